"""What the operator wished of the rates in flight: another percentage than all of them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from companion.core.nozzle import is_override

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.track import Floats

# As `companion/link/commands.py` writes the event.
_EVENT = re.compile(r"rate override (\d+(?:\.\d+)?(?:e[+-]?\d+)?) %")


class RateWish(NamedTuple):
    """From when on which percentage of the prescribed rates was asked for."""

    at_s: float
    percent: float


def rate_wishes(flight: AppliedFlight) -> list[RateWish]:
    """Return the operator's wishes in order of time, as the journal's events have them."""
    found = []
    for event in flight.events:
        match = _EVENT.fullmatch(event.text)
        if match and is_override(float(match[1])):
            found.append(RateWish(event.at_s, float(match[1])))
    return sorted(found)


def percent_at(flight: AppliedFlight, time_s: Floats) -> Floats:
    """Return the percentage asked for at each time; 100 before the first wish."""
    wishes = rate_wishes(flight)
    percents = np.array([100.0, *(wish.percent for wish in wishes)])
    found: Floats = percents[np.searchsorted([wish.at_s for wish in wishes], time_s, "right")]
    return found
