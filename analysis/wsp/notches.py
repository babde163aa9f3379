"""Notches in the outlines of stains: where the outline of one drop passes into that of another.

Two outlines of lengths U and V thrown onto an area A at random cross 2 U V / (pi A) times in the
mean, whatever their forms, and the angle at which they do has the density sin(angle) / 2 (the law
of Poincare: Santalo, Integral Geometry and Geometric Probability, 1976, section I.7). For drops
that fall independently, with L the length of all outlines to be seen and a share p covered, that
makes L^2 / ((1 - p) pi A) crossings in the open.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.wsp.outlines import Outlines

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

# The bend at a point is that between the chords over so many points before and after it, about
# 3 px each: blur and noise of a scan at 600 dpi reach less far.
_ARM = 4
# A smaller bend inwards may be noise, or an ellipse.
_LEAST_DEG = 15.0
# On stains of radii r and R [px] the arms bend back: a crossing is seen from so many degrees more
# on for each of 1 / r and 1 / R, as measured on drawn pairs of discs, radii 1.5 to 28 px, at the
# blur of usual scanners.
_ROUND_DEG = 120.0
# Stains are taken together in so many classes of equal length of outline.
_CLASSES = 40


def notches(outlines: Outlines) -> int:
    """Return how many notches are to be seen, but for those beside the edge of the region."""
    on, back = outlines.ahead(_ARM)
    x, y = outlines.x, outlines.y
    to_x, to_y = x - x[back], y - y[back]
    from_x, from_y = x[on] - x, y[on] - y
    # Stain on the left and y down: a positive angle bends inwards.
    bend = np.arctan2(to_x * from_y - to_y * from_x, to_x * from_x + to_y * from_y)
    is_notch = bend > np.deg2rad(_LEAST_DEG)
    by_edge = outlines.at_edge.copy()
    on = back = np.arange(len(bend))
    for step in range(_ARM + 1):
        on, back = outlines.after[on], outlines.before[back]
        by_edge |= outlines.at_edge[on] | outlines.at_edge[back]
        if step < _ARM:  # the largest bend about, and of equal ones the last
            is_notch &= (bend > bend[on]) & (bend >= bend[back])
    return int(np.count_nonzero(is_notch & ~by_edge))


def crossings(length_px: float, covered: float, roi_px: int) -> float:
    """Return how many crossings in the open outlines of this length have on the whole region."""
    return length_px**2 / ((1.0 - covered) * np.pi * roi_px)


def seen_share(area_px: Floats) -> float:
    """Return which part of the crossings of stains of these areas is seen as a notch.

    Two stains cross as often as their outlines are long.

    >>> round(seen_share(np.array([400.0])), 2), round(seen_share(np.array([12.0])), 2)
    (0.9, 0.13)
    """
    radius = np.sort(np.sqrt(np.maximum(area_px, 1.0) / np.pi))
    length = np.cumsum(radius) / radius.sum()
    middles = (np.arange(_CLASSES) + 0.5) / _CLASSES
    curving = 1.0 / radius[np.minimum(np.searchsorted(length, middles), len(radius) - 1)]
    least_deg = _LEAST_DEG + _ROUND_DEG * (curving[:, None] + curving)
    return float(((1.0 + np.cos(np.deg2rad(np.minimum(least_deg, 180.0)))) / 2.0).mean())
