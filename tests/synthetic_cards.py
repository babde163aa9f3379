"""Cards whose truth is known: drops of stated sizes at random places, drawn as a scanner sees them.

For tests, and for whoever wants to know what the figures of real cards are worth. Drops follow a
log-normal law and fall independently; their stains are ellipses of the area that DepositScan's
spread factor gives, drawn at four times the resolution, clipped at the card's edge. Over them:
the paper's texture, the scanner's blur and noise, and what JPEG makes of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.image import Rectangle
from analysis.wsp.stains import LEAST_DROP_UM

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]

CARD_MM = (76.0, 26.0)
A4_MM = (210.0, 297.0)
_FINER = 4
# DepositScan's D = 0.95 d^0.91 turned round.
_FACTOR, _EXPONENT = 0.95, 0.91


@dataclass(frozen=True, slots=True, kw_only=True)
class Spray:
    """What fell on a card: drops a square centimetre, and their log-normal sizes.

    `nmd_um` is the median diameter of their number; that of their volume is larger by
    exp(3 ln(sigma)^2).
    """

    drops_per_cm2: float
    nmd_um: float
    sigma: float = 1.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Scanner:
    """How the sheet looks in the file; colours are RGB."""

    dpi: float = 600.0
    paper: tuple[float, float, float] = (226.0, 210.0, 92.0)
    stain: tuple[float, float, float] = (40.0, 58.0, 142.0)
    ground: tuple[float, float, float] = (244.0, 244.0, 242.0)
    texture: float = 3.0
    noise: float = 2.0
    blur_px: float = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueCard:
    """What is true of one card; places in pixels of the sheet."""

    outline: Rectangle
    x: Floats = field(repr=False)
    y: Floats = field(repr=False)
    drop_um: Floats = field(repr=False)

    def inside(self, region: Rectangle) -> NDArray[np.bool_]:
        """Return which drops have their middles in a region."""
        angle = math.radians(region.angle_deg)
        dx, dy = self.x - region.x, self.y - region.y
        along = dx * math.cos(angle) + dy * math.sin(angle)
        across = dy * math.cos(angle) - dx * math.sin(angle)
        return (np.abs(along) <= region.long / 2.0) & (np.abs(across) <= region.short / 2.0)

    def count(self, region: Rectangle, *, above_um: float = LEAST_DROP_UM) -> int:
        """Return how many drops of more than `above_um` fell into a region of the card."""
        return int(np.count_nonzero(self.inside(region) & (self.drop_um > above_um)))


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueSheet:
    """A drawn sheet, and how much of each pixel is stained: 0 to 255, overlaps once."""

    pixels: Bytes = field(repr=False)
    stained: Bytes = field(repr=False)
    cards: tuple[TrueCard, ...]

    def coverage_percent(self, region: Rectangle) -> float:
        """Return how much of a region is under stains."""
        box = region.box(self.stained.shape[1], self.stained.shape[0])
        left, top, right, bottom = box
        return float(self.stained[top:bottom, left:right][region.mask(box)].mean()) / 2.55


def stain_of_um(drop_um: Floats) -> Floats:
    """Return the diameter of the stain of a drop.

    >>> float(stain_of_um(np.array([170.61]))[0].round(0))
    300.0
    """
    return np.asarray((drop_um / _FACTOR) ** (1.0 / _EXPONENT))


def draw_sheet(
    sprays: Sequence[Spray],
    places: Sequence[Rectangle],
    *,
    size: tuple[int, int],
    seed: int,
    scanner: Scanner | None = None,
) -> TrueSheet:
    """Return a sheet of `size` (width, height) with a card of each spray at each place."""
    scanner = Scanner() if scanner is None else scanner
    rng = np.random.default_rng(seed)
    width, height = size
    stained = np.zeros((height, width), dtype=np.uint8)
    pixels = np.empty((height, width, 3), dtype=np.uint8)
    pixels[:] = np.round(scanner.ground).astype(np.uint8)
    cards = []
    for spray, place in zip(sprays, places, strict=True):
        card = _fall(spray, place, scanner.dpi, rng)
        box = place.box(width, height)
        paper, stain = _coverages(card, box, scanner.dpi, rng)
        left, top, right, bottom = box
        stained[top:bottom, left:right] += np.round(255.0 * stain).astype(np.uint8)
        pixels[top:bottom, left:right] = _seen(paper, stain, scanner, rng)
        cards.append(card)
    return TrueSheet(pixels=pixels, stained=stained, cards=tuple(cards))


def draw_card(spray: Spray, *, seed: int, scanner: Scanner | None = None) -> TrueSheet:
    """Return one card that fills its picture."""
    scanner = Scanner() if scanner is None else scanner
    width, height = (round(side * scanner.dpi / 25.4) for side in CARD_MM)
    place = Rectangle(x=width / 2, y=height / 2, long=width, short=height, angle_deg=0.0)
    return draw_sheet([spray], [place], size=(width, height), seed=seed, scanner=scanner)


def a4_places(
    count: int, *, dpi: float = 600.0, seed: int = 0, tilt_deg: float = 4.0
) -> tuple[tuple[int, int], list[Rectangle]]:
    """Return the size of A4 in pixels and places for up to 14 cards, each tilted a little."""
    rng = np.random.default_rng(seed)
    px = dpi / 25.4
    spots = [
        (30.0 + 36.0 * column, 55.0 + 92.0 * row, 90.0) for row in range(2) for column in range(5)
    ] + [(55.0 + 92.0 * column, 225.0 + 40.0 * row, 0.0) for row in range(2) for column in range(2)]
    places = [
        Rectangle(
            x=x_mm * px,
            y=y_mm * px,
            long=CARD_MM[0] * px,
            short=CARD_MM[1] * px,
            angle_deg=angle_deg + float(rng.uniform(-tilt_deg, tilt_deg)),
        )
        for x_mm, y_mm, angle_deg in spots[:count]
    ]
    return (round(A4_MM[0] * px), round(A4_MM[1] * px)), places


def save(sheet: TrueSheet, path: Path, *, dpi: float | None = 600.0, quality: int = 92) -> None:
    """Write the picture; the ending of the name says as what."""
    from PIL import Image

    options: dict[str, Any] = {} if dpi is None else {"dpi": (dpi, dpi)}
    if path.suffix.lower() in (".jpg", ".jpeg"):
        options["quality"] = quality
    Image.fromarray(sheet.pixels).save(path, **options)


def _fall(spray: Spray, place: Rectangle, dpi: float, rng: np.random.Generator) -> TrueCard:
    area_cm2 = place.long * place.short * (2.54 / dpi) ** 2
    count = int(rng.poisson(spray.drops_per_cm2 * area_cm2))
    along = rng.uniform(-0.5, 0.5, count) * place.long
    across = rng.uniform(-0.5, 0.5, count) * place.short
    angle = math.radians(place.angle_deg)
    drop_um = np.exp(rng.normal(math.log(spray.nmd_um), math.log(spray.sigma), count))
    return TrueCard(
        outline=place,
        x=place.x + along * math.cos(angle) - across * math.sin(angle),
        y=place.y + along * math.sin(angle) + across * math.cos(angle),
        drop_um=drop_um,
    )


def _coverages(
    card: TrueCard, box: tuple[int, int, int, int], dpi: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return how much of each pixel of a box is card, and how much is stain."""
    left, top, right, bottom = box
    shape = ((bottom - top) * _FINER, (right - left) * _FINER)
    fine = np.zeros(shape, dtype=np.bool_)
    radius = stain_of_um(card.drop_um) / 2.0 * dpi / 25_400.0 * _FINER
    stretch = np.exp(np.abs(rng.normal(0.0, 0.08, len(radius))))
    turn = rng.uniform(0.0, math.pi, len(radius))
    x, y = (card.x - left) * _FINER, (card.y - top) * _FINER
    for each in zip(x, y, radius, stretch, turn, strict=True):
        _ellipse(fine, *each)
    on_card = card.outline.scaled(float(_FINER))
    shifted = Rectangle(
        x=on_card.x - left * _FINER,
        y=on_card.y - top * _FINER,
        long=on_card.long,
        short=on_card.short,
        angle_deg=on_card.angle_deg,
    )
    paper = shifted.mask((0, 0, shape[1], shape[0]))
    fine &= paper
    return _coarse(paper), _coarse(fine)


def _ellipse(fine: NDArray[np.bool_], *shape: float) -> None:
    """Stain an ellipse of the area of a disc of this radius, `stretch` times as long as round."""
    x, y, radius, stretch, turn = shape
    reach = radius * stretch + 1.0
    left, right = max(int(x - reach), 0), min(int(x + reach) + 1, fine.shape[1])
    top, bottom = max(int(y - reach), 0), min(int(y + reach) + 1, fine.shape[0])
    dx = np.arange(left, right) + 0.5 - x
    dy = (np.arange(top, bottom) + 0.5 - y)[:, None]
    along = (dx * math.cos(turn) + dy * math.sin(turn)) / stretch
    across = (dy * math.cos(turn) - dx * math.sin(turn)) * stretch
    fine[top:bottom, left:right] |= along**2 + across**2 <= radius**2


def _coarse(fine: NDArray[np.bool_]) -> Floats:
    height, width = fine.shape[0] // _FINER, fine.shape[1] // _FINER
    return np.asarray(
        fine.reshape(height, _FINER, width, _FINER).sum(axis=(1, 3), dtype=np.uint8)
        / np.float64(_FINER**2)
    )


def _seen(paper: Floats, stain: Floats, scanner: Scanner, rng: np.random.Generator) -> Bytes:
    # The paper's texture is coarser than a pixel, and the same in all colours.
    grain = ndimage.gaussian_filter(rng.normal(size=paper.shape), 1.5)
    grain *= scanner.texture / max(float(grain.std()), 1e-9)
    seen = np.empty((*paper.shape, 3), dtype=np.uint8)
    for channel in range(3):
        colour = scanner.ground[channel] + paper * (
            scanner.paper[channel] + grain - scanner.ground[channel]
        )
        colour += stain * (scanner.stain[channel] - scanner.paper[channel])
        if scanner.blur_px:
            colour = ndimage.gaussian_filter(colour, scanner.blur_px)
        colour += rng.normal(0.0, scanner.noise, paper.shape)
        seen[:, :, channel] = np.clip(np.round(colour), 0.0, 255.0)
    return seen
