"""Which pixels of a card are stain, which stains are one, and how large the drops were.

The outlines of stains: where they run, to a fraction of a pixel, and which point follows which. An
outline is the chain of pixel sides between stain and paper, with the stain on its left. Each side
stands for one point: where the grey between its two pixels passes the threshold. All outlines of a
card are held in flat arrays, so that no step is taken stain by stain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from companion.errors import VrsprayError

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

# DepositScan's: a stain is as dark as this or darker, of 0 to 255.
THRESHOLD = 127
Threshold = int | Literal["auto"]
# Paper and stain are at least so many grey levels apart; less is the paper's own texture.
LEAST_CONTRAST = 30.0
_EIGHT = np.ones((3, 3), dtype=np.int8)


@dataclass(frozen=True, slots=True, kw_only=True)
class Stains:
    """The stains of one card: labels 1, 2, ... and 0, and the area of each label from 1 on.

    `paper_grey` and `stain_grey` are the medians on both sides of the threshold, None where a
    side is empty; `counts` are the pixels of each grey level, stained or not.
    """

    labels: NDArray[np.int32]
    area_px: Floats
    threshold: int
    paper_grey: float | None
    stain_grey: float | None
    counts: NDArray[np.int64]


def grey_of(pixels: Bytes) -> Bytes:
    """Return round((R + G + B) / 3): all colours weigh the same.

    >>> grey_of(np.array([[[255, 0, 127]]], dtype=np.uint8))
    array([[127]], dtype=uint8)
    """
    total = pixels[:, :, 0].astype(np.uint16)
    total += pixels[:, :, 1]
    total += pixels[:, :, 2]
    total += 1  # a third never lies halfway between two numbers: rounded is (total + 1) // 3
    total //= 3
    return total.astype(np.uint8)


def segment(
    grey: Bytes, roi: Mask, *, threshold: Threshold = THRESHOLD, like: Stains | None = None
) -> Stains:
    """Return the stains within `roi`; pixels that touch by a side or a corner are one stain.

    `like` is what another threshold gave on the same pixels: the answer too where both are the
    same.
    """
    counts = np.bincount(grey[roi], minlength=256) if like is None else like.counts
    level = midway(counts) if threshold == "auto" else threshold
    if like is not None and like.threshold == level:
        return like
    dark = (grey <= level) & roi
    labels, _ = ndimage.label(dark, structure=_EIGHT, output=np.int32)
    area_px = np.bincount(labels[dark].ravel())[1:].astype(np.float64)
    return Stains(
        labels=labels,
        area_px=area_px,
        threshold=level,
        paper_grey=_quantile(counts, level + 1, 256, 0.5),
        stain_grey=_quantile(counts, 0, level + 1, 0.5),
        counts=counts,
    )


def midway(counts: NDArray[np.int64]) -> int:
    """Return the grey level halfway between paper and stain, where a blurred edge stays in place.

    DepositScan's own where there are no two kinds of ground.

    >>> counts = np.zeros(256, dtype=np.int64)
    >>> counts[[60, 180]] = 10, 100
    >>> midway(counts)
    120
    """
    parted = otsu(counts)
    paper = _quantile(counts, parted + 1, 256, 0.5)
    # Much of a small stain is blurred edge: the darker quarter tells how dark stains are.
    stain = _quantile(counts, 0, parted + 1, 0.25)
    if paper is None or stain is None or not paper - stain >= LEAST_CONTRAST:
        return THRESHOLD
    return int((paper + stain) / 2.0)


def otsu(counts: NDArray[np.int64]) -> int:
    """Return the grey level that parts two classes best: N. Otsu 1979, largest variance between.

    >>> counts = np.zeros(256, dtype=np.int64)
    >>> counts[[60, 180]] = 10, 100
    >>> 60 <= otsu(counts) < 180
    True
    """
    total = float(counts.sum())
    if not total:
        return THRESHOLD
    levels = np.arange(len(counts), dtype=np.float64)
    below = np.cumsum(counts) / total
    first = np.cumsum(counts * levels) / total
    with np.errstate(divide="ignore", invalid="ignore"):
        between = (first[-1] * below - first) ** 2 / (below * (1.0 - below))
    between = np.nan_to_num(between, nan=0.0, posinf=0.0)
    # Where no pixel lies between the classes the levels there are all as good: the middle one.
    best = np.flatnonzero(between >= between.max() * (1.0 - 1e-9))
    return int(best[len(best) // 2])


def _quantile(counts: NDArray[np.int64], low: int, high: int, part: float) -> float | None:
    """Return the grey level below which `part` of the pixels from `low` to `high` lie."""
    pixels = np.cumsum(counts[low:high])
    if not len(pixels) or not pixels[-1]:
        return None
    return float(low + int(np.searchsorted(pixels, part * pixels[-1])))


# How many drops fell where stains have run together.
#
# Drops that fall at random, each with a stain of any convex shape and size, make a Boolean model.
# For it, a set C of points is free of stain with the probability exp(-n E|stain + C|), n the number
# of drops an area (Matheron 1975; Stoyan, Kendall, Mecke, Stochastic Geometry and its Applications,
# section 3.1). Take for C one pixel, two neighbours in a row or in a column, and four in a square.
# A single stain covers pixels that hang together without a hole, so that by Euler's law, faces less
# edges plus corners is one for its patch of pixels:
#
#     |stain + four| - |stain + two in a row| - |stain + two in a column| + |stain + one| = 1 px
#
# With the logarithms of the free shares in place of the areas this is
#
#     n = ln(row x column / (one x four))        drops a pixel,
#
# without any assumption on sizes, and exact on the pixel grid where pixels that touch by a corner
# are joined. (Without the logarithms the same sum counts the patches less their holes.) What it
# does assume is that the drops fell independently and evenly over the card.

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


# -------------------------------------------------------------------------------------- their drops

# DepositScan leaves out what a smaller drop than this would have made: dust and noise.
LEAST_DROP_UM = 50.0
UM2_PER_CM2 = 1e8
# 1 um of liquid on 1 cm2 is 0.1 uL; 1 uL/cm2 is 100 L/ha.
UL_CM2_PER_UM = 0.1
L_HA_PER_UL_CM2 = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """What the stains of a card say by one spread factor; diameters are None without a deposit."""

    spread: str
    deposits: int
    deposits_per_cm2: float
    coverage_percent: float
    dv01_um: float | None
    dv05_um: float | None
    dv09_um: float | None
    relative_span: float | None
    nmd_um: float | None
    ul_per_cm2: float
    l_ha: float


def stain_um(area_px: Floats, dpi: float) -> Floats:
    """Return the diameters of the discs of these areas, sqrt(4 A / pi)."""
    return np.asarray(np.sqrt(4.0 / math.pi * area_px) * (25_400.0 / dpi))


def sizes(area_px: Floats, *, dpi: float, roi_px: int, spread: Spread) -> Sizes:
    """Return the figures of stains of these areas, on `roi_px` pixels of paper.

    DepositScan's chain: drops of more than 50 um are kept; coverage and count are those of them.
    """
    drop_um = spread.drop_um(stain_um(area_px, dpi))
    kept = drop_um > LEAST_DROP_UM
    drop_um = drop_um[kept]
    roi_um2 = roi_px * (25_400.0 / dpi) ** 2
    volume_um3 = math.pi / 6.0 * drop_um**3
    ul_per_cm2 = float(volume_um3.sum()) * UL_CM2_PER_UM / roi_um2
    dv01, dv05, dv09 = (fraction_um(drop_um, volume_um3, part) for part in (0.1, 0.5, 0.9))
    return Sizes(
        spread=spread.name,
        deposits=len(drop_um),
        deposits_per_cm2=len(drop_um) / roi_um2 * UM2_PER_CM2,
        coverage_percent=100.0 * float(area_px[kept].sum()) / roi_px,
        dv01_um=dv01,
        dv05_um=dv05,
        dv09_um=dv09,
        relative_span=(
            None if dv01 is None or dv05 is None or dv09 is None else (dv09 - dv01) / dv05
        ),
        nmd_um=fraction_um(drop_um, np.ones(len(drop_um)), 0.5),
        ul_per_cm2=ul_per_cm2,
        l_ha=ul_per_cm2 * L_HA_PER_UL_CM2,
    )


def fraction_um(drop_um: Floats, weight: Floats, part: float) -> float | None:
    """Return the diameter below which `part` of the weight lies; None without a drop.

    Straight between the drops in the order of their sizes, and from the origin to the smallest.

    >>> fraction_um(np.array([100.0, 200.0]), np.array([1.0, 3.0]), 0.5)
    133.33333333333334
    >>> fraction_um(np.array([100.0]), np.array([1.0]), 0.5)
    50.0
    """
    if not len(drop_um):
        return None
    order = np.argsort(drop_um)
    share = np.concatenate([[0.0], np.cumsum(weight[order])])
    return float(np.interp(part, share / share[-1], np.concatenate([[0.0], drop_um[order]])))


# From the stain on the paper to the drop that made it: spread factors by name.
#
# A drop spreads on the paper by a factor that grows with its size, and every source has another
# law; the laws are 10 to 15 % apart, so whoever gives a drop size has to say which was used.

# Stain and drop diameter [um]: the table of the paper's maker.
_TABLE_STAIN_UM = np.array([0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0])
_TABLE_DROP_UM = np.array([0.0, 59.0, 109.0, 155.0, 200.0, 243.0, 285.0])
# D = a d - b d^2, which turns back at a / (2 b): larger stains get the drop of that one.
_USDA_A, _USDA_B = 0.53549306, 8.4839e-5


class SpreadError(VrsprayError):
    """There is no spread factor of that name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """A law from the stain's to the drop's diameter, both in um, never falling."""

    name: str
    formula: str
    drop_um: Callable[[Floats], Floats]


def _usda(stain_um: Floats) -> Floats:
    stain_um = np.minimum(stain_um, _USDA_A / (2.0 * _USDA_B))
    return np.asarray(_USDA_A * stain_um - _USDA_B * stain_um**2)


def _table(stain_um: Floats) -> Floats:
    within = np.interp(stain_um, _TABLE_STAIN_UM, _TABLE_DROP_UM)
    # Beyond the table its last ratio.
    beyond = stain_um * (_TABLE_DROP_UM[-1] / _TABLE_STAIN_UM[-1])
    return np.asarray(np.where(stain_um > _TABLE_STAIN_UM[-1], beyond, within))


def _power(name: str, factor: float, exponent: float) -> Spread:
    return Spread(
        name=name,
        formula=f"D = {factor:g} d^{exponent:g}",
        drop_um=lambda stain_um: np.asarray(factor * stain_um**exponent),
    )


DEPOSITSCAN = _power("depositscan", 0.95, 0.91)
SPREADS = {
    spread.name: spread
    for spread in (
        DEPOSITSCAN,
        Spread(name="usda", formula="D = 0.53549306 d - 8.4839e-5 d^2", drop_um=_usda),
        Spread(
            name="adaptive",
            formula="D = d / (0.0009 d + 1.6333)",
            drop_um=lambda stain_um: np.asarray(stain_um / (0.0009 * stain_um + 1.6333)),
        ),
        Spread(name="table", formula="100:59, 200:109, 300:155 ... 600:285 um", drop_um=_table),
        Spread(name="none", formula="D = d", drop_um=lambda stain_um: stain_um),
    )
}


def spread_of(name: str) -> Spread:
    """Return the law of a name, or D = A d^B of `user:A,B`.

    >>> float(spread_of("depositscan").drop_um(np.array([300.0]))[0].round(1))
    170.6
    >>> float(spread_of("user:1,1").drop_um(np.array([300.0]))[0])
    300.0
    """
    if name in SPREADS:
        return SPREADS[name]
    kind, _, numbers = name.partition(":")
    try:
        factor, exponent = (float(number) for number in numbers.split(","))
    except ValueError:
        factor = exponent = 0.0
    if kind == "user" and 0.0 < factor < 100.0 and 0.1 <= exponent <= 2.0:
        return _power(name, factor, exponent)
    raise SpreadError(
        f"--spread {name[:40]}: give one of {', '.join(SPREADS)}, or user:A,B for D = A d^B [um]"
    )


def second_of(spread: Spread) -> Spread:
    """Return the law whose figures stand in the second column."""
    return SPREADS["usda"] if spread.name == DEPOSITSCAN.name else DEPOSITSCAN
