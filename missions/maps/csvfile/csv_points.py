"""Points with numbers, from a table: the cells in whose middles they stand.

Points in rows and columns are the cells of that lattice. Others are put into square cells as P2's
text map would have it, and the operator is told.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pyproj import CRS

from companion.core.frame import LocalFrame
from missions.maps.crs import WGS84
from missions.maps.csvfile.lattice import PointLattice, find_lattice, refit
from missions.maps.model import Affine, Floats, Problem, map_error
from missions.maps.text.point_grid import GridLayout, cell_numbers, layout_for, merged
from missions.maps.text.reader import MAX_CELLS, grid_of_points, named_crs, tied_down
from missions.maps.text.text_points import TextMap

MAX_VALUES = 64_000_000
# Degrees are taken for the lattice where they fit as well as metres, to a thousandth of a cell.
_OFF_MORE = 0.001
# Beyond any degrees: such coordinates are metres or feet.
_DEGREES_MAX = 400.0

Gridded = tuple[CRS | None, Affine, dict[str, Floats], tuple[Problem, ...]]


def cells_of_degrees(
    longitude_deg: Floats, latitude_deg: Floats, values: Mapping[str, Floats], path: Path
) -> Gridded:
    """Return CRS, transform, (rows, columns) of every column of values, and what to say."""
    points = np.column_stack([longitude_deg, latitude_deg])
    frame = LocalFrame(
        latitude_deg=float(latitude_deg.min() / 2 + latitude_deg.max() / 2),
        longitude_deg=float(longitude_deg.min() / 2 + longitude_deg.max() / 2),
    )
    metres = np.column_stack(frame.to_local_all(latitude_deg.tolist(), longitude_deg.tolist()))
    found = find_lattice(metres) if np.isfinite(metres).all() else None
    if found is None:
        return _irregular_degrees(latitude_deg, longitude_deg, values, path)
    degrees = refit(found, points)
    if degrees.off <= found.off + _OFF_MORE:
        return WGS84, _straight(degrees), _placed(degrees, values, path), ()
    return named_crs(frame), _straight(found), _placed(found, values, path), ()


def cells_of_coordinates(x: Floats, y: Floats, values: Mapping[str, Floats], path: Path) -> Gridded:
    """Return the same of coordinates in a CRS that only the operator knows."""
    points = np.column_stack([x, y])
    found = find_lattice(points)
    if found is not None:
        return None, _straight(found), _placed(found, values, path), ()
    if not float(np.abs(points).max()) > _DEGREES_MAX:
        raise map_error(
            path,
            "its points stand on no lattice, and nothing says whether x and y are metres",
            fix="name the columns lat and lon, or easting and northing in metres",
            code="irregular-points",
        )
    layout = layout_for(
        len(x),
        east_m=(float(x.min()), float(x.max())),
        north_m=(float(y.min()), float(y.max())),
    )
    _check_cells(layout.rows * layout.columns, len(values), path)
    grids = _merged(layout, x, y, values)
    size = float(layout.cell_m)
    transform = (size, 0.0, layout.east_min_m, 0.0, size, layout.north_min_m)
    return None, transform, grids, (_irregular(layout, grids, path),)


def _irregular_degrees(
    latitude_deg: Floats, longitude_deg: Floats, values: Mapping[str, Floats], path: Path
) -> Gridded:
    nothing = np.zeros(len(latitude_deg))
    points = TextMap(
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=nothing,
        rate_l_min=nothing,
    )
    grid = grid_of_points(points, path, merge="mean")
    _check_cells(grid.rates_l_min.size, len(values), path)
    east, north, _ = grid.plane.to_local(latitude_deg, longitude_deg, nothing)
    grids = _merged(grid.layout, east, north, values)
    frame, transform = tied_down(grid)
    return named_crs(frame), transform, grids, (_irregular(grid.layout, grids, path),)


def _merged(
    layout: GridLayout, x: Floats, y: Floats, values: Mapping[str, Floats]
) -> dict[str, Floats]:
    """Return the mean in every cell; points without a value do not count."""
    column, row = cell_numbers(layout, x, y)
    there = {name: ~np.isnan(column_values) for name, column_values in values.items()}
    return {
        name: merged(
            layout,
            (column[there[name]], row[there[name]]),
            column_values[there[name]],
            merge="mean",
        )
        for name, column_values in values.items()
    }


def _irregular(layout: GridLayout, grids: Mapping[str, Floats], path: Path) -> Problem:
    empty = min((int(np.isnan(grid).sum()) for grid in grids.values()), default=0)
    return Problem(
        severity="warning",
        code="irregular-points",
        text=f"its {layout.points} points stand on no lattice; they are put into cells of "
        f"{layout.cell_m} m, several in one by their mean, and {empty} of "
        f"{layout.rows * layout.columns} cells hold none",
        where=str(path),
        fix="look at the map with `vrspray map show`, or export it as polygons",
    )


def _placed(found: PointLattice, values: Mapping[str, Floats], path: Path) -> dict[str, Floats]:
    _check_cells(found.rows * found.columns, len(values), path)
    grids = {}
    for name, column_values in values.items():
        grid = np.full((found.rows, found.columns), np.nan)
        grid[found.row, found.column] = column_values
        grids[name] = grid
    return grids


def _check_cells(cells: int, columns: int, path: Path) -> None:
    if not (cells <= MAX_CELLS and cells * columns <= MAX_VALUES):
        raise map_error(
            path,
            f"{columns} columns of {cells} cells are too many",
            fix="keep the rate and its place, and cut the map to one field",
            code="too-large",
        )


def _straight(found: PointLattice) -> Affine:
    """Return the transform, without a turn that moves the farthest cell by a hundredth of one."""
    a, b, c, d, e, f = found.transform
    if abs(b) * found.rows < 0.01 * abs(a) and abs(d) * found.columns < 0.01 * abs(e):
        return (a, 0.0, c + b * found.rows / 2, 0.0, e, f + d * found.columns / 2)
    return found.transform
