"""The best zones along a pass of which none is over before the sprayer has settled on its rate.

Merging whatever is too short with a neighbour depends on the order of the merges and leaves litres
lying. Along one pass the best answer can be found: of all ways to cut it into runs of one rate,
each long enough, the one that misapplies least, by dynamic programming in one sweep.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Labels = NDArray[np.int16]

NONE = -1
# Passes that are worked out together: more take more memory, and no less time.
TOGETHER = 64
# A run that is short of its least length by a rounding is not short.
SLACK = 1e-9


def settled(cost: Floats, length_m: Floats, least_m: float) -> Labels:
    """Return the zone of every cell (passes, cells); NONE where nothing is sprayed.

    Args:
        cost: (passes, cells, zones), what a cell would misapply with the rate of each zone.
        length_m: (passes, cells), how much of each cell is field along the pass; 0 parts a pass.
        least_m: how long a run of one zone must be. A stretch of field that is shorter is one run.

    >>> cost = np.array([[[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 1.0]]])
    >>> settled(cost, np.ones((1, 4)), 1.0).tolist(), settled(cost, np.ones((1, 4)), 2.0).tolist()
    ([[0, 1, 0, 0]], [[0, 0, 0, 0]])
    """
    labels = np.full(length_m.shape, NONE, dtype=np.int16)
    pieces = stretches(length_m > 0.0)
    # Of like length together, so that few wait for the longest.
    pieces = pieces[np.argsort(pieces[:, 2] - pieces[:, 1], kind="stable")]
    for first in range(0, len(pieces), TOGETHER):
        some = pieces[first : first + TOGETHER]
        size = int((some[:, 2] - some[:, 1]).max())
        costs = np.zeros((len(some), size, cost.shape[2]))
        lengths = np.zeros((len(some), size))
        for row, (number, start, end) in enumerate(some.tolist()):
            costs[row, : end - start] = cost[number, start:end]
            lengths[row, : end - start] = length_m[number, start:end]
        found = _best(costs, lengths, some[:, 2] - some[:, 1], least_m)
        for row, (number, start, end) in enumerate(some.tolist()):
            labels[number, start:end] = found[row, : end - start]
    return labels


def stretches(there: NDArray[np.bool_]) -> Ints:
    """Return rows (pass, start, end) of cells that follow each other.

    >>> stretches(np.array([[True, True, False, True]])).tolist()
    [[0, 0, 2], [0, 3, 4]]
    """
    edges = np.diff(there.astype(np.int8), axis=1, prepend=0, append=0)
    number, start = np.nonzero(edges == 1)
    end = np.nonzero(edges == -1)[1]
    return np.column_stack([number, start, end])


def _best(cost: Floats, length_m: Floats, sizes: Ints, least_m: float) -> Labels:
    """Return the zones of stretches (rows), whose cells behind their size are padding."""
    rows, size, zones = cost.shape
    every = np.arange(rows)
    done = np.concatenate([np.zeros((rows, 1, zones)), np.cumsum(cost, axis=1)], axis=1)
    reached = np.concatenate([np.zeros((rows, 1)), np.cumsum(length_m, axis=1)], axis=1)
    best = np.full((rows, size + 1), np.inf)
    best[:, 0] = 0.0
    zone_at = np.zeros((rows, size + 1), dtype=np.int16)
    start_at = np.zeros((rows, size + 1), dtype=np.int32)
    # The last start that is far enough back, and for each zone the best of all before it.
    last = np.full(rows, -1)
    cheapest = np.full((rows, zones), np.inf)
    begun = np.zeros((rows, zones), dtype=np.int32)
    for end in range(1, size + 1):
        while True:
            far = reached[every, last + 1] <= reached[:, end] - least_m + SLACK
            far &= last + 1 < end
            if not far.any():
                break
            last[far] += 1
            at = last[far]
            offered = best[far, at, None] - done[far, at]
            better = offered < cheapest[far]
            cheapest[far] = np.where(better, offered, cheapest[far])
            begun[far] = np.where(better, at[:, None], begun[far])
        sums = cheapest + done[:, end]
        zone = np.argmin(sums, axis=1)
        best[:, end] = sums[every, zone]
        zone_at[:, end] = zone
        start_at[:, end] = begun[every, zone]
    labels = np.full((rows, size), NONE, dtype=np.int16)
    for row in range(rows):
        end = int(sizes[row])
        if not np.isfinite(best[row, end]):
            labels[row, :end] = np.argmin(done[row, end])
        while end > 0 and np.isfinite(best[row, end]):
            start = int(start_at[row, end])
            labels[row, start:end] = zone_at[row, end]
            end = start
    return labels
