"""The picture of a sheet: cards outlined and numbered, counted stains tinted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from analysis.wsp.card import Card
from analysis.wsp.image import Sheet

Bytes = NDArray[np.uint8]

# Longest side of a sheet's picture: a stain of 0.2 mm on A4 is still two pixels.
_LONGEST = 3600
_TINT = np.array([228, 26, 28], dtype=np.float32)
_OUTLINE = (0, 90, 255)
_TINT_SHARE = 0.75


def draw_sheet(sheet: Sheet, cards: Sequence[tuple[int, Card]], path: Path) -> None:
    """Write the sheet with what was found on it: outline blue, counted stains red."""
    factor = -(-max(sheet.pixels.shape[:2]) // _LONGEST)
    small = np.array(sheet.reduced(factor))
    for _, card in cards:
        _tint(small, card, factor)
    image = Image.fromarray(small)
    drawing = ImageDraw.Draw(image)
    line = max(2, round(max(small.shape[:2]) / 800))
    font = ImageFont.load_default(size=max(16.0, max(small.shape[:2]) / 60))
    for number, card in cards:
        corners = [(float(x) / factor, float(y) / factor) for x, y in card.outline.corners]
        drawing.line([*corners, corners[0]], fill=_OUTLINE, width=line)
        _label(drawing, f"{number}", corners, font)
    image.save(path, quality=88)


def _label(
    drawing: ImageDraw.ImageDraw,
    text: str,
    corners: Sequence[tuple[float, float]],
    font: ImageFont.ImageFont | ImageFont.FreeTypeFont,
) -> None:
    """Write a card's number on a white ground into its upper left corner."""
    x, y = min(corners, key=lambda corner: corner[0] + corner[1])
    place = (max(x, 0.0) + 6.0, max(y, 0.0) + 6.0)
    left, top, right, bottom = drawing.textbbox(place, text, font=font)
    drawing.rectangle((left - 5, top - 5, right + 5, bottom + 5), fill=(255, 255, 255))
    drawing.text(place, text, fill=_OUTLINE, font=font)


def _tint(small: Bytes, card: Card, factor: int) -> None:
    """Colour the counted stains, mixed by how much of each small pixel they cover."""
    left, top, right, bottom = card.box
    x, y = left // factor, top // factor
    columns, rows = -(-right // factor) - x, -(-bottom // factor) - y
    whole = np.zeros((rows * factor, columns * factor), dtype=np.bool_)
    dx, dy = left - x * factor, top - y * factor
    whole[dy : dy + bottom - top, dx : dx + right - left] = card.stained
    share = np.zeros((rows, columns), dtype=np.uint8)
    for down in range(factor):
        for across in range(factor):
            share += whole[down::factor, across::factor]
    view = small[y : y + rows, x : x + columns]
    stained = np.nonzero(share[: view.shape[0], : view.shape[1]])
    part = share[stained][:, None] * np.float32(_TINT_SHARE / factor**2)
    view[stained] = np.round(view[stained] * (1.0 - part) + _TINT * part).astype(np.uint8)
