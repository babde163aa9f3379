"""From a packed block back to its lines: the other half of `packing.py`."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import accumulate

import numpy as np

from companion.record.packing import (
    ANCHORED,
    BACK,
    BITS,
    FLOAT,
    HOLE,
    INT,
    NEW,
    SAME,
    WORD,
    Key,
    bits_of,
    keys_of,
)

# A damaged length must not take the reader's memory: a block is a second of a flight.
UNPACKED_MAX = 64_000_000


def unpack(packed: bytes, dictionary: bytes = b"") -> list[str]:
    """Return the lines that were packed; ValueError for what is no block."""
    return lines_of(inflated(packed, dictionary))


def inflated(packed: bytes, dictionary: bytes) -> bytes:
    """Return a block's content; ValueError for what is damaged."""
    worker = zlib.decompressobj(zdict=dictionary) if dictionary else zlib.decompressobj()
    try:
        content = worker.decompress(packed, UNPACKED_MAX)
    except zlib.error as error:
        raise ValueError(f"a block is damaged: {error}") from error
    if worker.unconsumed_tail or not worker.eof:
        raise ValueError("a block is cut off, or longer than a block can be")
    return content


def lines_of(content: bytes) -> list[str]:
    """Return the lines of a block's content; ValueError for what is none."""
    try:
        return list(_unpacked(_Reader(content)))
    except (IndexError, KeyError, StopIteration, RuntimeError, struct.error, UnicodeError) as error:
        raise ValueError(f"a block is damaged: {error!r}") from error
    except OverflowError as error:
        raise ValueError(f"a block is damaged: {error}") from error


class _Reader:
    """Reads what a packer wrote, from its beginning."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def word(self) -> int:
        (value,) = WORD.unpack_from(self._content, self._at)
        self._at += WORD.size
        return int(value)

    def take(self, count: int) -> bytes:
        if count > len(self._content) - self._at:
            raise ValueError("a block is cut off")
        self._at += count
        return self._content[self._at - count : self._at]

    def integers(self, count: int) -> list[int]:
        found, content, at = [], self._content, self._at
        if count > len(content) - at:
            raise ValueError("a block is cut off")
        for _ in range(count):
            value = content[at]
            at += 1
            if value > 0x7F:
                value &= 0x7F
                shift = 7
                while content[at] > 0x7F:
                    value |= (content[at] & 0x7F) << shift
                    shift += 7
                    at += 1
                value |= content[at] << shift
                at += 1
            found.append(value)
        self._at = at
        return found

    def values(self, count: int, width: int) -> list[int]:
        raw = self.take(count * width)
        if width > 8:  # from the very smallest to the very largest float
            rows = zip(*(raw[plane * count :][:count] for plane in range(width)), strict=True)
            return _sums([int.from_bytes(bytes(row), "little") for row in rows])
        planes = np.zeros((count, 8), dtype=np.uint8)
        planes[:, :width] = np.frombuffer(raw, dtype=np.uint8).reshape(width, count).T
        return _sums(planes.view("<u8").ravel().tolist())

    def floats(self, count: int) -> tuple[Sequence[str], Sequence[int]]:
        """Return new numbers as texts, or as distances from their anchors."""
        how, width = self.take(2)
        values = self.values(count, width)
        if how == ANCHORED:
            return (), values
        if how == BITS:
            return _from_bits(values), ()
        return [_unscaled(value, how) for value in values], ()


def _sums(words: Sequence[int]) -> list[int]:
    return list(accumulate(word >> 1 if not word & 1 else -((word + 1) >> 1) for word in words))


class _Texts:
    """The numbers of one column, to be given out in the order of the lines."""

    __slots__ = ("before", "codes", "fresh", "is_int", "words")

    def __init__(
        self,
        codes: Sequence[int],
        fresh: Sequence[str] = (),
        words: Sequence[int] = (),
        *,
        is_int: bool,
    ) -> None:
        self.codes = iter(codes)
        self.fresh = iter(fresh)
        self.words = iter(words) if words else None
        self.before = ""
        self.is_int = is_int


def _unpacked(reader: _Reader) -> Iterator[str]:
    count = reader.word()
    forms = reader.take(reader.word()).decode("ascii").split("\n")
    order = reader.integers(count)
    keys = [keys_of(form) for form in forms]
    codes: dict[Key, list[int]] = {}
    for key, how_many in _counts(order, keys).items():
        found = reader.integers(how_many)
        codes[key] = _sums(found) if key[0] == INT else found
    columns = {}
    for key, found in codes.items():
        news = found.count(NEW) if key[0] == FLOAT else 0
        fresh, words = reader.floats(news) if news else ((), ())
        columns[key] = _Texts(found, fresh, words, is_int=key[0] == INT)
    seen: list[str] = []
    pieces = [HOLE.split(form) for form in forms]
    holes = [[columns[key] for key in wanted] for wanted in keys]
    for form in order:
        parts = pieces[form].copy()
        parts[1::2] = _numbers(holes[form], seen)
        yield "".join(parts)


def _numbers(columns: Sequence[_Texts], seen: list[str]) -> list[str]:
    """Return the numbers of one line."""
    found = []
    anchor = ""
    for column in columns:
        code = next(column.codes)
        if column.is_int:
            found.append(str(code))
            continue
        if code == SAME:
            text = column.before
        elif code != NEW:
            text = column.before = seen[BACK - 1 - code]
        else:
            if column.words is None:
                text = next(column.fresh)
            else:
                (text,) = _from_bits([next(column.words) + bits_of([anchor])[0]])
            column.before = text
            seen.append(text)
        anchor = anchor or text
        found.append(text)
    return found


def _counts(order: Sequence[int], keys: Sequence[Sequence[Key]]) -> dict[Key, int]:
    """Return how many numbers each column has, the columns in the order of their first ones."""
    found: dict[Key, int] = {}
    for form, times in Counter(order).items():
        for key in keys[form]:
            found[key] = found.get(key, 0) + times
    return found


def _unscaled(value: int, decimals: int) -> str:
    digits = str(abs(value)).rjust(decimals + 1, "0")
    cut = len(digits) - decimals
    part = digits[cut:].rstrip("0") or "0"
    return f"{'-' if value < 0 else ''}{digits[:cut]}.{part}"


def _from_bits(words: Sequence[int]) -> list[str]:
    raw = [word if word >= 0 else (-word - 1) | 1 << 63 for word in words]
    packed = struct.pack(f"<{len(raw)}Q", *raw)
    return [repr(value) for value in struct.unpack(f"<{len(raw)}d", packed)]
