"""How the figures look, and how they become files: letters, colours, PNG, SVG for a page.

What all maps of a flight share: a sheet with panels of one extent, outlines, scale and north.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from companion.map_pictures import draw_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Affine2DBase

    from analysis.assess.cell_maps import CellMaps
    from analysis.flown.applied_flight import AppliedFlight, Floats

INK, QUIET, FAINT, GRID = "#222222", "#555555", "#8A8A8A", "#E4E4E4"
# Okabe and Ito's colours, told apart by all kinds of eyes.
BLUE, ORANGE, GREEN, RED, PURPLE, YELLOW, SKY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#F0E442", "#56B4E9",
)  # fmt: skip
# Red is too little, blue too much, and darker is further off.
DEVIATION_MAP = "RdBu"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 11.0,
    # Where it is in any case: else every label is measured once more for each file.
    "axes.titley": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    # Letters stay letters: small files, and text that can be searched and read out.
    "svg.fonttype": "none",
    # The same flight gives the same file.
    "svg.hashsalt": "vrspray",
}
DPI = 120
WIDTH_IN = 9.0
MARGINS_IN = (0.85, 0.25, 0.6, 0.4)
# A third of the time for a tenth more of bytes.
PNG: dict[str, Any] = {"compress_level": 3}
# Nothing of the program, the day or the network in an SVG.
_NO_METADATA = {"Creator": None, "Date": None, "Format": None, "Type": None}

Kind = Literal["chart", "map"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawn:
    """A figure with what is said of it; a chart stands in the page as SVG, a map as PNG."""

    name: str
    title: str
    caption: str
    alt: str
    kind: Kind
    figure: Figure

    @property
    def width(self) -> float:
        """Return its share of the page's width."""
        return min(float(self.figure.get_figwidth()) / WIDTH_IN, 1.0)


def stamp(figure: Figure, mark: str) -> None:
    """Write a mark into the upper right corner: a figure travels without its page."""
    if mark:
        figure.text(0.995, 0.995, mark, ha="right", va="top", size=9, weight="bold", color=RED)


@contextmanager
def styled() -> Iterator[None]:
    """Draw in this style, and leave no setting behind."""
    with mpl.rc_context(STYLE):
        yield


def new_figure(
    height_in: float,
    width_in: float = WIDTH_IN,
    *,
    margins_in: tuple[float, float, float, float] = MARGINS_IN,
) -> Figure:
    """Return an empty figure; no window and no state that outlives it.

    Margins are left, right, bottom and top, in inches: to have matplotlib seek them costs as much
    as to draw the figure.
    """
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasAgg(figure)
    left, right, bottom, top = margins_in
    figure.subplots_adjust(
        left=left / width_in,
        right=1.0 - right / width_in,
        bottom=bottom / height_in,
        top=1.0 - top / height_in,
    )
    return figure


def png_of(drawn: Drawn) -> bytes:
    """Return a figure as PNG."""
    file = io.BytesIO()
    drawn.figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None}, pil_kwargs=PNG)
    return file.getvalue()


def svg_of(drawn: Drawn) -> str:
    """Return a figure as an SVG document."""
    file = io.StringIO()
    drawn.figure.savefig(file, format="svg", dpi=DPI, metadata=_NO_METADATA)
    return file.getvalue()


def inline_svg(drawn: Drawn, document: str) -> str:
    """Return an SVG document as a part of a page: no prologue, names of its own, an alt text.

    Every document of matplotlib calls its parts the same; in one page they would be mixed up.
    """
    body = document[document.index("<svg") :]
    body = re.sub(r'\bid="', f'id="{drawn.name}-', body)
    body = re.sub(r"url\(#", f"url(#{drawn.name}-", body)
    body = re.sub(r'(?:xlink:)?href="#', f'href="#{drawn.name}-', body)
    body = body.replace("xlink:href=", "href=")
    # Their style is meant for their own parts, and would be the page's.
    body = re.sub(r"<style[^>]*>\*\{", f"<style>#{drawn.name}-figure_1 *{{", body)
    body = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", body)
    head, tail = body.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{_attribute(drawn.alt)}">{tail}'


def _attribute(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")


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
    draw_above(panel, panel.get_xaxis_transform() + ScaledTranslation(0, 8 / 72, _inches(panel)))


def _inches(panel: Axes) -> Affine2DBase:
    figure = panel.get_figure(root=True)
    assert figure is not None
    return figure.dpi_scale_trans


def _lines(
    areas: list[shapely.Polygon | shapely.MultiPolygon], seen: shapely.Polygon
) -> tuple[Floats, ...]:
    """Return the rings of areas that come into view, as arrays of places."""
    near = [area for area in areas if area.intersects(seen)]
    rings = shapely.get_rings(near) if near else np.empty(0, dtype=object)
    return tuple(shapely.get_coordinates(ring) for ring in rings)
