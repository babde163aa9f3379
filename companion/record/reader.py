"""Reading a journal: closed, or cut off by a crash; never while its flight still writes it."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from companion.core.controller import Setup
from companion.core.types import Decision, Input
from companion.errors import JournalError
from companion.record.codec import FieldNames, decode
from companion.record.geopackage import APPLICATION_ID
from companion.record.journal import JOURNAL_VERSION
from companion.record.layers import read_ground
from companion.record.setup_json import field_names_of, setup_from_json
from companion.record.writer import Event


@dataclass(frozen=True, slots=True)
class Entry:
    """One input or decision as it lies in the file; `kind` is the name of its type."""

    sequence: int
    kind: str
    body: str

    @property
    def is_decision(self) -> bool:
        """Whether this is a decision, and not an input."""
        return self.kind == Decision.__name__


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalContent:
    """A whole journal: what it says of itself, and all inputs and decisions in their order."""

    path: Path
    meta: dict[str, str]
    setup: Setup
    field_names: FieldNames
    entries: tuple[Entry, ...]
    events: tuple[Event, ...]
    lost: int

    @property
    def is_closed(self) -> bool:
        """Whether the flight ended in order; otherwise its last second may be missing."""
        return self.meta.get("closed") != "no"

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


def read_journal(path: Path) -> JournalContent:
    """Return what is in the file; JournalError, in one line, where it cannot be used."""
    if not path.is_file():
        raise JournalError(f"{path}: there is no such file; give the .gpkg file of a flight")
    try:
        with _connect(path) as connection:
            return _read(path, connection)
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
    log = path.with_name(path.name + "-wal")
    with tempfile.TemporaryDirectory(prefix="vrspray-") as folder:
        source = path
        if log.exists() and not os.access(path.parent, os.W_OK):
            # SQLite needs a shared-memory file beside a log: read a copy.
            for file in (path, log):
                shutil.copy(file, folder)
            source = Path(folder) / path.name
        uri = f"{source.resolve().as_uri()}?mode=ro"
        with closing(sqlite3.connect(uri, uri=True, timeout=1.0)) as connection:
            yield connection


def _read(path: Path, connection: sqlite3.Connection) -> JournalContent:
    # Through SQLite and not by opening the file: closing a file of its own would give up the locks
    # that a writer in the same process holds on it (POSIX).
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise JournalError(f"{path}: is no journal; give the .gpkg file of a flight")
    tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
    if not {"meta", "records", "events", "zones", "field"} <= tables:
        raise JournalError(f"{path}: is a GeoPackage, but no journal of a flight")
    meta = dict(connection.execute("SELECT key, value FROM meta").fetchall())
    if meta.get("journal_version") != JOURNAL_VERSION:
        raise JournalError(
            f"{path}: is a journal of version {meta.get('journal_version')}, this program reads "
            f"version {JOURNAL_VERSION}; use vrspray {meta.get('version_vrspray')}, which wrote it"
        )
    (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise ValueError(verdict)
    rows = connection.execute("SELECT sequence, kind, body FROM records ORDER BY sequence")
    entries = tuple(Entry(*row) for row in rows)
    marks = connection.execute("SELECT sequence, time_s, kind, text FROM events ORDER BY sequence")
    events = marks.fetchall()
    last = max([entry.sequence for entry in entries[-1:]] + [row[0] for row in events[-1:]] + [0])
    return JournalContent(
        path=path,
        meta=meta,
        setup=setup_from_json(meta["setup"], read_ground(connection)),
        field_names=field_names_of(meta["setup"]),
        entries=entries,
        events=tuple(
            # SQLite keeps no NaN: a time that was none comes back as missing.
            Event(at_s=float("nan") if at_s is None else at_s, kind=kind, text=text)
            for _, at_s, kind, text in events
        ),
        lost=max(last - len(entries) - len(events), int(meta["lost"])),
    )
