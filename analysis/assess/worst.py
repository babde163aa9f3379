"""How far off the worst change of a flight may lie, as a bound and not as a guess.

The largest lag distance of the model is no such figure: it leaves out what the journal cannot
know, and the truth of simulated flights was up to three times as large. Here every change has its
modelled distance and an uncertainty; the bound is the distance that all of them keep with a
probability of 95 %, taken as independent. Where errors are shared, as of valves over one boundary,
the true probability is higher (Sidak 1967, JASA 62:626). `python -m tests.bench.worst` measures it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from companion.core.inputs import Fix

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.lag import Step
    from companion.core.schedule import LagModel

Floats = NDArray[np.float64]

CONFIDENCE = 0.95
# Standard deviations of what a journal cannot know. Position of a receiver with a fixed RTK
# solution: 1.4 cm of noise and 1.4 cm that wanders (1 cm + 1 ppm, as receivers state it).
POSITION_M = 0.020
# When a position was measured: the autopilot's jitter, and a calibration that is good to 5 ms.
JITTER_S, CALIBRATION_S = 0.003, 0.005
# When an order acts: a servo frame of 20 ms, evenly spread, and where in it the pulse falls.
FRAME_S, PULSE_S = 0.0058, 0.005
# How much the valves of a boom differ in their lag.
VALVE_SHARE = 0.05
# The flow's own noise moves a small step more than a large one: this over the relative step.
# Found on 60 twin flights, and tried on others.
FLOW_M = 0.013
_HALVINGS = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class Worst:
    """The bound in metres, or None and why there is none; `count` is of the changes it is for."""

    bound_m: float | None
    why_not: str
    count: int

    def as_json(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            "bound_m": self.bound_m,
            "confidence": CONFIDENCE,
            "why_not": self.why_not,
            "count": self.count,
        }


def worst_of(flight: AppliedFlight, steps: Sequence[Step]) -> Worst:
    """Return how far off the worst measured change may lie; borders are not among them."""
    measured = [
        step for step in steps if step.lag_distance_m is not None and not step.change.border
    ]
    why_not = _why_not(flight, len(measured))
    if why_not:
        return Worst(bound_m=None, why_not=why_not, count=len(measured))
    lag_m = np.array([step.lag_distance_m for step in measured], dtype=np.float64)
    sd_m = np.array([uncertainty_m(step, flight.setup.lag) for step in measured])
    return Worst(bound_m=bound_m(lag_m, sd_m), why_not="", count=len(measured))


def _why_not(flight: AppliedFlight, count: int) -> str:
    if not count:
        return "no change of rate was measured"
    if flight.setup.pumping is not None:
        return "the pump makes the flow, and when it does is known too roughly"
    if flight.unknown or flight.lost:
        return "a part of the journal is missing"
    if flight.fix is None:
        return "the journal has no quality of the position"
    begin = np.searchsorted(flight.fix.time_s, flight.time_s[0], "right") - 1
    told = flight.fix.value[max(int(begin), 0) :]
    if not len(told) or not (told >= Fix.RTK_FIXED).all():
        return "the position was not a fixed RTK solution all the time: it may be off by metres"
    return ""


def uncertainty_m(step: Step, lag: LagModel) -> float:
    """Return one standard deviation of where a change fell, in metres along the track."""
    change = step.change
    its_s = {
        (False, True): lag.on_s,
        (True, False): lag.off_s,
    }.get(
        (change.before_l_ha > 0.0, change.after_l_ha > 0.0),
        lag.up_s if change.after_l_ha > change.before_l_ha else lag.down_s,
    )
    time_s = math.hypot(JITTER_S, CALIBRATION_S, FRAME_S, PULSE_S, VALVE_SHARE * its_s)
    return math.hypot(POSITION_M, change.speed_m_s * time_s, FLOW_M / change.relative)


def bound_m(lag_m: Floats, sd_m: Floats, confidence: float = CONFIDENCE) -> float:
    """Return the distance that all changes keep with this probability.

    >>> round(bound_m(np.zeros(1), np.ones(1)), 2)
    1.96
    >>> round(bound_m(np.zeros(200), np.full(200, 0.05)), 2)
    0.18
    """
    low = float(np.abs(lag_m).max())
    high = low + 10.0 * float(sd_m.max())
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        inside = _normal((middle - lag_m) / sd_m) - _normal((-middle - lag_m) / sd_m)
        low, high = (low, middle) if float(np.prod(inside)) >= confidence else (middle, high)
    return high


def _normal(values: Floats) -> Floats:
    """Return the normal distribution's cumulative function."""
    found: Floats = np.array([0.5 * math.erfc(-each / math.sqrt(2.0)) for each in values.tolist()])
    return found
