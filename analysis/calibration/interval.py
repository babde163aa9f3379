"""Means with 95 % intervals from few values: Student's t, and the jackknife for what is no mean."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist, fmean, stdev
from typing import TypeVar

from analysis.student import t_factor

Item = TypeVar("Item")

CONFIDENCE = 0.95
# Twelve values scatter by more than this times their own sd once in a thousand (chi-square).
EXCESS = 1.7


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A value in seconds with its 95 % interval, from so many steps."""

    value: float
    low: float
    high: float
    count: int

    def shifted(self, by_s: float) -> Estimate:
        """Return the same later by `by_s`."""
        return Estimate(
            value=self.value + by_s, low=self.low + by_s, high=self.high + by_s, count=self.count
        )


def mean_of(values: Sequence[float], sds: Sequence[float]) -> Estimate:
    """Return the mean of steps' lags with the interval of the mean over these very steps.

    It follows from what each fit says of itself, for the lags themselves differ from step to step
    (by the phase of the pulses) and that is no error of their mean. Where they scatter more than
    both explain, something unknown is at work, and the interval is Student's of the scatter.
    """
    count = len(values)
    if count < 2:
        raise ValueError("an interval needs two values or more")
    fitted = math.sqrt(math.fsum(sd**2 for sd in sds)) / count
    scattered = stdev(values) / math.sqrt(count)
    half = NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE) * fitted
    if not scattered <= EXCESS * fitted:
        half = max(half, t_factor(count - 1, CONFIDENCE) * scattered)
    mean = fmean(values)
    return Estimate(value=mean, low=mean - half, high=mean + half, count=count)


def jackknife(statistic: Callable[[Sequence[Item]], float], items: Sequence[Item]) -> Estimate:
    """Return a statistic of all items; its interval from leaving one out at a time."""
    count = len(items)
    if count < 2:
        raise ValueError("an interval needs two values or more")
    value = statistic(items)
    left_out = [statistic([*items[:i], *items[i + 1 :]]) for i in range(count)]
    mean = fmean(left_out)
    variance = (count - 1) / count * math.fsum((each - mean) ** 2 for each in left_out)
    half = t_factor(count - 1, CONFIDENCE) * math.sqrt(variance)
    return Estimate(value=value, low=value - half, high=value + half, count=count)
