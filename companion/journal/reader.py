"""Reading a journal: of which kinds and versions, closed or cut off, never while it is written.

A JournalError is exit 2: no file, no journal, or one that cannot be had now. An UnreadableError is
exit 1: a journal, of which what is asked for cannot be read. All commands refuse by these words.

What journals of each version have where; nothing is ever changed in a file that is read:
1: every input and decision a row of `records`, in plain JSON; a row of `applied` a decision.
2: packed rows in `blocks`, `applied` thinned, tables `valve_changes` and `link_stats`, in `meta`
   `utc_source`, `utc_offset_s` and `calibration_sha256`.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from companion.core.setup import Setup
from companion.errors import JournalError, NoMapError, UnreadableError
from companion.journal.codec import setup_from_json
from companion.journal.coverage import read_treated
from companion.journal.geopackage import APPLICATION_ID, JOURNAL_VERSION, RESERVE, read_ground
from companion.journal.read_only import (
    DAMAGE,
    allow_damaged_list,
    check_programs,
    log_of,
    one_line,
    read_only,
)

# -------------------------------------------------------------------------------------- which files

# Tables of a journal, of any version; a file with some of them is one, whatever else is gone.
_OWN = frozenset(
    {"meta", "records", "blocks", "events", "zones", "field", "applied", "valve_changes"}
)
_SOME = 3
# A flight map has the ground's tables too, and these of its own.
_OF_A_MAP = frozenset({"source_rates", "sources"})
_GIVE = "give the .gpkg file of a flight"
SEE_SHOW = "; see vrspray flights show"
# SQLite's words for a file that is not to be had; whatever else it says is damage.
_KEPT_BACK = ("unable to open", "readonly", "access permission", "authorization")


class NoJournalError(JournalError):
    """The file is something else, not a journal."""


def refused(path: Path, error: Exception) -> JournalError:
    """Return what hinders reading a journal as the error that all commands report."""
    text = one_line(error)
    if isinstance(error, sqlite3.OperationalError):
        if "locked" in text:
            return JournalError(f"{path}: its flight still writes it; end the flight first")
        if any(word in text for word in _KEPT_BACK):
            return JournalError(f"{path}: cannot be read: {text}")
        if "interrupted" in text:
            return UnreadableError(f"{path}: is damaged: reading it does not end")
    if isinstance(error, PermissionError):
        return JournalError(f"{path}: cannot be read: {text}")
    if isinstance(error, sqlite3.DatabaseError) and "not a database" in text:
        return NoJournalError(f"{path}: this is not a journal; {_GIVE}")
    return UnreadableError(f"{path}: is damaged: {text}")


def no_file(path: Path) -> JournalError:
    """Return the error for a path that no file is at."""
    what = "is a folder" if path.is_dir() else "there is no such file"
    return JournalError(f"{path}: {what}; {_GIVE}")


def check_kind(name: object, tables: Collection[str], *, is_geopackage: bool) -> None:
    """Refuse what is no journal by its tables: another database, another GeoPackage."""
    if not is_geopackage:
        raise NoJournalError(f"{name}: this is not a journal; {_GIVE}")
    if _OF_A_MAP.issubset(tables):
        raise NoJournalError(f"{name}: this is a flight map, not a journal; {_GIVE}")
    if len(_OWN.intersection(tables)) < _SOME:
        raise NoJournalError(f"{name}: this is a GeoPackage, but no journal of a flight")


def why_no_setup(error: Exception) -> str:
    """Return in plain words why what was constant in a flight cannot be had."""
    if isinstance(error, json.JSONDecodeError):
        return "its text is garbled or breaks off"
    text = str(error)
    if text.startswith("set-up of version "):
        return text
    return "what it says is not a set-up that this program knows"


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
        unread.append("what the flight said of lost is not a number")
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


# --------------------------------------------------------------------------------------------- read


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
