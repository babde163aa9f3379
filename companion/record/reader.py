"""Reading a journal: closed, or cut off by a crash; never while its flight still writes it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from companion.core.setup import Setup
from companion.core.types import Decision, Input
from companion.errors import NoMapError, UnreadableError
from companion.record.blocks import Entry
from companion.record.codec import FieldNames, decode
from companion.record.coverage_table import read_treated
from companion.record.distrust import check_programs
from companion.record.geopackage import APPLICATION_ID
from companion.record.layers import read_ground
from companion.record.read_only import DAMAGE, one_line, read_only, tolerate_damage
from companion.record.refusals import check_kind, extent, no_file, refused, why_no_setup
from companion.record.salvage import readable_rows
from companion.record.setup_json import field_names_of, setup_from_json
from companion.record.totals import missing_rows
from companion.record.versions import (
    as_far_as_said,
    check_said,
    check_version,
    migrated,
    read_entries,
)
from companion.record.whole_file import damaged_pages
from companion.record.writer import Event

__all__ = ["Entry", "JournalContent", "OpenJournal", "opened", "read_journal"]


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalContent:
    """A whole journal: what it says of itself, and all inputs and decisions in their order.

    `unread` says in a line each what is damaged and left out; empty for a sound file.
    """

    path: Path
    meta: dict[str, str]
    setup: Setup
    field_names: FieldNames
    entries: tuple[Entry, ...]
    events: tuple[Event, ...]
    lost: int
    unread: tuple[str, ...] = ()

    @property
    def is_closed(self) -> bool:
        """Whether the flight ended in order; otherwise its last second may be missing."""
        return self.meta.get("closed") == "yes"

    @property
    def training(self) -> str | None:
        """What of this flight was no spraying of a product: `water`, `dry`, `no`; None: unknown."""
        return self.meta.get("training")

    def value(self, entry: Entry) -> Input | Decision:
        """Return the input or the decision itself, exact to the last bit."""
        try:
            value = decode(entry.body, self.field_names)
        except (ValueError, TypeError, RecursionError) as error:
            raise UnreadableError(
                f"{self.path}: row {entry.sequence}: {one_line(error)}"
            ) from error
        if type(value).__name__ != entry.kind:
            raise UnreadableError(f"{self.path}: row {entry.sequence} is no {entry.kind}")
        return cast("Input | Decision", value)

    def items(self) -> Iterator[Input | Decision]:
        """Return all inputs and decisions in their order."""
        return (self.value(entry) for entry in self.entries)


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


def read_journal(path: Path, *, is_lenient: bool = False) -> JournalContent:
    """Return what is in the file; JournalError, in one line, where it cannot be used.

    An UnreadableError where it is a journal, but damaged or of another version.

    `is_lenient` leaves out what is damaged and says so in `unread`; that rows are missing is said
    there in any case.
    """
    with opened(path, is_lenient=is_lenient) as journal:
        return _read(journal, is_lenient=is_lenient)


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
        return {str(key): str(value) for key, value in rows if value is not None}
    except sqlite3.DatabaseError as error:
        if unread is None or "locked" in str(error):
            raise
        unread.append(f"meta: {one_line(error)}")
    kept = readable_rows(connection, "meta", [True])
    return {str(row[-2]): str(row[-1]) for row in kept if row[-1] is not None}


def _read(journal: OpenJournal, *, is_lenient: bool) -> JournalContent:
    unread = list(journal.unread)
    if is_lenient:
        unread += damaged_pages(journal.connection)
    unread += missing_rows(journal.connection, journal.meta)
    entries, events = [], []
    try:
        for entry in read_entries(
            journal.connection, journal.version, unread=unread if is_lenient else None
        ):
            entries.append(entry)
    except sqlite3.DatabaseError as error:
        if not is_lenient:
            raise
        unread.append(f"rows behind {entries[-1].sequence if entries else 0}: {one_line(error)}")
    marks = "SELECT sequence, time_s, kind, text FROM events ORDER BY sequence"
    last = entries[-1].sequence if entries else 0
    try:
        for sequence, at_s, kind, text in journal.connection.execute(marks):
            # SQLite keeps no NaN: a time that was none comes back as missing.
            time_s = float("nan") if at_s is None else at_s
            events.append(Event(at_s=time_s, kind=kind, text=text))
            last = max(last, sequence)
    except sqlite3.DatabaseError as error:
        if not is_lenient:
            raise
        unread.append(f"events behind the first {len(events)}: {one_line(error)}")
    return JournalContent(
        path=journal.path,
        meta=journal.meta,
        setup=journal.setup(unread if is_lenient else None),
        field_names=field_names_of(journal.meta["setup"]),
        entries=tuple(entries),
        events=tuple(events),
        lost=max(last - len(entries) - len(events), int(journal.meta["lost"])),
        unread=tuple(unread),
    )
