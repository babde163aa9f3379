"""P1's lag distance: from the boundary to where the total flow stays at its new target.

P1 read it off a log of 5 positions a second; here it is read off the truth, so that the figures
differ by up to half a metre for that reason alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.changes import Change, changes_of
from analysis.lag import SMALLEST_STEP
from analysis.smoothing import rise_over
from analysis.track import Floats, Track
from analysis.transitions import LEVEL_FROM, LEVEL_TO, ML_M_PER_L_HA_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.changes import Run
    from companion.core.types import TimedChange

BAND_OF_STEP = 0.10
STAY_S = 0.3
ORDER_BEFORE_S = 2.0
# An order belongs to a change when it moves the duty by this much of the change, relatively.
ORDER_OF_STEP = 0.4


@dataclass(frozen=True, slots=True, kw_only=True)
class SettledStep:
    """A change of the boom centre's rate; `lag_distance_m` is None where it is apart.

    `small` is below 8 %; a change that is not small and has no distance never settled.
    """

    change: Change
    small: bool
    lag_distance_m: float | None


def measure_settled(
    boom: Track, stretches: Sequence[Run], orders: Sequence[TimedChange]
) -> list[SettledStep]:
    """Return P1's lag distance of every change inside the field.

    `boom` is the whole boom as one strip. The target is what the new rate asks for at the actual
    speed, times what the flow in the second half of the stretch is of what was asked there: a
    sprayer that settles 2 % beside its target has settled.
    """
    flow_ml_s = rise_over(boom.volume_ml, boom.period_steps) / boom.period_s
    executed = _Orders(orders)
    settled_s = float(boom.time_s[0])
    steps: list[SettledStep] = []
    for i, change in enumerate(changes_of(boom, stretches)):
        if change is None or change.border:
            continue
        before, after = stretches[i], stretches[i + 1]
        if not change.relative >= SMALLEST_STEP:
            steps.append(SettledStep(change=change, small=True, lag_distance_m=None))
            continue
        begin_s = max(before.start_s, change.time_s - ORDER_BEFORE_S, settled_s)
        begin_s = executed.first_s(change, begin_s, after.end_s)
        at_s = _settles_at(boom, flow_ml_s, (before, after), begin_s)
        lag_m = None
        if at_s is not None:
            lag_m = boom.value(boom.distance_m, at_s) - change.distance_m
            settled_s = at_s
        steps.append(SettledStep(change=change, small=False, lag_distance_m=lag_m))
    return steps


class _Orders:
    """How much each executed order moved its valve's duty, relatively, in order of time."""

    def __init__(self, orders: Sequence[TimedChange]) -> None:
        last: dict[int, float] = {}
        moves: list[float] = []
        for order in orders:
            before = last.get(order.valve, 0.0)
            moves.append(order.duty / before - 1.0 if before > 0.0 else float(order.duty > 0.0))
            last[order.valve] = order.duty
        self.at_s = np.array([order.at_s for order in orders])
        self.moves = np.array(moves)

    def first_s(self, change: Change, begin_s: float, end_s: float) -> float:
        """Return when the first order for a change came; `begin_s` when there is none."""
        opens = not change.before_l_ha > 0.0
        part = 1.0 if opens else change.after_l_ha / change.before_l_ha - 1.0
        low, high = np.searchsorted(self.at_s, (begin_s, end_s))
        fits = np.flatnonzero(self.moves[low:high] / part >= ORDER_OF_STEP)
        return float(self.at_s[low + fits[0]]) if len(fits) else begin_s


def _asked_ml_s(boom: Track, rate_l_ha: float, where: slice) -> Floats:
    asked: Floats = rate_l_ha * ML_M_PER_L_HA_M * boom.across_m[where] * boom.speed_m_s[where]
    return asked


def _settles_at(
    boom: Track, flow_ml_s: Floats, stretches: tuple[Run, Run], begin_s: float
) -> float | None:
    """Return from when on the flow stays in its band; None where it does not before the end."""
    before, after = stretches
    where = slice(boom.sample(begin_s), boom.sample(after.end_s) + 1)
    target = _asked_ml_s(boom, after.rate_l_ha, where) * _correction(boom, flow_ml_s, after)
    step = _asked_ml_s(boom, abs(after.rate_l_ha - before.rate_l_ha), where)
    near = np.abs(flow_ml_s[where] - target) <= BAND_OF_STEP * step
    needed = max(round(STAY_S / boom.step_s), 1)
    if len(near) <= needed:
        return None
    count = np.concatenate(([0], np.cumsum(near)))
    stays = np.flatnonzero(count[needed:] - count[:-needed] == needed)
    return float(boom.time_s[where.start + stays[0]]) if len(stays) else None


def _correction(boom: Track, flow_ml_s: Floats, stretch: Run) -> float:
    """Return the flow that a stretch settled to over the flow that was asked there."""
    if not stretch.rate_l_ha > 0.0:
        return 1.0
    where = slice(
        boom.sample(stretch.start_s + LEVEL_FROM * stretch.dwell_s),
        boom.sample(stretch.start_s + LEVEL_TO * stretch.dwell_s) + 1,
    )
    asked = _asked_ml_s(boom, stretch.rate_l_ha, where)
    return float(flow_ml_s[where].sum() / asked.sum()) if asked.sum() > 0.0 else 1.0
