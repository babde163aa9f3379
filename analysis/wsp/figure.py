"""The figure of all cards: volume by drop size, and density and coverage against P1's limits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from analysis.wsp.chart import FAINT, INK, Axes, Canvas
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
