"""Which old flights make room: whole ones, oldest first; never an open, pinned or damaged one."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from companion.errors import JournalError
from companion.record.folder import Flight, journals, look_at, pin_of

# For want of space the newest flights stay all the same: a disk that something else has filled
# must not cost the records of the season.
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
    """A flight that goes, and by which rule."""

    flight: Flight
    reason: str


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

    Pinned flights do not count among those that are kept.
    An age counts only where the autopilot told the time: this computer's clock may be anything.
    """
    removals: list[Removal] = []
    ended = [flight for flight in flights if flight.state in _ENDED]
    free = [flight for flight in ended if not flight.is_pinned]
    too_many = 0 if rules.count is None else max(len(free) - rules.count, 0)
    for number, flight in enumerate(free):
        reason = None
        if number < too_many:
            reason = f"more than {rules.count} flights"
        elif _is_older(flight, rules.days, now_utc_s):
            reason = f"older than {rules.days:g} days"
        elif flight in ended[-ALWAYS_KEPT:]:
            continue
        elif rules.free_percent is not None:
            freed = sum(removal.flight.size_bytes for removal in removals)
            if space.free_bytes + freed < space.total_bytes * rules.free_percent / 100.0:
                reason = f"less than {rules.free_percent:g} % of the disk is free"
        if reason is not None:
            removals.append(Removal(flight=flight, reason=reason))
    return removals


def _is_older(flight: Flight, days: float | None, now_utc_s: float) -> bool:
    ended_s = flight.ended_utc_s
    if days is None or ended_s is None or flight.utc_source != "autopilot":
        return False
    return now_utc_s - ended_s > days * _DAY_S


def prune(
    folder: Path, rules: Rules, *, now_utc_s: float, is_dry_run: bool = False
) -> list[Removal]:
    """Remove what the rules say, and return it; JournalError where a file cannot be removed."""
    flights = [look_at(path) for path in journals(folder)]
    removals = chosen(flights, rules, space_of(folder), now_utc_s)
    for removal in () if is_dry_run else removals:
        # Pinned meanwhile, or opened: look again.
        if pin_of(removal.flight.path).exists() or look_at(removal.flight.path).state not in _ENDED:
            continue
        try:
            removal.flight.path.unlink()
        except OSError as error:
            raise JournalError(
                f"{removal.flight.path}: cannot be removed ({error.strerror})"
            ) from error
    return removals
