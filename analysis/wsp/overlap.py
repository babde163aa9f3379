"""How many drops fell where stains have run together.

Drops that fall at random, each with a stain of any convex shape and size, make a Boolean model.
For it, a set C of points is free of stain with the probability exp(-n E|stain + C|), n the number
of drops an area (Matheron 1975; Stoyan, Kendall, Mecke, Stochastic Geometry and its Applications,
section 3.1). Take for C one pixel, two neighbours in a row or in a column, and four in a square.
A single stain covers pixels that hang together without a hole, so that by Euler's law, faces less
edges plus corners is one for its patch of pixels:

    |stain + four| - |stain + two in a row| - |stain + two in a column| + |stain + one| = 1 px

With the logarithms of the free shares in place of the areas this is

    n = ln(row x column / (one x four))        drops a pixel,

without any assumption on sizes, and exact on the pixel grid where pixels that touch by a corner
are joined. (Without the logarithms the same sum counts the patches less their holes.) What it
does assume is that the drops fell independently and evenly over the card.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

LAW = "boolean-model"
# Above this coverage the plain count is no measure of drops (reference: cards above 20 %).
UNRELIABLE_PERCENT = 20.0
# Beyond this the free squares are too few for a logarithm to be of use.
_LEAST_FREE = 0.2


def drops_px(stained: Mask, roi: Mask) -> float | None:
    """Return the number of drops a pixel; None where too little paper is free to tell.

    Only pairs and squares that lie in `roi` as a whole are looked at, so that stains on the edge
    of the card count by the part that is on it.
    """
    free = ~stained & roi
    row_roi, row = _both(roi, 1), _both(free, 1)
    one = _share(free, roi)
    pair_row = _share(row, row_roi)
    pair_column = _share(_both(free, 0), _both(roi, 0))
    four = _share(_both(row, 0), _both(row_roi, 0))
    if not (four >= _LEAST_FREE and one > 0.0):
        return None
    # Never below zero but by rounding of a card without a stain.
    return max(math.log(pair_row) + math.log(pair_column) - math.log(one) - math.log(four), 0.0)


def _both(mask: Mask, axis: int) -> Mask:
    """Return where a pixel and its next along an axis both are."""
    return mask[:-1] & mask[1:] if axis == 0 else mask[:, :-1] & mask[:, 1:]


def _share(free: Mask, roi: Mask) -> float:
    all_of_them = int(np.count_nonzero(roi))
    return int(np.count_nonzero(free)) / all_of_them if all_of_them else 0.0
