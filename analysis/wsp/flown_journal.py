"""The journal behind the cards: read before the scans are, and as far as it can be read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from companion.errors import ConfigError, JournalError

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """A flight, None without one, and what of its journal is missing."""

    flight: AppliedFlight | None = None
    warnings: tuple[str, ...] = ()


def read_flown(journal: Path) -> Flown:
    """Return the flight of a journal; one that is damaged is a warning, a missing file an error.

    Cards are measured whatever became of the journal: scans do not depend on it.
    """
    from analysis.flown.read_applied import read_applied

    if not journal.is_file():
        raise ConfigError(f"--journal {journal}: there is no such file")
    unread: list[str] = []
    try:
        flight = read_applied(journal, unread=unread)
    except JournalError as error:
        return Flown(warnings=(str(error),))
    found = []
    if not flight.is_closed:
        found.append("the flight was cut off: its last second may be missing")
    if flight.lost:
        found.append(f"{flight.lost} rows are missing in the journal")
    if not len(flight.time_s):
        found.append("the flight never had a position: no card can be tied to it")
        return Flown(warnings=(*found, *unread))
    return Flown(flight=flight, warnings=(*found, *(f"not read: {each}" for each in unread)))
