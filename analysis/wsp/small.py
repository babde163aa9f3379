"""How large small stains are, by how much darkness they hold.

A scanner blurs. The part of a small stain that stays darker than a threshold is smaller than the
stain, and stains of drops just above 50 um are lost to the count. The darkness that a stain takes
from the paper around it is not changed by blur: divided by that of a full stain it is an area.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.stains import LEAST_CONTRAST, Stains

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

# Larger stains lose less than a tenth to blur; they keep the area that the threshold gives.
SMALL_PX = 40
# Blur carries darkness so far beyond the threshold's edge [px]; paper is what lies further away.
_REACH = 2
# The paper's own grey is the mean over so many pixels around, as light is not quite even.
_AROUND, _BLOCK = 60, 4
# So many pixels deep within large stains tell how dark a full stain is.
_LEAST_DEEP = 50
# So many single stains of a number of pixels tell how large those beside others are.
_LEAST_SINGLE = 5


def darkness_area_px(grey: Bytes, roi: Mask, stains: Stains) -> Floats:
    """Return the area of each stain: of small, single ones by their darkness."""
    full = _full_grey(grey, stains)
    if full is None or stains.paper_grey is None:
        return stains.area_px
    labels, last = _narrow(stains.labels, len(stains.area_px))
    side = 2 * _REACH + 1
    owners = ndimage.maximum_filter(labels, size=side)
    lowest = ndimage.minimum_filter(np.where(labels == 0, last, labels), size=side)
    # Only the pixels in and about stains matter from here on: a small part of them all.
    about = np.flatnonzero(owners)
    owner, other = owners.ravel()[about], lowest.ravel()[about]
    paper = _paper_around(grey, roi & (owners == 0), stains.paper_grey, about)
    taken = (paper - grey.ravel()[about]) / np.maximum(paper - full, LEAST_CONTRAST)
    taken *= roi.ravel()[about]
    area_px = np.bincount(owner, weights=taken, minlength=int(last))[1:]
    use = stains.area_px <= SMALL_PX
    # Where the surroundings of two stains meet, darkness cannot be told apart.
    is_shared = owner != other
    for shared in (owner[is_shared], other[is_shared]):
        use[shared.astype(np.int64) - 1] = False
    single = np.where(use, np.maximum(area_px, stains.area_px), stains.area_px)
    return _as_singles(single, stains.area_px, use)


def _as_singles(area_px: Floats, threshold_px: Floats, is_single: Mask) -> Floats:
    """Return the areas, small stains beside others as large as single ones of the same pixels."""
    size = threshold_px.astype(np.int64)
    among = size[is_single]
    count = np.bincount(among, minlength=SMALL_PX + 1)
    total = np.bincount(among, weights=area_px[is_single], minlength=SMALL_PX + 1)
    mean = np.where(count >= _LEAST_SINGLE, total / np.maximum(count, 1), np.arange(len(count)))
    beside = ~is_single & (threshold_px <= SMALL_PX)
    return np.where(beside, mean[np.minimum(size, SMALL_PX)], area_px)


def _narrow(labels: NDArray[np.int32], count: int) -> tuple[NDArray[Any], Any]:
    """Return the labels in as few bytes as they need, and a number above them all."""
    kind = np.uint16 if count < np.iinfo(np.uint16).max else np.int32
    return labels.astype(kind), kind(count + 1)


def _full_grey(grey: Bytes, stains: Stains) -> float | None:
    mask = stains.labels > 0
    inner = slice(2, -2)
    deep = mask[inner, inner].copy()
    for down in (slice(None, -4), inner, slice(4, None)):
        for right in (slice(None, -4), inner, slice(4, None)):
            deep &= mask[down, right]
    values = grey[inner, inner][deep]
    return float(np.median(values)) if len(values) >= _LEAST_DEEP else None


def _paper_around(
    grey: Bytes, paper: Mask, usual: float, places: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Return the mean grey of the paper around places (indices of pixels), from block means."""
    height, width = grey.shape
    rows, columns = -(-height // _BLOCK), -(-width // _BLOCK)
    share = np.zeros((rows * _BLOCK, columns * _BLOCK), dtype=np.float32)
    total = np.zeros_like(share)
    share[:height, :width] = paper
    np.multiply(grey, paper, out=total[:height, :width], dtype=np.float32)
    around = max(_AROUND // _BLOCK, 1)
    blocks = [
        ndimage.uniform_filter(each.reshape(rows, _BLOCK, columns, _BLOCK).mean((1, 3)), around)
        for each in (share, total)
    ]
    mean = np.where(blocks[0] > 0.1, blocks[1] / np.maximum(blocks[0], 0.1), np.float32(usual))
    return np.asarray(mean[(places // width) // _BLOCK, (places % width) // _BLOCK])
