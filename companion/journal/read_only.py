"""Opening a journal: which kinds and versions, so that nothing changes and nothing of it is run.

A JournalError is exit 2: no file, no journal, or one that cannot be had now. An UnreadableError is
exit 1: a journal, of which what is asked for cannot be read. All commands refuse by these words.

What journals of each version have where; nothing is ever changed in a file that is read:
1: every input and decision a row of `records`, in plain JSON; a row of `applied` a decision.
2: packed rows in `blocks`, `applied` thinned, tables `valve_changes` and `link_stats`, in `meta`
   `utc_source`, `utc_offset_s` and `calibration_sha256`.

A database is more than data. Views, triggers, computed columns, indexes and constraints are
programs; a log or a rollback file beside it is a part of it, and the latter may name any other
file, which SQLite then deletes (https://www.sqlite.org/atomiccommit.html, section 5.8). So only
plain tables of a journal's own names are read, by statements of ours alone, and only plain files
are opened.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
import stat
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from datetime import datetime
from functools import cache
from importlib import metadata
from pathlib import Path

from companion.errors import JournalError, UnreadableError, VrsprayError
from companion.journal.geopackage import JOURNAL_VERSION, SCHEMA

# -------------------------------------------------------------------------------------- which files

# Tables of a journal, of any version; a file with some of them is one, whatever else is gone.
_OWN = frozenset(
    {"meta", "records", "blocks", "events", "zones", "field", "applied", "valve_changes"}
)
_SOME = 3
_GIVE = "give the .gpkg file of a flight"
SEE_SHOW = "; see vrspray flights show"
# SQLite's words for a file that is not to be had; whatever else it says is damage.
_KEPT_BACK = ("unable to open", "readonly", "access permission", "authorization")


def refused(path: Path, error: Exception) -> JournalError:
    """Return what hinders reading a journal as the error that all commands report."""
    text = one_line(error)
    if isinstance(error, sqlite3.OperationalError):
        if "locked" in text:
            return JournalError(f"{path}: its flight still writes it; end the flight first")
        if any(word in text for word in _KEPT_BACK):
            return JournalError(f"{path}: cannot be read: {text}")
        if "interrupted" in text:
            return UnreadableError(f"{path}: is damaged: reading it comes to no end")
    if isinstance(error, PermissionError):
        return JournalError(f"{path}: cannot be read: {text}")
    if isinstance(error, sqlite3.DatabaseError) and "not a database" in text:
        return JournalError(f"{path}: is no journal; {_GIVE}")
    return UnreadableError(f"{path}: is damaged: {text}")


def no_file(path: Path) -> JournalError:
    """Return the error for a path that no file is at."""
    what = "is a folder" if path.is_dir() else "there is no such file"
    return JournalError(f"{path}: {what}; {_GIVE}")


def check_kind(name: object, tables: Collection[str], *, is_geopackage: bool) -> None:
    """Refuse what is no journal by its tables: another database, another GeoPackage."""
    if not is_geopackage:
        raise JournalError(f"{name}: is no journal; {_GIVE}")
    if len(_OWN.intersection(tables)) < _SOME:
        raise JournalError(f"{name}: is a GeoPackage, but no journal of a flight")


def why_no_setup(error: Exception) -> str:
    """Return in plain words why what was constant in a flight cannot be had."""
    if isinstance(error, json.JSONDecodeError):
        return "its text is garbled or breaks off"
    text = str(error)
    if text.startswith("set-up of version "):
        return text
    return "what it says is no set-up that this program knows"


def extent(connection: sqlite3.Connection) -> str:
    """Return in words what else there is in a journal that lacks something."""
    parts = []
    for table in ("blocks", "applied", "valve_changes", "events"):
        try:
            (count,) = connection.execute(f"SELECT count(*) FROM {table}").fetchone()
        except sqlite3.DatabaseError:
            continue
        parts.append(f"{count} rows of {table}")
    return f"{', '.join(parts) or 'nothing else'} can be read{SEE_SHOW}"


_BOTH = {"meta", "events", "zones", "field", "applied"}
_TABLES = {
    "1": frozenset({*_BOTH, "records"}),
    "2": frozenset({*_BOTH, "blocks", "block_dictionaries", "valve_changes", "link_stats"}),
}
# Without these `meta` says too little of a flight.
_NEEDED = frozenset({"closed", "lost", "setup", "started_s", "started_utc"})
# Of a journal of another version, what its refusal says: the rest is for `flights show`.
_SHOWN = {
    "started_utc": "begun",
    "closed": "closed",
    "training": "training",
    "simulated": "simulated",
    "method": "method",
}


class OtherVersionError(UnreadableError):
    """A journal of a version that this program does not know: only `meta` can be read."""

    def __init__(self, text: str, meta: Mapping[str, str]) -> None:
        super().__init__(text)
        self.meta = meta


def check_version(
    name: object, meta: Mapping[str, str], tables: Collection[str], *, is_lenient: bool = False
) -> str:
    """Return the version of a journal; a JournalError where it is none, or none that is known.

    `is_lenient` allows that tables are missing, and the version too: then the tables tell it.
    """
    check_kind(name, tables, is_geopackage=True)
    told = meta.get("journal_version")
    if _is_later(told):
        raise OtherVersionError(
            f"{name}: is a journal of version {told}, this program reads versions "
            f"{' and '.join(_TABLES)}; {_advice(meta.get('version_vrspray'))}{_said(meta)}",
            meta,
        )
    if told in _TABLES:
        version = str(told)
    elif is_lenient:
        version = "1" if "records" in tables else JOURNAL_VERSION
    else:
        raise UnreadableError(f"{name}: is damaged: {_no_version(told)}")
    missing = missing_tables(version, tables)
    if missing and not is_lenient:
        raise UnreadableError(f"{name}: is damaged: the table {missing[0]} is missing")
    return version


def check_said(meta: Mapping[str, str]) -> None:
    """Refuse a journal that does not say what every flight does."""
    missing = sorted(_NEEDED - meta.keys())
    if missing:
        raise ValueError(f"what the flight said of {missing[0]} is missing")


def as_far_as_said(
    meta: Mapping[str, str], version: str, tables: Collection[str]
) -> tuple[dict[str, str], list[str]]:
    """Return `meta` of a damaged journal so that it can be worked with, and what it lacks."""
    told = meta.get("journal_version")
    unread = [f"the table {table} is missing" for table in missing_tables(version, tables)]
    if told != version:
        unread.append(f"{_no_version(told)}; by its tables it is of version {version}")
    unread += [f"what the flight said of {key} is missing" for key in sorted(_NEEDED - meta.keys())]
    found = {**meta, "journal_version": version}
    try:
        int(found.setdefault("lost", "0"))
    except ValueError:
        unread.append("what the flight said of lost is no number")
        found["lost"] = "0"
    try:
        return migrated(found), unread
    except (ValueError, TypeError, LookupError):
        # Said above, or by whoever wants a time of day.
        return {"utc_source": "computer", **found}, unread


def _is_later(version: str | None) -> bool:
    """Whether a version is a number, and one that comes after those that are known."""
    text = str(version)
    return text.isdecimal() and int(text) > int(JOURNAL_VERSION)


def _no_version(told: str | None) -> str:
    return "its version is missing" if told is None else f"its version ({str(told)[:20]}) is none"


def _said(meta: Mapping[str, str]) -> str:
    """Return what a journal says of itself as the end of a sentence."""
    facts = [f"{word} {str(meta[key])[:40]}" for key, word in _SHOWN.items() if key in meta]
    return f"; it says of itself: {', '.join(facts)}" if facts else ""


def missing_tables(version: str, tables: Collection[str]) -> list[str]:
    """Return the tables that a journal of this version has and this one has not."""
    return sorted(_TABLES[version] - set(tables))


def _advice(wrote: str | None) -> str:
    """Return which program reads it; one that is not yet released bears the number before it."""
    try:
        own = metadata.version("vrspray")
    except metadata.PackageNotFoundError:
        own = None
    if wrote in (None, "unknown", own):
        return "use a newer vrspray"
    return f"use vrspray {wrote}, which wrote it"


def migrated(meta: Mapping[str, str]) -> dict[str, str]:
    """Return `meta` as a file of today has it: what an old one does not say is worked out."""
    found = dict(meta)
    if "utc_offset_s" not in found:
        started_s = float(found["started_s"])
        utc_s = datetime.fromisoformat(found["started_utc"]).timestamp()
        found["utc_offset_s"] = repr(utc_s - started_s)
    found.setdefault("utc_source", "computer")
    return found


# ------------------------------------------------------------------------------------------- opened

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
                raise ValueError(f"its {_short(name)} is no plain table")
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
    """Refuse by a ValueError what lies beside a journal and is no plain file of its own.

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
            raise ValueError(f"{file.name} is no plain file")
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
        folder = at_end.enter_context(tempfile.TemporaryDirectory(prefix="vrspray-"))
        source = path
        if log.exists() and not index.exists():
            # SQLite makes one to read the log by, and leaves it; nobody needs it any more.
            at_end.callback(index.unlink, missing_ok=True)
        if log.exists() and not os.access(path.parent, os.W_OK):
            # SQLite needs a shared-memory file beside a log: read a copy.
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
