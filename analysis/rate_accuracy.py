"""Spraying accuracy by prescribed rate, as P1's Table 5 has it.

Eq. 19 is a mean over data points. A row here knows how many it has, so that rows add up, weighted
by them, to the accuracy of a flight, and the rows of several flights to those of all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.flow_accuracy import flow_samples

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from analysis.strips import Strip


@dataclass(frozen=True, slots=True, kw_only=True)
class RateAccuracy:
    """SA of the data points over one rate; the rate is None where the strips had several."""

    rate_l_ha: float | None
    percent: float
    samples: int


def accuracy_by_rate(strips: Sequence[Strip]) -> tuple[RateAccuracy, ...]:
    """Return a flight's SA by rate, lowest first; what lay over several rates is last.

    Transitions count for the rate that they lead to: its ground is where they are.
    """
    found = flow_samples(strips)
    rates, accuracy = found.rate_l_ha, found.accuracy_percent
    parts = [(float(rate), accuracy[rates == rate]) for rate in np.unique(rates[~np.isnan(rates)])]
    parts.append((float("nan"), accuracy[np.isnan(rates)]))
    return tuple(
        RateAccuracy(
            rate_l_ha=None if np.isnan(rate) else rate,
            percent=float(part.mean()),
            samples=len(part),
        )
        for rate, part in parts
        if len(part)
    )


def pooled_by_rate(flights: Iterable[Iterable[RateAccuracy]]) -> tuple[RateAccuracy, ...]:
    """Return the rows of all flights together, as if they had been one."""
    by_rate: dict[float | None, list[RateAccuracy]] = {}
    for flight in flights:
        for row in flight:
            by_rate.setdefault(row.rate_l_ha, []).append(row)
    ordered = sorted(by_rate, key=lambda rate: float("inf") if rate is None else rate)
    pooled = []
    for rate in ordered:
        percent = pooled_percent(by_rate[rate])
        if percent is not None:
            samples = sum(row.samples for row in by_rate[rate])
            pooled.append(RateAccuracy(rate_l_ha=rate, percent=percent, samples=samples))
    return tuple(pooled)


def pooled_percent(rows: Iterable[RateAccuracy]) -> float | None:
    """Return the SA of all data points of some rows; None without any.

    >>> low = RateAccuracy(rate_l_ha=10.0, percent=90.0, samples=1)
    >>> pooled_percent([low, RateAccuracy(rate_l_ha=20.0, percent=98.0, samples=3)])
    96.0
    """
    each = list(rows)
    samples = sum(row.samples for row in each)
    return sum(row.percent * row.samples for row in each) / samples if samples else None
