"""The ground of a picture: zones and cells in the colours of their rates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PathCollection
from matplotlib.colors import Normalize
from matplotlib.path import Path as Outline
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from companion.core.frame import LocalFrame
from companion.errors import MapError
from companion.map_pictures import RATES_MAP, rate_ends
from missions.maps.cells import to_degrees
from missions.maps.convert.cell_zones import zones_of
from missions.maps.local import project, project_all
from missions.maps.model import Floats, MapCells, MapFile, MapZone
from missions.maps.totals import M2_PER_HA

Objects = NDArray[np.object_]
Colour = tuple[float, float, float, float]

# More rates than these are a scale of colours, not a list.
LISTED_MAX = 12
LABELS_MAX = 80
_LABEL_PT = 11.0
_ZERO: Colour = (1.0, 1.0, 1.0, 1.0)
BARE, HATCH, LINE = "0.95", "0.6", "0.2"
_BENEATH, _RATED, _OUTLINE, _LABEL = 0.5, 1.0, 2.0, 3.0
# Parts of a boundary without a rate below this share are the rounding of its edges.
_BARE_SHARE = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class Colours:
    """A colour for every rate, as on all pictures of the map; 0 is white."""

    rates_l_ha: Floats

    @classmethod
    def of(cls, rates_l_ha: Floats) -> Colours:
        """Return the colours for rates that rise."""
        return cls(rates_l_ha=rates_l_ha[rates_l_ha > 0.0])

    @property
    def are_listed(self) -> bool:
        """Whether each rate has its own line in the legend."""
        return len(self.rates_l_ha) <= LISTED_MAX

    @property
    def scale(self) -> ScalarMappable:
        """Return the scale."""
        return ScalarMappable(Normalize(*rate_ends(self.rates_l_ha.tolist())), RATES_MAP)

    def __call__(self, rates_l_ha: Floats) -> Floats:
        """Return red, green, blue and opacity for each rate; NaN is seen through."""
        rates = np.asarray(rates_l_ha, dtype=np.float64)
        result = np.zeros((*rates.shape, 4), dtype=np.float64)
        result[rates == 0.0] = _ZERO
        sprayed = rates > 0.0
        result[sprayed] = self.scale.to_rgba(rates[sprayed])
        return result


def draw_ground(
    axes: Axes,
    map_file: MapFile,
    frame: LocalFrame,
    colours: Colours,
    *,
    metres_per_inch: float,
    rated_ha: float,
) -> bool:
    """Draw zones or cells and the boundary; return whether there is ground without a rate."""
    bare = any(zone.rate_l_ha is None for zone in map_file.zones)
    outline = None if map_file.boundary is None else project(map_file.boundary, frame)
    if outline is not None:
        _hatched(axes, [outline], edge="none")
        bare = bare or not M2_PER_HA * rated_ha >= (1.0 - _BARE_SHARE) * outline.area
    if map_file.cells is not None:
        _draw_cells(axes, map_file.cells, frame, colours)
        _draw_zero(axes, map_file.cells, frame)
        labelled = _zones_for_labels(map_file, colours)
    else:
        _draw_zones(axes, map_file.zones, frame, colours)
        labelled = list(map_file.zones)
    if outline is not None:
        axes.add_collection(
            PathCollection(
                [outline_of(outline)], facecolors="none", edgecolors="black", linewidths=1.6,
                linestyles="--",
                zorder=_OUTLINE,
            ),
            autolim=False,
        )  # fmt: skip
    _draw_labels(axes, labelled, frame, colours, metres_per_inch=metres_per_inch)
    return bare


def outline_of(area: shapely.Polygon | shapely.MultiPolygon) -> Outline:
    """Return a polygon with its holes as one path."""
    # The filled ground is where a path turns, so holes have to turn the other way.
    rings = shapely.get_rings(shapely.get_parts(shapely.orient_polygons(area)))
    points, ring = shapely.get_coordinates(rings, return_index=True)
    codes = np.full(len(points), Outline.LINETO, dtype=Outline.code_type)
    first = np.flatnonzero(np.diff(ring, prepend=-1))
    codes[first] = Outline.MOVETO
    codes[np.append(first[1:], len(points)) - 1] = Outline.CLOSEPOLY
    return Outline(points, codes)


def _hatched(axes: Axes, areas: Sequence[shapely.Geometry], *, edge: str) -> None:
    paths = [outline_of(area) for area in areas]  # type: ignore[arg-type]
    axes.add_collection(
        PathCollection(
            paths, facecolors=BARE, edgecolors=HATCH, hatch="///", linewidths=0.0, zorder=_BENEATH
        ),
        autolim=False,
    )
    if edge != "none":
        axes.add_collection(
            PathCollection(
                paths, facecolors="none", edgecolors=edge, linewidths=0.6, zorder=_BENEATH
            ),
            autolim=False,
        )


def _draw_zones(axes: Axes, zones: Sequence[MapZone], frame: LocalFrame, colours: Colours) -> None:
    """Draw zones in the order of the map, those without a rate beneath the others."""
    local = project_all(np.array([zone.geometry for zone in zones], dtype=object), frame)
    bare = [area for area, zone in zip(local, zones, strict=True) if zone.rate_l_ha is None]
    if bare:
        _hatched(axes, bare, edge=LINE)
    rated = [(area, zone.rate_l_ha) for area, zone in zip(local, zones, strict=True)
             if zone.rate_l_ha is not None]  # fmt: skip
    if not rated:
        return
    line = 0.7 if shapely.get_num_coordinates(local).sum() < 20_000 else 0.15
    axes.add_collection(
        PathCollection(
            [outline_of(area) for area, _ in rated],
            facecolors=colours(np.array([rate for _, rate in rated])),
            edgecolors=LINE,
            linewidths=line,
            zorder=_RATED,
        ),
        autolim=False,
    )


def _draw_cells(axes: Axes, cells: MapCells, frame: LocalFrame, colours: Colours) -> None:
    """Draw cells as an image laid on the ground: rows are straight to within centimetres."""
    rows, columns = cells.rates_l_ha.shape
    column = np.array([0.0, columns, columns, 0.0, columns / 2])
    row = np.array([0.0, 0.0, rows, rows, rows / 2])
    longitude, latitude = to_degrees(cells, column, row)
    east, north = frame.to_local_all(latitude.tolist(), longitude.tolist())
    matrix = np.column_stack([column, row, np.ones(5)])
    (a, c), (b, d), (e, f) = np.linalg.lstsq(matrix, np.column_stack([east, north]), rcond=None)[0]
    image = (255.0 * colours(cells.rates_l_ha) + 0.5).astype(np.uint8)
    axes.imshow(
        image,
        extent=(0.0, columns, 0.0, rows),
        origin="lower",
        interpolation="nearest",
        aspect="auto",
        transform=Affine2D.from_values(a, c, b, d, e, f) + axes.transData,
        zorder=_RATED,
    )


def _draw_zero(axes: Axes, cells: MapCells, frame: LocalFrame) -> None:
    """Draw lines around cells of rate 0, which are as white as the paper."""
    zero = np.where(cells.rates_l_ha == 0.0, 0.0, np.nan)
    try:
        zones = zones_of(replace(cells, rates_l_ha=zero))
    except MapError:  # too speckled: the lines would hide all else
        return
    axes.add_collection(
        PathCollection(
            [outline_of(project(zone.geometry, frame)) for zone in zones],
            facecolors="none",
            edgecolors=LINE,
            linewidths=0.5,
            zorder=_RATED,
        ),
        autolim=False,
    )


def _zones_for_labels(map_file: MapFile, colours: Colours) -> list[MapZone]:
    """Return cells joined to zones where that is worth a label."""
    if map_file.cells is None or not colours.are_listed:
        return []
    try:
        return zones_of(map_file.cells, path=map_file.path)
    except MapError:  # too speckled for zones, and so for labels
        return []


def _draw_labels(
    axes: Axes,
    zones: Sequence[MapZone],
    frame: LocalFrame,
    colours: Colours,
    *,
    metres_per_inch: float,
) -> None:
    """Write the rate into the parts that have room for it, the largest first."""
    rated = [zone for zone in zones if zone.rate_l_ha is not None]
    if not rated:
        return
    local = project_all(np.array([zone.geometry for zone in rated], dtype=object), frame)
    parts, owner = shapely.get_parts(local, return_index=True)
    for index in np.argsort(-shapely.area(parts))[:LABELS_MAX].tolist():
        rate = rated[owner[index]].rate_l_ha
        if rate is None:
            continue
        text = f"{rate:.6g}"
        # A letter is some 0.65 of its size wide; the label lies in a circle without an edge.
        radius_m = _LABEL_PT / 72.0 * metres_per_inch * np.hypot(0.65 * len(text), 1.0) / 2
        place = _room_for(parts[index], radius_m)
        if place is None:
            continue
        red, green, blue, _ = colours(np.array([rate]))[0].tolist()
        dark = 0.3 * red + 0.59 * green + 0.11 * blue < 0.5
        axes.text(
            *place, text, ha="center", va="center", fontsize=_LABEL_PT,
            color="white" if dark else "black",
            zorder=_LABEL,
        )  # fmt: skip


def _room_for(part: shapely.Polygon, radius_m: float) -> tuple[float, float] | None:
    """Return the middle of a part, or of its widest place, where a circle fits around it."""
    middle = part.centroid
    if part.contains(middle) and shapely.boundary(part).distance(middle) >= radius_m:
        return middle.x, middle.y
    circle = shapely.maximum_inscribed_circle(part, tolerance=radius_m / 4)
    (x, y), _ = circle.coords
    return (x, y) if circle.length >= radius_m else None
