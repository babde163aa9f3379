"""The figures of a flight by kind of change, by step, by rate and by speed.

As P1 has them: its Fig. 8a (lag distance by rate), 8b (by speed) and Table 5 (spraying accuracy
by speed and rate).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.dose import flow_samples
from analysis.lag import Verdict
from analysis.student import NOTHING, Interval, crossings_of, mean_interval

if TYPE_CHECKING:
    from analysis.changes import Change
    from analysis.evaluation import Evaluation
    from analysis.lag import Step
    from analysis.strips import Strip
    from analysis.track import Floats

SPEED_BIN_M_S = 0.5
STEP_BINS = (0.08, 0.15, 0.30, 0.60, math.inf)
KINDS = ("on", "off", "up", "down")


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """The lag distances of some changes; `low` and `high` bound what they have in common.

    `lag_distance_m` is signed, + is too late; `lag_distance_abs_m` is of the absolute values.
    """

    name: str
    low: float | None
    high: float | None
    lag_distance_m: Interval
    lag_distance_abs_m: Interval
    max_abs_m: float | None
    apart: int = 0
    missed: int = 0

    def as_json(self) -> dict[str, Any]:
        """Return one row of a table."""
        return {
            "name": self.name,
            "low": self.low,
            "high": None if self.high == math.inf else self.high,
            "lag_distance_m": self.lag_distance_m.as_json(),
            "lag_distance_abs_m": self.lag_distance_abs_m.as_json(),
            "max_abs_m": self.max_abs_m,
            "apart": self.apart,
            "missed": self.missed,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class AccuracyGroup:
    """SA of the samples of one rate (None: the strips had several) at one speed (None: all)."""

    rate_l_ha: float | None
    speed_low_m_s: float | None
    speed_high_m_s: float | None
    percent: Interval

    def as_json(self) -> dict[str, Any]:
        """Return one field of the table."""
        return {
            "rate_l_ha": self.rate_l_ha,
            "speed_low_m_s": self.speed_low_m_s,
            "speed_high_m_s": self.speed_high_m_s,
            "percent": self.percent.as_json(),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Breakdowns:
    """Every table of a flight; `undefined_samples` had S = 0 in the field: SA says nothing there.

    Rates are those that a change leads to. `border` is the margin of each crossing of the border.
    """

    by_kind: tuple[Group, ...]
    border_margin_m: dict[str, Interval]
    by_step: tuple[Group, ...]
    by_rate: tuple[Group, ...]
    by_speed: tuple[Group, ...]
    settled_by_rate: tuple[Group, ...]
    settled_by_speed: tuple[Group, ...]
    accuracy_by_rate: tuple[AccuracyGroup, ...]
    accuracy_by_speed: tuple[AccuracyGroup, ...]
    accuracy: tuple[AccuracyGroup, ...]
    undefined_samples: int

    def as_json(self) -> dict[str, Any]:
        """Return all tables."""
        tables = {
            name: [row.as_json() for row in getattr(self, name)]
            for name in (
                "by_kind", "by_step", "by_rate", "by_speed", "settled_by_rate",
                "settled_by_speed", "accuracy_by_rate", "accuracy_by_speed", "accuracy",
            )
        }  # fmt: skip
        margins = {kind: each.as_json() for kind, each in self.border_margin_m.items()}
        return {
            **tables,
            "border_margin_m": margins,
            "undefined_samples": self.undefined_samples,
        }


def kind_of(change: Change) -> str:
    """Return what a change asks of the valve."""
    if not change.before_l_ha > 0.0:
        return "on"
    if not change.after_l_ha > 0.0:
        return "off"
    return "up" if change.after_l_ha > change.before_l_ha else "down"


def speed_bin(speed_m_s: float) -> tuple[float, float]:
    """Return the bin of a speed; bins are centred on whole halves, so that 5 m/s is in one.

    >>> speed_bin(4.9)
    (4.75, 5.25)
    """
    low = (math.floor(speed_m_s / SPEED_BIN_M_S + 0.5) - 0.5) * SPEED_BIN_M_S
    return low, low + SPEED_BIN_M_S


def breakdowns(evaluation: Evaluation, strips: Sequence[Strip]) -> Breakdowns:
    """Return the tables of a flight that was evaluated."""
    inside = [_Lag.of_step(step) for step in evaluation.steps if not step.change.border]
    settled = [
        _Lag(change=step.change, lag_m=step.lag_distance_m, apart=step.small, missed=(
            not step.small and step.lag_distance_m is None))
        for step in evaluation.settled_steps
    ]  # fmt: skip
    margins = {
        kind: mean_interval(
            np.array([each.margin_m for each in evaluation.crossings if each.kind == kind]),
            crossings_of(
                np.array([each.time_s for each in evaluation.crossings if each.kind == kind])
            ),
        )
        for kind in ("opening", "closing")
    }
    by_rate, by_speed, both, undefined = _accuracy(strips, evaluation)
    return Breakdowns(
        by_kind=tuple(
            _group(kind, (None, None), [lag for lag in inside if kind_of(lag.change) == kind])
            for kind in KINDS
        ),
        border_margin_m=margins,
        by_step=_by_step(inside),
        by_rate=_by_rate(inside),
        by_speed=_by_speed(inside),
        settled_by_rate=_by_rate(settled),
        settled_by_speed=_by_speed(settled),
        accuracy_by_rate=by_rate,
        accuracy_by_speed=by_speed,
        accuracy=both,
        undefined_samples=undefined,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Lag:
    """One change with what was measured of it, by either definition."""

    change: Change
    lag_m: float | None
    apart: bool
    missed: bool

    @staticmethod
    def of_step(step: Step) -> _Lag:
        return _Lag(
            change=step.change,
            lag_m=step.lag_distance_m,
            apart=step.verdict not in (Verdict.MEASURED, Verdict.MISSED),
            missed=step.verdict is Verdict.MISSED,
        )


def _group(name: str, bounds: tuple[float | None, float | None], lags: Sequence[_Lag]) -> Group:
    measured = [(lag.change.time_s, lag.lag_m) for lag in lags if lag.lag_m is not None]
    time_s = np.array([each[0] for each in measured])
    lag_m = np.array([each[1] for each in measured], dtype=np.float64)
    cluster = crossings_of(time_s)
    return Group(
        name=name,
        low=bounds[0],
        high=bounds[1],
        lag_distance_m=mean_interval(lag_m, cluster),
        lag_distance_abs_m=mean_interval(np.abs(lag_m), cluster),
        max_abs_m=float(np.abs(lag_m).max()) if len(lag_m) else None,
        apart=sum(lag.apart for lag in lags),
        missed=sum(lag.missed for lag in lags),
    )


def _by_step(lags: Iterable[_Lag]) -> tuple[Group, ...]:
    changes = [lag for lag in lags if kind_of(lag.change) in ("up", "down")]
    groups = []
    for low, high in pairwise(STEP_BINS):
        its = [lag for lag in changes if low <= lag.change.relative < high]
        name = (
            f"{100 * low:g} % and more"
            if high == math.inf
            else f"{100 * low:g} to {100 * high:g} %"
        )
        groups.append(_group(name, (low, high), its))
    return tuple(groups)


def _by_rate(lags: Sequence[_Lag]) -> tuple[Group, ...]:
    def key(lag: _Lag) -> float:
        return lag.change.after_l_ha

    rates = sorted({key(lag) for lag in lags})
    return tuple(
        _group(f"{rate:g} L/ha", (rate, rate), [lag for lag in lags if key(lag) == rate])
        for rate in rates
    )


def _by_speed(lags: Sequence[_Lag]) -> tuple[Group, ...]:
    bins = sorted({speed_bin(lag.change.speed_m_s) for lag in lags})
    return tuple(
        _group(
            f"{each[0]:g} to {each[1]:g} m/s",
            each,
            [lag for lag in lags if speed_bin(lag.change.speed_m_s) == each],
        )
        for each in bins
    )


_Table = tuple[AccuracyGroup, ...]


def _accuracy(
    strips: Sequence[Strip], evaluation: Evaluation
) -> tuple[_Table, _Table, _Table, int]:
    """Return SA by rate, by speed and by both, and how many samples had nothing prescribed."""
    found = flow_samples(strips)
    cluster = ways_between(evaluation, found.time_s)
    track = strips[0].track
    speed = track.at(track.speed_m_s, found.time_s)
    bins = np.floor(speed / SPEED_BIN_M_S + 0.5)
    rates: list[float] = [float(rate) for rate in np.unique(found.rate_l_ha)]  # NaN once, last

    def row(rate: float | None, place: float | None) -> AccuracyGroup:
        its = np.ones(len(speed), dtype=np.bool_)
        if rate is not None:
            its &= np.isnan(found.rate_l_ha) if math.isnan(rate) else found.rate_l_ha == rate
        if place is not None:
            its &= bins == place
        values = found.accuracy_percent[its]
        return AccuracyGroup(
            rate_l_ha=None if rate is None or math.isnan(rate) else rate,
            speed_low_m_s=None if place is None else (place - 0.5) * SPEED_BIN_M_S,
            speed_high_m_s=None if place is None else (place + 0.5) * SPEED_BIN_M_S,
            percent=_at_most_100(mean_interval(values, cluster[its])) if len(values) else NOTHING,
        )

    places = [float(place) for place in np.unique(bins)]
    both = (row(rate, place) for rate in rates for place in places)
    return (
        tuple(row(rate, None) for rate in rates),
        tuple(row(None, place) for place in places),
        tuple(each for each in both if each.percent.count),
        found.undefined,
    )


def _at_most_100(found: Interval) -> Interval:
    """Return an interval of an accuracy, which no flight can have above 100 %."""
    return found if found.high is None else replace(found, high=min(found.high, 100.0))


def ways_between(evaluation: Evaluation, time_s: Floats) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the way between two crossings of boundaries that each time lies on.

    Flow and speed of one way share what is wrong with them. A way begins with its crossing.
    """
    changes_s = np.array([step.change.time_s for step in evaluation.steps])
    if not len(changes_s):
        return np.zeros(len(time_s), dtype=np.int64)
    cluster = crossings_of(changes_s)
    first_s = np.full(int(cluster.max()) + 1, np.inf)
    np.minimum.at(first_s, cluster, changes_s)
    return np.searchsorted(first_s, time_s, "right").astype(np.int64)
