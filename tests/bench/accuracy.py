"""From many flights to the figures of accuracy: means over the seeds, and the worst seed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from tests.bench.figures import Figure
from tests.bench.flights import OUTPUTS, PAPER_M_S, PAPER_METHODS, Flown, Output

# Mean and greatest lag distance in metres up to 6 m/s, by output; beyond it in seconds of flight.
TARGETS_M: dict[Output, tuple[float, float]] = {
    "gpio": (0.05, 0.20),
    "servo": (0.05, 0.20),
    "free-running": (0.15, 0.40),
}
FAST_FROM_M_S = 6.5
FAST_TARGET_S = 0.015


def accuracy(flown: Sequence[Flown]) -> list[Figure]:
    """Return the figures of all speeds and outputs that were flown, and of the paper's methods."""
    figures: list[Figure] = []
    for speed in sorted({each.speed_m_s for each in flown}):
        at_speed = [each for each in flown if each.speed_m_s == speed]
        paper = [each for each in at_speed if each.method in PAPER_METHODS]
        for output in OUTPUTS:
            ours = [each for each in at_speed if each.output == output and each not in paper]
            if ours and speed > FAST_FROM_M_S:
                figures.append(_fast(speed, output, ours))
            elif ours:
                figures += _slow(speed, output, ours, paper)
    for method in PAPER_METHODS:
        theirs = [each for each in flown if each.method == method]
        if theirs:
            figures.append(_paper(method, theirs))
    return figures


def _slow(
    speed: float, output: Output, ours: Sequence[Flown], paper: Sequence[Flown]
) -> list[Figure]:
    key, where = f"{output}_{speed:g}_m_s", f"{output}, {speed:g} m/s"
    mean_m, worst_m = TARGETS_M[output]
    count = sum(each.count for each in ours)
    figures = [
        Figure(
            key=f"lag_{key}",
            what=f"lag distance, {where}: mean of absolute values",
            value=_weighted(ours),
            unit="m",
            n=count,
            target=mean_m,
            alternative=_of_paper(paper, _weighted),
            details=summary(ours),
        ),
        Figure(
            key=f"worst_lag_{key}",
            what=f"lag distance, {where}: worst of all seeds",
            value=_most(each.max_abs_m for each in ours),
            unit="m",
            n=count,
            target=worst_m,
            alternative=_of_paper(paper, lambda them: _most(each.max_abs_m for each in them)),
            details={"seed": _worst_seed(ours)},
        ),
    ]
    return figures if output == "free-running" else [*figures, *_shares(key, where, ours, paper)]


def _shares(key: str, where: str, ours: Sequence[Flown], paper: Sequence[Flown]) -> list[Figure]:
    """Return limit ratio, spraying accuracy, and what was missed or stands apart."""
    changes = sum(each.count + each.apart + each.missed for each in ours)
    return [
        Figure(
            key=f"limit_ratio_{key}",
            what=f"misapplied over that of perfect knowledge, {where}: mean",
            value=_mean(each.limit_ratio for each in ours),
            unit="x",
            n=len(ours),
            target=1.05,
            alternative=_of_paper(paper, lambda them: _mean(each.limit_ratio for each in them)),
            details={"worst": _most(each.limit_ratio for each in ours)},
        ),
        Figure(
            key=f"spraying_accuracy_{key}",
            what=f"spraying accuracy, {where}: mean",
            value=_mean(each.accuracy_percent for each in ours),
            unit="%",
            n=len(ours),
            target=98.5,
            is_at_least=True,
            alternative=_of_paper(
                paper, lambda them: _mean(each.accuracy_percent for each in them)
            ),
            details={"worst": _least(each.accuracy_percent for each in ours)},
        ),
        Figure(
            key=f"below_perfect_{key}",
            what=f"spraying accuracy below perfect knowledge, {where}: worst",
            value=_most(_below_perfect(each) for each in ours),
            unit="points",
            n=len(ours),
            target=0.2,
            details={"mean": _mean(_below_perfect(each) for each in ours)},
        ),
        Figure(
            key=f"missed_{key}",
            what=f"changes missed, {where}",
            value=float(sum(each.missed for each in ours)),
            unit="",
            n=changes,
            target=0.0,
        ),
        Figure(
            key=f"apart_{key}",
            what=f"changes counted apart, {where}",
            value=100.0 * sum(each.apart for each in ours) / changes if changes else None,
            unit="%",
            n=changes,
            target=2.0,
        ),
    ]


def _fast(speed: float, output: Output, ours: Sequence[Flown]) -> Figure:
    mean_abs = _weighted(ours)
    worst = _most(each.max_abs_m for each in ours)
    return Figure(
        key=f"lag_{output}_{speed:g}_m_s",
        what=f"lag in time, {output}, {speed:g} m/s: mean of absolute values",
        value=None if mean_abs is None else mean_abs / speed,
        unit="s",
        n=sum(each.count for each in ours),
        target=FAST_TARGET_S,
        details={"worst_s": None if worst is None else worst / speed, **summary(ours)},
    )


def _paper(method: str, theirs: Sequence[Flown]) -> Figure:
    return Figure(
        key=f"paper_{method}",
        what=f"settled lag distance, the paper's controller, {method}, {PAPER_M_S:g} m/s: mean",
        value=_mean(each.settled_mean_m for each in theirs),
        unit="m",
        n=len(theirs),
        details=summary(theirs),
    )


def summary(flown: Sequence[Flown]) -> dict[str, Any]:
    """Return what else is known of these flights, over all seeds."""
    return {
        "mean_m": _mean(each.mean_m for each in flown),
        "worst_m": _most(each.max_abs_m for each in flown),
        "worst_seed_mean_abs_m": _most(each.mean_abs_m for each in flown),
        "worst_seed": _worst_seed(flown),
        "settled_mean_m": _mean(each.settled_mean_m for each in flown),
        "settled_mean_abs_m": _mean(each.settled_mean_abs_m for each in flown),
        "limit_ratio": _mean(each.limit_ratio for each in flown),
        "misapplied_percent": _mean(each.misapplied_percent for each in flown),
        "spraying_accuracy_percent": _mean(each.accuracy_percent for each in flown),
        "settled_accuracy_percent": _mean(each.settled_accuracy_percent for each in flown),
        "perfect_accuracy_percent": _mean(each.perfect_accuracy_percent for each in flown),
        "missed": sum(each.missed for each in flown),
        "apart": sum(each.apart for each in flown),
        "off_target_ml": _most(each.off_target_ml for each in flown),
        "border_margin_m": _mean(each.border_margin_m for each in flown),
        "seeds": len(flown),
    }


def _of_paper(
    paper: Sequence[Flown], figure: Callable[[Sequence[Flown]], float | None]
) -> dict[str, float | None]:
    return {
        f"paper's {method}": figure(flown)
        for method in PAPER_METHODS
        if (flown := [each for each in paper if each.method == method])
    }


def _weighted(flown: Sequence[Flown]) -> float | None:
    """Return the mean of absolute lag distances over all changes of all flights."""
    total = sum((each.mean_abs_m or 0.0) * each.count for each in flown)
    count = sum(each.count for each in flown)
    return total / count if count else None


def _below_perfect(each: Flown) -> float | None:
    if each.accuracy_percent is None or each.perfect_accuracy_percent is None:
        return None
    return each.perfect_accuracy_percent - each.accuracy_percent


def _worst_seed(flown: Sequence[Flown]) -> int:
    return max(flown, key=lambda each: each.max_abs_m or 0.0).seed


def _values(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None]


def _mean(values: Iterable[float | None]) -> float | None:
    found = _values(values)
    return float(np.mean(found)) if found else None


def _most(values: Iterable[float | None]) -> float | None:
    return max(_values(values), default=None)


def _least(values: Iterable[float | None]) -> float | None:
    return min(_values(values), default=None)
