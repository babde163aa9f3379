"""From the record of a flight to the lags of its sprayer, or why it does not say them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist, fmean, median, stdev, variance
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from analysis.calibration.steps import Kind, Reject, Step, find_steps, settle_s
from analysis.student import t_factor

if TYPE_CHECKING:
    from analysis.calibration.steps import Floats, FlowRecord, Step
    from companion.core.schedule import LagModel


# Means with 95 % intervals from few values: Student's t, and the jackknife for what is no mean.

Item = TypeVar("Item")

CONFIDENCE = 0.95
# Twelve values scatter by more than this times their own sd once in a thousand (chi-square).
EXCESS = 1.7


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A value in seconds with its 95 % interval, from so many steps."""

    value: float
    low: float
    high: float
    count: int

    def shifted(self, by_s: float) -> Estimate:
        """Return the same later by `by_s`."""
        return Estimate(
            value=self.value + by_s, low=self.low + by_s, high=self.high + by_s, count=self.count
        )


def mean_of(values: Sequence[float], sds: Sequence[float]) -> Estimate:
    """Return the mean of steps' lags with the interval of the mean over these very steps.

    It follows from what each fit says of itself, for the lags themselves differ from step to step
    (by the phase of the pulses) and that is no error of their mean. Where they scatter more than
    both explain, something unknown is at work, and the interval is Student's of the scatter.
    """
    count = len(values)
    if count < 2:
        raise ValueError("an interval needs two values or more")
    fitted = math.sqrt(math.fsum(sd**2 for sd in sds)) / count
    scattered = stdev(values) / math.sqrt(count)
    half = NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE) * fitted
    if not scattered <= EXCESS * fitted:
        half = max(half, t_factor(count - 1, CONFIDENCE) * scattered)
    mean = fmean(values)
    return Estimate(value=mean, low=mean - half, high=mean + half, count=count)


def jackknife(statistic: Callable[[Sequence[Item]], float], items: Sequence[Item]) -> Estimate:
    """Return a statistic of all items; its interval from leaving one out at a time."""
    count = len(items)
    if count < 2:
        raise ValueError("an interval needs two values or more")
    value = statistic(items)
    left_out = [statistic([*items[:i], *items[i + 1 :]]) for i in range(count)]
    mean = fmean(left_out)
    variance = (count - 1) / count * math.fsum((each - mean) ** 2 for each in left_out)
    half = t_factor(count - 1, CONFIDENCE) * math.sqrt(variance)
    return Estimate(value=value, low=value - half, high=value + half, count=count)


# The volume-equivalent instant of a step, from cumulative metered volume alone.
#
# The volume before a step lies on one line, the volume after it on another; a sharp step that
# delivers the same volume stands where they meet. Each line goes through the mean over a whole PWM
# period at both ends of its window, so the phase of the pulses does not matter; and since the
# meter's error is one of flow, its sum walks at random and the ends say all there is about the
# slope. Gain and quantisation cancel in the intersection.

# A meter that was silent for this many of its own intervals (or PWM periods) was not there.
SILENT_INTERVALS = 4.0
# A period whose volume is this share of the step away from its line, and this many robust
# deviations, was disturbed: air, a clog, a valve that stuck.
DISTURBED_SHARE = 0.25
DISTURBED_DEVIATIONS = 6.0
MAD_TO_SD = 1.4826
# A count that falls by less has only been rounded.
ROUNDING_ML = 1e-6


class Meter:
    """Cumulative volume as a function of time, and its mean over a PWM period."""

    def __init__(self, time_s: Floats, volume_ml: Floats, *, lag_s: float, period_s: float) -> None:
        if not (len(time_s) >= 2 and bool(np.all(np.diff(time_s) > 0.0))):
            raise ValueError("a meter needs two readings or more, in order of time")
        self.time_s = time_s - lag_s
        self.volume_ml = volume_ml
        self.period_s = period_s
        self.interval_s = float(np.median(np.diff(time_s)))
        rises_ml = np.diff(volume_ml)
        rises_ml = rises_ml[rises_ml > ROUNDING_ML]
        # The least that it ever counted: what it may not have shown yet.
        self.pulse_ml = float(rises_ml.min()) if len(rises_ml) else 0.0
        steps_s = np.diff(self.time_s)
        pieces = 0.5 * (volume_ml[1:] + volume_ml[:-1]) * steps_s
        self._sum: Floats = np.concatenate(([0.0], np.cumsum(pieces)))

    def covers(self, from_s: float, to_s: float) -> bool:
        """Return whether the meter reported all the time, and counted upwards."""
        first = int(np.searchsorted(self.time_s, from_s, side="right")) - 1
        last = int(np.searchsorted(self.time_s, to_s, side="left"))
        if first < 0 or last >= len(self.time_s):
            return False
        gaps_s = np.diff(self.time_s[first : last + 1])
        longest_s = max(SILENT_INTERVALS * self.interval_s, self.period_s)
        grows = bool(np.all(np.diff(self.volume_ml[first : last + 1]) >= -ROUNDING_ML))
        return grows and bool(np.all(gaps_s <= longest_s))

    def at(self, times_s: Floats) -> Floats:
        """Return the volume at times, straight between readings."""
        result: Floats = np.interp(times_s, self.time_s, self.volume_ml)
        return result

    def mean_at(self, times_s: Floats) -> Floats:
        """Return the mean of the volume over the period around each time."""
        half_s = 0.5 * self.period_s
        result: Floats = (self._integral(times_s + half_s) - self._integral(times_s - half_s)) / (
            self.period_s
        )
        return result

    def _integral(self, times_s: Floats) -> Floats:
        i = np.clip(np.searchsorted(self.time_s, times_s, side="right") - 1, 0, len(self._sum) - 1)
        middle = 0.5 * (self.volume_ml[i] + self.at(times_s))
        result: Floats = self._sum[i] + middle * (times_s - self.time_s[i])
        return result


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """The volume in a window of steady flow, through its mean at the end near the step."""

    at_s: float
    volume_ml: float
    slope_ml_s: float
    noise_ml: float  # 1 sd of one period's volume
    worst_ml: float  # the period that is farthest from the others
    deviation_ml: float  # the periods' robust deviation
    periods: int

    def value_ml(self, time_s: float) -> float:
        """Return the line at any time."""
        return self.volume_ml + self.slope_ml_s * (time_s - self.at_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fit:
    """One step: its lag from the mean order, the lag's own uncertainty, and both lines."""

    step: Step
    lag_s: float
    sd_s: float
    before: Line
    after: Line

    @property
    def change_ml_s(self) -> float:
        """Return the measured change of flow."""
        return self.after.slope_ml_s - self.before.slope_ml_s


def fit_step(meter: Meter, step: Step, *, trim_lag_s: float) -> Fit | Reject:
    """Return where a step's volume-equivalent instant lies, or why that cannot be said.

    `trim_lag_s` is when trims take effect; what they add is taken out of the metered volume.
    """
    if not meter.covers(step.before_s[0], step.after_s[1]):
        return Reject.NO_METER
    before = _line(meter, step, step.before_s, near_end=True, trim_lag_s=trim_lag_s)
    after = _line(meter, step, step.after_s, near_end=False, trim_lag_s=trim_lag_s)
    change_ml_s = after.slope_ml_s - before.slope_ml_s
    if not change_ml_s * step.change_ml_s > 0.0:
        return Reject.NOT_FOLLOWED
    if any(_is_disturbed(line, change_ml_s, meter.period_s) for line in (before, after)):
        return Reject.UNSTEADY
    gap_s = after.at_s - before.at_s
    rise_ml = after.volume_ml - before.volume_ml - before.slope_ml_s * gap_s
    # From the near end of the line before: rise = change * (time after the step).
    at_s = after.at_s - rise_ml / change_ml_s
    sd_s = _sd_s(before, after, at_s, meter.period_s) / abs(change_ml_s)
    return Fit(step=step, lag_s=at_s - step.at_s, sd_s=sd_s, before=before, after=after)


def trimmed_ml(step: Step, times_s: Floats, lag_s: float, *, valve: int | None = None) -> Floats:
    """Return what trims have added to the volume, so that without it the flow only steps.

    It then flows before the step as it did just before, and after it as it did just after: a trim
    before the step is taken as made from the beginning, and one after it as never made. Of all
    valves, or of one.
    """
    added: Floats = np.zeros(len(times_s))
    ordered_s = {order.valve: order.at_s for order in step.orders}
    for trim in step.trims:
        if valve is not None and trim.valve != valve:
            continue
        since_s = times_s - (trim.at_s + lag_s)
        if trim.at_s < ordered_s.get(trim.valve, step.at_s):
            added += trim.change_ml_s * np.maximum(-since_s, 0.0)
        else:
            added += trim.change_ml_s * np.maximum(since_s, 0.0)
    return added


def _line(
    meter: Meter, step: Step, window_s: tuple[float, float], *, near_end: bool, trim_lag_s: float
) -> Line:
    """Return the line of one window; its near point is the window's end or its beginning."""
    period_s = meter.period_s
    periods = math.floor((window_s[1] - window_s[0]) / period_s + 1e-9)
    sign = -1.0 if near_end else 1.0
    near_s = (window_s[1] if near_end else window_s[0]) + sign * 0.5 * period_s
    anchors_s: Floats = near_s + sign * period_s * np.arange(periods, dtype=np.float64)
    volume_ml = meter.mean_at(anchors_s) - trimmed_ml(step, anchors_s, trim_lag_s)
    slope = (volume_ml[-1] - volume_ml[0]) / (anchors_s[-1] - anchors_s[0])
    increments = sign * np.diff(volume_ml)
    # The mean over a period smooths a random walk's increments to two thirds of their variance.
    noise_ml = float(np.std(increments, ddof=1)) * math.sqrt(1.5)
    off_ml = np.abs(increments - np.median(increments))
    return Line(
        at_s=near_s,
        volume_ml=float(volume_ml[0]),
        slope_ml_s=float(slope),
        noise_ml=noise_ml,
        worst_ml=float(off_ml.max()),
        deviation_ml=MAD_TO_SD * float(np.median(off_ml)),
        periods=periods - 1,
    )


def _sd_s(before: Line, after: Line, at_s: float, period_s: float) -> float:
    """Return the uncertainty of the volume at the intersection [mL]: walk, and both slopes."""
    walk = 0.0
    for line in (before, after):
        away_periods = abs(line.at_s - at_s) / period_s
        walk += line.noise_ml**2 * (away_periods + away_periods**2 / line.periods)
    return math.sqrt(walk)


def _is_disturbed(line: Line, change_ml_s: float, period_s: float) -> bool:
    """Return whether a period of a window is out of the line's own scatter."""
    share_ml = DISTURBED_SHARE * abs(change_ml_s) * period_s
    return not line.worst_ml <= max(share_ml, DISTURBED_DEVIATIONS * line.deviation_ml)


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
        fits, more = fit_all(meter, steps, record)
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


def fit_all(
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
        if not followed:
            continue
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


# First and last flow: what the border rule needs, as bounds that err to the safe side.
#
# The meter's counts after the orders of all steps of a kind, laid over each other, give one curve
# of delivered volume, fine where one step's readings are coarse. A flow that ramps up from zero
# delivers a volume that grows with the square of the time, so the two times at which a small volume
# and four times as much have passed give the first flow: 2 t(u) - t(4u). A steeper onset, and the
# straight lines between readings, put it earlier than it is; the same towards the end puts the last
# flow later. Both err so that nothing falls outside a border; and since less than a pulse does not
# show, the outer end of each interval lies farther out by the time of one.

# The small volume, in time of the full flow, as a share of the lag: 2 ms at a lag of 0.1 s.
SMALL_SHARE = 0.02
SMALL_MIN_S = 0.002
GRID = 4000
# Steps from duties this near to each other end alike.
ALIKE_DUTY = 0.15


def first_flow(meter: Meter, fits: Sequence[Fit], lag: LagModel, *, lag_s: float) -> Estimate:
    """Return from steps on when the flow begins after the order of a fully open valve.

    A pulse stands in the middle of its period: with a duty below 1 the first one begins later by
    half of the off-time, which is taken off. So no lag of a configuration has a gap in it,
    whatever it was measured by: at the border the core adds that of each opening itself
    (`Timing.rest_s`), and volume-equivalent lags do not depend on where a pulse stands.
    """
    until_s = settle_s(lag)
    curves = []
    for fit in fits:
        ahead_s = 0.5 * (1.0 - max(order.after for order in fit.step.orders)) * meter.period_s
        grid_s = _grid(until_s) + ahead_s
        volume_ml = _volume(meter, fit, fit.step.orders[0].at_s + grid_s)
        line_ml = np.array([fit.before.value_ml(fit.step.orders[0].at_s)])
        curves.append((volume_ml - line_ml) / fit.after.slope_ml_s)
    found = jackknife(lambda chosen: _onset(np.mean(chosen, axis=0), until_s, lag_s), curves)
    return replace(found, low=found.low - _hidden_s(meter, [fit.after for fit in fits]))


def last_flow(meter: Meter, fits: Sequence[Fit], lag: LagModel, *, lag_s: float) -> Estimate:
    """Return from steps off when the flow has ended after the order.

    Only the steps from the largest duty count: a valve that is ordered off between two pulses has
    closed already.
    """
    until_s = settle_s(lag)
    curves = []
    most = max(_duty_before(fit) for fit in fits)
    for fit in fits:
        if _duty_before(fit) < most - ALIKE_DUTY:
            continue
        at_s = fit.step.orders[-1].at_s
        # Backwards from where all has settled: what is still to come.
        volume_ml = _volume(meter, fit, at_s + until_s - _grid(until_s))
        line_ml = np.array([fit.after.value_ml(at_s + until_s)])
        curves.append((line_ml - volume_ml) / fit.before.slope_ml_s)
    rest_s = max(until_s - lag_s, 0.0)
    found = jackknife(lambda chosen: _onset(np.mean(chosen, axis=0), until_s, rest_s), curves)
    return Estimate(
        value=until_s - found.value,
        low=until_s - found.high,
        high=until_s - found.low + _hidden_s(meter, [fit.before for fit in fits]),
        count=found.count,
    )


def _hidden_s(meter: Meter, lines: Sequence[Line]) -> float:
    """Return how long the flow may last before the meter shows it: one pulse of the full flow."""
    return meter.pulse_ml / max(line.slope_ml_s for line in lines)


def _duty_before(fit: Fit) -> float:
    return max(order.before for order in fit.step.orders)


def _grid(until_s: float) -> Floats:
    return np.linspace(0.0, until_s, GRID + 1, dtype=np.float64)


def _volume(meter: Meter, fit: Fit, times_s: Floats) -> Floats:
    volume_ml: Floats = meter.at(times_s) - trimmed_ml(fit.step, times_s, fit.lag_s)
    return volume_ml


def _onset(curve_s: Floats, until_s: float, lag_s: float) -> float:
    """Return when a curve of volume (in time of the full flow) begins to rise."""
    small_s = max(SMALL_SHARE * lag_s, SMALL_MIN_S)
    # The last time below a level: noise around zero is no onset.
    times_s = []
    for level_s in (small_s, 4.0 * small_s):
        below = np.flatnonzero(curve_s < level_s)
        times_s.append(until_s * (int(below[-1]) + 1 if len(below) else 0) / GRID)
    return max(2.0 * times_s[0] - times_s[1], 0.0)
