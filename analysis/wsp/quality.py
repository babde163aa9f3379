"""What is doubtful about a card: a name and a sentence for each, none of it stops the figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from analysis.wsp.image import FLAT, YELLOW_ABOVE_BLUE
from analysis.wsp.rectangle import Rectangle
from analysis.wsp.stains import UNRELIABLE_PERCENT, Stains

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
            f"{short:.1f} x {long:.1f} mm is no usual card (26 x 76, 52 x 76): cut, or another dpi",
        )


def _near(side_mm: float, format_mm: float) -> bool:
    return abs(side_mm - format_mm) <= SIDE_TOLERANCE * format_mm
