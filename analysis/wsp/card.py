"""Measures one card: coverage, deposits, sizes by two spread factors, overlap, flags."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from analysis.wsp.cards import Found
from analysis.wsp.corrected import Corrected, corrected
from analysis.wsp.quality import Seen, flags_of
from analysis.wsp.rectangle import Rectangle
from analysis.wsp.sizes import LEAST_DROP_UM, UM2_PER_CM2, Sizes, sizes, stain_um
from analysis.wsp.spread import DEPOSITSCAN, Spread, second_of
from analysis.wsp.stains import THRESHOLD, Threshold, grey_of, segment

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

MM_PER_INCH = 25.4
# The cut edge of a card is bright or in shadow, and the outline is found to half a millimetre.
INSET_MM = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """How cards are measured; the defaults are DepositScan's."""

    threshold: Threshold = THRESHOLD
    spread: Spread = DEPOSITSCAN
    inset_mm: float = INSET_MM


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """One card and all that was measured on it.

    `main` and `second` are the same stains by two spread factors, `better` what they hide.
    `drop_um` are the kept drops of `main`; `stained` their pixels within `box`.
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
    better: Corrected
    flags: dict[str, str]
    drop_um: Floats = field(repr=False)
    stained: Mask = field(repr=False)
    box: tuple[int, int, int, int]


def measure(pixels: Bytes, found: Found, *, dpi: float, method: Method) -> Card:
    """Return what a card shows."""
    height, width = pixels.shape[:2]
    outline = found.outline
    px_per_mm = dpi / MM_PER_INCH
    box = outline.box(width, height)
    roi = found.mask(box, margin=method.inset_mm * px_per_mm)
    crop = pixels[box[1] : box[3], box[0] : box[2]]
    roi_px = int(np.count_nonzero(roi))
    if not roi_px:
        raise ValueError("nothing of the card is left within its edge")
    grey = grey_of(crop)
    stains = segment(grey, roi, threshold=method.threshold)
    main, second = (
        sizes(stains.area_px, dpi=dpi, roi_px=roi_px, spread=spread)
        for spread in (method.spread, second_of(method.spread))
    )
    better = corrected(grey, roi, stains, dpi=dpi, spread=method.spread)
    drop_um = method.spread.drop_um(stain_um(stains.area_px, dpi))
    is_kept = np.concatenate([[False], drop_um > LEAST_DROP_UM])
    seen = Seen(
        outline=outline,
        filled=found.filled,
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
        stain_percent=100.0 * float(stains.area_px.sum()) / roi_px,
        main=main,
        second=second,
        better=better,
        flags=flags_of(seen),
        drop_um=drop_um[is_kept[1:]],
        stained=is_kept[stains.labels],
        box=box,
    )
