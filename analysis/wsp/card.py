"""Measures one card: coverage, deposits, sizes by two spread factors, overlap, flags."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.overlap import drops_px
from analysis.wsp.quality import Seen, flags_of
from analysis.wsp.rectangle import Rectangle
from analysis.wsp.sizes import LEAST_DROP_UM, UM2_PER_CM2, Sizes, sizes, stain_um
from analysis.wsp.small import darkness_area_px
from analysis.wsp.spread import DEPOSITSCAN, Spread, second_of
from analysis.wsp.stains import THRESHOLD, Threshold, grey_of, segment

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

MM_PER_INCH = 25.4
# The cut edge of a card is bright or in shadow, and the outline is found to half a millimetre.
INSET_MM = 0.5
# A light spot within a stain is no sign of several drops: holes up to a disc of 0.25 mm.
_HOLE_MM2 = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """How cards are measured; the defaults are DepositScan's."""

    threshold: Threshold = THRESHOLD
    spread: Spread = DEPOSITSCAN
    inset_mm: float = INSET_MM


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """One card and all that was measured on it.

    `main` and `second` are the same stains by two spread factors. `drops_per_cm2` is the count
    corrected for overlap, None where the card is too wet to tell. `drop_um` are the kept drops.
    """

    outline: Rectangle
    width_mm: float
    length_mm: float
    roi_cm2: float
    dpi: float
    threshold: int
    stain_percent: float
    main: Sizes
    second: Sizes
    drops_per_cm2: float | None
    merged_percent: float | None
    flags: dict[str, str]
    drop_um: Floats = field(repr=False)
    stained: Mask = field(repr=False)
    box: tuple[int, int, int, int]


def measure(pixels: Bytes, outline: Rectangle, *, dpi: float, method: Method) -> Card:
    """Return what the card within `outline` shows."""
    height, width = pixels.shape[:2]
    px_per_mm = dpi / MM_PER_INCH
    inside = outline.inset(method.inset_mm * px_per_mm) if method.inset_mm else outline
    box = inside.box(width, height)
    left, top, right, bottom = box
    crop = pixels[top:bottom, left:right]
    roi = inside.mask(box)
    grey = grey_of(crop)
    stains = segment(grey, roi, threshold=method.threshold)
    roi_px = int(np.count_nonzero(roi))
    main, second = (
        sizes(stains.area_px, dpi=dpi, roi_px=roi_px, spread=spread)
        for spread in (method.spread, second_of(method.spread))
    )
    kept_drop_um = method.spread.drop_um(stain_um(stains.area_px, dpi))
    is_kept = np.concatenate([[False], kept_drop_um > LEAST_DROP_UM])
    stained = is_kept[stains.labels]
    unblurred_um = method.spread.drop_um(stain_um(darkness_area_px(grey, roi, stains), dpi))
    is_drop = np.concatenate([[False], unblurred_um > LEAST_DROP_UM])
    drops = drops_px(without_holes(is_drop[stains.labels], px_per_mm), roi)
    drops_per_cm2 = None if drops is None else drops * (dpi / 2.54) ** 2
    stain_percent = 100.0 * float(stains.area_px.sum()) / roi_px
    seen = Seen(
        outline=outline,
        sheet=(width, height),
        dpi=dpi,
        crop=crop,
        grey=grey,
        roi=roi,
        stains=stains,
        coverage_percent=main.coverage_percent,
    )
    return Card(
        outline=outline,
        width_mm=outline.short / px_per_mm,
        length_mm=outline.long / px_per_mm,
        roi_cm2=roi_px * (25_400.0 / dpi) ** 2 / UM2_PER_CM2,
        dpi=dpi,
        threshold=stains.threshold,
        stain_percent=stain_percent,
        main=main,
        second=second,
        drops_per_cm2=drops_per_cm2,
        merged_percent=_merged_percent(main.deposits_per_cm2, drops_per_cm2),
        flags=flags_of(seen),
        drop_um=kept_drop_um[is_kept[1:]],
        stained=stained,
        box=box,
    )


def without_holes(stained: Mask, px_per_mm: float) -> Mask:
    """Return the stains with their light spots filled; ground between stains stays free."""
    labels, count = ndimage.label(~stained)  # by sides: ground that touches by a corner is parted
    if count < 2:
        return stained
    areas = np.bincount(labels.ravel())
    is_spot = areas <= _HOLE_MM2 * px_per_mm**2
    is_spot[0] = False
    return np.asarray(stained | is_spot[labels])


def _merged_percent(counted: float, corrected: float | None) -> float | None:
    """Return how many of the drops are hidden in others' stains."""
    if not corrected:
        return None
    return 100.0 * (1.0 - counted / corrected)
