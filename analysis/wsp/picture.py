"""Pictures: each sheet with its cards outlined and stains tinted; all cards' distributions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from analysis.wsp.card import Card
from analysis.wsp.quality import FUNGICIDE_PER_CM2, INSECTICIDE_PER_CM2, OVERSPRAY_PERCENT
from analysis.wsp.results import Numbered

Bytes = NDArray[np.uint8]

# Longest side of a sheet's picture: a stain of 0.2 mm on A4 is still two pixels.
_LONGEST = 3600
_TINT = np.array([228, 26, 28], dtype=np.float32)
_OUTLINE = (0, 90, 255)
_TINT_SHARE = 0.75
# Cards that a figure names one by one; more make a grey bundle.
_NAMED = 10


def draw_sheet(pixels: Bytes, cards: Sequence[tuple[int, Card]], path: Path) -> None:
    """Write the sheet with what was found on it: outline blue, counted stains red."""
    height, width = pixels.shape[:2]
    factor = -(-max(height, width) // _LONGEST)
    small = np.array(Image.fromarray(pixels).reduce(factor))
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
    share = whole.reshape(rows, factor, columns, factor).mean(axis=(1, 3), dtype=np.float32)
    view = small[y : y + rows, x : x + columns]
    share = _TINT_SHARE * share[: view.shape[0], : view.shape[1], None]
    view[:] = np.round(view * (1.0 - share) + _TINT * share).astype(np.uint8)


def draw_distributions(cards: Sequence[Numbered], path: Path) -> None:
    """Write the figure: volume by drop size, and density and coverage against P1's limits."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    volume, density, coverage = figure.subplots(1, 3, width_ratios=(1.3, 1, 1))
    for each in cards:
        drop_um = np.sort(each.card.drop_um)
        if len(drop_um):
            share = 100.0 * np.cumsum(drop_um**3) / (drop_um**3).sum()
            style = {"label": f"card {each.number}"} if len(cards) <= _NAMED else {"color": "0.5"}
            volume.plot(drop_um, share, linewidth=1.2, **style)
    if volume.get_legend_handles_labels()[0]:
        volume.legend(fontsize=8, loc="lower right")
    volume.set(xlabel="drop diameter [um]", ylabel="volume in smaller drops [%]", ylim=(0, 100))
    for part in (10, 50, 90):
        volume.axhline(part, color="0.8", linewidth=0.8, zorder=0)
    numbers = np.arange(1, len(cards) + 1)
    counted = [each.card.main.deposits_per_cm2 for each in cards]
    drops = [each.card.better.drops_per_cm2 for each in cards]
    corrected = [np.nan if each is None else each for each in drops]
    density.bar(numbers, counted, color="#4477aa", label="stains counted")
    density.plot(numbers, corrected, "k_", markersize=9, label="corrected for overlap")
    density.axhline(INSECTICIDE_PER_CM2, color="#cc3311", linestyle="--", label="insecticide, 30")
    density.axhline(FUNGICIDE_PER_CM2, color="#228833", linestyle="--", label="fungicide, 70")
    density.set(xlabel="card", ylabel="deposits per cm²")
    density.set_ylim(top=1.35 * max([FUNGICIDE_PER_CM2, *np.nan_to_num(corrected)]))
    density.legend(fontsize=8, loc="upper center", ncols=2)
    coverage.bar(numbers, [each.card.main.coverage_percent for each in cards], color="#4477aa")
    coverage.axhline(OVERSPRAY_PERCENT, color="#cc3311", linestyle="--", label="overspray, 30 %")
    coverage.set(xlabel="card", ylabel="coverage [%]")
    coverage.set_ylim(top=1.2 * max(OVERSPRAY_PERCENT, coverage.get_ylim()[1] / 1.05))
    coverage.legend(fontsize=8, loc="upper right")
    for axes in (density, coverage):
        axes.xaxis.get_major_locator().set_params(integer=True)
    figure.savefig(path, dpi=130)
