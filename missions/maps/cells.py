"""Rows and columns of a map, from the coordinates of its file to metres of the flight's frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from shapely import MultiPolygon

from companion.core.cells import DEGREE_MAX, NO_RATE, CellGrid, Warp, monomials
from companion.core.frame import LocalFrame
from companion.errors import MapError
from missions.maps.crs import (
    METRES_PER_DEGREE,
    SEGMENT_M,
    WGS84,
    Objects,
    check_extent,
    densified,
    is_wgs84,
)
from missions.maps.model import Affine, MapCells, map_error

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Lattice on which the polynomials are fitted, and what they may leave between its points.
FIT_SIDE = 14
FIT_MAX_M = 1e-7
USABLE_MAX_M = 1e-3
# Edges of cells this near to a line are straight.
STRAIGHT_M = 0.01
# Cells smaller than this are below what any receiver can tell apart.
CELL_MIN_M = 0.05
BLOCK_CELLS = 200_000
# A share of a cell below what rounding leaves where thousands of edges add up.
SHARE_ZERO = 1e-9


def corner(transform: Affine, column: Floats, row: Floats) -> tuple[Floats, Floats]:
    """Return x and y of corners of cells.

    >>> [float(v[0]) for v in corner((2.0, 0.0, 10.0, 0.0, -2.0, 50.0), np.ones(1), np.ones(1))]
    [12.0, 48.0]
    """
    a, b, c, d, e, f = transform
    return a * column + b * row + c, d * column + e * row + f


def to_degrees(cells: MapCells, column: Floats, row: Floats) -> tuple[Floats, Floats]:
    """Return longitude and latitude of corners of cells; infinite where there are none."""
    x, y = corner(cells.transform, column, row)
    if is_wgs84(cells.crs):
        return x, y
    return _transformer(cells.crs, WGS84).transform(x, y)


def bounds_deg(cells: MapCells) -> tuple[float, float, float, float]:
    """Return west, south, east, north of the corners all round [deg]."""
    rows, columns = cells.rates_l_ha.shape
    across, up = np.linspace(0.0, columns, 33), np.linspace(0.0, rows, 33)
    column = np.concatenate([across, across, np.zeros(33), np.full(33, float(columns))])
    row = np.concatenate([np.zeros(33), np.full(33, float(rows)), up, up])
    longitude, latitude = to_degrees(cells, column, row)
    return (
        float(longitude.min()),
        float(latitude.min()),
        float(longitude.max()),
        float(latitude.max()),
    )


def check_place(cells: MapCells, path: Path) -> None:
    """Refuse cells that are not on Earth, or reach too far."""
    try:
        west, south, east, north = bounds_deg(cells)
    except ProjError as error:
        raise map_error(
            path, f"its CRS cannot be used ({str(error)[:120]})", fix="give it with --crs",
            code="wrong-crs",
        ) from None  # fmt: skip
    if not (west >= -180.0 and east <= 180.0 and south >= -90.0 and north <= 90.0):
        raise _nowhere(cells, path, (west, south, east, north))
    check_extent((west, south, east, north), path)


def _nowhere(cells: MapCells, path: Path, box: tuple[float, float, float, float]) -> MapError:
    """Return the refusal of cells that are not on Earth, with the likely reason."""
    west, south, east, north = box
    fix, code = "give the right CRS with --crs", "out-of-range"
    if cells.crs.is_geographic and max(abs(south), abs(north)) <= 90.0:
        fix = "split the map where it crosses the 180th meridian"
    elif cells.crs.is_geographic and max(abs(south), abs(north)) <= 180.0:
        fix = "longitude and latitude look exchanged: export the map with longitude first"
        code = "swapped-axes"
    elif cells.crs.is_geographic:
        fix, code = "give with --crs the projection that it was made in", "wrong-crs"
    return map_error(
        path,
        f"its cells (x {west:.6g} to {east:.6g}, y {south:.6g} to {north:.6g}) are not on Earth",
        fix=fix,
        code=code,
    )


def grid_of(cells: MapCells, frame: LocalFrame, path: Path) -> CellGrid:
    """Return the cells in the flight's frame."""
    rates, kinds = _classes(cells)
    flipped = turns_clockwise(cells)
    if flipped:
        kinds = kinds[::-1]
    to_frame, to_cells = _fitted(cells, frame, path, flipped=flipped)
    return CellGrid(kinds, rates, to_frame, to_cells)


def cells_of(grid: CellGrid, frame: LocalFrame) -> MapCells | None:
    """Return cells of a flight as a map has them, None where no CRS has their edges straight."""
    rows, columns = grid.classes.shape
    side = np.linspace(0.0, 1.0, FIT_SIDE)
    column, row = (one.ravel() for one in np.meshgrid(columns * side, rows * side))
    # Rows run south in most files, and north in a flight.
    east, north = grid.to_frame(column, rows - row)
    latitude, longitude = frame.to_geographic_all(east.tolist(), north.tolist())
    matrix = np.column_stack([column, row, np.ones_like(row)])
    for crs, unit_m, x, y in (
        (frame.crs, 1.0, east, north),
        (WGS84, METRES_PER_DEGREE, longitude, latitude),
    ):
        known = np.column_stack([x, y])
        terms = np.linalg.lstsq(matrix, known, rcond=None)[0]
        if unit_m * float(np.abs(matrix @ terms - known).max()) <= STRAIGHT_M:
            rates = np.append(grid.rates_l_ha, np.nan)[grid.classes[::-1]]  # NO_RATE is the last
            (a, d), (b, e), (c, f) = terms.tolist()
            return MapCells(rates_l_ha=rates, transform=(a, b, c, d, e, f), crs=crs)
    return None


def to_cells_of(
    transform: Affine, crs: CRS, shape: tuple[int, int], frame: LocalFrame, path: Path
) -> Warp:
    """Return the way from metres of the frame to column and row of a raster of any values."""
    cells = MapCells(rates_l_ha=np.broadcast_to(0.0, shape), transform=transform, crs=crs)
    check_place(cells, path)
    return _fitted(cells, frame, path, flipped=False)[1]


def cell_areas_m2(cells: MapCells, frame: LocalFrame) -> Floats:
    """Return the area of every cell (rows, columns), by its four corners in the frame."""
    rows, columns = cells.rates_l_ha.shape
    to_frame, _ = _fitted(cells, frame, Path("cells"), flipped=False)
    areas = np.empty((rows, columns))
    # In blocks of rows: all corners at once would take the memory of many maps.
    block = max(1, BLOCK_CELLS // columns)
    for first in range(0, rows, block):
        last = min(first + block, rows)
        column, row = np.meshgrid(
            np.arange(columns + 1, dtype=np.float64), np.arange(first, last + 1, dtype=np.float64)
        )
        shape = column.shape
        east, north = (values.reshape(shape) for values in to_frame(column.ravel(), row.ravel()))
        # Half the cross product of the diagonals.
        rising = (east[1:, 1:] - east[:-1, :-1]) * (north[1:, :-1] - north[:-1, 1:])
        falling = (east[1:, :-1] - east[:-1, 1:]) * (north[1:, 1:] - north[:-1, :-1])
        areas[first:last] = np.abs(rising - falling) / 2.0
    return areas


def numbered(areas: Sequence[MultiPolygon], cells: MapCells) -> Objects:
    """Return areas of longitude and latitude in columns and rows of the cells."""
    native: Objects = np.array(areas, dtype=object)
    to_crs = None
    if not is_wgs84(cells.crs):
        to_crs = _transformer(WGS84, cells.crs)
        native = densified(native, SEGMENT_M / METRES_PER_DEGREE)
    a, b, c, d, e, f = cells.transform
    size = a * e - b * d

    def number(points: Floats) -> Floats:
        x, y = points.T if to_crs is None else to_crs.transform(points[:, 0], points[:, 1])
        return np.column_stack(
            [(e * (x - c) - b * (y - f)) / size, (a * (y - f) - d * (x - c)) / size]
        )

    result: Objects = shapely.transform(native, number)
    return result


def shares_inside(cells: MapCells, area: MultiPolygon) -> Floats:
    """Return which share of every cell (rows, columns) lies in ground of longitude and latitude.

    Exact for polygons: every edge, cut where it leaves a cell, adds the part of that cell to its
    right, and all cells further right; what adds up along a row is the share (the area to the
    right of a closed ring's edges, as Green's theorem has it).
    """
    rows, columns = cells.rates_l_ha.shape
    parts = shapely.orient_polygons(shapely.get_parts(numbered([area], cells)))
    points, ring = shapely.get_coordinates(shapely.get_rings(parts), return_index=True)
    same = np.flatnonzero(ring[1:] == ring[:-1])
    start, end = points[same], points[same + 1]
    crossed = np.abs(np.clip(end, 0, (columns, rows)) - np.clip(start, 0, (columns, rows)))
    pieces = np.cumsum(crossed.sum(axis=1) + 4.0)
    shares = np.zeros((rows, columns + 2))
    first = 0
    while first < len(start):
        done = pieces[first - 1] if first else 0.0
        last = max(int(np.searchsorted(pieces, done + BLOCK_CELLS, side="right")), first + 1)
        _add_edges(shares, start[first:last], end[first:last])
        first = last
    inside = np.cumsum(shares[:, :columns], axis=1, out=shares[:, :columns])
    # Rounding along a row is no ground, and a cell that is inside is wholly so.
    inside[np.abs(inside) < SHARE_ZERO] = 0.0
    inside[np.abs(inside - 1.0) < SHARE_ZERO] = 1.0
    return np.clip(inside, 0.0, 1.0)


def _add_edges(shares: Floats, start: Floats, end: Floats) -> None:
    """Add what lies to the right of each edge; an edge upwards has its ground on the left."""
    rows, columns = shares.shape[0], shares.shape[1] - 2
    edges = np.arange(len(start))
    owner, at = [edges, edges], [np.zeros(len(start)), np.ones(len(start))]
    for axis, limit in ((0, columns), (1, rows)):
        low = np.clip(np.minimum(start[:, axis], end[:, axis]), 0, limit)
        high = np.clip(np.maximum(start[:, axis], end[:, axis]), 0, limit)
        line = np.ceil(low).astype(np.int64)
        count = np.maximum(np.floor(high).astype(np.int64) - line + 1, 0)
        owns = np.repeat(edges, count)
        step = np.arange(len(owns)) - np.repeat(np.cumsum(count) - count, count)
        way = (end - start)[owns, axis]
        slanted = way != 0.0
        owns, step, way = owns[slanted], step[slanted], way[slanted]
        owner.append(owns)
        at.append(np.clip((line[owns] + step - start[owns, axis]) / way, 0.0, 1.0))
    edge, share = np.concatenate(owner), np.concatenate(at)
    order = np.lexsort((share, edge))
    edge, share = edge[order], share[order]
    place = start[edge] + share[:, None] * (end - start)[edge]
    piece = np.flatnonzero(edge[1:] == edge[:-1])
    one, two = place[piece], place[piece + 1]
    middle = (one + two) / 2.0
    met = (middle[:, 1] > 0.0) & (middle[:, 1] < rows)
    rise = (one[:, 1] - two[:, 1])[met]
    x = np.clip(middle[met, 0], 0.0, columns)
    row = np.minimum(middle[met, 1].astype(np.int64), rows - 1)
    column = x.astype(np.int64)
    flat = row * (columns + 2) + column
    right = column + 1.0 - x
    for index, weight in ((flat, rise * right), (flat + 1, rise * (1.0 - right))):
        np.add.at(shares.reshape(-1), index, weight)


def cell_size_m(cells: MapCells, frame: LocalFrame) -> tuple[float, float]:
    """Return the length of a cell along its row and along its column, in the middle of the map."""
    rows, columns = cells.rates_l_ha.shape
    column = np.array([0.0, 1.0, 0.0]) + columns // 2
    row = np.array([0.0, 0.0, 1.0]) + rows // 2
    longitude, latitude = to_degrees(cells, column, row)
    east, north = frame.to_local_all(latitude.tolist(), longitude.tolist())
    along = np.hypot(east[1:] - east[0], north[1:] - north[0])
    return float(along[0]), float(along[1])


def _transformer(source: CRS, target: CRS) -> Transformer:
    return Transformer.from_crs(source, target, always_xy=True)


def _classes(cells: MapCells) -> tuple[Floats, NDArray[np.int32]]:
    """Return the different rates, and for every cell the index of its own."""
    rated = ~np.isnan(cells.rates_l_ha)
    rates, index = np.unique(cells.rates_l_ha[rated], return_inverse=True)
    kinds = np.full(rated.shape, NO_RATE, dtype=np.int32)
    kinds[rated] = index
    return rates, kinds


def turns_clockwise(cells: MapCells) -> bool:
    """Tell whether the first row lies north of the second, as in most rasters."""
    a, b, _, d, e, _ = cells.transform
    return a * e - b * d < 0.0


def _fitted(cells: MapCells, frame: LocalFrame, path: Path, *, flipped: bool) -> tuple[Warp, Warp]:
    """Return the polynomials from cell numbers to the frame and back, of the least degree."""
    rows, columns = cells.rates_l_ha.shape

    def places(side: int) -> tuple[Floats, Floats, Floats, Floats]:
        column, row = np.meshgrid(np.linspace(0.0, columns, side), np.linspace(0.0, rows, side))
        longitude, latitude = to_degrees(
            cells, column.ravel(), (rows - row if flipped else row).ravel()
        )
        east, north = frame.to_local_all(latitude.tolist(), longitude.tolist())
        return column.ravel(), row.ravel(), east, north

    known, checked = places(FIT_SIDE), places(2 * FIT_SIDE + 1)
    size_m = float(np.hypot(np.ptp(known[2]), np.ptp(known[3])) / np.hypot(rows, columns))
    if not size_m >= CELL_MIN_M:
        raise map_error(
            path,
            f"its cells are {100 * size_m:.2g} cm wide",
            fix=f"make the map with cells of {CELL_MIN_M * 100:.0f} cm or more",
            code="too-fine",
        )
    for degree in range(1, DEGREE_MAX + 1):
        to_frame = _fit(known[:2], known[2:], degree)
        to_cells = _fit(known[2:], known[:2], degree)
        error_m = max(
            _largest(to_frame, checked[:2], checked[2:]),
            size_m * _largest(to_cells, checked[2:], checked[:2]),
        )
        if error_m <= FIT_MAX_M:
            break
    if not error_m <= USABLE_MAX_M:
        raise map_error(
            path,
            f"its rows and columns are bent: {error_m:.2g} m are left unexplained",
            fix="cut the map to one field",
            code="too-large",
        )
    return to_frame, to_cells


def _fit(known: tuple[Floats, ...], wanted: tuple[Floats, ...], degree: int) -> Warp:
    (x, y), (u, v) = known, wanted
    x0, y0 = float(x.min() + np.ptp(x) / 2), float(y.min() + np.ptp(y) / 2)
    scale = float(max(np.ptp(x), np.ptp(y)) / 2)
    matrix = monomials((x - x0) / scale, (y - y0) / scale, degree).T
    terms = np.linalg.lstsq(matrix, np.column_stack([u, v]), rcond=None)[0]
    return Warp(x0=x0, y0=y0, scale=scale, terms=tuple((float(a), float(b)) for a, b in terms))


def _largest(warp: Warp, known: tuple[Floats, ...], wanted: tuple[Floats, ...]) -> float:
    found = warp(known[0], known[1])
    return float(max(np.abs(found[0] - wanted[0]).max(), np.abs(found[1] - wanted[1]).max()))
