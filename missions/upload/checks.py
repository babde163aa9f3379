"""What each firmware refuses, known before anything is sent, and whether what is there is it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from companion.wording import counted
from missions.upload.items import (
    FENCE_FIRST,
    FENCE_LAST,
    LAND,
    MISSION_FRAME,
    PLACES,
    RELATIVE,
    SAME_FRAME,
    TAKEOFF,
    TERRAIN,
    WAYPOINT,
    Firmware,
    MissionFile,
    WireItem,
)

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
