"""Reads a journal into arrays: the one way from a file to an `AppliedFlight`.

What was applied, ten times a second, is in a table of the journal; of the inputs only those of
sensors are decoded. A journal of version 1 has no table of valve changes: there they are worked
out from its decisions.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.flown.applied_flight import AppliedFlight, Floats, Series, ValveChanges
from companion.core.controller import Setup
from companion.core.types import Decision
from companion.errors import JournalError
from companion.record.codec import FieldNames, decode
from companion.record.events import Event
from companion.record.reader import OpenJournal, opened
from companion.record.setup_json import field_names_of
from companion.record.valve_rows import Row, ValveRows
from companion.record.versions import read_entries

_NAN = float("nan")
_MICRO = 1e-6
_APPLIED = """
    SELECT geom, time_s, target_flow_l_min, flow_l_min, speed_m_s, course_deg, heading_deg,
           height_m, inhibits, valve_rates_l_ha
    FROM applied WHERE geom IS NOT NULL ORDER BY sequence
"""
# A point as the journal writes it: 8 bytes of the GeoPackage, then WKB, little-endian.
_POINT = np.dtype(
    [("head", "V8"), ("order", "u1"), ("kind", "<u4"), ("lon", "<f8"), ("lat", "<f8")]
)
# Which value of which sensor's message becomes a series, and which field tells a fault.
_SENSORS = {
    "FlowReport": ("volume_ml", "fault"),
    "PressureReport": ("pressure_kpa", None),
    "TankReport": ("level_l", None),
    "WindReport": ("speed_m_s", None),
}


def read_applied(path: Path, *, unread: list[str] | None = None) -> AppliedFlight:
    """Return the flight in `path`; JournalError, in one line, where it cannot be read.

    With `unread` a damaged journal is read as far as it goes, and what is missing is said there.
    """
    with opened(path, is_lenient=unread is not None) as journal:
        return _flight(journal, unread)


class _Applied(NamedTuple):
    """The rows of the table `applied`, in columns."""

    place: NDArray[np.void]
    columns: Floats
    inhibits: tuple[str, ...]
    rate_l_ha: Floats


def _flight(journal: OpenJournal, unread: list[str] | None) -> AppliedFlight:
    setup, meta = journal.setup(), journal.meta
    names = field_names_of(meta["setup"])
    applied = _applied(journal, len(setup.boom.valves), unread)
    time_s, target, flow, speed, course, heading, height = applied.columns
    latitude_deg, longitude_deg = applied.place["lat"].copy(), applied.place["lon"].copy()
    east_m, north_m = setup.frame.to_local_all(latitude_deg.tolist(), longitude_deg.tolist())
    sensors = _sensors(journal, names, unread)
    events = _events(journal, unread)
    return AppliedFlight(
        path=journal.path,
        meta=meta,
        setup=setup,
        is_closed=meta.get("closed") == "yes",
        lost=_lost(journal, len(events)),
        events=events,
        utc_offset_s=float(meta["utc_offset_s"]),
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
        changes=_changes(journal, setup, names, unread),
        meter_ml=sensors["FlowReport"],
        pressure_kpa=sensors["PressureReport"],
        tank_l=sensors["TankReport"],
        wind_m_s=sensors["WindReport"],
    )


def _source(text: str) -> Literal["autopilot", "computer"]:
    return "autopilot" if text == "autopilot" else "computer"


def _applied(journal: OpenJournal, valves: int, unread: list[str] | None) -> _Applied:
    rows = list(_rows(journal.connection, _APPLIED, unread, "samples"))
    sound = [row for row in rows if len(row[0]) == _POINT.itemsize]
    place = np.frombuffer(b"".join(row[0] for row in sound), dtype=_POINT)
    columns = np.array([row[1:8] for row in sound], dtype=np.float64).reshape(-1, 7).T
    # Rows of one rate for all valves are one text, and there are few rates.
    known: dict[str, Floats] = {}
    rates = np.empty((len(sound), valves))
    for i, row in enumerate(sound):
        text = row[9]
        found = known.get(text)
        if found is None:
            found = known[text] = np.array(json.loads(text or "[null]"), dtype=np.float64)
        rates[i] = found
    order = np.argsort(columns[0], kind="stable")
    return _Applied(
        place=place[order],
        columns=np.ascontiguousarray(columns[:, order]),
        inhibits=tuple(" ".join(sorted((sound[i][8] or "").split())) for i in order.tolist()),
        rate_l_ha=rates[order],
    )


def _rows(
    connection: sqlite3.Connection, sql: str, unread: list[str] | None, what: str
) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a query; where the file is damaged, those before it."""
    count = 0
    try:
        for row in connection.execute(sql):
            count += 1
            yield row
    except sqlite3.DatabaseError as error:
        if unread is None:
            raise
        unread.append(f"{what} behind the first {count}: {' '.join(str(error).split())}")


def _events(journal: OpenJournal, unread: list[str] | None) -> tuple[Event, ...]:
    sql = "SELECT time_s, kind, text FROM events ORDER BY sequence"
    return tuple(
        # SQLite keeps no NaN: a time that was none comes back as missing.
        Event(at_s=_NAN if at_s is None else at_s, kind=kind, text=text)
        for at_s, kind, text in _rows(journal.connection, sql, unread, "events")
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


def _sensors(
    journal: OpenJournal, names: FieldNames, unread: list[str] | None
) -> dict[str, Series | None]:
    pairs: dict[str, list[tuple[float, float | None]]] = {kind: [] for kind in _SENSORS}
    places = {
        kind: tuple(names[kind].index(name) if name else -1 for name in ("received_s", *wanted))
        for kind, wanted in _SENSORS.items()
        if kind in names
    }
    entries = read_entries(journal.connection, journal.version, kinds=places.keys(), unread=unread)
    for entry in entries:
        ((_, values),) = json.loads(entry.body).items()
        at, value, fault = places[entry.kind]
        is_sound = fault < 0 or not values[fault]
        pairs[entry.kind].append((values[at], values[value] if is_sound else None))
    return {kind: _series(rows) for kind, rows in pairs.items()}


def _series(rows: list[tuple[float, float | None]]) -> Series | None:
    if not rows:
        return None
    time_s, value = np.array(rows, dtype=np.float64).T
    order = np.argsort(time_s, kind="stable")
    return Series(time_s=time_s[order], value=value[order])


def _changes(
    journal: OpenJournal, setup: Setup, names: FieldNames, unread: list[str] | None
) -> ValveChanges:
    """Return the changes of all valves in the order of time in which they came about."""
    if journal.version == "1":
        rows: list[Row] = list(_planned(journal, names, unread))
    else:
        sql = "SELECT planned_us, actual_us, valve, duty_permille FROM valve_changes ORDER BY id"
        rows = list(_rows(journal.connection, sql, unread, "valve changes"))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    planned_s, actual_s = table[:, 0] * _MICRO, table[:, 1] * _MICRO
    valve = table[:, 2].astype(np.int64)
    if len(valve) and not (valve.min() >= 0 and valve.max() < len(setup.boom.valves)):
        raise JournalError(f"{journal.path}: is damaged: a change of a valve that does not exist")
    # What no plan asked for (a fault that closed) has its real time only.
    planned_s = np.where(np.isnan(planned_s), actual_s, planned_s)
    order = np.argsort(np.where(np.isnan(actual_s), planned_s, actual_s), kind="stable")
    return ValveChanges(
        planned_s=planned_s[order],
        actual_s=actual_s[order],
        valve=valve[order],
        duty=table[order, 3] / 1000.0,
    )


def _planned(journal: OpenJournal, names: FieldNames, unread: list[str] | None) -> Iterator[Row]:
    made = ValveRows()
    entries = read_entries(
        journal.connection, journal.version, kinds={Decision.__name__}, unread=unread
    )
    for entry in entries:
        decision = decode(entry.body, names)
        if isinstance(decision, Decision):
            yield from made.take_plan(decision.plan)
    yield from made.end()
