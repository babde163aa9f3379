"""Student's t and Fisher's F: intervals and tests from few measurements; no library is needed.

t, for whole degrees of freedom, by the finite series of Abramowitz and Stegun, 26.7.3 and 26.7.4,
which are exact; F by the continued fraction of the incomplete beta function, 26.6.2 and 26.5.8.

Means with 95 % intervals that know that neighbouring measurements share one error. Six valves that
pass a boundary together share one position, and so one error of it; samples every 10 ms share the
flow. So measurements are put into clusters, one a boundary crossing of the boom or the way between
two, and the interval is the cluster-robust one: the variance of a mean from the sums of its
clusters' residuals, with Student's t for the number of clusters less one (Cameron and Miller 2015,
A Practitioner's Guide to Cluster-Robust Inference, eq. 10 with c = G / (G - 1)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Halvings of [0, 1]: the angle of the series is known to 1e-15 after these.
HALVINGS = 60
# Terms of the continued fraction, some ten are needed; and what stands for a divisor of 0.
TERMS = 300
TINY = 1e-300


def t_inside(t: float, dof: int) -> float:
    """Return the probability that |T| is below `t`.

    >>> round(t_inside(2.228, 10), 4)
    0.95
    """
    return _inside(math.atan2(t, math.sqrt(dof)), dof)


def t_factor(dof: int, inside: float = 0.95) -> float:
    """Return how many standard errors on each side hold the truth with probability `inside`.

    >>> [round(t_factor(dof), 3) for dof in (1, 3, 10, 1000)]
    [12.706, 3.182, 2.228, 1.962]
    """
    if not (dof >= 1 and 0.0 < inside < 1.0):
        raise ValueError(f"no t with {dof} degrees of freedom and probability {inside}")
    low, high = 0.0, 0.5 * math.pi
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if _inside(middle, dof) < inside:
            low = middle
        else:
            high = middle
    return math.sqrt(dof) * math.tan(low)


def _inside(angle: float, dof: int) -> float:
    sin, cos = math.sin(angle), math.cos(angle)
    odd = dof % 2
    term = total = cos if odd else 1.0
    if dof == 1:
        return 2.0 * angle / math.pi
    for k in range(2 + odd, dof - 1, 2):
        term *= cos * cos * (k - 1) / k
        total += term
    return 2.0 / math.pi * (angle + sin * total) if odd else sin * total


def f_above(f: float, dof_1: float, dof_2: float) -> float:
    """Return the probability that F with these degrees of freedom, whole or not, exceeds `f`.

    >>> [round(f_above(f, 5, 7), 4) for f in (0.0, 1.7111, 3.9715)]
    [1.0, 0.25, 0.05]
    """
    if not (f >= 0.0 and dof_1 > 0.0 and dof_2 > 0.0):
        raise ValueError(f"no F of {f} with {dof_1} and {dof_2} degrees of freedom")
    return _beta_below(dof_2 / (dof_2 + dof_1 * f), 0.5 * dof_2, 0.5 * dof_1)


def _beta_below(x: float, a: float, b: float) -> float:
    """Return the regularised incomplete beta function."""
    if x <= 0.0 or x >= 1.0:
        return 1.0 if x >= 1.0 else 0.0
    if x > (a + 1.0) / (a + b + 2.0):
        return 1.0 - _beta_below(1.0 - x, b, a)
    scale = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    front = math.exp(scale + a * math.log(x) + b * math.log1p(-x)) / a
    # Lentz's way to work out the fraction from its front.
    c, d, found = 1.0, 0.0, 1.0
    for i in range(TERMS):
        m = i // 2
        if i == 0:
            term = 1.0
        elif i % 2:
            term = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1.0))
        else:
            term = m * (b - m) * x / ((a + 2 * m - 1.0) * (a + 2 * m))
        d = 1.0 / (1.0 + term * d or TINY)
        c = 1.0 + term / c or TINY
        found *= c * d
        if abs(c * d - 1.0) < 1e-14:
            break
    return front * (found - 1.0)


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Valves of one boom that pass a boundary at an angle do so one after the other.
CROSSING_GAP_S = 0.25
# A crossing lasts no longer: where changes follow each other closely they would be all one.
CROSSING_MAX_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Interval:
    """A mean, its 95 % interval, and what it rests on; None where there is too little for it.

    `count` is the number of measurements, `clusters` that of those which are independent.
    """

    mean: float | None
    low: float | None
    high: float | None
    count: int
    clusters: int

    def as_json(self) -> dict[str, float | int | None]:
        """Return it as a JSON object."""
        return {
            "mean": self.mean,
            "low": self.low,
            "high": self.high,
            "count": self.count,
            "clusters": self.clusters,
        }


NOTHING = Interval(mean=None, low=None, high=None, count=0, clusters=0)


def crossings_of(time_s: Floats) -> Ints:
    """Return the crossing that each change belongs to, counted from 0 in order of time.

    >>> crossings_of(np.array([7.0, 1.0, 1.1, 1.0])).tolist()
    [1, 0, 0, 0]
    """
    found = np.zeros(len(time_s), dtype=np.int64)
    number, first_s, last_s = -1, -math.inf, -math.inf
    for i in np.argsort(time_s, kind="stable").tolist():
        at_s = float(time_s[i])
        if at_s - last_s > CROSSING_GAP_S or at_s - first_s > CROSSING_MAX_S:
            number, first_s = number + 1, at_s
        found[i], last_s = number, at_s
    return found


def mean_interval(values: Floats, cluster: Ints) -> Interval:
    """Return the mean of values, each of a cluster.

    >>> mean_interval(np.array([1.0, 3.0]), np.array([0, 1])).mean
    2.0
    """
    return ratio_interval(values, np.ones(len(values)), cluster)


def ratio_interval(parts: Floats, wholes: Floats, cluster: Ints) -> Interval:
    """Return the sum of `parts` over the sum of `wholes`: a mean with weights, or a share."""
    count = len(parts)
    whole = float(wholes.sum())
    if not count or not whole > 0.0:
        return NOTHING
    mean = float(parts.sum()) / whole
    _, place = np.unique(cluster, return_inverse=True)
    residuals = np.bincount(place, weights=parts - mean * wholes)
    clusters = len(residuals)
    if clusters < 2:
        return Interval(mean=mean, low=None, high=None, count=count, clusters=clusters)
    variance = float((residuals**2).sum()) / whole**2 * clusters / (clusters - 1)
    half = t_factor(clusters - 1) * math.sqrt(variance)
    return Interval(mean=mean, low=mean - half, high=mean + half, count=count, clusters=clusters)
