"""Reading a journal: closed, or cut off by a crash; never while its flight still writes it."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from companion.core.controller import Setup
from companion.core.types import Decision, Input
from companion.errors import JournalError
from companion.record.blocks import Entry
from companion.record.codec import FieldNames, decode
from companion.record.content_hash import log_of
from companion.record.coverage_table import read_treated
from companion.record.events import Event
from companion.record.geopackage import APPLICATION_ID
from companion.record.layers import read_ground
from companion.record.setup_json import field_names_of, setup_from_json
from companion.record.versions import check_version, migrated, read_entries

__all__ = ["Entry", "JournalContent", "opened", "read_journal"]


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
            raise JournalError(f"{self.path}: row {entry.sequence}: {_line(error)}") from error
        if type(value).__name__ != entry.kind:
            raise JournalError(f"{self.path}: row {entry.sequence} is no {entry.kind}")
        return cast("Input | Decision", value)

    def items(self) -> Iterator[Input | Decision]:
        """Return all inputs and decisions in their order."""
        return (self.value(entry) for entry in self.entries)


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenJournal:
    """A journal that is open for reading: its tables by SQL, what it says of itself in `meta`."""

    path: Path
    connection: sqlite3.Connection
    meta: dict[str, str]
    version: str

    def setup(self) -> Setup:
        """Return all that was constant in the flight; ValueError where it is damaged."""
        setup = setup_from_json(self.meta["setup"], read_ground(self.connection))
        treated = read_treated(self.connection)
        return setup if treated is None else replace(setup, treated=treated)


def read_journal(path: Path, *, is_lenient: bool = False) -> JournalContent:
    """Return what is in the file; JournalError, in one line, where it cannot be used.

    `is_lenient` leaves out what is damaged and says so in `unread`.
    """
    with opened(path, is_lenient=is_lenient) as journal:
        return _read(journal, is_lenient=is_lenient)


@contextmanager
def opened(path: Path, *, is_lenient: bool = False) -> Iterator[OpenJournal]:
    """Open a journal for reading; whatever SQLite finds inside becomes a JournalError."""
    if not path.is_file():
        raise JournalError(f"{path}: there is no such file; give the .gpkg file of a flight")
    try:
        with _connect(path) as connection:
            yield _checked(path, connection, is_lenient=is_lenient)
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            raise JournalError(
                f"{path}: its flight still writes it; end the flight first"
            ) from error
        raise JournalError(f"{path}: cannot be read: {_line(error)}") from error
    except sqlite3.DatabaseError as error:
        if "not a database" in str(error):
            raise JournalError(f"{path}: is no journal; give the .gpkg file of a flight") from error
        raise JournalError(f"{path}: is damaged: {_line(error)}") from error
    except (OSError, ValueError, KeyError) as error:
        raise JournalError(f"{path}: is damaged: {_line(error)}") from error


def _line(error: Exception) -> str:
    """Return an error's text in one line; SQLite's findings have several."""
    return " ".join(str(error).split())


@contextmanager
def _connect(path: Path) -> Iterator[sqlite3.Connection]:
    """Open for reading only: what a crash left (the -wal file beside it) is read, not changed."""
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
        yield at_end.enter_context(closing(sqlite3.connect(uri, uri=True, timeout=1.0)))


def _checked(path: Path, connection: sqlite3.Connection, *, is_lenient: bool) -> OpenJournal:
    # Through SQLite and not by opening the file: closing a file of its own would give up the locks
    # that a writer in the same process holds on it (POSIX).
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise JournalError(f"{path}: is no journal; give the .gpkg file of a flight")
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    if "meta" not in tables:
        raise JournalError(f"{path}: is a GeoPackage, but no journal of a flight")
    meta = dict(connection.execute("SELECT key, value FROM meta").fetchall())
    version = check_version(path, meta, tables)
    if not is_lenient:
        (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise ValueError(verdict)
    return OpenJournal(path=path, connection=connection, meta=migrated(meta), version=version)


def _read(journal: OpenJournal, *, is_lenient: bool) -> JournalContent:
    unread: list[str] = []
    entries, events = [], []
    try:
        for entry in read_entries(
            journal.connection, journal.version, unread=unread if is_lenient else None
        ):
            entries.append(entry)
    except sqlite3.DatabaseError as error:
        if not is_lenient:
            raise
        unread.append(f"rows behind {entries[-1].sequence if entries else 0}: {_line(error)}")
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
        unread.append(f"events behind the first {len(events)}: {_line(error)}")
    return JournalContent(
        path=journal.path,
        meta=journal.meta,
        setup=journal.setup(),
        field_names=field_names_of(journal.meta["setup"]),
        entries=tuple(entries),
        events=tuple(events),
        lost=max(last - len(entries) - len(events), int(journal.meta["lost"])),
        unread=tuple(unread),
    )
