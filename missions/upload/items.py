"""A mission as it travels: numbers of MISSION_ITEM_INT, what files hold and firmwares refuse."""

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
from companion.wording import counted

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
    """Return why this is not a mission for a field, and what to do; None where it is one.

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


# -------------------------------------------------------------------------- what a firmware refuses

FIRMWARES: dict[Firmware, str] = {"ardupilot": "ArduPilot", "px4": "PX4"}
# Measured on ArduCopter 4.7 and PX4 1.16. 112 and 114 end PX4's check before the start instead.
REFUSED: dict[Firmware, frozenset[int]] = {
    "ardupilot": frozenset({95, 113, 176, 187, 214}),
    "px4": frozenset(
        {18, 82, 92, 94, 95, 112, 113, 114, 115, 176, 181, 182, 183, 184, 191, 193, 207, 212}
    )
    | frozenset({215, 216, 222}),
}
# ArduPilot keeps 70 items of a fence in 560 bytes: 5 at its ends, 8 for a corner, 2 more for a
# polygon, 13 for a circle. Measured on 4.7: 555 of corners, polygons and circles are taken, 559
# refused, 556 end in "PANIC: Fence corrupt (offset=560)".
FENCE_BYTES, FENCE_ITEMS_MAX = 560, 70
ENDS_BYTES, CORNER_BYTES, POLYGON_BYTES, CIRCLE_BYTES = 5, 8, 2, 13
CIRCLES = frozenset({5003, 5004})
# PX4 takes one list of commands in frames with places, another in frame 2, and nothing in both.
PX4_PLACED = frozenset({16, 17, 19, 21, 22, 31, 84, 85, 195})
PX4_PLACELESS = frozenset({20, 93, 177, 178, 179, 187, 189, 197, 206, 211, 214, 2000, 2500})
FIXES = {
    216: "plan without --sprayer: valves follow the map by position",
    183: "valves follow the map by position: leave it out",
    187: "valves follow the map by position: leave it out",
}
# 2e-7 degrees are 2 cm: PX4 keeps degrees as floating point. ArduPilot keeps whole centimetres.
PLACE_E7, HEIGHT_M, PARAM = 2, 0.011, 1e-3
YAW = 3
# Copters of ArduPilot take no radius and no yaw from a waypoint; a LAND reads back with a yaw of 1.
NOT_KEPT: dict[Firmware, dict[int, tuple[int, ...]]] = {
    "ardupilot": {WAYPOINT: (1, 2, 3), LAND: (3,), TAKEOFF: (0, 1, 2, 3)},
    "px4": {WAYPOINT: (2,), TAKEOFF: (1, 2)},
}


def refusal(file: MissionFile, firmware: Firmware) -> str | None:
    """Return why the firmware would refuse this mission, and what to do; None where it takes it.

    Items are numbered as ground stations do: home is 0.
    """
    name = FIRMWARES[firmware]
    for number, item in enumerate(file.items, start=1):
        if item.command in REFUSED[firmware]:
            fix = FIXES.get(item.command, "leave it out")
            return f"{file.path}: item {number}: {name} takes no {item.name}; {fix}"
        wrong = _wrong_frame(item, firmware)
        if wrong is not None:
            return f"{file.path}: item {number}: {name} takes {wrong}"
    return None


def crowded(file: MissionFile, firmware: Firmware) -> str | None:
    """Return why a fence must not be sent to ArduPilot; None where it may be.

    More corners than it has room for it refuses itself. Of fewer it looks at their bytes only as
    far as the last shape begins: one that ends in the last five makes it halt ("Fence corrupt").
    """
    corners = len(file.fence)
    if firmware != "ardupilot" or not file.fence or corners > FENCE_ITEMS_MAX:
        return None
    shapes = 0.0
    for item in file.fence:
        is_circle = item.command in CIRCLES
        shapes += 1.0 if is_circle else 1.0 / max(item.params[0], 1.0)
    circles = sum(item.command in CIRCLES for item in file.fence)
    polygons = round(shapes) - circles
    taken = ENDS_BYTES + CIRCLE_BYTES * circles + POLYGON_BYTES * polygons
    taken += CORNER_BYTES * (corners - circles)
    if taken <= FENCE_BYTES:
        return None
    return (
        f"{file.path}: its fence takes {taken} bytes, and ArduPilot keeps {FENCE_BYTES}: one that "
        "is a little too large makes it halt; draw it with fewer corners, or say --no-fence"
    )


def _wrong_frame(item: WireItem, firmware: Firmware) -> str | None:
    """Return what of an item's frame the firmware refuses, and what to do."""
    if firmware == "px4" and SAME_FRAME.get(item.frame) == TERRAIN:
        return "no height above terrain; plan heights above home"
    if item.frame not in SAME_FRAME and item.frame != MISSION_FRAME:
        if firmware == "px4" or item.command in PLACES:
            return f"no {item.name} in frame {item.frame}; write frame {_frame_for(item)}"
        return None
    if firmware == "px4":
        has_place = item.frame in SAME_FRAME
        if item.command in (PX4_PLACELESS if has_place else PX4_PLACED):
            return f"{item.name} in frame {_frame_for(item)} only, not in {item.frame}"
    return None


def _frame_for(item: WireItem) -> int:
    return MISSION_FRAME if item.command in PX4_PLACELESS else RELATIVE


def blame(file: MissionFile, firmware: Firmware, asked: int | None) -> str | None:
    """Return which item ended an upload: a vehicle refuses the one that it last asked for.

    It says no more than a number, PX4 not even that.
    """
    number = None if asked is None else asked + (firmware == "px4")
    if number is None or not 1 <= number <= len(file.items):
        return None
    item = file.items[number - 1]
    numbers = ", ".join(f"{value:g}" for value in item.params)
    place = f" at {item.x / 1e7:.7f}, {item.y / 1e7:.7f}" if item.x or item.y else ""
    return f"item {number} ({item.name} in frame {item.frame}, parameters {numbers}{place})"


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """`differences` make another mission of it; `left_out` is what the firmware never keeps."""

    differences: tuple[str, ...]
    left_out: tuple[str, ...]


def compare(sent: Sequence[WireItem], back: Sequence[WireItem], firmware: Firmware) -> Compared:
    """Return what of the mission that was sent is not the one that is there.

    ArduPilot's item 0 is home, which it replaces by its own.
    """
    is_fence = bool(sent) and FENCE_FIRST <= sent[0].command <= FENCE_LAST
    first = 1 if firmware == "ardupilot" and not is_fence else 0
    if len(sent) != len(back):
        text = f"{counted(len(sent) - first, 'item')} sent, {len(back) - first} are there"
        return Compared(differences=(text,), left_out=())
    differences: list[str] = []
    left_out: list[str] = []
    pairs = list(zip(sent, back, strict=True))[first:]
    for number, (one, other) in enumerate(pairs, start=1):
        for index, text in _differences(one, other):
            is_lost = index in NOT_KEPT[firmware].get(one.command, ())
            if is_lost and (math.isnan(one.params[index]) or one.params[index] == 0.0):
                continue  # it was left open: what stands there instead means nothing
            (left_out if is_lost else differences).append(f"item {number} ({one.name}): {text}")
    return Compared(differences=tuple(differences), left_out=tuple(left_out))


def _differences(one: WireItem, other: WireItem) -> list[tuple[int, str]]:
    """Return what differs, each with the parameter's index; -1 for all else."""
    if one.command != other.command:
        return [(-1, f"{other.name} is there")]
    found = []
    if one.command in PLACES and (one.x or one.y):
        found += _of_place(one, other)
    for index, (value, kept) in enumerate(zip(one.params, other.params, strict=True)):
        if not _is_same(value, kept, is_yaw=index == YAW and one.command in (WAYPOINT, TAKEOFF)):
            found.append((index, f"parameter {index + 1} was {value:g}, {kept:g} is there"))
    return found


def _of_place(one: WireItem, other: WireItem) -> list[tuple[int, str]]:
    if not (abs(one.x - other.x) <= PLACE_E7 and abs(one.y - other.y) <= PLACE_E7):
        places = [f"{item.x / 1e7:.7f} {item.y / 1e7:.7f}" for item in (one, other)]
        return [(-1, f"was at {places[0]}, {places[1]} is there")]
    if FENCE_FIRST <= one.command <= FENCE_LAST:  # a corner has no height
        return []
    if SAME_FRAME.get(one.frame) != SAME_FRAME.get(other.frame):
        return [(-1, f"was in frame {one.frame}, {other.frame} is there")]
    if not abs(one.z_m - other.z_m) <= HEIGHT_M:
        return [(-1, f"was {one.z_m:g} m high, {other.z_m:g} is there")]
    return []


def _is_same(value: float, kept: float, *, is_yaw: bool) -> bool:
    """Return whether a parameter is kept; one left open may come back as zero or open."""
    if math.isnan(value) or value == 0.0:
        return math.isnan(kept) or kept == 0.0
    if is_yaw:
        return abs((value - kept + 180.0) % 360.0 - 180.0) <= 0.1
    return abs(value - kept) <= PARAM * max(1.0, abs(value))
