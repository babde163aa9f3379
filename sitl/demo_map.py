"""The demo's picture of the field: what was prescribed, and below it what was applied."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
import shapely
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Colormap, Normalize

from sitl.demo import SCHEDULED, DemoResult, Flown
from sitl.demo_field import demo_setup
from sitl.demo_style import FAINT, INK, QUIET, TITLES, new_figure, shown
from sitl.demo_traces import CELL_M, MARGIN_X_M, MARGIN_Y_M, FieldAxes, field_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from companion.core.prescription import Prescription

BARE = "#F1F1EE"
# Less than this share of the least rate on the map is not worth a colour.
WET_SHARE = 0.1
# Where the colours are dark, figures on them are white.
DARK_BELOW = 0.7
PASSES = 4
# The colours go on a little beyond the map's rates, so that too much can be seen.
BEYOND_L_HA = 1.0


def map_figure(result: DemoResult) -> Figure:
    """Draw what was prescribed, and what `none` and `scheduled` made of it, in the same colours."""
    speed_m_s = result.options.shown_m_s
    setup, flown = demo_setup(speed_m_s), shown(result)
    axes = field_axes(setup)
    rates = setup.prescription.rates_l_ha
    norm = Normalize(rates[0] - BEYOND_L_HA, rates[-1] + BEYOND_L_HA)
    colours = matplotlib.colormaps["viridis"].with_extremes(bad=BARE)
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
    title = f"Applied, {TITLES[flown.job.method]}"
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
        ink = "white" if norm(rate) < DARK_BELOW else INK
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
    for x_m, colour in ((0.0, INK), (10.0, FAINT)):
        panel.plot(
            [x_m, x_m + 10.0],
            [y_m, y_m],
            color=colour,
            lw=4.0,
            solid_capstyle="butt",
            clip_on=False,
        )
    panel.text(21.0, y_m, "20 m", va="center", size=9)
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
