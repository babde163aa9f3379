"""What each MAV_CMD does on PX4, with its results; there is no DO_SET_SERVO and no DO_SPRAYER.

Sources: Commander.cpp, mavlink_receiver.cpp (v1.14 to v1.16), and a PX4 1.16 SITL.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from sitl.stub import commands
from sitl.stub.commands import ACCEPTED, DENIED, FAILED, REJECTED
from sitl.stub.firmware import CommandHandler, Params
from sitl.stub.mission_items import AUTO, GUIDED, LAND, LOITER, RTL
from sitl.stub.outputs import ActuatorOutputs
from sitl.stub.protocol import Message, dialect

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel


from sitl.stub.mission_items import BRAKE

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
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_TAKEOFF: _take_off,
    dialect.MAV_CMD_NAV_LAND: commands.to_mode(LAND, refused=REJECTED),
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: commands.to_mode(RTL, refused=REJECTED),
    dialect.MAV_CMD_NAV_LOITER_UNLIM: commands.to_mode(LOITER, refused=REJECTED),
    dialect.MAV_CMD_MISSION_START: _start_mission,
    DO_SET_ACTUATOR: _answer_actuators,
    dialect.MAV_CMD_DO_CHANGE_SPEED: commands.change_speed,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: commands.get_interval,
    dialect.MAV_CMD_REQUEST_MESSAGE: commands.request(DENIED),
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: commands.request_fixed(
        dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    ),
    dialect.MAV_CMD_GET_HOME_POSITION: commands.request_fixed(dialect.MAVLINK_MSG_ID_HOME_POSITION),
    dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: commands.reboot,
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
