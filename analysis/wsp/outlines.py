"""The outlines of stains: where they run, to a fraction of a pixel, and which point follows which.

An outline is the chain of pixel sides between stain and paper, with the stain on its left. Each
side stands for one point: where the grey between its two pixels passes the threshold. All outlines
of a card are held in flat arrays, so that no step is taken stain by stain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# Directions along a side, left turns being + 1: east, north, west, south; y points down.
_LEFT = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Outlines:
    """Points of all outlines; `after` and `before` are the neighbours along the outline.

    `at_edge` tells points where the card's region ends and not the stain; `pixel` is the index of
    the stain's pixel at a point. `patches` is the number of patches less that of their holes.
    """

    x: Floats
    y: Floats
    after: Indices
    before: Indices
    at_edge: Mask
    pixel: Indices
    patches: int

    @property
    def length_px(self) -> float:
        """Return how long the outlines are, without what the edge of the region cuts."""
        step = np.hypot(self.x[self.after] - self.x, self.y[self.after] - self.y)
        return float(step[~(self.at_edge | self.at_edge[self.after])].sum())

    def ahead(self, steps: int) -> tuple[Indices, Indices]:
        """Return for each point the one so many steps on, and the one so many back."""
        on = back = np.arange(len(self.after))
        for _ in range(steps):
            on, back = self.after[on], self.before[back]
        return on, back


def outlines_of(stained: Mask, grey: Bytes, roi: Mask, *, threshold: int) -> Outlines:
    """Return the outlines of the stains; pixels that touch by a corner hang together."""
    width = stained.shape[1] + 2
    flat = np.pad(stained, 1).ravel()
    # Sides between a pixel and the one below it, and the one to its right; the frame is paper.
    below = np.flatnonzero(flat[width:] != flat[:-width])
    beside = np.flatnonzero(flat[1:] != flat[:-1])
    above_is, left_is = flat[below], flat[beside]
    # A corner of the grid has the number of the pixel to its upper left.
    start = np.concatenate([below - above_is, beside - width * ~left_is])
    end = np.concatenate([below - ~above_is, beside - width * left_is])
    heading = np.concatenate([np.where(above_is, 0, 2), np.where(left_is, 1, 3)])
    first = np.concatenate([below, beside])
    second = np.concatenate([below + width, beside + 1])
    stain = np.where(flat[first], first, second)
    paper = np.where(flat[first], second, first)
    turned = heading + _turn(flat, end, heading, width)
    after = _at(start * 4 + heading, end * 4 + turned % 4)
    before = np.empty_like(after)
    before[after] = np.arange(len(after))
    at_edge = ~np.pad(roi, 1).ravel()[paper]
    greys = np.pad(grey, 1).ravel()
    part = (threshold + 0.5 - greys[stain]) / np.maximum(greys[paper] - 1.0 * greys[stain], 1.0)
    part = np.where(at_edge, 0.5, np.clip(part, 0.0, 1.0))
    row, column = np.divmod(stain, width)
    return Outlines(
        x=column + part * (paper % width - column) - 0.5,
        y=row + part * (paper // width - row) - 0.5,
        after=after,
        before=before,
        at_edge=at_edge,
        pixel=(row - 1) * stained.shape[1] + column - 1,
        # Each outline turns once round, to the left about a patch and to the right about a hole.
        patches=int((turned - heading).sum()) // 4,
    )


def _turn(flat: Mask, corner: Indices, heading: Indices, width: int) -> Indices:
    """Return how an outline turns at a corner: 1 left, 0 straight on, -1 right."""
    ahead_left = flat[corner + np.array([1, 0, width, width + 1])[heading]]
    ahead_right = flat[corner + np.array([width + 1, 1, 0, width])[heading]]
    return np.where(ahead_right, -_LEFT, np.where(ahead_left, 0, _LEFT))


def _at(keys: Indices, wanted: Indices) -> Indices:
    """Return where each of `wanted` stands among `keys`, which are all different."""
    order = np.argsort(keys)
    return np.asarray(order[np.searchsorted(keys[order], wanted)])
