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
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from companion.core.nozzle import flow_for_rate
from missions.maps.build import build_prescription, frame_for
from missions.maps.cells import to_degrees
from missions.maps.model import Floats, MapCells, MapFile, map_error
from missions.maps.text_points import ALTITUDE_MAX_M, ALTITUDE_MIN_M, MAX_POINTS, TextMap

# P2's grid (Rovira-Más et al. 2024, equations 1 to 3): from points with rates to square cells.
#
# Pure: it takes metres east and north and gives cell numbers and values. A cell without a point
# is NaN here, where the paper writes 0: the valves close over both, but only one of them was
# asked for.

Ints = NDArray[np.int64]
Merge = Literal["max", "average", "mean"]
MERGES: tuple[str, ...] = get_args(Merge)

# Points that were laid out in whole cells come back from degrees with an error of nanometres,
# which must not open a new column. Nothing on a field is measured to a millionth of a cell.
_NOISE = 1e-6
M2_PER_HA = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GridLayout:
    """Where the cells lie: `columns` (the paper's H) run east, `rows` (its V) run north."""

    points: int
    cell_m: int
    columns: int
    rows: int
    east_min_m: float
    east_max_m: float
    north_min_m: float
    north_max_m: float

    @property
    def area_ha(self) -> float:
        """Return range east times range north of the points, which is P2's map area."""
        return (
            (self.east_max_m - self.east_min_m) * (self.north_max_m - self.north_min_m) / M2_PER_HA
        )

    @property
    def points_per_ha(self) -> float:
        """Return the density of the map; infinite for points on one line."""
        return self.points / self.area_ha if self.area_ha > 0.0 else math.inf

    @property
    def table_area_ha(self) -> float:
        """Return the area as P2 prints it: 9.206 ha are 9.2 in Table 1, so the rest is cut off."""
        return math.floor(100.0 * self.area_ha) / 100.0

    @property
    def table_points_per_ha(self) -> int | None:
        """Return the density as P2 prints it: 80.5 points/ha are 80 in Table 2."""
        return math.floor(self.points_per_ha) if math.isfinite(self.points_per_ha) else None


def cell_size(east_range_m: float, north_range_m: float, points: int) -> int:
    """Return c of equation 1, in whole metres; its brackets round up, as P2's Table 2 shows.

    c = ceil(sqrt(range east * range north / NP)), at least 1 m

    >>> cell_size(314.2, 293.0, 11243), cell_size(480.3, 595.3, 2302)
    (3, 12)
    """
    if not points > 0:
        raise ValueError("a map needs points")
    return max(1, _ceil(math.sqrt(east_range_m * north_range_m / points)))


def layout_for(
    points: int,
    *,
    east_m: tuple[float, float],
    north_m: tuple[float, float],
    cell_m: int | None = None,
) -> GridLayout:
    """Return the grid over ranges (least, most) east and north; `cell_m` overrules equation 1.

    H = ceil(range east / c), V = ceil(range north / c) (equation 2), each at least 1.

    >>> vineyard = layout_for(11243, east_m=(-167.0, 147.2), north_m=(-181.1, 111.9))
    >>> vineyard.cell_m, vineyard.columns, vineyard.rows
    (3, 105, 98)
    >>> vineyard.table_area_ha, vineyard.table_points_per_ha
    (9.2, 1221)
    """
    ranges = (east_m[1] - east_m[0], north_m[1] - north_m[0])
    if not all(math.isfinite(size) and size >= 0.0 for size in ranges):
        raise ValueError(f"no range of coordinates: {east_m}, {north_m}")
    size_m = cell_size(*ranges, points) if cell_m is None else cell_m
    if not size_m >= 1:
        raise ValueError(f"a cell has at least 1 m: {size_m}")
    columns, rows = (max(1, _ceil(size / size_m)) for size in ranges)
    return GridLayout(
        points=points,
        cell_m=size_m,
        columns=columns,
        rows=rows,
        east_min_m=east_m[0],
        east_max_m=east_m[1],
        north_min_m=north_m[0],
        north_max_m=north_m[1],
    )


def _ceil(value: float) -> int:
    return math.ceil(value - _NOISE)


def cell_numbers(layout: GridLayout, east_m: Floats, north_m: Floats) -> tuple[Ints, Ints]:
    """Return i (column) and j (row) of points inside the ranges, from 1 as in equation 2.

    i = max(1, ceil((E - Emin) / c)): a point on Emin belongs to the first column, a point on any
    other border to the cell west or south of it.

    >>> layout = layout_for(4, east_m=(0.0, 5.0), north_m=(0.0, 5.0))
    >>> [found.tolist() for found in cell_numbers(layout, np.array([0.0, 3.0, 5.0]), np.zeros(3))]
    [[1, 1, 2], [1, 1, 1]]
    """
    return (
        _numbers(east_m - layout.east_min_m, layout.cell_m, layout.columns),
        _numbers(north_m - layout.north_min_m, layout.cell_m, layout.rows),
    )


def _numbers(distance_m: Floats, cell_m: int, count: int) -> Ints:
    found: Ints = np.ceil(distance_m / cell_m - _NOISE).astype(np.int64)
    return np.clip(found, 1, count)


def merged(layout: GridLayout, cells: tuple[Ints, Ints], values: Floats, *, merge: str) -> Floats:
    """Return (rows, columns), the southern row first: what the points in each cell make together.

    max: the largest. average: P2's (R + G) / 2 of the point and what the cell holds so far, where
    a cell that holds 0 counts as empty; it hangs on the order of the points. mean: the true mean.

    >>> layout = layout_for(3, east_m=(0.0, 1.0), north_m=(0.0, 1.0))
    >>> same = (np.ones(3, dtype=np.int64), np.ones(3, dtype=np.int64))
    >>> [merged(layout, same, np.array([4.0, 8.0, 9.0]), merge=how).item() for how in MERGES]
    [9.0, 7.5, 7.0]
    """
    place = (cells[1] - 1) * layout.columns + (cells[0] - 1)
    count = layout.rows * layout.columns
    if merge == "max":
        found = np.full(count, -np.inf)
        np.maximum.at(found, place, values)
        found[np.isneginf(found)] = np.nan
    elif merge == "average":
        found = _running_average(place, values, count)
    elif merge == "mean":
        found = _mean(place, values, count)
    else:
        raise ValueError(f"no way to merge points: {merge!r}")
    return found.reshape(layout.rows, layout.columns)


def _mean(place: Ints, values: Floats, count: int) -> Floats:
    """Return the mean; of values that are all the same, that value to the last bit."""
    least = np.full(count, np.inf)
    most = np.full(count, -np.inf)
    np.minimum.at(least, place, values)
    np.maximum.at(most, place, values)
    points = np.bincount(place, minlength=count)
    with np.errstate(invalid="ignore"):
        found: Floats = np.bincount(place, weights=values, minlength=count) / points
    return np.where(points > 0, np.clip(found, least, most), np.nan)


def _running_average(place: Ints, values: Floats, count: int) -> Floats:
    held: dict[int, float] = {}
    for cell, value in zip(place.tolist(), values.tolist(), strict=True):
        before = held.get(cell, 0.0)
        held[cell] = value if before == 0.0 else (value + before) / 2.0
    found = np.full(count, np.nan)
    found[list(held)] = list(held.values())
    return found


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
