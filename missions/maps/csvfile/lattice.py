"""Points that stand in rows and columns: the lattice they stand on, however it is turned.

Programs export a grid as one point in the middle of each cell. Which grid is not written down, but
follows from the points: two steps, one along the rows and one along the columns, from a point to
its neighbours, and whole numbers of them from any point to any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from missions.maps.model import Affine

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# A point may stand this much of a cell beside its place: 10 m cells with five decimals of a
# degree are rounded by 0.06. Points at random are off by 0.25 in the mean.
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
