"""What the causes of wrong doses are looked for in: one strip, mark by mark."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.changes import SPEED_MIN_M_S
from analysis.smoothing import rise_over

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.strips import Strip
    from analysis.track import Bools, Floats
    from companion.core.prescription import Prescription
    from companion.core.setup import Setup

# Where nothing is prescribed, this part of a usual dose is nothing either.
NOTHING = 0.02
# Doses are means over a period: what an inhibit did is seen for this long after its end.
INHIBIT_TAIL_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class Marks:
    """Places along a strip where something was prescribed or fell.

    `given_ml_m` and `asked_ml_m` are doses, means over one PWM period; `usual` is the mean
    prescribed dose of the strip. `at_border` says that the strip reaches over the border there.
    """

    strip: Strip
    setup: Setup
    time_s: Floats
    distance_m: Floats
    speed_m_s: Floats
    area_m2: Floats
    given_ml_m: Floats
    asked_ml_m: Floats
    usual: float
    at_border: Bools

    @property
    def prescription(self) -> Prescription:
        """Return what was prescribed."""
        return self.setup.prescription

    def is_inhibited(self, flight: AppliedFlight) -> Bools:
        """Return where a reason not to spray held the valve, or had until a moment ago."""
        held = np.array([bool(reasons) for reasons in flight.inhibits], dtype=np.bool_)
        lead_s = flight.setup.lag.off_s + flight.setup.lag.output_s
        found = np.zeros(len(self.time_s), dtype=np.bool_)
        for back_s in (0.0, 0.5 * lead_s, lead_s, lead_s + INHIBIT_TAIL_S):
            found |= held[samples_at(flight, self.time_s - back_s)]
        return found


def samples_at(flight: AppliedFlight, time_s: Floats) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Return the flight's last sample before each time."""
    found = np.searchsorted(flight.time_s, time_s, "right") - 1
    return np.clip(found, 0, len(flight.time_s) - 1).astype(np.int64)


def marks_of(strip: Strip, setup: Setup) -> Marks:
    """Return the marks of a strip where something was prescribed or fell."""
    track = strip.track
    at = track.marks
    run_m = rise_over(track.distance_m, track.period_steps)[at]
    moving = run_m > SPEED_MIN_M_S * track.period_s
    given, asked = (
        np.divide(
            rise_over(values, track.period_steps)[at], run_m, out=np.zeros(len(at)), where=moving
        )
        for values in (track.volume_ml, strip.asked_ml)
    )
    usual = float(asked[asked > 0.0].mean()) if (asked > 0.0).any() else 0.0
    kept = moving & ((asked > 0.0) | (given > NOTHING * usual)) & (given + asked > 0.0)
    metres = np.gradient(track.distance_m[at])
    return Marks(
        strip=strip,
        setup=setup,
        time_s=track.time_s[at][kept],
        distance_m=track.distance_m[at][kept],
        speed_m_s=track.speed_m_s[at][kept],
        area_m2=(track.across_m[at] * metres)[kept],
        given_ml_m=given[kept],
        asked_ml_m=asked[kept],
        usual=usual,
        at_border=~strip.grazing[kept],
    )
