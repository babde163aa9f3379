"""Rows of a table in the order of their numbers, read around pages that are damaged."""

from __future__ import annotations

import sqlite3
from typing import Any, NamedTuple

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
