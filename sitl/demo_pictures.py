"""The demo's pictures: the field, the lag of every boundary, the flow along one pass.

The only file of the demo that needs matplotlib (extra `plot`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
import shapely
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from analysis.published import p1_lag_distance_m
from analysis.report import figure_style
from analysis.report.figure_style import FAINT, INK, QUIET
from companion.map_pictures import RATES_MAP, draw_bar, length_text, rate_ends
from sitl.anyang import demo_setup
from sitl.demo import (
    CELL_M,
    MARGIN_X_M,
    MARGIN_Y_M,
    METHODS,
    SCHEDULED,
    DemoResult,
    FieldAxes,
    Flown,
    field_axes,
)

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from companion.core.prescription import Prescription

__all__ = [
    "COLOURS",
    "DPI",
    "FAINT",
    "INK",
    "QUIET",
    "STYLE",
    "TITLES",
    "new_figure",
    "shown",
]

# Okabe and Ito's colours, told apart by all kinds of eyes.
COLOURS = {
    "none": "#D55E00",
    "look-ahead": "#E69F00",
    "look-ahead-stated": "#CC79A7",
    "scheduled": "#0072B2",
}
TITLES = {
    "none": "none",
    "look-ahead": "look-ahead 0.71 s",
    "look-ahead-stated": "look-ahead 0.97 s, as stated",
    "scheduled": "scheduled",
}
STYLE: dict[Any, Any] = {**figure_style.STYLE, "font.size": 9.0, "axes.titlesize": 10.0}
DPI = 150


def new_figure(size_in: tuple[float, float], title: str, subtitle: str) -> Figure:
    """Return a figure with its titles; no window and no state that outlives it."""
    figure = Figure(figsize=size_in)
    FigureCanvasAgg(figure)
    height_in = size_in[1]
    figure.text(0.02, 1.0 - 0.16 / height_in, title, size=14, weight="bold", va="top")
    figure.text(0.02, 1.0 - 0.47 / height_in, subtitle, size=9, color=QUIET, va="top")
    return figure


def shown(result: DemoResult) -> dict[str, Flown]:
    """Return the flights that pictures are made of, by method."""
    return {flown.job.method: flown for flown in result.flights if flown.traces is not None}


Floats = NDArray[np.float64]

# The enlarged picture reaches at least this far.
REACH_CM = 25.0
PLOT_M = 12.0


def draw_pictures(result: DemoResult, folder: Path) -> list[str]:
    """Draw all pictures into `folder` and return their names."""
    drawings = {"map.png": map_figure, "lags.png": lags_figure, "flow.png": flow_figure}
    with rc_context(STYLE):
        for name, drawing in drawings.items():
            drawing(result).savefig(folder / name, dpi=DPI, facecolor="white")
    return list(drawings)


# ---------------------------------------------------------------------------------------- the lags


def lags_figure(result: DemoResult) -> Figure:
    """Draw the lag distance of every boundary and valve: all methods, and ours enlarged."""
    speeds = result.options.speeds_m_s
    figure = new_figure(
        (10.0, 4.9),
        "Where each change of rate took effect",
        "How far past its boundary (below 0: too early), a point for every boundary and valve",
    )
    left, right = figure.subplots(1, 2, width_ratios=(1.75, 1.0))
    figure.subplots_adjust(left=0.06, right=0.985, top=0.755, bottom=0.075, wspace=0.17)
    jitter = np.random.default_rng(0)
    for flown in (each for each in result.flights if each.job.method in METHODS):
        place, method = float(speeds.index(flown.job.speed_m_s)), flown.job.method
        lags_m = _lags_m(flown)
        spread = jitter.uniform(-0.07, 0.07, len(lags_m))
        _points(left, place + _beside(method) + spread, lags_m, method)
        if method == SCHEDULED:
            _points(right, place + 3.0 * spread, 100.0 * lags_m, method)
            _figures(right, place, flown, size=min(8.5, 26.0 / len(speeds)))
    _published(left, speeds)
    left.set_title("All methods")
    left.set_ylabel("lag distance [m], above 0 too late")
    right.set_title("scheduled only; means ignore the sign")
    right.set_ylabel("lag distance [cm], above 0 too late")
    reach_cm = max(REACH_CM, 1.3 * float(np.abs(right.get_ylim()).max()))
    right.set_ylim(-reach_cm, reach_cm)
    for panel in (left, right):
        _dress(panel, speeds)
    _legend(figure)
    return figure


def _beside(method: str) -> float:
    return 0.2 * (METHODS.index(method) - 0.5 * (len(METHODS) - 1))


def _lags_m(flown: Flown) -> Floats:
    """Return the lag of every change inside the field that has one."""
    lags = (s.lag_distance_m for s in flown.evaluation.steps if not s.change.border)
    return np.array([lag for lag in lags if lag is not None], dtype=np.float64)


def _points(panel: Axes, x: Floats, y: Floats, method: str) -> None:
    panel.scatter(x, y, s=8, color=COLOURS[method], alpha=0.4, linewidths=0, zorder=2)


def _figures(panel: Axes, place: float, flown: Flown, *, size: float) -> None:
    lag = flown.evaluation.lag_distance_m
    if lag.mean_abs is None or lag.max_abs is None:
        return
    text = f"mean {100.0 * lag.mean_abs:.1f} cm\nworst {100.0 * lag.max_abs:.1f} cm"
    where = panel.get_xaxis_transform()
    panel.text(place, 0.99, text, transform=where, ha="center", va="top", size=size)


def _published(panel: Axes, speeds: tuple[float, ...]) -> None:
    for place, speed_m_s in enumerate(speeds):
        for method in METHODS:
            row = p1_lag_distance_m(method, speed_m_s)
            if row is not None:
                x = place + _beside(method)
                panel.scatter(x, row.mean, s=46, marker="D", color="none", ec=INK, lw=1.2, zorder=4)


def _dress(panel: Axes, speeds: tuple[float, ...]) -> None:
    panel.axhline(0.0, color=INK, lw=1.0, zorder=1)
    panel.set_xticks(range(len(speeds)), [f"{speed:g} m/s" for speed in speeds])
    panel.set_xlim(-0.55, len(speeds) - 0.45)
    panel.tick_params(length=0)
    panel.grid(axis="y", color="#E4E4E4", lw=0.7)
    panel.set_axisbelow(True)


def _legend(figure: Figure) -> None:
    marks = [
        Line2D([], [], ls="", marker="o", ms=6, color=COLOURS[method], label=TITLES[method])
        for method in METHODS
    ]
    published = "Wang et al. 2024, mean (settled)"
    marks.append(Line2D([], [], ls="", marker="D", ms=6, mfc="none", mec=INK, label=published))
    figure.legend(
        handles=marks,
        loc="upper left",
        bbox_to_anchor=(0.01, 0.87),
        ncols=len(marks),
        columnspacing=1.6,
        handletextpad=0.2,
    )


# ---------------------------------------------------------------------------------------- the flow


def flow_figure(result: DemoResult) -> Figure:
    """Draw the prescribed, ordered and applied flow along the first pass, a panel a method."""
    speed_m_s, flown = result.options.shown_m_s, shown(result)
    length_m = field_axes(demo_setup(speed_m_s)).length_m
    figure = new_figure(
        (10.0, 7.0),
        "The flow along one pass",
        f"Total flow of the boom at {speed_m_s:g} m/s against the distance along the field; "
        "prescribed follows the true speed, applied is the mean over one PWM period",
    )
    panels = figure.subplots(len(METHODS), 1, sharex=True, sharey=True)
    figure.subplots_adjust(left=0.055, right=0.985, top=0.86, bottom=0.07, hspace=0.27)
    for panel, method in zip(panels, METHODS, strict=True):
        _flows(panel, flown[method])
        panel.set_title(TITLES[method], color=COLOURS[method], weight="bold", pad=4)
        panel.set_ylabel("L/min")
    panels[0].legend(
        loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=3, fontsize=9, borderaxespad=0.0
    )
    panels[0].set_xlim(-4.0, length_m + 4.0)
    panels[0].set_xticks(np.arange(0.0, length_m + 1.0, PLOT_M))
    panels[0].set_ylim(bottom=0.0)
    panels[-1].set_xlabel("distance along the field [m], with ticks where plots meet")
    return figure


def _flows(panel: Axes, flown: Flown) -> None:
    traces, colour = flown.traces, COLOURS[flown.job.method]
    assert traces is not None
    along_m, asked = traces.along_m, traces.prescribed_l_min
    panel.fill_between(along_m, asked, color="#E0E0DC", lw=0, label="prescribed")
    panel.plot(along_m, asked, color=FAINT, lw=0.8)
    ordered = traces.ordered_l_min
    panel.plot(along_m, ordered, color=INK, lw=1.0, ls=(0, (3, 1.5)), label="ordered")
    panel.plot(along_m, traces.applied_l_min, color=colour, lw=1.7, label="applied")


# The demo's picture of the field: what was prescribed, and below it what was applied.

BARE = "#F1F1EE"
# Less than this share of the least rate on the map is not worth a colour.
WET_SHARE = 0.1
# Where the colours are dark, figures on them are white.
DARK_FROM = 0.3
PASSES = 4


def map_figure(result: DemoResult) -> Figure:
    """Draw what was prescribed, and what `none` and `scheduled` made of it, in the same colours."""
    speed_m_s = result.options.shown_m_s
    setup, flown = demo_setup(speed_m_s), shown(result)
    axes = field_axes(setup)
    rates = setup.prescription.rates_l_ha
    norm = Normalize(*rate_ends(rates))
    colours = matplotlib.colormaps[RATES_MAP].with_extremes(bad=BARE)
    figure = new_figure(
        (10.0, 7.2),
        "Prescribed and applied",
        f"The field of Wang et al. (2024) at {speed_m_s:g} m/s with the simulated sprayer, "
        f"{result.options.fidelity}, {result.options.output} output; the applied rate is the mean "
        "over one PWM period",
    )
    panels = figure.subplots(3, 1)
    figure.subplots_adjust(left=0.02, right=0.9, top=0.865, bottom=0.065, hspace=0.16)
    plots = setup.prescription.zone_count
    panels[0].set_title(f"Prescribed: {plots} plots, {len(rates)} rates", weight="bold")
    _fill(panels[0], setup.prescription, axes, colours=colours, norm=norm)
    _arrows(panels[0], axes)
    for panel, method in zip(panels[1:], ("none", SCHEDULED), strict=True):
        panel.set_title(_title(flown[method]), weight="bold")
        _applied(panel, flown[method], colours, norm=norm, dry=WET_SHARE * rates[0])
        _outline(panel, setup.prescription, axes)
    for panel in panels:
        panel.set_aspect("equal")
        panel.set_xlim(-MARGIN_X_M, axes.length_m + MARGIN_X_M)
        panel.set_ylim(-MARGIN_Y_M, axes.width_m + MARGIN_Y_M)
        panel.set_axis_off()
    _scale_and_north(panels[2], axes)
    _rate_bar(figure, rates, norm, colours)
    return figure


def _title(flown: Flown) -> str:
    how = "without compensation" if flown.job.method == "none" else "by vrspray"
    title = f"Applied {how} ({TITLES[flown.job.method]})"
    share = flown.evaluation.misapplied_percent
    return title if share is None else f"{title}: {share:.1f} % misapplied"


def _rings(prescription: Prescription, axes: FieldAxes) -> list[tuple[float, np.ndarray]]:
    """Return the rate and the outline of every plot, in the picture's axes."""
    found = []
    for zone in prescription.zones:
        for part in shapely.get_parts(zone.polygon):
            points = shapely.get_coordinates(part.exterior)
            found.append((zone.rate_l_ha, np.column_stack(axes.place(points[:, 0], points[:, 1]))))
    return found


def _fill(
    panel: Axes,
    prescription: Prescription,
    axes: FieldAxes,
    *,
    colours: Colormap,
    norm: Normalize,
) -> None:
    rings = _rings(prescription, axes)
    faces = [colours(norm(rate)) for rate, _ in rings]
    panel.add_collection(
        PolyCollection(
            [ring for _, ring in rings], facecolors=faces, edgecolors="white", linewidths=1.0
        )
    )
    for rate, ring in rings:
        x_m, y_m = ring[:-1].mean(axis=0)
        ink = "white" if norm(rate) > DARK_FROM else INK
        panel.text(x_m, y_m, f"{rate:.1f}", size=8.5, color=ink, ha="center", va="center")


def _outline(panel: Axes, prescription: Prescription, axes: FieldAxes) -> None:
    rings = [ring for _, ring in _rings(prescription, axes)]
    for colour, width in ((INK, 1.4), ("white", 0.8)):
        panel.add_collection(
            PolyCollection(rings, facecolors="none", edgecolors=colour, linewidths=width)
        )


def _applied(panel: Axes, flown: Flown, colours: Colormap, *, norm: Normalize, dry: float) -> None:
    assert flown.traces is not None
    raster = flown.traces.applied_l_ha
    rows, columns = raster.shape
    right_m, top_m = columns * CELL_M - MARGIN_X_M, rows * CELL_M - MARGIN_Y_M
    panel.imshow(
        np.ma.masked_less(raster, dry),
        origin="lower",
        extent=(-MARGIN_X_M, right_m, -MARGIN_Y_M, top_m),
        cmap=colours,
        norm=norm,
        interpolation="nearest",
    )


def _arrows(panel: Axes, axes: FieldAxes) -> None:
    """Say where each pass begins and which way it goes."""
    for number in range(PASSES):
        y_m = axes.width_m * (1.0 - (number + 0.5) / PASSES)
        start, end = -5.5, -1.0
        if number % 2:
            start, end = axes.length_m - start, axes.length_m - end
        panel.annotate(
            "",
            xy=(end, y_m),
            xytext=(start, y_m),
            arrowprops={"arrowstyle": "-|>", "color": FAINT, "lw": 1.4, "shrinkA": 0, "shrinkB": 0},
        )


def _scale_and_north(panel: Axes, axes: FieldAxes) -> None:
    y_m = -MARGIN_Y_M - 3.0
    draw_bar(panel, 0.0, y_m, 20.0)
    panel.text(21.0, y_m, length_text(20.0), va="center", size=9)
    # The picture's x is the course of the first pass: north is turned back from it.
    course = np.radians(axes.course_deg)
    tail = np.array([34.0, y_m - 0.6])
    tip = tail + 6.0 * np.array([np.cos(course), np.sin(course)])
    panel.annotate(
        "",
        xy=tuple(tip),
        xytext=tuple(tail),
        annotation_clip=False,
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.6, "mutation_scale": 14},
    )
    panel.text(tip[0] + 1.0, tip[1], "N", weight="bold", va="center", size=10)
    note = "lines: plots · arrows: passes · grey: nothing applied"
    panel.text(axes.length_m, y_m, note, ha="right", va="center", size=9, color=QUIET)


def _rate_bar(figure: Figure, rates: Sequence[float], norm: Normalize, colours: Colormap) -> None:
    place = figure.add_axes((0.925, 0.1, 0.016, 0.72))
    bar = figure.colorbar(ScalarMappable(norm=norm, cmap=colours), cax=place)
    bar.set_ticks(rates, labels=[f"{rate:.1f}" for rate in rates])
    bar.ax.set_title("L/ha", size=9.5, loc="left", pad=8)
    bar.ax.tick_params(length=0)
    bar.ax.spines["outline"].set_visible(False)
