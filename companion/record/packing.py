"""Lines of JSON in few bytes, and back to the last character.

What takes the room in a journal are digits: a float of the estimator has seventeen, and none of
them can be foreseen. So each line is split into its form (the text with a hole for each number)
and its numbers. Forms repeat, and are kept once a block. A number is kept by what it stands for:
the place in its object (the third number of a `VehicleState`), whose numbers make one column.
Of a column is kept only what is new: the same as in the line before costs next to nothing, the
same as any number of the block (a time that stands in four places) a byte or so. What is new is
the difference to the one before, as an integer: of decimals where there are few, of the float's
own bits otherwise; bytes of equal weight lie together, so that deflate finds the zeros.

A number is taken out only if its text is the one that Python writes for it; so what comes back is
what went in, whatever it is. Text is ASCII without control characters, as `codec.encode` writes.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import accumulate

import numpy as np

_NUMBER = re.compile(r"(-?\d+(?:\.\d+)?(?:e[+-]\d+)?)")
_FLOAT, _INT = "\x01", "\x02"
_HOLE = re.compile(f"([{_FLOAT}{_INT}])")
_OBJECT = re.compile(r'\{"(\w+)":|\}')
_INT_DIGITS_MAX = 15
# Decimals of a number that is kept as an integer: a monotonic clock has nine.
_DECIMALS_MAX = 9
_SCALED_DIGITS_MAX = 18
_BITS = 255  # in the place of the count of decimals: kept by its bits
_SAME, _NEW, _BACK = 0, 1, 2
_LEVEL = 6
# A damaged length must not take the reader's memory: a block is a second of a flight.
UNPACKED_MAX = 64_000_000
_WORD = struct.Struct("<I")

Key = tuple[str, str, int]


def pack(lines: Sequence[str]) -> bytes:
    """Return the lines in few bytes.

    >>> unpack(pack(['{"A":[1.5,2]}', '{"A":[1.75,3]}']))
    ['{"A":[1.5,2]}', '{"A":[1.75,3]}']
    """
    packer = _Packer()
    for line in lines:
        packer.add(line)
    return zlib.compress(packer.content(), _LEVEL)


def unpack(packed: bytes) -> list[str]:
    """Return the lines that `pack` was given; ValueError for what it did not make."""
    worker = zlib.decompressobj()
    try:
        content = worker.decompress(packed, UNPACKED_MAX)
    except zlib.error as error:
        raise ValueError(f"a block is damaged: {error}") from error
    if worker.unconsumed_tail or not worker.eof:
        raise ValueError("a block is cut off, or longer than a block can be")
    try:
        return list(_unpacked(_Reader(content)))
    except (IndexError, KeyError, StopIteration, RuntimeError, struct.error, UnicodeError) as error:
        raise ValueError(f"a block is damaged: {error!r}") from error


class _Column:
    """The numbers of one place: a code for each, and those that are new."""

    __slots__ = ("before", "codes", "fresh")

    def __init__(self) -> None:
        self.before = ""
        self.codes: list[int] = []
        self.fresh: list[str] = []


class _Packer:
    def __init__(self) -> None:
        self._forms: dict[str, int] = {}
        self._order: list[int] = []
        self._columns: dict[Key, _Column] = {}
        self._seen: dict[str, int] = {}

    def add(self, line: str) -> None:
        parts = _NUMBER.split(line)
        form, numbers = _taken_apart(parts)
        self._order.append(self._forms.setdefault(form, len(self._forms)))
        for key, number in zip(keys_of(form), numbers, strict=True):
            column = self._columns.get(key)
            if column is None:
                column = self._columns[key] = _Column()
            if key[0] == _INT:
                column.fresh.append(number)
            elif number == column.before:
                column.codes.append(_SAME)
            else:
                self._take(column, number)

    def _take(self, column: _Column, number: str) -> None:
        column.before = number
        seen = self._seen
        place = seen.get(number)
        if place is None:
            seen[number] = len(seen)
            column.codes.append(_NEW)
            column.fresh.append(number)
        else:
            column.codes.append(_BACK + len(seen) - 1 - place)

    def content(self) -> bytes:
        forms = "\n".join(self._forms).encode("ascii")
        out = bytearray(_WORD.pack(len(self._order)) + _WORD.pack(len(forms)) + forms)
        _put_all(out, self._order)
        for key, column in self._columns.items():
            if key[0] == _INT:
                _put_all(out, _differences([int(number) for number in column.fresh]))
            else:
                _put_all(out, column.codes)
        for key, column in self._columns.items():
            if key[0] == _FLOAT and column.fresh:
                _put_floats(out, column.fresh)
        return bytes(out)


def _taken_apart(parts: list[str]) -> tuple[str, list[str]]:
    """Return the form and the numbers of a line that was split at what may be numbers."""
    numbers = []
    for place in range(1, len(parts), 2):
        text = parts[place]
        if "." in text or "e" in text:
            if repr(float(text)) != text:
                continue
            parts[place] = _FLOAT
        elif len(text) <= _INT_DIGITS_MAX and str(int(text)) == text:
            parts[place] = _INT
        else:
            continue
        numbers.append(text)
    return "".join(parts), numbers


@lru_cache(maxsize=4096)
def keys_of(form: str) -> tuple[Key, ...]:
    """Return for each hole of a form what its number is: kind, object, how manieth in it."""
    keys = []
    inside: list[list[object]] = [["", 0]]
    for part in _HOLE.split(form):
        if part in (_FLOAT, _INT):
            name, count = inside[-1]
            keys.append((part, str(name), int(str(count))))
            inside[-1][1] = int(str(count)) + 1
            continue
        for found in _OBJECT.finditer(part):
            if found[1] is not None:
                inside.append([found[1], 0])
            elif len(inside) > 1:
                inside.pop()
    return tuple(keys)


def _differences(values: Sequence[int]) -> list[int]:
    """Return each value's difference to the one before, the sign in the lowest bit."""
    found, before = [], 0
    for value in values:
        step = value - before
        before = value
        found.append(step << 1 if step >= 0 else (-step << 1) - 1)
    return found


def _put_all(out: bytearray, values: Sequence[int]) -> None:
    """Write integers from 0 on, seven bits a byte."""
    for value in values:
        while value > 0x7F:
            out.append(value & 0x7F | 0x80)
            value >>= 7
        out.append(value)


def _put_floats(out: bytearray, texts: Sequence[str]) -> None:
    """Write new floats: how, then the bytes of their differences, those of least weight first."""
    decimals = _decimals_of(texts)
    values = _bits(texts) if decimals == _BITS else [_scaled(text, decimals) for text in texts]
    words = _differences(values)
    width = (max(words).bit_length() + 7) // 8
    out += bytes((decimals, width))
    raw = b"".join(word.to_bytes(width, "little") for word in words)
    for plane in range(width):
        out += raw[plane::width]


def _decimals_of(texts: Sequence[str]) -> int:
    most = 0
    for text in texts:
        decimals = len(text) - text.find(".") - 1
        if decimals > _DECIMALS_MAX or "e" in text or text == "-0.0":
            return _BITS
        most = max(most, decimals)
    long = any(text.find(".") + most > _SCALED_DIGITS_MAX for text in texts)
    return _BITS if long else most


def _scaled(text: str, decimals: int) -> int:
    whole, _, part = text.partition(".")
    return int(whole + part.ljust(decimals, "0"))


def _unscaled(value: int, decimals: int) -> str:
    digits = str(abs(value)).rjust(decimals + 1, "0")
    cut = len(digits) - decimals
    part = digits[cut:].rstrip("0") or "0"
    return f"{'-' if value < 0 else ''}{digits[:cut]}.{part}"


def _bits(texts: Sequence[str]) -> list[int]:
    """Return the floats' bits, as integers in the order of the numbers."""
    packed = struct.pack(f"<{len(texts)}d", *map(float, texts))
    return [
        word if word >= 0 else -(word & 0x7FFF_FFFF_FFFF_FFFF) - 1
        for word in struct.unpack(f"<{len(texts)}q", packed)
    ]


def _from_bits(words: Sequence[int]) -> list[str]:
    raw = [word if word >= 0 else (-word - 1) | 1 << 63 for word in words]
    packed = struct.pack(f"<{len(raw)}Q", *raw)
    return [repr(value) for value in struct.unpack(f"<{len(raw)}d", packed)]


class _Reader:
    """Reads what a packer wrote, from its beginning."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._at = 0

    def word(self) -> int:
        (value,) = _WORD.unpack_from(self._content, self._at)
        self._at += _WORD.size
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

    def floats(self, count: int) -> list[str]:
        decimals, width = self.take(2)
        values = self.values(count, width)
        if decimals == _BITS:
            return _from_bits(values)
        return [_unscaled(value, decimals) for value in values]


def _sums(words: Sequence[int]) -> list[int]:
    return list(accumulate(word >> 1 if not word & 1 else -((word + 1) >> 1) for word in words))


class _Texts:
    """The numbers of one column, to be given out in the order of the lines."""

    __slots__ = ("before", "codes", "fresh", "is_int")

    def __init__(self, codes: Sequence[int], fresh: Sequence[str], *, is_int: bool) -> None:
        self.codes = iter(codes)
        self.fresh = iter(fresh)
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
        codes[key] = _sums(found) if key[0] == _INT else found
    columns = {}
    for key, found in codes.items():
        news = found.count(_NEW) if key[0] == _FLOAT else 0
        fresh = reader.floats(news) if news else []
        columns[key] = _Texts(found, fresh, is_int=key[0] == _INT)
    seen: list[str] = []
    pieces = [_HOLE.split(form) for form in forms]
    holes = [[columns[key] for key in wanted] for wanted in keys]
    for form in order:
        parts = pieces[form].copy()
        parts[1::2] = [_next_text(column, seen) for column in holes[form]]
        yield "".join(parts)


def _counts(order: Sequence[int], keys: Sequence[Sequence[Key]]) -> dict[Key, int]:
    """Return how many numbers each column has, the columns in the order of their first ones."""
    found: dict[Key, int] = {}
    for form, times in Counter(order).items():
        for key in keys[form]:
            found[key] = found.get(key, 0) + times
    return found


def _next_text(column: _Texts, seen: list[str]) -> str:
    code = next(column.codes)
    if column.is_int:
        return str(code)
    if code == _SAME:
        return column.before
    if code == _NEW:
        text = next(column.fresh)
        seen.append(text)
    else:
        text = seen[_BACK - 1 - code]
    column.before = text
    return text
