"""What DepositScan's chain hides: coverage and drops corrected for threshold, blur and overlap.

The threshold lies halfway between paper and stain, so that blurred edges stay in place; small
stains are as large as the darkness they hold; drops are counted by the law of overlap and by the
notches of the outlines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.wsp.counts import Counted, drops_on
from analysis.wsp.faint import with_faint
from analysis.wsp.sizes import LEAST_DROP_UM, sizes, stain_um
from analysis.wsp.small import darkness_area_px, full_grey
from analysis.wsp.spread import Spread
from analysis.wsp.stains import Stains, segment

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
