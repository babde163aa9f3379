"""What a wrong flow is, and of which valve: names for what `detection.py` has noticed.

Nozzles and valves obey flow = conductance x sqrt(pressure). What is wrong behind the pressure
sensor moves flow and pressure in opposite directions and changes the conductance; what is wrong
before it moves both the same way and leaves the conductance as it was.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from companion.core.liquid_bins import Bin
from companion.core.types import FaultKind

# A conductance that moves by less than this share of the flow's move is healthy.
SUPPLY_SHARE = 0.5
# A loss of this much of one valve's flow is that valve shut; the pressure that rises for the
# others hides an eighth of it (14.6 of 16.7 % on the twin of wang-2024).
SHUT_SHARE = (0.70, 1.20)
OPEN_SHARE = (0.75, 1.25)
# Bins that differ by more than this from one to the next are no liquid: healthy ones differ by 1 %.
RESTLESS_SHARE = 0.06
# One valve is told from the next best by this many squared standard deviations: 1 in 2 000.
TOLD_APART = 12.0
# Of a bin: meter, its pulses, and what the lags leave at a change.
NOISE_SHARE = 0.02
NOISE_ML = 0.5
# Pressures over expected: shut nozzles raise it by a third, a stopped pump leaves little.
PRESSURE_SHUT = 1.15
PRESSURE_LOST = 0.75


class Evidence(NamedTuple):
    """The bins since a fault began, means of flow and pressure over expected; and the sprayer."""

    bins: tuple[Bin, ...]
    gain: float
    flow: float
    pressure: float | None
    open_ml_s: float
    restless_share: float = RESTLESS_SHARE

    @classmethod
    def of(
        cls,
        bins: Sequence[Bin],
        *,
        gain: float,
        pressure_gain: float,
        open_ml_s: float,
        restless_share: float = RESTLESS_SHARE,
    ) -> Evidence:
        """Return the evidence of some bins; the first of them may lie before the fault."""
        sure = tuple(bins[1:]) or tuple(bins)
        expected_ml = gain * math.fsum(each.all_ml for each in sure)
        pressures = [each.pressure for each in sure if each.pressure is not None]
        return cls(
            bins=sure,
            gain=gain,
            flow=math.fsum(each.metered_ml for each in sure) / expected_ml,
            pressure=_mean(pressures) / pressure_gain if pressures else None,
            open_ml_s=open_ml_s,
            restless_share=restless_share,
        )

    @property
    def is_restless(self) -> bool:
        """Whether the flow jumps from bin to bin, as no liquid does."""
        flows = [each.metered_ml / (self.gain * each.all_ml) for each in self.bins]
        moves = [abs(b - a) for a, b in pairwise(flows)]
        return len(moves) >= 2 and _mean(moves) > self.restless_share

    @property
    def is_supply(self) -> bool:
        """Whether flow and pressure agree with each other: the nozzles are as they were."""
        if self.pressure is None or not self.pressure > 0.0:
            return False
        conductance = self.flow / math.sqrt(self.pressure)
        return abs(conductance - 1.0) < SUPPLY_SHARE * abs(self.flow - 1.0)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


def name_of_nothing(evidence: Evidence, *, is_air_before: bool, is_tank_low: bool) -> FaultKind:
    """Return why nothing of what is ordered is metered."""
    pressure = evidence.pressure
    if pressure is None:
        return FaultKind.TANK_EMPTY if is_tank_low or is_air_before else FaultKind.NO_FLOW
    if pressure < PRESSURE_LOST:
        return FaultKind.TANK_EMPTY if is_tank_low or is_air_before else FaultKind.PUMP_OFF
    return FaultKind.NO_FLOW if pressure > PRESSURE_SHUT else FaultKind.DEAD_METER


def name_of(evidence: Evidence) -> FaultKind:
    """Return what is wrong with a flow that is too small or too large."""
    if evidence.is_restless:
        return FaultKind.AIR
    if evidence.is_supply:
        return FaultKind.SUPPLY
    if evidence.flow < 1.0:
        share = _share(evidence, is_open=False)
        return FaultKind.STUCK_CLOSED if _within(share, SHUT_SHARE) else FaultKind.CLOG
    share = _share(evidence, is_open=True)
    return FaultKind.STUCK_OPEN if _within(share, OPEN_SHARE) else FaultKind.LEAK


def _within(share: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] <= share <= bounds[1]


def _share(evidence: Evidence, *, is_open: bool) -> float:
    """Return the wrong flow over that of one whole valve, the mean one of those in use."""
    wrong_ml = valve_ml = 0.0
    for each in evidence.bins:
        used = [volume for volume in each.expected_ml if volume > 0.0]
        if not used:
            continue
        mean_ml = evidence.gain * _mean(used)
        wrong_ml += each.metered_ml - evidence.gain * each.all_ml
        open_ml = evidence.gain * evidence.open_ml_s * (each.end_s - each.begin_s)
        valve_ml += open_ml - mean_ml if is_open else mean_ml
    return abs(wrong_ml) / valve_ml if valve_ml > 0.0 else 0.0


def valve_of(bins: Sequence[Bin], *, gain: float, open_ml_s: float, is_open: bool) -> int | None:
    """Return the valve whose orders explain the wrong flow; None where several do as well.

    Valves that always have the same duty cannot be told apart; the border, sets of nozzles,
    plots beside each other and clicks of single valves tell.
    """
    if not bins or len(bins[0].expected_ml) < 2:
        return None
    misfits = []
    for valve in range(len(bins[0].expected_ml)):
        shapes = []
        for each in bins:
            ordered_ml = gain * each.expected_ml[valve]
            open_ml = gain * open_ml_s * (each.end_s - each.begin_s)
            shapes.append(open_ml - ordered_ml if is_open else -ordered_ml)
        misfits.append((_misfit(bins, shapes, gain), valve))
    misfits.sort()
    return misfits[0][1] if misfits[1][0] - misfits[0][0] > TOLD_APART else None


def _misfit(bins: Sequence[Bin], shapes: Sequence[float], gain: float) -> float:
    """Return the weighted squares that the best share, 0 to 1.2, of `shapes` leaves over."""
    weights, wrong = [], []
    for each in bins:
        wrong.append(each.metered_ml - gain * each.all_ml)
        weights.append(1.0 / (NOISE_ML + NOISE_SHARE * gain * each.all_ml) ** 2)
    rows = list(zip(weights, shapes, wrong, strict=True))
    square = math.fsum(w * s * s for w, s, _ in rows)
    share = math.fsum(w * s * r for w, s, r in rows) / square if square > 0.0 else 0.0
    share = min(max(share, 0.0), 1.2)
    return math.fsum(w * (r - share * s) ** 2 for w, s, r in rows)
