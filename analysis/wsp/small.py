"""How large small stains are, by how much darkness they hold.

A scanner blurs. The part of a small stain that stays darker than a threshold is smaller than the
stain, and stains of drops just above 50 um are lost to the count. The darkness that a stain takes
from the paper around it is not changed by blur: divided by that of a full stain it is an area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.faint import WINDOW, by_peak, darkest
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Paper:
    """The grey of the paper: the mean about each block of 4 x 4 pixels of a picture."""

    blocks: NDArray[np.float32]
    width: int

    def at(self, places: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return the grey of the paper at places, indices of pixels."""
        rows, columns = np.divmod(places, self.width)
        return np.asarray(self.blocks[rows // _BLOCK, columns // _BLOCK])


def darkness_area_px(grey: Bytes, roi: Mask, stains: Stains, *, full: float | None) -> Floats:
    """Return the area of each stain: of small ones by their darkness; `full` is full_grey's."""
    if full is None or stains.paper_grey is None:
        return stains.area_px
    zones, zone_of = _zones(stains)
    # Only the pixels in and about stains matter from here on: a small part of them all.
    about = np.flatnonzero(zones > 0)
    ground = _paper_around(grey, roi & (zones == 0), stains.paper_grey)
    paper = ground.at(about)
    taken = (paper - grey.ravel()[about]) / np.maximum(paper - full, LEAST_CONTRAST)
    taken *= roi.ravel()[about]
    area_px = np.bincount(zones.ravel()[about], weights=taken)[zone_of]
    # Where the surroundings of two stains meet, darkness cannot be told apart.
    use = (stains.area_px <= SMALL_PX) & (np.bincount(zone_of)[zone_of] == 1)
    single = np.where(use, np.maximum(area_px, stains.area_px), stains.area_px)
    areas = _as_singles(single, stains.area_px, use)
    label, places = darkest(grey, stains)
    about_them = _taken_about(grey, roi, places, ground.at(places), full)
    by_height = by_peak(about_them, use[label - 1], stains.area_px[label - 1])
    known = np.isfinite(by_height)
    areas[label[known] - 1] = by_height[known]
    return areas


def _taken_about(
    grey: Bytes, roi: Mask, places: NDArray[np.intp], paper: NDArray[np.float32], full: float
) -> Floats:
    """Return how much of the paper's light is gone around places, (places, 7, 7), 1 where full."""
    height, width = grey.shape
    rows, columns = np.divmod(places, width)
    reach = np.arange(WINDOW) - WINDOW // 2
    rows = np.clip(rows[:, None] + reach, 0, height - 1)[:, :, None]
    columns = np.clip(columns[:, None] + reach, 0, width - 1)[:, None, :]
    ground = paper[:, None, None].astype(np.float64)
    taken = (ground - grey[rows, columns]) / np.maximum(ground - full, LEAST_CONTRAST)
    return np.asarray(taken * roi[rows, columns])


def _as_singles(area_px: Floats, threshold_px: Floats, is_single: Mask) -> Floats:
    """Return the areas, small stains beside others as large as single ones of the same pixels."""
    size = threshold_px.astype(np.int64)
    among = size[is_single]
    count = np.bincount(among, minlength=SMALL_PX + 1)
    total = np.bincount(among, weights=area_px[is_single], minlength=SMALL_PX + 1)
    mean = np.where(count >= _LEAST_SINGLE, total / np.maximum(count, 1), np.arange(len(count)))
    beside = ~is_single & (threshold_px <= SMALL_PX)
    return np.where(beside, mean[np.minimum(size, SMALL_PX)], area_px)


def _zones(stains: Stains) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Return the zones of stains and their surroundings, and in which of them each stain lies."""
    near = stains.labels > 0
    for axis in (0, 1):
        wide = near.copy()
        for step in range(1, _REACH + 1):
            start, end = (slice(step, None), slice(None, -step))
            low, high = (start, end) if axis == 0 else ((slice(None), start), (slice(None), end))
            wide[low] |= near[high]
            wide[high] |= near[low]
        near = wide
    zones, _ = ndimage.label(near, structure=np.ones((3, 3)), output=np.int32)
    places = np.flatnonzero(stains.labels > 0)
    zone_of = np.zeros(len(stains.area_px), dtype=np.intp)
    zone_of[stains.labels.ravel()[places] - 1] = zones.ravel()[places]
    return zones, zone_of


def full_grey(grey: Bytes, stains: Stains) -> float | None:
    """Return how dark stains are in their depths; None where none is large enough."""
    mask = stains.labels > 0
    inner = slice(2, -2)
    deep = mask[inner, inner].copy()
    for down in (slice(None, -4), inner, slice(4, None)):
        for right in (slice(None, -4), inner, slice(4, None)):
            deep &= mask[down, right]
    values = grey[inner, inner][deep]
    return float(np.median(values)) if len(values) >= _LEAST_DEEP else None


def _paper_around(grey: Bytes, paper: Mask, usual: float) -> Paper:
    """Return the mean grey of the paper around every place, from block means."""
    # Every second pixel of every second row is enough: the paper's texture is coarser.
    height, width = (-(-side // _BLOCK) for side in grey.shape)
    share, total = np.zeros((2, height * _BLOCK // 2, width * _BLOCK // 2), dtype=np.float32)
    some = paper[::2, ::2]
    share[: some.shape[0], : some.shape[1]] = some
    np.multiply(grey[::2, ::2], some, out=total[: some.shape[0], : some.shape[1]])
    around = max(_AROUND // _BLOCK, 1)
    blocks = [
        ndimage.uniform_filter(
            each[::2, ::2] + each[1::2, ::2] + each[::2, 1::2] + each[1::2, 1::2], around
        )
        for each in (share, total)
    ]
    is_known = blocks[0] > 0.4
    mean = np.where(is_known, blocks[1] / np.where(is_known, blocks[0], 1.0), np.float32(usual))
    return Paper(blocks=mean, width=grey.shape[1])
