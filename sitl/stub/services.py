"""TIMESYNC, PING, and the refusal of file transfer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sitl.stub.protocol import AUTOPILOT_SYSTEM, Message, dialect, sender

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot
    from sitl.stub.channel import Channel

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
