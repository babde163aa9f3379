"""The way from the vehicle to the companion: written down, and spoilt where a fault wants it."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from sitl.stub.protocol import dialect

HEARTBEAT, POSITION, LANDED, COMMAND = 0, 33, 245, 76
_HEAD = 10
_POSITION_SIZE, _POSITION_CRC = 28, 104
Send = Callable[[bytes], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sent:
    """A frame that left for the companion, and the fields that the judge looks at.

    `made_s` is when the vehicle made it; `fields` are those of the message, in order.
    """

    at_s: float
    made_s: float
    message: int
    fields: tuple[float, ...]


def _payload(frame: bytes, size: int) -> bytes:
    return frame[_HEAD : _HEAD + frame[1]].ljust(size, b"\0")


def fields_of(frame: bytes) -> tuple[int, tuple[float, ...]]:
    """Return the number of a message, and what the judge wants of it."""
    number = int.from_bytes(frame[7:10], "little")
    if number == HEARTBEAT:
        mode, _, _, base = struct.unpack("<IBBB", _payload(frame, 9)[:7])
        return number, (float(base & 128 != 0), float(mode))
    if number == POSITION:
        boot, lat, lon, _, _, north, east = struct.unpack("<Iiiiihh", _payload(frame, 28)[:24])
        return number, (boot / 1e3, lat / 1e7, lon / 1e7, north / 100.0, east / 100.0)
    if number == LANDED:
        return number, (float(_payload(frame, 2)[1]),)
    if number == COMMAND:
        first, command = struct.unpack("<f24xH", _payload(frame, 33)[:30])
        return number, (float(command), first)
    return number, ()


def moved(frame: bytes, place: tuple[int, int]) -> bytes:
    """Return a frame of a position with another latitude and longitude (1e-7 degrees)."""
    payload = _payload(frame, _POSITION_SIZE)
    payload = payload[:4] + struct.pack("<ii", *place) + payload[12:]
    head = bytes((frame[0], _POSITION_SIZE)) + frame[2:_HEAD]
    crc = dialect.x25crc(head[1:] + payload)
    crc.accumulate(bytes((_POSITION_CRC,)))
    return head + payload + int(crc.crc).to_bytes(2, "little")


def place_of(frame: bytes) -> tuple[int, int]:
    """Return latitude and longitude of a position's frame, in 1e-7 degrees."""
    latitude, longitude = struct.unpack("<4xii", _payload(frame, _POSITION_SIZE)[:12])
    return latitude, longitude


@dataclass(slots=True)
class Wire:
    """Sits between the stub and its sockets.

    `dropped` are messages that do not arrive (None: nothing does, either way), `late_s` is how
    late positions are, `place` gives the place that is told instead of a true one.
    """

    sent: list[Sent] = field(default_factory=list)
    kinds: set[int] = field(default_factory=set)
    dropped: frozenset[int] | None = frozenset()
    late_s: float = 0.0
    place: Callable[[tuple[int, int]], tuple[int, int]] | None = None

    @property
    def is_cut(self) -> bool:
        """Return whether nothing comes through."""
        return self.dropped is None

    def towards_companion(self, send: Send) -> Send:
        """Return what the stub is to send through instead of `send`."""

        def passed(frame: bytes) -> None:
            made_s = time.monotonic()
            number = int.from_bytes(frame[7:10], "little")
            if self.dropped is None or number in self.dropped:
                return
            if number == POSITION and self.place is not None:
                frame = moved(frame, self.place(place_of(frame)))
            if number == POSITION and self.late_s > 0.0:
                loop = asyncio.get_running_loop()
                loop.call_later(self.late_s, self._deliver, send, frame, made_s)
            else:
                self._deliver(send, frame, made_s)

        return passed

    def _deliver(self, send: Send, frame: bytes, made_s: float) -> None:
        if self.dropped is None:
            return
        # Before the call: no time that the sending takes is in favour of the companion.
        at_s = time.monotonic()
        send(frame)
        number, found = fields_of(frame)
        self.kinds.add(number)
        if found:
            self.sent.append(Sent(at_s=at_s, made_s=made_s, message=number, fields=found))
