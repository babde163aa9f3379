"""The folder of journals: its flights, their state, the pinned ones, and which make room.

A flight that has ended is never written into: a pin is an empty file beside it. Whole flights make
room, oldest first; never an open, pinned or damaged one.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from companion.errors import JournalError
from companion.journal.read_only import DAMAGE, kept_log_of, log_of, one_line
from companion.journal.reader import OpenJournal, OtherVersionError, opened
from companion.journal.writer import applied_l
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
            f"{folder}: cannot be read ({error.strerror}); name the folder of the flights"
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
