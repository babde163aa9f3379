"""From the record of a flight to the lags of its sprayer, or why it does not say them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean, median, variance
from typing import TYPE_CHECKING

from analysis.calibration.ends import first_flow, last_flow
from analysis.calibration.interval import Estimate, mean_of
from analysis.calibration.lag_fit import MAD_TO_SD, Fit, Meter, fit_step
from analysis.calibration.steps import Kind, Reject, Step, find_steps

if TYPE_CHECKING:
    from analysis.calibration.flow_record import FlowRecord

STEPS_MIN = 6
# The ends are bounds for every single change: they lie this many sd of the lags farther out.
SPREAD_SDS = 2.0
# A turbine's own delay (Wang et al. 2024 state 1 ms for theirs).
METER_LAG_S = 0.001
# The first pass finds when trims act, the second takes them out there.
PASSES = 2
# A step whose measured change is this far from the others', against its order, was not followed.
FOLLOWED_SHARE = 0.25
# Deviations from the kind's median, of the kind (robust) or of the step's own fit if that is more.
ODD_DEVIATIONS = 4.5
# Nothing within this of the median is odd: no meter tells times nearer to each other.
ODD_MIN_S = 0.001


@dataclass(frozen=True, slots=True, kw_only=True)
class Identified:
    """What a flight says; a kind with too few steps is missing, and so is what needs it.

    Lags are those at the output: `output_s` of the configuration is taken off.
    """

    lags: dict[Kind, Estimate]
    on_start: Estimate | None
    off_end: Estimate | None
    output_s: float
    fits: tuple[Fit, ...]
    found: Counter[Kind]
    rejected: Counter[Reject]

    @property
    def missing(self) -> tuple[Kind, ...]:
        """Return the kinds that have too few steps."""
        return tuple(kind for kind in Kind if kind not in self.lags)


def identify(record: FlowRecord, *, meter_lag_s: float = METER_LAG_S) -> Identified:
    """Return the lags by kind with 95 % intervals, over all steps that were not disturbed."""
    steps, rejected = find_steps(record)
    fits: list[Fit] = []
    meter = None
    if len(record.time_s) >= 2:
        meter = Meter(record.time_s, record.volume_ml, lag_s=meter_lag_s, period_s=record.period_s)
        fits, more = _fit_all(meter, steps, record)
        rejected += more
    else:
        rejected[Reject.NO_METER] += len(steps)
    output_s = record.lag.output_s
    lags = {}
    for kind in Kind:
        chosen = [fit for fit in fits if fit.step.kind is kind]
        if len(chosen) >= STEPS_MIN:
            mean = mean_of([fit.lag_s for fit in chosen], [fit.sd_s for fit in chosen])
            lags[kind] = mean.shifted(-output_s)
    ends: dict[Kind, Estimate] = {}
    for kind, end in ((Kind.ON, first_flow), (Kind.OFF, last_flow)):
        if kind in lags and meter is not None:
            chosen = [fit for fit in fits if fit.step.kind is kind]
            lag_s = lags[kind].value + output_s
            found = end(meter, chosen, record.lag, lag_s=lag_s).shifted(-output_s)
            beyond_s = SPREAD_SDS * _spread_s(chosen)
            if kind is Kind.ON:
                ends[kind] = replace(found, low=found.low - beyond_s)
            else:
                ends[kind] = replace(found, high=found.high + beyond_s)
    return Identified(
        lags=lags,
        on_start=ends.get(Kind.ON),
        off_end=ends.get(Kind.OFF),
        output_s=output_s,
        fits=tuple(fits),
        found=Counter(step.kind for step in steps),
        rejected=rejected,
    )


def _spread_s(fits: Sequence[Fit]) -> float:
    """Return by how much the lags themselves differ from step to step, the fits' own error off."""
    own = fmean(fit.sd_s**2 for fit in fits)
    return math.sqrt(max(variance(fit.lag_s for fit in fits) - own, 0.0))


def _fit_all(
    meter: Meter, steps: Sequence[Step], record: FlowRecord
) -> tuple[list[Fit], Counter[Reject]]:
    """Return the steps that can be used, with their lags, and why the others cannot."""
    trim_lag_s = fmean((record.lag.up_s, record.lag.down_s)) + record.lag.output_s
    fits: list[Fit] = []
    rejected: Counter[Reject] = Counter()
    for _ in range(PASSES):
        answers = [fit_step(meter, step, trim_lag_s=trim_lag_s) for step in steps]
        fits = [answer for answer in answers if isinstance(answer, Fit)]
        rejected = Counter(answer for answer in answers if isinstance(answer, Reject))
        fits, more = _without_odd(fits)
        rejected += more
        small = [fit.lag_s for fit in fits if fit.step.kind in (Kind.UP, Kind.DOWN)]
        if small:
            trim_lag_s = median(small)
    return fits, rejected


def _without_odd(fits: Sequence[Fit]) -> tuple[list[Fit], Counter[Reject]]:
    """Return the steps that agree with the others of their kind."""
    rejected: Counter[Reject] = Counter()
    kept: list[Fit] = []
    for kind in Kind:
        chosen = [fit for fit in fits if fit.step.kind is kind]
        if not chosen:
            continue
        shares = [fit.change_ml_s / fit.step.change_ml_s for fit in chosen]
        share = median(shares)
        followed = [
            fit
            for fit, each in zip(chosen, shares, strict=True)
            if abs(each / share - 1.0) <= FOLLOWED_SHARE
        ]
        rejected[Reject.NOT_FOLLOWED] += len(chosen) - len(followed)
        middle_s = median(fit.lag_s for fit in followed)
        off_s = [abs(fit.lag_s - middle_s) for fit in followed]
        deviation_s = MAD_TO_SD * median(off_s)
        near = [
            fit
            for fit, each in zip(followed, off_s, strict=True)
            if each <= max(ODD_DEVIATIONS * max(deviation_s, fit.sd_s), ODD_MIN_S)
        ]
        rejected[Reject.ODD] += len(followed) - len(near)
        kept += near
    return kept, +rejected
