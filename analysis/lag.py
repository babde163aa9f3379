"""The volume-equivalent step of every change, P1's lag distance, and how far from its boundary.

With V(s) the volume that a valve has dropped up to the along-track distance s, the flow before a
change is a line V = V0 + q0 (s - s0), the flow after it another one. A sharp step that delivers
the same volume stands where the lines meet. Each line goes through one point near the change and
has the slope of up to twenty periods; both are taken from smoothed volume and distance, so that
neither the pulses' phase nor the speed matters.

On cells of a metre or two there is no room for lines: `analysis.by_volume` judges such a change.

P1 judged its sprayer by the flow that its own controller had ordered. So the target here is what
the orders in force ask for, as long as they ask for the new rate: a controller that follows a gust
0.7 s late is no change that came late. P1 read a log of five positions a second; here it is the
truth, so that the figures differ by up to half a metre for that reason alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from analysis.by_volume import late_by_volume
from analysis.changes import Change, changes_of
from analysis.flight_record import Orders
from analysis.flown.modelled_flow import flow_of, set_in_force
from analysis.holds import sides_of
from analysis.track import Bools, Floats, Ints, Track, rise_over
from analysis.transitions import (
    LEVEL_FROM,
    LEVEL_TO,
    ML_M_PER_L_HA_M,
    Sides,
    SmoothTrack,
    Transition,
    doses_per_rate_ml_m,
    find_transitions,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.changes import Run
    from analysis.holds import Hold
    from companion.core.nozzle import NozzleSet
    from companion.core.types import TimedChange

SMALLEST_STEP = 0.08
DWELL_MIN_S = 0.5
PERIODS_MAX = 20
PERIODS_MIN = 3
MISSED_BELOW = 0.5
# Below this part of the prescribed dose a valve is closed.
DRY_BELOW = 0.02
# A valve is saturated when its clamped duty leaves the dose this far from what is asked.
SATURATED_ERROR = 0.05


class Verdict(StrEnum):
    """What became of a change; all but the first and the last count apart.

    `border`: the strip reaches over the border there, or over treated ground, which may rightly
    hold its valve closed.
    `unknown`: the record of that time is missing.
    """

    MEASURED = "measured"
    SMALL = "small"
    CLOSE = "close"
    SATURATED = "saturated"
    BORDER = "border"
    UNKNOWN = "unknown"
    MISSED = "missed"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A change and its volume-equivalent step; + is too late. None where it is not measured.

    Borders have one too: the switches' gaps and overlaps come from it. `dry` says that the valve
    was closed before or after, where something is prescribed. `volume_m` is the way over which a
    change too close for lines was judged by volume; 0 for one by lines.
    """

    change: Change
    verdict: Verdict
    dry: bool
    lag_distance_m: float | None = None
    volume_m: float = 0.0


class _Lines(NamedTuple):
    """The volume against the distance around a point each; the slope is NaN where there is none."""

    distance_m: Floats
    volume_ml: Floats
    slope_ml_m: Floats


def measure_steps(
    track: Track,
    stretches: Sequence[Run],
    orders: Orders,
    duty_limits: tuple[float, float],
    holds: Sequence[Hold] = (),
) -> list[Step]:
    """Return the step of every change of one valve; `orders` and `holds` are that valve's."""
    changes = changes_of(track, stretches)
    smooth = SmoothTrack(track)
    sides = sides_of(smooth, stretches, holds)
    transitions = find_transitions(smooth, sides, changes)
    lags_m = _lag_distances_m(smooth, changes, transitions, sides)
    asked, given = _doses_ml_m(track, changes, transitions)
    dry = np.any(given < DRY_BELOW * asked, axis=1).tolist()
    saturated = _are_saturated(orders, duty_limits, sides, asked, given).tolist()
    by_volume = late_by_volume(smooth, changes, sides)
    steps: list[Step] = []
    for i, change in enumerate(changes):
        if change is None:
            continue
        verdict = _verdict(change, sides[i], transitions[i])
        if saturated[i] and verdict in (Verdict.MEASURED, Verdict.MISSED):
            verdict = Verdict.SATURATED
        lag_m = None
        if verdict is Verdict.MEASURED:
            lag_m = lags_m[i]
            verdict = Verdict.CLOSE if lag_m is None else verdict
        volume_m = 0.0
        if verdict is Verdict.CLOSE and i in by_volume:
            verdict = Verdict.SATURATED if saturated[i] else Verdict.MEASURED
            lag_m, volume_m = (None, 0.0) if saturated[i] else by_volume[i]
        steps.append(
            Step(
                change=change, verdict=verdict, dry=dry[i], lag_distance_m=lag_m, volume_m=volume_m
            )
        )
    return steps


def _doses_ml_m(
    track: Track, changes: Sequence[Change | None], transitions: Sequence[Transition]
) -> tuple[Floats, Floats]:
    """Return what is asked for before and after each change, and what was given; a row a change.

    NaN is asked where there is no change.
    """
    nowhere = (math.nan, math.nan, math.nan)
    told = [
        nowhere if each is None else (each.time_s, each.before_l_ha, each.after_l_ha)
        for each in changes
    ]
    table = np.array(told).reshape(-1, 3)
    is_one = ~np.isnan(table[:, 0])
    asked = np.full((len(table), 2), math.nan)
    per_rate = doses_per_rate_ml_m(track, table[is_one, 0])
    asked[is_one] = per_rate[:, np.newaxis] * table[is_one, 1:]
    return asked, np.array([each.levels_ml_m for each in transitions]).reshape(-1, 2)


def _verdict(change: Change, sides: Sides, transition: Transition) -> Verdict:
    if not change.relative >= SMALLEST_STEP:
        return Verdict.SMALL
    if sides.held:
        return Verdict.BORDER
    if not min(sides.before.dwell_s, sides.after.dwell_s) >= DWELL_MIN_S:
        return Verdict.CLOSE
    if not transition.progress >= MISSED_BELOW:
        return Verdict.MISSED
    return Verdict.MEASURED if transition.found else Verdict.CLOSE


def _lag_distances_m(
    smooth: SmoothTrack,
    changes: Sequence[Change | None],
    transitions: Sequence[Transition],
    sides: Sequence[Sides],
) -> list[float | None]:
    """Return step less boundary; None where a window would reach over a neighbouring change."""
    if not changes:
        return []
    track = smooth.track
    nan = float("nan")
    closed_before = np.array([each is not None and each.before_l_ha == 0.0 for each in changes])
    closed_after = np.array([each is not None and each.after_l_ha == 0.0 for each in changes])
    boundary_m = np.array([nan if each is None else each.distance_m for each in changes])
    begins_s = np.array([each.begin_s for each in transitions])
    settles_s = np.array([each.settled_s for each in transitions])
    floors_s = np.concatenate(([track.time_s[0]], settles_s[:-1]))
    ceilings_s = np.concatenate((begins_s[1:], [track.time_s[-1]]))
    # What the border holds bounds a line as a neighbouring change does.
    floors_s = np.maximum(floors_s, [each.floor_s for each in sides])
    ceilings_s = np.minimum(ceilings_s, [each.ceiling_s - track.period_s for each in sides])
    before = _lines(smooth, begins_s, np.minimum(floors_s, begins_s), closed_before)
    after = _lines(smooth, settles_s, np.maximum(ceilings_s, settles_s), closed_after)
    rise_ml = after.volume_ml - before.volume_ml
    rise_ml += before.slope_ml_m * before.distance_m - after.slope_ml_m * after.distance_m
    bend = before.slope_ml_m - after.slope_ml_m
    steps_m = np.divide(rise_ml, bend, out=np.full(len(bend), nan), where=bend != 0.0)
    return [None if np.isnan(lag_m) else lag_m for lag_m in (steps_m - boundary_m).tolist()]


def _lines(smooth: SmoothTrack, near_s: Floats, far_s: Floats, closed: Bools) -> _Lines:
    """Return the lines of the flow between changes (`near_s`) and their neighbours (`far_s`)."""
    track = smooth.track
    away_s = np.where(far_s > near_s, track.period_s, -track.period_s)
    # The smoothing reaches one period to each side of both points.
    periods = np.minimum(np.trunc((far_s - near_s) / away_s) - 2.0, PERIODS_MAX)
    anchors_s = near_s + away_s
    ends_s = np.sort(np.stack((anchors_s, anchors_s + periods * away_s)), axis=0)
    slopes = smooth.doses_between(ends_s[0], ends_s[1])
    slopes[periods < PERIODS_MIN] = np.nan
    return _Lines(
        distance_m=np.where(
            closed, track.at(track.distance_m, near_s), track.at(smooth.distance_m, anchors_s)
        ),
        volume_ml=np.where(
            closed, track.at(track.volume_ml, near_s), track.at(smooth.volume_ml, anchors_s)
        ),
        slope_ml_m=np.where(closed, 0.0, slopes),
    )


def _are_saturated(
    orders: Orders,
    duty_limits: tuple[float, float],
    sides: Sequence[Sides],
    asked: Floats,
    given: Floats,
) -> Bools:
    """Return at which changes a stretch's duty is at a limit and its dose short of what is asked.

    Or over it. Something must be asked for before and after; doses are as `_doses_ml_m` has them.

    A valve that gives nothing is not at its limit; it does not work. A switch on or off is placed
    by the flow's own level and needs no limit.
    """
    found: Bools = np.all(asked > 0.0, axis=1)
    if not (len(orders) and found.any()):
        return np.zeros(len(sides), dtype=np.bool_)
    stretches = [stretch for side in sides for stretch in (side.before, side.after)]
    middles_s = np.array([stretch.start_s + 0.5 * stretch.dwell_s for stretch in stretches])
    number = np.searchsorted(orders.at_s, middles_s.reshape(-1, 2), "right")
    duty = orders.duty[np.maximum(number - 1, 0)]
    share = np.divide(given, asked, out=np.zeros_like(given), where=found[:, np.newaxis])
    short = (duty >= duty_limits[1]) & (share > DRY_BELOW) & (share < 1.0 - SATURATED_ERROR)
    over = (duty > 0.0) & (duty <= duty_limits[0]) & (given > asked * (1.0 + SATURATED_ERROR))
    found &= np.any((number > 0) & (short | over), axis=1)
    return found


# -------------------------------------------------------------------------------- P1's lag distance

BAND_OF_STEP = 0.10
STAY_S = 0.3
ORDER_BEFORE_S = 2.0
# Without flows of orders: an order belongs to a change when it moves the duty by this much of the
# change, relatively.
ORDER_OF_STEP = 0.4
# The orders make the change once they ask for this much of the step, and a change of which the
# flow does not do as much never came.
HALF_OF_STEP = 0.5
# Between two trims the flow may be at either, or between: as long as the stay, so that one poll of
# 0.2 s and the valves' own 0.1 s are in it.
TRIM_S = 0.3
# An order asks for the new rate if a speed of the last second explains it: P1's program takes
# 0.42 s, its next poll 0.2 s, and a receiver's speed is 0.03 m/s off (1 sd, either way twice that).
SPEED_AGE_S = 1.0
SPEED_ERROR_M_S = 0.06


@dataclass(frozen=True, slots=True, kw_only=True)
class SettledStep:
    """A change of the boom centre's rate; `lag_distance_m` is None where it is apart.

    `small` is below 8 %; a change that is not small and has no distance never settled.
    """

    change: Change
    small: bool
    lag_distance_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """A change and the stretches before and after it."""

    change: Change
    before: Run
    after: Run

    @property
    def rise_l_ha(self) -> float:
        """Return by how much the rate rises; negative where it falls."""
        return self.after.rate_l_ha - self.before.rate_l_ha


def measure_settled(
    boom: Track,
    stretches: Sequence[Run],
    orders: Sequence[TimedChange],
    nozzle_sets: Sequence[NozzleSet] = (),
) -> list[SettledStep]:
    """Return P1's lag distance of every change inside the field.

    `boom` is the whole boom as one strip. The target is what the orders ask of `nozzle_sets`, or
    without any what the new rate asks for at the actual speed; times what the flow in the second
    half of the stretch is of that there: a sprayer that settles 2 % beside its target has settled.
    """
    judge = _ByOrders(boom, orders, nozzle_sets) if nozzle_sets else _ByRate(boom, orders)
    settled_s = float(boom.time_s[0])
    steps: list[SettledStep] = []
    for i, change in enumerate(changes_of(boom, stretches)):
        if change is None or change.border:
            continue
        pair = _Pair(change=change, before=stretches[i], after=stretches[i + 1])
        if not change.relative >= SMALLEST_STEP:
            steps.append(SettledStep(change=change, small=True, lag_distance_m=None))
            continue
        begin_s = max(pair.before.start_s, change.time_s - ORDER_BEFORE_S, settled_s)
        at_s = judge.settles_s(pair, begin_s) if judge.flow.came(pair) else None
        lag_m = None
        if at_s is not None:
            lag_m = boom.value(boom.distance_m, at_s) - change.distance_m
            settled_s = at_s
        steps.append(SettledStep(change=change, small=False, lag_distance_m=lag_m))
    return steps


class _TotalFlow:
    """The one-period mean of the total flow, and what a rate asks for."""

    def __init__(self, boom: Track) -> None:
        self.boom = boom
        self.ml_s = rise_over(boom.volume_ml, boom.period_steps) / boom.period_s
        # What 1 L/ha asks for at each moment.
        self.per_rate: Floats = ML_M_PER_L_HA_M * boom.across_m * boom.speed_m_s

    def level(self, stretch: Run) -> slice:
        """Return the samples in which a stretch's flow is its own."""
        boom = self.boom
        return slice(
            boom.sample(stretch.start_s + LEVEL_FROM * stretch.dwell_s),
            boom.sample(stretch.start_s + LEVEL_TO * stretch.dwell_s) + 1,
        )

    def came(self, pair: _Pair) -> bool:
        """Return whether the flow went from one stretch to the next by half of the step or more."""
        rates = [
            _usual_ratio(self.ml_s[level], self.per_rate[level])
            for level in (self.level(pair.before), self.level(pair.after))
        ]
        return (rates[1] - rates[0]) / pair.rise_l_ha >= HALF_OF_STEP

    def stays_s(self, near: Bools, first: int) -> float | None:
        """Return when the first stay in the band begins; `near` starts at the sample `first`."""
        needed = max(round(STAY_S / self.boom.step_s), 1)
        if len(near) <= needed:
            return None
        count = np.concatenate(([0], np.cumsum(near)))
        stays = np.flatnonzero(count[needed:] - count[:-needed] == needed)
        return float(self.boom.time_s[first + stays[0]]) if len(stays) else None


class _ByRate:
    """The target is what the new rate asks for at the actual speed."""

    def __init__(self, boom: Track, orders: Sequence[TimedChange]) -> None:
        self.flow = _TotalFlow(boom)
        last: dict[int, float] = {}
        moves: list[float] = []
        for order in orders:
            before = last.get(order.valve, 0.0)
            moves.append(order.duty / before - 1.0 if before > 0.0 else float(order.duty > 0.0))
            last[order.valve] = order.duty
        self.at_s = np.array([order.at_s for order in orders])
        self.moves = np.array(moves)

    def settles_s(self, pair: _Pair, begin_s: float) -> float | None:
        """Return from when on the flow stays in its band; None where it does not before the end."""
        flow, boom = self.flow, self.flow.boom
        begin_s = self._first_s(pair.change, begin_s, pair.after.end_s)
        where = slice(boom.sample(begin_s), boom.sample(pair.after.end_s) + 1)
        level, asked = flow.level(pair.after), pair.after.rate_l_ha * flow.per_rate
        target = asked[where] * _ratio(flow.ml_s[level], asked[level])
        step = abs(pair.rise_l_ha) * flow.per_rate[where]
        return flow.stays_s(np.abs(flow.ml_s[where] - target) <= BAND_OF_STEP * step, where.start)

    def _first_s(self, change: Change, begin_s: float, end_s: float) -> float:
        """Return when the first order for a change came; `begin_s` when there is none."""
        opens = not change.before_l_ha > 0.0
        part = 1.0 if opens else change.after_l_ha / change.before_l_ha - 1.0
        low, high = np.searchsorted(self.at_s, (begin_s, end_s))
        fits = np.flatnonzero(self.moves[low:high] / part >= ORDER_OF_STEP)
        return float(self.at_s[low + fits[0]]) if len(fits) else begin_s


class _ByOrders:
    """The target is what the orders in force ask for, of those that ask for the new rate."""

    def __init__(
        self, boom: Track, orders: Sequence[TimedChange], nozzle_sets: Sequence[NozzleSet]
    ) -> None:
        self.flow = _TotalFlow(boom)
        at_s, total_ml_s = ordered_ml_s(orders, nozzle_sets)
        self.ordered: Floats = total_ml_s[np.searchsorted(at_s, boom.time_s, "right")]
        error = ML_M_PER_L_HA_M * boom.across_m * SPEED_ERROR_M_S
        age = max(round(SPEED_AGE_S / boom.step_s), 1)
        self.per_rate_low = -highest(-self.flow.per_rate, age) - error
        self.per_rate_high = highest(self.flow.per_rate, age) + error

    def settles_s(self, pair: _Pair, begin_s: float) -> float | None:
        """Return from when on the flow stays in its band; None where it does not before the end.

        `orders_are` is what the orders ask for over what the rate asks for, `flow_is` the flow over
        the orders, both where the stretch has settled: neither curve nor sum needs to be exact.
        """
        flow, boom = self.flow, self.flow.boom
        level, rate = flow.level(pair.after), pair.after.rate_l_ha
        orders_are = _usual_ratio(self.ordered[level], rate * flow.per_rate[level])
        flow_is = _usual_ratio(flow.ml_s[level], self.ordered[level])
        where = slice(boom.sample(begin_s), boom.sample(pair.after.end_s) + 1)
        rise = pair.rise_l_ha * flow.per_rate[where] * orders_are
        missing = rate * flow.per_rate[where] * orders_are - self.ordered[where]
        made = np.flatnonzero(missing * np.sign(rise) <= (1.0 - HALF_OF_STEP) * np.abs(rise))
        if not len(made):
            return None
        where = slice(where.start + int(made[0]), where.stop)
        ordered, band = self.ordered[where], BAND_OF_STEP * np.abs(rise[made[0] :])
        right = ordered >= rate * self.per_rate_low[where] * orders_are - band
        right &= ordered <= rate * self.per_rate_high[where] * orders_are + band
        trims = max(round(TRIM_S / boom.step_s), 1)
        low = -highest(np.where(right, -ordered, -np.inf), trims)
        high = highest(np.where(right, ordered, -np.inf), trims)
        # Without an order for the new rate the band is infinitely empty; of a flow of 0 it is no
        # number then, and nothing is near that either.
        with np.errstate(invalid="ignore"):
            near = flow.ml_s[where] >= flow_is * (low - band)
            near &= flow.ml_s[where] <= flow_is * (high + band)
        return flow.stays_s(near, where.start)


def ordered_ml_s(
    orders: Sequence[TimedChange], nozzle_sets: Sequence[NozzleSet]
) -> tuple[Floats, Floats]:
    """Return the times of the orders, and the total flow asked for before the first and from each.

    In force is the smallest set with all valves that are open; each valve gives its share.
    """
    every = Orders.of(orders)
    at_s, valve, duty = every.at_s, every.valve, every.duty
    by_size = sorted(nozzle_sets, key=lambda each: len(each.valves))
    totals = np.stack([_total_of(nozzles, valve, duty) for nozzles in by_size])
    number = set_in_force(valve, duty, by_size)
    total: Floats = totals[number, np.arange(len(number))]
    return at_s, np.concatenate(([0.0], total))


def _total_of(nozzles: NozzleSet, valve: Ints, duty: Floats) -> Floats:
    """Return the flow of a set's valves after each order, if all of them gave its shares."""
    own = np.where(np.isin(valve, nozzles.valves), flow_of(nozzles, duty), 0.0)
    own /= len(nozzles.valves)
    for each in nozzles.valves:
        own[valve == each] *= nozzles.share(each)
    rise = own.copy()
    for each in nozzles.valves:
        its = np.flatnonzero(valve == each)
        rise[its[1:]] -= own[its[:-1]]
    # What sums of rises and falls leave where all is closed is rounding.
    total = np.cumsum(rise)
    return np.where(np.abs(total) < 1e-9, 0.0, total)


def highest(values: Floats, count: int) -> Floats:
    """Return the highest of each value and the `count` - 1 before it.

    >>> highest(np.array([3.0, 1.0, 2.0, 0.0, 0.0]), 3).tolist()
    [3.0, 3.0, 3.0, 2.0, 2.0]
    """
    found, width = values.copy(), 1
    while width < count:
        by = min(width, count - width)
        found[by:] = np.maximum(found[by:], found[:-by])
        width += by
    return found


def _usual_ratio(parts: Floats, wholes: Floats) -> float:
    """Return the ratio of the sums where it is usual: a smallest step or more off is another rate.

    The orders for a next change that comes early are among the last samples of a stretch.
    """
    there = wholes > 0.0
    if not there.any():
        return 1.0
    ratios = parts[there] / wholes[there]
    median = float(np.median(ratios))
    usual = np.abs(ratios - median) <= SMALLEST_STEP * median
    return _ratio(parts[there][usual], wholes[there][usual]) if usual.any() else median


def _ratio(parts: Floats, wholes: Floats) -> float:
    """Return the ratio of the sums; 1 where there is nothing to compare with."""
    whole = float(wholes.sum())
    return float(parts.sum()) / whole if whole > 0.0 else 1.0
