"""PX4, as the rest of the stub asks for it; some of its rules depend on the version."""

from __future__ import annotations

from sitl.stub.ardupilot import MESSAGES
from sitl.stub.firmware import Firmware, Version
from sitl.stub.mission_items import refused_by_px4
from sitl.stub.parameters import INT32, OUTPUT_COUNT, REAL32, Parameters
from sitl.stub.px4_commands import (
    ACKNOWLEDGED_SINCE,
    AT_ONCE,
    COMMANDS,
    DO_SET_ACTUATOR,
    handle_set_mode,
    set_actuators,
)
from sitl.stub.px4_streams import BUILDERS, DEFAULT_RATES_HZ, heartbeat, withholds

NAME = "px4"
VERSION: Version = (1, 16, 0)
COMMANDS_PER_S = 30.0
_QUEUE_DEPTH = 8
_FIRST_VALVE_OUTPUT = 9


def px4(version: Version = VERSION, *, commands_per_s: float = COMMANDS_PER_S) -> Firmware:
    """Return PX4 of a version."""
    return Firmware(
        name=NAME,
        version=version,
        heartbeat=heartbeat,
        messages={**MESSAGES, "SET_MODE": handle_set_mode},
        commands=COMMANDS,
        builders=BUILDERS,
        refuses_item=refused_by_px4,
        int_scale=1e-7,
        withholds=withholds,
        groups={},
        default_rates_hz=DEFAULT_RATES_HZ,
        commands_at_once=AT_ONCE,
        mixed_at_once={DO_SET_ACTUATOR: set_actuators},
        queue_depth=_QUEUE_DEPTH,
        commands_per_s=commands_per_s,
        first_item=1,
        zero_is_a_place=True,
        keeps_item=True,
        timesync_s=0.1,
        forwards=False,
        tells_of_actions=False,
        # EKF2 publishes every 8 ms; GLOBAL_POSITION_INT carries that time.
        position_step_s=0.008,
    )


def nan_keeps(version: Version) -> bool:
    """Return whether a NaN leaves an actuator alone."""
    return version >= ACKNOWLEDGED_SINCE


def px4_parameters() -> Parameters:
    """Return PX4's table; the outputs 9 to 14 carry the six actuators, as one has to set it."""
    table: dict[str, tuple[float, int]] = {
        "MAV_SYS_ID": (1, INT32),
        "MAV_TYPE": (2, INT32),
        "SYS_AUTOSTART": (4001, INT32),
        "COM_PREARM_MODE": (0, INT32),
        "COM_OBC_LOSS_T": (5, REAL32),
        "COM_DISARM_LAND": (2, REAL32),
        "EKF2_GPS_DELAY": (110, REAL32),
        "SER_TEL2_BAUD": (921_600, INT32),
        "MIS_TAKEOFF_ALT": (2.5, REAL32),
        "RTL_RETURN_ALT": (30, REAL32),
        "MPC_XY_CRUISE": (5, REAL32),
        "MPC_Z_V_AUTO_UP": (2.5, REAL32),
        "MPC_LAND_SPEED": (0.5, REAL32),
    }
    for number in range(1, OUTPUT_COUNT + 1):
        table[f"PWM_MAIN_FUNC{number}"] = (_function(number), INT32)
        table[f"PWM_MAIN_MIN{number}"] = (1000, INT32)
        table[f"PWM_MAIN_MAX{number}"] = (2000, INT32)
        table[f"PWM_MAIN_DIS{number}"] = (900, INT32)
        table[f"PWM_MAIN_FAIL{number}"] = (-1, INT32)
    speeds = {
        "cruise": ("MPC_XY_CRUISE", 1.0),
        "climb": ("MPC_Z_V_AUTO_UP", 1.0),
        "land": ("MPC_LAND_SPEED", 1.0),
    }
    return Parameters(table, speeds=speeds, bytewise=True)


def _function(number: int) -> int:
    """Return the motors' functions of a quadrotor, the six actuators', or none."""
    if number <= 4:
        return 100 + number
    actuator = number - _FIRST_VALVE_OUTPUT
    return 301 + actuator if 0 <= actuator < 6 else 0
