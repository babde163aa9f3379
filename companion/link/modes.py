"""Names of flight modes; the number alone means a different mode on each firmware and vehicle.

Sources: ArduPilot `ArduCopter/mode.h`, `ArduPlane/mode.h`, `Rover/mode.h`; PX4
`commander/px4_custom_mode.h` (main mode in bits 16 to 23, sub-mode of AUTO in bits 24 to 31).
"""

from __future__ import annotations

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

# MAV_TYPE: quadrotor, coaxial, helicopter, hexa-, octo-, tri-, dodeca-, decarotor.
_COPTER_TYPES = frozenset({2, 3, 4, 13, 14, 15, 29, 35})
_ROVER_TYPES = frozenset({10, 11})  # ground rover, surface boat
_PLANE_TYPES = frozenset({1, 19, 20, 21, 22, 23, 24, 25})  # fixed wing and the VTOLs

ARDUPILOT = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA
PX4 = 12  # MAV_AUTOPILOT_PX4


def autopilot_name(autopilot: int) -> str:
    """Return the firmware's name.

    >>> autopilot_name(12)
    'px4'
    """
    return {ARDUPILOT: "ardupilot", PX4: "px4"}.get(autopilot, f"autopilot {autopilot}")


def mode_name(autopilot: int, vehicle_type: int, custom_mode: int) -> str:
    """Return the mode's name as its firmware has it, `MODE n` where it is not known.

    >>> mode_name(3, 2, 3), mode_name(3, 10, 3), mode_name(12, 2, (4 << 16) | (4 << 24))
    ('AUTO', 'STEERING', 'MISSION')
    """
    if autopilot == PX4:
        return _px4_mode(custom_mode)
    table: dict[int, str] = {}
    if autopilot == ARDUPILOT and vehicle_type in _COPTER_TYPES:
        table = COPTER
    elif autopilot == ARDUPILOT and vehicle_type in _PLANE_TYPES:
        table = PLANE
    elif autopilot == ARDUPILOT and vehicle_type in _ROVER_TYPES:
        table = ROVER
    return table.get(custom_mode, f"MODE {custom_mode}")


def _px4_mode(custom_mode: int) -> str:
    main, sub = (custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF
    unknown = f"MODE {main}.{sub}"
    if main == 4:
        return PX4_AUTO.get(sub, unknown)
    return PX4_MAIN.get(main, unknown)
