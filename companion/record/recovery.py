"""After a crash or a cut of power: the log that was left beside a journal becomes part of it.

SQLite itself takes every transaction whose frames are whole and leaves out the rest. What it
cannot open is kept as it is, and a copy is made of all rows that can still be read.
"""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from companion.errors import JournalError
from companion.record.content_hash import log_of
from companion.record.folder import journals
from companion.record.geopackage import APPLICATION_ID
from companion.record.layers import box_of_points, set_box
from companion.record.salvage import salvage, salvaged_name
from companion.record.writer import SET_META, tell_times_again

_FAILURES = (sqlite3.Error, OSError, ValueError)
_KNOWN = "SELECT min(time_s) FROM events WHERE kind = 'clock'"


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery:
    """What became of one journal: recovered, open (left alone), salvaged or failed."""

    path: Path
    outcome: str
    text: str
    took_s: float

    @property
    def is_good(self) -> bool:
        """Whether nothing is left to be done by hand."""
        return self.outcome in ("recovered", "open")


def recover_folder(folder: Path) -> list[Recovery]:
    """Recover every journal that was cut; one that a living process holds is left alone."""
    return [
        found
        for path in journals(folder)
        if ".salvaged." not in path.name and (found := recover(path)) is not None
    ]


def recover(path: Path) -> Recovery | None:
    """Recover one journal; None where there is nothing to recover."""
    began_s = time.perf_counter()

    try:
        with closing(_connect(path)) as connection:
            if not _is_left(connection, path):
                return None
            _fold_in(connection)
        # Of somebody who looked at the cut file and did not end well either.
        path.with_name(path.name + "-shm").unlink(missing_ok=True)
        outcome, text = "recovered", "what was committed is there"
    except _FAILURES as error:
        reason = " ".join(str(error).split())
        if isinstance(error, sqlite3.OperationalError) and "locked" in reason:
            outcome, text = "open", "its flight still writes it"
        elif salvaged_name(path).exists():
            return None
        else:
            outcome, text = _salvaged(path, reason)
    took_s = time.perf_counter() - began_s
    return Recovery(path=path, outcome=outcome, text=text, took_s=took_s)


def _connect(path: Path) -> sqlite3.Connection:
    """Open for writing, and alone: a journal whose flight lives is locked."""
    if not path.is_file():
        raise JournalError(f"{path}: there is no such file; give the .gpkg file of a flight")
    connection = sqlite3.connect(path, isolation_level=None, timeout=0.0)
    # Before the first read, or a shared-memory file would be made.
    connection.execute("PRAGMA locking_mode = EXCLUSIVE").fetchall()
    return connection


def _is_left(connection: sqlite3.Connection, path: Path) -> bool:
    """Return whether a flight ended here without closing its journal."""
    if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
        raise ValueError("is no journal")
    row = connection.execute("SELECT value FROM meta WHERE key = 'closed'").fetchone()
    if row is None:
        raise ValueError("does not say whether it was closed")
    return row[0] == "no" or log_of(path).exists()


def _fold_in(connection: sqlite3.Connection) -> None:
    (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if verdict != "ok":
        raise sqlite3.DatabaseError(verdict)
    (closed,) = connection.execute("SELECT value FROM meta WHERE key = 'closed'").fetchone()
    if closed == "no":
        connection.execute("BEGIN IMMEDIATE")
        _settle(connection)
        connection.execute(SET_META, ("closed", "recovered"))
        connection.execute("COMMIT")
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
    connection.execute("PRAGMA journal_mode = DELETE").fetchall()


def _settle(connection: sqlite3.Connection) -> None:
    """Fill in what the flight itself would have at its end: the layer's extent, times of day."""
    set_box(connection, "applied", box_of_points(connection, "applied"))
    meta = dict(connection.execute("SELECT key, value FROM meta WHERE key LIKE 'utc_%'"))
    (known_s,) = connection.execute(_KNOWN).fetchone()
    if meta.get("utc_source") == "autopilot" and known_s is not None:
        tell_times_again(connection, float(meta["utc_offset_s"]), known_s)


def _salvaged(path: Path, reason: str) -> tuple[str, str]:
    """Copy what can still be read beside the file, which stays as it is."""
    try:
        rows, lost_tables = salvage(path)
    except _FAILURES as error:
        text = " ".join(str(error).split())
        return "failed", f"{reason}; nothing could be read ({text}); the file is kept as it is"
    parts = f"; not all of {', '.join(lost_tables)}" if lost_tables else ""
    return "salvaged", (
        f"{reason}; the file is kept, {rows} rows are in {salvaged_name(path).name}{parts}"
    )
