"""Measures one card: coverage, deposits, sizes by two spread factors, overlap, flags.

What is doubtful about a card: a name and a sentence for each, none of it stops the figures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.wsp.corrected import Corrected, corrected
from analysis.wsp.image import FLAT, YELLOW_ABOVE_BLUE, Found, Rectangle, Sheet, find_cards
from analysis.wsp.stains import (
    DEPOSITSCAN,
    LEAST_DROP_UM,
    THRESHOLD,
    UM2_PER_CM2,
    UNRELIABLE_PERCENT,
    Sizes,
    Spread,
    Stains,
    Threshold,
    grey_of,
    second_of,
    segment,
    sizes,
    stain_um,
)
from companion.errors import VrsprayError

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# P1's limits: more is overspray (after Chen et al. 2013); enough for insecticides and fungicides.
OVERSPRAY_PERCENT = 30.0
INSECTICIDE_PER_CM2, FUNGICIDE_PER_CM2 = 30.0, 70.0
# A drop of 50 um makes a stain of 78 um: 3.4 pixels at 600 dpi, 2.3 at 500, less than one at 300.
LEAST_DPI = 500.0
# The card's own formats [mm]: short and long side, with what cutting and outline may be off.
FORMATS_MM = ((26.0, 76.0), (52.0, 76.0))
SIDE_TOLERANCE = 0.06
# One stain of more than a tenth of the card on paper that is nowhere brighter than this is shade.
_LARGE_STAIN, _PAPER_FLOOR = 0.10, 143
# Paper that differs by more than this between eighths of the card [grey levels].
_UNEVEN = 20.0
_CLIPPED_PAPER, _CLIPPED_STAIN = 0.05, 0.3
# So much of what is no stain must be yellow: brown or faded paper still is, in parts.
_YELLOW_LEAST = 0.01
# 127 within this share of the contrast from the middle; at 600 dpi a stain's edge then lies
# within about a quarter of a pixel.
_OFF_MIDDLE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What the judgement rests on."""

    outline: Rectangle
    filled: float
    sheet: tuple[int, int]
    dpi: float
    crop: Bytes
    grey: Bytes
    roi: Mask
    stains: Stains
    coverage_percent: float


def flags_of(seen: Seen) -> dict[str, str]:
    """Return what is doubtful, by name."""
    found: dict[str, str] = {}
    for check in (_wet, _light, _clipping, _threshold, _resolution, _shape):
        found.update(check(seen))
    return found


def _wet(seen: Seen) -> Iterator[tuple[str, str]]:
    coverage = seen.coverage_percent
    if not coverage <= OVERSPRAY_PERCENT:
        yield "overspray", f"coverage {coverage:.1f} % is more than {OVERSPRAY_PERCENT:g} %"
    if not coverage <= UNRELIABLE_PERCENT:
        yield (
            "counts-unreliable",
            f"above {UNRELIABLE_PERCENT:g} % coverage most stains are several drops: "
            "no count and no drop size to rely on",
        )


def _light(seen: Seen) -> Iterator[tuple[str, str]]:
    greys = list(block_greys(seen.grey, seen.roi & (seen.stains.labels == 0)))
    if not greys:
        yield "no-paper", "no unstained paper is visible: is this a card?"
        return
    if not _has_yellow(seen):
        yield "no-paper", "nothing on it is yellow; is this a card, and scanned in colour?"
    largest = float(seen.stains.area_px.max(initial=0.0)) / max(int(seen.roi.sum()), 1)
    span = max(greys) - min(greys)
    if span > _UNEVEN or (largest > _LARGE_STAIN and min(greys) < _PAPER_FLOOR):
        yield (
            "uneven-light",
            f"the paper's grey goes from {min(greys):.0f} to {max(greys):.0f} over the card; "
            "scan it flat, lid closed",
        )


def _has_yellow(seen: Seen) -> bool:
    """Whether at least a hundredth of what is no stain is yellow, as the paper is."""
    # Every sixth pixel of every sixth row: 30 000 of a card.
    step = slice(None, None, 6)
    is_paper = seen.roi[step, step] & (seen.stains.labels[step, step] == 0)
    paper = seen.crop[step, step][is_paper].astype(np.int16)
    yellow = paper[:, :2].min(axis=1) > paper[:, 2] + YELLOW_ABOVE_BLUE
    return bool(yellow.sum() >= max(_YELLOW_LEAST * len(paper), 1.0))


def block_greys(grey: Bytes, paper: Mask) -> Iterator[float]:
    """Yield the median grey of the paper in each eighth of the card that has enough of it."""
    rows, columns = (4, 2) if grey.shape[0] >= grey.shape[1] else (2, 4)
    tops = np.linspace(0, grey.shape[0], rows + 1).astype(int)
    lefts = np.linspace(0, grey.shape[1], columns + 1).astype(int)
    for top, bottom in pairwise(tops):
        for left, right in pairwise(lefts):
            # Every third pixel is enough for a median.
            block = grey[top:bottom:3, left:right:3][paper[top:bottom:3, left:right:3]]
            if block.size >= 30:
                yield float(np.median(block))


def _clipping(seen: Seen) -> Iterator[tuple[str, str]]:
    crop, grey = seen.crop[::3, ::3], seen.grey[::3, ::3]
    stained = seen.stains.labels[::3, ::3] > 0
    paper = seen.roi[::3, ::3] & ~stained
    # What is white or black in all colours is so in grey: only there all three are looked at.
    white = (crop[(grey >= 254) & paper] >= 254).all(axis=1)
    black = (crop[(grey <= 1) & stained] <= 1).all(axis=1)
    if white.sum() > _CLIPPED_PAPER * max(int(paper.sum()), 1):
        yield "clipping", "parts of the paper are pure white; scan darker"
    elif black.sum() > _CLIPPED_STAIN * max(int(stained.sum()), 1):
        yield "clipping", "stains are pure black; scan brighter"


def _threshold(seen: Seen) -> Iterator[tuple[str, str]]:
    paper, stain = seen.stains.paper_grey, seen.stains.stain_grey
    if paper is None or stain is None:
        return
    off = abs(seen.stains.threshold - (paper + stain) / 2.0)
    if not off <= _OFF_MIDDLE * (paper - stain):
        yield (
            "threshold-off-middle",
            f"paper is {paper:.0f}, stains {stain:.0f}, the threshold {seen.stains.threshold}: "
            "stains come out too large or too small; see the corrected figures, --threshold auto",
        )


def _resolution(seen: Seen) -> Iterator[tuple[str, str]]:
    if not seen.dpi >= LEAST_DPI:
        yield (
            "low-dpi",
            f"{seen.dpi:.0f} dpi: small drops have too few pixels; scan at 600 dpi",
        )


def _shape(seen: Seen) -> Iterator[tuple[str, str]]:
    left, top = seen.outline.corners.min(axis=0)
    right, bottom = seen.outline.corners.max(axis=0)
    if left < -1.0 or top < -1.0 or right > seen.sheet[0] + 1 or bottom > seen.sheet[1] + 1:
        yield "cut-off", "the card goes over the edge of the picture"
    if not seen.filled > FLAT:
        yield (
            "not-flat",
            f"the card fills {100.0 * seen.filled:.0f} % of the rectangle around it: bent, or a "
            "photograph at a slant; sizes are as doubtful as the scale",
        )
    short, long = (side * 25.4 / seen.dpi for side in (seen.outline.short, seen.outline.long))
    if not any(_near(short, a) and _near(long, b) for a, b in FORMATS_MM):
        yield (
            "card-size",
            f"{short:.1f} x {long:.1f} mm is not a usual card (26 x 76, 52 x 76):"
            " cut, or another dpi",
        )


def _near(side_mm: float, format_mm: float) -> bool:
    return abs(side_mm - format_mm) <= SIDE_TOLERANCE * format_mm


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
