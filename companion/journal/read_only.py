"""Opening a journal so that nothing of it changes, and nothing that a stranger's file says is run.

A database is more than data. Views, triggers, computed columns, indexes and constraints are
programs; a log or a rollback file beside it is a part of it, and the latter may name any other
file, which SQLite then deletes (https://www.sqlite.org/atomiccommit.html, section 5.8). So only
plain tables of a journal's own names are read, by statements of ours alone, and only plain files
are opened.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import stat
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import cache
from pathlib import Path

from companion.errors import VrsprayError
from companion.journal.geopackage import SCHEMA

_MIB = 1 << 20
# One value, as large as any journal's set-up with all its ground. SQLite's own limit is a gigabyte.
_VALUE_BYTES_MAX = 128 * _MIB
# A statement, those that made the tables included.
_SQL_BYTES_MAX = _MIB
_LIKE_BYTES_MAX = 100
# Steps of SQLite's machine, some 50 million a second on a small computer: for all tables of a
# file several times over. A byte of a table of many small rows takes two, a pass.
_STEPS_PER_CALL = 100_000
_STEPS_MIN = 50_000_000
_STEPS_PER_BYTE = 200
# Of older journals, besides those of today.
_OLDER_TABLES = frozenset({"records", "cells"})
_LISTS = frozenset({"sqlite_master", "sqlite_schema", "pragma_table_info", "pragma_table_xinfo"})
_FUNCTIONS = frozenset({"abs", "coalesce", "count", "like", "max", "min", "strftime", "sum"})
_PRAGMAS_READ = frozenset(
    {
        *("application_id", "user_version", "page_size", "page_count", "database_list"),
        *("table_info", "table_xinfo", "quick_check", "writable_schema", "query_only"),
    }
)
_PRAGMAS_WRITE = frozenset({"locking_mode", "wal_checkpoint", "journal_mode"})
_ASKING = frozenset({sqlite3.SQLITE_SELECT, sqlite3.SQLITE_TRANSACTION, sqlite3.SQLITE_SAVEPOINT})
_CHANGING = frozenset({sqlite3.SQLITE_INSERT, sqlite3.SQLITE_UPDATE, sqlite3.SQLITE_DELETE})
_TABLE = re.compile(r"CREATE TABLE\s")
_INDEX = re.compile(r"CREATE (UNIQUE )?INDEX\s")
# Of a map viewer that made a spatial index; whatever else is virtual has code that reads it.
_RTREE = re.compile(r"CREATE VIRTUAL TABLE\s.*\sUSING\s+\"?rtree\b", re.IGNORECASE | re.DOTALL)
_LISTED = "SELECT type, name, tbl_name, rootpage, sql FROM sqlite_master"
_SIDES = ("-wal", "-journal", "-shm")
# The end of a rollback file that names another one (fileformat2.html, section 3).
_NAMES_ANOTHER = bytes.fromhex("d9d505f920a163d7")
# SQL of SQLite's own and of GeoPackage's registers comes with the tables; order as they depend.
TABLES = (
    "SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%' "
    "AND sql IS NOT NULL ORDER BY rowid"
)


def known_tables() -> frozenset[str]:
    """Return the tables of a journal, of any version."""
    return _OLDER_TABLES | own_tables().keys()


def distrust(
    connection: sqlite3.Connection,
    size_bytes: int,
    *,
    writes: bool = False,
    tables: frozenset[str] | None = None,
) -> None:
    """Have a fresh connection run nothing but our own statements on our own tables.

    Those of a journal, unless other `tables` are given.
    """
    for name in ("trusted_schema = OFF", "cell_size_check = ON", "ignore_check_constraints = ON"):
        connection.execute(f"PRAGMA {name}")
    _configure(connection, "DEFENSIVE", value=True)
    _configure(connection, "ENABLE_TRIGGER", value=False)
    _configure(connection, "ENABLE_VIEW", value=False)
    for limit, most in (
        (sqlite3.SQLITE_LIMIT_LENGTH, _VALUE_BYTES_MAX),
        (sqlite3.SQLITE_LIMIT_SQL_LENGTH, _SQL_BYTES_MAX),
        (sqlite3.SQLITE_LIMIT_LIKE_PATTERN_LENGTH, _LIKE_BYTES_MAX),
        (sqlite3.SQLITE_LIMIT_ATTACHED, 0),
        (sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH, 0),
        (sqlite3.SQLITE_LIMIT_WORKER_THREADS, 0),
    ):
        connection.setlimit(limit, most)
    tables = known_tables() if tables is None else tables
    readable = tables | _LISTS
    pragmas = _PRAGMAS_READ | _PRAGMAS_WRITE if writes else _PRAGMAS_READ

    def judged(action: int, one: str | None, two: str | None, _: str | None, by: str | None) -> int:
        # `by` is the view or the trigger whose program this would be.
        is_ours = by is None and (
            action in _ASKING
            or (action == sqlite3.SQLITE_READ and one in readable)
            or (action == sqlite3.SQLITE_FUNCTION and str(two).lower() in _FUNCTIONS)
            or (action == sqlite3.SQLITE_PRAGMA and one in pragmas)
            or (writes and action in _CHANGING and one in tables)
        )
        return sqlite3.SQLITE_OK if is_ours else sqlite3.SQLITE_DENY

    connection.set_authorizer(judged)
    most_steps = _STEPS_MIN + _STEPS_PER_BYTE * size_bytes
    steps = iter(range(most_steps // _STEPS_PER_CALL))
    connection.set_progress_handler(lambda: next(steps, None) is None, _STEPS_PER_CALL)


def allow_damaged_list(connection: sqlite3.Connection) -> None:
    """Let `PRAGMA writable_schema` count, which the defensive mode does not."""
    _configure(connection, "DEFENSIVE", value=False)


def _configure(connection: sqlite3.Connection, name: str, *, value: bool) -> None:
    """Set what Python has a name for since 3.12; before, the authorizer alone refuses it."""
    option = getattr(sqlite3, f"SQLITE_DBCONFIG_{name}", None)
    setconfig = getattr(connection, "setconfig", None)
    if option is not None and setconfig is not None:
        setconfig(option, value)


def check_programs(
    connection: sqlite3.Connection, *, writes: bool = False, tables: frozenset[str] | None = None
) -> None:
    """Refuse by a ValueError what would have to be run to be read, and with `writes` to change it.

    As far as the list of tables can be read: what is damaged shows where it is read.
    """
    known = known_tables() if tables is None else tables
    found: set[str] = set()
    try:
        for kind, name, table, page, sql in connection.execute(_LISTED):
            text = str(sql or "")
            if text.upper().startswith("CREATE VIRTUAL") and not _RTREE.match(text):
                raise ValueError(f"it has a virtual table ({_short(name)}), as no journal has")
            is_ours = name in known or table in known
            if not is_ours or sql is None:
                continue
            if kind == "table" and page and _TABLE.match(text):
                found.add(str(name))
            elif kind in ("view", "table"):
                raise ValueError(f"its {_short(name)} is not a plain table")
            elif writes and not (kind == "index" and _INDEX.match(text)):
                raise ValueError(f"it has a program ({_short(name)}), as no journal has")
    except sqlite3.DatabaseError:
        pass
    for name in found:
        _check_columns(connection, name)


def _check_columns(connection: sqlite3.Connection, table: str) -> None:
    try:
        columns = connection.execute(f'PRAGMA table_xinfo("{table}")').fetchall()
    except sqlite3.DatabaseError:
        return
    computed = [row[1] for row in columns if row[6]]
    if computed:
        raise ValueError(f"its {table} has a computed column ({_short(computed[0])})")


def _short(name: object) -> str:
    return "".join(letter for letter in str(name)[:40] if letter.isprintable())


def check_beside(path: Path, *, writes: bool = False) -> None:
    """Refuse by a ValueError what lies beside a journal and is not a plain file of its own.

    With `writes` the journal itself must be one too: a link would lead out of the folder.
    """
    for file in (path, *(path.with_name(path.name + side) for side in _SIDES)):
        try:
            mode = file.lstat().st_mode
        except FileNotFoundError:
            continue
        if file == path and not writes:
            mode = file.stat().st_mode
        if not stat.S_ISREG(mode):
            raise ValueError(f"{file.name} is not a plain file")
    if writes:
        _check_rollback(path.with_name(path.name + "-journal"))


def _check_rollback(path: Path) -> None:
    """Refuse a rollback file that names another file: SQLite would delete that."""
    try:
        with path.open("rb") as file:
            file.seek(-min(len(_NAMES_ANOTHER), path.stat().st_size), 2)
            end = file.read()
            size = file.tell()
    except FileNotFoundError:
        return
    if end == _NAMES_ANOTHER and size > len(_NAMES_ANOTHER):
        raise ValueError(f"{path.name} names another file")


@contextmanager
def empty_tables() -> Iterator[sqlite3.Connection]:
    """Make a journal's tables in memory, without a row of a flight."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.executescript(SCHEMA)
        yield connection


@cache
def own_tables() -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return the tables of a journal of today, by their names: SQL, and columns."""
    with empty_tables() as empty:
        tables = empty.execute(TABLES).fetchall()
        return {name: (sql, columns_of(empty, name)) for name, sql in tables}


def columns_of(connection: sqlite3.Connection, table: str) -> tuple[str, ...]:
    """Return the names of a table's columns."""
    rows = connection.execute("SELECT name FROM pragma_table_info(?)", (table,))
    return tuple(row[0] for row in rows)


# What a damaged journal may do to its reader: SQLite's findings, and values that are none.
DAMAGE = (
    sqlite3.Error,
    OSError,
    ValueError,
    TypeError,
    ArithmeticError,
    LookupError,
    AttributeError,
    RecursionError,
)


@contextmanager
def read_only(path: Path, *, timeout_s: float = 1.0) -> Iterator[sqlite3.Connection]:
    """Open for reading only: what a crash left (the -wal file beside it) is read, not changed."""
    check_beside(path)
    log, index = log_of(path), path.with_name(path.name + "-shm")
    with ExitStack() as at_end:
        source = path
        if log.exists() and not index.exists():
            # SQLite makes one to read the log by, and leaves it; nobody needs it any more.
            at_end.callback(index.unlink, missing_ok=True)
        if log.exists() and not os.access(path.parent, os.W_OK):
            # SQLite needs a shared-memory file beside a log: read a copy.
            folder = at_end.enter_context(tempfile.TemporaryDirectory(prefix="vrspray-"))
            for file in (path, log):
                shutil.copy(file, folder)
            source = Path(folder) / path.name
        uri = f"{source.resolve().as_uri()}?mode=ro"
        connection = at_end.enter_context(
            closing(sqlite3.connect(uri, uri=True, timeout=timeout_s))
        )
        size_bytes = sum(file.stat().st_size for file in (path, log) if file.exists())
        distrust(connection, size_bytes)
        yield connection


def one_line(error: Exception) -> str:
    """Return an error's text in one line; SQLite's findings have several."""
    text = " ".join(str(error).split())
    if isinstance(error, sqlite3.Error | OSError | ValueError | VrsprayError) and text:
        return text
    return f"{type(error).__name__} {text}".strip()


def kept_log_of(path: Path) -> Path:
    """Return where the log of a journal is kept if it was damaged."""
    return path.with_name(path.name + "-wal.damaged")


def salvaged_name(path: Path) -> Path:
    """Return where the copy of a damaged journal is."""
    return path.with_name(path.stem + ".salvaged.gpkg")


def log_of(path: Path) -> Path:
    """Return where SQLite keeps what is not yet in a journal's file."""
    return path.with_name(path.name + "-wal")
