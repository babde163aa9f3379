"""Made-up parcels with what real ones have: drawn by hand, walked with a receiver, with obstacles.

One seed makes one parcel. Shapes are cells of a Voronoi diagram, strips, blocks, blocks that roads
cut and angled ones; with curved edges, rounded corners, ditches, yards and access strips.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon
from shapely.affinity import rotate, scale, translate
from shapely.geometry.base import BaseGeometry

Floats = NDArray[np.float64]
Draw = np.random.Generator

KINDS = ("drawn", "recorded", "obstacles")
# Both hemispheres, far north, UTM zones and their borders, beside the antimeridian.
PLACES = (
    (48.0, 11.0), (52.4, 5.6), (60.2, 24.9), (64.9, 25.4), (37.2, -120.5), (41.6, -93.6),
    (-12.5, -45.6), (-33.3, 149.1), (-45.9, 170.2), (-17.8, 179.95), (-16.8, -179.95),
    (10.0, 76.0), (35.9, 126.95), (51.0, 6.0), (0.5, 37.1),
)  # fmt: skip
AXIS_M, FLATTENING = 6_378_137.0, 1.0 / 298.257_223_563
NOISE_M, NOISE_POINTS = 0.03, 8.0
# The narrowest boom is 6 m wide: some of a parcel is as wide as that.
WIDE_ENOUGH_M = 6.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Parcel:
    """An outline and its obstacles, in longitude and latitude."""

    name: str
    kind: str
    outline: BaseGeometry
    obstacles: tuple[BaseGeometry, ...] = ()

    def write(self, folder: Path) -> tuple[Path, Path | None]:
        """Write the outline, and the obstacles where there are any."""
        outline = folder / f"{self.name}.geojson"
        outline.write_text(_collection([self.outline]))
        if not self.obstacles:
            return outline, None
        obstacles = folder / f"{self.name}.obstacles.geojson"
        obstacles.write_text(_collection(self.obstacles))
        return outline, obstacles


def _collection(shapes: Any) -> str:
    features = [
        {"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(each))}
        for each in shapes
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}) + "\n"


def read_parcel(path: Path, *, kind: str) -> Parcel:
    """Return a parcel from its files, as `Parcel.write` leaves them."""
    beside = path.with_name(f"{path.stem}.obstacles.geojson")
    return Parcel(
        name=path.stem, kind=kind,
        outline=shapely.union_all([shapely.make_valid(each) for each in _shapes(path)]),
        obstacles=tuple(_shapes(beside)) if beside.exists() else (),
    )  # fmt: skip


def _shapes(path: Path) -> list[BaseGeometry]:
    content = json.loads(path.read_text(encoding="utf-8"))
    return [
        shapely.from_geojson(json.dumps(each["geometry"]))
        for each in content.get("features", [content])
    ]


def parcel(kind: str, seed: int) -> Parcel:
    """Return the parcel of a kind and a seed."""
    draw = np.random.default_rng([KINDS.index(kind), seed])
    ground = _ground(draw, _area_m2(draw, 0.4 if kind == "obstacles" else 0.05))
    obstacles: list[Polygon] = []
    if kind == "obstacles":
        obstacles, holes = _obstacles(draw, ground)
        ground = _whole(ground.difference(shapely.union_all(holes)))
    if kind == "recorded" or (kind == "obstacles" and draw.random() < 0.3):
        ground = _walked(draw, ground)
    else:
        ground = _clicked(draw, ground)
    lat, lon = PLACES[int(draw.integers(len(PLACES)))]
    digits = 8 if kind == "recorded" else int(draw.integers(6, 9))
    to_degrees = _degrees(lat + draw.uniform(-0.01, 0.01), lon, digits)
    return Parcel(
        name=f"{kind}-{seed}", kind=kind, outline=_whole(shapely.transform(ground, to_degrees)),
        obstacles=tuple(shapely.transform(each, to_degrees) for each in obstacles),
    )  # fmt: skip


def _degrees(lat: float, lon: float, digits: int) -> Callable[[Floats], Floats]:
    """Return what turns metres around a place into longitude and latitude, with so many digits."""
    square = FLATTENING * (2.0 - FLATTENING)
    bent = 1.0 - square * math.sin(math.radians(lat)) ** 2
    east = AXIS_M / math.sqrt(bent) * math.cos(math.radians(lat))
    north = AXIS_M * (1.0 - square) / bent**1.5

    def turn(points: Floats) -> Floats:
        away = np.degrees(points / np.array([east, north]))
        return np.round(away + np.array([lon, lat]), digits)

    return turn


def _area_m2(draw: Draw, least_ha: float) -> float:
    """Return an area: mostly of 0.2 to 30 ha, a fifth of them of 0.05 to 400 ha."""
    low, high = (0.05, 400.0) if draw.random() < 0.2 else (0.2, 30.0)
    low = max(low, least_ha)
    return 1e4 * float(math.exp(draw.uniform(math.log(low), math.log(high))))


def _ground(draw: Draw, area_m2: float) -> Polygon:
    """Return a shape with details, in metres."""
    for _ in range(100):
        shape = _shape(draw)
        factor = math.sqrt(area_m2 / shape.area)
        ground = scale(shape, factor, factor, origin=(0.0, 0.0))
        for detail, share in (
            (_curved, 0.25), (_rounded, 0.3), (_notched, 0.25), (_ditched, 0.15), (_reaching, 0.1),
        ):  # fmt: skip
            if draw.random() < share:
                ground = _whole(detail(draw, ground))
        middle = ground.centroid
        ground = rotate(translate(ground, -middle.x, -middle.y), draw.uniform(0.0, 360.0), (0, 0))
        if ground.area > 0.5 * area_m2 and not ground.buffer(-WIDE_ENOUGH_M / 2.0).is_empty:
            return ground
    raise AssertionError("no shape is as wide as a boom")


def _whole(area: BaseGeometry) -> Polygon:
    """Return the largest part, valid."""
    parts = shapely.get_parts(shapely.make_valid(area))
    return max((part for part in parts if isinstance(part, Polygon)), key=lambda part: part.area)


def _shape(draw: Draw) -> Polygon:
    kind = draw.choice(["cell", "strip", "block", "cut", "angle"], p=[0.35, 0.2, 0.15, 0.15, 0.15])
    if kind == "cell":
        grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
        points = grid + draw.uniform(-0.4, 0.4, grid.shape)
        cells = shapely.get_parts(shapely.voronoi_polygons(shapely.MultiPoint(points)))
        order = np.argsort(shapely.distance(cells, shapely.Point(2.0, 2.0)))
        near = cells[order[: 2 if draw.random() < 0.3 else 1]]
        return scale(_whole(shapely.union_all(near)), 1.0, draw.uniform(1.0, 3.0), origin=(0, 0))
    if kind in ("strip", "block"):
        long = draw.uniform(4.0, 15.0) if kind == "strip" else draw.uniform(1.0, 3.0)
        skew = draw.uniform(-0.4, 0.4, 2) if kind == "strip" else draw.uniform(-0.1, 0.1, 2)
        return Polygon([(skew[0], 0.0), (long + skew[1], 0.0), (long, 1.0), (0.0, 1.0)])
    block: BaseGeometry = shapely.box(0.0, 0.0, draw.uniform(1.0, 2.5), 1.0)
    if kind == "angle":
        corner = shapely.box(0.0, 0.0, draw.uniform(0.3, 0.8), draw.uniform(0.3, 0.7))
        return _whole(block.difference(corner))
    for _ in range(int(draw.integers(1, 4))):
        at = draw.uniform(0.2, 0.8, 2) * np.array([block.bounds[2], 1.0])
        half = rotate(shapely.box(0.0, -5.0, 10.0, 5.0), draw.uniform(0.0, 360.0), origin=(0, 0))
        rest = block.difference(translate(half, *at))
        if rest.area > 0.35 * block.area:
            block = _whole(rest)
    return _whole(block)


def _edge(draw: Draw, ground: Polygon) -> tuple[Floats, Floats, float]:
    """Return start, direction and length of one of the longer edges; inside is to its left."""
    points = shapely.get_coordinates(shapely.geometry.polygon.orient(ground).exterior)
    steps = np.diff(points, axis=0)
    lengths = np.hypot(*steps.T)
    number = int(draw.choice(len(lengths), p=lengths**2 / (lengths**2).sum()))
    return points[number], steps[number] / lengths[number], float(lengths[number])


def _beside(start: Floats, along: Floats, *, at: float, long: float, deep: float) -> Polygon:
    """Return a rectangle that reaches from an edge into the ground, and a little out of it."""
    left = np.array([-along[1], along[0]])
    first, second = start + at * along, start + (at + long) * along
    return Polygon([first - left, second - left, second + deep * left, first + deep * left])


def _curved(draw: Draw, ground: Polygon) -> BaseGeometry:
    """Return the ground with a border that winds as a brook does."""
    start, along, length = _edge(draw, ground)
    share = np.linspace(0.0, 1.0, 40)
    waves = draw.uniform(0.5, 3.0)
    deep = draw.uniform(0.03, 0.12) * length / waves * np.sin(np.pi * share)
    aside = deep * (1.0 + np.sin(2.0 * np.pi * waves * share + draw.uniform(0.0, 6.0))) / 2.0
    left = np.array([-along[1], along[0]])
    bank = start + np.outer(share * length, along) + np.outer(aside, left)
    off = Polygon([*bank, start + length * along - left, start - left])
    return ground.difference(shapely.make_valid(off))


def _rounded(draw: Draw, ground: Polygon) -> BaseGeometry:
    radius = min(draw.uniform(3.0, 15.0), 0.1 * math.sqrt(ground.area))
    return ground.buffer(-radius).buffer(radius, quad_segs=int(draw.integers(2, 9)))


def _notched(draw: Draw, ground: Polygon) -> BaseGeometry:
    """Return the ground without a yard at an edge."""
    start, along, length = _edge(draw, ground)
    long = draw.uniform(0.1, 0.4) * length
    deep = min(draw.uniform(0.3, 1.5) * long, 0.3 * math.sqrt(ground.area))
    at = draw.uniform(0.0, length - long)
    return ground.difference(_beside(start, along, at=at, long=long, deep=deep))


def _ditched(draw: Draw, ground: Polygon) -> BaseGeometry:
    """Return the ground with a ditch of 1.5 to 4 m: along an edge, or into the ground."""
    start, along, length = _edge(draw, ground)
    wide = draw.uniform(1.5, 4.0)
    if draw.random() < 0.5:
        deep = draw.uniform(0.3, 0.7) * math.sqrt(ground.area)
        at = draw.uniform(0.1, 0.9) * length
        return ground.difference(_beside(start, along, at=at, long=wide, deep=deep))
    away, long = draw.uniform(6.5, 15.0), draw.uniform(0.4, 0.9) * length
    left = np.array([-along[1], along[0]])
    band = _beside(start + (away + 1.0) * left, along, at=-2.0, long=long, deep=wide)
    return ground.difference(band)


def _reaching(draw: Draw, ground: Polygon) -> BaseGeometry:
    """Return the ground with a narrow strip that leads out of it."""
    start, along, length = _edge(draw, ground)
    wide = min(draw.uniform(6.5, 14.0), length / 2.0)
    at = draw.choice([0.0, length - wide])
    far = min(draw.uniform(20.0, 150.0), math.sqrt(ground.area))
    left = np.array([-along[1], along[0]])
    return ground.union(_beside(start - far * left, along, at=at, long=wide, deep=far + 1.0))


def _clicked(draw: Draw, ground: Polygon) -> Polygon:
    """Return ground as it is drawn on a picture: few corners, each a little off."""
    coarse = min(draw.uniform(0.5, 3.0), 0.02 * math.sqrt(ground.area))
    simple = _whole(ground.simplify(coarse))
    off_m = draw.uniform(0.1, 0.5)
    return _whole(shapely.transform(simple, lambda points: points + _closed(draw, points, off_m)))


def _closed(draw: Draw, points: Floats, off_m: float) -> Floats:
    """Return an offset for each point; equal points have equal ones, or rings would not close."""
    _, which = np.unique(points, axis=0, return_inverse=True)
    found: Floats = draw.normal(0.0, off_m, (len(points), 2))[which.ravel()]
    return found


def _walked(draw: Draw, ground: Polygon) -> Polygon:
    """Return ground as a receiver records it: a point every 1 to 3 m, its error slowly changing."""
    step_m = draw.uniform(1.0, 3.0)

    def walk(ring: Any) -> Floats:
        places = np.arange(0.0, ring.length - step_m / 2.0, step_m)
        points = shapely.get_coordinates(shapely.line_interpolate_point(ring, places))
        kept = math.exp(-1.0 / NOISE_POINTS)
        noise = np.empty_like(points)
        noise[0] = draw.normal(0.0, NOISE_M, 2)
        for number in range(1, len(points)):
            fresh = draw.normal(0.0, NOISE_M * math.sqrt(1.0 - kept**2), 2)
            noise[number] = kept * noise[number - 1] + fresh
        return points + noise

    holes = [walk(ring) for ring in ground.interiors if ring.length > 4.0 * step_m]
    return _whole(Polygon(walk(ground.exterior), holes))


def _obstacles(draw: Draw, ground: Polygon) -> tuple[list[Polygon], list[Polygon]]:
    """Return up to 100 obstacles, and ponds that are holes of the outline instead."""
    count = int(min(100.0 * draw.random() ** 2, 12.0 * ground.area / 1e4))
    west, south, east, north = ground.bounds
    inner = ground.buffer(-8.0)
    apart, obstacles, holes = [], [], []
    for _ in range(40 * count):
        if len(apart) == count:
            break
        at = (draw.uniform(west, east), draw.uniform(south, north))
        kind = draw.choice(["tree", "pylon", "pond"], p=[0.7, 0.2, 0.1])
        shape = translate(_obstacle(draw, kind, ground.area), *at)
        if not inner.contains(shape) or any(shape.distance(other) < 1.0 for other in apart):
            continue
        apart.append(shape)
        (holes if kind == "pond" and draw.random() < 0.5 else obstacles).append(shape)
    return obstacles, holes


def _obstacle(draw: Draw, kind: str, area_m2: float) -> Polygon:
    if kind == "pylon":
        half = draw.uniform(0.5, 4.0)
        return rotate(shapely.box(-half, -half, half, half), draw.uniform(0.0, 90.0), (0, 0))
    corners = int(draw.integers(8, 33))
    turns = np.linspace(0.0, 2.0 * math.pi, corners, endpoint=False)
    radius = draw.uniform(1.0, 5.0)
    rough = np.ones(corners)
    if kind == "pond":
        radius = min(draw.uniform(5.0, 25.0), 0.1 * math.sqrt(area_m2))
        rough = 1.0 + 0.25 * np.sin(2.0 * turns + draw.uniform(0.0, 6.0))
    around = np.column_stack([np.cos(turns), np.sin(turns)])
    return Polygon(around * (radius * rough)[:, None])
