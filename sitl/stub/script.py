"""A script that runs in the flight controller, such as a watchdog of the valves in Lua.

The stub calls it as ArduPilot's scheduler would; what the script orders goes to the outputs past
every rule of DO_SET_SERVO, as `SRV_Channels:set_output_pwm_chan` does.
"""

from __future__ import annotations

from typing import Protocol

SCRIPT_PERIOD_S = 0.02

_MAVLINK2 = 0xFD
_PAYLOAD_SIZE = 264  # payload64[33] of mavlink_message_t
_TAIL_SIZE = 2 + 13  # checksum as received, signature


class Script(Protocol):
    """What a script has to offer; it gets `Autopilot.set_output` from whoever makes it."""

    def on_message(self, raw: bytes, now_s: float) -> None:
        """Take a frame in that arrived from a peer, as it was on the wire."""

    def update(self, now_s: float) -> None:
        """Do what is due; called every 20 ms."""


def as_message_struct(frame: bytes) -> bytes:
    """Return a frame as `mavlink_message_t`, which is what `mavlink:receive_chan` gives to Lua.

    checksum (2), start, length, two flags, sequence, system, component, id (3), payload filled
    with zeros, checksum, signature: counted from 1, the component is byte 9.
    """
    if frame[0] == _MAVLINK2:
        head, payload = frame[:10], frame[10 : 10 + frame[1]]
    else:
        head = bytes((frame[0], frame[1], 0, 0, *frame[2:6], 0, 0))
        payload = frame[6 : 6 + frame[1]]
    end = (10 if frame[0] == _MAVLINK2 else 6) + frame[1]
    checksum = frame[end : end + 2]
    return checksum + head + payload.ljust(_PAYLOAD_SIZE, b"\0") + checksum.ljust(_TAIL_SIZE, b"\0")
