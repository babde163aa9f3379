"""Rows of the journal: inputs and decisions in packed blocks, and changes of the valves.

What takes the room in a journal are digits: a float of the estimator has seventeen, and none of
them can be foreseen. So each line is split into its form (the text with a hole for each number)
and its numbers. Forms repeat, and are kept once a block. A number is kept by what it stands for:
the place in its object (the third number of a `VehicleState`), whose numbers make one column.
Of a column is kept only what is new: the same as in the line before costs next to nothing, the
same as any number of the block (a time that stands in four places) a byte or so. What is new is
the difference to the one before, as an integer: of decimals where there are few, of the float's
own bits otherwise; bytes of equal weight lie together, so that deflate finds the zeros.

A packer can have a `follower`, whose lines may refer to the numbers of both: decisions repeat what
is in the inputs before them, and inputs can be read without the decisions.

A number is taken out only if its text is the one that Python writes for it; so what comes back is
what went in, whatever it is. Text is ASCII without control characters, as `codec.encode` writes.

A block is a row a commit, with check sums over the text. Inputs (`body`) and decisions lie apart:
who wants a sensor's values does not unpack decisions, which are ten times as much. Decisions may
refer to numbers of the inputs before them.

Changes of the valves are kept as planned, and as ordered where an output tells when it gave the
order. A row is integers only (microseconds, thousandths), so that a trim ten times a second of
each valve costs 25 bytes and not a hundred.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

from companion.core.types import SprayPlan

# ------------------------------------------------------------------------------------------ packing

_NUMBER = re.compile(r"(-?\d+(?:\.\d+)?(?:e[+-]\d+)?)")
FLOAT, INT = "\x01", "\x02"
HOLE = re.compile(f"([{FLOAT}{INT}])")
_OBJECT = re.compile(r'\{"(\w+)":|\}')
_INT_DIGITS_MAX = 15
# Decimals of a number that is kept as an integer: a monotonic clock has nine.
_DECIMALS_MAX = 9
_SCALED_DIGITS_MAX = 18
# In the place of the count of decimals: kept by the float's bits; by how far they are from those
# of the first number of the line.
BITS, ANCHORED = 255, 254
SAME, NEW, BACK = 0, 1, 2
_LEVEL = 6
WORD = struct.Struct("<I")

Key = tuple[str, str, int]


def pack(lines: Sequence[str]) -> bytes:
    """Return the lines in few bytes."""
    packer = Packer()
    for line in lines:
        packer.add(line)
    return deflated(packer.content(), b"")


def deflated(content: bytes, dictionary: bytes) -> bytes:
    """Return a block's content deflated; a block of before as `dictionary` saves a tenth."""
    worker = zlib.compressobj(_LEVEL, zdict=dictionary) if dictionary else zlib.compressobj(_LEVEL)
    return worker.compress(content) + worker.flush()


class _Column:
    """The numbers of one place: a code for each, and those that are new with their anchors."""

    __slots__ = ("anchors", "before", "codes", "fresh", "is_int")

    def __init__(self, *, is_int: bool) -> None:
        self.is_int = is_int
        self.before = ""
        self.codes: list[int] = []
        self.fresh: list[str] = []
        self.anchors: list[str] = []


class Packer:
    """Takes lines one by one, so that a commit finds most of the work done."""

    def __init__(self, *, follower: Packer | None = None) -> None:
        self._follower = follower
        self._forms: dict[str, tuple[int, list[_Column]]] = {}
        self._order: list[int] = []
        self._gaps: list[int] = []
        self._leads: list[int] = []
        self._led = 0
        self._columns: dict[Key, _Column] = {}
        self._places: dict[str, int] = {}
        self._seen = 0

    def add(self, line: str, gap: int = 1) -> None:
        """Take one line; `gap` is how much higher its number is than that of the line before."""
        form, numbers = _taken_apart(_NUMBER.split(line))
        known = self._forms.get(form)
        if known is None:
            known = self._forms[form] = (len(self._forms), self._columns_of(form))
        self._order.append(known[0])
        self._gaps.append(gap)
        self._leads.append(self._led)
        self._led = 0
        if self._follower is not None:
            self._follower.follow()
        anchor = ""
        for column, number in zip(known[1], numbers, strict=True):
            if column.is_int:
                column.fresh.append(number)
                continue
            if number == column.before:
                column.codes.append(SAME)
            else:
                self._take(column, number, anchor)
            anchor = anchor or number

    def _columns_of(self, form: str) -> list[_Column]:
        columns = self._columns
        return [columns.setdefault(key, _Column(is_int=key[0] == INT)) for key in keys_of(form)]

    def _take(self, column: _Column, number: str, anchor: str) -> None:
        column.before = number
        place = self._places.get(number)
        if place is None:
            self.see(number)
            if self._follower is not None:
                self._follower.see(number)
            column.codes.append(NEW)
            column.fresh.append(number)
            column.anchors.append(anchor)
        else:
            column.codes.append(BACK + self._seen - 1 - place)

    def follow(self) -> None:
        """Note that the leader has taken a line."""
        self._led += 1

    def see(self, number: str) -> None:
        """Note a new number, of this packer's or of its leader's lines."""
        self._places[number] = self._seen
        self._seen += 1

    def content(self) -> bytes:
        """Return all of it, still to be deflated."""
        forms = "\n".join(self._forms).encode("ascii")
        out = bytearray(WORD.pack(len(self._order)) + WORD.pack(len(forms)) + forms)
        put_all(out, [_unsigned(gap) for gap in self._gaps])
        put_all(out, self._leads)
        put_all(out, self._order)
        for column in self._columns.values():
            if column.is_int:
                put_all(out, differences([int(number) for number in column.fresh]))
            else:
                put_all(out, column.codes)
        for column in self._columns.values():
            if not column.is_int and column.fresh:
                _put_floats(out, column)
        return bytes(out)


def _taken_apart(parts: list[str]) -> tuple[str, list[str]]:
    """Return the form and the numbers of a line that was split at what may be numbers."""
    numbers = []
    for place in range(1, len(parts), 2):
        text = parts[place]
        if "." in text or "e" in text:
            if repr(float(text)) != text:
                continue
            parts[place] = FLOAT
        elif len(text) <= _INT_DIGITS_MAX and str(int(text)) == text:
            parts[place] = INT
        else:
            continue
        numbers.append(text)
    return "".join(parts), numbers


# A form of 64 valves is shorter. Of longer ones nothing is kept: a stranger's file has many.
FORM_KEPT = 8000


def keys_of(form: str) -> tuple[Key, ...]:
    """Return for each hole of a form what its number is: kind, object, how manieth in it."""
    return _keys_of(form) if len(form) <= FORM_KEPT else _keys_of.__wrapped__(form)


@lru_cache(maxsize=1024)
def _keys_of(form: str) -> tuple[Key, ...]:
    keys = []
    inside: list[list[object]] = [["", 0]]
    for part in HOLE.split(form):
        if part in (FLOAT, INT):
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


def differences(values: Sequence[int]) -> list[int]:
    """Return each value's difference to the one before, the sign in the lowest bit."""
    found, before = [], 0
    for value in values:
        found.append(_unsigned(value - before))
        before = value
    return found


def _unsigned(value: int) -> int:
    return value << 1 if value >= 0 else (-value << 1) - 1


def put_all(out: bytearray, values: Sequence[int]) -> None:
    """Write integers from 0 on, seven bits a byte."""
    if max(values, default=0) <= 0x7F:
        out += bytes(values)
        return
    for value in values:
        while value > 0x7F:
            out.append(value & 0x7F | 0x80)
            value >>= 7
        out.append(value)


def _put_floats(out: bytearray, column: _Column) -> None:
    """Write new floats: how, then the bytes of their differences, those of least weight first."""
    texts = column.fresh
    how = _decimals_of(texts)
    if how == BITS:
        values = bits_of(texts)
        words = differences(values)
        # What follows from the first number of its line (the end of a lease) differs from it
        # always by nearly the same.
        if all(column.anchors):
            anchored = [a - b for a, b in zip(values, bits_of(column.anchors), strict=True)]
            other = differences(anchored)
            if sum(map(int.bit_length, other)) < sum(map(int.bit_length, words)):
                how, words = ANCHORED, other
    else:
        words = differences([_scaled(text, how) for text in texts])
    width = (max(words).bit_length() + 7) // 8
    out += bytes((how, width))
    raw = b"".join([word.to_bytes(width, "little") for word in words])
    for plane in range(width):
        out += raw[plane::width]


def _decimals_of(texts: Sequence[str]) -> int:
    most = 0
    for text in texts:
        decimals = len(text) - text.find(".") - 1
        if decimals > _DECIMALS_MAX or "e" in text or text == "-0.0":
            return BITS
        most = max(most, decimals)
    long = any(text.find(".") + most > _SCALED_DIGITS_MAX for text in texts)
    return BITS if long else most


def _scaled(text: str, decimals: int) -> int:
    whole, _, part = text.partition(".")
    return int(whole + part.ljust(decimals, "0"))


def bits_of(texts: Sequence[str]) -> list[int]:
    """Return the floats' bits, as integers in the order of the numbers."""
    packed = struct.pack(f"<{len(texts)}d", *map(float, texts))
    return [
        word if word >= 0 else -(word & 0x7FFF_FFFF_FFFF_FFFF) - 1
        for word in struct.unpack(f"<{len(texts)}q", packed)
    ]


# --------------------------------------------------------------------------------------------- rows

# A second of a flight has a hundred rows; a simulation has thousands, which are several blocks.
ROWS_MAX = 1000
# A block of 1000 rows with six valves has half a megabyte of text (measured on recorded flights).
TEXT_MAX = 4_000_000
# A block that serves others as their dictionary is chosen anew so often: what they save is ten
# times what it costs.
_DICTIONARY_EVERY = 120
_DICTIONARY_FIRST = 5
DICTIONARY_BYTES = 32_000
_INSERT = "INSERT INTO blocks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"
_INSERT_DICTIONARY = "INSERT INTO block_dictionaries VALUES (?, ?)"
_DECISION = "Decision"
_DECISION_START = f'{{"{_DECISION}":'


class _Rows:
    """The inputs of a block, or its decisions."""

    def __init__(self, follower: _Rows | None = None) -> None:
        self.packer: Packer = Packer(follower=None if follower is None else follower.packer)
        self.crc = 0
        self.last: int | None = None

    def add(self, sequence: int, first: int, body: str) -> None:
        self.packer.add(body, sequence - (first - 1 if self.last is None else self.last))
        self.last = sequence
        self.crc = zlib.crc32(body.encode("ascii"), self.crc)


class Taker(Protocol):
    """A connection, or what collects statements for one."""

    def execute(self, sql: str, values: Sequence[Any], /) -> object:
        """Take a statement."""


class Block:
    """What has come since the last commit: number, time, line of JSON."""

    def __init__(self) -> None:
        self._dictionary = b""
        self._dictionary_id: int | None = None
        self._written = 0
        self._clear()

    def _clear(self) -> None:
        self._decisions = _Rows()
        self._inputs = _Rows(self._decisions)
        self._first: int | None = None
        self._last = 0
        self._times_s: list[float] = []
        self.row_count = self._text = 0

    def add(self, sequence: int, at_s: float, body: str) -> None:
        """Take one row."""
        self._first = sequence if self._first is None else self._first
        rows = self._decisions if body.startswith(_DECISION_START) else self._inputs
        rows.add(sequence, self._first, body)
        self._last = sequence
        self.row_count += 1
        self._text += len(body)
        if abs(at_s) < float("inf"):
            self._times_s.append(at_s)

    @property
    def is_full(self) -> bool:
        """Whether it should be written before more comes."""
        return self.row_count >= ROWS_MAX or self._text >= TEXT_MAX

    def insert(self, taker: Taker) -> None:
        """Write the rows as one and forget them.

        Where what was written is lost: begin with a new `Block`, for a dictionary may be, too.
        """
        if self._first is None:
            return
        contents = [rows.packer.content() for rows in (self._inputs, self._decisions)]
        inputs, decisions = (deflated(content, self._dictionary) for content in contents)
        taker.execute(
            _INSERT,
            (
                self._first,
                self._last,
                self.row_count,
                min(self._times_s, default=None),
                max(self._times_s, default=None),
                self._dictionary_id,
                self._inputs.crc,
                inputs,
                self._decisions.crc,
                decisions,
            ),
        )
        self._written += 1
        if self._written % _DICTIONARY_EVERY == _DICTIONARY_FIRST:
            self._dictionary = b"".join(contents)[-DICTIONARY_BYTES:]
            self._dictionary_id = self._first
            packed = zlib.compress(self._dictionary)
            taker.execute(_INSERT_DICTIONARY, (self._first, packed))
        self._clear()


# No duty: whatever comes next differs.
_UNTOLD = -1

Row = tuple[int | None, int | None, int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class ValveOrder:
    """An order that an output gave: `planned_s` is None where no plan asked for it (a fault)."""

    valve: int
    duty: float
    planned_s: float | None
    given_s: float


def micros(at_s: float | None) -> int | None:
    """Return whole microseconds; None for what is no time.

    >>> micros(1.25), micros(float("nan"))
    (1250000, None)
    """
    return None if at_s is None or not math.isfinite(at_s) else round(at_s * 1e6)


class ValveRows:
    """Rows (planned_us, actual_us, valve, duty_permille), from plans or from orders.

    Of plans: a change counts when its time has come and no newer plan has replaced it; a lease
    that ends closes. With `from_orders` plans are not looked at: what was ordered happened.
    """

    def __init__(self, *, from_orders: bool = False) -> None:
        self.from_orders = from_orders
        self._plan: SprayPlan | None = None
        self._permille: dict[int, int] = {}

    def take_order(self, order: ValveOrder) -> list[Row]:
        """Return the row of an order; none where it changes nothing."""
        return self._changed(
            micros(order.planned_s), micros(order.given_s), order.valve, order.duty
        )

    def take_plan(self, plan: SprayPlan) -> list[Row]:
        """Return what came about of the plan before, and what this one changes at once."""
        if self.from_orders:
            return []
        before, self._plan = self._plan, plan
        rows = [] if before is None else self._came_about(before, plan.issued_s)
        for valve, duty in enumerate(plan.duty):
            rows += self._changed(micros(plan.issued_s), None, valve, duty)
        return rows

    def forget(self) -> None:
        """Take nothing for told: rows were lost, and each valve's next duty is a change."""
        self._permille = dict.fromkeys(self._permille, _UNTOLD)

    def end(self) -> list[Row]:
        """Return what the last plan brings about by itself: its lease ends."""
        before, self._plan = self._plan, None
        return [] if before is None else self._came_about(before, math.inf)

    def _came_about(self, plan: SprayPlan, until_s: float) -> list[Row]:
        rows: list[Row] = []
        last_s = min(plan.lease_until_s, until_s)
        for change in plan.changes:
            if not change.at_s <= last_s:
                break
            rows += self._changed(micros(change.at_s), None, change.valve, change.duty)
        if plan.lease_until_s < until_s:
            for valve in range(len(plan.duty)):
                rows += self._changed(micros(plan.lease_until_s), None, valve, 0.0)
        return rows

    def _changed(
        self, planned_us: int | None, actual_us: int | None, valve: int, duty: float
    ) -> list[Row]:
        permille = round(1000.0 * duty)
        if self._permille.get(valve, 0) == permille:
            return []
        self._permille[valve] = permille
        return [(planned_us, actual_us, valve, permille)]
