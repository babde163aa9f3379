"""Why ground got another rate than was prescribed: every square metre is put to one cause.

Ground is off where its dose, a mean over one PWM period, is more than 10 % beside what was
prescribed. Colaco (2014) found 31 % of the points of ground machines so, most of them at changes
of rate or of speed; a flight should know the same of itself.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from analysis.changes import SPEED_MIN_M_S
from analysis.flown.holes import UNREAD
from analysis.flown.modelled_flow import ML_S_PER_L_MIN
from analysis.holds import CLEAR_M
from analysis.lag import Verdict
from analysis.track import rise_over
from analysis.transitions import ML_M_PER_L_HA_M
from companion.core.nozzle import is_override

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.assess.ground import Ground
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.lag import Step
    from analysis.strips import Strip
    from analysis.track import Bools, Floats
    from companion.core.prescription import Prescription
    from companion.core.schedule import LagModel
    from companion.core.setup import Setup


OFF_BY = 0.10
# Ground that got less than this part of its rate was left out.
SKIPPED_BELOW = 0.10


class Cause(StrEnum):
    """Why ground is off; where several would do, the first of them is named."""

    OPERATOR = "operator"  # it got the percentage that the operator asked for in flight
    INHIBIT = "inhibit"  # the safety layer held the valves closed
    EDGE = "edge"  # the border rule: nothing may fall outside
    CHANGE = "change"  # a boundary between two rates is near
    SATURATION = "saturation"  # no nozzle set delivers that rate at that speed
    ACCELERATION = "acceleration"  # the speed was changing
    OVERLAP = "overlap"  # treated again: the ground of the second time
    SKIP = "skip"  # left out, and none of the above: between passes too
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True, slots=True, kw_only=True)
class Causes:
    """Areas in square metres.

    `off_m2` is what was off along the strips, with what was treated again and `skipped_m2`, what
    lies between passes; `passed_m2` is what the strips went over, twice where two did.
    `untreated_m2` is all ground of the field with a rate that no open strip passed, flown over or
    not: of a job in several flights most of it belongs to the others.
    """

    passed_m2: float
    off_m2: float
    by_cause: Mapping[Cause, float]
    by_inhibit: Mapping[str, float]
    doubled_m2: float
    skipped_m2: float
    untreated_m2: float

    def as_json(self) -> dict[str, Any]:
        """Return areas, and the shares of the ground that is off."""
        whole = self.off_m2 if self.off_m2 > 0.0 else 1.0
        return {
            "off_m2": self.off_m2,
            "area_m2": {cause.value: area for cause, area in self.by_cause.items()},
            "share": {cause.value: area / whole for cause, area in self.by_cause.items()},
            "inhibit_m2": dict(self.by_inhibit),
            "doubled_m2": self.doubled_m2,
            "skipped_m2": self.skipped_m2,
            "untreated_m2": self.untreated_m2,
        }


def causes_of(
    flight: AppliedFlight, strips: Sequence[Strip], steps: Sequence[Step], ground: Ground
) -> Causes:
    """Return where the ground that is off comes from."""
    area = dict.fromkeys(Cause, 0.0)
    inhibits: dict[str, float] = {}
    passed_m2 = closed_m2 = 0.0
    for strip in strips:
        marks = marks_of(strip, flight.setup)
        passed_m2 += float(marks.area_m2.sum())
        off = _is_off(marks)
        own = [step for step in steps if step.change.valve == strip.track.valve]
        for cause, where in _sorted(flight, marks, off, own):
            is_edge = cause is Cause.EDGE
            area[cause] += _edge_m2(marks, where) if is_edge else float(marks.area_m2[where].sum())
            if not is_edge:
                closed_m2 += float(marks.area_m2[where & _is_closed(marks)].sum())
            if cause is Cause.INHIBIT:
                for reason, its in by_inhibit(flight, marks, where).items():
                    inhibits[reason] = inhibits.get(reason, 0.0) + its
    # Bare ground at the border lies under strips whose middles are outside, too: by the ground.
    edge_m2 = ground.missed_m2 - ground.between_m2 - closed_m2
    area[Cause.EDGE] = max(area[Cause.EDGE], edge_m2)
    area[Cause.OVERLAP] = ground.doubled_m2
    area[Cause.SKIP] += ground.between_m2
    return Causes(
        passed_m2=passed_m2,
        off_m2=sum(area.values()),
        by_cause=area,
        by_inhibit=inhibits,
        doubled_m2=ground.doubled_m2,
        skipped_m2=ground.between_m2,
        untreated_m2=ground.untreated_m2,
    )


def _edge_m2(marks: Marks, where: Bools) -> float:
    """Return the ground that the border rule left bare, by its geometry.

    A dose is a mean over a PWM period, which spreads the end of the spray over half a metre, too
    little on one side and too much on the other: that ground is not all off. What is missing of
    its volume, at the prescribed dose, is the ground between the end of the spray and the border.
    """
    asked, given = marks.asked_ml_m[where], marks.given_ml_m[where]
    share = np.divide(asked - given, asked, out=np.ones(len(asked)), where=asked > 0.0)
    return max(float((marks.area_m2[where] * share).sum()), 0.0)


def _is_off(marks: Marks) -> Bools:
    """Return where the dose is beside the prescribed one; on ground of rate 0 anything is."""
    wrong = np.abs(marks.given_ml_m - marks.asked_ml_m)
    off: Bools = wrong > OFF_BY * np.where(marks.asked_ml_m > 0.0, marks.asked_ml_m, marks.usual)
    return off


def _is_closed(marks: Marks) -> Bools:
    closed: Bools = marks.given_ml_m < SKIPPED_BELOW * marks.asked_ml_m
    return closed


def _sorted(
    flight: AppliedFlight, marks: Marks, off: Bools, steps: Sequence[Step]
) -> list[tuple[Cause, Bools]]:
    """Return where each cause is to blame; no mark has two."""
    short = marks.given_ml_m < marks.asked_ml_m
    closed = off & _is_closed(marks)
    rules = (
        (Cause.OPERATOR, as_wished(flight, marks, OFF_BY)),
        (Cause.INHIBIT, marks.is_inhibited(flight) & short),
        (Cause.EDGE, in_edge(marks, steps) | beside_border(marks, closed)),
        (Cause.CHANGE, in_change(marks, steps)),
        (Cause.SATURATION, in_saturation(marks)),
        (Cause.ACCELERATION, in_acceleration(marks, off)),
        (Cause.SKIP, closed),
    )
    left, found = off.copy(), []
    for cause, where in rules:
        found.append((cause, left & where))
        left &= ~where
    found.append((Cause.UNEXPLAINED, left))
    return found


# Which marks of a strip a cause explains.

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
    if not rate_wishes(flight):
        return np.zeros(len(marks.time_s), dtype=np.bool_)
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
        # The marks are in order of distance.
        first = marks.distance_m.searchsorted(change.distance_m - reach_m)
        found[first : marks.distance_m.searchsorted(until_m, "right")] = True
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


def in_acceleration(marks: Marks, off: Bools) -> Bools:
    """Return where, of the marks that are `off`, the speed was changing."""
    track = marks.strip.track
    half_s, time_s = 0.5 * ACCELERATION_OVER_S, marks.time_s[off]
    after: Floats = track.at(track.speed_m_s, time_s + half_s)
    before: Floats = track.at(track.speed_m_s, time_s - half_s)
    found = np.zeros(len(off), dtype=np.bool_)
    found[off] = np.abs(after - before) > ACCELERATION_M_S2 * ACCELERATION_OVER_S
    return found


def by_inhibit(flight: AppliedFlight, marks: Marks, where: Bools) -> dict[str, float]:
    """Return the ground by the reason that held the valves; of several, by all of them at once.

    A valve that was held takes its lag, and a dose its period, to be back: the reason stays.
    """
    names = np.array(flight.inhibits, dtype=object)
    found: dict[str, float] = {}
    looks = [
        names[samples_at(flight, marks.time_s[where] - back_s)].tolist()
        for back_s in backs_s(flight.setup.lag)
    ]
    for area, *reasons in zip(marks.area_m2[where].tolist(), *looks, strict=True):
        name = next(filter(None, reasons), UNREAD)
        found[name] = found.get(name, 0.0) + area
    return found


def backs_s(lag: LagModel) -> tuple[float, ...]:
    """Return how long before a dose what kept a valve from it is looked for."""
    lead_s = lag.off_s + lag.output_s
    return (lead_s, 0.0, 0.5 * lead_s, lead_s + INHIBIT_TAIL_S)


# What the causes of wrong doses are looked for in: one strip, mark by mark.

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
        held = np.array(list(map(bool, flight.inhibits)), dtype=np.bool_)
        edges = np.flatnonzero(np.diff(held, prepend=False, append=False))
        # As `samples_at`: the first sample counts before it, too, and the last one for good.
        edges_s = np.concatenate((flight.time_s, [math.inf]))[edges]
        edges_s[edges == 0] = -math.inf
        found = np.zeros(len(self.time_s), dtype=np.bool_)
        for back_s in backs_s(flight.setup.lag):
            # Few edges are sought among many marks, not each mark among the samples.
            at = np.searchsorted(self.time_s - back_s, edges_s).tolist()
            for first, end in zip(at[::2], at[1::2], strict=True):
                found[first:end] = True
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


# What the operator wished of the rates in flight: another percentage than all of them.

# As `companion/link/service.py` writes the event.
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
