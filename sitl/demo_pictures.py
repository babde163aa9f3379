"""The demo's pictures: the field, the lag of every boundary, the flow along one pass.

The only file of the demo that needs matplotlib (the extra `plot`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.published import p1_lag_distance_m
from sitl.demo import METHODS, SCHEDULED, DemoResult, Flown, demo_setup
from sitl.demo_traces import CELL_M, MARGIN_M, FieldAxes, field_axes

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from companion.core.prescription import Prescription

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
    "look-ahead-stated": "look-ahead 0.97 s",
    "scheduled": "scheduled",
}
INK, FAINT, BARE = "#222222", "#8A8A8A", "#F1F1EE"
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
}
DPI = 150
# Less than this share of the least rate on the map is not worth a colour.
WET_SHARE = 0.1


def draw_pictures(result: DemoResult, folder: Path) -> list[Path]:
    """Draw all pictures into `folder` and return where they are."""
    with rc_context(STYLE):
        figures = {
            "map.png": map_figure(result),
            "lags.png": lags_figure(result),
            "flow.png": flow_figure(result),
        }
        for name, figure in figures.items():
            figure.savefig(folder / name, dpi=DPI, facecolor="white")
    return [folder / name for name in figures]


def _figure(width_in: float, height_in: float, title: str, subtitle: str) -> Figure:
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasAgg(figure)
    figure.text(0.03, 1.0 - 0.17 / height_in, title, size=13.5, weight="bold", va="top")
    figure.text(0.03, 1.0 - 0.46 / height_in, subtitle, size=9.5, color="#555555", va="top")
    return figure


def _shown(result: DemoResult) -> dict[str, Flown]:
    """Return the flights that have traces, by method."""
    return {flown.job.method: flown for flown in result.flights if flown.traces is not None}


# ---------------------------------------------------------------------------------------- the lags


def lags_figure(result: DemoResult) -> Figure:
    """Draw the lag distance of every boundary and valve: all methods, and ours enlarged."""
    speeds = result.options.speeds_m_s
    figure = _figure(
        10.0,
        4.9,
        "Where the changes of rate fell",
        "Distance from the boundary to the volume-equivalent step of the true flow; "
        "one point for each boundary and valve",
    )
    left, right = figure.subplots(1, 2, width_ratios=(1.75, 1.0))
    figure.subplots_adjust(left=0.07, right=0.985, top=0.77, bottom=0.11, wspace=0.17)
    rng = np.random.default_rng(0)
    for flown in result.flights:
        place, method = speeds.index(flown.job.speed_m_s), flown.job.method
        offset = 0.2 * (METHODS.index(method) - 1.5)
        lags_m = _lags_m(flown)
        spread = rng.uniform(-0.07, 0.07, len(lags_m))
        _points(left, place + offset + spread, lags_m, method)
        if method == SCHEDULED:
            _points(right, place + 3.0 * spread, 100.0 * lags_m, method)
            _mean(right, place, flown, 100.0, "cm", 0.3)
    _published(left, speeds)
    left.set_title("All methods")
    left.set_ylabel("lag distance [m]: above 0 too late")
    right.set_title("scheduled alone, enlarged")
    right.set_ylabel("lag distance [cm]")
    for panel in (left, right):
        panel.axhline(0.0, color=INK, lw=1.0, zorder=1)
        panel.set_xticks(range(len(speeds)), [f"{speed:g} m/s" for speed in speeds])
        panel.set_xlim(-0.55, len(speeds) - 0.45)
        panel.tick_params(length=0)
        panel.grid(axis="y", color="#E4E4E4", lw=0.7)
        panel.set_axisbelow(True)
    reach = max(25.0, 1.15 * float(np.abs(right.get_ylim()).max()))
    right.set_ylim(-reach, reach)
    _legend(figure)
    return figure


def _lags_m(flown: Flown) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    lags = (s.lag_distance_m for s in flown.evaluation.steps if not s.change.border)
    return np.array([lag for lag in lags if lag is not None], dtype=np.float64)


def _points(panel: Axes, x: object, y: object, method: str) -> None:
    panel.scatter(x, y, s=7, color=COLOURS[method], alpha=0.4, linewidths=0, zorder=2)  # type: ignore[arg-type]


def _mean(panel: Axes, place: float, flown: Flown, scale: float, unit: str, half: float) -> None:
    lag = flown.evaluation.lag_distance_m
    if lag.mean_abs is None or lag.max_abs is None:
        return
    panel.text(
        place,
        0.99,
        f"mean {scale * lag.mean_abs:.1f} {unit}\nworst {scale * lag.max_abs:.0f} {unit}",
        transform=panel.get_xaxis_transform(),
        ha="center",
        va="top",
        size=8.5,
    )


def _published(panel: Axes, speeds: tuple[float, ...]) -> None:
    for place, speed_m_s in enumerate(speeds):
        for number, method in enumerate(METHODS):
            row = p1_lag_distance_m(method, speed_m_s)
            if row is not None:
                x = place + 0.2 * (number - 1.5)
                panel.scatter(x, row.mean, s=46, marker="D", color="none", ec=INK, lw=1.2, zorder=4)


def _legend(figure: Figure) -> None:
    marks = [
        Line2D([], [], ls="", marker="o", ms=6, color=COLOURS[method], label=TITLES[method])
        for method in METHODS
    ]
    marks.append(
        Line2D([], [], ls="", marker="D", ms=6, mfc="none", mec=INK, label="P1, published mean")
    )
    figure.legend(
        handles=marks, loc="upper left", bbox_to_anchor=(0.02, 0.89), ncols=5, columnspacing=1.4
    )


# ---------------------------------------------------------------------------------------- the flow


def flow_figure(result: DemoResult) -> Figure:
    """Draw the prescribed, ordered and applied flow along the first pass, a panel a method."""
    speed_m_s, shown = result.options.shown_m_s, _shown(result)
    length_m = field_axes(demo_setup(speed_m_s)).length_m
    figure = _figure(
        10.0,
        7.2,
        "The flow along one pass",
        f"Total flow at {speed_m_s:g} m/s against the distance along the field; "
        "applied: mean over one PWM period",
    )
    panels = figure.subplots(len(METHODS), 1, sharex=True, sharey=True)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.85, bottom=0.075, hspace=0.32)
    for panel, method in zip(panels, METHODS, strict=True):
        traces = shown[method].traces
        assert traces is not None
        along_m, asked = traces.along_m, traces.prescribed_l_min
        panel.fill_between(along_m, asked, color="#E2E2DE", lw=0, label="prescribed")
        panel.plot(along_m, asked, color=FAINT, lw=0.8)
        panel.plot(
            along_m, traces.ordered_l_min, color=INK, lw=1.0, ls=(0, (3, 1.5)), label="ordered"
        )
        panel.plot(along_m, traces.applied_l_min, color=COLOURS[method], lw=1.7, label="applied")
        panel.set_title(TITLES[method], color=COLOURS[method], weight="bold", pad=4)
        panel.set_ylabel("L/min")
        panel.legend(loc="upper right", bbox_to_anchor=(1.0, 1.3), ncols=3, fontsize=8.5)
        panel.set_xlim(-4.0, length_m + 4.0)
        panel.set_xticks(np.arange(0.0, length_m + 1.0, 12.0))
        panel.set_ylim(0.0, 1.08 * float(traces.prescribed_l_min.max()))
    panels[-1].set_xlabel("distance along the field [m]; ticks at the boundaries of the plots")
    return figure
