"""Bytes of any kind to whole MAVLink messages; loses nothing that stands behind a broken frame.

`MAVLink.parse_buffer` believes the length of whatever looks like a start, and throws away what it
covers when the checksum is wrong: a stray 0xFD costs up to 280 bytes of good messages. Here a
start that turns out not to be one costs a single byte.
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
        self.frame_count = 0
        self.bad_frame_count = 0
        self.refused_frame_count = 0
        self.dropped_byte_count = 0

    def push(self, data: bytes, received_s: float) -> list[Any]:
        """Return the messages that are complete with `data`; whatever it holds, never raises."""
        if self._buffer and not received_s - self._oldest_s <= STALE_S:
            self._drop(1)
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
        self.dropped_byte_count += count

    def _next_length(self) -> int | None:
        """Move to the next start of a frame and return its length; None where bytes are missing."""
        while self._buffer:
            start = _first_magic(self._buffer)
            self._drop(start)
            if not self._buffer:
                return None
            header = _HEADER[self._buffer[0]]
            if len(self._buffer) < header:
                return None
            if self._is_plausible():
                length = header + self._buffer[1] + _CHECKSUM
                if self._buffer[0] == _V2 and self._buffer[2] & _SIGNED:
                    length += _SIGNATURE
                return length if len(self._buffer) >= length else None
            self._drop(1)
        return None

    def _is_plausible(self) -> bool:
        """Whether the header is one of a message that we can check."""
        head = self._buffer
        if head[0] == _V1:
            return head[5] in mavlink.mavlink_map
        message_id = head[7] | head[8] << 8 | head[9] << 16
        return not head[2] & ~_SIGNED and message_id in mavlink.mavlink_map

    def _decode(self, frame: bytearray) -> Any | None:
        try:
            return self._mav.decode(frame)
        except mavlink.MAVError:
            return None


def _first_magic(buffer: bytearray) -> int:
    """Return the index of the first byte that starts a frame, or the length."""
    found = [index for magic in (_V1, _V2) if (index := buffer.find(magic)) >= 0]
    return min(found, default=len(buffer))
