"""Times of the report: whose clock they are by, and in which time zone they are written."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from typing import TYPE_CHECKING

from companion.config.application_table import zone_named
from companion.errors import ConfigError

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight

# Before there was this program: a clock that shows it was never set.
PLAUSIBLE_FROM = datetime(2024, 1, 1, tzinfo=UTC)
SOURCES = {
    "autopilot": "clock of the autopilot (UTC from its satellite receiver)",
    "autopilot-jumped": "clock of the autopilot, which jumped in flight, not verified",
    "computer": "clock of the companion, not verified",
    "operator": "given by the operator",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Makes a time of day of a flight's seconds; `source` is a key of `SOURCES`."""

    offset_s: float
    source: str
    zone: tzinfo
    zone_name: str

    @property
    def is_verified(self) -> bool:
        """Return whether somebody vouches for the time: the autopilot, or the operator."""
        return self.source in ("autopilot", "operator")

    @property
    def source_text(self) -> str:
        """Return in words whose clock it is."""
        return SOURCES[self.source]

    def at(self, time_s: float | None) -> datetime | None:
        """Return a moment of the flight; None for no time, or one that a clock never set shows."""
        if time_s is None or not math.isfinite(time_s + self.offset_s):
            return None
        try:
            moment = datetime.fromtimestamp(time_s + self.offset_s, self.zone)
        except (ValueError, OverflowError, OSError):
            return None
        return moment if moment >= PLAUSIBLE_FROM else None

    def text(self, time_s: float | None) -> str | None:
        """Return the moment as ISO 8601 with its offset from UTC, to the second."""
        moment = self.at(time_s)
        return None if moment is None else moment.isoformat(timespec="seconds")

    def moved_to(self, start_time: str, first_s: float | None) -> Clock:
        """Return a clock by which the first spraying was at `start_time`, as the operator says."""
        if first_s is None:
            return self
        moment = datetime.fromisoformat(start_time)
        return Clock(
            offset_s=moment.timestamp() - first_s,
            source="operator",
            zone=self.zone,
            zone_name=self.zone_name,
        )


def clock_of(flight: AppliedFlight, time_zone: str | None) -> Clock:
    """Return the flight's clock, in `time_zone` or in UTC; ConfigError where it is none."""
    return Clock(
        offset_s=flight.utc_offset_s,
        source=flight.utc_source,
        zone=zone_of(time_zone),
        zone_name=time_zone or "UTC",
    )


def zone_of(name: str | None) -> tzinfo:
    """Return the time zone of that name; UTC without one."""
    if name is None or name == "UTC":
        return UTC
    zone = zone_named(name)
    if zone is None:
        raise ConfigError(
            f"time zone {name}: not known here; write one such as Europe/Madrid or America/Chicago"
        )
    return zone


def duration_text(duration_s: float) -> str:
    """Return a duration for a person.

    >>> duration_text(142.4), duration_text(59.6), duration_text(3725.0)
    ('2 min 22 s', '1 min 0 s', '1 h 2 min')
    """
    whole = timedelta(seconds=round(duration_s))
    minutes, seconds = divmod(int(whole.total_seconds()), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
