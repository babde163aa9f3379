"""The changes of the valves in a journal, and where some of them are missing."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from analysis.flown.applied_flight import ValveChanges
from analysis.flown.holes import Hole, change_holes
from analysis.flown.sound_rows import is_change, sound_rows
from analysis.flown.table_rows import Row, rows_of
from companion.core.types import Decision
from companion.record.codec import FieldNames, decode
from companion.record.reader import OpenJournal
from companion.record.valve_rows import ValveRows
from companion.record.versions import read_entries

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
        rows: list[Row] = list(enumerate_rows(_planned(journal, names, unread)))
        return _in_order(_table(rows)), []
    found = rows_of(
        journal.connection, "valve_changes", _COLUMNS, key="id", unread=unread, what=what
    )
    rows = sound_rows(found.rows, partial(is_change, valves=valves), unread, what)
    table = _table(rows)
    changes = _changes(table)
    holes = change_holes(
        table[:, 0].astype(np.int64),
        np.where(np.isnan(changes.actual_s), changes.planned_s, changes.actual_s),
        int(journal.meta.get("rows_valve_changes") or 0),
        reaches_end=found.reaches_end,
    )
    return _in_order(table), holes


def enumerate_rows(rows: Iterator[tuple[int | None, int | None, int, int]]) -> Iterator[Row]:
    """Yield rows with a number before each, from 1."""
    return ((number, *row) for number, row in enumerate(rows, start=1))


def _table(rows: list[Row]) -> np.ndarray:
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def _changes(table: np.ndarray) -> ValveChanges:
    planned_s, actual_s = table[:, 1] * _MICRO, table[:, 2] * _MICRO
    return ValveChanges(
        # What no plan asked for (a fault that closed) has its real time only.
        planned_s=np.where(np.isnan(planned_s), actual_s, planned_s),
        actual_s=actual_s,
        valve=table[:, 3].astype(np.int64),
        duty=table[:, 4] / 1000.0,
    )


def _in_order(table: np.ndarray) -> ValveChanges:
    at_us = np.where(np.isnan(table[:, 2]), table[:, 1], table[:, 2])
    return _changes(table[np.argsort(at_us, kind="stable")])


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
