"""The figure of all cards: volume by drop size, and density and coverage against P1's limits."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from analysis.wsp.quality import FUNGICIDE_PER_CM2, INSECTICIDE_PER_CM2, OVERSPRAY_PERCENT
from analysis.wsp.results import Numbered

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
