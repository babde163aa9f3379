"""Measures one card: coverage, deposits, sizes by two spread factors, overlap, flags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.wsp.corrected import Corrected, corrected
from analysis.wsp.image import Found, Sheet, find_cards
from analysis.wsp.quality import SIDE_TOLERANCE, Seen, flags_of
from analysis.wsp.rectangle import Rectangle
from analysis.wsp.sizes import (
    DEPOSITSCAN,
    LEAST_DROP_UM,
    UM2_PER_CM2,
    Sizes,
    Spread,
    second_of,
    sizes,
    stain_um,
)
from analysis.wsp.stains import THRESHOLD, Threshold, grey_of, segment
from companion.errors import VrsprayError

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


# One sheet: which resolution it has, which cards lie on it, and what each of them shows.

DpiSource = Literal["option", "file", "card-width"]
CARD_WIDTH_MM = 26.0
_CARD_LENGTH = 76.0 / 26.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How a scan is read: what the user says of it."""

    method: Method
    whole: bool = False
    dpi: float | None = None
    card_width_mm: float = CARD_WIDTH_MM


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetResult:
    """What one sheet showed; `cards` in reading order, none where none was found."""

    path: Path
    page: int
    name: str
    width_px: int
    height_px: int
    dpi: float | None
    dpi_source: DpiSource | None
    cards: tuple[Card, ...]
    notes: tuple[str, ...]


def read_sheet(sheet: Sheet, reading: Reading) -> SheetResult:
    """Return the cards of a sheet, measured."""
    height, width = sheet.pixels.shape[:2]
    others = 0
    if reading.whole:
        found = [Found(outline=_all_of(width, height))]
    else:
        found, others = find_cards(sheet)
    notes = list(sheet.notes)
    if others:
        notes.append(
            f"{others} of card colour but no rectangle, left out: cards must not touch each other"
        )
    cards: list[Card] = []
    dpi: float | None = None
    source: DpiSource | None = None
    if found:
        dpi, source = resolution(sheet.dpi, [each.outline for each in found], reading)
        if reading.dpi is not None and sheet.dpi and abs(sheet.dpi / dpi - 1.0) > 0.01:
            notes.append(f"the file says {sheet.dpi:g} dpi, --dpi {dpi:g} was taken")
        for each in found:
            try:
                cards.append(measure(sheet.pixels, each, dpi=dpi, method=reading.method))
            except ValueError as error:
                short, long = each.outline.short, each.outline.long
                raise VrsprayError(
                    f"{sheet.path}: a card of {short:.0f} x {long:.0f} pixels is too small at "
                    f"{dpi:g} dpi ({error}); give the right --dpi or a smaller --inset-mm"
                ) from error
    else:
        notes.append("no cards: nothing yellow or blue is a rectangle; give --whole for one card")
    return SheetResult(
        path=sheet.path,
        page=sheet.page,
        name=sheet.name,
        width_px=width,
        height_px=height,
        dpi=dpi,
        dpi_source=source,
        cards=tuple(cards),
        notes=tuple(notes),
    )


def resolution(
    stated: float | None, outlines: Sequence[Rectangle], reading: Reading
) -> tuple[float, DpiSource]:
    """Return the resolution and where it comes from: the option, the file, or the cards' width."""
    if reading.dpi is not None:
        return reading.dpi, "option"
    if stated is not None:
        return stated, "file"
    # A card of the usual shape tells best; half of one is as wide, but 52 mm cards are not.
    usual = [
        each.short
        for each in outlines
        if abs(each.long / each.short / _CARD_LENGTH - 1.0) <= SIDE_TOLERANCE
    ]
    short_px = float(np.median(usual or [each.short for each in outlines]))
    return short_px / reading.card_width_mm * 25.4, "card-width"


def _all_of(width: int, height: int) -> Rectangle:
    return Rectangle(
        x=width / 2.0,
        y=height / 2.0,
        long=float(max(width, height)),
        short=float(min(width, height)),
        angle_deg=0.0 if width >= height else 90.0,
    )
