"""What DepositScan's chain hides: coverage and drops corrected for threshold, blur and overlap.

The threshold lies halfway between paper and stain, so that blurred edges stay in place; small
stains are as large as the darkness they hold; drops are counted by the law of overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.overlap import drops_px
from analysis.wsp.sizes import LEAST_DROP_UM, sizes, stain_um
from analysis.wsp.small import darkness_area_px
from analysis.wsp.spread import Spread
from analysis.wsp.stains import Stains, segment

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# A light spot within a stain is no sign of several drops: holes up to a disc of 0.25 mm.
_HOLE_MM2 = 0.05


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
    area_px = darkness_area_px(grey, roi, fair)
    roi_px = int(np.count_nonzero(roi))
    figures = sizes(area_px, dpi=dpi, roi_px=roi_px, spread=spread)
    drop_um = spread.drop_um(stain_um(area_px, dpi))
    is_drop = np.concatenate([[False], drop_um > LEAST_DROP_UM])
    drops = drops_px(without_holes(is_drop[fair.labels], dpi / 25.4), roi)
    per_cm2 = None if drops is None else drops * (dpi / 2.54) ** 2
    return Corrected(
        threshold=fair.threshold,
        covered_percent=figures.coverage_percent,
        drops_per_cm2=per_cm2,
        merged_percent=100.0 * (1.0 - figures.deposits_per_cm2 / per_cm2) if per_cm2 else None,
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
