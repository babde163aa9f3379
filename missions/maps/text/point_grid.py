"""P2's grid (Rovira-Más et al. 2024, equations 1 to 3): from points with rates to square cells.

Pure: it takes metres east and north and gives cell numbers and values. A cell without a point is
NaN here, where the paper writes 0: the valves close over both, but only one of them was asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
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
