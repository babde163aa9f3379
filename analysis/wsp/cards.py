"""Finds the cards on a sheet by their colour, and puts them in the order in which one reads.

Yellow paper and blue stains are told from everything else on a small copy of the picture; what is
left is closed, filled and must be nearly a rectangle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from analysis.wsp.image import Sheet
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
# A flat card on a scanner fills this much; what fills less is measured in its own form.
FLAT = 0.96
# Smaller than this share of the sheet is no card: on A4 the usual one has 3.2 %, half of it 1.6 %.
_LEAST_SHARE = 0.004


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """A card on a sheet: the rectangle around it, and its own form on the small copy.

    `form` begins at column `left` and row `top` of the copy, which has one pixel for `factor`.
    A card that is bent or photographed at a slant fills less of its rectangle. None: all of it.
    """

    outline: Rectangle
    form: Mask | None = field(default=None, repr=False)
    left: int = 0
    top: int = 0
    factor: int = 1

    @property
    def filled(self) -> float:
        """Return how much of the rectangle is card."""
        if self.form is None:
            return 1.0
        area = self.outline.long * self.outline.short
        return float(np.count_nonzero(self.form)) * self.factor**2 / area

    def mask(self, box: tuple[int, int, int, int], *, margin: float) -> Mask:
        """Return which pixels of a box are card, less `margin` pixels along its edge."""
        inside = (self.outline.inset(margin) if margin else self.outline).mask(box)
        if self.form is None or self.filled > FLAT:
            return inside
        steps = max(1, round(margin / self.factor))
        form = ndimage.binary_erosion(np.pad(self.form, 1), iterations=steps)
        x = np.arange(box[0], box[2]) // self.factor - self.left + 1
        y = np.arange(box[1], box[3]) // self.factor - self.top + 1
        is_known = np.outer((y >= 0) & (y < form.shape[0]), (x >= 0) & (x < form.shape[1]))
        x, y = np.clip(x, 0, form.shape[1] - 1), np.clip(y, 0, form.shape[0] - 1)
        return np.asarray(inside & is_known & form[np.ix_(y, x)])


def find_cards(sheet: Sheet) -> tuple[list[Found], int]:
    """Return the cards of a sheet in reading order, and how many large things were none.

    Rows from the top, each from the left. What has the colours and size of a card but is no
    rectangle may be several cards that touch.
    """
    factor = max(1, max(sheet.pixels.shape[:2]) // _SMALL_SIDE)
    small = np.asarray(sheet.reduced(factor)).astype(np.int16)
    found, others = _cards(card_colours(small), factor)
    return reading_order(found), others


def card_colours(pixels: NDArray[np.int16]) -> Mask:
    """Return which pixels are yellow or blue."""
    red, green, blue = pixels[:, :, 0], pixels[:, :, 1], pixels[:, :, 2]
    yellow = (red > blue + YELLOW_ABOVE_BLUE) & (green > blue + YELLOW_ABOVE_BLUE)
    stain = (blue > red + BLUE_ABOVE_OTHERS) & (blue > green + BLUE_ABOVE_OTHERS)
    return np.asarray(yellow | stain)


def _cards(coloured: Mask, factor: int) -> tuple[list[Found], int]:
    # Closing must not eat at the sheet's edge, where a card may lie: a margin for it.
    framed = np.pad(coloured, _CLOSE + 1)
    closed = ndimage.binary_closing(framed, iterations=_CLOSE)
    filled = ndimage.binary_fill_holes(closed)
    opened = ndimage.binary_opening(filled, structure=np.ones((3, 3)), iterations=_OPEN)
    labels, count = ndimage.label(opened)
    found: list[Found] = []
    others = 0
    if not count:
        return found, others
    least_px = _LEAST_SHARE * coloured.size
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        part = labels[box] == label
        area = int(part.sum())
        if area < least_px:
            continue
        left, top = box[1].start - _CLOSE - 1, box[0].start - _CLOSE - 1
        around_it = _rectangle(part, left=left, top=top)
        if around_it is None:  # no area: excluded by `least_px`, but for the types
            continue
        outline = around_it.scaled(float(factor))
        card = Found(outline=outline, form=part, left=left, top=top, factor=factor)
        if card.filled >= _LEAST_FILL:
            found.append(card)
        else:
            others += 1
    return found, others


def _rectangle(part: Mask, *, left: int, top: int) -> Rectangle | None:
    """Return the rectangle around the outer pixels of one object, edges of pixels included."""
    edge = part & ~ndimage.binary_erosion(part)
    y, x = np.nonzero(edge)
    x_px, y_px = x.astype(np.float64) + left, y.astype(np.float64) + top
    return around(
        np.concatenate([x_px, x_px + 1.0, x_px, x_px + 1.0]),
        np.concatenate([y_px, y_px, y_px + 1.0, y_px + 1.0]),
    )


def reading_order(cards: Sequence[Found]) -> list[Found]:
    """Return the cards row by row: a card whose middle lies beside another's belongs to its row.

    >>> def card(x, y):
    ...     outline = Rectangle(x=x, y=y, long=70.0, short=20.0, angle_deg=90.0)
    ...     return Found(outline=outline)
    >>> cards = [card(60.0, 44.0), card(30.0, 150.0), card(20.0, 50.0)]
    >>> [each.outline.x for each in reading_order(cards)]
    [20.0, 60.0, 30.0]
    """
    rows: list[list[Found]] = []
    for card in sorted(cards, key=lambda each: each.outline.y):
        half = float(np.ptp(card.outline.corners[:, 1])) / 2.0
        if rows and card.outline.y - rows[-1][0].outline.y < half:
            rows[-1].append(card)
        else:
            rows.append([card])
    return [card for row in rows for card in sorted(row, key=lambda each: each.outline.x)]
