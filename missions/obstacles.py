"""What stands in the way: areas, trees as points with a radius, power lines with a corridor.

How far a point or a line reaches is never guessed: each has it as an attribute, or the command
line says it for all that have none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame
from missions.errors import PlanError
from missions.maps.layer import Value, as_number
from missions.maps.local import make_valid, project_all
from missions.maps.registry import Record, read_records
from missions.reading_outline import NOTHING_TOLD, check_near, told

RADIUS_MAX_M, CORRIDOR_MAX_M, HEIGHT_MAX_M = 100.0, 500.0, 500.0
# Points grow to polygons of 16 corners around their circle, not in it; corners of areas are rounded
# more closely, 0.2 % of the buffer outside: how they are flown around is decided later.
QUARTER, AROUND = 4, 1.0 / math.cos(math.pi / 16.0)
CLOSE_QUARTER, CLOSELY_AROUND = 12, 1.0 / math.cos(math.pi / 48.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """Ground, points or lines in longitude and latitude, and how far beyond them it reaches.

    `height_m` is above the ground; None is not known, and so as high as any.
    """

    geometry: BaseGeometry
    beyond_m: float = 0.0
    height_m: float | None = None

    def ground(
        self, frame: LocalFrame, buffer_m: float, offset_m: tuple[float, float] = (0.0, 0.0)
    ) -> BaseGeometry:
        """Return its ground in metres with a buffer, all of it and with straight edges."""
        local = project_all(np.array([self.geometry], dtype=object), frame, offset_m=offset_m)[0]
        far_m = self.beyond_m + buffer_m
        dimensions = int(shapely.get_dimensions(local))
        if dimensions == 2:
            local = local if local.is_valid else make_valid(local)
        if local is None:
            raise PlanError("an obstacle has no ground; draw it again")
        found: BaseGeometry = (
            local.buffer(AROUND * far_m, quad_segs=QUARTER)
            if dimensions == 0
            else local.buffer(CLOSELY_AROUND * far_m, quad_segs=CLOSE_QUARTER, cap_style="square")
        )
        return found


def read_obstacles(
    path: Path,
    frame: LocalFrame,
    *,
    radius_m: float | None = None,
    corridor_m: float | None = None,
    opens: Mapping[str, str | None] = NOTHING_TOLD,
) -> list[Obstacle]:
    """Return the obstacles in a file; what has no radius or corridor of its own takes those given.

    Raises:
        PlanError, MapError: in one line, which record lacks what, or that the file is of elsewhere.
    """
    records = told(partial(read_records, path), opens)
    west, south, east, north = shapely.total_bounds([each.geometry for each in records]).tolist()
    check_near(str(path), (south + north) / 2.0, (west + east) / 2.0, frame)
    return _together([_obstacle(path, record, radius_m, corridor_m) for record in records])


def _together(obstacles: list[Obstacle]) -> list[Obstacle]:
    """Return the obstacles, those of one kind, reach and height as one: there may be thousands."""
    alike: dict[tuple[int, float, float | None], list[BaseGeometry]] = {}
    for each in obstacles:
        kind = int(shapely.get_dimensions(each.geometry))
        alike.setdefault((kind, each.beyond_m, each.height_m), []).append(each.geometry)
    return [
        Obstacle(geometry=_united(shapes), beyond_m=beyond_m, height_m=height_m)
        for (_, beyond_m, height_m), shapes in alike.items()
    ]


def _united(shapes: list[BaseGeometry]) -> BaseGeometry:
    try:
        return shapely.union_all(np.array(shapes, dtype=object))
    except ShapelyError as error:
        raise PlanError(f"obstacles do not unite ({str(error)[:80]}); repair them") from error


def _obstacle(
    path: Path, record: Record, radius_m: float | None, corridor_m: float | None
) -> Obstacle:
    height_m = _metres(path, record, "height_m", HEIGHT_MAX_M)
    dimensions = shapely.get_dimensions(record.geometry)
    if dimensions == 2:
        return Obstacle(geometry=record.geometry, height_m=height_m)
    if dimensions == 0:
        given_m = _metres(path, record, "radius_m", RADIUS_MAX_M)
        beyond_m = radius_m if given_m is None else given_m
        what, name, option = "point", "radius_m", "--obstacle-radius-m"
        about = "its radius in metres, the crown of a tree"
    else:
        given_m = _metres(path, record, "corridor_m", CORRIDOR_MAX_M)
        width_m = corridor_m if given_m is None else given_m
        beyond_m = None if width_m is None else width_m / 2.0
        what, name, option = "line", "corridor_m", "--corridor-m"
        about = "the whole width in metres to keep free along it"
    if beyond_m is None:
        raise PlanError(
            f"{path}: record {record.name} is a {what} without {name} ({about}); add the "
            f"attribute, or give one for all with {option}"
        )
    return Obstacle(geometry=record.geometry, beyond_m=beyond_m, height_m=height_m)


def _metres(path: Path, record: Record, name: str, most_m: float) -> float | None:
    """Return an attribute; None where the record has none."""
    values: Mapping[str, Value] = record.values
    try:
        found = as_number(values.get(name))
    except ValueError:
        found = math.nan
    if found is None or 0.0 < found <= most_m:
        return found
    raise PlanError(
        f"{path}: {name} of record {record.name} is {str(values[name])[:40]!r}; write metres "
        f"above 0 and up to {most_m:g}"
    )
