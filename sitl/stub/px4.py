"""PX4, as the rest of the stub asks for it; some of its rules depend on the version.

What each MAV_CMD does on PX4, with its results; there is no DO_SET_SERVO and no DO_SPRAYER.
Sources: Commander.cpp, mavlink_receiver.cpp (v1.14 to v1.16), and a PX4 1.16 SITL.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from sitl.stub import commands
from sitl.stub.ardupilot import MESSAGES
from sitl.stub.commands import ACCEPTED, DENIED, FAILED, REJECTED
from sitl.stub.faults import FaultKind
from sitl.stub.firmware import Builder, CommandHandler, Firmware, Params, Version
from sitl.stub.mission_items import AUTO, BRAKE, GUIDED, LAND, LOITER, RTL, refused_by_px4
from sitl.stub.outputs import ActuatorOutputs
from sitl.stub.parameters import INT32, OUTPUT_COUNT, REAL32, Parameters
from sitl.stub.protocol import Message, dialect
from sitl.stub.streams import COMMON, HEALTHY, LOST, estimated, version_word

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel

# Until this version nobody acknowledged DO_SET_ACTUATOR, and a NaN overwrote (PR #22711).
ACKNOWLEDGED_SINCE = (1, 14, 2)
DO_SET_ACTUATOR: int = dialect.MAV_CMD_DO_SET_ACTUATOR
_INTERVAL_MIN_S = 0.002
_UNASKABLE = frozenset({dialect.MAVLINK_MSG_ID_HEARTBEAT})


def _arm(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return commands.arm(autopilot, params, now_s, refused=REJECTED)


def _set_mode(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not all(0.0 <= value < 256.0 for value in params[:2]):
        return DENIED
    if not int(params[0]) & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return DENIED
    sub = int(params[2]) if 0.0 <= params[2] < 256.0 else 0
    return _change(autopilot, mode_of(int(params[1]), sub), now_s)


def _change(autopilot: Autopilot, mode: int | None, now_s: float) -> int:
    flight = autopilot.flight
    if mode is None:
        return REJECTED
    if mode == GUIDED:
        return _climb(autopilot, math.nan, now_s)
    done = flight.start_mission(now_s) if mode == AUTO else flight.set_mode(mode, now_s)
    return ACCEPTED if done else REJECTED


def _take_off(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return _climb(autopilot, params[6], now_s)


def _climb(autopilot: Autopilot, altitude_m: float, now_s: float) -> int:
    """Take off to an altitude above the sea, or to MIS_TAKEOFF_ALT above the ground."""
    height_m = altitude_m - autopilot.flight.home_altitude_m
    if math.isnan(altitude_m):
        height_m = autopilot.parameters["MIS_TAKEOFF_ALT"]
    before = autopilot.flight.mode
    if not autopilot.flight.set_mode(GUIDED, now_s):
        return REJECTED
    if autopilot.flight.take_off(height_m, now_s):
        return ACCEPTED
    autopilot.flight.set_mode(before, now_s)
    return REJECTED


def _start_mission(autopilot: Autopilot, _channel: Channel, _params: Params, now_s: float) -> int:
    return _change(autopilot, AUTO, now_s)


def _answer_actuators(
    autopilot: Autopilot, _channel: Channel, _params: Params, _now_s: float
) -> int | None:
    """Accept an order of all six actuators, whatever became of it, or never acknowledge it."""
    return ACCEPTED if autopilot.firmware.version >= ACKNOWLEDGED_SINCE else None


def set_actuators(autopilot: Autopilot, params: Params, now_s: float) -> None:
    """Hand the values on to the outputs; param7 is the index of the set."""
    if isinstance(autopilot.outputs, ActuatorOutputs):
        autopilot.outputs.order(params[:6], index=params[6], now_s=now_s)


def _set_interval(autopilot: Autopilot, channel: Channel, params: Params, now_s: float) -> int:
    """Set a stream of the peer that asks; 0 is the rate of the start, -1 none."""
    unused = (params[2], params[3], params[6])
    if not all(value == 0.0 or math.isnan(value) for value in unused):
        return FAILED
    if not (0.0 <= params[0] < 2**24 and abs(params[1]) < 1e10):
        return FAILED
    message_id, firmware = int(params[0]), autopilot.firmware
    if message_id in _UNASKABLE or message_id not in firmware.builders:
        return FAILED
    interval_s: float | None = max(params[1] * 1e-6, _INTERVAL_MIN_S)
    if params[1] < 0.0:
        interval_s = None
    elif params[1] == 0.0:
        rate_hz = firmware.default_rates_hz.get(message_id)
        interval_s = 1.0 / rate_hz if rate_hz else None
    channel.ask(message_id, interval_s, now_s=now_s)
    return ACCEPTED


COMMANDS: Mapping[int, CommandHandler] = {
    **commands.shared(refused=REJECTED, unknown=DENIED),
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_TAKEOFF: _take_off,
    dialect.MAV_CMD_MISSION_START: _start_mission,
    DO_SET_ACTUATOR: _answer_actuators,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
}

# The receiver answers these itself; the others go to the Commander through its queue.
AT_ONCE = frozenset(
    {
        dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
        dialect.MAV_CMD_GET_MESSAGE_INTERVAL,
        dialect.MAV_CMD_REQUEST_MESSAGE,
        dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES,
    }
)


def handle_set_mode(
    autopilot: Autopilot, _channel: Channel, message: Message, now_s: float
) -> None:
    """Change the mode by the older message, which has no acknowledgement of its own."""
    if message.base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        word = message.custom_mode
        _change(autopilot, mode_of(word >> 16 & 0xFF, word >> 24 & 0xFF), now_s)


# PX4's modes: a main and a sub mode in one word (px4_custom_mode.h), and who is who.
#
# The flight itself counts in ArduCopter's numbers; here they are translated.

_MANUAL, _ALTCTL, _POSCTL, _AUTO, _ACRO, _OFFBOARD, _STABILIZED = 1, 2, 3, 4, 5, 6, 7
_TAKE_OFF, _HOLD, _MISSION, _RETURN, _LAND = 2, 3, 4, 5, 6

# A take-off by command flies in the internal GUIDED.
_WORDS: dict[int, tuple[int, int]] = {
    LOITER: (_AUTO, _HOLD),
    AUTO: (_AUTO, _MISSION),
    RTL: (_AUTO, _RETURN),
    LAND: (_AUTO, _LAND),
    GUIDED: (_AUTO, _TAKE_OFF),
    BRAKE: (_AUTO, _HOLD),
    dialect.COPTER_MODE_POSHOLD: (_POSCTL, 0),
    dialect.COPTER_MODE_ALT_HOLD: (_ALTCTL, 0),
    dialect.COPTER_MODE_STABILIZE: (_STABILIZED, 0),
}
_MODES = {word: mode for mode, word in _WORDS.items() if mode != BRAKE}


def custom_mode(mode: int) -> int:
    """Return the word of HEARTBEAT for an internal mode.

    >>> hex(custom_mode(3))
    '0x4040000'
    """
    main, sub = _WORDS[mode]
    return main << 16 | sub << 24


def mode_of(main: int, sub: int) -> int | None:
    """Return the internal mode; AUTO without a sub mode is Hold, as in PX4."""
    if main == _AUTO and sub == 0:
        return LOITER
    return _MODES.get((main, sub if main == _AUTO else 0))


def base_mode(mode: int, *, armed: bool) -> int:
    """Return the flags of HEARTBEAT."""
    flags: int = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    main, _ = _WORDS[mode]
    flags |= dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
    if main == _AUTO:
        flags |= dialect.MAV_MODE_FLAG_AUTO_ENABLED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
    else:
        flags |= dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
    return flags | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)


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
        # What PX4's own simulation says of itself (measured, 1.16-alpha in SIH): the stub
        # announces in the same way that its sensors are simulated.
        "CAL_ACC0_ID": (1_310_988, INT32),
        "CAL_GYRO0_ID": (1_310_988, INT32),
        "SYS_HITL": (0, INT32),
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


# What PX4 sends beside what both firmwares do, and what it streams unasked.
#
# Rates are those of the mode ONBOARD in mavlink_main.cpp (v1.16), of what there is here.

# ekf2 says CONST_POS_MODE of a vehicle at rest.
CONST_POS_AT_REST_SINCE = (1, 16, 0)
DEFAULT_RATES_HZ: Mapping[int, float] = {
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE: 100.0,
    dialect.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
    dialect.MAVLINK_MSG_ID_VFR_HUD: 10.0,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: 10.0,
    dialect.MAVLINK_MSG_ID_RC_CHANNELS: 20.0,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: 10.0,
    dialect.MAVLINK_MSG_ID_WIND_COV: 10.0,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 5.0,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
}

# Streams that end while the estimator has no position (streams/GLOBAL_POSITION_INT.hpp).
_NEED_POSITION = frozenset({dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT})


def withholds(autopilot: Autopilot, message_id: int, now_s: float) -> bool:
    """Return whether a message is not sent now."""
    lost = autopilot.faults.active(FaultKind.STALE_POSITION, now_s) is not None
    return message_id in _NEED_POSITION and lost


def heartbeat(autopilot: Autopilot, _now_s: float) -> Message:
    """Return HEARTBEAT of a PX4 multicopter."""
    flight = autopilot.flight
    status = dialect.MAV_STATE_ACTIVE if flight.armed else dialect.MAV_STATE_STANDBY
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_QUADROTOR,
        dialect.MAV_AUTOPILOT_PX4,
        base_mode(flight.mode, armed=flight.armed),
        custom_mode(flight.mode),
        status,
        3,
    )


def estimator_status(autopilot: Autopilot, now_s: float) -> Message:
    """Return ESTIMATOR_STATUS."""
    lost = autopilot.estimator_lost(now_s)
    ratio = 1.5 if lost else 0.05
    accuracy_m = 25.0 if lost else 0.15
    at_rest = autopilot.firmware.version >= CONST_POS_AT_REST_SINCE and not autopilot.flight.in_air
    good = HEALTHY | (dialect.ESTIMATOR_CONST_POS_MODE if at_rest else 0)
    return dialect.MAVLink_estimator_status_message(
        autopilot.boot_ms(now_s) * 1000,
        LOST if lost else good,
        *(ratio, ratio, 0.05, 0.05, 0.0, 0.0),
        accuracy_m,
        0.3,
    )


def wind_cov(autopilot: Autopilot, now_s: float) -> Message:
    """Return WIND_COV: where it blows to."""
    east_m_s, north_m_s = estimated(autopilot.wind_towards_m_s, now_s)
    return dialect.MAVLink_wind_cov_message(
        autopilot.boot_ms(now_s) * 1000, north_m_s, east_m_s, 0.0, 0.3, 0.0, 60.0, 0.3, 0.0
    )


def autopilot_version(autopilot: Autopilot, _now_s: float) -> Message:
    """Return AUTOPILOT_VERSION, without file transfer."""
    capabilities = (
        dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | dialect.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
        | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    zeros = [0] * 8
    version = version_word(autopilot.firmware.version)
    return dialect.MAVLink_autopilot_version_message(
        capabilities, version, 0, 0, 0, zeros, zeros, zeros, 0, 0, 1
    )


# MISSION_CURRENT is not among them: it comes when it changes and every ten seconds, and asking for
# it fails (measured).
BUILDERS: Mapping[int, Builder] = {
    **COMMON,
    dialect.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: estimator_status,
    dialect.MAVLINK_MSG_ID_WIND_COV: wind_cov,
    dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
}
