"""The flow of a sprayer whose pump makes it: the pump's total, over the sections that are open."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from analysis.flown.modelled_flow import ML_S_PER_L_MIN, ordered_s, ramped

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight, Floats
    from companion.core.schedule import LagModel

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
    if setup.pump.way != "always":
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
