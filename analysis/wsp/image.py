"""Reads scans into RGB bytes and their resolution, within bounds, and finds the cards on them.

Whatever the file holds (grey, palette, 16 bits, CMYK, an alpha channel, several pages), what comes
out is height x width x 3 bytes a page, with a note of what was changed on the way.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from scipy import ndimage

from companion.errors import VrsprayError

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """A rectangle in pixels of a sheet, x to the right and y down; `long` lies at `angle_deg`.

    `angle_deg` is that of the long side against the picture's right, clockwise, -90 to 90.
    """

    x: float
    y: float
    long: float
    short: float
    angle_deg: float

    @property
    def corners(self) -> Floats:
        """Return the four corners, (4, 2), in order around the rectangle."""
        along, across = self._axes()
        a, b = along * self.long / 2.0, across * self.short / 2.0
        middle = np.array([self.x, self.y])
        return np.asarray(middle + np.array([-a - b, a - b, a + b, -a + b]))

    def _axes(self) -> tuple[Floats, Floats]:
        angle = np.deg2rad(self.angle_deg)
        along = np.array([np.cos(angle), np.sin(angle)])
        return along, np.array([-along[1], along[0]])

    def scaled(self, factor: float) -> Rectangle:
        """Return the same rectangle on a sheet with `factor` times the pixels."""
        return Rectangle(
            x=self.x * factor,
            y=self.y * factor,
            long=self.long * factor,
            short=self.short * factor,
            angle_deg=self.angle_deg,
        )

    def inset(self, margin: float) -> Rectangle:
        """Return the rectangle less `margin` on each side; ValueError where nothing is left."""
        if not self.short > 2.0 * margin:
            raise ValueError(f"a margin of {margin} leaves nothing of {self.short}")
        return Rectangle(
            x=self.x,
            y=self.y,
            long=self.long - 2.0 * margin,
            short=self.short - 2.0 * margin,
            angle_deg=self.angle_deg,
        )

    def box(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom [px] of what lies on a sheet of this size."""
        low, high = np.floor(self.corners.min(axis=0)), np.ceil(self.corners.max(axis=0))
        left, top = max(int(low[0]), 0), max(int(low[1]), 0)
        return left, top, min(int(high[0]), width), min(int(high[1]), height)

    def mask(self, box: tuple[int, int, int, int]) -> Mask:
        """Return which pixels of a box have their centres inside."""
        left, top, right, bottom = box
        # Single precision: 1e-3 of a pixel on a sheet of 14 000, at half the time.
        dx = (np.arange(left, right) + 0.5 - self.x).astype(np.float32)
        dy = (np.arange(top, bottom) + 0.5 - self.y).astype(np.float32)[:, None]
        along, across = (axis.astype(np.float32) for axis in self._axes())
        inside = np.abs(dx * along[0] + dy * along[1]) <= self.long / 2.0
        inside &= np.abs(dx * across[0] + dy * across[1]) <= self.short / 2.0
        return np.asarray(inside)


def around(x: Floats, y: Floats) -> Rectangle | None:
    """Return the smallest rectangle around points; None where they lie in a line.

    One of its sides lies along a side of the convex hull, so those are tried.
    """
    hull = _hull(x, y)
    if len(hull) < 3:
        return None
    sides = np.roll(hull, -1, axis=0) - hull
    angles = np.arctan2(sides[:, 1], sides[:, 0])
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    u, v = hull[:, 0] * cos + hull[:, 1] * sin, hull[:, 1] * cos - hull[:, 0] * sin
    width, height = np.ptp(u, axis=1), np.ptp(v, axis=1)
    best = int(np.argmin(width * height))
    middle_u = (u[best].max() + u[best].min()) / 2.0
    middle_v = (v[best].max() + v[best].min()) / 2.0
    c, s = float(cos[best, 0]), float(sin[best, 0])
    is_long = width[best] >= height[best]
    angle_deg = float(np.rad2deg(angles[best])) + (0.0 if is_long else 90.0)
    return Rectangle(
        x=float(middle_u * c - middle_v * s),
        y=float(middle_u * s + middle_v * c),
        long=float(max(width[best], height[best])),
        short=float(min(width[best], height[best])),
        angle_deg=(angle_deg + 90.0) % 180.0 - 90.0,
    )


def _hull(x: Floats, y: Floats) -> Floats:
    """Return the corners of the convex hull in order, (n, 2); fewer than three of a line."""
    order = np.lexsort((x, y))
    x, y = x[order], y[order]
    # Only the first and the last point of a row can be corners.
    is_first = np.diff(y, prepend=np.nan) != 0.0
    is_end = is_first | np.roll(is_first, -1)
    points = list(zip(x[is_end].tolist(), y[is_end].tolist(), strict=True))
    return np.array(_chain(points)[:-1] + _chain(points[::-1])[:-1]).reshape(-1, 2)


def _chain(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the hull on one side of points in order (Andrew's monotone chain)."""
    chain: list[tuple[float, float]] = []
    for point in points:
        while len(chain) > 1 and _bend(chain[-2], chain[-1], point) <= 0.0:
            chain.pop()
        if not chain or point != chain[-1]:
            chain.append(point)
    return chain


def _bend(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


# Finds the cards on a sheet by their colour, and puts them in the order in which one reads.
#
# Yellow paper and blue stains are told from everything else on a small copy of the picture; what is
# left is closed, filled and must be nearly a rectangle.


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


Bytes = NDArray[np.uint8]

FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP")
# A4 at 1200 dpi has 139 million pixels, A3 at 600 dpi 70: both are read, at 3 bytes a pixel. A3 at
# 1200 dpi (278 million, 0.8 GB) is not: drops of 50 um do not need it, 600 dpi is the method's own.
MAX_PIXELS = 150_000_000
MAX_PAGES = 50
# What programs write when they do not know; no scan for this purpose is made so coarse.
LEAST_DPI = 100.0
MOST_DPI = 9600.0
# 16 bits a channel to 8: the high byte.
_HIGH_BYTE = 256
# Where EXIF says how a picture is turned; 1 is upright.
_ORIENTATION = 0x0112


class ImageError(VrsprayError):
    """A file is no image that can be used."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """One page of one file; `dpi` is what the file says, None where it does not.

    `image` is the same picture as the file was unpacked to, where that is RGB and of one page.
    """

    path: Path
    page: int
    pixels: Bytes
    dpi: float | None
    notes: tuple[str, ...] = ()
    image: Image.Image | None = field(default=None, repr=False)

    @property
    def name(self) -> str:
        """Return what the sheet is called: the file, and the page after the first."""
        return self.path.name if self.page == 1 else f"{self.path.name} page {self.page}"

    def reduced(self, factor: int) -> Image.Image:
        """Return the picture with the mean of so many pixels each way for one."""
        image = Image.fromarray(self.pixels) if self.image is None else self.image
        return image.reduce(factor)


def sheets_of(path: Path) -> Iterator[Sheet]:
    """Yield the pages of a file; ImageError, in one line, where it cannot be read."""
    if not path.is_file():
        raise ImageError(f"{path}: there is no such file; give a scan (PNG, TIFF, JPEG)")
    try:
        with warnings.catch_warnings():
            # Pillow's own limits: sizes are checked below, before a pixel is unpacked, and what it
            # thinks of odd metadata is no news for the user.
            warnings.simplefilter("ignore")
            with Image.open(path, formats=FORMATS) as image:
                yield from _pages(path, image)
    except UnidentifiedImageError as error:
        raise ImageError(
            f"{path}: is not an image that can be read; give PNG, TIFF, JPEG, BMP or WebP"
        ) from error
    except Image.DecompressionBombError as error:
        raise _too_large(path, "more than 178 million") from error
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise ImageError(f"{path}: cannot be read to its end ({error}); scan it again") from error


def _pages(path: Path, image: Image.Image) -> Iterator[Sheet]:
    # The further pictures of a phone's JPEG (MPO) are previews of the first.
    pages = getattr(image, "n_frames", 1) if image.format == "TIFF" else 1
    if pages > MAX_PAGES:
        raise ImageError(f"{path}: has {pages} pages; give at most {MAX_PAGES} in one file")
    for page in range(pages):
        image.seek(page)
        if image.width * image.height > MAX_PIXELS:
            raise _too_large(path, f"{image.width} x {image.height}")
        dpi, doubt = dpi_of(image.info)
        image.load()  # a PNG may say last how it is turned
        # A picture that lies upright is not copied.
        is_turned = image.getexif().get(_ORIENTATION, 1) != 1
        upright = ImageOps.exif_transpose(image) if is_turned else image
        pixels, changed = to_rgb(upright)
        notes = tuple(note for note in (doubt, changed) if note)
        kept = upright if upright.mode == "RGB" and pages == 1 else None
        yield Sheet(path=path, page=page + 1, pixels=pixels, dpi=dpi, notes=notes, image=kept)


def _too_large(path: Path, size: str) -> ImageError:
    return ImageError(
        f"{path}: {size} pixels are too many ({MAX_PIXELS // 1_000_000} million at most, A4 at "
        "1200 dpi); scan at 600 dpi"
    )


def dpi_of(info: dict[Any, Any]) -> tuple[float | None, str]:
    """Return the resolution that a file states, if it is one to believe, and why not if not.

    >>> dpi_of({"dpi": (600.0, 600.0)})
    (600.0, '')
    >>> dpi_of({"dpi": (72, 72)})
    (None, 'the file says 72 dpi, which is not a resolution of a scan: not used')
    """
    stated = info.get("dpi")
    if stated is None:
        return None, ""
    try:
        across, down = float(stated[0]), float(stated[1])
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None, "the file's resolution cannot be read: not used"
    if not abs(across - down) <= 0.01 * abs(across):
        return None, f"the file says {across:g} x {down:g} dpi, which differ: not used"
    if not LEAST_DPI <= across <= MOST_DPI:
        return None, f"the file says {across:g} dpi, which is not a resolution of a scan: not used"
    # PNG keeps whole pixels a metre: 600 dpi comes back as 599.9988.
    whole = round(across)
    return float(whole) if abs(across - whole) < 0.02 else across, ""


def to_rgb(image: Image.Image) -> tuple[Bytes, str]:
    """Return the pixels as RGB bytes, and what had to be changed."""
    if image.mode == "RGB":
        return np.asarray(image), ""
    if image.mode.startswith("I") or image.mode == "F":
        return _deep_grey(image), f"{image.mode}: grey of more than 8 bits, made 8"
    if image.has_transparency_data:
        solid = image.convert("RGBA")
        white = Image.new("RGBA", solid.size, (255, 255, 255, 255))
        return np.asarray(Image.alpha_composite(white, solid).convert("RGB")), (
            "transparent pixels were made white"
        )
    note = "CMYK was converted without its colour profile" if image.mode == "CMYK" else ""
    return np.asarray(image.convert("RGB")), note


def _deep_grey(image: Image.Image) -> Bytes:
    values = np.asarray(image).astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError("pixels are not finite")
    # 32-bit modes hold 16-bit greys in practice; a float image from 0 to 1 or to 255.
    top = float(values.max(initial=0.0))
    if top > 255.0:
        values /= _HIGH_BYTE
    elif image.mode == "F" and top <= 1.0:
        values *= 255.0
    grey = np.clip(values, 0.0, 255.0).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)
