"""TIMESYNC, PING, the parameter protocol, and the refusal of file transfer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.faults import FaultKind
from sitl.stub.mission_items import WARNING
from sitl.stub.protocol import AUTOPILOT_SYSTEM, Message, dialect, sender

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel

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
