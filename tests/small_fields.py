"""Fields of 0.05 to 1 ha: cuts of real outlines, ditches, triangles, L-shapes, with seeds."""

from __future__ import annotations

import json
import math
import os
import random
from collections.abc import Iterator
from pathlib import Path

import shapely
from shapely import Polygon, box
from shapely.affinity import rotate, translate
from shapely.geometry.base import BaseGeometry

from tests.mission_fields import degrees
from tests.mission_judge import Drawn

LEAST_HA, MOST_HA = 0.05, 1.0
WIDTH_M = 6.0
# A swath of 6 m and a half: two passes on ground that is a third too wide for one.
DITCH_M = 7.6
KINDS = ("ditch", "bent ditch", "triangle", "L", "quadrangle", "rectangle")


def small_fields(seed: int = 1, each: int = 4) -> Iterator[tuple[str, Drawn]]:
    """Yield made-up fields, so many of each kind, and, where the samples are, cuts of real ones."""
    for kind in KINDS:
        for number in range(each):
            ground = made_up(kind, seed * 1000 + number)
            yield f"{kind} {number}", Drawn(outline=degrees(ground), width_m=WIDTH_M)
    draw = random.Random(seed)
    for name, drawn in _real():
        ground = drawn.plane.area(drawn.outline)
        if ground.area < MOST_HA * 1e4:
            yield name, drawn
            continue
        for number in range(each // 2):
            part = _cut(ground, draw)
            if part is not None:
                yield f"{name} cut {number}", Drawn(outline=degrees(part), width_m=WIDTH_M)


def _real() -> Iterator[tuple[str, Drawn]]:
    """Yield the real outlines of VRSPRAY_SAMPLES."""
    folder = os.environ.get("VRSPRAY_SAMPLES")
    for path in sorted(Path(folder).glob("fields/*.geojson")) if folder else ():
        content = json.loads(path.read_text(encoding="utf-8"))
        shapes = [
            shapely.make_valid(shapely.from_geojson(json.dumps(each["geometry"])))
            for each in content.get("features", [content])
        ]
        yield path.stem, Drawn(outline=shapely.union_all(shapes), width_m=WIDTH_M)


def made_up(kind: str, seed: int) -> Polygon:
    """Return a field of a kind, in metres."""
    draw = random.Random(f"{kind} {seed}")
    area_m2 = 1e4 * math.exp(draw.uniform(math.log(LEAST_HA), math.log(MOST_HA)))
    side_m = math.sqrt(area_m2)
    if kind == "ditch":
        shape = box(0.0, 0.0, draw.uniform(70.0, 400.0), DITCH_M)
    elif kind == "bent ditch":
        course, points = 0.0, [(0.0, 0.0)]
        for _ in range(draw.randint(2, 4)):
            course += math.radians(draw.uniform(-35.0, 35.0))
            long_m = draw.uniform(30.0, 110.0)
            x, y = points[-1]
            points.append((x + long_m * math.cos(course), y + long_m * math.sin(course)))
        shape = shapely.LineString(points).buffer(
            DITCH_M / 2.0, cap_style="flat", join_style="mitre"
        )
    elif kind == "triangle":
        top = draw.uniform(-0.2, 1.2)
        shape = _scaled(Polygon([(0, 0), (1, 0), (top, draw.uniform(0.5, 1.2))]), area_m2)
    elif kind == "L":
        wide, high = draw.uniform(0.3, 0.7), draw.uniform(0.3, 0.7)
        shape = _scaled(
            Polygon([(0, 0), (1.3, 0), (1.3, high), (wide, high), (wide, 1), (0, 1)]), area_m2
        )
    elif kind == "quadrangle":
        corners = [(0, 0), (1.5, 0), (1.5, 1), (0, 1)]
        shape = _scaled(
            Polygon(
                [(x + draw.uniform(-0.2, 0.2), y + draw.uniform(-0.2, 0.2)) for x, y in corners]
            ),
            area_m2,
        )
    else:
        ratio = draw.uniform(1.0, 4.0)
        shape = box(0.0, 0.0, side_m * math.sqrt(ratio), side_m / math.sqrt(ratio))
    turned = rotate(shape, draw.uniform(0.0, 360.0), origin=(0.0, 0.0))
    assert isinstance(turned, Polygon)
    return turned


def _scaled(shape: Polygon, area_m2: float) -> Polygon:
    factor = math.sqrt(area_m2 / shape.area)
    return shapely.transform(shape, lambda points: points * factor)


def _cut(ground: BaseGeometry, draw: random.Random) -> Polygon | None:
    """Return a piece of a field, as a farm road or a neighbour's crop leaves it at its border."""
    west, south, _, _ = ground.bounds
    for _ in range(200):
        side_m = math.sqrt(1e4 * draw.uniform(LEAST_HA, MOST_HA))
        border = ground.boundary
        place = border.interpolate(draw.uniform(0.0, border.length))
        ratio = draw.uniform(0.6, 1.7)
        frame = box(-side_m * ratio, -side_m / ratio, side_m * ratio, side_m / ratio)
        frame = translate(rotate(frame, draw.uniform(0.0, 180.0)), place.x, place.y)
        parts = shapely.get_parts(ground.intersection(frame))
        part = max(parts, key=lambda each: each.area)
        if (
            isinstance(part, Polygon)
            and LEAST_HA * 1e4 <= part.area <= MOST_HA * 1e4
            and part.buffer(-WIDTH_M / 2.0 - 0.5).geom_type == "Polygon"
            and not part.buffer(-WIDTH_M / 2.0 - 0.5).is_empty
        ):
            return translate(part, -west, -south)
    return None
