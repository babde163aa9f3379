"""Command line of water-sensitive paper: scans in, figures, table and pictures out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from analysis.report.folder import check_folder
from analysis.wsp.card import (
    CARD_WIDTH_MM,
    INSET_MM,
    Card,
    Method,
    Reading,
    SheetResult,
    read_sheet,
)
from analysis.wsp.figure import draw_distributions
from analysis.wsp.flight_ties import Position, placed, read_positions
from analysis.wsp.image import LEAST_DPI, MOST_DPI, ImageError, Sheet, sheets_of
from analysis.wsp.results import (
    Numbered,
    Row,
    card_row,
    csv_text,
    method_row,
    numbered,
    sheet_row,
    summary,
    table_lines,
)
from analysis.wsp.sizes import SPREADS, spread_of
from analysis.wsp.stains import THRESHOLD, Threshold
from companion.atomic_write import write_atomically
from companion.cli.answer import AsJson, answer, note
from companion.errors import ConfigError, JournalError

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.wsp.flight_ties import Ties

FIGURE = "distributions.png"

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.command(epilog="Example: vrspray wsp scan.png --out paper --spread usda")
def measure_cards(
    images: Annotated[list[Path], typer.Argument(help="Scans: PNG, TIFF, JPEG, BMP, WebP.")],
    out: Annotated[Path, typer.Option(help="Folder for wsp.json, wsp.csv and the pictures.")],
    dpi: Annotated[
        float | None, typer.Option(help="Resolution; without it the file's, or the card's width.")
    ] = None,
    whole: Annotated[
        bool, typer.Option("--whole", help="Each image is one card, nothing is looked for.")
    ] = False,
    spread: Annotated[
        str, typer.Option(help=f"Spread factor: {', '.join(SPREADS)}, user:A,B (D = A d^B).")
    ] = "depositscan",
    threshold: Annotated[
        str, typer.Option(help="Grey level of the darkest paper, 1 to 254, or auto.")
    ] = str(THRESHOLD),
    inset_mm: Annotated[
        float | None, typer.Option(help=f"Edge left out; {INSET_MM:g}, with --whole 0.")
    ] = None,
    card_width_mm: Annotated[
        float, typer.Option(help="Short side of the cards, where it has to tell the resolution.")
    ] = CARD_WIDTH_MM,
    positions: Annotated[
        Path | None, typer.Option(help="CSV: card, latitude, longitude[, height, note].")
    ] = None,
    journal: Annotated[
        Path | None, typer.Option(help="Flight that sprayed the cards; needs --positions.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure coverage, deposits and drop sizes on scans of water-sensitive paper.

    Exit 0: measured; 1: no card found, an image could not be read, or the journal was cut, is
    damaged or lacks rows; 2: wrong options or input.
    """
    if journal is not None and positions is None:
        raise ConfigError("--journal: give --positions too, where the cards lay")
    reading = Reading(
        method=Method(
            threshold=_threshold(threshold),
            spread=spread_of(spread),
            inset_mm=_inset_mm(inset_mm, whole=whole),
        ),
        whole=whole,
        dpi=_within("--dpi", dpi, LEAST_DPI, MOST_DPI),
        card_width_mm=_within("--card-width-mm", card_width_mm, 5.0, 200.0) or CARD_WIDTH_MM,
    )
    places = [] if positions is None else read_positions(positions)
    flown = Flown() if journal is None else read_flown(journal)
    check_folder(out)
    sheets, pictures, refused = _read_all(images, reading, out)
    cards = numbered(sheets)
    ties, notes = _ties(cards, places, flown)
    rows = [_joined(each, ties, places, cards) for each in cards]
    result = _result(reading, sheets, pictures, cards, rows) | {
        "boundaries": ties.boundaries if ties else [],
        "notes": notes,
        "warnings": list(flown.warnings),
        "refused": refused,
        "files": [*pictures, "wsp.json", "wsp.csv"],
    }
    if cards:
        _written(out / FIGURE, partial(draw_distributions, cards))
        result["files"].append(FIGURE)
    for name, text in (
        ("wsp.csv", csv_text(rows)),
        ("wsp.json", json.dumps(result, indent=1, allow_nan=False) + "\n"),
    ):
        _written(out / name, partial(_write, text))
    for line in (*notes, *(f"warning: {each}" for each in flown.warnings)):
        note(line)
    lines = [*table_lines(cards, reading.method), *_tie_lines(ties)]
    answer(result, [*lines, "", f"written to {out}: {', '.join(result['files'])}"], as_json=as_json)
    if refused or not cards or flown.warnings:
        raise typer.Exit(1)


def _read_all(
    images: Sequence[Path], reading: Reading, out: Path
) -> tuple[list[SheetResult], list[str], list[Row]]:
    """Return all sheets and the names of their pictures, and the files that were refused."""
    sheets: list[SheetResult] = []
    pictures: list[str] = []
    refused: list[Row] = []
    for path in images:
        try:
            for sheet in sheets_of(path):
                note(f"{sheet.name}: {sheet.pixels.shape[1]} x {sheet.pixels.shape[0]} pixels")
                found = read_sheet(sheet, reading)
                picture = f"sheet-{len(sheets) + 1:02d}-{path.stem}.jpg"
                first = sum(len(each.cards) for each in sheets) + 1
                numbers = list(enumerate(found.cards, start=first))
                _written(out / picture, partial(draw_sheet, sheet, numbers))
                sheets.append(found)
                pictures.append(picture)
                for line in found.notes:
                    note(f"{sheet.name}: {line}")
        except ImageError as error:
            if len(images) == 1:
                raise
            refused.append({"file": str(path), "error": str(error)})
            note(f"error: {error}")
    if not sheets:
        raise ImageError(f"none of the {len(images)} files is an image that can be read")
    return sheets, pictures, refused


def _written(path: Path, draw: Callable[[Path], None]) -> None:
    try:
        # Not before there is something to write: what is refused leaves no folder.
        path.parent.mkdir(parents=True, exist_ok=True)
        draw(path)
    except OSError as error:
        raise ConfigError(f"--out: {path} cannot be written ({error.strerror or error})") from error


def _ties(
    cards: Sequence[Numbered], places: Sequence[Position], flown: Flown
) -> tuple[Ties | None, list[str]]:
    if not places:
        return None, []
    by_number, notes = placed(cards, places)
    flight = flown.flight
    if flight is None:
        return None, notes
    from analysis.wsp.flight_ties import tie  # what knows of flights is read for them alone

    if flight.training not in (None, "no"):
        notes.append(f"{flight.path.name}: training: {flight.training}")
    return tie(flight, cards, by_number), notes


def _tie_lines(ties: Ties | None) -> list[str]:
    if ties is None:
        return []
    from analysis.wsp.flight_ties import tie_lines

    return list(tie_lines(ties))


def _joined(
    each: Numbered, ties: Ties | None, places: Sequence[Position], cards: Sequence[Numbered]
) -> Row:
    """Return a card's row with its place and what the flight says of it."""
    row = card_row(each)
    place = placed(cards, places)[0].get(each.number)
    if place is not None:
        row["position"] = {
            "latitude_deg": place.latitude_deg,
            "longitude_deg": place.longitude_deg,
            "height_m": place.height_m,
            "note": place.note,
        }
    if ties is not None and each.number in ties.rows:
        row["flight"] = ties.rows[each.number]
    return row


def _result(
    reading: Reading,
    sheets: Sequence[SheetResult],
    pictures: Sequence[str],
    cards: Sequence[Numbered],
    rows: Sequence[Row],
) -> Row:
    return {
        "method": method_row(reading.method),
        "sheets": [
            sheet_row(sheet, cards, picture)
            for sheet, picture in zip(sheets, pictures, strict=True)
        ],
        "summary": summary(cards),
        "cards": list(rows),
    }


def _threshold(text: str) -> Threshold:
    if text == "auto":
        return "auto"
    if not (text.isascii() and text.isdigit() and 1 <= int(text) <= 254):
        raise ConfigError(f"--threshold {text[:40]}: give 1 to 254, or auto")
    return int(text)


def _inset_mm(given: float | None, *, whole: bool) -> float:
    if given is None:
        return 0.0 if whole else INSET_MM
    if not 0.0 <= given <= 10.0:
        raise ConfigError(f"--inset-mm {given:g}: give 0 to 10 mm")
    return given


def _within(name: str, value: float | None, low: float, high: float) -> float | None:
    if value is not None and not low <= value <= high:
        raise ConfigError(f"{name} {value:g}: give {low:g} to {high:g}")
    return value


def _write(text: str, path: Path) -> None:
    write_atomically(path, text.encode())


# What the program's own command line takes in: one command of the kind that Typer makes.
wsp = typer.main.get_command(app)


# The journal behind the cards: read before the scans are, and as far as it can be read.


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """A flight, None without one, and what of its journal is missing."""

    flight: AppliedFlight | None = None
    warnings: tuple[str, ...] = ()


def read_flown(journal: Path) -> Flown:
    """Return the flight of a journal; one that is damaged is a warning, a missing file an error.

    Cards are measured whatever became of the journal: scans do not depend on it.
    """
    from analysis.flown.read_applied import read_applied

    if not journal.is_file():
        raise ConfigError(f"--journal {journal}: there is no such file")
    unread: list[str] = []
    try:
        flight = read_applied(journal, unread=unread)
    except JournalError as error:
        return Flown(warnings=(str(error),))
    found = []
    if not flight.is_closed:
        found.append("the flight was cut off: its last second may be missing")
    if flight.lost:
        found.append(f"{flight.lost} rows are missing in the journal")
    if not len(flight.time_s):
        found.append("the flight never had a position: no card can be tied to it")
        return Flown(warnings=(*found, *unread))
    return Flown(flight=flight, warnings=(*found, *(f"not read: {each}" for each in unread)))


# The picture of a sheet: cards outlined and numbered, counted stains tinted.

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
