"""Bytes of any kind to whole MAVLink messages; loses nothing that stands behind a broken frame.

`MAVLink.parse_buffer` believes the length of whatever looks like a start, and throws away what it
covers when the checksum is wrong: a stray 0xFD costs up to 280 bytes of good messages. Here a
start that turns out not to be one costs a single byte, and holds nothing back: a sound frame that
stands behind it in what has arrived says at once that it was none.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

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
