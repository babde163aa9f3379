"""What each MAV_CMD does on ArduCopter, with its results."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sitl.stub import commands
from sitl.stub.commands import ACCEPTED, DENIED, FAILED
from sitl.stub.faults import FaultKind
from sitl.stub.firmware import CommandHandler, Params
from sitl.stub.mission_items import LAND, LOITER, RTL
from sitl.stub.outputs import ServoOutputs
from sitl.stub.protocol import Message, dialect

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel

# The main loop runs at 400 Hz; an interval below it is too fast to keep.
_INTERVAL_MIN_S = 0.0025


def _result(done: bool) -> int:
    return ACCEPTED if done else FAILED


def _arm(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return commands.arm(autopilot, params, now_s, refused=FAILED)


def _set_mode(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not (abs(params[0]) < 256 and int(params[0]) & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED):
        return DENIED
    if not 0.0 <= params[1] < 256.0:
        return FAILED
    return _result(autopilot.flight.set_mode(int(params[1]), now_s))


def _take_off(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return _result(autopilot.flight.take_off(params[6], now_s))


def _start_mission(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not (params[0] == 0.0 and params[1] == 0.0):
        return DENIED
    return _result(autopilot.flight.start_mission(now_s))


def _set_servo(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return _result(write_servo(autopilot, params[0], params[1], now_s))


def write_servo(autopilot: Autopilot, channel: float, pulse_us: float, now_s: float) -> bool:
    """Write to an output if its function is free; the text is all that a mission gets."""
    outputs = autopilot.outputs
    if not isinstance(outputs, ServoOutputs):
        return False
    if not (1.0 <= channel < outputs.count + 1 and abs(pulse_us) < 1e6):
        return False
    refused = autopilot.faults.active(FaultKind.SERVO_REFUSED, now_s)
    if refused or not outputs.is_free(int(channel)):
        autopilot.tell(f"ServoRelayEvent: Channel {int(channel)} is already in use")
        return False
    outputs.write(int(channel), pulse_us, now_s=now_s)
    return True


def _set_relay(_autopilot: Autopilot, _channel: Channel, _params: Params, _now_s: float) -> int:
    """Fail without a text: no RELAYx_FUNCTION is set."""
    return FAILED


def _sprayer(autopilot: Autopilot, _channel: Channel, _params: Params, _now_s: float) -> int:
    """Accept whatever the value, as ArduPilot does, if there is a sprayer at all."""
    return _result(autopilot.parameters["SPRAY_ENABLE"] == 1.0)


def _set_interval(autopilot: Autopilot, channel: Channel, params: Params, now_s: float) -> int:
    """Set a stream of the peer that asks; param3 must be exactly 0, so a NaN is refused."""
    if not (params[2] == 0.0 and 0.0 <= params[0] < 2**24 and abs(params[1]) < 1e10):
        return DENIED
    message_id = int(params[0])
    if message_id in autopilot.firmware.silent:
        return ACCEPTED
    if message_id not in autopilot.firmware.builders:
        return DENIED
    if params[1] <= 0.0:
        channel.ask(message_id, None, now_s=now_s)
        return ACCEPTED
    interval_s = max(round(params[1] / 1000.0), 1) / 1000.0
    if interval_s < _INTERVAL_MIN_S:
        autopilot.tell(f"rate of message {message_id} is too fast")
        return DENIED
    kinds_max = autopilot.firmware.interval_kinds_max
    channel.ask(message_id, interval_s, now_s=now_s, kinds_max=kinds_max)
    return ACCEPTED


COMMANDS: Mapping[int, CommandHandler] = {
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_TAKEOFF: _take_off,
    dialect.MAV_CMD_NAV_LAND: commands.to_mode(LAND, refused=FAILED),
    dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH: commands.to_mode(RTL, refused=FAILED),
    dialect.MAV_CMD_NAV_LOITER_UNLIM: commands.to_mode(LOITER, refused=FAILED),
    dialect.MAV_CMD_MISSION_START: _start_mission,
    dialect.MAV_CMD_DO_SET_MISSION_CURRENT: commands.set_current,
    dialect.MAV_CMD_DO_SET_SERVO: _set_servo,
    dialect.MAV_CMD_DO_SET_RELAY: _set_relay,
    dialect.MAV_CMD_DO_SPRAYER: _sprayer,
    dialect.MAV_CMD_DO_CHANGE_SPEED: commands.change_speed,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    dialect.MAV_CMD_GET_MESSAGE_INTERVAL: commands.get_interval,
    dialect.MAV_CMD_REQUEST_MESSAGE: commands.request(FAILED),
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: commands.request_fixed(
        dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    ),
    dialect.MAV_CMD_GET_HOME_POSITION: commands.request_fixed(dialect.MAVLINK_MSG_ID_HOME_POSITION),
    dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: commands.reboot,
}


def handle_set_mode(
    autopilot: Autopilot, _channel: Channel, message: Message, now_s: float
) -> None:
    """Change the mode by the older message, which has no acknowledgement of its own."""
    if message.base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        autopilot.flight.set_mode(message.custom_mode, now_s)


def handle_data_stream(
    autopilot: Autopilot, channel: Channel, message: Message, now_s: float
) -> None:
    """Switch a group of streams of the peer that asks."""
    rate_hz = message.req_message_rate if message.start_stop else 0
    switch_groups(autopilot, channel, message.req_stream_id, rate_hz, now_s)


def switch_groups(
    autopilot: Autopilot, channel: Channel, group: int, rate_hz: float, now_s: float
) -> None:
    """Set the rate of one group of streams, or of all of them (0)."""
    groups = autopilot.firmware.groups
    for number in list(groups) if group == 0 else [group]:
        for message_id in groups.get(number, ()):
            interval_s = max(1.0 / rate_hz, _INTERVAL_MIN_S) if rate_hz > 0 else None
            kinds_max = autopilot.firmware.interval_kinds_max
            channel.ask(message_id, interval_s, now_s=now_s, kinds_max=kinds_max)
