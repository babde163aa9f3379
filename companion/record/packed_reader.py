"""Reads the numbers of a packed block: integers of seven bits a byte, floats by differences."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from companion.record.packing import ANCHORED, BITS, WORD

_PLENTY = 0x7F
_SIGN = 1 << 63
# A float has all decimal numbers of fifteen digits, each by a text of its own.
_EXACT_MAX = 10**15
_EXACT_DECIMALS_MAX = 22  # ten to the power of so much is a float without an error


class Reader:
    """Reads what a packer wrote, from its beginning."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def word(self) -> int:
        """Return four bytes as an integer."""
        (value,) = WORD.unpack_from(self._content, self._at)
        self._at += WORD.size
        return int(value)

    def take(self, count: int) -> bytes:
        """Return the next bytes; ValueError where there are fewer."""
        if count > len(self._content) - self._at:
            raise ValueError("a block is cut off")
        self._at += count
        return self._content[self._at - count : self._at]

    def integers(self, count: int) -> list[int]:
        """Return so many integers."""
        content, at = self._content, self._at
        if count > len(content) - at:
            raise ValueError("a block is cut off")
        found = list(content[at : at + count])
        if max(found, default=0) <= _PLENTY:
            self._at += count
            return found
        found = []
        for _ in range(count):
            value = content[at]
            at += 1
            if value > _PLENTY:
                value &= _PLENTY
                shift = 7
                while content[at] > _PLENTY:
                    value |= (content[at] & _PLENTY) << shift
                    shift += 7
                    at += 1
                value |= content[at] << shift
                at += 1
            found.append(value)
        self._at = at
        return found

    def values(self, count: int, width: int) -> list[int]:
        """Return integers whose differences have so many bytes each."""
        raw = self.take(count * width)
        if width > 8:  # from the very smallest to the very largest float
            rows = zip(*(raw[plane * count :][:count] for plane in range(width)), strict=True)
            return sums([int.from_bytes(bytes(row), "little") for row in rows])
        planes = np.zeros((count, 8), dtype=np.uint8)
        planes[:, :width] = np.frombuffer(raw, dtype=np.uint8).reshape(width, count).T
        return sums(planes.view("<u8").ravel().tolist())

    def floats(self, count: int) -> tuple[Sequence[str], Sequence[int]]:
        """Return new numbers as texts, or as distances from their anchors."""
        how, width = self.take(2)
        values = self.values(count, width)
        if how == ANCHORED:
            return (), values
        if how == BITS:
            return _from_bits(values), ()
        return _unscaled(values, how), ()


def sums(words: Sequence[int]) -> list[int]:
    """Return what `packing.differences` was given."""
    return list(accumulate([word >> 1 if not word & 1 else -((word + 1) >> 1) for word in words]))


def signed(word: int) -> int:
    """Return an integer whose sign is in the lowest bit."""
    return word >> 1 if not word & 1 else -((word + 1) >> 1)


def _unscaled(values: Sequence[int], decimals: int) -> list[str]:
    scale = 10.0**decimals
    if -_EXACT_MAX < min(values) <= max(values) < _EXACT_MAX and decimals <= _EXACT_DECIMALS_MAX:
        return [repr(value / scale) for value in values]
    found = []
    for value in values:
        digits = str(abs(value)).rjust(decimals + 1, "0")
        cut = len(digits) - decimals
        part = digits[cut:].rstrip("0") or "0"
        found.append(f"{'-' if value < 0 else ''}{digits[:cut]}.{part}")
    return found


def _from_bits(words: Sequence[int]) -> list[str]:
    raw = [word if word >= 0 else (-word - 1) | _SIGN for word in words]
    packed = struct.pack(f"<{len(raw)}Q", *raw)
    return [repr(value) for value in struct.unpack(f"<{len(raw)}d", packed)]
