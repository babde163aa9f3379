"""Rows of the journal: inputs and decisions in packed blocks, and changes of the valves.

A block is a row a commit, with check sums over the text. Inputs (`body`) and decisions lie apart:
who wants a sensor's values does not unpack decisions, which are ten times as much. Decisions may
refer to numbers of the inputs before them.

Changes of the valves are kept as planned, and as ordered where an output tells when it gave the
order. A row is integers only (microseconds, thousandths), so that a trim ten times a second of
each valve costs 25 bytes and not a hundred.
"""

from __future__ import annotations

import math
import sqlite3
import zlib
from dataclasses import dataclass

from companion.core.types import SprayPlan
from companion.journal.packing import Packer, deflated

# A second of a flight has a hundred rows; a simulation has thousands, which are several blocks.
ROWS_MAX = 1000
# A block that serves others as their dictionary is chosen anew so often: what they save is ten
# times what it costs.
_DICTIONARY_EVERY = 120
_DICTIONARY_FIRST = 5
_DICTIONARY_BYTES = 32_000
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
        self.row_count = 0

    def add(self, sequence: int, at_s: float, body: str) -> None:
        """Take one row."""
        self._first = sequence if self._first is None else self._first
        rows = self._decisions if body.startswith(_DECISION_START) else self._inputs
        rows.add(sequence, self._first, body)
        self._last = sequence
        self.row_count += 1
        if abs(at_s) < float("inf"):
            self._times_s.append(at_s)

    @property
    def is_full(self) -> bool:
        """Whether it should be written before more comes."""
        return self.row_count >= ROWS_MAX

    def insert(self, connection: sqlite3.Connection) -> None:
        """Write the rows as one and forget them.

        Where that, or the commit, fails: begin with a new `Block`, for a dictionary may be lost.
        """
        if self._first is None:
            return
        contents = [rows.packer.content() for rows in (self._inputs, self._decisions)]
        inputs, decisions = (deflated(content, self._dictionary) for content in contents)
        connection.execute(
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
            self._dictionary = b"".join(contents)[-_DICTIONARY_BYTES:]
            self._dictionary_id = self._first
            packed = zlib.compress(self._dictionary)
            connection.execute(_INSERT_DICTIONARY, (self._first, packed))
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
