"""One sheet: which resolution it has, which cards lie on it, and what each of them shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from analysis.wsp.card import Card, Method, measure
from analysis.wsp.cards import Found, find_cards
from analysis.wsp.image import Sheet
from analysis.wsp.quality import SIDE_TOLERANCE
from analysis.wsp.rectangle import Rectangle
from companion.errors import VrsprayError

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
