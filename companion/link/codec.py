"""Bytes to our types, from whom they count; nothing here does any I/O."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.link.census import AUTOPILOT_COMPONENT, Census, Vehicle
from companion.link.decode import FROM_ANYONE, FROM_VEHICLE
from companion.link.messages import CommandReceived, Message
from companion.link.signing import RADIO_STATUS

__all__ = ["AUTOPILOT_COMPONENT", "Codec", "Vehicle"]


_HEARTBEAT = 0
_SENDERS_MAX = 64
# So many frames in a row that seem overtaken, and their sender has begun to count anew.
_ANEW = 32


class _Sequence:
    """Counts the frames of one sender, and those that its numbers say are missing."""

    __slots__ = ("_behind", "_counts", "count", "last", "lost")

    def __init__(self) -> None:
        self.count, self.lost, self.last = 0, 0, -1
        self._behind, self._counts = 0, False

    def take(self, number: int) -> bool:
        """Count a frame; return whether it was overtaken or sent twice: half the circle ahead.

        A sender whose numbers never move (a script) sends nothing late.
        """
        self.count += 1
        ahead = 0 if self.last < 0 else (number - self.last - 1) % 256
        self._counts = self._counts or (self.last >= 0 and number != self.last)
        is_late = ahead >= 128 and self._counts
        self._behind = self._behind + 1 if is_late else 0
        if is_late and self._behind < _ANEW:
            return True
        self.lost += ahead if ahead < 128 else 0
        self.last = number
        return is_late


class Codec:
    """Decodes a byte stream; remembers the first autopilot it hears and believes no other.

    `system_id` 0 takes the first autopilot; another number waits for that one.
    """

    def __init__(self, *, system_id: int = 0, accept: Accept | None = None) -> None:
        self.census = Census(system_id)
        self._framer = Framer(accept)
        self._senders: dict[tuple[int, int], _Sequence] = {}
        self.vehicle_counts: dict[int, int] = {}
        self.ignored_count = 0
        # Frames that show who speaks from an address; a radio's report is signed by nobody.
        self.named_frame_count = 0
        self.vehicle_frame_count = 0
        self.byte_count = 0

    @property
    def vehicle(self) -> Vehicle | None:
        """Return the autopilot that the link belongs to; None before it was heard."""
        return self.census.vehicle

    @property
    def frame_count(self) -> int:
        """Return how many valid frames came in, from whomever."""
        return self._framer.frame_count

    @property
    def dropped_byte_count(self) -> int:
        """Return how many bytes belonged to no valid frame."""
        return self._framer.dropped_byte_count

    @property
    def bad_frame_count(self) -> int:
        """Return how many frames had a wrong checksum; a false start in noise counts as one."""
        return self._framer.bad_frame_count

    @property
    def refused_frame_count(self) -> int:
        """Return how many sound frames had no good signature."""
        return self._framer.refused_frame_count

    @property
    def lost_frames(self) -> dict[tuple[int, int], tuple[int, int]]:
        """Return frames that came and frames that are missing, by (system, component).

        Gaps are normal behind a router that does not pass everything on.
        """
        return {sender: (one.count, one.lost) for sender, one in self._senders.items()}

    def is_autopilot(self, system_id: int, component_id: int) -> bool:
        """Whether a sender is the vehicle's autopilot, the only one who speaks for the vehicle.

        A camera or a gimbal of the same system may say what it likes.
        """
        vehicle = self.vehicle
        return vehicle is not None and (system_id, component_id) == (
            vehicle.system_id,
            AUTOPILOT_COMPONENT,
        )

    def decode(self, data: bytes, received_s: float) -> list[Message]:
        """Return what `data` completes, in its order; never raises."""
        self.byte_count += len(data)
        messages = []
        for raw in self._framer.push(data, received_s):
            message = self._understand(raw, received_s)
            if message is not None:
                messages.append(message)
        return messages

    def _understand(self, raw: Any, received_s: float) -> Message | None:
        sender = (raw.get_srcSystem(), raw.get_srcComponent())
        is_late = self._count(sender, raw.get_seq())
        message_id: int = raw.get_msgId()
        if message_id == _HEARTBEAT:
            self.census.heartbeat(*sender, kind=raw.type, autopilot=raw.autopilot, now_s=received_s)
        if message_id != RADIO_STATUS:
            self.named_frame_count += 1
            if self.vehicle is not None and sender[0] == self.vehicle.system_id:
                self.vehicle_frame_count += 1
        if message_id in FROM_ANYONE:
            message = FROM_ANYONE[message_id](raw, received_s)
            if is_late and isinstance(message, CommandReceived):
                return replace(message, is_late=True)
            return message
        if not self.is_autopilot(*sender):
            self.ignored_count += 1
            return None
        self.vehicle_counts[message_id] = self.vehicle_counts.get(message_id, 0) + 1
        decoder = FROM_VEHICLE.get(message_id)
        return None if decoder is None else decoder(raw, received_s)

    def _count(self, sender: tuple[int, int], number: int) -> bool:
        """Count a frame of a sender; return whether it comes late."""
        one = self._senders.get(sender)
        if one is None:
            if len(self._senders) >= _SENDERS_MAX:
                return False
            one = self._senders[sender] = _Sequence()
        return one.take(number)


# Bytes of any kind to whole MAVLink messages; loses nothing that stands behind a broken frame.
#
# `MAVLink.parse_buffer` believes the length of whatever looks like a start, and throws away what it
# covers when the checksum is wrong: a stray 0xFD costs up to 280 bytes of good messages. Here a
# start that turns out not to be one costs a single byte, and holds nothing back: a sound frame that
# stands behind it in what has arrived says at once that it was none.

_V1, _V2 = 0xFE, 0xFD
_HEADER = {_V1: 6, _V2: 10}
_CHECKSUM = 2
_SIGNATURE = 13
_SIGNED = 0x01
# A frame on the slowest usable wire (57600 baud) is through in 49 ms; a start that is still
# incomplete after this was none, and must not hold back what follows.
STALE_S = 0.25


Accept = Callable[[bytes, int], bool]


class Framer:
    """Finds MAVLink 1 and 2 frames in a stream; memory is bounded by one frame and one chunk.

    `accept`, if given, is asked of every sound frame (its bytes, its message's number) whether it
    may be believed: the check of its signature.
    """

    def __init__(self, accept: Accept | None = None) -> None:
        self._accept = accept
        self._mav = mavlink.MAVLink(None)
        self._buffer = bytearray()
        self._oldest_s = 0.0
        self._joint = 0  # where in the buffer the last chunk begins
        self.frame_count = 0
        self.bad_frame_count = 0
        self.refused_frame_count = 0
        self.dropped_byte_count = 0

    def push(self, data: bytes, received_s: float) -> list[Any]:
        """Return the messages that are complete with `data`; whatever it holds, never raises."""
        if self._buffer and not received_s - self._oldest_s <= STALE_S:
            self._drop(1)
        self._joint = len(self._buffer)
        self._buffer += data
        messages = []
        while (length := self._next_length()) is not None:
            frame = self._buffer[:length]
            message = self._decode(frame)
            if message is None:
                self.bad_frame_count += 1
                self._drop(1)
                continue
            if self._accept is None or self._accept(bytes(frame), message.get_msgId()):
                messages.append(message)
            else:
                self.refused_frame_count += 1
            del self._buffer[:length]
        self.frame_count += len(messages)
        if messages or not len(self._buffer) > len(data):
            self._oldest_s = received_s
        return messages

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._joint -= count
        self.dropped_byte_count += count

    def _next_length(self) -> int | None:
        """Move to the next start of a frame and return its length; None where bytes are missing."""
        while self._buffer:
            self._drop(_next_magic(self._buffer, 0))
            if not self._buffer:
                return None
            length = _length(self._buffer)
            if length is not None and len(self._buffer) >= length:
                return length
            if length is not None and not self._is_overtaken():
                return None
            self._drop(1)
        return None

    def _is_overtaken(self) -> bool:
        """Whether a sound frame stands behind a start that still misses bytes: it was none.

        Only one that begins where something new arrived, or ends where that ends, counts. What a
        long frame carries (a file with frames in it) fits there by chance alone.
        """
        held = self._buffer
        at = _next_magic(held, 1)
        while at < len(held):
            length = _length(held[at:])
            end = len(held) + 1 if length is None else at + length
            is_at_edge = at == self._joint or end == len(held)
            if is_at_edge and end <= len(held) and self._decode(held[at:end]) is not None:
                return True
            at = _next_magic(held, at + 1)
        return False

    def _decode(self, frame: bytearray) -> Any | None:
        try:
            return self._mav.decode(frame)
        except mavlink.MAVError:
            return None


def _next_magic(buffer: bytearray, at: int) -> int:
    """Return the index of the next byte from `at` on that starts a frame, or the length."""
    found = [index for magic in (_V1, _V2) if (index := buffer.find(magic, at)) >= 0]
    return min(found, default=len(buffer))


def _length(head: bytearray) -> int | None:
    """Return how long a frame claims to be; None for one of a message that we cannot check.

    Of a head that is not complete it is the least that a frame can have.
    """
    header = _HEADER[head[0]]
    if len(head) < header:
        return header + _CHECKSUM
    length = header + head[1] + _CHECKSUM
    if head[0] == _V1:
        return length if head[5] in mavlink.mavlink_map else None
    message_id = head[7] | head[8] << 8 | head[9] << 16
    if head[2] & ~_SIGNED or message_id not in mavlink.mavlink_map:
        return None
    return length + _SIGNATURE if head[2] & _SIGNED else length
