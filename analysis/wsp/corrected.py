"""What DepositScan's chain hides: coverage and drops corrected for threshold, blur and overlap.

The threshold lies halfway between paper and stain, so that blurred edges stay in place; small
stains are as large as the darkness they hold; drops are counted by the law of overlap and by the
notches of the outlines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.stains import (
    LEAST_CONTRAST,
    LEAST_DROP_UM,
    Outlines,
    Spread,
    Stains,
    drops_px,
    outlines_of,
    segment,
    sizes,
    stain_um,
)

# Stains at the limit of what counts: found where blur leaves no pixel dark, sized by their peaks.
#
# The stain of a drop of 50 um has an area of 2.7 pixels at 600 dpi. The blur of many a scanner
# leaves none of them as dark as the middle between paper and stain, and the paper's texture,
# coarser than a pixel, adds and takes a pixel and more of darkness. So such stains are looked for
# by a lighter threshold too, and sized by the height of their peak of darkness, over which
# texture hardly changes: by as much darkness as single stains of the same card with the same peak
# hold on average.

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


Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Corrected:
    """The corrected figures; `drops_per_cm2` is None where the card is too wet to tell.

    `merged_percent` is how many of the drops are hidden in the stains of others.
    """

    threshold: int
    covered_percent: float
    drops_per_cm2: float | None
    merged_percent: float | None


def corrected(grey: Bytes, roi: Mask, stains: Stains, *, dpi: float, spread: Spread) -> Corrected:
    """Return the figures of a card whose stains were found by another threshold."""
    fair = segment(grey, roi, threshold="auto", like=stains)
    full = full_grey(grey, fair)
    seen = with_faint(grey, roi, fair, full=full)
    area_px = darkness_area_px(grey, roi, seen, full=full)
    roi_px = int(np.count_nonzero(roi))
    figures = sizes(area_px, dpi=dpi, roi_px=roi_px, spread=spread)
    drop_um = spread.drop_um(stain_um(area_px, dpi))
    is_drop = np.concatenate([[False], drop_um > LEAST_DROP_UM])
    drops = drops_on(Counted(grey=grey, roi=roi, stains=seen, is_drop=is_drop[1:], dpi=dpi))
    per_cm2 = None if drops is None else drops / roi_px * (dpi / 2.54) ** 2
    return Corrected(
        threshold=fair.threshold,
        covered_percent=figures.coverage_percent,
        drops_per_cm2=per_cm2,
        merged_percent=100.0 * (1.0 - figures.deposits_per_cm2 / per_cm2) if per_cm2 else None,
    )


# How large small stains are, by how much darkness they hold.
#
# A scanner blurs. The part of a small stain that stays darker than a threshold is smaller than the
# stain, and stains of drops just above 50 um are lost to the count. The darkness that a stain takes
# from the paper around it is not changed by blur: divided by that of a full stain it is an area.

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


# How many drops fell on a card: by the law of overlap, and by the notches of the outlines.
#
# Euler's law (`overlap`) needs the shares of free paper alone, and holds whatever small stains
# look like. But how many drops of a few hundred hit each other is chance, which it cannot see. An
# outline can: two drops that hit each other make one patch with two notches, so that patches plus
# half of the notches are the drops but for those that hide in others and for notches that are not
# seen. How many crossings there are on average follows from the length of the outlines
# (`notches`); of n patches, V notches seen of a share q of crossings and B crossings on average
# that is
#
#     drops = (n + V / 2 + B (1 / 4 - q / 2)) / (1 - covered),
#
# since n + B / 4 is what overlap leaves of the drops on average and V has the mean q B. The two
# counts are joined by their variances. A drop at the edge of the region counts where its middle
# lies inside, which it does if more than half of it is to be seen.

# Notches in the outlines of stains: where the outline of one drop passes into that of another.
#
# Two outlines of lengths U and V thrown onto an area A at random cross 2 U V / (pi A) times in the
# mean, whatever their forms, and the angle at which they do has the density sin(angle) / 2 (the law
# of Poincare: Santalo, Integral Geometry and Geometric Probability, 1976, section I.7). For drops
# that fall independently, with L the length of all outlines to be seen and a share p covered, that
# makes L^2 / ((1 - p) pi A) crossings in the open.


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


# What either count may be off beyond chance, of the pairs that it counts by law: blur joins about
# a tenth of stains that do not touch; the share of notches seen is known to about a third.
_JOINED, _SHARE_KNOWN = 0.1, 0.3
# Many more notches than crossings: the outlines are ragged, and notches tell nothing.
_RAGGED, _RAGGED_DEVIATIONS = 1.3, 8.0
# A light spot within a stain is no sign of several drops: holes up to a disc of 0.25 mm.
_HOLE_MM2 = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Counted:
    """A card as it is counted; `is_drop` tells which of the stains are those of drops."""

    grey: Bytes
    roi: Mask
    stains: Stains
    is_drop: Mask
    dpi: float


def drops_on(card: Counted) -> float | None:
    """Return the number of drops on the region; None where too little paper is free to tell."""
    roi_px = int(np.count_nonzero(card.roi))
    number = np.where(card.is_drop, np.arange(1, len(card.is_drop) + 1, dtype=np.int32), 0)
    labels = np.concatenate([np.zeros(1, dtype=np.int32), number])[card.stains.labels]
    stained, outlines = _outlined(card, labels > 0)
    by_law_px = drops_px(stained, card.roi)
    if not by_law_px:
        return by_law_px
    covered = int(np.count_nonzero(stained)) / roi_px
    touching, inside = at_edge(outlines, labels, card.stains.area_px)
    # Euler's law takes half of each drop at the edge.
    by_law = by_law_px * roi_px + (inside - touching / 2.0) / (1.0 - covered)
    seen = notches(outlines)
    expected = crossings(outlines.length_px, covered, roi_px)
    if seen > _RAGGED * expected + _RAGGED_DEVIATIONS * math.sqrt(expected + 1.0):
        return by_law
    share = seen_share(card.stains.area_px[card.is_drop])
    patches = outlines.patches - touching + inside
    by_notches = (patches + seen / 2.0 + expected * (0.25 - share / 2.0)) / (1.0 - covered)
    pairs = expected / 4.0
    law_variance = pairs + (_JOINED * pairs) ** 2
    hidden = (1.0 - share) * pairs
    notch_variance = hidden + (_SHARE_KNOWN * hidden) ** 2
    weight = law_variance / (law_variance + notch_variance) if pairs else 1.0
    return weight * by_notches + (1.0 - weight) * by_law


def _outlined(card: Counted, stained: Mask) -> tuple[Mask, Outlines]:
    """Return the stains with their light spots filled, and their outlines."""
    threshold = card.stains.threshold
    outlines = outlines_of(stained, card.grey, card.roi, threshold=threshold)
    if outlines.patches < np.count_nonzero(card.is_drop):  # else there is no hole
        stained = without_holes(stained, card.dpi / 25.4)
        outlines = outlines_of(stained, card.grey, card.roi, threshold=threshold)
    return stained, outlines


def without_holes(stained: Mask, px_per_mm: float) -> Mask:
    """Return the stains with their light spots filled; ground between stains stays free."""
    labels, count = ndimage.label(~stained)  # by sides: ground that touches by a corner is parted
    if count < 2:
        return stained
    areas = np.bincount(labels.ravel())
    is_spot = areas <= _HOLE_MM2 * px_per_mm**2
    is_spot[0] = False
    return np.asarray(stained | is_spot[labels])


def at_edge(
    outlines: Outlines, labels: NDArray[np.int32], area_px: NDArray[np.float64]
) -> tuple[int, int]:
    """Return how many stains the edge of the region cuts, and of how many the middle is inside.

    Half a disc, and half an ellipse, has pi / 8 of the square over its cut.
    """
    points = np.flatnonzero(outlines.at_edge)
    label = labels.ravel()[outlines.pixel[points]]
    points, label = points[label > 0], label[label > 0]
    order = np.argsort(label, kind="stable")
    points, label = points[order], label[order]
    first = np.flatnonzero(np.diff(label, prepend=0))
    if not len(first):
        return 0, 0
    across, down = (
        np.maximum.reduceat(axis[points], first) - np.minimum.reduceat(axis[points], first)
        for axis in (outlines.x, outlines.y)
    )
    cut_px = np.hypot(across, down) + 1.0
    is_inside = np.maximum(area_px[label[first] - 1], 1.0) > math.pi / 8.0 * cut_px**2
    return len(first), int(np.count_nonzero(is_inside))
