"""What a journal's sensors said, as series: of its inputs only these are decoded.

A block keeps each number's column and what of it is new (`companion/journal/rows.py`). Who wants
the count of a meter, fifty times a second, needs neither the lines of JSON nor the other kinds: of
a sound block only the wanted columns are read, all of a column at once.
"""

from __future__ import annotations

import json
import math
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.flown.applied_flight import Floats, Ints, Series
from analysis.journals.content import read_entries
from analysis.journals.unpacking import (
    EXACT_DECIMALS_MAX,
    EXACT_MAX,
    PLENTY,
    SELECT,
    SIGN,
    Dictionaries,
    Reader,
    check_text,
    checked,
    inflated,
    pieces_of,
    span_text,
)
from companion.core.label import from_deg
from companion.journal.rows import ANCHORED, BACK, BITS, FLOAT, NEW, SAME, Key, keys_of
from companion.receiver import offset_of

if TYPE_CHECKING:
    from analysis.journals.unpacking import Entry
    from companion.journal.codec import FieldNames
    from companion.journal.reader import OpenJournal
    from companion.receiver import ReceiverOffset

WIND_FROM, TOLD, FIXED = "wind from", "Telemetry", "GnssReport"
PARSED_AT_ONCE = 1000
# Which value of which sensor's message becomes a series, and which field tells a fault.
_SENSORS = {
    "FlowReport": ("volume_ml", "fault"),
    "PressureReport": ("pressure_kpa", None),
    "TankReport": ("level_l", None),
    "WindReport": ("speed_m_s", None),
    FIXED: ("fix", None),
}
# What else is read of a message: where a wind blows to; place and velocity, whose receiver's delay
# is found beside the estimator's.
_MORE = {
    "WindReport": ("east_m_s", "north_m_s"),
    FIXED: ("boot_s", "latitude_deg", "longitude_deg"),
    TOLD: (
        "boot_s", "latitude_deg", "longitude_deg", "velocity_north_m_s", "velocity_east_m_s"
    ),
}  # fmt: skip


def sensors_of(
    journal: OpenJournal, names: FieldNames, unread: list[str] | None, *, is_sound: bool
) -> tuple[dict[str, Series | None], ReceiverOffset | None]:
    """Return the series of each kind of sensor's message, and of where the wind comes from.

    None where there is no message; and what the receiver differs by. `is_sound` says that the
    packed rows are whole: then only their numbers are read.
    """
    parts: dict[str, list[Floats]] = {kind: [] for kind in (*_SENSORS, WIND_FROM)}
    heard: dict[str, list[Floats]] = {TOLD: [], FIXED: []}
    wanted = {kind: _wanted(kind, names) for kind in (*_SENSORS, TOLD) if kind in names}
    try:
        for kind, rows in _numbers(journal, wanted, unread, is_sound=is_sound):
            if kind in heard:
                heard[kind].append(rows[:, :-1])
            if kind == TOLD:
                continue
            told = rows[:, 1].copy()
            told[rows[:, -1] != 0.0] = np.nan
            parts[kind].append(np.column_stack((rows[:, 0], told)))
            if kind == "WindReport" and _more_in(kind, names):
                from_deg_s = [from_deg(*each) for each in rows[:, 2:4].tolist()]
                parts[WIND_FROM].append(
                    np.column_stack((rows[:, 0], np.array(from_deg_s, dtype=np.float64)))
                )
    except sqlite3.DatabaseError as error:
        if unread is None or "locked" in str(error):
            raise
        unread.append(f"what sensors said behind a damaged place: {' '.join(str(error).split())}")
    positions, fixes = (
        [row for rows in heard[kind] for row in rows.tolist()] if _more_in(FIXED, names) else []
        for kind in (TOLD, FIXED)
    )
    return {kind: _series(rows) for kind, rows in parts.items()}, offset_of(positions, fixes)


def _wanted(kind: str, names: FieldNames) -> Wanted:
    """Return the places of a sensor's time, value and fault, and of what else is read of it."""
    value, fault = _SENSORS.get(kind, (None, None))
    numbers = ["received_s", *filter(None, [value]), *_more_in(kind, names)]
    return Wanted(
        numbers=tuple(names[kind].index(name) for name in numbers),
        flag=names[kind].index(fault) if fault else -1,
    )


def _numbers(
    journal: OpenJournal,
    wanted: Mapping[str, Wanted],
    unread: list[str] | None,
    *,
    is_sound: bool,
) -> Iterator[tuple[str, Floats]]:
    """Yield the numbers of the sensors' messages in pieces, each of one kind and in order."""
    if is_sound and journal.version != "1":
        for found in read_numbers(journal.connection, wanted, unread=unread):
            yield from found.items()
        return
    entries = read_entries(journal.connection, journal.version, kinds=wanted.keys(), unread=unread)
    for several in _several(entries):
        yield from numbers_of([entry.body for entry in several], wanted).items()


def _more_in(kind: str, names: FieldNames) -> tuple[str, ...]:
    """Return what else is read of a message; nothing in journals from before it was kept."""
    wanted = _MORE.get(kind, ())
    return wanted if set(wanted) <= set(names.get(kind, ())) else ()


def _several(entries: Iterator[Entry]) -> Iterator[list[Entry]]:
    """Yield entries many at once: what was read before damage, too."""
    several: list[Entry] = []
    try:
        for entry in entries:
            several.append(entry)
            if len(several) == PARSED_AT_ONCE:
                yield several
                several = []
    except sqlite3.DatabaseError:
        yield several
        raise
    yield several


def _series(parts: list[Floats]) -> Series | None:
    rows = np.concatenate(parts) if parts else np.empty((0, 2))
    if not len(rows):
        return None
    order = np.argsort(rows[:, 0], kind="stable")
    return Series(time_s=rows[order, 0], value=rows[order, 1])


# Numbers of a few kinds of messages from packed blocks.

_INT64_MAX = 9.2e18
_BYTES_OF_INT64 = 9
_HOLE_KEY = "\\u0001"


class Wanted(NamedTuple):
    """Which of a message's values: numbers by their places, and one that says yes or no, or -1."""

    numbers: tuple[int, ...]
    flag: int = -1


class _UnusualError(Exception):
    """Something that only the reading of all texts can tell."""


def read_numbers(
    connection: sqlite3.Connection, wanted: Mapping[str, Wanted], *, unread: list[str] | None = None
) -> Iterator[Mapping[str, Floats]]:
    """Yield for each block the numbers of the wanted kinds: a row a message, the flag behind them.

    What is missing is NaN. The check sum of the lines is not looked at, as there are no lines: that
    of the stream (RFC 1950) is. A block that is unusual or damaged is read as `read_blocks` does.
    """
    dictionaries = Dictionaries(connection)
    sql = SELECT.format("NULL, NULL")
    for first, from_s, until_s, dictionary, *parts in connection.execute(sql):
        try:
            words = dictionaries.get(dictionary)
            found = quick_numbers(parts[1], words, wanted)
            if found is None:
                found = numbers_of(checked(parts[0], parts[1], words, None).lines, wanted)
        except (ValueError, TypeError, OverflowError) as error:
            text = f"rows from {first} on ({span_text(from_s, until_s)}): {error}"
            if unread is None:
                raise ValueError(text) from error
            unread.append(text)
        else:
            yield found


def quick_numbers(
    packed: bytes, dictionary: bytes, wanted: Mapping[str, Wanted]
) -> Mapping[str, Floats] | None:
    """Return the numbers of a block; None where its texts must be read."""
    content = inflated(packed, dictionary)
    try:
        return _Numbers(content).of(wanted)
    except (_UnusualError, LookupError, ValueError, RuntimeError, struct.error):
        return None


def numbers_of(lines: Sequence[str], wanted: Mapping[str, Wanted]) -> Mapping[str, Floats]:
    """Return the numbers from the lines themselves."""
    rows: dict[str, list[list[float]]] = {kind: [] for kind in wanted}
    its = [line for line in lines if line[2 : line.find('"', 2)] in wanted]
    # All at once is quicker.
    for message in json.loads(f"[{','.join(its)}]"):
        ((kind, values),) = message.items()
        if kind in wanted:
            numbers, flag = wanted[kind]
            row = [_number(values[place]) for place in numbers]
            rows[kind].append([*row, float(flag >= 0 and bool(values[flag]))])
    return {
        kind: np.array(each, dtype=np.float64).reshape(len(each), len(wanted[kind].numbers) + 1)
        for kind, each in rows.items()
    }


def _number(value: Any) -> float:
    told = value["Fix"] if isinstance(value, dict) else value
    return math.nan if told is None else float(told)


class _PackedFloats(NamedTuple):
    """New numbers of a column as they are kept."""

    how: int
    width: int
    how_many: int
    raw: bytes

    def integers(self) -> Ints:
        """Return their integers; those of more than 64 bits are `_UnusualError`."""
        if self.width > 8:
            raise _UnusualError
        raw = np.frombuffer(self.raw, dtype=np.uint8)
        if self.width == 1:
            return _summed(raw.astype(np.uint64))
        planes = np.zeros((self.how_many, 8), dtype=np.uint8)
        planes[:, : self.width] = raw.reshape(self.width, -1).T
        return _summed(planes.view("<u8").ravel())


class _Reader(Reader):
    """Reads integers as arrays."""

    def words(self, count: int) -> Ints:
        """Return so many integers as an array; those of more than 63 bits are `_UnusualError`."""
        content, at = self._content, self._at
        if count > len(content) - at:
            raise ValueError("a block is cut off")
        # A byte that goes on in the next one is none of ASCII's.
        if content[at : at + count].isascii():
            self._at += count
            return np.frombuffer(content, dtype=np.uint8, count=count, offset=at).astype(np.int64)
        reach = min(_BYTES_OF_INT64 * count, len(content) - at)
        raw = np.frombuffer(content, dtype=np.uint8, count=reach, offset=at)
        ends = np.flatnonzero(raw <= PLENTY)[:count]
        if len(ends) < count:
            raise _UnusualError
        starts = np.concatenate(([0], ends[:-1] + 1))
        found = raw[ends].astype(np.int64)
        # Most have one byte; of the others the first ones are put below the last.
        long = np.flatnonzero(ends != starts)
        starts, more = starts[long], (ends - starts)[long]
        if more.max(initial=0) >= _BYTES_OF_INT64:
            raise _UnusualError
        found[long] <<= 7 * more
        for place in range(int(more.max(initial=0))):
            its = np.flatnonzero(more > place)
            low = (raw[starts[its] + place] & PLENTY).astype(np.int64)
            found[long[its]] |= low << (7 * place)
        self._at += int(ends[-1]) + 1
        return found

    def packed_floats(self, count: int) -> _PackedFloats:
        """Return new numbers as they are kept: nobody may want them."""
        how, width = self.take(2)
        return _PackedFloats(how, width, count, self.take(count * width))


class _Hole(NamedTuple):
    number: int


def _hole_or_dict(found: dict[str, Any]) -> object:
    return _Hole(found["\x01"]) if found.keys() == {"\x01"} else found


@lru_cache(maxsize=256)
def _values_of(form: str) -> tuple[str, tuple[object, ...]]:
    """Return the kind and the values of a form, a `_Hole` for each number."""
    pieces = list(pieces_of(form))
    pieces[1::2] = [f'{{"{_HOLE_KEY}":{number}}}' for number in range(len(pieces) // 2)]
    try:
        ((kind, values),) = json.loads("".join(pieces), object_hook=_hole_or_dict).items()
    except (ValueError, AttributeError) as error:
        raise _UnusualError from error
    return kind, tuple(values)


class _Floats(NamedTuple):
    """A column of floats: its places among all of the block, and its codes there."""

    slots: Ints
    codes: Ints


class _Numbers:
    """A block's content, read as numbers as far as they are asked for."""

    def __init__(self, content: bytes) -> None:
        reader = _Reader(content)
        count, self._forms = reader.head()
        reader.words(count)  # the distances of the lines' numbers
        if reader.words(count).any():
            raise _UnusualError
        self._order = reader.words(count)
        check_text(self._forms, self._order)
        self._keys = [keys_of(form) for form in self._forms]
        is_float = [[key[0] == FLOAT for key in keys] for keys in self._keys]
        held = np.array([sum(each) for each in is_float], dtype=np.int64)[self._order]
        ends = np.cumsum(held)
        # Of each line the place of its first float among all of the block.
        self._first = ends - held
        self._line = np.repeat(np.arange(count), held)
        total = int(ends[-1]) if count else 0
        self._ints: dict[Key, Ints] = {}
        self._floats: list[_Floats] = []
        self._number_of: dict[Key, int] = {}
        # The codes of all columns follow each other: read at once.
        slots_of = self._slots(is_float)
        codes = reader.words(sum(map(len, slots_of.values())))
        first = 0
        for key, slots in slots_of.items():
            its = codes[first : first + len(slots)]
            first += len(slots)
            if key[0] == FLOAT:
                self._number_of[key] = len(self._floats)
                self._floats.append(_Floats(slots, its))
            else:
                self._ints[key] = _summed(its.view(np.uint64))
        self._column_of, is_new, news = _told_by(self._floats, total)
        self._rank = np.cumsum(is_new)
        self._new_slots = np.flatnonzero(is_new)
        self._new_column = self._column_of[self._new_slots]
        self._fresh = [reader.packed_floats(each) if each else None for each in news]
        self._seen = np.full(len(self._new_slots), np.nan)
        self._known: set[int] = set()
        self._asked: set[int] = set()
        self._columns: dict[int, Floats] = {}

    def _lines(self) -> dict[int, Ints]:
        """Return the lines of each form, in the order in which the forms come first."""
        lines = {
            form: np.flatnonzero(self._order == form)
            for form in np.flatnonzero(np.bincount(self._order)).tolist()
        }
        return dict(sorted(lines.items(), key=lambda each: int(each[1][0])))

    def _slots(self, is_float: Sequence[Sequence[bool]]) -> dict[Key, Ints]:
        """Return where the numbers of each column are: places of floats, or lines of integers."""
        self._lines_of = self._lines()
        found: dict[Key, list[Ints]] = {}
        for form, lines in self._lines_of.items():
            place = 0
            for key, is_one in zip(self._keys[form], is_float[form], strict=True):
                found.setdefault(key, []).append(self._first[lines] + place if is_one else lines)
                place += is_one
        return {
            key: each[0] if len(each) == 1 else np.sort(np.concatenate(each))
            for key, each in found.items()
        }

    def of(self, wanted: Mapping[str, Wanted]) -> Mapping[str, Floats]:
        """Return the numbers of the wanted kinds, each message a row, the flag last."""
        found: dict[str, list[tuple[Ints, Floats]]] = {kind: [] for kind in wanted}
        for form, lines in self._lines_of.items():
            text = self._forms[form]
            kind = text[2 : text.find('"', 2)]
            if kind not in wanted or not text.startswith(f'{{"{kind}":'):
                continue
            values = _values_of(text)[1]
            numbers, flag = wanted[kind]
            columns = [self._told(form, lines, values[place]) for place in numbers]
            columns.append(self._flag(form, lines, values[flag] if flag >= 0 else None))
            found[kind].append((lines, np.stack(columns, axis=1)))
        return {
            kind: _in_order(each, len(wanted[kind].numbers) + 1) for kind, each in found.items()
        }

    def _told(self, form: int, lines: Ints, value: object) -> Floats:
        """Return a number of each line of a form."""
        told = value["Fix"] if isinstance(value, dict) else value
        if isinstance(told, _Hole):
            return self._in_hole(form, lines, told.number)
        if told is not None and not isinstance(told, bool | int | float):
            raise _UnusualError
        return np.full(len(lines), math.nan if told is None else float(told))

    def _flag(self, form: int, lines: Ints, value: object) -> Floats:
        if isinstance(value, _Hole):
            return np.where(self._in_hole(form, lines, value.number) != 0.0, 1.0, 0.0)
        return np.full(len(lines), float(bool(value)))

    def _in_hole(self, form: int, lines: Ints, hole: int) -> Floats:
        keys = self._keys[form]
        key = keys[hole]
        if keys.count(key) > 1:
            raise _UnusualError
        if key[0] != FLOAT:
            each = self._ints[key]
            its = self._lines_with(key)
            return each[np.searchsorted(its, lines)].astype(np.float64)
        place = sum(other[0] == FLOAT for other in keys[:hole])
        number = self._number_of[key]
        slots, values = self._floats[number].slots, self._values(number)
        if len(slots) == len(lines):  # no other form has such a number
            return values
        return values[np.searchsorted(slots, self._first[lines] + place)]

    def _lines_with(self, key: Key) -> Ints:
        return np.sort(
            np.concatenate([self._lines_of[f] for f in self._lines_of if key in self._keys[f]])
        )

    def _values(self, number: int) -> Floats:
        """Return the values of a column of floats."""
        found = self._columns.get(number)
        if found is None:
            source = self._sources(number)
            self._look_up(source)
            self._columns[number] = found = self._seen.take(source)
        return found

    def _sources(self, number: int) -> Ints:
        """Return which of the block's new numbers each of a column is."""
        slots, codes = self._floats[number]
        if not len(codes):
            return np.empty(0, dtype=np.int64)
        if codes[0] == SAME:
            raise _UnusualError
        own = self._rank[slots] - 1 - np.where(codes == NEW, 0, codes - BACK)
        if own.min() < 0:
            raise _UnusualError
        last = np.maximum.accumulate(np.where(codes == SAME, 0, np.arange(len(codes))))
        return own[last]

    def _look_up(self, source: Ints) -> None:
        """Work out the columns of these new numbers."""
        if not len(source):
            return
        for number in np.flatnonzero(np.bincount(self._new_column[source])).tolist():
            if number not in self._known:
                self._decode(number)

    def _decode(self, number: int) -> None:
        """Work out all new numbers of a column."""
        if number in self._asked:
            raise _UnusualError  # they stand on each other
        self._asked.add(number)
        its = np.flatnonzero(self._new_column == number)
        fresh = self._fresh[number]
        if fresh is None:
            raise _UnusualError
        how, values = fresh.how, fresh.integers()
        if how == ANCHORED:
            anchors = self._anchors(self._line[self._new_slots[its]])
            bits = np.ascontiguousarray(anchors).view(np.int64)
            values = np.where(bits >= 0, bits, -(bits & (SIGN - 1)) - 1) + values
            how = BITS
        if how == BITS:
            raw = np.where(values >= 0, values, (-values - 1) | np.int64(-SIGN))
            self._seen[its] = raw.view(np.float64)
        elif how > EXACT_DECIMALS_MAX or (len(values) and np.abs(values).max() >= EXACT_MAX):
            raise _UnusualError
        else:
            self._seen[its] = values / 10.0**how
        self._known.add(number)

    def _anchors(self, lines: Ints) -> Floats:
        """Return the first number of each of these lines."""
        slots = self._first[lines]
        columns = self._column_of[slots]
        found = np.empty(len(lines))
        for number in np.flatnonzero(np.bincount(columns)).tolist():
            its = columns == number
            at = np.searchsorted(self._floats[number].slots, slots[its])
            found[its] = self._values(number)[at]
        return found


def _told_by(columns: Sequence[_Floats], total: int) -> tuple[Ints, NDArray[np.bool_], list[int]]:
    """Return of each float of a block the column, and whether it is new; and each column's count.

    The count is that of new ones.
    """
    column_of, is_new = np.full(total, -1, dtype=np.int64), np.zeros(total, dtype=np.bool_)
    if not columns:
        return column_of, is_new, []
    slots = np.concatenate([each.slots for each in columns])
    number = np.repeat(np.arange(len(columns)), [len(each.slots) for each in columns])
    new = np.concatenate([each.codes for each in columns]) == NEW
    column_of[slots], is_new[slots] = number, new
    return column_of, is_new, np.bincount(number[new], minlength=len(columns)).tolist()


def _in_order(parts: Sequence[tuple[Ints, Floats]], width: int) -> Floats:
    """Return the rows of several forms in the order of their lines."""
    if not parts:
        return np.empty((0, width))
    if len(parts) == 1:
        return parts[0][1]
    order = np.argsort(np.concatenate([lines for lines, _ in parts]), kind="stable")
    return np.concatenate([rows for _, rows in parts])[order]


def _summed(words: NDArray[np.uint64]) -> Ints:
    """Return as `sums` what fits in 64 bits."""
    steps = (words >> np.uint64(1)).view(np.int64) ^ -(words & np.uint64(1)).view(np.int64)
    could_be = int(words.max(initial=0)) * len(words)
    if could_be > _INT64_MAX and np.abs(np.cumsum(steps.astype(np.float64))).max() > _INT64_MAX:
        raise _UnusualError
    return np.cumsum(steps)
