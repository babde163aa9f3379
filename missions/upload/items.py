"""A mission as it travels: numbers of MISSION_ITEM_INT, and what a file holds of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Literal

import shapely
from shapely.geometry.base import BaseGeometry

from companion.core.frame import LocalFrame

Firmware = Literal["ardupilot", "px4"]
Params = tuple[float, float, float, float]

WAYPOINT, LAND, TAKEOFF = 16, 21, 22
FENCE_FIRST, FENCE_LAST = 5000, 5004
# Frames with a place, each with the one that means the same (the INT twins are deprecated).
GLOBAL, RELATIVE, TERRAIN = 0, 3, 10
# MAV_FRAME_MISSION: of what is not somewhere.
MISSION_FRAME = 2
SAME_FRAME = {0: 0, 5: 0, 3: 3, 6: 3, 10: 10, 11: 10}
# Commands whose last three numbers are a place that the vehicle keeps.
PLACES = frozenset({16, 17, 18, 19, 21, 22, 31, 82, 84, 85, 179, 189, 195, 201, 5000, 5001, 5002})
PLACES |= {5003, 5004}
NAMES = {
    16: "WAYPOINT", 20: "RETURN_TO_LAUNCH", 21: "LAND", 22: "TAKEOFF", 82: "SPLINE_WAYPOINT",
    112: "CONDITION_DELAY", 114: "CONDITION_DISTANCE", 115: "CONDITION_YAW", 177: "DO_JUMP",
    178: "DO_CHANGE_SPEED", 181: "DO_SET_RELAY", 183: "DO_SET_SERVO", 187: "DO_SET_ACTUATOR",
    215: "DO_SET_RESUME_REPEAT_DIST", 216: "DO_SPRAYER",
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class WireItem:
    """One item; `x` and `y` are latitude and longitude in 1e-7 degrees where it has a place.

    NaN is a parameter that is left to the autopilot.
    """

    command: int
    frame: int
    params: Params = (0.0, 0.0, 0.0, 0.0)
    x: int = 0
    y: int = 0
    z_m: float = 0.0
    goes_on: bool = True

    @property
    def name(self) -> str:
        """Return what the command is called."""
        return NAMES.get(self.command, f"command {self.command}")


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionFile:
    """What a file holds: `items` do not count home, which ArduPilot has as its item 0."""

    path: Path
    home: WireItem
    items: tuple[WireItem, ...]
    fence: tuple[WireItem, ...] = ()

    def items_for(self, firmware: Firmware) -> tuple[WireItem, ...]:
        """Return what travels: ArduPilot numbers home, PX4 has no home in its mission.

        A waypoint file has 0 where a yaw is left open, which PX4 would take for the north.
        """
        if firmware == "ardupilot":
            return (self.home, *self.items)
        if self.path.suffix.casefold() == ".plan":
            return self.items
        return tuple(_with_open_yaw(item) for item in self.items)


def _with_open_yaw(item: WireItem) -> WireItem:
    if item.command not in (WAYPOINT, LAND, TAKEOFF) or item.params[3]:
        return item
    return replace(item, params=(*item.params[:3], math.nan))


# Whether a mission stays where its field is: items at 0, 0, far away, or outside its own fence.
#
# With a configuration at hand, whether it is that one's field at all.

# A sortie of a spraying aircraft is smaller than this; another field is mostly farther away.
FAR_M = 5000.0
# Items are said to be somewhere by whole metres up to this, then by kilometres.
METRES_TO = 1000.0
# Corners are kept to 2 cm, and a line along the fence may be drawn on it.
ON_FENCE_M = 0.1
POLYGON_IN, POLYGON_OUT, CIRCLE_IN, CIRCLE_OUT = 5001, 5002, 5003, 5004
DEGREES = 1e-7

Numbered = tuple[int, WireItem]


def misplaced(file: MissionFile, firmware: Firmware, *, with_fence: bool) -> str | None:
    """Return which item leads away from the field, and what to do; None where none does."""
    placed = [
        (number, item)
        for number, item in enumerate(file.items, start=1)
        if item.command in PLACES and not FENCE_FIRST <= item.command <= FENCE_LAST
    ]
    for number, item in placed:
        if item.frame not in SAME_FRAME and (item.x or item.y):
            return (
                f"{file.path}: item {number} ({item.name}): it has a place, and frame "
                f"{item.frame} has none; write frame 3"
            )
        if firmware == "px4" and item.frame in SAME_FRAME and not (item.x or item.y):
            return (
                f'{file.path}: item {number} ({item.name}): it is at 0, 0, which means "here" to '
                "ArduPilot; PX4 would fly to the Atlantic. Give it real coordinates"
            )
    somewhere = [(number, item) for number, item in placed if item.x or item.y]
    return next(_away(file, somewhere, with_fence=with_fence), None)


def elsewhere(
    file: MissionFile,
    field: shapely.Polygon | shapely.MultiPolygon,
    frame: LocalFrame,
    *,
    reach_m: float,
    whose: str,
) -> str | None:
    """Return why this is no mission for a field, and what to do; None where it is one.

    A depot may lie far from its field. Some way from item to item leads over the field all the
    same, or so near that a boom which reaches `reach_m` to the side comes over it.
    """
    fix = "correct the mission or take the configuration of its field, or say --elsewhere"
    placed = [
        (number, item, shapely.Point(*frame.to_local(item.x * DEGREES, item.y * DEGREES)))
        for number, item in enumerate(file.items, start=1)
        if item.command in PLACES and (item.x or item.y)
    ]
    for number, item, point in placed:
        far_m = point.distance(field)
        if not far_m <= FAR_M:
            return (
                f"{file.path}: item {number} ({item.name}): {item.x * DEGREES:.7f}, "
                f"{item.y * DEGREES:.7f} is {_said(far_m)} from the field of {whose}; {fix}"
            )
    ways = [shapely.LineString((a, b)) for (*_, a), (*_, b) in pairwise(placed)]
    if any(way.distance(field) <= reach_m for way in ways):
        return None
    nearest = min(placed, key=lambda each: each[2].distance(field), default=None)
    how_near = ""
    if nearest is not None:
        number, item, point = nearest
        how_near = (
            f"; the nearest item, item {number} ({item.name}), is "
            f"{_said(point.distance(field))} from it"
        )
    return f"{file.path}: no way of the mission leads over the field of {whose}{how_near}; {fix}"


def _said(length_m: float) -> str:
    return f"{length_m:.0f} m" if length_m < METRES_TO else f"{length_m / 1000.0:.1f} km"


def _away(file: MissionFile, placed: Sequence[Numbered], *, with_fence: bool) -> Iterator[str]:
    """Yield what is said of items far from the others or outside the fence."""
    if not placed:
        return
    known = [item for item in (file.home, *(item for _, item in placed)) if item.x or item.y]
    middle = LocalFrame(
        median(item.x for item in known) * DEGREES, median(item.y for item in known) * DEGREES
    )
    for number, item in placed:
        if not math.hypot(*middle.to_local(item.x * DEGREES, item.y * DEGREES)) <= FAR_M:
            yield (
                f"{file.path}: item {number} ({item.name}): {item.x * DEGREES:.7f}, "
                f"{item.y * DEGREES:.7f} is more than {FAR_M / 1000.0:g} km from the field; "
                "correct its place"
            )
    if with_fence and file.fence:
        inside, outside = _fence(file.fence, middle)
        for number, item in placed:
            point = shapely.Point(*middle.to_local(item.x * DEGREES, item.y * DEGREES))
            if inside is not None and not inside.covers(point):
                where = "outside the fence"
            elif outside.covers(point):
                where = "where the fence forbids it"
            else:
                continue
            yield (
                f"{file.path}: item {number} ({item.name}): it is {where} of the same file; "
                "correct one of them, or say --no-fence"
            )


def _fence(
    fence: Sequence[WireItem], frame: LocalFrame
) -> tuple[BaseGeometry | None, BaseGeometry]:
    """Return where the fence wants the vehicle, None for anywhere, and where it forbids it."""
    shapes: dict[bool, list[BaseGeometry]] = {True: [], False: []}
    rest = list(fence)
    while rest:
        item = rest[0]
        local = [frame.to_local(one.x * DEGREES, one.y * DEGREES) for one in rest]
        if item.command in (POLYGON_IN, POLYGON_OUT):
            count = max(int(item.params[0]), 1)
            ring = shapely.Polygon(local[:count]) if count >= 3 <= len(local) else shapely.Point()
            shapes[item.command == POLYGON_IN].append(ring.buffer(0.0))
        else:
            count = 1
            if item.command in (CIRCLE_IN, CIRCLE_OUT):
                circle = shapely.Point(*local[0]).buffer(item.params[0], quad_segs=64)
                shapes[item.command == CIRCLE_IN].append(circle)
        rest = rest[count:]
    wanted = shapely.union_all(shapes[True]).buffer(ON_FENCE_M) if shapes[True] else None
    return wanted, shapely.union_all(shapes[False]).buffer(-ON_FENCE_M)
