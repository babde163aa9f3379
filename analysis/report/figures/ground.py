"""Maps of the ground, cell by cell: prescribed and applied, deviation, duty; north is up.

As P2's Figs. 10, 15 and 16. Cells are rastered, so that a large field makes no large file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely
from matplotlib.collections import LineCollection

from analysis.report.figures.style import (
    DEVIATION_MAP,
    FAINT,
    INK,
    RATES_MAP,
    WIDTH_IN,
    Drawn,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

    from analysis.assess.cell_maps import CellMaps
    from analysis.flown.applied_flight import AppliedFlight, Floats

# More zones than these would be all outline.
OUTLINES_MAX = 1500
MARGIN_M = 3.0
PANEL_MIN_IN, PANEL_MAX_IN = 1.2, 5.2
# Beside the maps of a sheet: axis labels, and the scale of colours.
BESIDE_IN, BAR_IN = 0.75, 1.1
WIDTH_MIN_IN = 4.0
# A deviation map reaches at least this far, so that a good flight looks good.
# Cells on the border, which get nothing by rule, must not make all others white.
DEVIATION_MIN_PERCENT, DEVIATION_MAX_PERCENT, DEVIATION_PERCENTILE = 20.0, 50.0, 98.0
PATH_POINTS_MAX = 4000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sheet:
    """What all maps of a flight share: extent in metres, outlines, path."""

    flight: AppliedFlight
    cells: CellMaps
    box: tuple[float, float, float, float]
    outlines: tuple[Floats, ...]
    border: tuple[Floats, ...]

    @property
    def is_wide(self) -> bool:
        west, south, east, north = self.box
        return east - west > 1.2 * (north - south)

    def layout(self, count: int) -> tuple[tuple[float, float], int, int]:
        """Return height and width of a figure with so many maps, its rows and its columns."""
        west, south, east, north = self.box
        rows, columns = (count, 1) if self.is_wide else (1, count)
        width_in = (WIDTH_IN - BAR_IN) / columns - BESIDE_IN
        height_in = width_in * (north - south) / max(east - west, 1e-6)
        if height_in > PANEL_MAX_IN:
            width_in, height_in = width_in * PANEL_MAX_IN / height_in, PANEL_MAX_IN
        whole_in = max(BAR_IN + columns * (BESIDE_IN + width_in), WIDTH_MIN_IN)
        return (0.3 + rows * (0.7 + max(height_in, PANEL_MIN_IN)), whole_in), rows, columns


def sheet_of(flight: AppliedFlight, cells: CellMaps) -> _Sheet:
    """Return what the maps of a flight have in common."""
    prescription = flight.setup.prescription
    box = (
        float(cells.corner_east_m.min()) - MARGIN_M,
        float(cells.corner_north_m.min()) - MARGIN_M,
        float(cells.corner_east_m.max()) + MARGIN_M,
        float(cells.corner_north_m.max()) + MARGIN_M,
    )
    seen = shapely.box(*box)
    # Joining cells to zones may take long, and the cells are drawn themselves.
    has_outlines = prescription.cells is None and prescription.zone_count <= OUTLINES_MAX
    outlines = [zone.polygon for zone in prescription.zones] if has_outlines else []
    return _Sheet(
        flight=flight,
        cells=cells,
        box=box,
        outlines=_lines(outlines, seen),
        border=_lines([prescription.field], seen),
    )


def prescribed_and_applied(sheet: _Sheet) -> Drawn:
    """Draw both maps with one scale of colours."""
    asked, given = sheet.cells.commanded_l_ha, sheet.cells.measured_l_ha
    least, most = _rates_shown(asked)
    size_in, rows, columns = sheet.layout(2)
    figure = new_figure(*size_in)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for panel, values, title in zip(panels, (asked, given), ("prescribed", "applied"), strict=True):
        mesh = _mesh(panel, sheet, values, RATES_MAP, least, most)
        _dress(panel, sheet, title, with_path=title == "applied")
    figure.colorbar(mesh, ax=list(panels), label="rate [L/ha]", fraction=0.05, aspect=30)
    return Drawn(
        name="map",
        title="Prescribed and applied",
        caption=f"{_cells_text(sheet.cells)} Dark is little, bright is much; white was not flown "
        "over. The thin line is the path of the vehicle, the black one the border.",
        alt="Two maps of the field with one scale of colours: the prescribed rate of each cell, "
        "and the rate that was applied.",
        kind="map",
        figure=figure,
    )


def _rates_shown(asked: Floats) -> tuple[float, float]:
    """Return the rates at both ends of the scale; from 0 where the least is not far from it."""
    known = asked[np.isfinite(asked) & (asked > 0.0)]
    if not len(known):
        return 0.0, 1.0
    least, most = (float(each) for each in np.percentile(known, [1.0, 99.9]))
    return (least if 0.5 * most < least < most else 0.0), most


def deviation(sheet: _Sheet) -> Drawn:
    """Draw by how much each cell is off its rate."""
    error = sheet.cells.relative_error_percent
    known = np.abs(error[np.isfinite(error)])
    reach = float(np.percentile(known, DEVIATION_PERCENTILE)) if len(known) else 0.0
    reach = math.ceil(reach / 5.0) * 5.0
    reach = min(max(reach, DEVIATION_MIN_PERCENT), DEVIATION_MAX_PERCENT)
    figure, panel = _single(sheet)
    mesh = _mesh(panel, sheet, error, DEVIATION_MAP, -reach, reach)
    _dress(panel, sheet, "deviation")
    bar = figure.colorbar(mesh, ax=panel, fraction=0.05, aspect=30, extend="both")
    bar.set_label("deviation [%]: - too little, + too much")
    return Drawn(
        name="deviation",
        title="Deviation",
        caption=f"{_cells_text(sheet.cells)} White: as prescribed. Grey: not flown over, or "
        "prescribed less than a tenth of the highest rate.",
        alt="Map of the relative deviation of each cell from its prescribed rate, red where too "
        "little was applied and blue where too much.",
        kind="map",
        figure=figure,
    )


def duty(sheet: _Sheet) -> Drawn:
    """Draw the duty that the valves had over each cell."""
    figure, panel = _single(sheet)
    mesh = _mesh(panel, sheet, 100.0 * sheet.cells.duty, RATES_MAP, 0.0, 100.0)
    _dress(panel, sheet, "duty")
    figure.colorbar(mesh, ax=panel, label="duty [%]", fraction=0.05, aspect=30)
    return Drawn(
        name="duty",
        title="Duty of the valves",
        caption=f"{_cells_text(sheet.cells)} Mean of the orders in force.",
        alt="Map of the mean duty of the valves over each cell.",
        kind="map",
        figure=figure,
    )


def _cells_text(cells: CellMaps) -> str:
    whose = "the map's own cells" if cells.source == "map" else "square cells"
    return f"Mean of {whose} of {cells.cell_m:.2g} m."


def _single(sheet: _Sheet) -> tuple[Figure, Axes]:
    size_in, _, _ = sheet.layout(1)
    figure = new_figure(*size_in)
    return figure, figure.subplots()


def _mesh(
    panel: Axes, sheet: _Sheet, values: Floats, colours: str, low: float, high: float
) -> QuadMesh:
    return panel.pcolormesh(
        sheet.cells.corner_east_m,
        sheet.cells.corner_north_m,
        np.ma.masked_invalid(values),
        cmap=colours,
        vmin=low,
        vmax=high,
        rasterized=True,
    )


def _dress(panel: Axes, sheet: _Sheet, title: str, *, with_path: bool = False) -> None:
    west, south, east, north = sheet.box
    if title.startswith("deviation"):
        panel.set_facecolor("#D9D9D9")
    panel.add_collection(LineCollection(sheet.outlines, colors=FAINT, lw=0.4, rasterized=True))
    panel.add_collection(LineCollection(sheet.border, colors=INK, lw=1.0))
    if with_path and len(sheet.flight.time_s):
        every = max(1, len(sheet.flight.time_s) // PATH_POINTS_MAX)
        panel.plot(
            sheet.flight.east_m[::every], sheet.flight.north_m[::every],
            color="white", lw=0.5, alpha=0.8, rasterized=True,
        )  # fmt: skip
    panel.set_xlim(west, east)
    panel.set_ylim(south, north)
    panel.set_aspect("equal")
    panel.locator_params(nbins=6)
    panel.set_title(title)
    panel.set_xlabel("east [m]")
    panel.set_ylabel("north [m]")
    panel.label_outer()
    _scale_and_north(panel, east - west)


def _scale_and_north(panel: Axes, width_m: float) -> None:
    """Draw a scale above the map's right corner, and say where north is."""
    length_m = scale_m(width_m)
    share = length_m / width_m
    where = panel.transAxes
    panel.plot([1.0 - share, 1.0], [1.03, 1.03], color=INK, lw=2.0, transform=where, clip_on=False)
    panel.text(
        1.0 - share - 0.01, 1.03, f"{length_m:g} m  N \u2191", transform=where,
        ha="right", va="center", size=8.5,
    )  # fmt: skip


def scale_m(width_m: float) -> float:
    """Return a round length, about a fifth of a width.

    >>> scale_m(126.0), scale_m(48.0), scale_m(900.0)
    (20.0, 5.0, 100.0)
    """
    wanted = width_m / 5.0
    power = 10.0 ** math.floor(math.log10(wanted))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= wanted)


def _lines(
    areas: list[shapely.Polygon | shapely.MultiPolygon], seen: shapely.Polygon
) -> tuple[Floats, ...]:
    """Return the rings of areas that come into view, as arrays of places."""
    near = [area for area in areas if area.intersects(seen)]
    rings = shapely.get_rings(near) if near else np.empty(0, dtype=object)
    return tuple(shapely.get_coordinates(ring) for ring in rings)
