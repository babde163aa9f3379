"""Least squares with intervals, and the one measurement that does not fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from analysis.student import t_factor, t_inside

Floats = NDArray[np.float64]

# A clean set loses its worst measurement in one of a hundred cases.
OUTLIER_PROBABILITY = 0.01
NORMAL = NormalDist()


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A value and its 95 % interval."""

    value: float
    low: float
    high: float

    def turned(self, factor: float, added: float = 0.0) -> Estimate:
        """Return `factor` times this, plus `added`."""
        low, high = sorted((self.low * factor + added, self.high * factor + added))
        return Estimate(value=self.value * factor + added, low=low, high=high)


@dataclass(frozen=True, slots=True, kw_only=True)
class Solved:
    """A least squares solution; `sd_m` is what its intervals rest on."""

    values: Floats
    covariance: Floats
    residual_m: Floats
    leverage: Floats
    residual_sd_m: float
    sd_m: float
    factor: float
    spare: int

    def estimate(self, index: int) -> Estimate:
        """Return one of the values with its interval."""
        value = float(self.values[index])
        half = self.factor * math.sqrt(float(self.covariance[index, index]))
        return Estimate(value=value, low=value - half, high=value + half)


def solve(design: Floats, measured_m: Floats, sd_m: float | None) -> Solved:
    """Solve; a stated deviation is kept unless the residuals are far beyond it."""
    spare = len(design) - design.shape[1]
    inverse = np.linalg.inv(design.T @ design)
    solution = inverse @ design.T @ measured_m
    residual_m = measured_m - design @ solution
    found_m = math.sqrt(float(residual_m @ residual_m) / spare)
    stated = sd_m is not None and found_m <= sd_m * _excess(spare)
    used_m = sd_m if stated and sd_m is not None else found_m
    return Solved(
        values=solution,
        covariance=np.asarray(inverse * used_m**2, dtype=np.float64),
        residual_m=residual_m,
        leverage=np.einsum("ij,jk,ik->i", design, inverse, design),
        residual_sd_m=found_m,
        sd_m=used_m,
        factor=NORMAL.inv_cdf(0.975) if stated else t_factor(spare),
        spare=spare,
    )


def _excess(spare: int) -> float:
    """Return the ratio of found to true deviation that is exceeded in 1 % (Wilson, Hilferty)."""
    part = 2.0 / (9.0 * spare)
    cube_root = 1.0 - part + NORMAL.inv_cdf(0.99) * math.sqrt(part)
    return math.sqrt(cube_root**3)


def worst_outlier(solved: Solved, sd_m: float | None) -> int | None:
    """Return the one that is too far from what the others tell; None where none is.

    Judged by the stated deviation where the others agree with it, else by the others' own: the
    worst one would hide in a deviation that it is part of.
    """
    free = np.maximum(1.0 - solved.leverage, 1e-9)
    share = solved.residual_m**2 / free
    worst = int(np.argmax(share))
    spare = solved.spare - 1
    if spare < 1 or not solved.residual_sd_m > 1e-9:
        return None
    others_2 = max(solved.residual_sd_m**2 * solved.spare - float(share[worst]), 0.0) / spare
    if sd_m is not None and math.sqrt(others_2) <= sd_m * _excess(spare):
        chance = 2.0 * NORMAL.cdf(-math.sqrt(float(share[worst])) / sd_m)
    else:
        chance = 1.0 - t_inside(math.sqrt(float(share[worst]) / max(others_2, 1e-18)), spare)
    return worst if chance * len(free) < OUTLIER_PROBABILITY else None
