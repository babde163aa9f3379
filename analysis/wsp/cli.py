"""Command line of water-sensitive paper: scans in, figures, table and pictures out."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
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
    FUNGICIDE_PER_CM2,
    INSECTICIDE_PER_CM2,
    INSET_MM,
    OVERSPRAY_PERCENT,
    Card,
    Method,
    Reading,
    SheetResult,
    read_sheet,
)
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
from analysis.wsp.stains import SPREADS, THRESHOLD, Threshold, spread_of
from companion.atomic_write import write_atomically
from companion.cli.answer import AsJson, answer, new_app, note
from companion.errors import ConfigError, JournalError
from companion.wording import CUT, writing

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.wsp.flight_ties import Ties

FIGURE = "distributions.png"

app = new_app()


@app.command(epilog="Example: vrspray wsp scan.png --out paper --spread usda")
def measure_cards(
    images: Annotated[list[Path], typer.Argument(help="Scans: PNG, TIFF, JPEG, BMP, WebP.")],
    out: Annotated[Path, typer.Option(help="Folder for wsp.json, wsp.csv and the pictures.")],
    dpi: Annotated[
        float | None,
        typer.Option(help="Resolution; default: from the file, or from the card's width."),
    ] = None,
    whole: Annotated[
        bool, typer.Option("--whole", help="Each image is one card; do not search for cards.")
    ] = False,
    spread: Annotated[
        str, typer.Option(help=f"Spread factor: {', '.join(SPREADS)}, user:A,B (D = A d^B).")
    ] = "depositscan",
    threshold: Annotated[
        str, typer.Option(help="Grey level of the darkest paper, 1 to 254, or auto.")
    ] = str(THRESHOLD),
    inset_mm: Annotated[
        float | None,
        typer.Option(help=f"Edge to leave out; default: {INSET_MM:g}, with --whole 0."),
    ] = None,
    card_width_mm: Annotated[
        float, typer.Option(help="Short side of the cards, if it sets the resolution.")
    ] = CARD_WIDTH_MM,
    positions: Annotated[
        Path | None, typer.Option(help="CSV: card, latitude, longitude[, height, note].")
    ] = None,
    journal: Annotated[
        Path | None, typer.Option(help="Journal of the flight over the cards; needs --positions.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Measure coverage, deposit and drop size on scans of water-sensitive paper.

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
        raise ImageError(f"none of the {len(images)} files is a readable image")
    return sheets, pictures, refused


def _written(path: Path, draw: Callable[[Path], None]) -> None:
    with writing(f"--out {path}"):
        # Not before there is something to write: what is refused leaves no folder.
        path.parent.mkdir(parents=True, exist_ok=True)
        draw(path)


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
    if flight.simulated.label:
        notes.append(f"{flight.path.name}: {flight.simulated.label}")
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
        found.append(CUT)
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


# The figure of all cards: volume by drop size, and density and coverage against P1's limits.

_WIDTH, _HEIGHT, _TOP, _BOTTOM = 1560, 546, 15.0, 484.0
_BAR, _RED, _GREEN = "#4477aa", "#cc3311", "#228833"
# Cards that the figure names one by one; more make a grey bundle.
_NAMED = (
    *("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd"),
    *("#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf"),
)
# A curve of so many points, even in volume, is as good as one of all drops.
_POINTS = 400


def draw_distributions(cards: Sequence[Numbered], path: Path) -> None:
    """Write the figure."""
    canvas = Canvas(_WIDTH, _HEIGHT)
    _volume(canvas, cards)
    _density(canvas, cards)
    _coverage(canvas, cards)
    canvas.picture().save(path, dpi=(130, 130))


def _volume(canvas: Canvas, cards: Sequence[Numbered]) -> None:
    sized = [each for each in cards if len(each.card.drop_um)]
    largest = max((float(each.card.drop_um.max()) for each in sized), default=500.0)
    axes = Axes(
        canvas=canvas,
        place=(78.0, _TOP, 592.0, _BOTTOM),
        x_range=(0.0, 1.03 * largest),
        y_range=(0.0, 100.0),
    )
    for part in (10.0, 50.0, 90.0):
        axes.level(part, FAINT, dashed=False)
    for k, each in enumerate(sized):
        drop_um = np.sort(each.card.drop_um)
        share = 100.0 * np.cumsum(drop_um**3) / (drop_um**3).sum()
        some = np.unique(np.searchsorted(share, np.linspace(0.0, share[-1], _POINTS)))
        colour = _NAMED[k] if len(sized) <= len(_NAMED) else "#808080"
        axes.curve([(float(drop_um[i]), float(share[i])) for i in some], colour)
        if len(sized) <= len(_NAMED):
            axes.name(f"card {each.number}", colour, style="line")
    axes.finish("drop diameter [um]", "volume in smaller drops [%]")
    axes.legend((495.0, _BOTTOM - 20.0 * len(axes.names)))


def _density(canvas: Canvas, cards: Sequence[Numbered]) -> None:
    counted = [each.card.main.deposits_per_cm2 for each in cards]
    corrected = [each.card.better.drops_per_cm2 for each in cards]
    most = max([FUNGICIDE_PER_CM2, *counted, *(each or 0.0 for each in corrected)])
    axes = _bars(canvas, (675.0, 1070.0), counted, most=1.4 * most)
    for number, each in enumerate(corrected, start=1):
        if each is not None:
            axes.mark(number, each)
    axes.level(INSECTICIDE_PER_CM2, _RED)
    axes.level(FUNGICIDE_PER_CM2, _GREEN)
    axes.name("stains counted", _BAR, style="bar")
    axes.name("corrected for overlap", INK, style="line")
    axes.name(f"insecticide, {INSECTICIDE_PER_CM2:g}", _RED, style="dashes")
    axes.name(f"fungicide, {FUNGICIDE_PER_CM2:g}", _GREEN, style="dashes")
    axes.finish("card", "deposits per cm2", only_whole=True)
    axes.legend((690.0, _TOP + 15.0))


def _coverage(canvas: Canvas, cards: Sequence[Numbered]) -> None:
    coverage = [each.card.main.coverage_percent for each in cards]
    most = max([OVERSPRAY_PERCENT, *coverage])
    axes = _bars(canvas, (1152.0, 1546.0), coverage, most=1.2 * most)
    axes.level(OVERSPRAY_PERCENT, _RED)
    axes.name(f"overspray, {OVERSPRAY_PERCENT:g} %", _RED, style="dashes")
    axes.finish("card", "coverage [%]", only_whole=True)
    axes.legend((1380.0, _TOP + 15.0))


def _bars(
    canvas: Canvas, sides: tuple[float, float], values: Sequence[float], *, most: float
) -> Axes:
    axes = Axes(
        canvas=canvas,
        place=(sides[0], _TOP, sides[1], _BOTTOM),
        x_range=(0.0, len(values) + 1.0),
        y_range=(0.0, most),
    )
    for number, value in enumerate(values, start=1):
        axes.bar(number, value, _BAR)
    return axes


# Plain charts drawn with Pillow alone: a plotting library takes longer to load than cards to read.
#
# Everything is drawn three times as large and then made smaller, so that lines come out smooth.

# A colour of CSS's names or #rrggbb, as Pillow takes it.
INK, FAINT = "black", "#cccccc"
_FINER = 3
_TEXT_PX, _TICK_PX = 15.0, 5.0


class Canvas:
    """A white picture of `width` x `height` pixels."""

    def __init__(self, width: int, height: int) -> None:
        """Begin with white."""
        self._large = Image.new("RGB", (width * _FINER, height * _FINER), "white")
        self._drawing = ImageDraw.Draw(self._large)
        self._font = ImageFont.load_default(size=_TEXT_PX * _FINER)

    def picture(self) -> Image.Image:
        """Return what was drawn."""
        return self._large.reduce(_FINER)

    def line(
        self, points: Sequence[tuple[float, float]], colour: str, *, width: float = 1.0
    ) -> None:
        """Draw a line through points."""
        finer = [(x * _FINER, y * _FINER) for x, y in points]
        self._drawing.line(finer, fill=colour, width=max(1, round(width * _FINER)), joint="curve")

    def dashes(self, start: tuple[float, float], end_x: float, colour: str) -> None:
        """Draw a dashed line to the right."""
        x, y = start
        while x < end_x:
            self.line([(x, y), (min(x + 7.0, end_x), y)], colour, width=2.0)
            x += 11.0

    def box(self, corners: tuple[float, float, float, float], colour: str) -> None:
        """Fill a rectangle: left, top, right, bottom."""
        left, top, right, bottom = (each * _FINER for each in corners)
        self._drawing.rectangle((left, top, max(right, left), max(bottom, top)), fill=colour)

    def text(self, place: tuple[float, float], text: str, *, anchor: str = "mm") -> None:
        """Write a text; `anchor` tells which of its points lies at the place, as Pillow has it."""
        x, y = place
        self._drawing.text((x * _FINER, y * _FINER), text, fill=INK, font=self._font, anchor=anchor)

    def text_upwards(self, place: tuple[float, float], text: str) -> None:
        """Write a text that reads from below, its middle at the place."""
        left, top, right, bottom = self._font.getbbox(text)
        image = Image.new("RGB", (math.ceil(right - left), math.ceil(bottom - top)), "white")
        ImageDraw.Draw(image).text((-left, -top), text, fill=INK, font=self._font)
        turned = image.transpose(Image.Transpose.ROTATE_90)
        x, y = place
        corner = (round(x * _FINER - turned.width / 2), round(y * _FINER - turned.height / 2))
        self._large.paste(turned, corner)


@dataclass(frozen=True, slots=True, kw_only=True)
class Axes:
    """A frame on a canvas, and what its sides stand for; `place` is left, top, right, bottom."""

    canvas: Canvas
    place: tuple[float, float, float, float]
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    names: list[tuple[str, str, str]] = field(default_factory=list)

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return where a pair of values lies on the canvas."""
        left, top, right, bottom = self.place
        along = (x - self.x_range[0]) / (self.x_range[1] - self.x_range[0])
        up = (y - self.y_range[0]) / (self.y_range[1] - self.y_range[0])
        return left + along * (right - left), bottom - up * (bottom - top)

    def curve(self, points: Sequence[tuple[float, float]], colour: str) -> None:
        """Draw a line through pairs of values."""
        self.canvas.line([self.at(x, y) for x, y in points], colour, width=1.5)

    def bar(self, x: float, height: float, colour: str) -> None:
        """Draw a bar of 0.8 of a unit in width."""
        left, top = self.at(x - 0.4, height)
        right, bottom = self.at(x + 0.4, self.y_range[0])
        self.canvas.box((left, top, right, bottom), colour)

    def mark(self, x: float, y: float) -> None:
        """Draw a short line across a bar."""
        self.canvas.line([self.at(x - 0.4, y), self.at(x + 0.4, y)], INK, width=2.0)

    def level(self, y: float, colour: str, *, dashed: bool = True) -> None:
        """Draw a line from side to side."""
        start, end = self.at(self.x_range[0], y), self.at(self.x_range[1], y)
        if dashed:
            self.canvas.dashes(start, end[0], colour)
        else:
            self.canvas.line([start, end], colour)

    def name(self, text: str, colour: str, *, style: str) -> None:
        """Have the legend name something: a "bar", a "line", "dashes"."""
        self.names.append((text, colour, style))

    def finish(self, x_name: str, y_name: str, *, only_whole: bool = False) -> None:
        """Draw the frame, its ticks and names, and the legend."""
        left, top, right, bottom = self.place
        corners = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
        self.canvas.line(corners, INK)
        for value, text in ticks(*self.x_range, least_step=1.0 if only_whole else 0.0):
            x, _ = self.at(value, self.y_range[0])
            self.canvas.line([(x, bottom), (x, bottom + _TICK_PX)], INK)
            self.canvas.text((x, bottom + 16.0), text)
        for value, text in ticks(*self.y_range):
            _, y = self.at(self.x_range[0], value)
            self.canvas.line([(left - _TICK_PX, y), (left, y)], INK)
            self.canvas.text((left - 8.0, y), text, anchor="rm")
        self.canvas.text(((left + right) / 2.0, bottom + 40.0), x_name)
        self.canvas.text_upwards((left - 56.0, (top + bottom) / 2.0), y_name)

    def legend(self, place: tuple[float, float]) -> None:
        """Write what was named, one below the other, from this place on the canvas."""
        x, y = place
        for text, colour, style in self.names:
            if style == "bar":
                self.canvas.box((x, y - 5.0, x + 24.0, y + 5.0), colour)
            elif style == "dashes":
                self.canvas.dashes((x, y), x + 24.0, colour)
            else:
                self.canvas.line([(x, y), (x + 24.0, y)], colour, width=2.0)
            self.canvas.text((x + 32.0, y), text, anchor="lm")
            y += 20.0


def ticks(low: float, high: float, *, least_step: float = 0.0) -> Iterator[tuple[float, str]]:
    """Yield some eight round values between two, and how they are written.

    >>> [text for _, text in ticks(0.0, 36.0)]
    ['0', '5', '10', '15', '20', '25', '30', '35']
    """
    rough = (high - low) / 8.0
    decade = 10.0 ** math.floor(math.log10(rough))
    step = next(decade * each for each in (1.0, 2.0, 5.0, 10.0) if decade * each >= rough)
    step = max(step, least_step)
    for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1):
        yield k * step, f"{k * step:g}"
