"""The volume-equivalent instant of a step, from cumulative metered volume alone.

The volume before a step lies on one line, the volume after it on another; a sharp step that
delivers the same volume stands where they meet. Each line goes through the mean over a whole PWM
period at both ends of its window, so the phase of the pulses does not matter; and since the
meter's error is one of flow, its sum walks at random and the ends say all there is about the
slope. Gain and quantisation cancel in the intersection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.calibration.steps import Reject

if TYPE_CHECKING:
    from analysis.calibration.flow_record import Floats
    from analysis.calibration.steps import Step

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
