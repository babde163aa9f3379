"""The demo's pictures: the field, the lag of every boundary, the flow along one pass.

With `demo_map` and `demo_style` the only files of the demo that need matplotlib (extra `plot`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib import rc_context
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from analysis.published import p1_lag_distance_m
from sitl.demo import METHODS, SCHEDULED, DemoResult, Flown
from sitl.demo_field import demo_setup
from sitl.demo_map import map_figure
from sitl.demo_style import COLOURS, DPI, FAINT, INK, STYLE, TITLES, new_figure, shown
from sitl.demo_traces import field_axes

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
        "Where the changes of rate fell",
        "Distance along the track from the boundary to the volume-equivalent step of the true "
        "flow, a point for every boundary and valve",
    )
    left, right = figure.subplots(1, 2, width_ratios=(1.75, 1.0))
    figure.subplots_adjust(left=0.06, right=0.985, top=0.755, bottom=0.075, wspace=0.17)
    jitter = np.random.default_rng(0)
    for flown in result.flights:
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
    right.set_title("scheduled alone; figures: absolute values")
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
