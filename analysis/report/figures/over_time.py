"""The flow over time: asked, ordered, metered; pressure and speed below; grey where inhibited."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import MaxNLocator

from analysis.report.figures.style import BLUE, FAINT, GREEN, GRID, INK, RED, Drawn, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from analysis.flown.applied_flight import AppliedFlight, Floats, Series

# A count every second is 1 mL in 80 of a flow of 5 L/min: enough for a line.
METER_STEP_S = 1.0
INHIBITED_MIN_S = 0.5
# A page is some thousand points wide; more of them make files larger and lines no finer.
POINTS_MAX = 2000


def flow_over_time(flight: AppliedFlight, clock_text: str) -> Drawn:
    """Draw the flow over time; `clock_text` says when minute 0 is."""
    panels_of = [_flow_panel, _speed_panel]
    heights = [3.0, 1.0]
    if flight.pressure_kpa is not None:
        panels_of.insert(1, _pressure_panel)
        heights.insert(1, 1.0)
    figure = new_figure(1.0 + 0.85 * sum(heights))
    panels = figure.subplots(
        len(panels_of),
        1,
        sharex=True,
        gridspec_kw={"height_ratios": heights, "hspace": 0.12},
        squeeze=False,
    )[:, 0]
    for panel, draw in zip(panels, panels_of, strict=True):
        draw(panel, flight)
        panel.grid(axis="y", color=GRID, lw=0.7)
        panel.set_axisbelow(True)
    for begin, end in inhibited_spans(flight):
        panels[0].axvspan(begin / 60.0, end / 60.0, color="#EEEEEE", lw=0, zorder=0)
    figure.align_ylabels()
    panels[-1].set_xlabel(f"minutes since {clock_text}")
    panels[-1].xaxis.set_major_locator(MaxNLocator(nbins=12, steps=[1, 2, 5, 10]))
    panels[-1].set_xlim(0.0, max(flight.duration_s, 1.0) / 60.0)
    return Drawn(
        name="flow",
        title="Flow over time",
        caption="Asked: what the prescription needs at the speed of the moment. Ordered: what the "
        "executed valve changes stand for by the calibrated curve. Grey: spraying was inhibited.",
        alt="Line chart of the flow of all valves together, asked, ordered and metered, over the "
        "time of the flight, with pressure where it was measured, and speed below.",
        kind="chart",
        figure=figure,
    )


def inhibited_spans(flight: AppliedFlight) -> list[tuple[float, float]]:
    """Return from when to when spraying was inhibited, in seconds since the first sample."""
    if not len(flight.time_s):
        return []
    held = np.array([reasons != "" for reasons in flight.inhibits], dtype=np.int8)
    edges = np.diff(np.concatenate([[0], held, [0]]))
    time_s = flight.time_s - flight.time_s[0]
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    spans = [
        (float(time_s[begin]), float(time_s[min(end, len(time_s) - 1)]))
        for begin, end in zip(begins, ends, strict=True)
    ]
    return [span for span in spans if span[1] - span[0] >= INHIBITED_MIN_S]


def metered_flow(series: Series, from_s: float, until_s: float) -> tuple[Floats, Floats]:
    """Return times and flow [L/min] by the counts of a meter, a mean every second."""
    known = np.isfinite(series.value)
    at_s = np.arange(from_s, until_s, METER_STEP_S)
    if known.sum() < 2 or len(at_s) < 2:
        return np.empty(0), np.empty(0)
    volume_ml = np.interp(at_s, series.time_s[known], series.value[known])
    return at_s[:-1] + METER_STEP_S / 2, np.diff(volume_ml) * 60.0 / 1e3 / METER_STEP_S


def thinned(flight: AppliedFlight, values: Floats) -> tuple[Floats, Floats]:
    """Return minutes and values, of long flights the least and the largest of each few."""
    minutes = (flight.time_s - flight.time_s[0]) / 60.0
    several = len(minutes) // POINTS_MAX
    if several < 2:
        return minutes, values
    few = 2 * several
    whole = len(minutes) // few * few
    parts, at = np.nan_to_num(values[:whole]).reshape(-1, few), minutes[:whole].reshape(-1, few)
    both = np.stack([parts.min(axis=1), parts.max(axis=1)], axis=1).ravel()
    return np.repeat(at[:, 0], 2), both


def _flow_panel(panel: Axes, flight: AppliedFlight) -> None:
    minutes, target = thinned(flight, np.nan_to_num(flight.target_flow_l_min))
    panel.fill_between(minutes, target, color="#DDDDD8", lw=0, label="asked", rasterized=True)
    if flight.meter_ml is not None:
        at_s, flow = metered_flow(flight.meter_ml, flight.time_s[0], flight.time_s[-1])
        panel.plot((at_s - flight.time_s[0]) / 60.0, flow, color=RED, lw=0.9, label="metered")
    panel.plot(*thinned(flight, flight.flow_l_min), color=BLUE, lw=1.0, label="ordered")
    panel.set_ylabel("flow [L/min]")
    panel.set_ylim(bottom=0.0)
    panel.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.0)


def _pressure_panel(panel: Axes, flight: AppliedFlight) -> None:
    series = flight.pressure_kpa
    assert series is not None
    minutes = (series.time_s - flight.time_s[0]) / 60.0
    panel.plot(minutes, series.value, color=GREEN, lw=0.9)
    panel.set_ylabel("pressure [kPa]")
    panel.set_ylim(bottom=0.0)


def _speed_panel(panel: Axes, flight: AppliedFlight) -> None:
    panel.plot(*thinned(flight, flight.speed_m_s), color=INK, lw=0.9)
    panel.set_ylabel("speed [m/s]")
    panel.axhline(0.0, color=FAINT, lw=0.6)
    panel.set_ylim(bottom=0.0)
