"""A mission as it travels: numbers of MISSION_ITEM_INT, and what a file holds of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

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
