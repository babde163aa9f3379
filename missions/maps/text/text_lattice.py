"""From any map to the points of P2's open text map, laid so that P2's grid gives the cells back.

P2's grid hangs on nothing but the points: its corner is the least east and north among them, its
cell size follows from their number (equation 1), its rows and columns from their ranges. Points
in the middles of cells alone would lose half a cell on each side, and with it a row and a column.
So beside the middle of every cell that has a rate there are a point on the western edge of the
grid and one on its southern edge; and where most of the rectangle has no rate, more points in the
cells that do, until equation 1 gives the size that is wanted. Where no number of points gives it
(a few large cells), the cells are cut into smaller ones of the same rate.

Points lie in a cell's middle or a quarter of it away, so that the small turn of the map between
its own origin and the reader's (its first point, and so the middlemost here) moves none across.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.core.nozzle import flow_for_rate
from missions.maps.build import build_prescription, frame_for
from missions.maps.cells import to_degrees
from missions.maps.model import Floats, MapCells, MapFile, map_error
from missions.maps.text.point_grid import cell_size
from missions.maps.text.text_points import ALTITUDE_MAX_M, ALTITUDE_MIN_M, MAX_POINTS, TextMap

# Unless the operator gives a spacing, it is the least with which the map has at most so many
# cells: 1 m up to 25 ha, 2 m up to 100 ha; 10 MB of text.
CELLS_WANTED = 250_000
# A map in cells keeps its own if they deviate from squares along east and north by at most this
# much of one.
DEVIATION_MAX = 0.1
_EARTH_RADIUS_M = 6_371_000.0
_QUARTERS = np.array([(0.25, 0.25), (-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25)])

# From fractional column and row to longitude and latitude.
Place = Callable[[Floats, Floats], tuple[Floats, Floats]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """Square cells along east and north: rates [L/ha], the southern row first, and their place."""

    rates_l_ha: Floats
    cell_m: int
    place: Place
    altitude_m: float = 0.0


def text_map_of(
    map_file: MapFile,
    *,
    width_m: float,
    speed_m_s: float,
    spacing_m: int | None = None,
    overlap: str = "error",
) -> TextMap:
    """Return a map as points in L/min, for a sprayer of this width at this speed.

    A map whose cells are squares of whole metres along east and north keeps them, rates and all.
    Any other is looked up in the middles of cells of `spacing_m`: its rates stay, its borders
    move to the next edge of a cell.
    """
    if not (0.0 < width_m < 1e4 and 0.0 < speed_m_s < 1e4):
        raise ValueError(f"no width and speed: {width_m} m, {speed_m_s} m/s")
    if spacing_m is not None and not spacing_m >= 1:
        raise ValueError(f"spacing of a text map is whole metres: {spacing_m}")
    lattice = _own_cells(map_file) if spacing_m is None else None
    if lattice is None:
        lattice = _looked_up(map_file, spacing_m, overlap)
    column, row, rate_l_ha = _points(lattice, map_file)
    longitude, latitude = lattice.place(column, row)
    return TextMap(
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=np.full(len(column), lattice.altitude_m),
        rate_l_min=flow_for_rate(1.0, speed_m_s, width_m) * rate_l_ha,
    )


def _own_cells(map_file: MapFile) -> Lattice | None:
    """Return the map's own cells where they are whole metres along east and north."""
    cells = map_file.cells
    if cells is None or map_file.boundary is not None:
        return None  # a boundary cuts through cells
    rows, columns = cells.rates_l_ha.shape
    place = _place_in(cells)
    column, row = np.array([0.0, columns, 0, columns]), np.array([0.0, 0, rows, rows])
    longitude, latitude = place(column, row)
    east, north = frame_for(map_file).to_local_all(latitude.tolist(), longitude.tolist())
    along = math.hypot(east[1] - east[0], north[1] - north[0]) / columns
    up = math.hypot(east[2] - east[0], north[2] - north[0]) / rows
    size_m = math.sqrt(along * up)
    cell_m = round(size_m)
    if not cell_m >= 1:
        return None
    # P2's plane is stretched by its points' altitude; a map read from one shows by how much.
    altitude_m = (cell_m / size_m - 1.0) * _EARTH_RADIUS_M
    if not (ALTITUDE_MIN_M < altitude_m < ALTITUDE_MAX_M and abs(altitude_m) > 1.0):
        altitude_m = 0.0
    stretch = 1.0 + altitude_m / _EARTH_RADIUS_M
    off = np.concatenate(
        [
            values * stretch - values.mean() * stretch - cell_m * (count - count.mean())
            for values, count in ((east, column), (north, row))
        ]
    )
    if not np.abs(off).max() <= DEVIATION_MAX * cell_m:
        return None
    rates = cells.rates_l_ha[::-1] if _first_row_north(cells) else cells.rates_l_ha
    return Lattice(rates_l_ha=rates, cell_m=cell_m, place=place, altitude_m=altitude_m)


def _first_row_north(cells: MapCells) -> bool:
    a, b, _, d, e, _ = cells.transform
    return a * e - b * d < 0.0


def _place_in(cells: MapCells) -> Place:
    rows = len(cells.rates_l_ha)
    flipped = _first_row_north(cells)
    return lambda column, row: to_degrees(cells, column, rows - row if flipped else row)


def _looked_up(map_file: MapFile, spacing_m: int | None, overlap: str) -> Lattice:
    """Return cells over the field, each with the rate in its middle."""
    frame = frame_for(map_file)
    prescription = build_prescription(map_file, frame, overlap=overlap)
    west, south, east, north = prescription.bounds_m
    width_m, height_m = east - west, north - south
    cell_m = spacing_m or _least_spacing(width_m, height_m)
    columns, rows = max(1, math.ceil(width_m / cell_m)), max(1, math.ceil(height_m / cell_m))
    if not columns * rows <= MAX_POINTS:
        raise _too_many(map_file, columns * rows)
    column, row = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    rates = prescription.rates_at(
        west + cell_m * column.ravel(), south + cell_m * row.ravel()
    ).reshape(rows, columns)

    def place(column: Floats, row: Floats) -> tuple[Floats, Floats]:
        latitude, longitude = frame.to_geographic_all(
            (west + cell_m * column).tolist(), (south + cell_m * row).tolist()
        )
        return np.array(longitude), np.array(latitude)

    return Lattice(rates_l_ha=rates, cell_m=cell_m, place=place)


def _least_spacing(width_m: float, height_m: float) -> int:
    cell_m = max(1, math.floor(math.sqrt(width_m * height_m / CELLS_WANTED)))
    while math.ceil(width_m / cell_m) * math.ceil(height_m / cell_m) > CELLS_WANTED:
        cell_m += 1
    return cell_m


def _points(lattice: Lattice, map_file: MapFile) -> tuple[Floats, Floats, Floats]:
    """Return column, row (of the lattice) and rate of all points, the middlemost first."""
    rated = ~np.isnan(lattice.rates_l_ha)
    if not rated.any():
        raise map_error(
            map_file.path,
            f"no cell of {lattice.cell_m} m has a rate in its middle",
            fix="take a smaller spacing",
            code="null-rate",
        )
    first_row, last_row = np.flatnonzero(rated.any(axis=1))[[0, -1]].tolist()
    first_column, last_column = np.flatnonzero(rated.any(axis=0))[[0, -1]].tolist()
    rates = lattice.rates_l_ha[first_row : last_row + 1, first_column : last_column + 1]
    for parts in range(1, lattice.cell_m + 1):
        if lattice.cell_m % parts:
            continue
        if not rates.size * parts**2 <= MAX_POINTS:
            break
        finer: Floats = np.repeat(np.repeat(rates, parts, axis=0), parts, axis=1)
        found = _laid(finer, lattice.cell_m // parts)
        if found is not None and len(found[2]) <= MAX_POINTS:
            column, row, rate = found
            return column / parts + first_column, row / parts + first_row, rate
    raise _too_many(map_file, rates.size)


def _laid(rates: Floats, cell_m: int) -> tuple[Floats, Floats, Floats] | None:
    """Return points of which equations 1 and 2 make these cells, or None where there are none."""
    rows, columns = np.nonzero(~np.isnan(rates))
    middle = np.argmin(
        np.hypot(columns + 0.5 - rates.shape[1] / 2, rows + 0.5 - rates.shape[0] / 2)
    )
    order = np.argsort(np.arange(len(rows)) != middle, kind="stable")
    rows, columns = rows[order], columns[order]
    west, south = int(np.argmin(columns)), int(np.argmin(rows))
    which = np.concatenate([np.arange(len(rows)), [west, south]])
    across = np.concatenate([columns + 0.5, [columns[west], columns[south] + 0.5]])
    up = np.concatenate([rows + 0.5, [rows[west] + 0.5, rows[south]]])
    # Further points reach a quarter of a cell beyond the middles, and equation 1 asks for more of
    # them then; a thousandth more is against the rounding of degrees.
    wanted = 1.001 * (np.ptp(across) + 0.25) * (np.ptp(up) + 0.25)
    missing = np.arange(max(0, math.ceil(wanted) - len(which)))
    again = missing % len(rows)
    shift = _QUARTERS[missing // len(rows) % len(_QUARTERS)]
    which = np.concatenate([which, again])
    across = np.concatenate([across, columns[again] + 0.5 + shift[:, 0]])
    up = np.concatenate([up, rows[again] + 0.5 + shift[:, 1]])
    wide_m, high_m = cell_m * float(np.ptp(across)), cell_m * float(np.ptp(up))
    if cell_size(wide_m, high_m, len(which)) != cell_m:
        return None
    return across, up, rates[rows, columns][which]


def _too_many(map_file: MapFile, count: int) -> Exception:
    return map_error(
        map_file.path,
        f"{count} cells are more than the {MAX_POINTS} points that a text map may have",
        fix="take a larger spacing, or cut the map to one field",
        code="too-large",
    )
