"""Means with 95 % intervals that know that neighbouring measurements share one error.

Six valves that pass a boundary together share one position, and so one error of it; samples every
10 ms share the flow. So measurements are put into clusters, one a boundary crossing of the boom or
the way between two, and the interval is the cluster-robust one: the variance of a mean from the
sums of its clusters' residuals, with Student's t for the number of clusters less one (Cameron and
Miller 2015, A Practitioner's Guide to Cluster-Robust Inference, eq. 10 with c = G / (G - 1)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.student import t_factor

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
