"""Reads a journal into arrays: the one way from a file to an `AppliedFlight`.

What was applied, ten times a second, is in a table of the journal; of the inputs only those of
sensors are decoded. Where rows are missing the valves count as closed (`analysis.flown.holes`).
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, partial
from operator import methodcaller
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from analysis.flown.applied_flight import AppliedFlight, ClockSource, Floats, Ints, ValveChanges
from analysis.flown.holes import (
    Hole,
    change_holes,
    closed_over,
    doubtful_holes,
    marked,
    sample_holes,
    unknown_times,
    within,
)
from analysis.flown.sensor_series import WIND_FROM, sensors_of
from analysis.journals.content import damages, read_entries
from companion.core.setup import Setup
from companion.core.types import Decision
from companion.errors import UnreadableError
from companion.journal.codec import FieldNames, decode, field_names_of
from companion.journal.reader import OpenJournal, migrated, opened
from companion.journal.rows import ValveRows
from companion.journal.writer import Event

# Which rows of a journal's tables can be believed, row by row: the rest is left out and counted.
#
# A damaged file may hold anything in any column; what is used must be a number where one is due.

# A point as the journal writes it: 8 bytes of the GeoPackage, then WKB, little-endian.
POINT_BYTES = 29
PERMILLE_MAX = 1000
# The year 2200: what lies behind it, or before 1970, no calendar of an export can write.
OFFSET_S_MAX = 7.26e9


def sound_rows(
    rows: list[Row], is_sound: Callable[[Row], bool], unread: list[str] | None, what: str
) -> list[Row]:
    """Return the rows to be believed; ValueError without `unread` where some are not."""
    found = [row for row in rows if is_sound(row)]
    bad = len(rows) - len(found)
    if bad:
        text = f"{bad} {what}: what is in them is no such thing"
        if unread is None:
            raise ValueError(text)
        unread.append(text)
    return found


def is_change(row: Row, valves: int) -> bool:
    """Whether a row (id, planned_us, actual_us, valve, duty_permille) is a change of a valve."""
    _, planned, actual, valve, duty = row
    return (
        type(valve) is int
        and 0 <= valve < valves
        and type(duty) is int
        and 0 <= duty <= PERMILLE_MAX
        and (planned is None or type(planned) is int)
        and (actual is None or type(actual) is int)
        and not (planned is None and actual is None)
    )


def is_sample(row: Row) -> bool:
    """Whether a row (sequence, geom, time_s, six numbers, inhibits, rates) is a sample."""
    _, geom, time_s, *numbers, inhibits, _ = row
    return (
        (geom is None or (isinstance(geom, bytes) and len(geom) == POINT_BYTES))
        and isinstance(time_s, float)
        and math.isfinite(time_s)
        and all(each is None or isinstance(each, (int, float)) for each in numbers)
        and (inhibits is None or isinstance(inhibits, str))
    )


def is_event(row: Row) -> bool:
    """Whether a row (sequence, time_s, kind, text) is an event."""
    _, at_s, kind, text = row
    return (
        (at_s is None or isinstance(at_s, (int, float)))
        and isinstance(kind, str)
        and isinstance(text, str)
    )


def rates_of(text: object, valves: int) -> list[float] | None:
    """Return the rate of every valve, NaN where none is prescribed; None where it is no list.

    >>> rates_of("[20.5]", 2), rates_of('["x"]', 2)
    ([20.5, 20.5], None)
    """
    if text is not None and not isinstance(text, str):
        return None
    try:
        found: Any = json.loads(text) if text else [None]
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, list) or len(found) not in (1, valves):
        return None
    if not all(each is None or type(each) in (int, float) for each in found):
        return None
    values = [math.nan if each is None else float(each) for each in found]
    return values if len(values) == valves else values * valves


def clock_offset_s(
    given: object, started: Sequence[str], path: object, unread: list[str] | None
) -> float:
    """Return seconds from the companion's clock to UTC: the given one, or that of the start.

    `started` is the same by the computer's clock; UnreadableError where neither is a time.
    """
    if _is_offset(given):
        return float(str(given))
    sound = [each for each in started if _is_offset(each)]
    if sound and unread is not None:
        unread.append("the time in UTC is none: that of the start of the record stands")
        return float(sound[0])
    raise UnreadableError(f"{path}: is damaged: the time in UTC ({str(given)[:20]}) is none")


def _is_offset(value: object) -> bool:
    try:
        return 0.0 <= float(str(value)) <= OFFSET_S_MAX
    except ValueError:
        return False


_NAN = float("nan")


def read_applied(path: Path, *, unread: list[str] | None = None) -> AppliedFlight:
    """Return the flight in `path`; JournalError, in one line, where it cannot be read.

    With `unread` a damaged journal is read as far as it goes, and what is missing is said there:
    also what is damaged in a part of the file that a flight is not made of.
    """
    with opened(path, is_lenient=unread is not None) as journal:
        if unread is not None:
            unread += journal.unread
            unread += damages(journal.connection)
        return flight_of(journal, journal.setup(unread), unread)


def flight_of(journal: OpenJournal, setup: Setup, unread: list[str] | None) -> AppliedFlight:
    """Return the flight in an open journal, whose `setup` was read; `unread` as above."""
    if unread is not None:
        # A byte that is no text makes one word wrong and not a whole table.
        journal.connection.text_factory = methodcaller("decode", "utf-8", "replace")
    meta = journal.meta
    names = _names_of(meta["setup"])
    applied = read_samples(journal, len(setup.boom.valves), unread)
    time_s, target, flow, speed, course, heading, height = applied.columns
    latitude_deg, longitude_deg = applied.place["lat"].copy(), applied.place["lon"].copy()
    east_m, north_m = setup.frame.to_local_all(latitude_deg.tolist(), longitude_deg.tolist())
    sensors, receiver = sensors_of(journal, names, unread)
    events = _events(journal, unread)
    changes, missing = read_changes(journal, len(setup.boom.valves), names, unread)
    flight = AppliedFlight(
        path=journal.path,
        meta=meta,
        setup=setup,
        is_closed=meta.get("closed") == "yes",
        lost=_lost(journal, len(events)) + applied.missing + sum(hole.rows for hole in missing),
        events=events,
        utc_offset_s=clock_offset_s(
            meta.get("utc_offset_s"), _at_start(meta), journal.path, unread
        ),
        utc_source=_source(meta["utc_source"]),
        time_s=time_s,
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        east_m=east_m,
        north_m=north_m,
        height_m=height,
        speed_m_s=speed,
        course_deg=course,
        heading_deg=heading,
        rate_l_ha=applied.rate_l_ha,
        target_flow_l_min=target,
        flow_l_min=flow,
        inhibits=applied.inhibits,
        changes=changes,
        meter_ml=sensors["FlowReport"],
        pressure_kpa=sensors["PressureReport"],
        tank_l=sensors["TankReport"],
        wind_m_s=sensors["WindReport"],
        wind_from_deg=sensors[WIND_FROM],
        fix=sensors["GnssReport"],
        receiver=receiver,
    )
    return _mended(flight, applied.holes, missing, unread)


# Journals of one version have the same names; those of one machine the same text.
_names_of = lru_cache(maxsize=4)(field_names_of)


def _mended(
    flight: AppliedFlight, samples: list[Hole], missing: list[Hole], unread: list[str] | None
) -> AppliedFlight:
    """Return the flight with closed valves, and a mark, where rows are missing."""
    changes = flight.changes
    if flight.setup.pumping is None and flight.meta.get("journal_version") != "1":
        # Where a pump makes the flow, sections may stay open without any.
        closed = closed_over(changes, (), missing)
        missing = [*missing, *doubtful_holes(closed, flight.time_s, flight.flow_l_min)]
    if not samples and not missing:
        return flight
    texts = [hole.text("samples") for hole in samples]
    texts += [hole.text("valve changes") for hole in missing]
    if unread is not None:
        unread.extend(texts)
    unseen = within(flight.time_s, samples)
    return replace(
        flight,
        # Of a hole without numbers nobody knows how many rows it had: one at least.
        lost=flight.lost + sum(not hole.rows for hole in [*samples, *missing]),
        changes=closed_over(changes, samples, missing),
        # A pump would go on over the gap as the last sample before it says.
        flow_l_min=np.where(unseen, 0.0, flight.flow_l_min),
        inhibits=marked(flight.inhibits, unseen | within(flight.time_s, missing)),
        unknown=unknown_times(
            flight.changes, samples, missing, valves=len(flight.setup.boom.valves)
        ),
    )


def _source(text: str) -> ClockSource:
    return next((each for each in get_args(ClockSource) if each == text), "computer")


def _at_start(meta: dict[str, str]) -> list[str]:
    """Return the offset to UTC by the computer's clock at the start, if there is one."""
    try:
        without = {key: value for key, value in meta.items() if key != "utc_offset_s"}
        return [migrated(without)["utc_offset_s"]]
    except (KeyError, ValueError):
        return []


def _events(journal: OpenJournal, unread: list[str] | None) -> tuple[Event, ...]:
    found = rows_of(
        journal.connection,
        "events",
        "time_s, kind, text",
        key="sequence",
        unread=unread,
        what="events",
    )
    return tuple(
        # SQLite keeps no NaN: a time that was none comes back as missing.
        Event(at_s=_NAN if at_s is None else float(at_s), kind=kind, text=text)
        for _, at_s, kind, text in sound_rows(found.rows, is_event, unread, "events")
    )


def _lost(journal: OpenJournal, events: int) -> int:
    """Return how many rows are missing: of their numbers, or as the writer counted."""
    table = (
        "SELECT max(sequence), count(*) FROM records"
        if journal.version == "1"
        else "SELECT max(last_sequence), sum(row_count) FROM blocks"
    )
    counted = int(journal.meta["lost"])
    try:
        last, rows = journal.connection.execute(table).fetchone()
        (other,) = journal.connection.execute("SELECT max(sequence) FROM events").fetchone()
    except sqlite3.DatabaseError:
        return counted
    return max(max(last or 0, other or 0) - (rows or 0) - events, counted)


# The changes of the valves in a journal, and where some of them are missing.

_MICRO = 1e-6
_COLUMNS = "planned_us, actual_us, valve, duty_permille"


def read_changes(
    journal: OpenJournal, valves: int, names: FieldNames, unread: list[str] | None
) -> tuple[ValveChanges, list[Hole]]:
    """Return the changes of all valves in the order of time in which they came about.

    A journal of version 1 has no table of them: there they are worked out from its decisions.
    """
    what = "valve changes"
    if journal.version == "1":
        made = enumerate_rows(_planned(journal, names, unread))
        return _in_order(_table(list(made))), []
    found = rows_of(
        journal.connection, "valve_changes", _COLUMNS, key="id", unread=unread, what=what
    )
    table = _table(sound_rows(found.rows, partial(is_change, valves=valves), unread, what))
    changes = _changes(table)
    holes = change_holes(
        table[0].astype(np.int64),
        np.where(np.isnan(changes.actual_s), changes.planned_s, changes.actual_s),
        int(journal.meta.get("rows_valve_changes") or 0),
        reaches_end=found.reaches_end,
    )
    return _in_order(table), holes


def enumerate_rows(rows: Iterator[tuple[int | None, int | None, int, int]]) -> Iterator[Row]:
    """Yield rows with a number before each, from 1."""
    return ((number, *row) for number, row in enumerate(rows, start=1))


def _table(rows: Sequence[Row]) -> Floats:
    """Return the columns of changes as numbers; NaN is what is missing."""
    return np.array(rows, dtype=np.float64).reshape(-1, 5).T


def _changes(table: Floats) -> ValveChanges:
    planned_s, actual_s = table[1] * _MICRO, table[2] * _MICRO
    return ValveChanges(
        # What no plan asked for (a fault that closed) has its real time only.
        planned_s=np.where(np.isnan(planned_s), actual_s, planned_s),
        actual_s=actual_s,
        valve=table[3].astype(np.int64),
        duty=table[4] / 1000.0,
    )


def _in_order(table: Floats) -> ValveChanges:
    at_us = np.where(np.isnan(table[2]), table[1], table[2])
    order = np.argsort(at_us, kind="stable")
    # Most are in order as they were planned.
    return _changes(table[:, order] if (np.diff(order) < 0).any() else table)


def _planned(
    journal: OpenJournal, names: FieldNames, unread: list[str] | None
) -> Iterator[tuple[int | None, int | None, int, int]]:
    made = ValveRows()
    entries = read_entries(
        journal.connection, journal.version, kinds={Decision.__name__}, unread=unread
    )
    for entry in entries:
        decision = decode(entry.body, names)
        if isinstance(decision, Decision):
            yield from made.take_plan(decision.plan)
    yield from made.end()


# The table `applied` of a journal in columns, and where rows of it are missing.

_APPLIED = """geom, time_s, target_flow_l_min, flow_l_min, speed_m_s, course_deg, heading_deg,
           height_m, inhibits, valve_rates_l_ha"""
# A point as the journal writes it: 8 bytes of the GeoPackage, then WKB, little-endian.
_POINT = np.dtype(
    [("head", f"V{POINT_BYTES - 21}"), ("order", "u1"), ("kind", "<u4"), ("lon", "<f8"),
     ("lat", "<f8")]
)  # fmt: skip


class Samples(NamedTuple):
    """The rows of the table `applied`, in columns; `holes` are where rows are missing."""

    place: NDArray[np.void]
    columns: Floats
    inhibits: tuple[str, ...]
    rate_l_ha: Floats
    holes: list[Hole]
    missing: int


def read_samples(journal: OpenJournal, valves: int, unread: list[str] | None) -> Samples:
    """Return all samples with a position, in the order of their times."""
    found = rows_of(
        journal.connection, "applied", _APPLIED, key="sequence", unread=unread, what="samples"
    )
    rates: dict[object, list[float] | None] = {}
    for row in found.rows:
        # Rows of one rate for all valves are one text, and there are few rates.
        if row[-1] not in rates:
            rates[row[-1]] = rates_of(row[-1], valves)
    rows = sound_rows(
        found.rows, lambda row: is_sample(row) and rates[row[-1]] is not None, unread, "samples"
    )
    sequence: Ints = np.array([row[0] for row in rows], dtype=np.int64)
    holes = sample_holes(
        sequence, np.array([row[2] for row in rows], dtype=np.float64), _ends(journal)
    )
    count = int(journal.meta.get("rows_applied") or 0)
    placed = [row for row in rows if row[1] is not None]
    place = np.frombuffer(b"".join([row[1] for row in placed]), dtype=_POINT)
    columns = np.array([row[2:9] for row in placed], dtype=np.float64).reshape(-1, 7).T
    sound = np.isfinite(place["lat"]) & np.isfinite(place["lon"])
    order = np.flatnonzero(sound)[np.argsort(columns[0, sound], kind="stable")]
    return Samples(
        place=place[order],
        columns=np.ascontiguousarray(columns[:, order]),
        inhibits=tuple(_in_order_of_names(placed[i][9] or "") for i in order.tolist()),
        rate_l_ha=np.array(
            [rates[placed[i][-1]] for i in order.tolist()], dtype=np.float64
        ).reshape(-1, valves),
        holes=holes,
        missing=max(count - len(rows), 0),
    )


@lru_cache(maxsize=1024)
def _in_order_of_names(reasons: str) -> str:
    return " ".join(sorted(reasons.split()))


def _ends(journal: OpenJournal) -> Sequence[tuple[float, float]]:
    """Return number and time of the first and the last of all entries; nothing where unknown."""
    if journal.version == "1":
        return ()
    found = []
    for sql in (
        "SELECT first_sequence, from_s FROM blocks ORDER BY first_sequence LIMIT 1",
        "SELECT last_sequence, until_s FROM blocks ORDER BY first_sequence DESC LIMIT 1",
    ):
        try:
            row = journal.connection.execute(sql).fetchone()
        except sqlite3.DatabaseError:
            continue
        if row is not None and isinstance(row[0], int) and isinstance(row[1], float):
            found.append((float(row[0]), row[1]))
    return found


# Rows of a table in the order of their numbers, read around pages that are damaged.

Row = tuple[Any, ...]

# Numbers behind damage are looked for so far; then the table counts as ended there.
_POWERS = 40
# A file with more damaged places than this is not worth the search.
_BREAKS_MAX = 1000


class TableRows(NamedTuple):
    """Rows, their number first; `reaches_end` is false where the last ones cannot be read."""

    rows: list[Row]
    reaches_end: bool


class _Query(NamedTuple):
    connection: sqlite3.Connection
    sql: str

    def is_readable(self, after: int) -> bool:
        """Whether the first row behind a number, if there is one, can be read."""
        try:
            self.connection.execute(f"{self.sql} LIMIT 1", (after,)).fetchone()
        except sqlite3.DatabaseError:
            return False
        return True

    def next_readable(self, last: int) -> int | None:
        """Return the least number behind `last` from which rows can be read again."""
        beyond = (last + 2**power for power in range(_POWERS))
        good: int | None = next((each for each in beyond if self.is_readable(each)), None)
        if good is None:
            return None
        bad = last + (good - last) // 2
        while good - bad > 1:
            middle = (good + bad) // 2
            good, bad = (middle, bad) if self.is_readable(middle) else (good, middle)
        return good


def rows_of(
    connection: sqlite3.Connection,
    table: str,
    columns: str,
    *,
    key: str,
    unread: list[str] | None,
    what: str,
) -> TableRows:
    """Return all rows that can be read; without `unread` damage is a sqlite3.DatabaseError."""
    query = _Query(connection, f"SELECT {key}, {columns} FROM {table} WHERE {key} > ? ORDER BY 1")
    rows: list[Row] = []
    after = -1
    with suppress(sqlite3.DatabaseError):
        return TableRows(connection.execute(query.sql, (after,)).fetchall(), reaches_end=True)
    for _ in range(_BREAKS_MAX):
        try:
            for row in connection.execute(query.sql, (after,)):
                rows.append(row)
        except sqlite3.DatabaseError as error:
            if unread is None or "locked" in str(error):
                raise
            last = max(int(rows[-1][0]) if rows else -1, after)
            behind = query.next_readable(last)
            span = f"behind {max(last, 0)}" + ("" if behind is None else f" up to {behind}")
            unread.append(f"{what} {span}: {' '.join(str(error).split())}")
            if behind is None:
                return TableRows(rows, reaches_end=False)
            after = behind
        else:
            return TableRows(rows, reaches_end=True)
    return TableRows(rows, reaches_end=False)
