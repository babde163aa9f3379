"""The modelled volume scaled to what the flow meter counted.

A meter counts for all valves together, and pulse by pulse: so in windows long enough for its
resolution the model's volume is scaled by what came through, and the model says which valve.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight, Floats, Series

# A window holds at least so much: 230 pulses of a meter of 4600 pulses/L, 0.4 % each way.
WINDOW_ML = 50.0
# A meter that differs by more has failed, or its flow is not the valves': the model stands there.
RATIO_MIN, RATIO_MAX = 0.5, 2.0


def counted(series: Series) -> tuple[Floats, Floats]:
    """Return times and counts that are sound; a count that began anew goes on from the last."""
    sound = np.isfinite(series.value)
    time_s, value = series.time_s[sound], series.value[sound]
    if not len(value):
        return time_s, value
    rises = np.diff(value)
    # What was counted up to a restart is not lost; what fell between the two counts is.
    return time_s, np.concatenate(([0.0], np.cumsum(np.where(rises >= 0.0, rises, value[1:]))))


def metered(flight: AppliedFlight, time_s: Floats, volume_ml: Floats) -> Floats:
    """Return the modelled volume with the meter's total; the model where there is no meter."""
    if flight.meter_ml is None:
        return volume_ml
    count_s, count_ml = counted(flight.meter_ml)
    if len(count_s) < 2:
        return volume_ml
    factors = _factors(time_s, volume_ml.sum(axis=1), count_s, count_ml)
    steps = np.diff(volume_ml, axis=0) * factors[:, np.newaxis]
    return np.concatenate((volume_ml[:1], volume_ml[0] + np.cumsum(steps, axis=0)))


def _factors(time_s: Floats, total_ml: Floats, count_s: Floats, count_ml: Floats) -> Floats:
    """Return meter over model for every step of time; 1 outside the meter's time."""
    model_ml = np.interp(count_s, time_s, total_ml)
    inside = (count_s >= time_s[0]) & (count_s <= time_s[-1])
    model_ml, read_ml, read_s = model_ml[inside], count_ml[inside], count_s[inside]
    factors = np.ones(len(time_s) - 1)
    if len(read_s) < 2 or not model_ml[-1] - model_ml[0] >= WINDOW_ML:
        return factors
    windows = max(int((model_ml[-1] - model_ml[0]) / WINDOW_ML), 1)
    wanted = np.linspace(model_ml[0], model_ml[-1], windows + 1)
    ends = np.unique(np.clip(np.searchsorted(model_ml, wanted), 0, len(model_ml) - 1))
    given, asked = np.diff(read_ml[ends]), np.diff(model_ml[ends])
    ratio = np.divide(given, asked, out=np.ones(len(asked)), where=asked > 0.0)
    ratio[~((ratio >= RATIO_MIN) & (ratio <= RATIO_MAX))] = 1.0
    middle_s = 0.5 * (time_s[1:] + time_s[:-1])
    index = np.searchsorted(read_s[ends], middle_s, "right") - 1
    known = (index >= 0) & (index < len(ratio))
    factors[known] = ratio[index[known]]
    return factors
