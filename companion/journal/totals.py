"""What a flight's tables come to, told in `meta` at its end: missing rows are noticed by it."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterator, Mapping

from companion.journal.read_only import one_line

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
