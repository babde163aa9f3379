"""The validation's pictures: lag distances with P1's ranges, and accuracy as heat maps.

Needs matplotlib (extra `plot`): imported only where a picture is drawn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import rc_context
from matplotlib.lines import Line2D

from analysis.published import P1_RATES_L_HA, P1_SPRAYING_ACCURACY_PERCENT
from companion.errors import ConfigError
from sitl.demo_pictures import COLOURS, DPI, INK, QUIET, STYLE, TITLES, new_figure
from tools.studies.validation_flights import WAYS, FlownMethod, Row, Validation, basis, mean_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Below this all cells have one colour: without compensation accuracy is far lower than anywhere
# else, and a scale that reached there would show nothing of the rest.
SCALE_PERCENT = (90.0, 100.0)
SERVO_COLOUR = "#56B4E9"


def draw_pictures(result: Validation, folder: Path) -> list[str]:
    """Draw both pictures into `folder` and return their names.

    Raises:
        ConfigError: when one cannot be written.
    """
    drawings = {"validation.png": lag_figure, "validation-accuracy.png": accuracy_figure}
    with rc_context(STYLE):
        for name, drawing in drawings.items():
            try:
                drawing(result).savefig(
                    folder / name, dpi=DPI, facecolor="white", metadata={"Software": None}
                )
            except (OSError, ValueError) as error:
                raise ConfigError(f"{folder / name}: cannot be written ({error})") from None
    return list(drawings)


def lag_figure(result: Validation) -> Figure:
    """Draw mean and range of P1's lag distance by speed and method, beside P1's own."""
    figure = new_figure(
        (10.0, 5.2),
        "Lag distance on the twin beside Wang et al. 2024",
        f"Boundary to settled flow, P1's definition; {basis(result)} "
        "Bar: all changes; thick: means by rate; dot: mean",
    )
    axes = figure.subplots()
    figure.subplots_adjust(left=0.065, right=0.985, top=0.8, bottom=0.075)
    places = {speed: float(i) for i, speed in enumerate(result.speeds_m_s)}
    for row in (row for row in result.rows if row.way in WAYS):
        x = places[row.speed_m_s] + 0.17 * (WAYS.index(row.way) - 0.5 * (len(WAYS) - 1))
        _lag(axes, x, row)
        _published(axes, x + 0.055, row)
    axes.axhline(0.0, color=INK, lw=1.0, zorder=1)
    axes.set_xticks(list(places.values()), [f"{speed:g} m/s" for speed in places])
    axes.set_xlim(-0.5, len(places) - 0.5)
    axes.set_ylabel("lag distance [m], above 0 too late")
    axes.tick_params(axis="x", length=0)
    axes.grid(axis="y", color="#E4E4E4", lw=0.7)
    axes.set_axisbelow(True)
    _legend(figure)
    return figure


def _colour(way: FlownMethod) -> str:
    return SERVO_COLOUR if way.output == "servo" else COLOURS[way.method]


def _title(way: FlownMethod) -> str:
    title = TITLES[way.method]
    return way.name if title == way.method and title != "none" else title


def _lag(axes: Axes, x: float, row: Row) -> None:
    lag, colour, means = row.settled.all_m, _colour(row.way), row.settled.rate_means_m
    if lag.mean is None or lag.min is None or lag.max is None:
        return
    axes.plot([x, x], [lag.min, lag.max], color=colour, lw=1.4, zorder=2)
    axes.plot(
        [x, x], [min(means), max(means)], color=colour, lw=6.0, alpha=0.5, solid_capstyle="butt"
    )
    axes.scatter(x, lag.mean, s=34, color=colour, zorder=3)
    axes.text(x - 0.02, lag.mean, f"{lag.mean:.2f}", ha="right", va="center", size=8)


def _published(axes: Axes, x: float, row: Row) -> None:
    p1 = row.published
    if p1 is None:
        return
    if p1.min is not None and p1.max is not None:
        axes.plot([x, x], [p1.min, p1.max], color=INK, lw=1.4, zorder=2)
    axes.scatter(x, p1.mean, s=40, marker="D", color="white", ec=INK, lw=1.3, zorder=4)
    axes.text(x + 0.025, p1.mean, f"{p1.mean:.2f}", ha="left", va="center", size=8)


def _legend(figure: Figure) -> None:
    marks = [
        Line2D([], [], ls="", marker="o", ms=6, color=_colour(way), label=_title(way))
        for way in WAYS
    ]
    published = "Wang et al. 2024, mean and range"
    marks.append(Line2D([], [], marker="D", ms=6, color=INK, mfc="white", label=published))
    figure.legend(
        handles=marks, loc="upper left", bbox_to_anchor=(0.01, 0.88), ncols=len(marks),
        columnspacing=1.1, handletextpad=0.2, handlelength=1.5,
    )  # fmt: skip


def accuracy_figure(result: Validation) -> Figure:
    """Draw P1's Table 5 and the twin's, one heat map each, on one scale."""
    figure = new_figure(
        (12.0, 5.6),
        "Spraying accuracy by speed and rate",
        f"SA [%] by Eqs. 18 and 19 of Wang et al. 2024, transitions included; {basis(result)} "
        "Last column: mean of the ten rates",
    )
    panels = figure.subplots(3, 2, sharex=True).flat
    figure.subplots_adjust(left=0.05, right=0.91, top=0.83, bottom=0.09, hspace=0.36, wspace=0.1)
    published = list(P1_SPRAYING_ACCURACY_PERCENT.values())
    image = _heat(panels[0], published, list(P1_SPRAYING_ACCURACY_PERCENT))
    panels[0].set_title("Wang et al. 2024, Table 5 (measured)", weight="bold")
    for panel, way in zip(panels[1:], WAYS, strict=True):
        rows = [row for row in result.rows if row.way == way]
        _heat(panel, [row.cells_percent() for row in rows], [row.speed_m_s for row in rows])
        panel.set_title(f"twin: {_title(way)}")
    for panel in panels[4:]:
        panel.set_xlabel("prescribed rate [L/ha]")
    bar = figure.colorbar(image, cax=figure.add_axes((0.93, 0.09, 0.013, 0.74)), extend="min")
    bar.set_label("spraying accuracy [%]", color=QUIET)
    return figure


def _heat(axes: Axes, rows: Sequence[Sequence[float | None]], speeds: Sequence[float]) -> Any:
    """Draw a table with its figures; the mean of each row stands in a column of its own."""
    table = np.array([[*row, mean_of(row)] for row in rows], dtype=np.float64)
    low, high = SCALE_PERCENT
    image = axes.imshow(table, cmap="viridis", vmin=low, vmax=high, aspect="auto")
    for (i, j), value in np.ndenumerate(table):
        dark = value < 0.5 * (low + high)
        axes.text(
            j, i, f"{value:.1f}", ha="center", va="center", size=8, color="w" if dark else INK
        )
    axes.axvline(len(P1_RATES_L_HA) - 0.5, color="white", lw=4.0)
    axes.set_xticks(range(table.shape[1]), [*(f"{rate:g}" for rate in P1_RATES_L_HA), "mean"])
    axes.set_yticks(range(len(speeds)), [f"{speed:g} m/s" for speed in speeds])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    return image
