"""Reads a journal into arrays: the one way from a file to an `AppliedFlight`.

What was applied, ten times a second, is in a table of the journal; of the inputs only those of
sensors are decoded. Where rows are missing the valves count as closed (`analysis.flown.holes`).
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from analysis.flown.applied_flight import AppliedFlight, Series
from analysis.flown.holes import (
    Hole,
    closed_over,
    doubtful_holes,
    marked,
    within,
)
from analysis.flown.read_changes import read_changes
from analysis.flown.read_samples import read_samples
from analysis.flown.sound_rows import (
    clock_offset_s,
    is_event,
    sound_rows,
)
from analysis.flown.table_rows import rows_of
from analysis.flown.unknown import unknown_times
from companion.record.blocks import Entry
from companion.record.codec import FieldNames
from companion.record.events import Event
from companion.record.reader import OpenJournal, opened
from companion.record.setup_json import field_names_of
from companion.record.versions import migrated, read_entries
from companion.record.whole_file import damages

_NAN = float("nan")
PARSED_AT_ONCE = 1000
# Which value of which sensor's message becomes a series, and which field tells a fault.
_SENSORS = {
    "FlowReport": ("volume_ml", "fault"),
    "PressureReport": ("pressure_kpa", None),
    "TankReport": ("level_l", None),
    "WindReport": ("speed_m_s", None),
}


def read_applied(path: Path, *, unread: list[str] | None = None) -> AppliedFlight:
    """Return the flight in `path`; JournalError, in one line, where it cannot be read.

    With `unread` a damaged journal is read as far as it goes, and what is missing is said there:
    also what is damaged in a part of the file that a flight is not made of.
    """
    with opened(path, is_lenient=unread is not None) as journal:
        if unread is not None:
            # A byte that is no text makes one word wrong and not a whole table.
            journal.connection.text_factory = lambda raw: raw.decode("utf-8", errors="replace")
            unread += journal.unread
            unread += damages(journal.connection)
        return _flight(journal, unread)


def _flight(journal: OpenJournal, unread: list[str] | None) -> AppliedFlight:
    setup, meta = journal.setup(unread), journal.meta
    names = field_names_of(meta["setup"])
    applied = read_samples(journal, len(setup.boom.valves), unread)
    time_s, target, flow, speed, course, heading, height = applied.columns
    latitude_deg, longitude_deg = applied.place["lat"].copy(), applied.place["lon"].copy()
    east_m, north_m = setup.frame.to_local_all(latitude_deg.tolist(), longitude_deg.tolist())
    sensors = _sensors(journal, names, unread)
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
    )
    return _mended(flight, applied.holes, missing, unread)


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


def _source(text: str) -> Literal["autopilot", "computer"]:
    return "autopilot" if text == "autopilot" else "computer"


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


def _sensors(
    journal: OpenJournal, names: FieldNames, unread: list[str] | None
) -> dict[str, Series | None]:
    pairs: dict[str, list[tuple[float, float | None]]] = {kind: [] for kind in _SENSORS}
    places = {
        kind: tuple(names[kind].index(name) if name else -1 for name in ("received_s", *wanted))
        for kind, wanted in _SENSORS.items()
        if kind in names
    }
    try:
        entries = read_entries(
            journal.connection, journal.version, kinds=places.keys(), unread=unread
        )
        for kind, values in _messages(entries):
            at, value, fault = places[kind]
            is_sound = fault < 0 or not values[fault]
            pairs[kind].append((values[at], values[value] if is_sound else None))
    except sqlite3.DatabaseError as error:
        if unread is None or "locked" in str(error):
            raise
        unread.append(f"what sensors said behind a damaged place: {' '.join(str(error).split())}")
    return {kind: _series(rows) for kind, rows in pairs.items()}


def _messages(entries: Iterator[Entry]) -> Iterator[tuple[str, list[Any]]]:
    """Yield the kind and the values of each message; many are parsed at once, which is quicker."""
    several: list[Entry] = []
    try:
        for entry in entries:
            several.append(entry)
            if len(several) == PARSED_AT_ONCE:
                yield from _parsed(several)
                several = []
    except sqlite3.DatabaseError:
        yield from _parsed(several)
        raise
    yield from _parsed(several)


def _parsed(entries: list[Entry]) -> Iterator[tuple[str, list[Any]]]:
    messages = json.loads(f"[{','.join(entry.body for entry in entries)}]")
    for entry, message in zip(entries, messages, strict=True):
        ((_, values),) = message.items()
        yield entry.kind, values


def _series(rows: list[tuple[float, float | None]]) -> Series | None:
    if not rows:
        return None
    time_s, value = np.array(rows, dtype=np.float64).T
    order = np.argsort(time_s, kind="stable")
    return Series(time_s=time_s[order], value=value[order])
