"""First and last flow: what the border rule needs, as bounds that err to the safe side.

The meter's counts after the orders of all steps of a kind, laid over each other, give one curve
of delivered volume, fine where one step's readings are coarse. A flow that ramps up from zero
delivers a volume that grows with the square of the time, so the two times at which a small volume
and four times as much have passed give the first flow: 2 t(u) - t(4u). A steeper onset, and the
straight lines between readings, put it earlier than it is; the same towards the end puts the last
flow later. Both err so that nothing falls outside a border; and since less than a pulse does not
show, the outer end of each interval lies farther out by the time of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.calibration.interval import Estimate, jackknife
from analysis.calibration.lag_fit import trimmed_ml
from analysis.calibration.steps import settle_s

if TYPE_CHECKING:
    from analysis.calibration.flow_record import Floats
    from analysis.calibration.lag_fit import Fit, Line, Meter
    from companion.core.schedule import LagModel

# The small volume, in time of the full flow, as a share of the lag: 2 ms at a lag of 0.1 s.
SMALL_SHARE = 0.02
SMALL_MIN_S = 0.002
GRID = 4000
# Steps from duties this near to each other end alike.
ALIKE_DUTY = 0.15


def first_flow(meter: Meter, fits: Sequence[Fit], lag: LagModel, *, lag_s: float) -> Estimate:
    """Return from steps on when the flow begins after the order of a fully open valve.

    A pulse stands in the middle of its period: with a duty below 1 the first one begins later by
    half of the off-time, which is taken off.
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
