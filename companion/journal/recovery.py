"""After a crash or a cut of power: the log that was left beside a journal becomes part of it.

SQLite itself takes every transaction whose frames are whole and leaves out the rest. A journal is
looked at first without writing; what is damaged stays as it is, to the byte. What can still be
read of that is for who has the time: `vrspray flights recover`, in the office.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from companion.errors import JournalError
from companion.journal.folder import journals
from companion.journal.geopackage import APPLICATION_ID, box_of_points, set_box
from companion.journal.read_only import (
    DAMAGE,
    check_beside,
    check_programs,
    distrust,
    kept_log_of,
    log_of,
    one_line,
    read_only,
    salvaged_name,
)
from companion.journal.reader import OtherVersionError, check_version
from companion.journal.writer import SET_META, tell_times_again, totals_of

_KNOWN = "SELECT min(time_s) FROM events WHERE kind = 'clock'"


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery:
    """What became of one journal.

    Recovered, open or other-version (both left alone), damaged (left alone too), salvaged, or
    failed. `is_whole`: nothing that was committed is lost.
    """

    path: Path
    outcome: str
    text: str
    took_s: float
    is_whole: bool = True

    @property
    def is_good(self) -> bool:
        """Whether nothing is left to be done by hand."""
        return self.is_whole and self.outcome in ("recovered", "open")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ending:
    """What the flight itself would have written at its end; `time` is (offset, known since)."""

    box: tuple[float, float, float, float] | None
    time: tuple[float, float] | None
    totals: Mapping[str, str]


class Told(NamedTuple):
    """What became of one journal, and what is said of it."""

    outcome: str
    text: str
    is_whole: bool = True


_OPEN = Told("open", "its flight still writes it")
SEE_RECOVER = "; vrspray flights recover copies what can be read of it"
# What is done about a journal that is damaged, and why it counts as that.
OfDamaged = Callable[[Path, str], Told]


def _left_alone(_: Path, reason: str) -> Told:
    return Told("damaged", f"{reason}; it is left as it is{SEE_RECOVER}")


def recover_folder(folder: Path, of_damaged: OfDamaged = _left_alone) -> list[Recovery]:
    """Recover every journal that was cut; one that a living process holds is left alone."""
    return [
        found
        for path in journals(folder)
        if ".salvaged." not in path.name and (found := recover(path, of_damaged)) is not None
    ]


def recover(path: Path, of_damaged: OfDamaged = _left_alone) -> Recovery | None:
    """Recover one journal; None where there is nothing to recover.

    `of_damaged` is told a journal that is damaged, and why, and what it says is told.
    """
    began_s = time.perf_counter()
    told = _recovered(path, of_damaged)
    if told is None:
        return None
    return Recovery(
        path=path,
        outcome=told.outcome,
        text=told.text,
        took_s=time.perf_counter() - began_s,
        is_whole=told.is_whole,
    )


def _recovered(path: Path, of_damaged: OfDamaged) -> Told | None:
    """Return what became of a journal, and what is said of it."""
    try:
        _undo_half_written(path)
        is_left, ending = _looked_at(path)
    except OtherVersionError as error:
        return Told("other-version", f"{error}; it was cut and is left alone")
    except (JournalError, *DAMAGE) as error:
        if _is_locked(error):
            return _OPEN
        return None if salvaged_name(path).exists() else of_damaged(path, one_line(error))
    return _folded_in(path, ending) if is_left else None


def _folded_in(path: Path, ending: _Ending | None) -> Told:
    # Only where a flight was cut: who recovers nothing need not know how a log is made.
    from companion.journal.log import keep_log, log_damage, mark

    try:
        damage = log_damage(path)
        if damage is not None:
            keep_log(path)
        told = _fold_in(path, ending, None if damage is None else partial(mark, damage=damage))
        if told is None:
            kept_log_of(path).unlink(missing_ok=True)
    except DAMAGE as error:
        return _OPEN if _is_locked(error) else Told("failed", f"{one_line(error)}; it can be read")
    if told is None:
        return Told("recovered", "what was committed is there")
    text = f"{told}; the damaged log is kept as {kept_log_of(path).name}"
    return Told("recovered", text, is_whole=False)


def _is_locked(error: Exception) -> bool:
    return isinstance(error, sqlite3.OperationalError) and "locked" in str(error)


def _undo_half_written(path: Path) -> None:
    """Have SQLite undo what a cut in the moment of closing left half written.

    Only then is there such a file beside a journal, and nobody can read it before.
    """
    if path.with_name(path.name + "-journal").exists():
        with _alone(path) as connection:
            connection.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _looked_at(path: Path) -> tuple[bool, _Ending | None]:
    """Return whether a flight ended here without closing its journal, and how it ended then.

    Nothing is written. What is damaged, or no journal, is an error.
    """
    with read_only(path, timeout_s=0.0) as connection:
        if connection.execute("PRAGMA application_id").fetchone()[0] != APPLICATION_ID:
            raise ValueError("is no journal")
        check_programs(connection, writes=True)
        (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
        if path.stat().st_size % page_bytes:
            # SQLite takes zeros for the rest of a page.
            raise ValueError("the file was cut off within a page")
        meta = dict(connection.execute("SELECT key, value FROM meta").fetchall())
        closed = meta.get("closed")
        if closed not in (None, "no") and not log_of(path).exists():
            return False, None
        tables = {row[0] for row in connection.execute("SELECT name FROM sqlite_master")}
        check_version(path.name, meta, tables)
        if closed is None:
            raise ValueError("does not say whether it was closed")
        (verdict,) = connection.execute("PRAGMA quick_check(1)").fetchone()
        if verdict != "ok":
            raise sqlite3.DatabaseError(verdict)
        return True, _ending(connection, meta) if closed == "no" else None


def _ending(connection: sqlite3.Connection, meta: Mapping[str, str]) -> _Ending:
    (known_s,) = connection.execute(_KNOWN).fetchone()
    offset = meta.get("utc_offset_s")
    is_known = meta.get("utc_source") == "autopilot" and known_s is not None and offset is not None
    return _Ending(
        box=box_of_points(connection, "applied"),
        time=(float(offset or "nan"), float(known_s)) if is_known else None,
        # A journal of version 1 has no table of valve changes.
        totals=totals_of(connection) if meta["journal_version"] != "1" else {},
    )


def _fold_in(
    path: Path, ending: _Ending | None, mark: Callable[[sqlite3.Connection], str | None] | None
) -> str | None:
    """Make one file of it; return what is said of a damaged log."""
    with _alone(path) as connection:
        connection.execute("BEGIN IMMEDIATE")
        if ending is not None:
            _settle(connection, ending)
        told = None if mark is None else mark(connection)
        connection.execute("COMMIT")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        connection.execute("PRAGMA journal_mode = DELETE").fetchall()
    # Of somebody who looked at the cut file and did not end well either.
    path.with_name(path.name + "-shm").unlink(missing_ok=True)
    return told


@contextmanager
def _alone(path: Path) -> Iterator[sqlite3.Connection]:
    """Open for writing, and alone: a journal whose flight lives is locked."""
    check_beside(path, writes=True)
    # Absolute: a name that begins with "file:" is an address for some builds of SQLite.
    where = path.absolute()
    with closing(sqlite3.connect(where, isolation_level=None, timeout=0.0)) as connection:
        distrust(connection, where.stat().st_size, writes=True)
        # Before the first read, or a shared-memory file would be made.
        connection.execute("PRAGMA locking_mode = EXCLUSIVE").fetchall()
        yield connection


def _settle(connection: sqlite3.Connection, ending: _Ending) -> None:
    """Fill in the layer's extent, times of day, and what the tables come to."""
    set_box(connection, "applied", ending.box)
    if ending.time is not None:
        tell_times_again(connection, *ending.time)
    for fact in (*ending.totals.items(), ("closed", "recovered")):
        connection.execute(SET_META, fact)
