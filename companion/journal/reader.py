"""Reading a journal: closed, or cut off by a crash; never while its flight still writes it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from companion.core.setup import Setup
from companion.errors import NoMapError, UnreadableError
from companion.journal.codec import setup_from_json
from companion.journal.coverage import read_treated
from companion.journal.geopackage import APPLICATION_ID, RESERVE, read_ground
from companion.journal.read_only import (
    DAMAGE,
    allow_damaged_list,
    check_programs,
    log_of,
    one_line,
    read_only,
)
from companion.journal.versions import (
    as_far_as_said,
    check_kind,
    check_said,
    check_version,
    extent,
    migrated,
    no_file,
    refused,
    why_no_setup,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenJournal:
    """A journal that is open for reading: its tables by SQL, what it says of itself in `meta`.

    `unread` says what was found to be damaged in opening it; empty for a strict reader.
    """

    path: Path
    connection: sqlite3.Connection
    meta: dict[str, str]
    version: str
    unread: tuple[str, ...] = ()

    def setup(self, unread: list[str] | None = None) -> Setup:
        """Return all that was constant in the flight; UnreadableError where it is damaged.

        In one line, with what else can be read; a NoMapError where only the map is damaged. With
        `unread` what earlier flights treated may be damaged, and is named there.
        """
        try:
            ground = read_ground(self.connection)
        except DAMAGE as error:
            raise NoMapError(
                f"{self.path}: is damaged: no map: its zones or its field cannot be read "
                f"({one_line(error)}); {extent(self.connection)}"
            ) from error
        try:
            setup = setup_from_json(self.meta["setup"], ground)
        except DAMAGE as error:
            why = why_no_setup(error) if "setup" in self.meta else "it is gone"
            raise UnreadableError(
                f"{self.path}: is damaged: no set-up of the flight: {why}; "
                f"{extent(self.connection)}"
            ) from error
        treated = read_treated(self.connection, unread)
        return setup if treated is None else replace(setup, treated=treated)


@contextmanager
def opened(path: Path, *, is_lenient: bool = False) -> Iterator[OpenJournal]:
    """Open a journal for reading; whatever SQLite finds inside becomes a JournalError."""
    if not path.is_file():
        raise no_file(path)
    try:
        with read_only(path) as connection:
            yield _checked(path, connection, is_lenient=is_lenient)
    except DAMAGE as error:
        raise refused(path, error) from error


def is_empty(path: Path) -> bool:
    """Return whether a journal that has just been closed has neither inputs nor decisions."""
    with opened(path) as journal:
        return journal.connection.execute("SELECT 1 FROM blocks LIMIT 1").fetchone() is None


def _checked(path: Path, connection: sqlite3.Connection, *, is_lenient: bool) -> OpenJournal:
    unread: list[str] = []
    application_id, tables = _registered(connection, unread if is_lenient else None)
    check_kind(path, tables, is_geopackage=application_id == APPLICATION_ID)
    check_programs(connection)
    meta = _meta(connection, tables, unread if is_lenient else None)
    version = check_version(path, meta, tables, is_lenient=is_lenient)
    if is_lenient:
        meta, lacking = as_far_as_said(meta, version, tables)
        unread += lacking
    else:
        check_said(meta)
        meta = migrated(meta)
        for text in damaged_pages(connection):
            raise ValueError(text)
    return OpenJournal(
        path=path, connection=connection, meta=meta, version=version, unread=tuple(unread)
    )


def _registered(connection: sqlite3.Connection, unread: list[str] | None) -> tuple[int, set[str]]:
    """Return the application's number and the tables; with `unread` also of a file cut short."""
    try:
        return _register(connection)
    except sqlite3.DatabaseError as error:
        # Its subclasses are no damage: locked, cannot be opened.
        if unread is None or type(error) is not sqlite3.DatabaseError:
            raise
        if "not a database" in str(error):
            raise
        unread.append(f"the file is shorter than it was, or damaged: {one_line(error)}")
    tolerate_damage(connection)
    try:
        return _register(connection)
    except sqlite3.DatabaseError as error:
        raise ValueError(
            f"nothing of it can be read: its list of tables is gone ({one_line(error)})"
        ) from error


def _register(connection: sqlite3.Connection) -> tuple[int, set[str]]:
    """Return the application's number and the tables.

    Through SQLite and not by opening the file: closing a file of its own would give up the locks
    that a writer in the same process holds on it (POSIX).
    """
    (application_id,) = connection.execute("PRAGMA application_id").fetchone()
    return application_id, {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}


def _meta(
    connection: sqlite3.Connection, tables: set[str], unread: list[str] | None
) -> dict[str, str]:
    """Return what the journal says of itself; with `unread` as far as that can be read."""
    if "meta" not in tables:
        return {}
    try:
        rows = connection.execute("SELECT key, value FROM meta").fetchall()
        return _told(rows)
    except sqlite3.DatabaseError as error:
        if unread is None or "locked" in str(error):
            raise
        unread.append(f"meta: {one_line(error)}")
    kept = readable_rows(connection, "meta", [True])
    return _told([row[-2:] for row in kept])


def _told(rows: Iterable[tuple[Any, Any]]) -> dict[str, str]:
    return {str(key): str(value) for key, value in rows if value is not None and key != RESERVE}


# What of a damaged journal can be read.

# Behind a damaged page the search goes on after so many rows, each time twice as many.
_SKIPS = 24
_UNKNOWN_BYTES = 1 << 30
_NOISE = "*** in database main ***"


def tolerate_damage(connection: sqlite3.Connection) -> None:
    """Read a file that is shorter than its header says, or whose list of tables is damaged.

    SQLite refuses such a file as a whole, unless its list of tables may be written; of a
    connection that is read only nothing is written all the same.
    """
    allow_damaged_list(connection)
    connection.execute("PRAGMA writable_schema = ON")


def _bytes_of(source: sqlite3.Connection) -> int:
    try:
        ((pages,), (page_bytes,)) = (
            source.execute(f"PRAGMA {name}").fetchone() for name in ("page_count", "page_size")
        )
    except sqlite3.DatabaseError:
        return _UNKNOWN_BYTES
    return int(pages) * int(page_bytes)


def readable_rows(
    source: sqlite3.Connection, name: str, whole: list[bool]
) -> Iterator[tuple[Any, ...]]:
    """Yield rowid and row of all that can be read; `whole[0]` becomes False where that is less."""
    last = -(2**62)
    # Pages that lead to each other would go on for ever: a row takes five bytes and more.
    rows_max = _bytes_of(source) // 5
    try:
        for count, row in enumerate(
            source.execute(f'SELECT rowid, * FROM "{name}" ORDER BY rowid')
        ):
            if count > rows_max:
                raise sqlite3.DatabaseError("its pages lead to each other")
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
            for count, row in enumerate(source.execute(sql, (beyond,))):
                if count > rows_max:
                    return
                last = row[0]
                yield row
        except sqlite3.DatabaseError:
            continue
        break


def damaged_pages(connection: sqlite3.Connection) -> list[str]:
    """Return what SQLite finds in the file's own order: one line, or none where it is sound."""
    if _ends_within_a_page(connection):
        return ["the file is shorter than it was: it ends within a page"]
    try:
        (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.DatabaseError as error:
        verdict = one_line(error)
    if verdict == "ok":
        return []
    found = " ".join(str(verdict).replace(_NOISE, "").split())
    return [f"a part of the file is damaged ({found})"]


def _ends_within_a_page(connection: sqlite3.Connection) -> bool:
    """Whether the last page is not whole: SQLite takes what is missing of it for zeros.

    By the file's size alone: to open it here would give up SQLite's locks. A log beside it may
    still have that page.
    """
    try:
        (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
        ((_, _, name),) = connection.execute("PRAGMA database_list").fetchall()
        path = Path(name)
        return bool(path.stat().st_size % page_bytes) and not log_of(path).exists()
    except (sqlite3.DatabaseError, OSError, ValueError):
        return False
