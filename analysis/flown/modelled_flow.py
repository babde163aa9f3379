"""From executed changes of duty to the flow of each valve: what the set-up says of the sprayer.

Each change of a valve becomes a ramp from one flow to the next, as long as the configured ends of
switching say, that delivers the same volume as a sharp step at its order plus the lag of its kind.
Pulses and the wait for the next period of a trim are left out: means over a period are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.flown.applied_flight import ValveChanges
    from companion.core.nozzle import NozzleSet
    from companion.core.schedule import LagModel

Floats = NDArray[np.float64]
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
        index = np.searchsorted(knot_s, time_s, "right") - 1
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
    changes: ValveChanges, nozzle_sets: Sequence[NozzleSet], lag: LagModel, valve_count: int
) -> list[ValveFlow]:
    """Return the flow of each valve that the executed changes stand for."""
    order_s = ordered_s(changes)
    levels = levels_ml_s(changes, nozzle_sets)
    return [
        ramped(order_s[changes.valve == valve], levels[changes.valve == valve], lag)
        for valve in range(valve_count)
    ]


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
        levels[its] = flow_of(nozzles, changes.duty[its]) / len(nozzles.valves)
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


def ramped(order_s: Floats, levels: Floats, lag: LagModel) -> ValveFlow:
    """Return the flow of one valve from its orders and the levels that they ask for."""
    if not len(levels):
        return ValveFlow(knot_s=np.zeros(0), flow_ml_s=np.zeros(0))
    before = np.concatenate(([0.0], levels[:-1]))
    lag_s, half_s = _lags(before, levels, lag)
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
