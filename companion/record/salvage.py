"""What can still be read of a damaged journal, row by row, into a new file beside it."""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from companion.atomic_write import sync_folder
from companion.record.geopackage import APPLICATION_ID, USER_VERSION
from companion.record.kept_pages import KeptPages, kept_pages
from companion.record.read_only import read_only, tolerate_damage
from companion.record.registers import TABLES, columns_of, own_tables, register_again
from companion.record.stray_rows import COLUMNS, Row, is_of, stray_rows, torn_rows
from companion.record.totals import tell_litres_again
from companion.record.versions import JOURNAL_VERSION, missing_tables
from companion.record.writer import SET_META

# Without a row of any of these a file is no journal, or nothing of one.
_OF_A_FLIGHT = ("meta", "applied", "blocks", "valve_changes")
_TELL_VERSION = "INSERT OR IGNORE INTO meta (key, value) VALUES ('journal_version', ?)"
# Behind a damaged page the search goes on after so many rows, each time twice as many.
_SKIPS = 24


def salvaged_name(path: Path) -> Path:
    """Return where the copy of a damaged journal is."""
    return path.with_name(path.stem + ".salvaged.gpkg")


@dataclass(frozen=True, slots=True, kw_only=True)
class Salvaged:
    """How many rows were copied; which tables are not whole.

    `stray` says of each table how many of these rows came from pages that nothing leads to.
    """

    rows: int
    lost_tables: tuple[str, ...]
    stray: Mapping[str, int]


def salvage(path: Path) -> Salvaged:
    """Copy all rows that can be read.

    What went wrong otherwise is a `sqlite3.Error`, a ValueError or an OSError: then there is no
    copy.
    """
    target = salvaged_name(path)
    draft = target.with_name(f".new-{os.getpid()}-salvaged.gpkg")
    draft.unlink(missing_ok=True)
    try:
        with (
            kept_pages(path) as pages,
            read_only(path, timeout_s=0.0) as source,
            closing(sqlite3.connect(draft, isolation_level=None)) as copy,
        ):
            found = _copy_all(source, pages, copy)
        with draft.open("rb") as file:
            os.fsync(file.fileno())
        draft.rename(target)
        sync_folder(path.parent)
        return found
    finally:
        draft.unlink(missing_ok=True)


def _copy_all(source: sqlite3.Connection, pages: KeptPages, copy: sqlite3.Connection) -> Salvaged:
    tolerate_damage(source)
    source.text_factory = _text
    tables = _tables(source)
    copy.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    copy.execute(f"PRAGMA user_version = {USER_VERSION}")
    copy.execute("BEGIN")
    rows: Counter[str] = Counter()
    lost, torn = [], torn_rows(pages)
    for name, sql in tables.items():
        try:
            _make(copy, name, sql)
            copied, is_whole = _copy(source, copy, name, torn)
        except (sqlite3.Error, ValueError):  # a name, or a list of columns, that is none
            copied, is_whole = 0, False
        rows[name] = copied
        if not is_whole:
            lost.append(name)
    # Of tables too that could be read to their ends: a tree may lead past a page without notice.
    stray = _copy_strays(pages, copy, tables)
    lost += [name for name in stray if name not in lost]
    if not any((rows + stray)[name] for name in _OF_A_FLIGHT):
        raise ValueError("no row of a flight is left")
    if "records" not in tables:
        copy.execute(_TELL_VERSION, (JOURNAL_VERSION,))
    if "applied" in lost:
        tell_litres_again(copy)
    if {"applied", "gpkg_contents", "gpkg_geometry_columns"} & set(lost):
        register_again(copy)
    copy.execute(SET_META, ("closed", "salvaged"))
    copy.execute("COMMIT")
    return Salvaged(rows=(rows + stray).total(), lost_tables=tuple(lost), stray=stray)


def _tables(source: sqlite3.Connection) -> dict[str, str]:
    """Return the tables by their names: what the file's list says, then what it must have said."""
    found: dict[str, str] = {}
    is_whole = False
    try:
        for name, sql in source.execute(TABLES):
            found[name] = sql
        is_whole = not missing_tables("1" if "records" in found else "2", found)
    except (sqlite3.DatabaseError, ValueError):
        pass
    return found if is_whole else {name: sql for name, (sql, _) in own_tables().items()} | found


def _make(copy: sqlite3.Connection, name: str, sql: str) -> None:
    """Make a table as the file says it; where damage speaks from that, as it must have been."""
    own_sql, own_columns = own_tables().get(name, (sql, None))
    try:
        copy.execute(sql)
        columns = columns_of(copy, name)
        is_other = len(columns) != len(own_columns or ())
        if columns and (own_columns is None or columns == own_columns or is_other):
            return
        copy.execute(f'DROP TABLE IF EXISTS "{name}"')
    except sqlite3.Error:
        pass
    copy.execute(own_sql)


def _copy_strays(pages: KeptPages, copy: sqlite3.Connection, tables: Iterable[str]) -> Counter[str]:
    """Copy what SQLite finds no way to; return how many rows of which table."""
    known: dict[str, set[int]] = {}
    for name in tables:
        if _is_known(copy, name):
            known[name] = {row[0] for row in copy.execute(f'SELECT rowid FROM "{name}"')}
    count: Counter[str] = Counter()
    for name, row in stray_rows(pages, known) if known else ():
        count[name] += _put(copy, name, row)
    return +count


def _is_known(copy: sqlite3.Connection, name: str) -> bool:
    """Return whether a table has the columns that it has today."""
    _, own = own_tables().get(name, ("", ()))
    return name in COLUMNS and columns_of(copy, name) == (own or columns_of(copy, name))


def _put(copy: sqlite3.Connection, name: str, row: Row) -> int:
    marks = ", ".join("?" * len(row))
    return copy.execute(f'INSERT OR IGNORE INTO "{name}" VALUES ({marks})', row).rowcount


def _text(raw: bytes) -> str:
    return raw.decode("utf-8", errors="replace")


def _copy(
    source: sqlite3.Connection, copy: sqlite3.Connection, name: str, torn: Container[object]
) -> tuple[int, bool]:
    """Copy one table from both its ends, up to the damage in its middle."""
    whole = [True]
    count = 0
    is_known = _is_known(copy, name)
    for row in readable_rows(source, name, whole):
        # A page that lies where another one belongs has the other's rows.
        if is_known and ((name, row[0]) in torn or not is_of(name, row[1:])):
            whole[0] = False
            continue
        count += _put(copy, name, row[1:])
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
