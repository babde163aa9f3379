"""How a command comes in and is answered, and what both firmwares do alike.

`ardupilot.py` and `px4.py` hold what each of them does; what is in neither table is UNSUPPORTED.
Here are also TIMESYNC, PING, the parameter protocol, and the refusal of file transfer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.faults import FaultKind
from sitl.stub.firmware import CommandHandler, Params
from sitl.stub.mission_items import WARNING
from sitl.stub.parameters import SPEED_MAX_M_S, SPEED_MIN_M_S
from sitl.stub.protocol import AUTOPILOT_SYSTEM, Message, dialect, sender

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel

ACCEPTED: int = dialect.MAV_RESULT_ACCEPTED
REJECTED: int = dialect.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = dialect.MAV_RESULT_DENIED
UNSUPPORTED: int = dialect.MAV_RESULT_UNSUPPORTED
FAILED: int = dialect.MAV_RESULT_FAILED
_FORCE = 21196  # MAV_CMD_COMPONENT_ARM_DISARM param2: arm or disarm whatever the checks say


def arm(autopilot: Autopilot, params: Params, now_s: float, *, refused: int) -> int:
    """Arm or disarm; `refused` is how the firmware says no."""
    flight = autopilot.flight
    if params[0] == 1.0:
        return ACCEPTED if flight.arm(now_s) else refused
    if params[0] == 0.0:
        return ACCEPTED if flight.disarm(now_s, force=params[1] == _FORCE) else refused
    return UNSUPPORTED


def to_mode(mode: int, *, refused: int) -> CommandHandler:
    """Return a command that changes to one mode."""

    def handler(autopilot: Autopilot, _channel: Channel, _params: Params, now_s: float) -> int:
        return ACCEPTED if autopilot.flight.set_mode(mode, now_s) else refused

    return handler


def set_current(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    """Go on with another item of the mission."""
    if not 0.0 <= params[0] < 65536.0:
        return DENIED
    sequence = int(params[0]) + autopilot.firmware.first_item
    return ACCEPTED if autopilot.flight.set_sequence(sequence, now_s) else FAILED


def change_speed(autopilot: Autopilot, _channel: Channel, params: Params, _now_s: float) -> int:
    """Set the speed of the legs to come."""
    if not SPEED_MIN_M_S <= params[1] <= SPEED_MAX_M_S:
        return FAILED
    autopilot.parameters.put_speed("cruise", params[1])
    return ACCEPTED


def get_interval(autopilot: Autopilot, channel: Channel, params: Params, _now_s: float) -> int:
    """Tell how often a message comes."""
    if not 0.0 <= params[0] < 2**16:
        return FAILED
    message_id = int(params[0])
    stream = channel.streams.get(message_id)
    if message_id not in autopilot.firmware.builders:
        interval_us = 0
    else:
        interval_us = -1 if stream is None else round(stream.interval_s * 1e6)
    autopilot.send(channel, dialect.MAVLink_message_interval_message(message_id, interval_us))
    return ACCEPTED


def request(refused: int) -> CommandHandler:
    """Return MAV_CMD_REQUEST_MESSAGE; `refused` is the answer for what there is not."""

    def handler(autopilot: Autopilot, channel: Channel, params: Params, now_s: float) -> int:
        if not 0.0 <= params[0] < 2**24 or not autopilot.has(int(params[0]), now_s):
            return refused
        autopilot.send(channel, autopilot.build(int(params[0]), now_s))
        return ACCEPTED

    return handler


def request_fixed(message_id: int) -> CommandHandler:
    """Return a command that asks for one certain message."""

    def handler(autopilot: Autopilot, channel: Channel, _params: Params, now_s: float) -> int:
        autopilot.send(channel, autopilot.build(message_id, now_s))
        return ACCEPTED

    return handler


def reboot(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    """Restart, on the ground only."""
    if autopilot.flight.armed or params[0] != 1.0:
        return FAILED
    autopilot.reboot(now_s)
    return ACCEPTED


def handle_long(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Carry out a COMMAND_LONG and acknowledge it."""
    last = (message.param5, message.param6, message.param7)
    _take(autopilot, channel, message, now_s, last)


def handle_int(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Carry out a COMMAND_INT and acknowledge it; PX4 takes x and y for degrees of 1e-7."""
    scale = autopilot.firmware.int_scale
    last = (message.x * scale, message.y * scale, message.z)
    _take(autopilot, channel, message, now_s, last)


def _take(
    autopilot: Autopilot,
    channel: Channel,
    message: Message,
    now_s: float,
    last: tuple[float, float, float],
) -> None:
    """Carry a command out, now or when the firmware's queue comes to it."""
    command, peer = int(message.command), sender(message)
    params = (message.param1, message.param2, message.param3, message.param4, *last)
    if autopilot.strikes(FaultKind.COMMAND_BLOCKED, now_s, command=command):
        return

    def carry_out(at_s: float) -> None:
        handler = autopilot.firmware.commands.get(command)
        result: int | None = UNSUPPORTED
        if handler is not None:
            result = handler(autopilot, channel, params, at_s)
        if result is not None:
            autopilot.acknowledge(channel, command, result, to=peer, now_s=at_s)

    queue = autopilot.queue
    if queue is None or command in autopilot.firmware.commands_at_once:
        carry_out(now_s)
    elif not queue.put(carry_out, now_s):
        autopilot.says(f"vehicle_command lost: {command}")
    elif command in autopilot.firmware.mixed_at_once:
        autopilot.firmware.mixed_at_once[command](autopilot, params, now_s)


# A link carries so many PARAM_VALUE in one go; the rest of a list follows.
LIST_BURST = 10
LIST_EVERY_S = 0.02
# MAVLink FTP: operation NAK, error "fail"; the payload of FILE_TRANSFER_PROTOCOL is 251 bytes.
_NAK = 129
_FAIL = 1
_PAYLOAD_SIZE = 251


def handle_timesync(autopilot: Autopilot, channel: Channel, message: Message, now_s: float) -> None:
    """Answer a request with the time since boot; answers to ours need nothing."""
    if message.tc1 == 0:
        reply = dialect.MAVLink_timesync_message(autopilot.boot_ns(now_s), message.ts1)
        autopilot.send(channel, reply)


def timesync_request(autopilot: Autopilot, now_s: float) -> Message:
    """Return a request of the autopilot; ArduPilot adds its system id to its own time."""
    added = AUTOPILOT_SYSTEM if autopilot.firmware.system_in_timesync else 0
    return dialect.MAVLink_timesync_message(0, autopilot.boot_ns(now_s) + added)


def handle_ping(autopilot: Autopilot, channel: Channel, message: Message, _now_s: float) -> None:
    """Answer a PING to everybody with its own time and number."""
    if message.target_system == 0 and message.target_component == 0:
        peer = sender(message)
        reply = dialect.MAVLink_ping_message(message.time_usec, message.seq, peer[0], peer[1])
        autopilot.send(channel, reply)


def handle_file_transfer(
    autopilot: Autopilot, channel: Channel, message: Message, now_s: float
) -> None:
    """Refuse: there are no files here, and a client then goes on without."""
    channel.busy_until_s = now_s + 1.0
    asked = bytes(message.payload)
    sequence = (int.from_bytes(asked[0:2], "little") + 1) & 0xFFFF
    answer = bytearray(_PAYLOAD_SIZE)
    answer[0:2] = sequence.to_bytes(2, "little")
    answer[2], answer[3], answer[4], answer[5], answer[12] = asked[2], _NAK, 1, asked[3], _FAIL
    peer = sender(message)
    reply = dialect.MAVLink_file_transfer_protocol_message(0, peer[0], peer[1], list(answer))
    autopilot.send(channel, reply)


def handle_parameter_list(
    autopilot: Autopilot, channel: Channel, _message: Message, now_s: float
) -> None:
    """Begin to send the whole table; the other streams of that peer are slowed meanwhile."""
    channel.busy_until_s = now_s + 1.0
    channel.parameters_left = list(range(len(autopilot.parameters)))
    send_parameters(autopilot, channel, now_s)


def send_parameters(autopilot: Autopilot, channel: Channel, now_s: float) -> None:
    """Send what the link takes of a list in one go."""
    left = channel.parameters_left
    if not left or now_s < channel.parameters_due_s:
        return
    channel.busy_until_s = now_s + 1.0
    channel.parameters_due_s = now_s + LIST_EVERY_S
    for index in left[:LIST_BURST]:
        name = autopilot.parameters.name_at(index)
        if name is not None:
            _send_parameter(autopilot, channel, name, now_s)
    del left[:LIST_BURST]


def _send_parameter(autopilot: Autopilot, channel: Channel, name: str, now_s: float) -> None:
    if autopilot.strikes(FaultKind.PARAM_LOST, now_s) is None:
        autopilot.send(channel, autopilot.parameters.message(name))


def handle_parameter_read(
    autopilot: Autopilot, channel: Channel, message: Message, now_s: float
) -> None:
    """Send one parameter by index or name; an unknown one gets no answer."""
    name: str | None = message.param_id
    if message.param_index >= 0:
        name = autopilot.parameters.name_at(message.param_index)
    if name is not None and name in autopilot.parameters:
        _send_parameter(autopilot, channel, name, now_s)


def handle_parameter_set(
    autopilot: Autopilot, _channel: Channel, message: Message, now_s: float
) -> None:
    """Set one parameter and tell everybody its new value."""
    name = message.param_id
    if name not in autopilot.parameters:
        return
    if autopilot.strikes(FaultKind.PARAM_LOST, now_s) is not None:
        return
    value = autopilot.parameters.decoded(name, message)
    if value is None:
        if autopilot.parameters.bytewise:
            autopilot.tell(f"param types mismatch param: {name}", severity=WARNING)
        return
    autopilot.parameters.put(name, value)
    for channel in autopilot.channels:
        _send_parameter(autopilot, channel, name, now_s)
