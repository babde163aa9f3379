"""Flights of one kind: what their figures are called, and what is told of all of them together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from sitl.conditions import condition_of
from tests.bench.flights import FIELD, NOMINAL, PAPER_METHODS, VEHICLE, Flown
from tests.bench.sprayers import PLANT


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Flights of one kind, with what their figures are called and judged by."""

    flown: Sequence[Flown]
    paper: Sequence[Flown]
    section: str
    factor: float = 1.0

    @property
    def first(self) -> Flown:
        """Return one of them: what makes the kind is the same in all."""
        return self.flown[0]

    @property
    def is_bound(self) -> bool:
        """Return whether the targets hold here."""
        condition = self.first.condition
        return condition == FIELD or condition_of(condition).is_bound

    @property
    def key(self) -> str:
        """Return the end of the keys: what is as usual is not in it."""
        one = self.first
        parts = [name for name in (one.plant,) if name != PLANT]
        parts += [name for name in (one.condition,) if name != FIELD]
        parts += [name for name in (one.lags,) if name != NOMINAL]
        return "_".join([*parts, one.output, f"{one.speed_m_s:g}_m_s"])

    @property
    def where(self) -> str:
        """Return the same for people."""
        one = self.first
        parts = [one.output, f"{one.speed_m_s:g} m/s", one.plant]
        if one.condition != FIELD:
            parts.append(condition_of(one.condition).what)
        if one.lags != NOMINAL:
            parts.append(f"{one.lags} lags")
        return ", ".join(parts)

    @property
    def row(self) -> str:
        """Return what is one line of the summary: both sprayers and outputs of the same targets."""
        one = self.first
        where = "the example's field" if one.condition == FIELD else "hard conditions"
        board = ", free-running board" if one.output == "free-running" else ""
        vehicle = ", flown vehicle" if one.plant.endswith(VEHICLE) else ""
        return f"{where}, {one.lags} lags{board}{vehicle}"

    def of_paper(
        self, figure: Callable[[Sequence[Flown]], float | None]
    ) -> dict[str, float | None]:
        """Return the same figure of the paper's methods, and of perfect knowledge, where flown."""
        return {
            f"paper's {method}": figure(flown)
            for method in PAPER_METHODS
            if (flown := [each for each in self.paper if each.method == method])
        }


def weighted(flown: Sequence[Flown]) -> float | None:
    """Return the mean of absolute lag distances over all changes of all flights."""
    total = sum((each.mean_abs_m or 0.0) * each.count for each in flown)
    count = sum(each.count for each in flown)
    return total / count if count else None


def weighted_perfect(flown: Sequence[Flown]) -> float | None:
    """Return the same of the flights with perfect knowledge beside them."""
    return mean_of(each.perfect_mean_abs_m for each in flown)


def below_perfect(each: Flown) -> float | None:
    """Return the points of spraying accuracy that perfect knowledge has more."""
    if each.accuracy_percent is None or each.perfect_accuracy_percent is None:
        return None
    return each.perfect_accuracy_percent - each.accuracy_percent


def is_settled(flown: Sequence[Flown]) -> bool:
    """Return whether anything settles at all: short zones never do."""
    return any(each.settled_accuracy_percent is not None for each in flown)


def worst_seed(flown: Sequence[Flown]) -> int:
    """Return the seed with the worst change."""
    return max(flown, key=lambda each: each.max_abs_m or 0.0).seed


def _values(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def mean_of(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that there are."""
    found = _values(values)
    return float(np.mean(found)) if found else None


def most_of(values: Iterable[float | None]) -> float | None:
    """Return the greatest of the values that there are."""
    return max(_values(values), default=None)


def least_of(values: Iterable[float | None]) -> float | None:
    """Return the least of the values that there are."""
    return min(_values(values), default=None)
