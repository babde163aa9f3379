"""From executed changes of duty to the flow of each valve: what the set-up says of the sprayer.

Each change of a valve becomes a ramp from one flow to the next, as long as the configured ends of
switching say, that delivers the same volume as a sharp step at its order plus the lag of its kind.
Pulses and the wait for the next period of a trim are left out: means over a period are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.flown.applied_flight import AppliedFlight, Floats, Series, ValveChanges
    from companion.core.nozzle import NozzleSet
    from companion.core.schedule import LagModel, Timing


Ints = NDArray[np.int64]

ML_S_PER_L_MIN = 1000.0 / 60.0
# Shorter ramps are steps: the sum below divides by their length.
RAMP_MIN_S = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class ValveFlow:
    """The flow of one valve: straight lines between `knot_s`, `flow_ml_s` at each.

    `flow_ml_s` is 0 before the first knot and stays as it is after the last.
    """

    knot_s: Floats
    flow_ml_s: Floats

    def volume_ml(self, time_s: Floats) -> Floats:
        """Return what has come out of the valve until each time, exactly."""
        knot_s, flow = self.knot_s, self.flow_ml_s
        if not len(knot_s):
            return np.zeros(len(time_s))
        lengths_s = np.diff(knot_s)
        at_knots = np.concatenate(([0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]) * lengths_s)))
        # Few knots are sought among many times, not each time among the knots.
        at = np.searchsorted(time_s, knot_s)
        index = np.cumsum(np.bincount(at, minlength=len(time_s) + 1)[:-1]) - 1
        begun = index >= 0
        index = np.maximum(index, 0)
        after_s = np.where(begun, time_s - knot_s[index], 0.0)
        slopes = np.append(np.diff(flow) / np.maximum(lengths_s, 1e-12), 0.0)
        found: Floats = at_knots[index] + (flow[index] + 0.5 * slopes[index] * after_s) * after_s
        return np.maximum.accumulate(found)


def ordered_s(changes: ValveChanges) -> Floats:
    """Return when each order was given: its real time where the output told it, else planned."""
    return np.where(np.isfinite(changes.actual_s), changes.actual_s, changes.planned_s)


def valve_flows(
    changes: ValveChanges,
    nozzle_sets: Sequence[NozzleSet],
    lags: Sequence[LagModel],
    timings: Sequence[Timing] = (),
) -> list[ValveFlow]:
    """Return the flow of each valve that the executed changes stand for; `lags` are of each.

    `timings` say how long a valve that opens rests before its first pulse.
    """
    order_s = ordered_s(changes)
    levels = levels_ml_s(changes, nozzle_sets)
    flows = []
    for valve, lag in enumerate(lags):
        its = changes.valve == valve
        rest_s: Floats | float = 0.0
        # No other output lets a valve rest, whatever the duty.
        if timings and timings[valve].centred is not None:
            rest_s = np.array([timings[valve].rest_s(each) for each in changes.duty[its].tolist()])
        flows.append(ramped(order_s[its], levels[its], lag, rest_s))
    return flows


def levels_ml_s(changes: ValveChanges, nozzle_sets: Sequence[NozzleSet]) -> Floats:
    """Return the flow that the valve of each change has after it.

    In force is the smallest set with all valves that are open then, as in `ordered_ml_s`.
    """
    by_size = sorted(nozzle_sets, key=lambda each: len(each.valves))
    number = set_in_force(changes.valve, changes.duty, by_size)
    if len(number):
        # The last change of a moment knows what all of them together leave open.
        number = number[np.searchsorted(changes.planned_s, changes.planned_s, "right") - 1]
    levels = np.zeros(len(changes.duty))
    for i, nozzles in enumerate(by_size):
        its = (number == i) & np.isin(changes.valve, nozzles.valves)
        shares = np.ones(max(nozzles.valves) + 1)
        shares[list(nozzles.valves)] = [nozzles.share(valve) for valve in nozzles.valves]
        own = shares[changes.valve[its]]
        levels[its] = flow_of(nozzles, changes.duty[its]) * own / len(nozzles.valves)
    return levels


def flow_of(nozzles: NozzleSet, duty: Floats) -> Floats:
    """Return the flow [mL/s] of a whole set at many duties."""
    duties, flows = nozzles.curve.duty, nozzles.curve.flow_l_min
    if duties[0] > 0.0:
        duties, flows = (0.0, *duties), (0.0, *flows)
    found: Floats = np.interp(duty, duties, flows) * ML_S_PER_L_MIN
    return np.where(duty > 0.0, found, 0.0)


def set_in_force(valve: Ints, duty: Floats, by_size: Sequence[NozzleSet]) -> Ints:
    """Return after each change the smallest set that has all valves that are open."""
    if len(by_size) == 1:
        return np.zeros(len(duty), dtype=np.int64)
    members = [set(nozzles.valves) for nozzles in by_size]
    still_open: set[int] = set()
    found = []
    for each, value in zip(valve.tolist(), duty.tolist(), strict=True):
        (still_open.add if value > 0.0 else still_open.discard)(each)
        fits = (i for i, valves in enumerate(members) if still_open <= valves)
        found.append(next(fits, len(members) - 1))
    return np.array(found, dtype=np.int64)


def ramped(
    order_s: Floats, levels: Floats, lag: LagModel, rest_s: Floats | float = 0.0
) -> ValveFlow:
    """Return the flow of one valve from its orders and the levels that they ask for.

    A valve that opens begins `rest_s` later, and has let through the same all the same.
    """
    if not len(levels):
        return ValveFlow(knot_s=np.zeros(0), flow_ml_s=np.zeros(0))
    before = np.concatenate(([0.0], levels[:-1]))
    lag_s, half_s = _lags(before, levels, lag)
    half_s = np.where(before <= 0.0, np.maximum(half_s - rest_s, 0.5 * RAMP_MIN_S), half_s)
    middle_s = order_s + lag.output_s + lag_s
    # What a later order overtakes comes no later than that one: the flow never falls below zero.
    start_s, end_s = (
        np.minimum.accumulate(edge[::-1])[::-1] for edge in (middle_s - half_s, middle_s + half_s)
    )
    knot_s = np.unique(np.concatenate((start_s, end_s)))
    flow = np.zeros(len(knot_s))
    slope = np.zeros(len(knot_s))
    rise = levels - before
    steepness = rise / np.maximum(end_s - start_s, RAMP_MIN_S)
    np.add.at(slope, np.searchsorted(knot_s, start_s), steepness)
    np.add.at(slope, np.searchsorted(knot_s, end_s), -steepness)
    flow[1:] = np.cumsum(np.cumsum(slope)[:-1] * np.diff(knot_s))
    # Sums of rises and falls leave rounding behind where the valve is closed.
    return ValveFlow(knot_s=knot_s, flow_ml_s=np.where(np.abs(flow) < 1e-9, 0.0, flow))


def _lags(before: Floats, after: Floats, lag: LagModel) -> tuple[Floats, Floats]:
    """Return the volume-equivalent lag of each change, and half of the length of its ramp."""
    rise_s = max(lag.on_s - lag.on_start_s, 0.5 * RAMP_MIN_S)
    fall_s = max(lag.off_end_s - lag.off_s, 0.5 * RAMP_MIN_S)
    kinds = [before <= 0.0, after <= 0.0, after > before]
    lag_s = np.select(kinds, [lag.on_s, lag.off_s, lag.up_s], lag.down_s)
    half_s = np.select(kinds, [rise_s, fall_s, min(rise_s, lag.up_s)], min(rise_s, lag.down_s))
    return lag_s, np.maximum(half_s, 0.5 * RAMP_MIN_S)


# What the flow meter counted.


def counted(series: Series) -> tuple[Floats, Floats]:
    """Return times and counts that are sound; a count that began anew goes on from the last."""
    sound = np.isfinite(series.value)
    time_s, value = series.time_s[sound], series.value[sound]
    if not len(value):
        return time_s, value
    rises = np.diff(value)
    # What was counted up to a restart is not lost; what fell between the two counts is.
    return time_s, np.concatenate(([0.0], np.cumsum(np.where(rises >= 0.0, rises, value[1:]))))


# How far a turbine meter, as they are sold, may be off; no journal says that it was weighed.
METER_PERCENT = 3.0
# Such a meter and a curve of a few percent may differ by this much and be sound.
METER_OFF_PERCENT = 6.0


def meter_within_percent(meter_l: float | None, model_l: float) -> float | None:
    """Return how far off the litres of a meter may be; None where the curves contradict it."""
    if meter_l is None or not abs(meter_l - model_l) <= METER_OFF_PERCENT / 100.0 * model_l:
        return None
    return METER_PERCENT


def meter_text(meter_l: float, model_l: float) -> str:
    """Return how sure litres by the meter are, to stand behind its name.

    >>> meter_text(1.02, 1.0), meter_text(0.5, 1.0)
    (', ±3 %', ', which the curves contradict')
    """
    within = meter_within_percent(meter_l, model_l)
    return ", which the curves contradict" if within is None else f", ±{within:g} %"


def metered_l(flight: AppliedFlight) -> float | None:
    """Return what the flow meter counted in all; None without one."""
    if flight.meter_ml is None:
        return None
    _, count_ml = counted(flight.meter_ml)
    return float(count_ml[-1]) / 1000.0 if len(count_ml) > 1 else None


# The flow of a sprayer whose pump makes it: the pump's total, over the sections that are open.

# Below this share of its width a section is closed: what is left of a ramp is rounding.
OPEN_MIN = 1e-6


def pumped_ml(flight: AppliedFlight, time_s: Floats) -> Floats:
    """Return the modelled cumulative volume of each section.

    What the motor was told is known at the decisions only, so the moment of a change is known to
    half of the time between two of them. The flow follows as an exponential after a dead time.
    """
    setup = flight.setup
    if setup.pump is None or setup.pumping is None:
        raise ValueError("the flow is not made by a pump")
    step_s = float(time_s[1] - time_s[0])
    total_ml_s = _followed(flight, setup.pumping.lag, time_s, step_s)
    shares = np.array([[valve.width_m for valve in setup.boom.valves]]).repeat(len(time_s), axis=0)
    if setup.pump.outlet != "always":
        shares *= np.stack([_open_part(flight, i, time_s) for i in range(shares.shape[1])], axis=1)
    whole = shares.sum(axis=1, keepdims=True)
    shares = np.divide(shares, whole, out=np.zeros_like(shares), where=whole > OPEN_MIN)
    drops = shares * total_ml_s[:, np.newaxis] * step_s
    volume_ml: Floats = np.cumsum(drops, axis=0) - drops[:1]
    return volume_ml


def _followed(flight: AppliedFlight, lag: LagModel, time_s: Floats, step_s: float) -> Floats:
    """Return the pump's flow [mL/s] at each time: the ordered one, after its lag."""
    flowing = flight.flow_l_min * ML_S_PER_L_MIN
    dead_s = min(lag.up_s - lag.up_time_s, lag.down_s - lag.down_time_s) + lag.output_s
    last = np.searchsorted(flight.time_s, time_s - dead_s, "right") - 1
    asked = np.where(last >= 0, flowing[np.maximum(last, 0)], 0.0)
    up, down = (
        1.0 - math.exp(-step_s / constant_s) if constant_s > 0.0 else 1.0
        for constant_s in (lag.up_time_s, lag.down_time_s)
    )
    now, found = 0.0, []
    for value in asked.tolist():
        now += (value - now) * (up if value > now else down)
        found.append(now)
    return np.array(found)


def _open_part(flight: AppliedFlight, valve: int, time_s: Floats) -> Floats:
    """Return how far a section is open at each time, 0 to 1."""
    its = flight.changes.valve == valve
    levels = (flight.changes.duty[its] > 0.0).astype(np.float64)
    flow = ramped(ordered_s(flight.changes)[its], levels, flight.setup.lag)
    if not len(flow.knot_s):
        return np.zeros(len(time_s))
    return np.interp(time_s, flow.knot_s, flow.flow_ml_s, left=0.0)
