"""Inputs and decisions of a journal, back from packed blocks: the other half of `rows.py`."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from companion.journal.rows import (
    ANCHORED,
    BACK,
    BITS,
    DICTIONARY_BYTES,
    FLOAT,
    HOLE,
    NEW,
    ROWS_MAX,
    SAME,
    TEXT_MAX,
    WORD,
    Key,
    keys_of,
)

# A few bytes must not take the reader's memory or time. A block that is full has `TEXT_MAX` of text
# and one line more; packed, a number takes less room than its text.
_LINE_MAX = 1_000_000
UNPACKED_MAX = 2 * (TEXT_MAX + _LINE_MAX)
_BITS_MAX = 70  # of an integer: the largest has fifteen digits
_REAL = struct.Struct("<d")
_LONG = struct.Struct("<q")
SIGN = 1 << 63


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """What was packed: lines, the distances of their numbers, and all new numbers in their order.

    Of the new numbers the first `ends[i]` stand in the lines up to the i-th.
    """

    lines: list[str]
    gaps: list[int]
    seen: list[str]
    ends: list[int]

    def rows(self, first: int) -> list[tuple[int, str]]:
        """Return all lines with their numbers, in a block that begins with number `first`."""
        numbers = accumulate(self.gaps, initial=first - 1)
        next(numbers)
        return list(zip(numbers, self.lines, strict=True))


def unpack(packed: bytes, dictionary: bytes = b"") -> list[str]:
    """Return the lines that were packed; ValueError for what is no block.

    >>> from companion.journal.rows import pack
    >>> unpack(pack(['{"A":[1.5,2]}', '{"A":[1.75,3]}']))
    ['{"A":[1.5,2]}', '{"A":[1.75,3]}']
    """
    return part_of(inflated(packed, dictionary)).lines


def inflated(packed: bytes, dictionary: bytes, most: int = UNPACKED_MAX) -> bytes:
    """Return a block's content; ValueError for what is damaged."""
    worker = zlib.decompressobj(zdict=dictionary) if dictionary else zlib.decompressobj()
    try:
        content = worker.decompress(packed, most + 1)
    except zlib.error as error:
        raise ValueError(f"a block is damaged: {error}") from error
    if worker.unconsumed_tail or not worker.eof:
        raise ValueError("a block is cut off, or longer than a block can be")
    return content


def part_of(content: bytes, leader: Part | None = None) -> Part:
    """Return what is in a block's content, whose packer followed that of `leader`.

    ValueError for what is no content of a block.
    """
    try:
        return _part(Reader(content), leader)
    except (IndexError, KeyError, StopIteration, RuntimeError, struct.error, UnicodeError) as error:
        raise ValueError(f"a block is damaged: {error!r}") from error
    except OverflowError as error:
        raise ValueError(f"a block is damaged: {error}") from error


class _Column:
    """The numbers of one place, to be given out in the order of the lines.

    `code`, `fresh` and `word` each give the next one: looked up once, asked for each number.
    """

    __slots__ = ("before", "code", "fresh", "is_int", "word")

    def __init__(
        self, *, codes: Sequence[int] = (), fresh: Sequence[str] = (), is_int: bool
    ) -> None:
        self.code = iter(codes).__next__
        self.fresh = iter(fresh).__next__
        self.word: Callable[[], int] | None = None
        self.before = ""
        self.is_int = is_int


def pieces_of(form: str) -> tuple[str, ...]:
    """Return a form cut at its holes, and these between the pieces."""
    return tuple(HOLE.split(form))


def _part(reader: Reader, leader: Part | None) -> Part:
    count, forms = reader.head()
    gaps = [signed(gap) for gap in reader.integers(count)]
    leads, order = reader.integers(count), reader.integers(count)
    check_text(forms, order)
    columns = _columns(reader, order, [keys_of(form) for form in forms])
    pieces = [list(pieces_of(form)) for form in forms]
    holes = [[columns[key] for key in keys_of(form)] for form in forms]
    part = Part(lines=[], gaps=gaps, seen=[], ends=[])
    heard = told = 0
    for form, led in zip(order, leads, strict=True):
        if led:
            if leader is None:
                raise ValueError("a block is damaged: it refers to another")
            heard += led
            end = leader.ends[heard - 1]
            part.seen.extend(leader.seen[told:end])
            told = end
        parts = pieces[form]
        parts[1::2] = _numbers(holes[form], part.seen)
        part.lines.append("".join(parts))
        part.ends.append(len(part.seen))
    return part


def _columns(
    reader: Reader, order: Sequence[int], keys: Sequence[Sequence[Key]]
) -> dict[Key, _Column]:
    """Read the columns, in the order of their first numbers."""
    counts: dict[Key, int] = {}
    for form, times in Counter(order).items():
        for key in keys[form]:
            counts[key] = counts.get(key, 0) + times
    columns, news = {}, {}
    for key, how_many in counts.items():
        codes = reader.integers(how_many)
        if key[0] == FLOAT:
            columns[key], news[key] = _Column(codes=codes, is_int=False), codes.count(NEW)
        else:
            columns[key] = _Column(fresh=[str(value) for value in sums(codes)], is_int=True)
    for key, how_many in news.items():
        if how_many:
            fresh, words = reader.floats(how_many)
            columns[key].fresh = iter(fresh).__next__
            columns[key].word = iter(words).__next__ if words else None
    return columns


def _numbers(columns: Sequence[_Column], seen: list[str]) -> list[str]:
    """Return the numbers of one line."""
    found = []
    anchor = ""
    anchor_word: int | None = None
    for column in columns:
        if column.is_int:
            found.append(column.fresh())
            continue
        code = column.code()
        if code == SAME:
            text = column.before
        elif code != NEW:
            text = column.before = seen[BACK - 1 - code]
        else:
            if column.word is None:
                text = column.fresh()
            else:
                if anchor_word is None:
                    anchor_word = _word_of(anchor)
                text = _float_of(anchor_word + column.word())
            column.before = text
            seen.append(text)
        anchor = anchor or text
        found.append(text)
    return found


def _word_of(text: str) -> int:
    """Return a float's bits as an integer in the order of the numbers."""
    word: int = _LONG.unpack(_REAL.pack(float(text)))[0]
    return word if word >= 0 else -(word & SIGN - 1) - 1


def _float_of(word: int) -> str:
    (value,) = _REAL.unpack(_LONG.pack(word if word >= 0 else (-word - 1) - SIGN))
    return repr(value)


# Reads the numbers of a packed block: integers of seven bits a byte, floats by differences.

PLENTY = 0x7F
# A float has all decimal numbers of fifteen digits, each by a text of its own.
EXACT_MAX = 10**15
EXACT_DECIMALS_MAX = 22  # ten to the power of so much is a float without an error


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

    def head(self) -> tuple[int, list[str]]:
        """Return how many lines there are, and their forms."""
        count = self.word()
        if count > ROWS_MAX:
            raise ValueError(f"it says {count} rows, a block has {ROWS_MAX} at most")
        return count, self.take(self.word()).decode("ascii").split("\n")

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
        if max(found, default=0) <= PLENTY:
            self._at += count
            return found
        found = []
        for _ in range(count):
            value = content[at]
            at += 1
            if value > PLENTY:
                value &= PLENTY
                shift = 7
                while content[at] > PLENTY and shift < _BITS_MAX:
                    value |= (content[at] & PLENTY) << shift
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


def check_text(forms: Sequence[str], order: Iterable[int]) -> None:
    """Refuse lines that would be longer together than those of any block."""
    if sum(len(forms[form]) for form in order) > TEXT_MAX + _LINE_MAX:
        raise ValueError("its lines are longer than a block's")


def sums(words: Sequence[int]) -> list[int]:
    """Return what `rows.differences` was given."""
    return list(accumulate([word >> 1 if not word & 1 else -((word + 1) >> 1) for word in words]))


def signed(word: int) -> int:
    """Return an integer whose sign is in the lowest bit."""
    return word >> 1 if not word & 1 else -((word + 1) >> 1)


def _unscaled(values: Sequence[int], decimals: int) -> list[str]:
    scale = 10.0**decimals
    if -EXACT_MAX < min(values) <= max(values) < EXACT_MAX and decimals <= EXACT_DECIMALS_MAX:
        return [repr(value / scale) for value in values]
    found = []
    for value in values:
        digits = str(abs(value)).rjust(decimals + 1, "0")
        cut = len(digits) - decimals
        part = digits[cut:].rstrip("0") or "0"
        found.append(f"{'-' if value < 0 else ''}{digits[:cut]}.{part}")
    return found


def _from_bits(words: Sequence[int]) -> list[str]:
    raw = [word if word >= 0 else (-word - 1) | SIGN for word in words]
    packed = struct.pack(f"<{len(raw)}Q", *raw)
    return [repr(value) for value in struct.unpack(f"<{len(raw)}d", packed)]


_DECISION = "Decision"
SELECT = (
    "SELECT first_sequence, from_s, until_s, dictionary, crc32, body, {} FROM blocks "
    "ORDER BY first_sequence"
)


class Entry(NamedTuple):
    """One input or decision as it lies in the file; `kind` is the name of its type."""

    sequence: int
    kind: str
    body: str

    @property
    def is_decision(self) -> bool:
        """Whether this is a decision, and not an input."""
        return self.kind == _DECISION


def read_blocks(
    connection: sqlite3.Connection,
    *,
    kinds: Collection[str] | None = None,
    unread: list[str] | None = None,
) -> Iterator[Entry]:
    """Yield all entries in their order, or those of some kinds.

    What is damaged is a ValueError; with `unread` it is said there, and left out.
    """
    with_decisions = kinds is None or _DECISION in kinds
    starts = None if kinds is None else tuple(f'{{"{kind}":' for kind in kinds)
    dictionaries = Dictionaries(connection)
    sql = SELECT.format("decisions_crc32, decisions" if with_decisions else "NULL, NULL")
    for first, from_s, until_s, dictionary, *parts in connection.execute(sql):
        rows: list[tuple[int, str]] = []
        inputs: Part | None = None
        try:
            inputs = checked(parts[0], parts[1], dictionaries.get(dictionary), None)
            rows += inputs.rows(first)
            if with_decisions:
                decisions = checked(parts[2], parts[3], dictionaries.get(dictionary), inputs)
                rows += decisions.rows(first)
                rows.sort()
        except (ValueError, TypeError, OverflowError) as error:
            what = "rows" if inputs is None else "decisions"
            text = f"{what} from {first} on ({span_text(from_s, until_s)}): {error}"
            if unread is None:
                raise ValueError(text) from error
            unread.append(text)
        for sequence, line in rows:
            if starts is None or line.startswith(starts):
                yield Entry(sequence, line[2 : line.find('"', 2)], line)


def checked(crc: int, packed: bytes, dictionary: bytes, leader: Part | None) -> Part:
    """Return what is in a packed block; ValueError where its check sum does not fit."""
    part = part_of(inflated(packed, dictionary), leader)
    if zlib.crc32("".join(part.lines).encode("ascii")) != crc:
        raise ValueError("the check sum does not fit")
    return part


class Dictionaries:
    """The blocks' dictionaries by their numbers, each read once."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self._found: dict[int | None, bytes] = {None: b""}

    def get(self, number: int | None) -> bytes:
        """Return a dictionary; ValueError where it is gone."""
        if number not in self._found:
            sql = "SELECT body FROM block_dictionaries WHERE id = ?"
            row = self._connection.execute(sql, (number,)).fetchone()
            if row is None:
                raise ValueError(f"the dictionary {number} is missing")
            self._found[number] = inflated(row[0], b"", DICTIONARY_BYTES)
        return self._found[number]


def span_text(from_s: object, until_s: object) -> str:
    """Return from when until when a block is, for a person."""
    if isinstance(from_s, float) and isinstance(until_s, float):
        return f"{from_s:.3f} to {until_s:.3f} s"
    return "of an unknown time"
