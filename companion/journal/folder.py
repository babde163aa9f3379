"""The folder of journals: its flights, the pinned ones, which make room, and what a crash left.

A flight that has ended is never written into: a pin is an empty file beside it. Whole flights make
room, oldest first, when their owner says so; never an open, pinned or damaged one.

SQLite itself takes every transaction whose frames are whole and leaves out the rest. A journal is
looked at first without writing; what is damaged stays as it is, to the byte. What can still be
read of that is for who has the time: `vrspray flights recover`, in the office.
"""

from __future__ import annotations

import re
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from companion.errors import JournalError
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
from companion.journal.reader import (
    NoJournalError,
    OpenJournal,
    OtherVersionError,
    check_version,
    opened,
)
from companion.journal.writer import SET_META, applied_l, tell_times_again, totals_of
from companion.simulated import Simulated, simulated_in

_NAME = re.compile(r"flight-\d+(\.salvaged)?\.gpkg")
_STATES = {"yes": "closed", "no": "cut", "recovered": "recovered", "salvaged": "salvaged"}
_SPANS = {
    "1": "SELECT min(time_s), max(time_s) FROM records",
    "2": "SELECT min(from_s), max(until_s) FROM blocks",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """A journal in the folder; what cannot be told of it is None, and `problem` says why.

    `state` is open (its flight still writes it), closed, cut (by a crash, not yet recovered),
    recovered, salvaged, damaged, or other-version.
    """

    path: Path
    size_bytes: int
    state: str
    is_pinned: bool
    started_utc_s: float | None = None
    utc_source: str | None = None
    duration_s: float | None = None
    applied_l: float | None = None
    training: str | None = None
    simulated: Simulated | None = None
    problem: str | None = None

    @property
    def ended_utc_s(self) -> float | None:
        """Return when it ended, as far as that is known."""
        if self.started_utc_s is None or self.duration_s is None:
            return None
        return self.started_utc_s + self.duration_s


def journals(folder: Path) -> list[Path]:
    """Return the journals in their order; JournalError for a folder that cannot be read.

    A folder or a dangling link of such a name is none.
    """
    try:
        names = [
            entry.name
            for entry in folder.iterdir()
            if _NAME.fullmatch(entry.name) and entry.is_file()
        ]
    except OSError as error:
        raise JournalError(
            f"{folder}: cannot be read ({error.strerror}); name the folder of flights with --folder"
        ) from error
    return [folder / name for name in sorted(names, key=_number)]


def _number(name: str) -> tuple[int, str]:
    found = re.match(r"flight-(\d+)", name)
    return (int(found[1]) if found else 0, name)


def look_at(path: Path) -> Flight:
    """Return what can be told of a journal without reading all of it."""
    size_bytes, is_pinned = 0, False
    try:
        size_bytes = sum(file.stat().st_size for file in (path, log_of(path)) if file.exists())
        is_pinned = pin_of(path).exists()
        with opened(path, is_lenient=True) as journal:
            return _flight(journal, size_bytes=size_bytes, is_pinned=is_pinned)
    except OtherVersionError as error:
        state, problem = "other-version", str(error)
    except JournalError as error:
        problem = str(error)
        state = "open" if "still writes it" in problem else "damaged"
    except OSError as error:
        state, problem = "damaged", f"{path}: cannot be read: {error.strerror}"
    return Flight(
        path=path,
        size_bytes=size_bytes,
        state=state,
        is_pinned=is_pinned,
        problem=None if state == "open" else problem,
    )


def _flight(journal: OpenJournal, *, size_bytes: int, is_pinned: bool) -> Flight:
    meta, problems = journal.meta, list(journal.unread)
    duration_s = litres = started_utc_s = None
    try:
        started_utc_s = float(meta["started_s"]) + float(meta["utc_offset_s"])
        first_s, last_s = journal.connection.execute(_SPANS[journal.version]).fetchone()
        duration_s = None if first_s is None else float(last_s) - float(first_s)
        litres = applied_l(journal.connection, meta)
    except DAMAGE as error:
        problems += [] if any(one_line(error) in text for text in problems) else [one_line(error)]
    state = _STATES.get(meta.get("closed", ""), "damaged")
    return Flight(
        path=journal.path,
        size_bytes=size_bytes,
        state="damaged" if problems else state,
        is_pinned=is_pinned,
        started_utc_s=started_utc_s,
        utc_source=meta.get("utc_source"),
        duration_s=duration_s,
        applied_l=litres,
        training=meta.get("training"),
        simulated=simulated_in(meta),
        problem=f"{journal.path}: is damaged: {'; '.join(problems)}" if problems else None,
    )


def pin_of(path: Path) -> Path:
    """Return the file that says that a flight is pinned."""
    return path.with_name(path.name + ".pin")


def set_pinned(path: Path, *, is_pinned: bool) -> bool:
    """Pin a flight, or no longer; return whether that was news."""
    if not path.is_file():
        raise JournalError(f"{path}: there is no such file; give the .gpkg file of a flight")
    if is_pinned:
        _refuse_others(path)
    pin = pin_of(path)
    if pin.exists() == is_pinned:
        return False
    try:
        if is_pinned:
            pin.touch()
        else:
            pin.unlink()
    except OSError as error:
        raise JournalError(f"{pin}: cannot be written ({error.strerror})") from error
    return True


def _refuse_others(path: Path) -> None:
    """Refuse what is no journal; one that is damaged, or that is still written, can be pinned."""
    try:
        with opened(path, is_lenient=True):
            pass
    except NoJournalError:
        raise
    except JournalError:
        return


# The newest flights stay by every rule: a disk that something else has filled, or a clock that is
# wrong, must not cost the records of the season.
ALWAYS_KEPT = 10
# Below this much free space the flight begins with a warning.
WARN_FREE_PERCENT = 20.0
_DAY_S = 86_400.0
# Only what is complete as far as it ever will be, and can be told apart from damage.
_ENDED = frozenset({"closed", "recovered"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Rules:
    """How much is kept: None is no limit of that kind."""

    free_percent: float | None = 10.0
    count: int | None = None
    days: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Space:
    """The disk under the folder."""

    total_bytes: int
    free_bytes: int

    @property
    def free_percent(self) -> float:
        """Return the free share."""
        return 100.0 * self.free_bytes / self.total_bytes if self.total_bytes else 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Removal:
    """A flight that goes, and by which rule; `problem`: why it is still there."""

    flight: Flight
    reason: str
    problem: str | None = None


def space_of(folder: Path) -> Space:
    """Return how much room there is; JournalError where the folder cannot be looked at."""
    try:
        usage = shutil.disk_usage(folder)
    except OSError as error:
        raise JournalError(f"{folder}: cannot be read ({error.strerror})") from error
    return Space(total_bytes=usage.total, free_bytes=usage.free)


def chosen(
    flights: Sequence[Flight], rules: Rules, space: Space, now_utc_s: float
) -> list[Removal]:
    """Return what goes, oldest first; `flights` in their order, oldest first.

    Pinned flights do not count among those that `count` keeps. The newest ten, pinned or not, stay
    by every rule.
    """
    removals: list[Removal] = []
    ended = [flight for flight in flights if flight.state in _ENDED]
    free = [flight for flight in ended if not flight.is_pinned]
    too_many = 0 if rules.count is None else max(len(free) - rules.count, 0)
    sure_utc_s = _sure_utc_s(ended, now_utc_s)
    safe = ended[max(len(ended) - ALWAYS_KEPT, 0) :]
    for number, flight in enumerate(free):
        reason = None
        if flight in safe:
            continue
        if number < too_many:
            reason = f"more than {rules.count} flights"
        elif _is_older(flight, rules.days, sure_utc_s):
            reason = f"older than {rules.days:g} days"
        elif rules.free_percent is not None:
            freed = sum(removal.flight.size_bytes for removal in removals)
            if space.free_bytes + freed < space.total_bytes * rules.free_percent / 100.0:
                reason = f"less than {rules.free_percent:g} % of the disk is free"
        if reason is not None:
            removals.append(Removal(flight=flight, reason=reason))
    return removals


def _sure_utc_s(ended: Sequence[Flight], now_utc_s: float) -> float | None:
    """Return a time that has surely come; None where nobody knows one.

    This computer's clock may be anything, and one flight's autopilot may have been wrong: an age
    counts against the earlier of the two, the newest end by an autopilot's clock and the
    computer's. Whichever is wrong alone, nothing goes too early.
    """
    ends_s = [
        flight.ended_utc_s
        for flight in ended
        if flight.utc_source == "autopilot" and flight.ended_utc_s is not None
    ]
    return min(max(ends_s), now_utc_s) if ends_s else None


def _is_older(flight: Flight, days: float | None, sure_utc_s: float | None) -> bool:
    ended_s = flight.ended_utc_s
    if days is None or ended_s is None or flight.utc_source != "autopilot" or sure_utc_s is None:
        return False
    return sure_utc_s - ended_s > days * _DAY_S


def prune(
    folder: Path, rules: Rules, *, now_utc_s: float, is_dry_run: bool = False
) -> list[Removal]:
    """Remove what the rules say, and return it; what cannot be removed has a `problem`."""
    flights = [look_at(path) for path in journals(folder)]
    removals = chosen(flights, rules, space_of(folder), now_utc_s)
    if is_dry_run:
        return removals
    return [found for removal in removals if (found := _removed(removal)) is not None]


def _removed(removal: Removal) -> Removal | None:
    """Remove a flight and the log beside it; None where it is to stay by now."""
    path = removal.flight.path
    # Pinned meanwhile, or opened: look again.
    if pin_of(path).exists() or look_at(path).state not in _ENDED:
        return None
    try:
        path.unlink()
        for rest in (log_of(path), kept_log_of(path), path.with_name(path.name + "-shm")):
            rest.unlink(missing_ok=True)
    except OSError as error:
        return replace(removal, problem=f"cannot be removed ({error.strerror})")
    return removal


# ------------------------------------------------------------------------------------ after a crash

_KNOWN = "SELECT max(time_s) FROM events WHERE kind = 'clock'"


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
            raise ValueError("this is not a journal")
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
    is_known = meta.get("utc_source") != "computer" and known_s is not None and offset is not None
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
