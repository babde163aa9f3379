"""The journal's side of the disk: owns the connection, lives in its own thread.

One commit a second, or sooner where it is told so, so that a cut of power costs a second. Whatever
the disk does, it does to this thread: what a full disk or a removed card does not take waits in
memory, packed, and is tried again with each commit.

What the flight's tables come to is told in `meta` at its end: missing rows are noticed by it.
"""

from __future__ import annotations

import json
import logging
import math
import sqlite3
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal

from companion.core.frame import LocalFrame, course_deg
from companion.core.options.coverage import CELL_M, TILE_CELLS, Coverage
from companion.core.types import (
    Decision,
    DeclarationReport,
    Inhibit,
    Input,
    SprayerState,
    UtcReport,
    VehicleState,
)
from companion.journal.codec import encode
from companion.journal.geopackage import point_blob, set_box, time_text
from companion.journal.read_only import one_line
from companion.journal.rows import Block, Row, ValveOrder, ValveRows
from companion.simulated import BECAUSE, SIMULATED, Simulated, parsed

# Behind the name of a table: how many rows it has.
_COUNTED = {"rows_applied": "applied", "rows_valve_changes": "valve_changes"}
LITRES_KEY = "applied_l"
_GAP_MAX_S = 1.0


def totals_of(connection: sqlite3.Connection) -> dict[str, str]:
    """Return what `meta` says of the tables as they are now."""
    found = {key: str(_count(connection, table)) for key, table in _COUNTED.items()}
    return {**found, LITRES_KEY: repr(_summed_l(connection))}


def applied_l(connection: sqlite3.Connection, meta: Mapping[str, str]) -> float:
    """Return what the ordered duties stand for in litres: not a measurement."""
    try:
        told_l = float(meta[LITRES_KEY])
    except (KeyError, TypeError, ValueError):
        return _summed_l(connection)
    return told_l if math.isfinite(told_l) else _summed_l(connection)


def missing_rows(connection: sqlite3.Connection, meta: Mapping[str, str]) -> Iterator[str]:
    """Yield a line for each table that has not the rows that it had at the flight's end."""
    for key, table in _COUNTED.items():
        told = meta.get(key)
        if told is None:  # a flight that was cut, or an older journal
            continue
        try:
            found = _count(connection, table)
        except sqlite3.DatabaseError as error:
            yield f"{table}: {one_line(error)}"
            continue
        if str(found) != told:
            yield f"{table}: {found} rows, {told} were written"


def _count(connection: sqlite3.Connection, table: str) -> int:
    (count,) = connection.execute(f"SELECT count(*) FROM {table}").fetchone()
    return int(count)


def _summed_l(connection: sqlite3.Connection) -> float:
    summed_l, before_s, flow_l_min = 0.0, None, 0.0
    rows = connection.execute("SELECT time_s, flow_l_min FROM applied ORDER BY sequence")
    for at_s, flow in rows:
        if before_s is not None and at_s is not None and 0.0 < at_s - before_s < _GAP_MAX_S:
            summed_l += flow_l_min * (at_s - before_s) / 60.0
        before_s, flow_l_min = at_s, flow or 0.0
    return summed_l


__all__ = ["Event", "Item", "Writer"]


# What is written down besides inputs and decisions.


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """What happened besides inputs and decisions."""

    at_s: float
    kind: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSample:
    """How the link does at one moment: a value for each column of `link_stats`, as far as known."""

    at_s: float
    values: Mapping[str, float | None]


_logger = logging.getLogger(__name__)

_EVENT = "INSERT INTO events VALUES (?, ?, ?, ?, ?)"
_APPLIED = "INSERT INTO applied VALUES (" + ", ".join("?" * 14) + ")"
_VALVE = (
    "INSERT INTO valve_changes (planned_us, actual_us, valve, duty_permille) VALUES (?, ?, ?, ?)"
)
LINK_COLUMNS = (
    *("bytes_in", "bytes_out", "frames_in", "frames_out", "bad_frames", "refused_frames"),
    *("unsent_frames", "lost_percent", "frames_per_s", "bytes_in_per_s", "bytes_out_per_s"),
    *("position_hz", "round_trip_s"),
)
_LINK = (
    f"INSERT INTO link_stats (time_s, {', '.join(LINK_COLUMNS)}) "
    f"VALUES ({', '.join('?' * (len(LINK_COLUMNS) + 1))})"
)
SET_META = (
    "INSERT INTO meta (key, value) VALUES (?, ?) "
    "ON CONFLICT (key) DO UPDATE SET value = excluded.value"
)
# Where it is kept what the operator declared during the run, the newest of it.
DECLARED_META, DECLARED_MAX = "declared_json", 50
# What was written before the autopilot said which time it is gets that time at the end.
_TIME_AGAIN = (
    "UPDATE {} SET time = strftime('%Y-%m-%dT%H:%M:%fZ', time_s + ?, 'unixepoch') WHERE time_s < ?"
)
_FROM_ORDERS = ("valve_changes", "orders")
_CHECKPOINT_EVERY = 60  # commits
# What is not yet on the disk waits in memory: a quarter of an hour with six valves takes 26 MB by
# this count, and 42 of the process (`python -m tests.bench.journal held`).
HELD_BYTES_MAX = 64_000_000
_VALUE_BYTES = 40
_AT_ONCE = 60  # seconds of the flight in one transaction, where some had to wait
# A full disk, a removed card: what was to be written waits.
_FAILURES = (sqlite3.Error, ValueError, TypeError, OverflowError)
# A value that JSON or SQLite does not know: its row is lost, whenever it is tried again.
_REFUSALS = (
    *(ValueError, TypeError, OverflowError),
    *(sqlite3.IntegrityError, sqlite3.DataError, sqlite3.ProgrammingError, sqlite3.InterfaceError),
)


class _Commit:
    """What one commit writes: statements, each with how many rows of the flight are in it."""

    def __init__(self) -> None:
        self.statements: list[tuple[str, Sequence[Any], int]] = []
        self.rows = 0
        self.size_bytes = 0

    def execute(self, sql: str, values: Sequence[Any], rows: int = 0) -> None:
        """Take a statement as a connection does; nothing is written yet."""
        self.statements.append((sql, values, rows))
        self.rows += rows
        self.size_bytes += sum(
            _VALUE_BYTES + (len(value) if isinstance(value, bytes | str) else 0) for value in values
        )


Item = Input | Decision | Event | ValveOrder | LinkSample


class Writer:
    """Writes what it is given, late if it must; never raises for what a disk can do.

    `next_sequence` numbers the writer's own events; `utc_offset_s` makes a time since 1970 of the
    companion's monotonic one, until the autopilot says better.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        *,
        frame: LocalFrame,
        utc_offset_s: float,
        next_sequence: Callable[[], int],
    ) -> None:
        self._connection = connection
        self._clock = FlightClock(utc_offset_s)
        self._told_offset_s = utc_offset_s
        self._told_orders = False
        self._simulated: Simulated | None = None
        self._declared: list[tuple[float, str]] = []
        self._applied = AppliedRows(frame, self._clock.text)
        self._block = Block()
        self.valves = ValveRows()
        self._next_sequence = next_sequence
        self._coverage: Coverage | None = None
        self._open = _Commit()
        self._waiting: deque[_Commit] = deque()
        self._waiting_bytes = 0
        self._commits = 0
        self._reported = 0
        self._last_s = 0.0
        self.committed = 0
        self.lost = 0
        self.fault: str | None = None

    @property
    def waiting(self) -> int:
        """Return how many rows the disk has not taken."""
        return sum(each.rows for each in self._waiting)

    def write(self, sequence: int, item: Item) -> None:
        """Take one row into the open second."""
        try:
            self._take(sequence, item)
            if self._block.is_full:
                self._flush()
        except _REFUSALS as error:
            self._fail(error, lost=1)

    def commit(self, *, lost_before: int, coverage: Coverage | None = None) -> None:
        """Make the open second last; `lost_before` rows never reached this thread.

        What the disk does not take is tried again with the next commit.
        """
        self._flush()
        if self._waiting_bytes + self._open.size_bytes > HELD_BYTES_MAX:
            self._forget_open()
        self._hold(lost_before)
        try:
            self._save(coverage)
        except _FAILURES as error:
            self._fail(error)

    def finish(self, *, lost_before: int, coverage: Coverage | None = None) -> None:
        """Make one file of it and mark it closed; a file that lacks what waits stays open."""
        try:
            self._insert_valves(self.valves.end())
            self._keep_simulated()
            self.commit(lost_before=lost_before, coverage=coverage)
            # Once more, with what the last commit could not take.
            self._hold(lost_before)
            self._save(coverage)
            execute = self._connection.execute
            execute("BEGIN")
            if self._clock.known_s is not None:
                tell_times_again(self._connection, self._clock.offset_s, self._clock.known_s)
            set_box(self._connection, "applied", self._applied.box)
            execute(SET_META, ("utc_source", self._clock.source))
            execute(SET_META, ("utc_offset_s", repr(self._clock.offset_s)))
            for fact in totals_of(self._connection).items():
                execute(SET_META, fact)
            execute(SET_META, ("closed", "yes"))
            execute("COMMIT")
            execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            execute("PRAGMA journal_mode = DELETE").fetchall()
        except _FAILURES as error:
            self._fail(error, lost=self.waiting)
        finally:
            self._connection.close()

    def _flush(self) -> None:
        """Pack the open block; where that fails for whatever reason, it is lost."""
        count = self._block.row_count
        try:
            self._block.insert(self._open)
            self._open.rows += count
        except _REFUSALS as error:
            self._block = Block()
            self._fail(error, lost=count)

    def _forget_open(self) -> None:
        """Lose the open second: there is no more memory for what waits."""
        self.lost += self._open.rows
        self._open, self._block = _Commit(), Block()
        # What was told of the flight in that second is told again; so are the valves' duties.
        self._told_orders = False
        self._told_offset_s = math.inf
        self.valves.forget()

    def _hold(self, lost_before: int) -> None:
        """Put the open second behind those that wait."""
        if self.valves.from_orders and not self._told_orders:
            self._open.execute(SET_META, _FROM_ORDERS)
            self._told_orders = True
        self._report(self.lost + lost_before)
        if self._open.statements:
            self._waiting.append(self._open)
            self._waiting_bytes += self._open.size_bytes
            self._open = _Commit()

    def _save(self, coverage: Coverage | None) -> None:
        """Write all that waits, oldest first; raise what the disk says."""
        while self._waiting or (coverage is not None and coverage is not self._coverage):
            now = list(islice(self._waiting, _AT_ONCE))
            self._connection.execute("BEGIN")
            lost = sum(map(self._written_but, now))
            if coverage is not None and coverage is not self._coverage:
                write_coverage(self._connection, coverage, self._coverage)
            self._connection.execute("COMMIT")
            self._coverage = coverage or self._coverage
            for done in now:
                self._waiting.popleft()
                self._waiting_bytes -= done.size_bytes
                self.committed += done.rows
            self.committed -= lost
            self.lost += lost
            self._commits += 1
            if self._commits % _CHECKPOINT_EVERY == 0:
                self._connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
        self.fault = None

    def _written_but(self, commit: _Commit) -> int:
        """Write what was taken for a commit; return how many rows the database refused."""
        lost = 0
        for sql, values, rows in commit.statements:
            try:
                self._connection.execute(sql, values)
            except _REFUSALS as error:
                lost += rows
                _logger.warning("journal: a row is lost: %s", one_line(error))
        return lost

    def _fail(self, error: Exception, *, lost: int = 0) -> None:
        """Note why the disk takes nothing, or what is gone for good."""
        if self._connection.in_transaction:
            self._connection.rollback()
        self.lost += lost
        if self.fault is None:
            _logger.warning("journal: %s; %d rows lost, %d wait", error, lost, self.waiting)
        self.fault = str(error)

    def _report(self, lost: int) -> None:
        if lost == self._reported:
            return
        text = f"{lost - self._reported} rows lost, {lost} in all"
        if self.fault:
            text += f": {self.fault}"
        self._reported = lost
        self._insert_event(
            self._next_sequence(), Event(at_s=self._last_s, kind="rows-lost", text=text)
        )
        self._open.execute(SET_META, ("lost", str(lost)))

    def _take(self, sequence: int, item: Item) -> None:
        if isinstance(item, ValveOrder):
            self._insert_valves(self.valves.take_order(item))
        elif isinstance(item, LinkSample):
            values = (item.values.get(name) for name in LINK_COLUMNS)
            self._open.execute(_LINK, (item.at_s, *values))
        elif isinstance(item, Event):
            self._insert_event(sequence, item, rows=1)
            if item.kind == SIMULATED:
                self._simulated = parsed(item.text)
                self._keep_simulated()
        elif isinstance(item, Decision):
            body = encode(item)
            row = self._applied.take(sequence, item)
            if row is not None:
                self._open.execute(_APPLIED, row)
            self._insert_valves(self.valves.take_plan(item.plan))
            self._add(sequence, item.now_s, body)
        else:
            self._add(sequence, item.received_s, encode(item))
            if isinstance(item, UtcReport):
                self._take_time(item)
            elif isinstance(item, DeclarationReport):
                self._keep_declared(item)

    def _add(self, sequence: int, at_s: float, body: str) -> None:
        self._block.add(sequence, at_s, body)
        self._last_s = at_s

    def _insert_valves(self, rows: list[Row]) -> None:
        for row in rows:
            self._open.execute(_VALVE, row)

    def _insert_event(self, sequence: int, event: Event, *, rows: int = 0) -> None:
        time = self._clock.text(event.at_s)
        self._open.execute(_EVENT, (sequence, time, event.at_s, event.kind, event.text), rows)

    def _keep_simulated(self) -> None:
        """Keep in `meta` whether the flight is simulated; at the end once more."""
        if self._simulated is not None:
            self._open.execute(SET_META, (SIMULATED, self._simulated.word))
            self._open.execute(SET_META, (BECAUSE, self._simulated.because))

    def _keep_declared(self, report: DeclarationReport) -> None:
        """Keep in `meta` what the operator declared, and when: the record is made of it."""
        self._declared = [*self._declared, (report.received_s, report.said)][-DECLARED_MAX:]
        self._open.execute(SET_META, (DECLARED_META, json.dumps(self._declared)))

    def _take_time(self, report: UtcReport) -> None:
        """Keep the autopilot's time of day in `meta`; a jump is an event."""
        said = self._clock.take(report)
        if said is not None:
            event = Event(at_s=report.received_s, kind="clock", text=said)
            self._insert_event(self._next_sequence(), event, rows=1)
        if said is not None or abs(self._clock.offset_s - self._told_offset_s) > 0.01:
            self._told_offset_s = self._clock.offset_s
            self._open.execute(SET_META, ("utc_source", self._clock.source))
            self._open.execute(SET_META, ("utc_offset_s", repr(self._clock.offset_s)))


def tell_times_again(connection: sqlite3.Connection, offset_s: float, known_s: float) -> None:
    """Give what was written before the autopilot told the time of day that time."""
    for table in ("applied", "events"):
        connection.execute(_TIME_AGAIN.format(table), (offset_s, known_s))


# Rows of the layer `applied`: where the vehicle was and what was to be applied there.
#
# For map viewers and reports: ten a second, and one more whenever the reasons not to spray or the
# state of the sprayer change. Every decision itself is in the blocks.

EVERY_S = 0.1
# Decisions come when something arrives, not on the tick.
_EARLY_S = 0.005
Box = tuple[float, float, float, float]


class AppliedRows:
    """Makes rows of some decisions, and keeps the box around their places."""

    def __init__(self, frame: LocalFrame, time_text: Callable[[float], str | None]) -> None:
        # A projection of its own: pyproj's are not to be shared between threads.
        self._frame = LocalFrame(frame.latitude_deg, frame.longitude_deg)
        self._time_text = time_text
        self._last_s = -math.inf
        self._told: tuple[frozenset[Inhibit], SprayerState] | None = None
        self.box: Box | None = None

    def take(self, sequence: int, decision: Decision) -> tuple[object, ...] | None:
        """Return the row of a decision; None where none is due."""
        told = (decision.inhibits, decision.sprayer)
        since_s = decision.now_s - self._last_s
        if told == self._told and 0.0 <= since_s < EVERY_S - _EARLY_S:
            return None
        self._told, self._last_s = told, decision.now_s
        return self._row(sequence, decision)

    def _row(self, sequence: int, decision: Decision) -> tuple[object, ...]:
        state, duty = decision.state, decision.plan.duty
        rates = [rate for rate in decision.rate_l_ha if rate is not None]
        motion: tuple[float | None, ...] = (None, None, None, None)
        if state is not None:
            east, north = state.velocity_east_m_s, state.velocity_north_m_s
            speed_m_s = math.hypot(east, north)
            motion = (speed_m_s, course_deg(east, north), state.heading_deg, state.height_m)
        return (
            sequence,
            None if state is None else self._point(state),
            self._time_text(decision.now_s),
            decision.now_s,
            sum(rates) / len(rates) if rates else None,
            decision.target_flow_l_min,
            decision.flow_l_min,
            sum(duty) / len(duty) if duty else 0.0,
            *motion,
            " ".join(sorted(decision.inhibits)),
            _short(decision.rate_l_ha),
        )

    def _point(self, state: VehicleState) -> bytes | None:
        latitude, longitude = self._frame.to_geographic(state.east_m, state.north_m)
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
            return None
        west, south, east, north = self.box or (longitude, latitude, longitude, latitude)
        self.box = (
            min(west, longitude),
            min(south, latitude),
            max(east, longitude),
            max(north, latitude),
        )
        return point_blob(longitude, latitude)


def _short(values: Sequence[float | None]) -> str:
    """Return one value a valve; one alone where all are the same, as they mostly are."""
    rounded = [None if value is None else round(value, 4) for value in values]
    return json.dumps(rounded[:1] if len(set(rounded)) == 1 else rounded, separators=(",", ":"))


# Which time of day it is: by this computer at first, by the autopilot as soon as it says so.
#
# A board without a clock of its own wakes in 1970 or where it was switched off; the autopilot has
# the time of the satellites. Pure: times are arguments.

# What differs by more is another time, and not the way of a message.
JUMP_S = 1.0
# So many times of day are counted; one that reports name seldom gives way.
TIMES_MAX = 8


@dataclass(slots=True, eq=False)
class _Time:
    offset_s: float
    reports: int = 0


class FlightClock:
    """Makes a time since 1970 of the companion's monotonic one.

    Of the autopilot's reports the one counts that was shortest on its way: delays only ever make
    its clock look slow. Where its time jumps, as at the end of a week of GPS, that time counts
    which most of its reports name, and nobody vouches for it.
    """

    def __init__(self, offset_s: float) -> None:
        self.offset_s = offset_s
        self.source = "computer"
        self.known_s: float | None = None  # what was written before gets its time at the end
        self._times: list[_Time] = []
        self._last = _Time(offset_s)

    def take(self, report: UtcReport) -> str | None:
        """Take a report; return what is to be said of it, None where it only agrees."""
        offset_s = report.utc_s - report.received_s
        if not abs(offset_s) < float("inf"):
            return None
        before, own = self._last, self._time_of(offset_s)
        own.reports += 1
        used = max(self._times, key=lambda each: each.reports)
        said = None
        if self.known_s is None:
            self.source, text = "autopilot", time_text(report.utc_s)
            off_s = self.offset_s - offset_s
            said = f"the autopilot says {text}; this computer's clock was {off_s:+.1f} s off"
        elif own is not before:
            self.source = "autopilot-jumped"
            said = f"the autopilot's time of day jumped by {own.offset_s - before.offset_s:+.1f} s"
        elif abs(used.offset_s - self.offset_s) > JUMP_S:
            said = f"most of the autopilot's reports say {time_text(report.utc_s)}"
        if said is not None:
            self.known_s = report.received_s
        self._last, self.offset_s = own, used.offset_s
        return said

    def _time_of(self, offset_s: float) -> _Time:
        """Return the time of day that a report names, by its offset."""
        for each in self._times:
            if abs(offset_s - each.offset_s) <= JUMP_S:
                each.offset_s = max(each.offset_s, offset_s)
                return each
        if len(self._times) == TIMES_MAX:
            self._times.remove(min(self._times, key=lambda each: each.reports))
        self._times.append(_Time(offset_s))
        return self._times[-1]

    def text(self, at_s: float) -> str | None:
        """Return a monotonic time as UTC; None for what is no time."""
        return time_text(at_s + self.offset_s)


# Treated ground: one row a tile, only those that changed (`coverage.py` reads them).

_TILES_TABLE = (
    "CREATE TABLE IF NOT EXISTS coverage_tiles (id INTEGER PRIMARY KEY NOT NULL, "
    "kind TEXT NOT NULL, tile_east INTEGER NOT NULL, tile_north INTEGER NOT NULL, "
    "cells BLOB NOT NULL, UNIQUE (kind, tile_east, tile_north))",
    "INSERT OR IGNORE INTO gpkg_contents (table_name, data_type, identifier, description) VALUES "
    f"('coverage_tiles', 'attributes', 'coverage_tiles', 'treated ground: {TILE_CELLS} x "
    f"{TILE_CELLS} cells of {CELL_M} m a row, one bit each, deflated')",
)
_PUT_TILE = (
    "INSERT INTO coverage_tiles (kind, tile_east, tile_north, cells) VALUES (?, ?, ?, ?) "
    "ON CONFLICT (kind, tile_east, tile_north) DO UPDATE SET cells = excluded.cells"
)
_DROP_TILE = "DELETE FROM coverage_tiles WHERE kind = ? AND tile_east = ? AND tile_north = ?"
COVERAGE_AHEAD_KEY = "coverage_ahead_s"


def write_coverage(
    connection: sqlite3.Connection, coverage: Coverage, before: Coverage | None
) -> None:
    """Write what differs from `before`, the coverage that was written last.

    Within the caller's transaction. A tile that is the same object as before is not touched.
    """
    _write_tiles(connection, "flight", coverage, before)
    connection.execute(SET_META, (COVERAGE_AHEAD_KEY, repr(coverage.ahead_s)))


def write_treated(connection: sqlite3.Connection, treated: Coverage | None) -> None:
    """Write what earlier flights treated; nothing for a flight that begins on bare ground."""
    if treated is not None:
        _write_tiles(connection, "before", treated, None)


def _write_tiles(
    connection: sqlite3.Connection,
    kind: Literal["before", "flight"],
    coverage: Coverage,
    before: Coverage | None,
) -> None:
    for sql in _TILES_TABLE if before is None else ():
        connection.execute(sql)
    last = {} if before is None else before.tiles
    if coverage.tiles is last:
        return
    connection.executemany(
        _PUT_TILE,
        (
            (kind, *key, zlib.compress(tile, level=1))
            for key, tile in coverage.tiles.items()
            if last.get(key) is not tile
        ),
    )
    gone = [(kind, *key) for key in last if key not in coverage.tiles]
    connection.executemany(_DROP_TILE, gone)
