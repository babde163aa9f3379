"""How well identified lags lie to the truth: by kind, all four together, as figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from analysis.calibration.steps import Kind
from tests.bench.figures import Figure

TARGET_S = 0.005
WITHIN_SHARE = 0.95
COVERED_SHARES = (0.90, 0.99)
# Of fewer flights nearly all may be covered by chance.
FLIGHTS_ENOUGH = 50


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One kind in one flight, or one of the two ends."""

    seed: int
    name: str
    count: int
    value_s: float
    low_s: float
    high_s: float
    truth_s: float

    @property
    def error_s(self) -> float:
        """Return identified less true."""
        return self.value_s - self.truth_s

    @property
    def covers(self) -> bool:
        """Return whether the interval has the truth in it."""
        return self.low_s <= self.truth_s <= self.high_s


def summary(rows: Sequence[Compared], flights: int) -> dict[str, dict[str, float]]:
    """Return the figures by kind, and of all four lags together."""
    result = {}
    for name in (*(kind.value for kind in Kind), "on_start", "off_end"):
        chosen = [row for row in rows if row.name == name]
        if not chosen:
            continue
        errors = np.array([row.error_s for row in chosen])
        figures = {
            "flights": len(chosen) / flights,
            "steps": fmean(row.count for row in chosen),
            "truth_s": fmean(row.truth_s for row in chosen),
            "error_mean_s": float(errors.mean()),
            "error_sd_s": float(errors.std(ddof=1)) if len(errors) > 1 else 0.0,
            "error_worst_s": float(np.abs(errors).max()),
            "half_width_s": fmean(0.5 * (row.high_s - row.low_s) for row in chosen),
        }
        if name == "on_start":
            figures["safe"] = fmean(row.low_s <= row.truth_s for row in chosen)
            figures["margin_s"] = fmean(row.truth_s - row.low_s for row in chosen)
        elif name == "off_end":
            figures["safe"] = fmean(row.high_s >= row.truth_s for row in chosen)
            figures["margin_s"] = fmean(row.high_s - row.truth_s for row in chosen)
        else:
            figures["within_target"] = float(np.mean(np.abs(errors) <= TARGET_S))
            figures["covered"] = fmean(row.covers for row in chosen)
        result[name] = figures
    return result


def all_four(rows: Sequence[Compared], flights: int) -> dict[str, float]:
    """Return in how many flights all four lags are within the target, and how many are covered."""
    names = {kind.value for kind in Kind}
    lags = [row for row in rows if row.name in names]
    good: dict[int, int] = {}
    for row in lags:
        good[row.seed] = good.get(row.seed, 0) + (abs(row.error_s) <= TARGET_S)
    return {
        "flights": flights,
        "all_within_target": sum(count == len(names) for count in good.values()) / flights,
        "within_target": sum(abs(row.error_s) <= TARGET_S for row in lags) / (4 * flights),
        "covered": fmean(row.covers for row in lags) if lags else 0.0,
    }


def figures(rows: Sequence[Compared], flights: int, *, where: str, section: str) -> list[Figure]:
    """Return how often lags are within the target, and how often their intervals hold the truth."""
    everything = all_four(rows, flights)
    kinds = summary(rows, flights)
    key = where.replace(", ", "_")
    low, high = COVERED_SHARES
    covered = everything["covered"]
    is_enough = flights >= FLIGHTS_ENOUGH
    return [
        Figure(
            key=f"identified_within_{key}",
            what=f"identified lags within 5 ms of the truth, {where}",
            value=100.0 * everything["within_target"],
            unit="%",
            n=flights,
            target=100.0 * WITHIN_SHARE,
            is_at_least=True,
            details={"all_four": 100.0 * everything["all_within_target"], "kinds": kinds},
            section=section,
            row="identified lags within 5 ms of the truth",
        ),
        Figure(
            key=f"identified_covered_{key}",
            what=f"95 % intervals that hold the truth, {where}",
            value=100.0 * covered,
            unit="%",
            n=flights,
            target=100.0 * low,
            is_at_least=True,
            details={"at_most": 100.0 * high},
            section=section,
            row="intervals of lags that hold the truth, at least",
        ),
        Figure(
            key=f"identified_not_too_wide_{key}",
            what=f"95 % intervals that hold the truth, not more than, {where}",
            value=100.0 * covered,
            unit="%",
            n=flights,
            target=100.0 * high if is_enough else None,
            section=section,
            row="intervals of lags that hold the truth, at most",
        ),
    ]
