"""How far the ground is from what was asked: a histogram; and what the off-rate area is due to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import NullLocator

from analysis.report.figures.style import BLUE, FAINT, GRID, INK, RED, Drawn, new_figure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes

    from analysis.assess.histogram import Histogram
    from analysis.track import Ints

# A bar so many times as high as the usual one makes the usual one a line.
STEEP = 50.0


def histogram(found: Sequence[Histogram]) -> Drawn | None:
    """Draw how often cells deviate by how much, a panel a unit; None without any cell."""
    if not found:
        return None
    figure = new_figure(3.4)
    panels = figure.subplots(1, len(found), squeeze=False, gridspec_kw={"wspace": 0.18})[0]
    for panel, each in zip(panels, found, strict=True):
        _bars(panel, each)
    steep = any(_is_steep(each.counts) for each in found)
    panels[0].set_ylabel("cells (each step ten times)" if steep else "cells")
    return Drawn(
        name="histogram",
        title="Deviation of the cells",
        caption="Applied less prescribed of every cell that was flown over; left of 0: too little. "
        "The line is the mean, the band one standard deviation to each side.",
        alt="Histograms of applied less prescribed of every cell: "
        + "; ".join(f"mean {each.mean:+.2f}, sd {each.sd:.2f} {each.unit}" for each in found)
        + ".",
        kind="chart",
        figure=figure,
    )


def causes(shares: Mapping[str, float]) -> Drawn | None:
    """Draw the off-rate area [m2] by its cause, largest first; None where there is none."""
    named = sorted(
        ((name, area) for name, area in shares.items() if area > 0.0), key=lambda item: item[1]
    )
    if not named:
        return None
    figure = new_figure(0.8 + 0.32 * len(named), margins_in=(2.9, 0.25, 0.6, 0.1))
    panel = figure.subplots()
    areas = [area for _, area in named]
    whole = sum(areas)
    panel.barh([name for name, _ in named], areas, color=BLUE, height=0.65)
    for row, area in enumerate(areas):
        text = f" {area:,.1f} m\u00b2, {100.0 * area / whole:.0f} %"
        panel.text(area, row, text, va="center", color=INK, size=9.5)
    panel.set_xlim(0.0, 1.25 * max(areas))
    panel.set_ylim(-0.6, len(named) - 0.4)
    panel.set_xlabel("area that is off by more than 10 % [m\u00b2]")
    panel.tick_params(axis="y", length=0)
    return Drawn(
        name="causes",
        title="Why ground is off its rate",
        caption="Area whose applied rate is more than 10 % from the prescribed one, each square "
        "metre put to one cause.",
        alt="Bar chart of the area that is more than 10 per cent off its rate, by cause: "
        + "; ".join(f"{name} {area:.1f} square metres" for name, area in reversed(named))
        + ".",
        kind="chart",
        figure=figure,
    )


def _is_steep(counts: Ints) -> bool:
    """Return whether most bars would be lines on an even scale."""
    filled = counts[counts > 0]
    return bool(len(filled) > 2 and filled.max() > STEEP * float(np.median(filled)))


def _bars(panel: Axes, found: Histogram) -> None:
    panel.axvspan(found.mean - found.sd, found.mean + found.sd, color="#F1E3D8", lw=0, zorder=0)
    panel.stairs(found.counts, found.edges, fill=True, color=BLUE)
    is_steep = _is_steep(found.counts)
    if is_steep:
        # One bar of nearly all cells: the others would not be seen beside it.
        panel.set_yscale("log")
        panel.set_ylim(0.7, 2.0 * float(found.counts.max()))
        panel.yaxis.set_major_formatter("{x:,.0f}")
        panel.yaxis.set_minor_locator(NullLocator())
    else:
        panel.set_ylim(bottom=0.0)
    panel.axvline(0.0, color=FAINT, lw=0.8)
    panel.axvline(found.mean, color=RED, lw=1.4)
    panel.set_title(
        f"mean {found.mean:+.2f}, sd {found.sd:.2f} {found.unit}, {found.cells:,} cells"
    )
    panel.set_xlabel(f"applied less prescribed [{found.unit}]")
    panel.grid(axis="y", color=GRID, lw=0.7)
    panel.set_axisbelow(True)
