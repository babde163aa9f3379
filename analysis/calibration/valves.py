"""Each valve by itself: its flow over the mean valve's, and how much later or sooner it is.

Every valve goes through the same course of duties on the ground, the others closed or, where one
alone is below what the meter can tell, open and steady. Whatever is common to all (the meter's
gain and delay, the pressure, the curve) cancels in the comparison: so factors are ratios with the
mean 1, and no dose comes from here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import TYPE_CHECKING

import numpy as np

from analysis.calibration.identify import (
    CONFIDENCE,
    METER_LAG_S,
    STEPS_MIN,
    Estimate,
    Fit,
    Line,
    Meter,
    fit_all,
    mean_of,
)
from analysis.calibration.steps import Kind, find_steps, settle_s
from analysis.student import t_factor
from companion.errors import VrsprayError
from companion.ground.work import PIECE_MAX_S, GroundKind, GroundTask, Phase

if TYPE_CHECKING:
    from analysis.calibration.steps import Floats, FlowRecord
    from companion.core.schedule import LagModel
    from companion.core.types import PwmLimits

# How often each kind of change is made of every valve: 2.4 ms of lag in 95 % of the twin's valves.
CYCLES = 20
# Steady PWM periods after each change: more say the flow better, fewer leave time for more changes.
STEADY_PERIODS = 9
# One valve among 24 that spray: its step is repeated so often that it shows.
SMALLEST_STEP = 0.01
# Low and high duty, as shares of the window that the valves can follow. Off and on are changes from
# and to the high one: the more a change makes, the better the meter says when it was.
LOW_SHARE, HIGH_SHARE = 0.25, 0.8
# A nozzle that gives 10 % more or less than it should is replaced (ISO 16122-2, 4.9.2: the flow of
# a nozzle within 10 % of the mean of all; FAO and the trade use the same figure).
WORN_SHARE = 0.10


class ValveCourseError(VrsprayError):
    """A sprayer whose valves cannot be measured one by one, or a record that does not say it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """How each valve is measured: a piece of ground work that is done so many times.

    `base` is the duty of the other valves: 0 where one alone is enough for the meter.
    """

    low: float
    high: float
    base: float
    dwell_s: float
    cycles: int
    pieces: int
    is_counted: bool = False

    @property
    def piece_s(self) -> float:
        """Return how long one piece takes: a steady beginning, and four changes a cycle."""
        if self.is_counted:
            return COUNTED_REST_S + 2.0 * self.dwell_s
        return (1 + 4 * self.cycles) * self.dwell_s

    def duties(self) -> list[tuple[float, float]]:
        """Return the valve's own course: from when on which duty."""
        if self.is_counted:
            begin_s = COUNTED_REST_S
            return [(0.0, 0.0), (begin_s, self.high), (begin_s + self.dwell_s, self.low)]
        every = [0.0, *([self.high, self.low, self.high, 0.0] * self.cycles)]
        return [(number * self.dwell_s, duty) for number, duty in enumerate(every)]

    def task(self, valve: int, count: int) -> GroundTask:
        """Return one piece for a valve out of `count`."""
        phases = []
        for at_s, own in self.duties():
            duty = [self.base] * count
            duty[valve] = own
            phases.append(Phase(at_s=at_s, duty=tuple(duty)))
        return GroundTask(
            kind=GroundKind.VALVES, phases=tuple(phases), seconds=self.piece_s, is_whole=True
        )

    def rounds(self, count: int) -> Iterator[tuple[int, int]]:
        """Yield valve and number of each piece: all valves in turn, there and back again.

        So what warms up meanwhile, or a tank that empties, comes to every valve alike.
        """
        for number in range(1, self.pieces + 1):
            order = range(count) if number % 2 else reversed(range(count))
            yield from ((valve, number) for valve in order)

    def open_s(self, count: int) -> tuple[float, float]:
        """Return what all of it takes: seconds, and seconds of one fully open valve."""
        highs = 1.0 if self.is_counted else 2.0
        own_s = self.cycles * self.dwell_s * (highs * self.high + self.low)
        others_s = self.piece_s * self.base * (count - 1)
        pieces = self.pieces * count
        return self.piece_s * pieces, (own_s + others_s) * pieces


def course_of(pwm: PwmLimits, lag: LagModel, *, cycles: int, is_alone: bool) -> Course:
    """Return the course for valves of one sprayer; `cycles` is how often each kind of change comes.

    Raises:
        ValveCourseError: where not even one cycle fits into a piece of ground work.
    """
    window = pwm.duty_max - pwm.duty_min
    dwell_s = settle_s(lag) + STEADY_PERIODS * pwm.period_s
    fitting = math.floor((PIECE_MAX_S / dwell_s - 1.0) / 4.0)
    if fitting < 1:
        raise ValveCourseError(
            f"lags of {lag.off_end_s:.2g} s leave no time for a cycle within {PIECE_MAX_S:g} s"
        )
    pieces = max(math.ceil(cycles / fitting), 1)
    pieces += pieces % 2  # as often there as back
    low = pwm.duty_min + LOW_SHARE * window
    return Course(
        low=low,
        high=pwm.duty_min + HIGH_SHARE * window,
        base=0.0 if is_alone else low,
        dwell_s=dwell_s,
        cycles=math.ceil(cycles / pieces),
        pieces=pieces,
    )


# A meter on the autopilot: whole millilitres, some three times a second, and late by a time that
# nobody knows. One millilitre is a tenth of a second of one valve's flow, which is 30 ms (1 sd) in
# each reading, and valves differ by 3 ms: it says nothing of lags. It says the flow of stretches.
#
# Closed, high and low for so long each; a count is that of up to `COUNTED_LATE_S` before it came.
COUNTED_REST_S, COUNTED_DWELL_S, COUNTED_LATE_S = 4.0, 12.5, 1.0
READINGS_MIN = 5
# Of the changes that are asked for, one stretch of steady flow is worth several.
CYCLES_PER_PIECE, COUNTED_PIECES_MIN = 3.4, 6


def counted_course(pwm: PwmLimits, *, cycles: int, is_alone: bool) -> Course:
    """Return the course for a meter that the autopilot counts: long steady stretches."""
    window = pwm.duty_max - pwm.duty_min
    pieces = max(math.ceil(cycles / CYCLES_PER_PIECE), COUNTED_PIECES_MIN)
    low = pwm.duty_min + LOW_SHARE * window
    return Course(
        low=low,
        high=pwm.duty_min + HIGH_SHARE * window,
        base=0.0 if is_alone else low,
        dwell_s=COUNTED_DWELL_S,
        cycles=1,
        pieces=pieces + pieces % 2,
        is_counted=True,
    )


# As the changes of a cycle are taken together below.
KINDS = (Kind.ON, Kind.OFF, Kind.UP, Kind.DOWN)
Fits = Sequence[Fit]


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """What one piece of ground work has recorded of one valve."""

    valve: int
    record: FlowRecord
    is_counted: bool = False  # by the autopilot, in whole millilitres


@dataclass(frozen=True, slots=True, kw_only=True)
class ValveFigures:
    """One valve against the mean of all: flow as a ratio, lags in seconds (+ is later)."""

    factor: Estimate
    lags: dict[Kind, Estimate]

    @property
    def is_worn(self) -> bool:
        """Whether its flow is out of what nozzles of one set may differ by."""
        return not abs(self.factor.value - 1.0) <= WORN_SHARE


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentifiedValves:
    """All valves, the set's own lags (the mean over its valves), and what was counted."""

    valves: tuple[ValveFigures, ...]
    lags: dict[Kind, Estimate]
    volume_ml: float


def identify_valves(
    pieces: Sequence[Piece], count: int, *, meter_lag_s: float = METER_LAG_S
) -> IdentifiedValves:
    """Return flow and lags of each of `count` valves, with 95 % intervals; no lags of counts.

    Raises:
        ValveCourseError: naming the valve of which there are too few good changes.
    """
    if pieces[0].is_counted:
        return _identify_counted(pieces, count)
    fits: list[list[Fit]] = [[] for _ in range(count)]
    volume_ml = 0.0
    for piece in pieces:
        fits[piece.valve] += _fits_of(piece, meter_lag_s)
        if len(piece.record.volume_ml):
            volume_ml += float(piece.record.volume_ml[-1] - piece.record.volume_ml[0])
    own = [_lags(of_valve, valve) for valve, of_valve in enumerate(fits)]
    flows = [_flow(of_valve) for of_valve in fits]
    found = [
        ValveFigures(
            factor=factor,
            lags={kind: _against_mean([each[kind] for each in own], valve, 0.0) for kind in Kind},
        )
        for valve, factor in enumerate(_factors(flows))
    ]
    lags = {kind: _mean([each[kind] for each in own]) for kind in Kind}
    output_s = pieces[0].record.lag.output_s
    return IdentifiedValves(
        valves=tuple(found),
        lags={kind: lag.shifted(-output_s) for kind, lag in lags.items()},
        volume_ml=volume_ml,
    )


def _fits_of(piece: Piece, meter_lag_s: float) -> list[Fit]:
    record = piece.record
    if len(record.time_s) < 2:
        return []
    steps, _ = find_steps(record, smallest=SMALLEST_STEP)
    time_s, volume_ml = _with_rests(record.time_s, record.volume_ml, record.period_s)
    meter = Meter(time_s, volume_ml, lag_s=meter_lag_s, period_s=record.period_s)
    # The others open together at the beginning and close at the end.
    own = [step for step in steps if {order.valve for order in step.orders} == {piece.valve}]
    return fit_all(meter, own, record)[0]


def _with_rests(time_s: Floats, volume_ml: Floats, period_s: float) -> tuple[Floats, Floats]:
    """Return readings at a meter's pulses with such as say that meanwhile none came.

    Between two pulses of a flow the volume is taken to grow evenly; where none came for more than
    a PWM period there was no flow, and it stood: somewhere between two pulses, so half of one more
    was delivered than was counted.
    """
    rises = np.diff(volume_ml)
    half_ml = 0.5 * float(rises[rises > 0.0].min()) if (rises > 0.0).any() else 0.0
    half_s = 0.5 * period_s
    rests_s, rests_ml = [time_s], [volume_ml]
    for gap in np.flatnonzero(np.diff(time_s) > period_s).tolist():
        rest_s = np.arange(time_s[gap] + half_s, time_s[gap + 1], half_s, dtype=np.float64)
        rests_s.append(rest_s)
        rests_ml.append(np.full(len(rest_s), volume_ml[gap] + half_ml))
    more_s, more_ml = np.concatenate(rests_s), np.concatenate(rests_ml)
    order = np.argsort(more_s, kind="stable")
    return more_s[order], more_ml[order]


def _lags(fits: Sequence[Fit], valve: int) -> dict[Kind, Estimate]:
    found = {}
    for kind in Kind:
        chosen = [fit for fit in fits if fit.step.kind is kind]
        if len(chosen) < STEPS_MIN:
            raise ValveCourseError(
                f"valve {valve + 1}: {len(chosen)} good changes of kind {kind.value}, "
                f"{STEPS_MIN} are needed; look whether it opens and whether the meter counts"
            )
        found[kind] = mean_of([fit.lag_s for fit in chosen], [fit.sd_s for fit in chosen])
    return found


def _flow(fits: Sequence[Fit]) -> Estimate:
    """Return the flow over what the curve says, half at the high level and half at the low one.

    A valve that delivers a little longer at every pulse is farther off at the low level, so one
    alone would not do. Both are taken above what flows while the valve is closed. The changes of a
    cycle share stretches of steady flow, so that it is cycles, and not changes, that say how much
    the figure scatters; the interval is Student's.
    """
    by_kind = {kind: [fit for fit in fits if fit.step.kind is kind] for kind in Kind}
    high_ml_s = _expected(by_kind[Kind.ON] + by_kind[Kind.OFF])
    low_ml_s = high_ml_s - _expected(by_kind[Kind.UP] + by_kind[Kind.DOWN])

    def share(on: Fits, off: Fits, up: Fits, down: Fits) -> float:
        closed = _level([fit.before for fit in on] + [fit.after for fit in off])
        high = _level([fit.after for fit in (*on, *up)] + [fit.before for fit in (*off, *down)])
        low = _level([fit.after for fit in down] + [fit.before for fit in up])
        return 0.5 * ((high - closed) / high_ml_s + (low - closed) / low_ml_s)

    value = share(*(by_kind[kind] for kind in KINDS))
    cycles = [
        share(*((fit,) for fit in cycle))
        for cycle in zip(*(by_kind[kind] for kind in KINDS), strict=False)
    ]
    half = _half(_mean_with_interval(cycles))
    return Estimate(value=value, low=value - half, high=value + half, count=len(fits))


def _level(lines: Sequence[Line]) -> float:
    return fmean(line.slope_ml_s for line in lines)


def _expected(fits: Sequence[Fit]) -> float:
    return fmean(abs(fit.step.change_ml_s) for fit in fits)


def _half(estimate: Estimate) -> float:
    return 0.5 * (estimate.high - estimate.low)


def _factors(flows: Sequence[Estimate]) -> list[Estimate]:
    """Return flows as ratios with the mean 1."""
    mean = fmean(flow.value for flow in flows)
    ratios = [_scaled(flow, 1.0 / mean) for flow in flows]
    return [_against_mean(ratios, valve, 1.0) for valve in range(len(ratios))]


def _mean_with_interval(values: Sequence[float]) -> Estimate:
    mean = fmean(values)
    half = t_factor(len(values) - 1, CONFIDENCE) * stdev(values) / math.sqrt(len(values))
    return Estimate(value=mean, low=mean - half, high=mean + half, count=len(values))


def _flows_only(flows: Sequence[Estimate], volume_ml: float) -> IdentifiedValves:
    own = tuple(ValveFigures(factor=factor, lags={}) for factor in _factors(flows))
    return IdentifiedValves(valves=own, lags={}, volume_ml=volume_ml)


def _identify_counted(pieces: Sequence[Piece], count: int) -> IdentifiedValves:
    """Return the flow factors by the autopilot's counts; the pieces' scatter is the interval."""
    shares: list[list[float]] = [[] for _ in range(count)]
    volume_ml = 0.0
    for piece in pieces:
        shares[piece.valve].append(_counted_share(piece))
        volume_ml += float(piece.record.volume_ml[-1] - piece.record.volume_ml[0])
    if min(len(own) for own in shares) < 2:
        raise ValveCourseError("an interval needs two pieces of every valve or more")
    return _flows_only([_mean_with_interval(own) for own in shares], volume_ml)


def _counted_share(piece: Piece) -> float:
    """Return the flow over what the curve says, half at the high level and half at the low one."""
    record = piece.record
    own = [order for order in record.orders if order.valve == piece.valve]
    if len(own) != 3:
        raise ValveCourseError(f"valve {piece.valve + 1}: {len(own)} changes in a piece, not 3")
    settle = settle_s(record.lag) + COUNTED_LATE_S
    opened, lowered, closed = (order.at_s for order in own)
    rest_s = opened - COUNTED_REST_S
    spans_s = ((rest_s, opened), (opened, lowered), (lowered, closed))
    rest, high, low = (
        _counted_flow(piece, from_s + settle, until_s) for from_s, until_s in spans_s
    )
    if not high - rest > 0.0:
        raise ValveCourseError(
            f"valve {piece.valve + 1}: the count does not grow faster while it sprays; look "
            "whether it opens, and whether flow_meter.battery is the flow meter"
        )
    return 0.5 * ((high - rest) / own[0].after_ml_s + (low - rest) / own[1].after_ml_s)


def _counted_flow(piece: Piece, from_s: float, until_s: float) -> float:
    """Return the slope of the counts within a steady stretch [mL/s], by least squares."""
    time_s, volume_ml = piece.record.time_s, piece.record.volume_ml
    within = (time_s >= from_s) & (time_s <= until_s)
    if int(within.sum()) < READINGS_MIN:
        raise ValveCourseError(
            f"valve {piece.valve + 1}: {int(within.sum())} counts of the autopilot within "
            f"{until_s - from_s:.1f} s of steady flow, {READINGS_MIN} are needed"
        )
    away_s = time_s[within] - time_s[within].mean()
    return float((away_s * volume_ml[within]).sum() / (away_s**2).sum())


def _scaled(estimate: Estimate, by: float) -> Estimate:
    return Estimate(
        value=by * estimate.value,
        low=by * estimate.low,
        high=by * estimate.high,
        count=estimate.count,
    )


def _mean(estimates: Sequence[Estimate]) -> Estimate:
    """Return the mean of independent estimates."""
    value = fmean(estimate.value for estimate in estimates)
    half = math.sqrt(math.fsum(_half(each) ** 2 for each in estimates)) / len(estimates)
    count = sum(estimate.count for estimate in estimates)
    return Estimate(value=value, low=value - half, high=value + half, count=count)


def _against_mean(estimates: Sequence[Estimate], own: int, middle: float) -> Estimate:
    """Return one of them with the mean of all moved to `middle`; that mean is uncertain too."""
    count = len(estimates)
    value = estimates[own].value - fmean(each.value for each in estimates) + middle
    halves = [
        _half(each) * ((1.0 - 1.0 / count) if number == own else 1.0 / count)
        for number, each in enumerate(estimates)
    ]
    half = math.sqrt(math.fsum(each**2 for each in halves))
    return Estimate(value=value, low=value - half, high=value + half, count=estimates[own].count)


def identify_caught(caught: Sequence[Sequence[float]]) -> IdentifiedValves:
    """Return the flow factors of valves that were caught one by one; of lags a jug says nothing.

    `caught` is the flow of each valve in each of its catches, in any unit: two catches or more.
    """
    return _flows_only([_mean_with_interval(own) for own in caught], math.nan)
