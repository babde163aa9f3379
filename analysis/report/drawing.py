"""All figures of a report, in the order of the page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import shapely
from matplotlib import colormaps
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator, NullLocator

from analysis.report.contents import CAUSES
from analysis.report.figure_style import (
    BLUE,
    DEVIATION_MAP,
    FAINT,
    GREEN,
    GRID,
    INK,
    NOTHING_COLOUR,
    RED,
    SKY,
    Drawn,
    Sheet,
    dress,
    new_figure,
    sheet_of,
)
from companion.map_pictures import RATES_MAP, rate_ends

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.colors import Colormap

    from analysis.assess.assessment import Assessment
    from analysis.assess.breakdowns import Group
    from analysis.assess.cell_maps import CellMaps, Histogram
    from analysis.assess.ground import Treated
    from analysis.evaluation import Evaluation
    from analysis.flown.applied_flight import AppliedFlight, Floats, Series
    from analysis.lag import Step
    from analysis.report.clock import Clock
    from analysis.student import Interval
    from analysis.track import Ints


def drawn_of(assessment: Assessment, clock: Clock, treated: Treated) -> Iterator[Drawn]:
    """Yield every figure that this flight gives something to draw for."""
    flight, cells = assessment.flight, assessment.cells
    sheet = None if cells is None else sheet_of(flight, cells)
    if sheet is not None:
        yield prescribed_and_applied(sheet)
        yield deviation(sheet)
    yield flow_over_time(flight, _minute_zero(assessment, clock))
    tables = assessment.breakdowns
    found = [lag_distances(assessment.evaluation, tables.by_rate, tables.by_speed)]
    if cells is not None:
        both = (cells.histogram_l_ha, cells.histogram_l_min)
        found.append(histogram([each for each in both if each is not None]))
    by_cause = assessment.causes.by_cause
    found.append(causes({CAUSES[cause.value]: area for cause, area in by_cause.items()}))
    yield from (each for each in found if each is not None)
    if sheet is not None:
        yield duty(sheet)
        if not treated.area.is_empty:
            yield treated_area(sheet, treated)


def _minute_zero(assessment: Assessment, clock: Clock) -> str:
    """Return in words when the time axis begins."""
    first = clock.at(float(assessment.flight.time_s[0]))
    if first is None:
        return "the first position"
    return f"{first:%H:%M:%S} ({clock.zone_name}; {clock.source_text.split(' (')[0]})"


# Maps of the ground, cell by cell: prescribed and applied, deviation, duty; north is up.
#
# As P2's Figs. 10, 15 and 16. Cells are rastered, so that a large field makes no large file.

# A deviation map reaches at least this far, so that a good flight looks good.
# Cells on the border, which get nothing by rule, must not make all others white.
DEVIATION_MIN_PERCENT, DEVIATION_MAX_PERCENT, DEVIATION_PERCENTILE = 20.0, 50.0, 98.0
NOTHING_L_HA = 1e-6


def prescribed_and_applied(sheet: Sheet) -> Drawn:
    """Draw both maps with one scale of colours."""
    asked, given = sheet.cells.commanded_l_ha, sheet.cells.measured_l_ha
    least, most = rate_ends(sheet.flight.setup.prescription.rates_l_ha)
    figure, panels, bar = sheet.panels(2)
    colours = colormaps[RATES_MAP].with_extremes(under=NOTHING_COLOUR)
    for panel, values, title in zip(panels, (asked, given), ("prescribed", "applied"), strict=True):
        shown = np.where(values <= NOTHING_L_HA, -1.0, np.maximum(values, least))
        mesh = _mesh(panel, sheet, shown, colours, least, most)
        dress(panel, sheet, title, with_path=title == "applied")
    # One scale for both: the north names one axis of two maps side by side.
    panels[1].set_ylabel("" if not sheet.is_wide else "north [m]")
    panels[0].set_xlabel("" if sheet.is_wide else "east [m]")
    figure.colorbar(mesh, cax=bar, label="rate [L/ha]", extend="both")
    return Drawn(
        name="map",
        title="Prescribed and applied",
        caption=f"{_cells_text(sheet.cells)} The darker, the more; grey is nothing, "
        "white was under no pass. The thin line is the path of the vehicle, the black one "
        "the border.",
        alt="Two maps of the field with one scale of colours: the prescribed rate of each cell, "
        "and the rate that was applied.",
        kind="map",
        figure=figure,
    )


def deviation(sheet: Sheet) -> Drawn:
    """Draw by how much each cell is off its rate."""
    error = sheet.cells.relative_error_percent
    known = np.abs(error[np.isfinite(error)])
    reach = float(np.percentile(known, DEVIATION_PERCENTILE)) if len(known) else 0.0
    reach = math.ceil(reach / 5.0) * 5.0
    reach = min(max(reach, DEVIATION_MIN_PERCENT), DEVIATION_MAX_PERCENT)
    figure, (panel,), scale = sheet.panels(1)
    mesh = _mesh(panel, sheet, error, DEVIATION_MAP, -reach, reach)
    dress(panel, sheet, "deviation")
    bar = figure.colorbar(mesh, cax=scale, extend="both")
    bar.set_label("deviation [%], + too much")
    return Drawn(
        name="deviation",
        title="Deviation",
        caption=f"{_cells_text(sheet.cells)} White: as prescribed; red: too little; blue: too "
        "much; the darker, the further off. Cells at the ends of a pass get less where nothing may "
        "fall outside the border. Grey: not flown over, or prescribed less than a tenth of the "
        "highest rate.",
        alt="Map of the relative deviation of each cell from its prescribed rate, red where too "
        "little was applied and blue where too much.",
        kind="map",
        figure=figure,
    )


def duty(sheet: Sheet) -> Drawn:
    """Draw the duty that the valves had over each cell."""
    figure, (panel,), scale = sheet.panels(1)
    mesh = _mesh(panel, sheet, 100.0 * sheet.cells.duty, RATES_MAP, 0.0, 100.0)
    dress(panel, sheet, "duty")
    figure.colorbar(mesh, cax=scale, label="duty [%]")
    return Drawn(
        name="duty",
        title="Duty of the valves",
        caption=f"{_cells_text(sheet.cells)} Mean of the orders in force. The darker, the more.",
        alt="Map of the mean duty of the valves over each cell.",
        kind="map",
        figure=figure,
    )


def _cells_text(cells: CellMaps) -> str:
    whose = "the map's own cells" if cells.source == "map" else "square cells"
    return f"Mean of {whose} of {cells.cell_m:.2g} m."


def _mesh(
    panel: Axes, sheet: Sheet, values: Floats, colours: str | Colormap, low: float, high: float
) -> QuadMesh:
    """Draw the cells, cut at the border: nothing beyond it is the field's."""
    mesh = panel.pcolormesh(
        sheet.cells.corner_east_m,
        sheet.cells.corner_north_m,
        np.ma.masked_invalid(values),
        cmap=colours,
        vmin=low,
        vmax=high,
        rasterized=True,
    )
    mesh.set_clip_path(_path(sheet.flight.setup.prescription.field), panel.transData)
    return mesh


# Lag distances by the rate that a change leads to and by speed, as P1's Fig. 8.

# More groups than these are not named one by one.
NAMED_MAX = 12
# More points than these make a large file and no finer picture.
POINTS_MAX = 300
SPREAD = 0.25
# An interval from fewer independent crossings says nothing but that there are few.
CLUSTERS_MIN = 3
# A good flight should look good: the axis reaches this far at least.
REACH_MIN_M = 0.1


def lag_distances(
    evaluation: Evaluation, by_rate: Sequence[Group], by_speed: Sequence[Group]
) -> Drawn | None:
    """Draw every lag distance and the mean of each group; None where none was measured."""
    steps = [
        step
        for step in evaluation.steps
        if step.lag_distance_m is not None and not step.change.border
    ]
    if not steps:
        return None
    figure = new_figure(4.0, margins_in=(0.85, 0.25, 0.75, 0.4))
    left, right = figure.subplots(
        1, 2, sharey=True, gridspec_kw={"width_ratios": [2, 1], "wspace": 0.05}
    )
    _panel(left, steps, by_rate, [step.change.after_l_ha for step in steps])
    left.set_xlabel("rate that the change leads to [L/ha]")
    left.set_ylabel("lag distance [m], + too late")
    _panel(right, steps, by_speed, [step.change.speed_m_s for step in steps])
    right.set_xlabel("speed [m/s]")
    reached_m = [abs(step.lag_distance_m or 0.0) for step in steps]
    for group in (*by_rate, *by_speed):
        reached_m += [abs(end) for end in _ends(group.lag_distance_m)]
    limit_m = max(1.15 * max(reached_m), REACH_MIN_M)
    left.set_ylim(-limit_m, limit_m)
    left.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.0)
    return Drawn(
        name="lags",
        title="Lag distance by rate and by speed",
        caption="One point for each change of rate and valve inside the field; diamonds are means "
        "with their 95 % interval, from three crossings on. 0: the change lies on its boundary. "
        "Wang et al. 2024 drew such a figure (Fig. 8) of the settled distance, 3.87 m on average "
        "without compensation and 0.32 m with it, at 5 m/s.",
        alt="Two scatter charts of the distance from each boundary to where the flow changed, by "
        "the rate that the change leads to and by speed, with means and 95 % intervals.",
        kind="chart",
        figure=figure,
    )


def _panel(
    panel: Axes, steps: Sequence[Step], groups: Sequence[Group], values: Sequence[float]
) -> None:
    measured = [group for group in groups if group.lag_distance_m.mean is not None]
    place = np.zeros(len(steps))
    for number, group in enumerate(measured):
        assert group.low is not None and group.high is not None
        inside = np.array([group.low <= value <= group.high for value in values])
        place[inside] = number
    # Side by side in the order of flight, so that points do not hide each other; no chance in it.
    beside = (np.arange(len(steps)) * 0.618034) % 1.0 - 0.5
    lag_m = [step.lag_distance_m or 0.0 for step in steps]  # all are measured
    panel.axhline(0.0, color=INK, lw=1.0, zorder=1)
    panel.scatter(
        place + SPREAD * 2 * beside, lag_m, s=9, color=BLUE, alpha=0.45, lw=0, label="a change",
        rasterized=len(steps) > POINTS_MAX,
    )  # fmt: skip
    for number, group in enumerate(measured):
        mean = group.lag_distance_m
        assert mean.mean is not None
        ends = _ends(mean)
        panel.plot([number] * len(ends), ends, color=RED, lw=1.6, zorder=3)
        panel.plot(
            number, mean.mean, marker="D", ms=5, color=RED, mec="white", mew=0.7, ls="", zorder=4,
            label="mean, 95 %" if number == 0 else None,
        )  # fmt: skip
    every = max(1, -(-len(measured) // NAMED_MAX))
    shown = range(0, len(measured), every)
    panel.set_xticks([*shown], [_name(measured[number]) for number in shown])
    panel.set_xlim(-0.6, len(measured) - 0.4)
    panel.grid(axis="y", color=GRID, lw=0.7)
    panel.tick_params(axis="x", length=0, colors=INK)
    panel.spines["bottom"].set_color(FAINT)
    panel.set_axisbelow(True)


def _ends(mean: Interval) -> tuple[float, ...]:
    """Return the ends of an interval that is drawn; none for one that says nothing."""
    if mean.low is None or mean.high is None or mean.clusters < CLUSTERS_MIN:
        return ()
    return mean.low, mean.high


def _name(group: Group) -> str:
    assert group.low is not None and group.high is not None
    return f"{group.low:g}" if group.low == group.high else f"{group.low:g}\nto\n{group.high:g}"


# How far the ground is from what was asked: a histogram; and what the off-rate area is due to.

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


# Where was sprayed: the treated area that the record of the application has as geodata.


def treated_area(sheet: Sheet, treated: Treated) -> Drawn:
    """Draw the treated area over the zones."""
    figure, (panel,), _ = sheet.panels(1, has_bar=False)
    panel.add_patch(
        PathPatch(_path(treated.area), facecolor=SKY, edgecolor="none", rasterized=True)
    )
    dress(panel, sheet, f"{treated.area_ha:.4f} ha")
    return Drawn(
        name="treated",
        title="Treated area",
        caption="Blue: where the spray of open valves fell, as the record of the application has "
        "it as geodata; ground sprayed twice counts once. Black: the border.",
        alt=f"Map of the treated area, {treated.area_ha:.4f} hectares, within the field's border.",
        kind="map",
        figure=figure,
    )


def _path(area: shapely.Geometry) -> Path:
    """Return the area as one path; rings that turn the other way are holes."""
    parts = shapely.orient_polygons(shapely.get_parts(area))
    places, codes = [], []
    for ring in shapely.get_rings(parts):
        corners = shapely.get_coordinates(ring)
        kinds = np.full(len(corners), Path.LINETO, dtype=np.uint8)
        kinds[0], kinds[-1] = Path.MOVETO, Path.CLOSEPOLY
        places.append(corners)
        codes.append(kinds)
    return Path(np.concatenate(places), np.concatenate(codes))


# The flow over time: asked, ordered, metered; pressure and speed below; grey where inhibited.

# A count every second is 1 mL in 80 of a flow of 5 L/min: enough for a line.
METER_STEP_S = 1.0
INHIBITED_MIN_S = 0.5
# A page is some thousand points wide; more of them make files larger and lines no finer.
SERIES_POINTS_MAX = 2000


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
    several = len(minutes) // SERIES_POINTS_MAX
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
