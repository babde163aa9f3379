"""What all maps of a flight share: a sheet with panels of one extent, outlines, scale and north."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely
from matplotlib.collections import LineCollection
from matplotlib.transforms import ScaledTranslation

from analysis.report.figures.style import INK, WIDTH_IN, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Affine2DBase

    from analysis.assess.cell_maps import CellMaps
    from analysis.flown.applied_flight import AppliedFlight, Floats

# More zones than these would be all outline.
OUTLINES_MAX = 1500
MARGIN_M = 3.0
PANEL_MIN_IN, PANEL_MAX_IN = 1.6, 5.6
# Around the maps of a sheet, in inches: names of the axes, title and scale above each map, and on
# the right the scale of colours.
LEFT_IN, BELOW_IN, ABOVE_IN, GAP_IN = 0.75, 0.55, 0.45, 0.25
BAR_GAP_IN, BAR_IN, BAR_TEXT_IN = 0.2, 0.16, 0.75
BAR_MAX_IN = 3.0
PATH_POINTS_MAX = 4000
NOTHING_COLOUR = "#D9D9D9"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """What all maps of a flight share: extent in metres, outlines, path."""

    flight: AppliedFlight
    cells: CellMaps
    box: tuple[float, float, float, float]
    outlines: tuple[Floats, ...]
    border: tuple[Floats, ...]

    @property
    def is_wide(self) -> bool:
        """Return whether maps stand one above the other."""
        west, south, east, north = self.box
        return east - west > 1.2 * (north - south)

    def panels(self, count: int, *, has_bar: bool = True) -> tuple[Figure, list[Axes], Axes | None]:
        """Return a figure with so many maps, and with room for a scale of colours."""
        west, south, east, north = self.box
        rows, columns = (count, 1) if self.is_wide else (1, count)
        beside_in = BAR_GAP_IN + BAR_IN + BAR_TEXT_IN if has_bar else GAP_IN
        free_in = WIDTH_IN - LEFT_IN - beside_in - (columns - 1) * GAP_IN
        per_m = min(free_in / columns / (east - west), PANEL_MAX_IN / (north - south))
        wide_in, high_in = per_m * (east - west), max(per_m * (north - south), PANEL_MIN_IN)
        wide_in = max(wide_in, PANEL_MIN_IN)
        right_in = LEFT_IN + columns * wide_in + (columns - 1) * GAP_IN
        width_in = right_in + beside_in
        height_in = BELOW_IN + rows * (high_in + ABOVE_IN)
        figure = new_figure(height_in, width_in)

        def axes(left: float, bottom: float, wide: float, high: float) -> Axes:
            return figure.add_axes(
                (left / width_in, bottom / height_in, wide / width_in, high / height_in)
            )

        maps = [
            axes(
                LEFT_IN + column * (wide_in + GAP_IN),
                BELOW_IN + (rows - 1 - row) * (high_in + ABOVE_IN),
                wide_in,
                high_in,
            )
            for row in range(rows)
            for column in range(columns)
        ]
        bar_in = min(BAR_MAX_IN, height_in - BELOW_IN - ABOVE_IN)
        bar = axes(right_in + BAR_GAP_IN, BELOW_IN, BAR_IN, bar_in) if has_bar else None
        return figure, maps, bar


def sheet_of(flight: AppliedFlight, cells: CellMaps) -> Sheet:
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
    return Sheet(
        flight=flight,
        cells=cells,
        box=box,
        outlines=_lines(outlines, seen),
        border=_lines([prescription.field], seen),
    )


def dress(panel: Axes, sheet: Sheet, title: str, *, with_path: bool = False) -> None:
    """Draw zones, border, axes, scale and north around a map, and the vehicle's path over it."""
    west, south, east, north = sheet.box
    if title.startswith("deviation"):
        panel.set_facecolor(NOTHING_COLOUR)
    panel.add_collection(
        LineCollection(sheet.outlines, colors=INK, lw=0.35, alpha=0.6, rasterized=True)
    )
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
    panel.set_title(title, pad=8)
    panel.set_xlabel("east [m]")
    panel.set_ylabel("north [m]")
    _scale_and_north(panel, east - west)


def _scale_and_north(panel: Axes, width_m: float) -> None:
    """Draw a scale above the map's right corner, and say where north is."""
    length_m = scale_m(width_m)
    share = length_m / width_m
    above = panel.get_xaxis_transform() + ScaledTranslation(0.0, 8 / 72, _inches(panel))
    east_m = panel.get_xlim()[1]
    west_m = east_m - length_m
    panel.plot([west_m, east_m], [1.0, 1.0], color=INK, lw=2.5, transform=above, clip_on=False)
    panel.text(
        east_m - (share + 0.02) * width_m, 1.0, f"N \u2191  {length_m:g} m", transform=above,
        ha="right", va="center", size=9.5,
    )  # fmt: skip


def _inches(panel: Axes) -> Affine2DBase:
    figure = panel.get_figure(root=True)
    assert figure is not None
    return figure.dpi_scale_trans


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
