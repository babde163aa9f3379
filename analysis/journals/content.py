"""A whole journal: all inputs and decisions in their order, and what of it is damaged."""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from analysis.journals.unpacking import Entry, inflated, read_blocks, span_text
from companion.core.setup import Setup
from companion.core.types import Decision, Input
from companion.errors import UnreadableError
from companion.journal.codec import FieldNames, decode, field_names_of
from companion.journal.read_only import log_of, one_line
from companion.journal.reader import OpenJournal, damaged_pages, opened
from companion.journal.rows import DICTIONARY_BYTES
from companion.journal.writer import Event, missing_rows
from companion.simulated import Simulated, simulated_in

_BLOCKS = (
    "SELECT first_sequence, from_s, until_s, dictionary, body, decisions FROM blocks "
    "ORDER BY first_sequence"
)
_CHUNK_BYTES = 1 << 20


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
        """Whether the flight ended in order; otherwise what came after its end is missing."""
        return self.meta.get("closed") == "yes"

    @property
    def training(self) -> str | None:
        """What of this flight was no spraying of a product: `water`, `dry`, `no`; None: unknown."""
        return self.meta.get("training")

    @property
    def simulated(self) -> Simulated:
        """Whether the flight was simulated, and what told."""
        return simulated_in(self.meta)

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


def read_journal(path: Path, *, is_lenient: bool = False) -> JournalContent:
    """Return what is in the file; JournalError, in one line, where it cannot be used.

    An UnreadableError where it is a journal, but damaged or of another version.

    `is_lenient` leaves out what is damaged and says so in `unread`; that rows are missing is said
    there in any case.
    """
    with opened(path, is_lenient=is_lenient) as journal:
        return _read(journal, is_lenient=is_lenient)


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


def read_entries(
    connection: sqlite3.Connection,
    version: str,
    *,
    kinds: Collection[str] | None = None,
    unread: list[str] | None = None,
) -> Iterator[Entry]:
    """Yield inputs and decisions in their order, or those of some kinds.

    What is damaged is a ValueError; with `unread` it is said there, and left out.
    """
    if version != "1":
        yield from read_blocks(connection, kinds=kinds, unread=unread)
        return
    rows = connection.execute("SELECT sequence, kind, body FROM records ORDER BY sequence")
    for row in rows:
        entry = Entry(*row)
        if kinds is None or entry.kind in kinds:
            yield entry


def damages(connection: sqlite3.Connection) -> list[str]:
    """Return in a line each what is damaged in the file's pages and in its packed rows."""
    return [*damaged_pages(connection), *damaged_blocks(connection)]


def damaged_blocks(connection: sqlite3.Connection) -> list[str]:
    """Return which packed rows are damaged, in one line; they are inflated and not unpacked.

    Each is a stream with a check sum of its own (RFC 1950): what SQLite cannot see shows there.
    """
    if not _has_blocks(connection):
        return []
    bad: list[str] = []
    count = 0
    try:
        dictionaries = {None: b""} | {
            number: inflated(body, b"", DICTIONARY_BYTES)
            for number, body in connection.execute("SELECT id, body FROM block_dictionaries")
        }
        for first, from_s, until_s, dictionary, *parts in connection.execute(_BLOCKS):
            count += 1
            try:
                for part in parts:
                    inflated(part, dictionaries[dictionary])
            except (ValueError, TypeError, LookupError):
                bad.append(f"from row {first} on ({span_text(from_s, until_s)})")
    except (sqlite3.DatabaseError, ValueError, TypeError) as error:
        return [f"inputs and decisions behind the first {count} blocks: {one_line(error)}"]
    if not bad:
        return []
    return [f"inputs and decisions: {len(bad)} of {count} blocks are damaged, the first {bad[0]}"]


def _has_blocks(connection: sqlite3.Connection) -> bool:
    sql = "SELECT count(*) FROM sqlite_master WHERE name IN ('blocks', 'block_dictionaries')"
    try:
        return bool(connection.execute(sql).fetchone()[0] == 2)
    except sqlite3.DatabaseError:
        return False


def content_sha256(path: Path) -> str:
    """Return the SHA-256 of a journal and of the log beside it; OSError if it cannot be read.

    Not in the process that still writes it: closing a file gives up the locks on it (POSIX).
    """
    found = hashlib.sha256()
    log = log_of(path)
    for part in (path, log) if log.exists() else (path,):
        with part.open("rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                found.update(chunk)
    return found.hexdigest()
