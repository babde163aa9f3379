"""The legend of a picture: what the colours mean, and the ground and the litres of each rate."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from missions.maps.picture.ground import BARE, HATCH, LINE, Colours
from missions.maps.totals import Totals


def draw_legend(
    figure: Figure,
    colours: Colours,
    found: Totals,
    *,
    left: float,
    top: float,
    bare: bool,
    boundary: bool,
) -> None:
    """Write what the colours mean, and the ground and the litres of each rate."""
    shown = found.rates_l_ha >= 0.0 if colours.are_listed else found.rates_l_ha == 0.0
    shades = colours(found.rates_l_ha[shown]).tolist()
    handles: list[Artist] = []
    for label, shade in zip(_lines_of(found, shown), shades, strict=True):
        handles.insert(0, Patch(facecolor=tuple(shade), edgecolor=LINE, label=label))
    if bare:
        handles.append(Patch(facecolor=BARE, edgecolor=HATCH, hatch="///", label="no rate"))
    if boundary:
        handles.append(Line2D([], [], color="black", linestyle="--", label="boundary"))
    high_in = figure.get_figheight()
    if not colours.are_listed:
        bar_in = min(5.0, 0.6 * high_in)
        axes = figure.add_axes((left, top - bar_in / high_in, 0.03, bar_in / high_in))
        figure.colorbar(colours.scale, cax=axes, label="L/ha")
        top -= (bar_in + 0.3) / high_in
    if handles:
        figure.legend(
            handles=handles, loc="upper left", bbox_to_anchor=(left, top), frameon=False,
            fontsize=11, borderaxespad=0.0, labelspacing=0.7, handlelength=2.2,
        )  # fmt: skip


def amount(value: float) -> str:
    """Return a number as a person writes it: with decimals where it is small.

    >>> amount(12345.6), amount(76.8062), amount(0.02881), amount(0.0)
    ('12,346', '76.8', '0.0288', '0')
    """
    if value >= 100.0:
        return f"{value:,.0f}"
    if value >= 1.0:
        return f"{value:.1f}" if value >= 10.0 else f"{value:.2f}"
    return f"{value:.3g}"


def _lines_of(found: Totals, shown: NDArray[np.bool_]) -> list[str]:
    """Return rate, ground and litres as columns; a figure space is as wide as a digit."""
    most = float(found.litres.max(initial=0.0))
    decimals = 0 if most >= 100.0 else 1 if most >= 10.0 else 2
    columns = [
        [f"{rate:.6g}" for rate in found.rates_l_ha[shown].tolist()],
        [
            f"{area:.2f}" if area >= 1.0 else f"{area:.4f}"
            for area in found.areas_ha[shown].tolist()
        ],
        [f"{litres:,.{decimals}f}" for litres in found.litres[shown].tolist()],
    ]
    widths = [max(map(len, column), default=0) for column in columns]
    rows = zip(*columns, strict=True)
    return [
        "    ".join(
            text.rjust(width, "\N{FIGURE SPACE}") + unit
            for text, width, unit in zip(row, widths, (" L/ha", " ha", " L"), strict=True)
        )
        for row in rows
    ]
