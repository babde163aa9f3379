"""The newest values of a running companion in shared memory: written without waiting, never full.

The writer overwrites the oldest slot; a reader that falls behind loses the oldest values and
nothing else. Each slot has its number and a checksum, so that a reader that is overtaken while it
reads notices it: there is no lock that anybody could hold.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Iterator

SLOTS = 256
SLOT_BYTES = 8192
_COUNT = struct.Struct("<Q")
_HEAD = struct.Struct("<QII")  # number, length, CRC-32
_BEGIN = 64
PAYLOAD_MAX = SLOT_BYTES - _HEAD.size
SIZE = _BEGIN + SLOTS * SLOT_BYTES


def new_memory() -> int:
    """Return a descriptor of anonymous memory for a ring; whoever inherits it may map it."""
    descriptor = os.memfd_create("vrspray-page", os.MFD_CLOEXEC)
    os.ftruncate(descriptor, SIZE)
    return descriptor


class RingWriter:
    """Puts values into a ring; a call copies some bytes and does nothing else."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, SIZE)
        (self._count,) = _COUNT.unpack_from(self._map, 0)

    def put(self, payload: bytes) -> bool:
        """Add a value; False where it is too large for a slot."""
        if len(payload) > PAYLOAD_MAX:
            return False
        number = self._count + 1
        at = _BEGIN + (number % SLOTS) * SLOT_BYTES
        _HEAD.pack_into(self._map, at, 0, 0, 0)  # a reader of the old value sees that it goes
        begin = at + _HEAD.size
        self._map[begin : begin + len(payload)] = payload
        _HEAD.pack_into(self._map, at, number, len(payload), zlib.crc32(payload))
        self._count = number
        _COUNT.pack_into(self._map, 0, number)
        return True

    def close(self) -> None:
        """Let go of the memory."""
        self._map.close()


class RingReader:
    """Takes values out of a ring that another process writes; begins with the newest."""

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, SIZE, access=mmap.ACCESS_READ)
        self._read = max(self._written() - 1, 0)

    def _written(self) -> int:
        (count,) = _COUNT.unpack_from(self._map, 0)
        return int(count)

    def news(self) -> Iterator[bytes]:
        """Yield what was written since the last call, oldest first; without what is overwritten."""
        count = self._written()
        # The slot that is overwritten next is not worth a race.
        for number in range(max(self._read + 1, count - SLOTS + 2), count + 1):
            payload = self._at(number)
            if payload is not None:
                yield payload
        self._read = max(count, self._read)

    def _at(self, number: int) -> bytes | None:
        at = _BEGIN + (number % SLOTS) * SLOT_BYTES
        found, length, checksum = _HEAD.unpack_from(self._map, at)
        if found != number or length > PAYLOAD_MAX:
            return None
        begin = at + _HEAD.size
        payload = bytes(self._map[begin : begin + length])
        return payload if zlib.crc32(payload) == checksum else None
