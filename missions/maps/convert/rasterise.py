"""Zones to cells of longitude and latitude, for the formats that hold rasters."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import Transformer
from shapely import MultiPolygon

from companion.core.frame import metres_per_degree
from missions.maps.build import frame_for
from missions.maps.cells import bounds_deg, cell_size_m, numbered
from missions.maps.crs import WGS84
from missions.maps.local import make_valid, project_all
from missions.maps.model import Affine, MapCells, MapFile, MapZone, map_error
from missions.maps.overlaps import overlaps

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Box = tuple[float, float, float, float]

MAX_CELLS = 16_000_000
# Cells that are cut up on the way to another lattice become at most so many.
REMADE_CELLS = 2_000_000
CELL_MIN_M, CELL_MAX_M = 0.05, 1000.0
_BITE = 500_000


def cells_of(
    map_file: MapFile, cell_m: float, *, overlap: str = "error", clip: bool = True
) -> MapCells:
    """Return the map as cells `cell_m` wide, in longitude and latitude, the north first.

    A cell has the rate at its centre: of the zone there, by the overlap policy where there are
    several, else the map's default. With `clip` there is none outside the map's own boundary.
    """
    if not CELL_MIN_M <= cell_m <= CELL_MAX_M:
        raise map_error(
            map_file.path,
            f"cells of {cell_m:g} m cannot be made",
            fix=f"take --cell-m between {CELL_MIN_M:g} and {CELL_MAX_M:g}",
            code="cell-size",
        )
    shape, transform = _lattice(_bounds(map_file), cell_m, map_file.path)
    if map_file.cells is None:
        rates = _of_zones(map_file, shape, transform, overlap)
    else:
        rates = _of_cells(map_file.cells, shape, transform)
    made = MapCells(rates_l_ha=rates, transform=transform, crs=WGS84)
    return in_field(made, map_file, clip=clip)


def north_up(map_file: MapFile, cell_m: float | None = None, *, clip: bool = True) -> MapCells:
    """Return the cells of a map as they are, or turned over where their first row is the south.

    Cells of another CRS, or along other axes, are made anew, a quarter as wide as the old ones
    where there is room: an edge moves by half of a new cell at most.
    """
    cells = map_file.cells
    if cells is None:
        raise ValueError("the map has no cells")
    a, b, c, d, e, f = cells.transform
    if cell_m is not None or cells.crs.to_epsg() != 4326 or not (a > 0.0 and b == d == 0.0):
        if cell_m is None:
            cell_m = min(cell_size_m(cells, frame_for(map_file))) / _parts(cells)
        return cells_of(map_file, cell_m, clip=clip)
    if e > 0.0:
        rows = cells.rates_l_ha.shape[0]
        cells = MapCells(
            rates_l_ha=cells.rates_l_ha[::-1].copy(),
            transform=(a, b, c, d, -e, f + rows * e),
            crs=cells.crs,
        )
    return in_field(cells, map_file, clip=clip)


def _parts(cells: MapCells) -> int:
    """Return into how many parts the side of a cell is cut where it is made anew."""
    return next((parts for parts in (4, 2) if cells.rates_l_ha.size * parts**2 <= REMADE_CELLS), 1)


def in_field(cells: MapCells, map_file: MapFile, *, clip: bool) -> MapCells:
    """Return the cells with the map's default inside its boundary, and no rate beyond it."""
    default = map_file.default_rate_l_ha
    if map_file.boundary is None or not (clip or default is not None):
        return cells
    if default is not None:
        cells = _reaching(cells, map_file.boundary, map_file.path)
    rows, columns = cells.rates_l_ha.shape
    spans = spans_of(numbered([map_file.boundary], cells), (rows, columns), path=map_file.path)
    flat = np.zeros(rows * columns, dtype=np.bool_)
    for _, cell in painted(spans, columns, path=map_file.path):
        flat[cell] = True
    inside = flat.reshape(rows, columns)
    rates = np.where(inside | (not clip), cells.rates_l_ha, np.nan)
    if default is not None:
        rates[inside & np.isnan(rates)] = default
    return replace(cells, rates_l_ha=rates)


def _reaching(cells: MapCells, boundary: MultiPolygon, path: Path) -> MapCells:
    """Return the cells with more of them around, without a rate, as far as the boundary reaches."""
    rows, columns = cells.rates_l_ha.shape
    west, south, east, north = shapely.total_bounds(numbered([boundary], cells))
    before = max(math.ceil(-south - 0.5), 0), max(math.ceil(-west - 0.5), 0)
    after = max(math.ceil(north - rows - 0.5), 0), max(math.ceil(east - columns - 0.5), 0)
    if not (rows + before[0] + after[0]) * (columns + before[1] + after[1]) <= MAX_CELLS:
        raise map_error(
            path,
            "its boundary reaches far beyond its cells, and the default rate with it",
            fix="convert it to zones, such as .gpkg",
            code="too-large",
        )
    if before == after == (0, 0):
        return cells
    a, b, c, d, e, f = cells.transform
    row, column = before
    return MapCells(
        rates_l_ha=np.pad(
            cells.rates_l_ha,
            ((before[0], after[0]), (before[1], after[1])),
            constant_values=np.nan,
        ),
        transform=(a, b, c - a * column - b * row, d, e, f - d * column - e * row),
        crs=cells.crs,
    )


def _bounds(map_file: MapFile) -> Box:
    """Return west, south, east, north of all that gets a rate."""
    grounds = [zone.geometry for zone in map_file.rated]
    if map_file.boundary is not None and map_file.default_rate_l_ha is not None:
        grounds.append(map_file.boundary)
    boxes = [shapely.total_bounds(np.array(grounds, dtype=object)).tolist()] if grounds else []
    if map_file.cells is not None:
        boxes.append(list(bounds_deg(map_file.cells)))
    if not boxes:
        raise map_error(
            map_file.path, "nothing in it has a rate", fix="name another column with --rate-field",
            code="null-rate",
        )  # fmt: skip
    edges = np.array(boxes)
    west, south = edges[:, :2].min(axis=0).tolist()
    east, north = edges[:, 2:].max(axis=0).tolist()
    return west, south, east, north


def _lattice(box: Box, cell_m: float, path: Path) -> tuple[tuple[int, int], Affine]:
    west, south, east, north = box
    across_m, along_m = metres_per_degree((south + north) / 2)
    width_deg, height_deg = cell_m / across_m, cell_m / along_m
    # Of a cell that is less than half inside the bounds, the centre lies beyond all ground.
    columns = max(math.ceil((east - west) / width_deg - 0.5), 1)
    rows = max(math.ceil((north - south) / height_deg - 0.5), 1)
    if not rows * columns <= MAX_CELLS:
        raise map_error(
            path,
            f"{rows} x {columns} cells of {cell_m:g} m are more than {MAX_CELLS}",
            fix="take larger cells (--cell-m)",
            code="too-large",
        )
    return (rows, columns), (width_deg, 0.0, west, 0.0, -height_deg, north)


def _of_zones(map_file: MapFile, shape: tuple[int, int], transform: Affine, overlap: str) -> Floats:
    zones = map_file.rated
    if overlap == "error":
        _refuse_overlaps(map_file, zones)
    a, _, c, _, e, f = transform
    native = np.array([zone.geometry for zone in zones], dtype=object)
    numbered = shapely.transform(native, lambda points: (points - (c, f)) / (a, e))
    rate_of = np.array([zone.rate_l_ha for zone in zones], dtype=np.float64)
    rates = np.full(shape[0] * shape[1], np.nan)
    count = np.zeros(len(rates), dtype=np.int32)
    spans = spans_of(numbered, shape, path=map_file.path)
    for owner, cell in painted(spans, shape[1], path=map_file.path):
        if overlap == "mean":
            np.add.at(count, cell, 1)
            rates[cell[np.isnan(rates[cell])]] = 0.0
            np.add.at(rates, cell, rate_of[owner])
        elif overlap == "last":
            rates[cell] = rate_of[owner]  # of equal numbers the last one holds
        else:
            (np.fmax if overlap == "max" else np.fmin).at(rates, cell, rate_of[owner])
    if overlap == "mean":
        rates[count > 1] /= count[count > 1]
    return rates.reshape(shape)


def _refuse_overlaps(map_file: MapFile, zones: list[MapZone]) -> None:
    """Refuse zones that share more than a square metre; on less the smaller rate holds."""
    if not zones:
        return
    native = np.array([zone.geometry for zone in zones], dtype=object)
    local = project_all(native, frame_for(map_file))
    # Rounding can make rings cross that touch; the rest of such a zone is valid still.
    found = overlaps(
        [area if area.is_valid else make_valid(area) or MultiPolygon() for area in local]
    )
    if found:
        first, second = zones[found[0].first], zones[found[0].second]
        raise map_error(
            map_file.path,
            f"zones {first.name} and {second.name} overlap by {found[0].area_m2:.1f} m2, and a "
            "cell has one rate",
            fix="correct the map, or choose a rate with --overlap max, min, mean or last",
            code="overlap",
        )


def _of_cells(cells: MapCells, shape: tuple[int, int], transform: Affine) -> Floats:
    """Return the rates of other cells at the centres of these."""
    a, _, c, _, e, f = transform
    longitude = c + a * (np.arange(shape[1]) + 0.5)
    latitude = f + e * (np.arange(shape[0]) + 0.5)
    step = max(_BITE // shape[1], 1)
    rates = np.empty(shape)
    for row in range(0, shape[0], step):
        places = np.meshgrid(longitude, latitude[row : row + step])
        rates[row : row + step] = cell_rates(cells, places[0], places[1])
    return rates


def cell_rates(cells: MapCells, longitude_deg: Floats, latitude_deg: Floats) -> Floats:
    """Return the rate of the cell at each place, NaN where there is none."""
    x, y = longitude_deg, latitude_deg
    if cells.crs.to_epsg() != 4326:
        x, y = Transformer.from_crs(WGS84, cells.crs, always_xy=True).transform(x, y)
    a, b, c, d, e, f = cells.transform
    size = a * e - b * d
    column = (e * (x - c) - b * (y - f)) / size
    row = (a * (y - f) - d * (x - c)) / size
    rows, columns = cells.rates_l_ha.shape
    inside = (column >= 0.0) & (column < columns) & (row >= 0.0) & (row < rows)
    rates = cells.rates_l_ha[
        np.where(inside, row, 0.0).astype(np.int64), np.where(inside, column, 0.0).astype(np.int64)
    ]
    return np.where(inside, rates, np.nan)


# Which cells have their centre in which polygon: lines through the centres, cut by the edges.
#
# A centre belongs to the polygon that it lies in, never to one that merely touches its cell, which
# would make every zone larger by half a cell all round.

Ints = NDArray[np.int64]
Objects = NDArray[np.object_]

# A field of a million cells cut into some thousand zones has some hundred thousand crossings;
# these bounds stop files whose polygons go to and fro, or lie on each other by the thousand.
MAX_CROSSINGS = 30_000_000
MAX_PAINTED = 400_000_000
SCAN_BITE = 4_000_000


class Spans(NamedTuple):
    """Cells `column` to `column_end` of a row whose centres lie in a polygon, by its index."""

    owner: Ints
    row: Ints
    column: Ints
    column_end: Ints


def spans_of(polygons: Objects, shape: tuple[int, int], *, path: Path) -> Spans:
    """Return the cells in each polygon, whose coordinates are column and row numbers.

    A centre exactly on an edge belongs to one side, the same for both polygons that meet there.
    """
    owner, row, column = _crossings(polygons, shape[0], path)
    order = np.lexsort((column, row, owner))
    owner, row, column = owner[order], row[order], column[order]
    # Rings are closed, so that every line enters a polygon as often as it leaves it.
    first = np.clip(np.ceil(column[0::2] - 0.5), 0, shape[1]).astype(np.int64)
    end = np.clip(np.ceil(column[1::2] - 0.5), 0, shape[1]).astype(np.int64)
    some = end > first
    return Spans(owner[0::2][some], row[0::2][some], first[some], end[some])


def _crossings(polygons: Objects, rows: int, path: Path) -> tuple[Ints, Ints, Floats]:
    """Return where the edges of each polygon cross the lines through the centres of the rows."""
    parts, part_owner = shapely.get_parts(polygons, return_index=True)
    rings, ring_part = shapely.get_rings(parts, return_index=True)
    points, ring = shapely.get_coordinates(rings, return_index=True)
    same = np.flatnonzero(ring[1:] == ring[:-1])
    start, end = points[same], points[same + 1]
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    first = np.clip(np.ceil(low - 0.5), 0, rows).astype(np.int64)
    count = np.clip(np.ceil(high - 0.5), 0, rows).astype(np.int64) - first
    if count.sum() > MAX_CROSSINGS:
        raise map_error(
            path,
            "its polygons have too many edges for cells of this size",
            fix="take larger cells (--cell-m)",
            code="too-large",
        )
    edge = np.repeat(np.arange(len(same)), count)
    row = np.repeat(first - np.cumsum(count) + count, count) + np.arange(len(edge))
    # From the lower end, so that both polygons of a shared edge find the same number.
    upwards = start[edge, 1] <= end[edge, 1]
    a = np.where(upwards[:, None], start[edge], end[edge])
    b = np.where(upwards[:, None], end[edge], start[edge])
    column = a[:, 0] + (row + 0.5 - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return part_owner[ring_part[ring[same[edge]]]], row, column


def painted(spans: Spans, columns: int, *, path: Path) -> Iterator[tuple[Ints, Ints]]:
    """Yield, in bites, the polygon and the flat number of every cell in it."""
    lengths = spans.column_end - spans.column
    total = np.cumsum(lengths)
    if len(total) and total[-1] > MAX_PAINTED:
        raise map_error(
            path,
            "too many of its zones lie on the same ground",
            fix="correct the map where it is made, or take larger cells (--cell-m)",
            code="too-large",
        )
    start = 0
    while start < len(lengths):
        done = int(total[start - 1]) if start else 0
        end = max(int(np.searchsorted(total, done + SCAN_BITE, side="right")), start + 1)
        long = lengths[start:end]
        flat = spans.row[start:end] * columns + spans.column[start:end]
        cell = np.repeat(flat - np.cumsum(long) + long, long) + np.arange(int(long.sum()))
        yield np.repeat(spans.owner[start:end], long), cell
        start = end
