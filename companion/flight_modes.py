"""Names of flight modes; the number alone means a different mode on each firmware and vehicle.

Sources: ArduPilot `ArduCopter/mode.h`, `ArduPlane/mode.h`, `Rover/mode.h`; PX4
`commander/px4_custom_mode.h` (main mode in bits 16 to 23, sub-mode of AUTO in bits 24 to 31).
"""

from __future__ import annotations

import re

COPTER = {
    0: "STABILIZE",
    1: "ACRO",
    2: "ALT_HOLD",
    3: "AUTO",
    4: "GUIDED",
    5: "LOITER",
    6: "RTL",
    7: "CIRCLE",
    9: "LAND",
    11: "DRIFT",
    13: "SPORT",
    14: "FLIP",
    15: "AUTOTUNE",
    16: "POSHOLD",
    17: "BRAKE",
    18: "THROW",
    19: "AVOID_ADSB",
    20: "GUIDED_NOGPS",
    21: "SMART_RTL",
    22: "FLOWHOLD",
    23: "FOLLOW",
    24: "ZIGZAG",
    25: "SYSTEMID",
    26: "AUTOROTATE",
    27: "AUTO_RTL",
    28: "TURTLE",
}
PLANE = {
    0: "MANUAL",
    2: "STABILIZE",
    5: "FBWA",
    6: "FBWB",
    7: "CRUISE",
    10: "AUTO",
    11: "RTL",
    12: "LOITER",
    15: "GUIDED",
    17: "QSTABILIZE",
    18: "QHOVER",
    19: "QLOITER",
    20: "QLAND",
    21: "QRTL",
}
ROVER = {
    0: "MANUAL",
    1: "ACRO",
    3: "STEERING",
    4: "HOLD",
    5: "LOITER",
    10: "AUTO",
    11: "RTL",
    12: "SMART_RTL",
    15: "GUIDED",
}
PX4_MAIN = {
    1: "MANUAL",
    2: "ALTCTL",
    3: "POSCTL",
    4: "AUTO",
    5: "ACRO",
    6: "OFFBOARD",
    7: "STABILIZED",
}
PX4_AUTO = {
    1: "READY",
    2: "TAKEOFF",
    3: "LOITER",
    4: "MISSION",
    5: "RTL",
    6: "LAND",
    8: "FOLLOW",
    9: "PRECLAND",
    10: "VTOL_TAKEOFF",
}

# What a mode that is in no table is called, by its number.
_BY_NUMBER = re.compile(r"MODE \d+(\.\d+)?")


_TABLES = {"ardupilot": (COPTER, PLANE, ROVER), "px4": (PX4_MAIN, PX4_AUTO)}


def known_modes(*autopilots: str) -> frozenset[str]:
    """Return the names of all modes in which a vehicle, with one of these, can be told to be.

    >>> {"AUTO", "MISSION"} <= known_modes(), "AUTO" in known_modes("px4")
    (True, False)
    """
    every = autopilots or tuple(_TABLES)
    names = frozenset(name for one in every for table in _TABLES[one] for name in table.values())
    # Of PX4 a mode of AUTO goes by its own name.
    return names if "ardupilot" in every else names - {"AUTO"}


def is_mode(name: str, *autopilots: str) -> bool:
    """Return whether a vehicle can be in a mode of this name.

    >>> is_mode("auto"), is_mode("MODE 31"), is_mode("ATUO")
    (True, True, False)
    """
    return name.upper() in known_modes(*autopilots) or bool(_BY_NUMBER.fullmatch(name.upper()))
