"""Reads scans into RGB bytes and their resolution, within bounds; knows nothing of cards.

Whatever the file holds (grey, palette, 16 bits, CMYK, an alpha channel, several pages), what comes
out is height x width x 3 bytes a page, with a note of what was changed on the way.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from companion.errors import VrsprayError

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
            f"{path}: is no image that can be read; give PNG, TIFF, JPEG, BMP or WebP"
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
    (None, 'the file says 72 dpi, which is no resolution of a scan: not used')
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
        return None, f"the file says {across:g} dpi, which is no resolution of a scan: not used"
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
