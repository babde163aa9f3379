"""A second judge of flights along logs, with numpy and shapely: it shares no line with the first.

Written from what docs/howto/fly-along.md says that the figures are. It goes by time, where the
first one goes by marks along the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

Floats = NDArray[np.float64]
ML_S_PER_L_MIN = 1000.0 / 60.0
GRAZE_M = 0.1
MOVING_M_S = 0.5
TURNING_DEG_S, STAYS_S = 10.0, 0.3
AROUND_S = 0.5


@dataclass(frozen=True, kw_only=True)
class Flown:
    """What truly happened: rows of time at even steps, cumulative volumes (rows x valves)."""

    time_s: Floats
    east_m: Floats
    north_m: Floats
    heading_deg: Floats
    volume_ml: Floats
    strips: tuple[tuple[float, float, float], ...]  # right, forward, width of each valve [m]
    zones: tuple[tuple[shapely.Geometry, float], ...]  # L/ha
    period_s: float
    least_l_min: float  # of one valve
    full_l_min: float
    slow_m_s: float


@dataclass(frozen=True, kw_only=True)
class Verdict:
    misapplied_percent: float
    turn_percent: float
    cannot_percent: float
    lags_m: Floats


def judge(flown: Flown) -> Verdict:
    """Judge a flight."""
    step_s = float(flown.time_s[1] - flown.time_s[0])
    nose = np.unwrap(np.radians(flown.heading_deg))
    sin, cos = np.sin(nose), np.cos(nose)
    yaw_deg_s = np.abs(np.degrees(np.gradient(nose, step_s)))
    turning = np.zeros(len(nose), dtype=np.bool_)
    for row in np.flatnonzero(yaw_deg_s > TURNING_DEG_S):
        turning[max(row - round(STAYS_S / step_s), 0) : row + round(STAYS_S / step_s) + 1] = True
    east_m_s, north_m_s = (np.gradient(each, step_s) for each in (flown.east_m, flown.north_m))
    ahead_m_s = east_m_s * sin + north_m_s * cos
    spin = np.gradient(nose, step_s)
    # The fastest point of the boom: one of its strips' middles at an end.
    ends_m = [right for right, _, _ in flown.strips]
    foremost_m_s = np.maximum(ahead_m_s - spin * min(ends_m), ahead_m_s - spin * max(ends_m))
    is_fast = np.hypot(east_m_s, north_m_s) >= flown.slow_m_s
    field = shapely.union_all([zone for zone, _ in flown.zones])
    shapely.prepare(field)
    sums = np.zeros((3, 2))
    lags: list[float] = []
    for number, (right_m, forward_m, width_m) in enumerate(flown.strips):
        x = flown.east_m + sin * forward_m + cos * right_m
        y = flown.north_m + cos * forward_m - sin * right_m
        rate = np.zeros(len(x))
        for zone, l_ha in flown.zones:
            rate[shapely.contains_xy(zone, x, y)] = l_ha
        across_m_s = np.abs(np.gradient(x, step_s) * sin + np.gradient(y, step_s) * cos)
        # L/ha times m2 is a tenth of a millilitre.
        asked_ml_s = 0.1 * rate * across_m_s * width_m
        given_ml = flown.volume_ml[:, number]
        asked_ml = np.concatenate(([0.0], np.cumsum(asked_ml_s[1:] + asked_ml_s[:-1]) * step_s / 2))
        given_p, asked_p = (_over(each, flown.period_s / step_s) for each in (given_ml, asked_ml))
        way_m = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))))
        counts = _over(way_m, flown.period_s / step_s) > MOVING_M_S * flown.period_s
        half_m = 0.5 * width_m - GRAZE_M
        for side_m in (-half_m, half_m):
            counts &= shapely.contains_xy(field, x + cos * side_m, y - sin * side_m)
        flow = asked_p / flown.period_s / ML_S_PER_L_MIN
        can = (flow >= 0.98 * flown.least_l_min) & (flow <= 1.02 * flown.full_l_min) & is_fast
        can &= (ahead_m_s - spin * right_m >= 0.0) | (foremost_m_s <= 0.0)
        wrong = np.abs(given_p - asked_p)
        for row, which in enumerate((counts & can, counts & can & turning, counts & ~can)):
            sums[row] += wrong[which].sum(), asked_p[which].sum()
        lags += _lags(rate, way_m, given_ml, asked_ml, can, flown.period_s / step_s, step_s)
    (wrong_can, can_ml), (wrong_turn, turn_ml), (_, cannot_ml) = sums
    return Verdict(
        misapplied_percent=100.0 * wrong_can / can_ml,
        turn_percent=100.0 * wrong_turn / turn_ml if turn_ml else 0.0,
        cannot_percent=100.0 * cannot_ml / (can_ml + cannot_ml),
        lags_m=np.array(lags),
    )


def _over(values: Floats, steps: float) -> Floats:
    """Return by how much values rise over a period around each row."""
    rows = np.arange(len(values), dtype=np.float64)
    found: Floats = np.interp(rows + steps / 2, rows, values) - np.interp(
        rows - steps / 2, rows, values
    )
    return found


def _smooth(values: Floats, steps: float) -> Floats:
    """Return the mean over a period around each row."""
    rows = np.arange(len(values), dtype=np.float64)
    sums = np.concatenate(([0.0], np.cumsum(0.5 * (values[1:] + values[:-1]))))
    ends = np.clip(rows + steps / 2, 0, rows[-1]), np.clip(rows - steps / 2, 0, rows[-1])
    found: Floats = (np.interp(ends[0], rows, sums) - np.interp(ends[1], rows, sums)) / (
        ends[0] - ends[1]
    )
    return found


def _lags(
    rate: Floats, way_m: Floats, given_ml: Floats, asked_ml: Floats, can: NDArray[np.bool_],
    period: float, step_s: float,
) -> list[float]:  # fmt: skip
    """Return how late each change is by the volume around it, where it can be had and came."""
    around = round(AROUND_S / step_s)
    given, way = _smooth(_smooth(given_ml, period), period), _smooth(_smooth(way_m, period), period)
    edges = np.flatnonzero(np.diff(rate)) + 1
    found = []
    for before, row, after in zip([0, *edges[:-1]], edges, [*edges[1:], len(rate)], strict=True):
        low, high = row - around, row + around
        stays = min(row - before, after - row) >= around + period
        if not (stays and rate[row] > 0.0 and rate[row - 1] > 0.0 and can[low:high].all()):
            continue
        near = round(0.2 / step_s)
        step = (asked_ml[high] - asked_ml[row]) / (way_m[high] - way_m[row])
        step -= (asked_ml[row] - asked_ml[low]) / (way_m[row] - way_m[low])
        later = (given[high] - given[row + near]) / (way[high] - way[row + near])
        sooner = (given[row - near] - given[low]) / (way[row - near] - way[low])
        if (later - sooner) / step >= 0.5:
            missing_ml = asked_ml[high] - asked_ml[low] - (given[high] - given[low])
            found.append(float(missing_ml / step))
    return found
