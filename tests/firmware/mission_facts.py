"""What ArduCopter 4.7 and PX4 1.16 answer to mission items, measured on their simulations.

Numbers are MAV_MISSION_RESULT: 0 accepted, 2 frame, 3 command, 6 to 12 a parameter. The stub is
held to these facts, and `test_missions.py` holds the facts to the firmwares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

# Of MAV_FRAME: absolute, local, mission, relative, and so on; one digit of an answer for each.
FRAMES = (0, 1, 2, 3, 4, 5, 6, 10, 11)
_PX4_PLACED, _PX4_PLACELESS, _PX4_BOTH = "023020022", "320323322", "020020022"
_PX4_NOT = "323323322"
_COPTER_PLACED, _COPTER_ANY, _COPTER_NOT = "020020000", "000000000", "333333333"


@dataclass(frozen=True, slots=True)
class Answers:
    """To one command in each of `FRAMES`, with good numbers."""

    px4: str
    ardupilot: str


COMMANDS: dict[int, Answers] = {
    **dict.fromkeys(
        (16, 17, 19, 21, 22, 31, 84, 85, 195), Answers(_PX4_PLACED, _COPTER_PLACED)
    ),
    **dict.fromkeys((18, 82, 92, 94, 191), Answers(_PX4_NOT, _COPTER_PLACED)),
    **dict.fromkeys(
        (20, 93, 112, 114, 177, 178, 197, 206, 211, 2000, 2500),
        Answers(_PX4_PLACELESS, _COPTER_ANY),
    ),
    **dict.fromkeys((95, 113, 176), Answers(_PX4_NOT, _COPTER_NOT)),
    **dict.fromkeys(
        (115, 181, 182, 183, 184, 193, 207, 212, 215, 216, 222), Answers(_PX4_NOT, _COPTER_ANY)
    ),
    **dict.fromkeys((179, 189), Answers(_PX4_PLACELESS, _COPTER_PLACED)),
    **dict.fromkeys((187, 214), Answers(_PX4_PLACELESS, _COPTER_NOT)),
    201: Answers(_PX4_BOTH, _COPTER_PLACED),
}  # fmt: skip
# Commands that are sent with a place where their frame has one.
PLACED = frozenset({16, 17, 18, 19, 21, 22, 31, 82, 84, 85, 94, 189, 195, 201})
# Numbers with which the commands above were sent; zeros where none are named.
NUMBERS: dict[int, tuple[float, float, float, float]] = {
    19: (2, 0, 0, 0), 93: (2, 0, 0, 0), 112: (2, 0, 0, 0), 114: (2, 0, 0, 0), 115: (90, 10, 1, 0),
    177: (1, 1, 0, 0), 178: (1, 5, -1, 0), 181: (0, 1, 0, 0), 183: (9, 1500, 0, 0),
    187: (-1, -1, -1, -1), 216: (1, 0, 0, 0),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Numbers:
    """An item with numbers that ArduPilot refuses and PX4 does not look at."""

    command: int
    frame: int = 3
    params: tuple[float, float, float, float] = (0.0, 0.0, 0.0, math.nan)
    latitude_deg: float = 36.0
    longitude_deg: float = 114.5
    height_m: float = 3.5
    ardupilot: int = 0
    px4: int = 0


NUMBERED: dict[str, Numbers] = {
    "open hold": Numbers(command=16, params=(math.nan, 0, 0, 0), ardupilot=6),
    "endless hold": Numbers(command=16, params=(math.inf, 0, 0, 0), ardupilot=6),
    "open yaw": Numbers(command=16),
    "open speed": Numbers(
        command=178, frame=2, params=(1, math.nan, -1, 0), latitude_deg=0, longitude_deg=0,
        ardupilot=7,
    ),
    "speed of 0": Numbers(
        command=178, frame=2, params=(1, 0, -1, 0), latitude_deg=0, longitude_deg=0
    ),
    "latitude of 95": Numbers(command=16, latitude_deg=95.0, ardupilot=10),
    "longitude of 185": Numbers(command=16, longitude_deg=185.0, ardupilot=11),
    "open height": Numbers(command=16, height_m=math.nan, ardupilot=12),
    "height of 10 000 km": Numbers(command=16, height_m=1e7, ardupilot=12),
    "landing at 0, 0": Numbers(command=21, latitude_deg=0.0, longitude_deg=0.0, height_m=0.0),
    "waypoint at 0, 0": Numbers(command=16, latitude_deg=0.0, longitude_deg=0.0),
    "take-off at 0, 0": Numbers(command=22, latitude_deg=0.0, longitude_deg=0.0),
}  # fmt: skip
