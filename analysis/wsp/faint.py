"""Stains at the limit of what counts: found where blur leaves no pixel dark, sized by their peaks.

The stain of a drop of 50 um has an area of 2.7 pixels at 600 dpi. The blur of many a scanner
leaves none of them as dark as the middle between paper and stain, and the paper's texture, coarser
than a pixel, adds and takes a pixel and more of darkness. So such stains are looked for by a
lighter threshold too, and sized by the height of their peak of darkness, over which texture hardly
changes: by as much darkness as single stains of the same card with the same peak hold in the mean.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.stains import LEAST_CONTRAST, Stains

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# A stain shows at least this part of the contrast in its darkest pixel: that of a drop of 50 um
# shows 0.44 after a blur of 0.85 px; and it shows so many standard deviations of the paper.
_FAINT, _DEVIATIONS = 0.35, 5.0
# Stains of up to so many dark pixels are sized by their peak, what a peak means is told by single
# ones of up to so many more, if there are so many of them.
TINY_PX, _TELL_PX, _LEAST_TELL = 6, 12, 25
# The peak is the mean of 5 x 5 pixels under a bell of this standard deviation [px], about as wide
# as blur and aperture of a pixel make a point.
_BELL_PX, _HALF = 0.8, 2
# What is looked at about the darkest pixel, which may lie one pixel off the peak.
WINDOW = 2 * (_HALF + 1) + 1


def with_faint(grey: Bytes, roi: Mask, stains: Stains, *, full: float | None) -> Stains:
    """Return the stains and, with an area of 0, those that no pixel passes the threshold of."""
    paper = stains.paper_grey
    if full is None or paper is None:
        return stains
    free = grey[roi & (stains.labels == 0)]
    deviation = paper - float(np.quantile(free[::7], 0.16)) if len(free) else 0.0
    level = int(paper - max(_FAINT * max(paper - full, LEAST_CONTRAST), _DEVIATIONS * deviation))
    if level <= stains.threshold:
        return stains
    found, count = ndimage.label((grey <= level) & roi, structure=np.ones((3, 3)), output=np.int32)
    is_new = np.ones(count + 1, dtype=np.bool_)
    is_new[found[stains.labels > 0]] = False
    is_new[0] = False
    numbers = np.cumsum(is_new, dtype=np.int32) + np.int32(len(stains.area_px))
    places = np.flatnonzero(found > 0)
    label = found.ravel()[places]
    places, label = places[is_new[label]], label[is_new[label]]
    labels = stains.labels.copy()
    labels.ravel()[places] = numbers[label]
    area_px = np.concatenate([stains.area_px, np.zeros(int(is_new.sum()))])
    return replace(stains, labels=labels, area_px=area_px)


def by_peak(taken: Floats, is_single: Mask, threshold_px: Floats) -> Floats:
    """Return the areas of small stains from the darkness about their darkest pixels.

    `taken` holds 7 x 7 pixels a stain, 1 where full; NaN where there are too few single stains to
    tell, and for stains of more than 6 dark pixels.
    """
    areas = np.full(len(taken), np.nan)
    tells = is_single & (threshold_px <= _TELL_PX)
    if np.count_nonzero(tells) < _LEAST_TELL:
        return areas
    height = peak(taken)
    powers = np.stack([height, height**2, height**3], axis=1)
    held = taken[:, 1:-1, 1:-1].sum(axis=(1, 2))
    law, *_ = np.linalg.lstsq(powers[tells], held[tells], rcond=None)
    is_tiny = threshold_px <= TINY_PX
    areas[is_tiny] = np.maximum(powers[is_tiny] @ law, 0.0)
    return areas


def peak(taken: Floats) -> Floats:
    """Return how high the bell-weighted darkness rises next to the middle of 7 x 7 pixels."""
    bell = np.exp(-0.5 * (np.arange(-_HALF, _HALF + 1) / _BELL_PX) ** 2)
    bell /= bell.sum()
    rows: Any = sum(weight * taken[:, k : k + 3] for k, weight in enumerate(bell))
    near: Any = sum(weight * rows[:, :, k : k + 3] for k, weight in enumerate(bell))
    middle = near[:, 1, 1]
    height = middle.copy()
    for low, high in ((near[:, 0, 1], near[:, 2, 1]), (near[:, 1, 0], near[:, 1, 2])):
        # The top of the parabola through three neighbours, no further off than they are.
        bend = 2.0 * middle - low - high
        rise = (high - low) ** 2 / 8.0 / np.maximum(bend, 1e-9)
        height += np.where(bend > 0.0, np.minimum(rise, bend), 0.0)
    return np.asarray(height)


def darkest(grey: Bytes, stains: Stains) -> tuple[Indices, Indices]:
    """Return the labels of small stains, and the index of the darkest pixel of each."""
    is_small = np.concatenate([[False], stains.area_px <= _TELL_PX])
    places = np.flatnonzero(stains.labels > 0)
    places = places[is_small[stains.labels.ravel()[places]]]
    label = stains.labels.ravel()[places].astype(np.intp)
    order = np.lexsort((grey.ravel()[places], label))
    label, places = label[order], places[order]
    is_first = np.diff(label, prepend=-1) > 0
    return label[is_first], places[is_first]
