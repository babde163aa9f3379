"""What can still be read of a damaged journal, row by row, into a new file beside it."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from companion.record.geopackage import APPLICATION_ID, USER_VERSION
from companion.record.read_only import read_only, tolerate_damage
from companion.record.writer import SET_META

# SQL of SQLite's own and of GeoPackage's registers comes with the tables; order as they depend.
_TABLES = (
    "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%' "
    "AND sql IS NOT NULL ORDER BY rowid"
)
# Behind a damaged page the search goes on after so many rows, each time twice as many.
_SKIPS = 24

Row = tuple[object, ...]


def salvaged_name(path: Path) -> Path:
    """Return where the copy of a damaged journal is."""
    return path.with_name(path.stem + ".salvaged.gpkg")


def salvage(path: Path) -> tuple[int, list[str]]:
    """Copy all rows that can be read; return how many, and the tables that are not whole.

    What went wrong otherwise is a `sqlite3.Error` or an OSError: then there is no copy.
    """
    target = salvaged_name(path)
    draft = target.with_name(f".new-{os.getpid()}-salvaged.gpkg")
    draft.unlink(missing_ok=True)
    try:
        with (
            read_only(path, timeout_s=0.0) as source,
            closing(sqlite3.connect(draft, isolation_level=None)) as copy,
        ):
            found = _copy_all(source, copy)
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.rename(target)
        return found
    finally:
        draft.unlink(missing_ok=True)


def _copy_all(source: sqlite3.Connection, copy: sqlite3.Connection) -> tuple[int, list[str]]:
    tolerate_damage(source)
    source.text_factory = _text
    tables = source.execute(_TABLES).fetchall()
    if "meta" not in {name for name, _ in tables}:
        raise ValueError("what the flight says of itself is gone")
    copy.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    copy.execute(f"PRAGMA user_version = {USER_VERSION}")
    copy.execute("BEGIN")
    rows, lost = 0, []
    for name, sql in tables:
        copy.execute(sql)
        copied, is_whole = _copy(source, copy, name)
        rows += copied
        if not is_whole:
            lost.append(name)
    copy.execute(SET_META, ("closed", "salvaged"))
    copy.execute("COMMIT")
    return rows, lost


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", errors="replace")


def _copy(source: sqlite3.Connection, copy: sqlite3.Connection, name: str) -> tuple[int, bool]:
    """Copy one table from both its ends, up to the damage in its middle."""
    whole = [True]
    count = 0
    for row in readable_rows(source, name, whole):
        marks = ", ".join("?" * (len(row) - 1))
        copy.execute(f'INSERT OR IGNORE INTO "{name}" VALUES ({marks})', row[1:])
        count += 1
    return count, whole[0]


def readable_rows(source: sqlite3.Connection, name: str, whole: list[bool]) -> Iterator[Row]:
    """Yield rowid and row of all that can be read; `whole[0]` becomes False where that is less."""
    last = -(2**62)
    try:
        for row in source.execute(f'SELECT rowid, * FROM "{name}" ORDER BY rowid'):
            last = row[0]
            yield row
    except sqlite3.DatabaseError:
        whole[0] = False
    if whole[0]:
        return
    for power in range(_SKIPS):
        if last < 0:
            last = 0
        beyond = last + 2**power
        try:
            sql = f'SELECT rowid, * FROM "{name}" WHERE rowid >= ? ORDER BY rowid'
            for row in source.execute(sql, (beyond,)):
                last = row[0]
                yield row
        except sqlite3.DatabaseError:
            continue
        break
