"""What each MAV_CMD does, with ArduPilot's results; everything else is UNSUPPORTED."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from sitl.stub.faults import FaultKind
from sitl.stub.modes import LAND, LOITER, RTL
from sitl.stub.parameters import OUTPUT_COUNT, SPEED_MAX_M_S, SPEED_MIN_M_S
from sitl.stub.protocol import Message, dialect, sender
from sitl.stub.streams import BUILDERS, GROUPS, SILENT

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.channel import Channel

Params = tuple[float, ...]
Handler = Callable[["Autopilot", "Channel", Params, float], int]

_ACCEPTED: int = dialect.MAV_RESULT_ACCEPTED
_DENIED: int = dialect.MAV_RESULT_DENIED
_UNSUPPORTED: int = dialect.MAV_RESULT_UNSUPPORTED
_FAILED: int = dialect.MAV_RESULT_FAILED
_FORCE = 21196  # MAV_CMD_COMPONENT_ARM_DISARM param2: arm or disarm whatever the checks say

# The main loop runs at 400 Hz; an interval below it is too fast to keep.
_INTERVAL_MIN_S = 0.0025


def _result(done: bool) -> int:
    return _ACCEPTED if done else _FAILED


def _arm(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if params[0] == 1.0:
        return _result(autopilot.flight.arm(now_s))
    if params[0] == 0.0:
        return _result(autopilot.flight.disarm(now_s, force=params[1] == _FORCE))
    return _UNSUPPORTED


def _set_mode(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not (abs(params[0]) < 256 and int(params[0]) & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED):
        return _DENIED
    if not 0.0 <= params[1] < 256.0:
        return _FAILED
    return _result(autopilot.flight.set_mode(int(params[1]), now_s))


def _to_mode(mode: int) -> Handler:
    def handler(autopilot: Autopilot, _channel: Channel, _params: Params, now_s: float) -> int:
        return _result(autopilot.flight.set_mode(mode, now_s))

    return handler


def _take_off(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return _result(autopilot.flight.take_off(params[6], now_s))


def _start_mission(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not (params[0] == 0.0 and params[1] == 0.0):
        return _DENIED
    return _result(autopilot.flight.start_mission(now_s))


def _set_current(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not 0.0 <= params[0] < 65536.0:
        return _DENIED
    return _result(autopilot.flight.set_sequence(int(params[0]), now_s))


def _set_servo(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return _result(write_servo(autopilot, params[0], params[1], now_s))


def write_servo(autopilot: Autopilot, channel: float, pulse_us: float, now_s: float) -> bool:
    """Write to an output if its function is free; the text is all that a mission gets."""
    if not (1.0 <= channel < OUTPUT_COUNT + 1 and abs(pulse_us) < 1e6):
        return False
    refused = autopilot.faults.active(FaultKind.SERVO_REFUSED, now_s)
    if refused or not autopilot.outputs.is_free(int(channel)):
        autopilot.tell(f"ServoRelayEvent: Channel {int(channel)} is already in use")
        return False
    autopilot.outputs.write(int(channel), pulse_us, now_s=now_s)
    return True


def _sprayer(autopilot: Autopilot, _channel: Channel, _params: Params, _now_s: float) -> int:
    """Accept whatever the value, as ArduPilot does, if there is a sprayer at all."""
    return _result(autopilot.parameters["SPRAY_ENABLE"] == 1.0)


def _change_speed(autopilot: Autopilot, _channel: Channel, params: Params, _now_s: float) -> int:
    if not SPEED_MIN_M_S <= params[1] <= SPEED_MAX_M_S:
        return _FAILED
    autopilot.parameters.put("WPNAV_SPEED", params[1] * 100.0)
    return _ACCEPTED


def _set_interval(autopilot: Autopilot, channel: Channel, params: Params, now_s: float) -> int:
    """Set a stream of the peer that asks; param3 must be exactly 0, so a NaN is refused."""
    if not (params[2] == 0.0 and 0.0 <= params[0] < 2**24 and abs(params[1]) < 1e10):
        return _DENIED
    message_id = int(params[0])
    if message_id in SILENT:
        return _ACCEPTED
    if message_id not in BUILDERS:
        return _DENIED
    if params[1] <= 0.0:
        channel.ask(message_id, None, now_s=now_s)
        return _ACCEPTED
    interval_s = max(round(params[1] / 1000.0), 1) / 1000.0
    if interval_s < _INTERVAL_MIN_S:
        autopilot.tell(f"rate of message {message_id} is too fast")
        return _DENIED
    channel.ask(message_id, interval_s, now_s=now_s)
    return _ACCEPTED


def _get_interval(autopilot: Autopilot, channel: Channel, params: Params, _now_s: float) -> int:
    if not 0.0 <= params[0] < 2**16:
        return _FAILED
    message_id = int(params[0])
    stream = channel.streams.get(message_id)
    if message_id not in BUILDERS:
        interval_us = 0
    else:
        interval_us = -1 if stream is None else round(stream.interval_s * 1e6)
    autopilot.send(channel, dialect.MAVLink_message_interval_message(message_id, interval_us))
    return _ACCEPTED


def _request(autopilot: Autopilot, channel: Channel, params: Params, now_s: float) -> int:
    if not (0.0 <= params[0] < 2**24 and int(params[0]) in BUILDERS):
        return _FAILED
    autopilot.send(channel, autopilot.build(int(params[0]), now_s))
    return _ACCEPTED


def _request_fixed(message_id: int) -> Handler:
    def handler(autopilot: Autopilot, channel: Channel, _params: Params, now_s: float) -> int:
        autopilot.send(channel, autopilot.build(message_id, now_s))
        return _ACCEPTED

    return handler


def _reboot(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if autopilot.flight.armed or params[0] != 1.0:
        return _FAILED
    autopilot.reboot(now_s)
    return _ACCEPTED


HANDLERS: dict[int, Handler] = {
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_TAKEOFF: _take_off,
    dialect.MAV_CMD_NAV_LAND: _to_mode(LAND),
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: _to_mode(RTL),
    dialect.MAV_CMD_NAV_LOITER_UNLIM: _to_mode(LOITER),
    dialect.MAV_CMD_MISSION_START: _start_mission,
    dialect.MAV_CMD_DO_SET_MISSION_CURRENT: _set_current,
    dialect.MAV_CMD_DO_SET_SERVO: _set_servo,
    dialect.MAV_CMD_DO_SPRAYER: _sprayer,
    dialect.MAV_CMD_DO_CHANGE_SPEED: _change_speed,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    dialect.MAV_CMD_REQUEST_MESSAGE: _request,
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _request_fixed(
        dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    ),
    dialect.MAV_CMD_GET_HOME_POSITION: _request_fixed(dialect.MAVLINK_MSG_ID_HOME_POSITION),
    dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
}


def handle_long(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Carry out a COMMAND_LONG and acknowledge it."""
    last = (message.param5, message.param6, message.param7)
    _carry_out(autopilot, channel, message, now_s, last)


def handle_int(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Carry out a COMMAND_INT and acknowledge it; places stay whole numbers."""
    last = (float(message.x), float(message.y), message.z)
    _carry_out(autopilot, channel, message, now_s, last)


def _carry_out(
    autopilot: Autopilot,
    channel: Channel,
    message: Message,
    now_s: float,
    last: tuple[float, float, float],
) -> None:
    params = (message.param1, message.param2, message.param3, message.param4, *last)
    handler = HANDLERS.get(message.command)
    result = _UNSUPPORTED
    if handler is not None:
        result = handler(autopilot, channel, params, now_s)
    autopilot.acknowledge(channel, message.command, result, to=sender(message), now_s=now_s)


def handle_set_mode(
    autopilot: Autopilot, _channel: Channel, message: Message, now_s: float
) -> None:
    """Change the mode by the older message, which has no acknowledgement of its own."""
    if message.base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        autopilot.flight.set_mode(message.custom_mode, now_s)


def handle_data_stream(
    _autopilot: Autopilot, channel: Channel, message: Message, now_s: float
) -> None:
    """Switch a group of streams of the peer that asks."""
    rate_hz = message.req_message_rate if message.start_stop else 0
    groups = list(GROUPS) if message.req_stream_id == 0 else [message.req_stream_id]
    for group in groups:
        for message_id in GROUPS.get(group, ()):
            interval_s = max(1.0 / rate_hz, _INTERVAL_MIN_S) if rate_hz > 0 else None
            channel.ask(message_id, interval_s, now_s=now_s)
