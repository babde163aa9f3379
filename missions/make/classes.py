"""Values into classes, from the lowest to the highest: the usual ways to draw zones.

Jenks' natural breaks are the ones with the least squared deviation inside the classes (Fisher 1958,
exact by dynamic programming); k-means reaches for the same with several layers at once.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Labels = NDArray[np.int16]
Method = Literal["jenks", "quantiles", "equal", "kmeans"]

# Values are counted in so many bins before the exact search: a ten-thousandth of their range is
# less than any sensor tells apart.
BINS = 4096
# k-means learns from so many places, chosen by a fixed seed, and starts so many times.
LEARNT_FROM, STARTS, ROUNDS_MAX = 5_000, 25, 100


class Classes(NamedTuple):
    """The class of every place, 0 for the lowest; `breaks` between them, of one layer alone."""

    labels: Labels
    breaks: tuple[float, ...]


def classify(layers: Floats, count: int, method: Method) -> Classes:
    """Return the classes of places (layers, places); there may be fewer than asked for.

    >>> classify(np.array([[1.0, 2.0, 9.0, 10.0]]), 2, "jenks").labels.tolist()
    [0, 0, 1, 1]
    """
    first = layers[0]
    if method == "kmeans":
        labels = _kmeans(layers, count)
        return Classes(labels, _between(first, labels) if len(layers) == 1 else ())
    if method == "jenks":
        breaks = natural_breaks(first, count)
    elif method == "quantiles":
        breaks = np.quantile(first, np.arange(1, count) / count)
    else:
        breaks = np.linspace(first.min(), first.max(), count + 1)[1:-1]
    breaks = np.unique(breaks)
    side = np.searchsorted(breaks, first, side="left")
    found, which = np.unique(side, return_inverse=True)
    # A class without a place is none, and so is the break below it.
    kept = breaks[found[1:] - 1]
    return Classes(which.astype(np.int16), tuple(kept.tolist()))


def natural_breaks(values: Floats, count: int) -> Floats:
    """Return the breaks of the classes with the least sum of squares, fewer for fewer values.

    >>> natural_breaks(np.array([1.0, 1.5, 2.0, 8.0, 9.0]), 2).tolist()
    [5.0]
    """
    middle, weight = _counted(values)
    count = min(count, len(middle))
    total = np.concatenate([[0.0], np.cumsum(weight)])
    first = np.concatenate([[0.0], np.cumsum(weight * middle)])
    second = np.concatenate([[0.0], np.cumsum(weight * middle**2)])

    def spread(start: NDArray[np.int64], end: int) -> Floats:
        """Return the sum of squares of values `start` to `end` (exclusive) around their mean."""
        many = total[end] - total[start]
        result: Floats = second[end] - second[start] - (first[end] - first[start]) ** 2 / many
        return result

    size = len(middle)
    least = np.array([np.inf, *(spread(np.zeros(1, dtype=np.int64), end)[0]
                                for end in range(1, size + 1))])  # fmt: skip
    starts = np.zeros((count, size + 1), dtype=np.int64)
    for number in range(1, count):
        better = np.full(size + 1, np.inf)
        for end in range(number + 1, size + 1):
            start = np.arange(number, end)
            sums = least[start] + spread(start, end)
            best = int(np.argmin(sums))
            better[end], starts[number, end] = sums[best], start[best]
        least = better
    breaks, end = [], size
    for number in range(count - 1, 0, -1):
        end = int(starts[number, end])
        breaks.append((middle[end - 1] + middle[end]) / 2.0)
    return np.array(breaks[::-1])


def _counted(values: Floats) -> tuple[Floats, Floats]:
    """Return the different values and how often they are there; many by the means of bins."""
    # Around their middle: sums of squares of large numbers lose the small differences.
    different, many = np.unique(values, return_counts=True)
    weight: Floats = many.astype(np.float64)
    if len(different) <= BINS:
        return np.asarray(different, dtype=np.float64), weight
    low, high = float(different[0]), float(different[-1])
    index = np.minimum(((different - low) / (high - low) * BINS).astype(np.int64), BINS - 1)
    counts = np.bincount(index, weights=weight, minlength=BINS).astype(np.float64)
    sums = np.bincount(index, weights=weight * different, minlength=BINS)
    some = counts > 0.0
    return sums[some] / counts[some], counts[some]


def _kmeans(layers: Floats, count: int) -> Labels:
    """Return clusters of places by all layers, each scaled by its spread."""
    spread = layers.std(axis=1, keepdims=True)
    places = ((layers - layers.mean(axis=1, keepdims=True)) / np.where(spread > 0, spread, 1.0)).T
    draw = np.random.default_rng(1)
    learnt = places
    if len(places) > LEARNT_FROM:
        learnt = places[np.sort(draw.choice(len(places), LEARNT_FROM, replace=False))]
    best, least = learnt[:1], math.inf
    for _ in range(STARTS):
        centres, spread_2 = _lloyd(learnt, _seeded(learnt, count, draw))
        if spread_2 < least * (1.0 - 1e-9):
            best, least = centres, spread_2
    nearest = _nearest(places, best)[0]
    found, labels = np.unique(nearest, return_inverse=True)
    means = np.array([layers[0][nearest == one].mean() for one in found])
    rank = np.empty(len(found), dtype=np.int16)
    rank[np.argsort(means, kind="stable")] = np.arange(len(found))
    return rank[labels]


def _seeded(places: Floats, count: int, draw: np.random.Generator) -> Floats:
    """Return first centres far from each other (k-means++, Arthur and Vassilvitskii 2007)."""
    centres = [places[draw.integers(len(places))]]
    while len(centres) < count:
        away = _nearest(places, np.array(centres))[1]
        if not away.sum() > 0.0:
            break
        centres.append(places[draw.choice(len(places), p=away / away.sum())])
    return np.array(centres)


def _lloyd(places: Floats, centres: Floats) -> tuple[Floats, float]:
    spread_2 = math.inf
    for _ in range(ROUNDS_MAX):
        nearest, away = _nearest(places, centres)
        if not away.sum() < spread_2 * (1.0 - 1e-7):
            break
        spread_2 = float(away.sum())
        counts = np.bincount(nearest, minlength=len(centres))
        sums = np.stack(
            [np.bincount(nearest, weights=one, minlength=len(centres)) for one in places.T], axis=1
        )
        centres = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], centres)
    return centres, spread_2


def _nearest(places: Floats, centres: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the nearest centre of every place and the squared distance to it."""
    nearest = np.zeros(len(places), dtype=np.int64)
    least = np.full(len(places), np.inf)
    for number, centre in enumerate(centres):
        away = ((places - centre) ** 2).sum(axis=1)
        closer = away < least
        nearest[closer], least[closer] = number, away[closer]
    return nearest, least


def _between(values: Floats, labels: Labels) -> tuple[float, ...]:
    """Return the middles between the classes of one layer."""
    ends = [(values[labels == one].min(), values[labels == one].max()) for one in np.unique(labels)]
    return tuple(float(low[1] + high[0]) / 2.0 for low, high in pairwise(ends))
