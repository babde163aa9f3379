"""Points with numbers, from a table: the cells in whose middles they stand.

Points in rows and columns are the cells of that lattice. Others are put into square cells as P2's
text map would have it, and the operator is told.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from companion.core.frame import LocalFrame
from missions.maps.crs import WGS84
from missions.maps.model import RATE_MAX_L_HA, Affine, Floats, Problem, map_error
from missions.maps.text_lattice import GridLayout, cell_numbers, layout_for, merged
from missions.maps.text_map import MAX_CELLS, grid_of_points, named_crs, tied_down
from missions.maps.text_points import TextMap

# Points that stand in rows and columns: the lattice they stand on, however it is turned.
#
# Programs export a grid as one point in the middle of each cell. Which grid is not written down,
# but follows from the points: two steps, one along the rows and one along the columns, from a
# point to its neighbours, and whole numbers of them from any point to any other.

Ints = NDArray[np.int64]

# A point may stand this much of a cell beside its place: 10 m cells with five decimals of a
# degree are rounded by 0.06. Points at random are off by 0.25 on average.
OFF_MAX = 0.12
# Rows and columns stand at right angles, to 10 degrees (the sine): a lattice in one projection is
# a little skewed in another.
SKEW_MAX = 0.17
# At least this part of the cells has a point, and no row or column stands alone.
FILLED_MIN = 0.05
POINTS_MIN = 4
_SAMPLES = 24
_START_RADIUS = 4
_ROUNDS_MAX = 20  # four cells twenty times doubled are more than any map has


@dataclass(frozen=True, slots=True, kw_only=True)
class PointLattice:
    """Cells around points: their transform, each point's row and column, and how many there are.

    Rows run towards the east and columns towards the north as nearly as they can. `off` is the
    largest distance of a point from the middle of its cell, in cells.
    """

    transform: Affine
    row: Ints
    column: Ints
    rows: int
    columns: int
    off: float


def find_lattice(points: Floats) -> PointLattice | None:
    """Return the lattice on which all points (x, y) stand, each alone in its cell, or None.

    >>> square = np.array([(5.0, 5.0), (15.0, 5.0), (5.0, 15.0), (15.0, 15.0)])
    >>> found = find_lattice(square)
    >>> [round(value, 9) for value in found.transform], found.row.tolist(), found.column.tolist()
    ([10.0, 0.0, 0.0, 0.0, 10.0, 0.0], [0, 0, 1, 1], [0, 1, 0, 1])
    """
    if len(points) < POINTS_MIN:
        return None
    middle = points.mean(axis=0)
    around = points - middle
    steps = _first_steps(around)
    if steps is None:
        return None
    try:
        fitted = _grown(around, steps)
    except np.linalg.LinAlgError:  # steps so short that they have no inverse
        return None
    return None if fitted is None else _numbered(*fitted, middle)


def refit(found: PointLattice, points: Floats) -> PointLattice:
    """Return the same rows and columns with the transform that fits other coordinates best."""
    matrix = np.column_stack([found.column + 0.5, found.row + 0.5, np.ones(len(points))])
    middle = points.mean(axis=0)
    (a, d), (b, e), (c, f) = np.linalg.lstsq(matrix, points - middle, rcond=None)[0]
    steps = np.array([[a, d], [b, e]])
    left = points - middle - matrix @ np.array([[a, d], [b, e], [c, f]])
    transform = tuple(float(value) for value in (a, b, c + middle[0], d, e, f + middle[1]))
    return PointLattice(
        transform=transform,  # type: ignore[arg-type]
        row=found.row,
        column=found.column,
        rows=found.rows,
        columns=found.columns,
        off=float(np.abs(left @ np.linalg.inv(steps)).max()),
    )


def _first_steps(around: Floats) -> Floats | None:
    """Return rough steps along and across, as rows: from some points to their neighbours."""
    samples = min(_SAMPLES, max(4, 4_000_000 // len(around)))
    picked = np.unique(np.linspace(0, len(around) - 1, samples).astype(np.int64))
    along, across = [], []
    for index in picked.tolist():
        away = around - around[index]
        length = np.hypot(away[:, 0], away[:, 1])
        length[length == 0.0] = np.inf
        nearest = away[int(np.argmin(length))]
        unit = nearest / np.hypot(*nearest)
        sideways = np.abs(away @ np.array([-unit[1], unit[0]]))
        upright = np.where(sideways > (1.0 - SKEW_MAX) * length, length, np.inf)
        upright[~np.isfinite(length)] = np.inf
        if np.isfinite(upright.min()):
            along.append(nearest)
            across.append(away[int(np.argmin(upright))])
    if not along:
        return None
    # A point beside a gap finds a farther neighbour than the others; the shortest pair is right.
    lengths = [np.hypot(*one) + np.hypot(*two) for one, two in zip(along, across, strict=True)]
    best = int(np.argmin(lengths))
    return np.array([along[best], across[best]])


def _grown(around: Floats, steps: Floats) -> tuple[Ints, Floats, Floats, float] | None:
    """Return every point's numbers, the steps and the origin, fitted outwards from one point.

    The rough steps are good for a few cells. What they give there is fitted, which is good for
    twice as far, and so on: numbers never slip, however many columns there are.
    """
    away = np.hypot(around[:, 0], around[:, 1])
    origin = around[int(np.argmin(away))]
    away = np.hypot(*(around - origin).T)
    order = np.argsort(away)
    away, outwards = away[order], around[order]
    radius = float(_START_RADIUS)
    for _ in range(_ROUNDS_MAX):
        reach = radius * float(np.hypot(steps[:, 0], steps[:, 1]).min())
        near = outwards[: int(np.searchsorted(away, reach, side="right"))]
        number = np.rint((near - origin) @ np.linalg.inv(steps))
        left = near - origin - number @ steps
        matrix = np.column_stack([number, np.ones(len(near))])
        # The least correction: where all points near stand in one row, the other step stays.
        correction = np.linalg.lstsq(matrix, left, rcond=None)[0]
        steps, origin = steps + correction[:2], origin + correction[2]
        if not _sound(steps):
            return None
        if len(near) == len(around):
            return _checked(around, steps, origin)
        radius *= 2.0
    return None


def _checked(
    around: Floats, steps: Floats, origin: Floats
) -> tuple[Ints, Floats, Floats, float] | None:
    """Return what was fitted if every point stands near enough to its place."""
    place = (around - origin) @ np.linalg.inv(steps)
    number = np.rint(place)
    off = float(np.abs(place - number).max())
    if not off <= OFF_MAX:
        return None
    return number.astype(np.int64), steps, origin, off


def _sound(steps: Floats) -> bool:
    """Tell whether the steps are two, and stand upright on each other."""
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    if not (np.isfinite(lengths).all() and (lengths > 0.0).all()):
        return False
    return abs(float(steps[0] @ steps[1])) <= SKEW_MAX * float(lengths.prod())


def _numbered(
    number: Ints, steps: Floats, origin: Floats, off: float, middle: Floats
) -> PointLattice | None:
    """Return the lattice with rows towards the east, columns towards the north, from 0."""
    number, steps = _turned(number, steps)
    first = number.min(axis=0)
    columns, rows = (number.max(axis=0) - first + 1).tolist()
    column, row = (number - first).T
    count = len(number)
    lonely = min(rows, columns) < 2
    if lonely or not rows * columns * FILLED_MIN <= count:
        return None
    if np.bincount(row * columns + column).max() > 1:
        return None
    corner = origin + middle + (first - 0.5) @ steps
    (a, d), (b, e) = steps.tolist()
    return PointLattice(
        transform=(a, b, float(corner[0]), d, e, float(corner[1])),
        row=row,
        column=column,
        rows=rows,
        columns=columns,
        off=off,
    )


def _turned(number: Ints, steps: Floats) -> tuple[Ints, Floats]:
    if abs(steps[0, 0]) * np.hypot(*steps[1]) < abs(steps[1, 0]) * np.hypot(*steps[0]):
        number, steps = number[:, ::-1], steps[::-1]
    signs = np.array([1 if steps[0, 0] >= 0.0 else -1, 1 if steps[1, 1] >= 0.0 else -1])
    return number * signs, steps * signs[:, None]


MAX_VALUES = 64_000_000
# Degrees are taken for the lattice where they fit as well as metres, to a thousandth of a cell.
_OFF_MORE = 0.001
# Beyond any degrees: such coordinates are metres or feet.
_DEGREES_MAX = 400.0

# Column and row of every point.
Places = tuple[Ints, Ints]
Gridded = tuple[CRS | None, Affine, dict[str, Floats], Places, tuple[Problem, ...]]


def cells_of_degrees(
    longitude_deg: Floats, latitude_deg: Floats, values: Mapping[str, Floats], path: Path
) -> Gridded:
    """Return CRS, transform, cells of every column of values, the points' places, what to say."""
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
        return WGS84, _straight(degrees), *_placed(degrees, values, path), ()
    return named_crs(frame), _straight(found), *_placed(found, values, path), ()


def cells_of_coordinates(x: Floats, y: Floats, values: Mapping[str, Floats], path: Path) -> Gridded:
    """Return the same of coordinates in a CRS that only the operator knows."""
    points = np.column_stack([x, y])
    found = find_lattice(points)
    if found is not None:
        return None, _straight(found), *_placed(found, values, path), ()
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
    grids, places = _merged(layout, x, y, values)
    size = float(layout.cell_m)
    transform = (size, 0.0, layout.east_min_m, 0.0, size, layout.north_min_m)
    return None, transform, grids, places, (_irregular(layout, grids, path),)


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
    grids, places = _merged(grid.layout, east, north, values)
    frame, transform = tied_down(grid)
    return named_crs(frame), transform, grids, places, (_irregular(grid.layout, grids, path),)


def _merged(
    layout: GridLayout, x: Floats, y: Floats, values: Mapping[str, Floats]
) -> tuple[dict[str, Floats], Places]:
    """Return the mean in every cell; points without a value do not count.

    A point that is no rate spoils its cell, which would else hide it among its neighbours.
    """
    column, row = cell_numbers(layout, x, y)
    grids = {}
    for name, numbers in values.items():
        there = ~np.isnan(numbers)
        cells = (column[there], row[there])
        grids[name] = merged(layout, cells, numbers[there], merge="mean")
        wrong = (numbers < 0.0) | (numbers >= RATE_MAX_L_HA)
        grids[name][row[wrong] - 1, column[wrong] - 1] = numbers[wrong]
    return grids, (column - 1, row - 1)


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


def _placed(
    found: PointLattice, values: Mapping[str, Floats], path: Path
) -> tuple[dict[str, Floats], Places]:
    _check_cells(found.rows * found.columns, len(values), path)
    grids = {}
    for name, column_values in values.items():
        grid = np.full((found.rows, found.columns), np.nan)
        grid[found.row, found.column] = column_values
        grids[name] = grid
    return grids, (found.column, found.row)


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
