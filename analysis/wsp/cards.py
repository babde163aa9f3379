"""Finds the cards on a sheet by their colour, and puts them in the order in which one reads.

Yellow paper and blue stains are told from everything else on a small copy of the picture; what is
left is closed, filled and must be nearly a rectangle.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from analysis.wsp.rectangle import Rectangle, around

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# Yellow is red and green above blue, blue is blue above both: by so many levels of 255.
YELLOW_ABOVE_BLUE = 50
BLUE_ABOVE_OTHERS = 15
# Sides of the small copy: about 75 dpi for A4, where a card is 77 x 224 pixels.
_SMALL_SIDE = 1000
# Stains grey out where they are mixed with paper in the small copy: such gaps are closed.
_CLOSE = 2
# Threads and shadows thinner than this are taken off.
_OPEN = 2
# A card fills its rectangle but for cut corners; a yellow leaf does not.
_LEAST_FILL = 0.8
# Smaller than this share of the sheet is no card: on A4 the usual one has 3.2 %, half of it 1.6 %.
_LEAST_SHARE = 0.004


def find_cards(pixels: Bytes) -> list[Rectangle]:
    """Return the cards of a sheet, in reading order: rows from the top, each from the left."""
    height, width = pixels.shape[:2]
    factor = max(1, max(height, width) // _SMALL_SIDE)
    small = np.asarray(Image.fromarray(pixels).reduce(factor)).astype(np.int16)
    found = [card.scaled(float(factor)) for card in _rectangles(card_colours(small))]
    return reading_order(found)


def card_colours(pixels: NDArray[np.int16]) -> Mask:
    """Return which pixels are yellow or blue."""
    red, green, blue = pixels[:, :, 0], pixels[:, :, 1], pixels[:, :, 2]
    yellow = (red > blue + YELLOW_ABOVE_BLUE) & (green > blue + YELLOW_ABOVE_BLUE)
    stain = (blue > red + BLUE_ABOVE_OTHERS) & (blue > green + BLUE_ABOVE_OTHERS)
    return np.asarray(yellow | stain)


def _rectangles(coloured: Mask) -> list[Rectangle]:
    # Closing must not eat at the sheet's edge, where a card may lie: a margin for it.
    framed = np.pad(coloured, _CLOSE + 1)
    closed = ndimage.binary_closing(framed, iterations=_CLOSE)
    filled = ndimage.binary_fill_holes(closed)
    opened = ndimage.binary_opening(filled, structure=np.ones((3, 3)), iterations=_OPEN)
    labels, count = ndimage.label(opened)
    if not count:
        return []
    found = []
    least_px = _LEAST_SHARE * coloured.size
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        part = labels[box] == label
        area = int(part.sum())
        if area < least_px:
            continue
        card = _rectangle(part, left=box[1].start - _CLOSE - 1, top=box[0].start - _CLOSE - 1)
        if card is not None and area >= _LEAST_FILL * card.long * card.short:
            found.append(card)
    return found


def _rectangle(part: Mask, *, left: int, top: int) -> Rectangle | None:
    """Return the rectangle around the outer pixels of one object, edges of pixels included."""
    edge = part & ~ndimage.binary_erosion(part)
    y, x = np.nonzero(edge)
    x_px, y_px = x.astype(np.float64) + left, y.astype(np.float64) + top
    return around(
        np.concatenate([x_px, x_px + 1.0, x_px, x_px + 1.0]),
        np.concatenate([y_px, y_px, y_px + 1.0, y_px + 1.0]),
    )


def reading_order(cards: Sequence[Rectangle]) -> list[Rectangle]:
    """Return the cards row by row: a card whose middle lies beside another's belongs to its row.

    >>> def card(x, y):
    ...     return Rectangle(x=x, y=y, long=70.0, short=20.0, angle_deg=90.0)
    >>> cards = [card(60.0, 44.0), card(30.0, 150.0), card(20.0, 50.0)]
    >>> [each.x for each in reading_order(cards)]
    [20.0, 60.0, 30.0]
    """
    rows: list[list[Rectangle]] = []
    for card in sorted(cards, key=lambda each: each.y):
        half = float(np.ptp(card.corners[:, 1])) / 2.0
        if rows and card.y - rows[-1][0].y < half:
            rows[-1].append(card)
        else:
            rows.append([card])
    return [card for row in rows for card in sorted(row, key=lambda each: each.x)]
