"""Which marks of a strip a cause explains."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.assess.cause_marks import samples_at
from analysis.assess.rate_wishes import percent_at
from analysis.flown.modelled_flow import ML_S_PER_L_MIN
from analysis.holds import CLEAR_M
from analysis.lag import Verdict
from analysis.transitions import ML_M_PER_L_HA_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.assess.cause_marks import Marks
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.lag import Step
    from analysis.track import Bools, Floats
    from companion.core.schedule import LagModel

# A first-order flow is within 5 % of its step after so many time constants.
SETTLED_TIMES = 3.0
# A speed that changes by more within a second is changing; gusts do less in most seconds.
ACCELERATION_M_S2 = 0.5
ACCELERATION_OVER_S = 0.5
# Measured ranges are taken as they are, give or take 2 %, as `FlowCurve.delivers` has it.
RANGE_SLACK = 0.02


def as_wished(flight: AppliedFlight, marks: Marks, off_by: float) -> Bools:
    """Return where it got the percentage that the operator asked for, give or take `off_by`."""
    lag, setup = flight.setup.lag, marks.setup
    percent = percent_at(flight, marks.time_s - lag.output_s - lag.up_s)
    wished: Floats = marks.asked_ml_m * percent / 100.0
    if setup.rate_max_l_ha is not None:
        most = setup.rate_max_l_ha * ML_M_PER_L_HA_M * marks.strip.track.width_m
        wished = np.minimum(wished, most)
    near = np.abs(marks.given_ml_m - wished) <= off_by * wished
    found: Bools = near & (percent != 100.0) & (wished > 0.0)
    return found


def in_edge(marks: Marks, steps: Sequence[Step]) -> Bools:
    """Return where the border decides: the strip reaches over it, or the rule's margin is near."""
    lag = marks.setup.lag
    found = marks.at_border.copy()
    margin_s = max(lag.off_end_s, lag.on_s) + marks.strip.track.period_s
    for step in steps:
        if step.change.border:
            margin_m = margin_s * step.change.speed_m_s + marks.setup.border_buffer_m
            margin_m += 0.5 * marks.strip.track.width_m  # of a border that is met at an angle
            found |= np.abs(marks.distance_m - step.change.distance_m) <= margin_m
    return found


def beside_border(marks: Marks, closed: Bools) -> Bools:
    """Return which closed marks have the border so near to the strip's end that it may be why."""
    index = np.flatnonzero(closed)
    found = np.zeros(len(closed), dtype=np.bool_)
    if len(index):
        strip = marks.strip
        found[index] = ~strip.track.wholly_inside(
            marks.prescription,
            strip.track.places(marks.time_s[index]),
            widen_m=max(CLEAR_M, marks.setup.border_buffer_m),
        )
    return found


def in_change(marks: Marks, steps: Sequence[Step]) -> Bools:
    """Return where a change of rate explains it: within its lag distance, and while it goes on."""
    lag = marks.setup.doses.lag
    found = np.zeros(len(marks.time_s), dtype=np.bool_)
    starts_s = [run.start_s for run in marks.strip.stretches]
    ends_m = {run.start_s: run.end_m for run in marks.strip.stretches}
    takes_s = marks.strip.track.period_s + _lasts_s(lag)
    for step in steps:
        change = step.change
        if change.border:
            continue
        reach_m = takes_s * change.speed_m_s + abs(step.lag_distance_m or 0.0)
        until_m = change.distance_m + reach_m
        if step.verdict is Verdict.MISSED and change.time_s in starts_s:
            until_m = ends_m[change.time_s]
        found |= (marks.distance_m >= change.distance_m - reach_m) & (marks.distance_m <= until_m)
    return found


def _lasts_s(lag: LagModel) -> float:
    """Return how long a change of flow goes on, on either side of its volume-equivalent step."""
    ramp_s = max(lag.on_s - lag.on_start_s, lag.off_end_s - lag.off_s)
    return ramp_s + SETTLED_TIMES * max(lag.up_time_s, lag.down_time_s)


def in_saturation(marks: Marks) -> Bools:
    """Return where no nozzle set delivers what is prescribed at that speed."""
    doses = marks.setup.doses
    share = marks.strip.track.width_m / marks.setup.boom.width_m
    asked_l_min = marks.asked_ml_m * marks.speed_m_s / ML_S_PER_L_MIN / share
    delivers = np.zeros(len(asked_l_min), dtype=np.bool_)
    for nozzles in doses.nozzle_sets:
        low = (1.0 - RANGE_SLACK) * nozzles.curve.flow_for(max(doses.pwm.duty_min, 0.0))
        high = (1.0 + RANGE_SLACK) * nozzles.flow_max_l_min
        delivers |= (asked_l_min >= low) & (asked_l_min <= high)
    saturated: Bools = ~delivers & (marks.asked_ml_m > 0.0)
    return saturated


def in_acceleration(marks: Marks) -> Bools:
    """Return where the speed was changing."""
    track = marks.strip.track
    half_s = 0.5 * ACCELERATION_OVER_S
    after: Floats = track.at(track.speed_m_s, marks.time_s + half_s)
    before: Floats = track.at(track.speed_m_s, marks.time_s - half_s)
    found: Bools = np.abs(after - before) > ACCELERATION_M_S2 * ACCELERATION_OVER_S
    return found


def by_inhibit(flight: AppliedFlight, marks: Marks, where: Bools) -> dict[str, float]:
    """Return the ground by the reason that held the valves; of several, by all of them at once."""
    names = np.array(flight.inhibits, dtype=object)
    lead_s = flight.setup.lag.off_s + flight.setup.lag.output_s
    found: dict[str, float] = {}
    reasons = names[samples_at(flight, marks.time_s[where] - lead_s)]
    later = names[samples_at(flight, marks.time_s[where])]
    for reason, then, area in zip(
        reasons.tolist(), later.tolist(), marks.area_m2[where].tolist(), strict=True
    ):
        name = reason or then or "just ended"
        found[name] = found.get(name, 0.0) + area
    return found
