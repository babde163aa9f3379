"""A prescription in rows and columns: look-ups by index, edges only where they are asked for.

A raster of a million cells has four million edges; a flight passes some hundred of them. So
nothing is kept but the class of every cell, and the edges near a path are made when a step asks.

The rows of a map run along meridians or along the axes of some projection, and are no straight
lines in the flight's frame. A polynomial carries cell numbers into the frame and another one
back; whoever builds the grid fits both and checks what they leave (`maps/build.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon

from companion.core.frame import Floats, Ints

Classes = NDArray[np.int32]

# The class of a cell to which the map gives no rate, and of all ground beyond the cells.
NO_RATE = -1
DEGREE_MAX = 5


@dataclass(frozen=True)
class Warp:
    """A polynomial from one pair of coordinates to another.

    u, v = sum over i + j <= degree of terms[k] * ((x - x0) / scale)^i ((y - y0) / scale)^j, with
    the pairs (i, j) in the order of `exponents`.

    >>> shift = Warp(x0=0.0, y0=0.0, scale=1.0, terms=((5.0, 7.0), (0.0, 1.0), (1.0, 0.0)))
    >>> [value.tolist() for value in shift(np.array([2.0]), np.array([3.0]))]
    [[7.0], [10.0]]
    """

    x0: float
    y0: float
    scale: float
    terms: tuple[tuple[float, float], ...]

    @cached_property
    def degree(self) -> int:
        """Return the highest sum of exponents; ValueError where the terms are of none."""
        for degree in range(DEGREE_MAX + 1):
            if len(exponents(degree)) == len(self.terms):
                return degree
        raise ValueError(f"{len(self.terms)} terms make no polynomial")

    @cached_property
    def _columns(self) -> Floats:
        return np.array(self.terms, dtype=np.float64).T[:, :, np.newaxis].copy()

    def __call__(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return u and v of points; arrays of one shape."""
        p, q = (x - self.x0) / self.scale, (y - self.y0) / self.scale
        found = monomials(p, q, self.degree)
        # Summed term by term, not by a matrix product, whose last bit depends on where a point
        # stands in the array: a corner that two cells share has to be one and the same.
        u = np.add.reduce(self._columns[0] * found, axis=0)
        v = np.add.reduce(self._columns[1] * found, axis=0)
        return u, v

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return u and v of one point, to the last bits as the arrays have it."""
        p, q = (x - self.x0) / self.scale, (y - self.y0) / self.scale
        row = [1.0]
        u, v = self.terms[0]
        position = 1
        for _ in range(self.degree):
            row = [*[value * q for value in row], row[-1] * p]
            for value in row:
                term = self.terms[position]
                u += term[0] * value
                v += term[1] * value
                position += 1
        return u, v


def exponents(degree: int) -> list[tuple[int, int]]:
    """Return the exponents (i, j) of all terms of a polynomial in two variables.

    >>> exponents(1)
    [(0, 0), (0, 1), (1, 0)]
    """
    return [(i, total - i) for total in range(degree + 1) for i in range(total + 1)]


def monomials(p: Floats, q: Floats, degree: int) -> Floats:
    """Return p^i q^j for all exponents: (terms, points)."""
    found = np.empty(((degree + 1) * (degree + 2) // 2, len(p)))
    found[0] = 1.0
    start, count = 0, 1
    for _ in range(degree):
        # Each degree from the one before: times q, and its last term, p^d, times p as well.
        before = found[start : start + count]
        start, count = start + count, count + 1
        np.multiply(before, q, out=found[start : start + count - 1])
        np.multiply(before[-1], p, out=found[start + count - 1])
    return found


class Rectangles(NamedTuple):
    """Blocks of cells of one class: rows `row` to `row_end`, columns `column` to `column_end`."""

    kind: Ints
    row: Ints
    row_end: Ints
    column: Ints
    column_end: Ints


def rectangles(classes: Classes) -> Rectangles:
    """Return blocks that cover every cell with a rate once: runs along rows, equal runs joined.

    >>> blocks = rectangles(np.array([[0, 0, 1], [0, 0, -1]], dtype=np.int32))
    >>> [tuple(int(value) for value in block) for block in zip(*blocks)]
    [(0, 0, 2, 0, 2), (1, 0, 1, 2, 3)]
    """
    rows, columns = classes.shape
    fresh = np.ones(classes.shape, dtype=np.bool_)
    fresh[:, 1:] = classes[:, 1:] != classes[:, :-1]
    row, column = np.nonzero(fresh)
    starts = row * columns + column
    ends = np.append(starts[1:], rows * columns)
    kind = classes[row, column].astype(np.int64)
    end = column + (ends - starts)
    order = np.lexsort((row, end, column, kind))
    kind, row, column, end = kind[order], row[order], column[order], end[order]
    kept = kind != NO_RATE
    kind, row, column, end = kind[kept], row[kept], column[kept], end[kept]
    begins = np.ones(len(kind), dtype=np.bool_)
    begins[1:] = ~(
        (kind[1:] == kind[:-1])
        & (column[1:] == column[:-1])
        & (end[1:] == end[:-1])
        & (row[1:] == row[:-1] + 1)
    )
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(kind))[: len(first)] - 1
    return Rectangles(kind[first], row[first], row[last] + 1, column[first], end[first])


class CellGrid:
    """Rows and columns of cells with rates, in the flight's frame.

    Args:
        classes: (rows, columns), for each cell the index of its rate, or `NO_RATE`.
        rates_l_ha: the rate of each class, all different.
        to_frame: from (column, row) to (east_m, north_m). Whole numbers are corners of cells;
            rows and columns turn like north and east, anticlockwise from the one to the other.
        to_cells: the inverse.
    """

    def __init__(
        self, classes: Classes, rates_l_ha: Sequence[float] | Floats, to_frame: Warp, to_cells: Warp
    ) -> None:
        rates = np.asarray(rates_l_ha, dtype=np.float64)
        if not ((rates >= 0.0) & (rates < 100_000.0)).all():
            raise ValueError("a rate of the cells is not a rate")
        if classes.ndim != 2 or not classes.size:
            raise ValueError(f"cells need rows and columns: {classes.shape}")
        if not (classes.min() >= NO_RATE and classes.max() < len(rates)):
            raise ValueError("a cell is of a class that has no rate")
        self.rates_l_ha = rates
        self.to_frame = to_frame
        self.to_cells = to_cells
        # One cell of no rate all round, so that the outermost edges are like all others.
        self._padded = np.pad(classes.astype(np.int32), 1, constant_values=NO_RATE)
        corner_east, corner_north = to_frame(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
        right, up = corner_east[1:] - corner_east[0], corner_north[1:] - corner_north[0]
        if not right[0] * up[1] - right[1] * up[0] > 0.0:
            raise ValueError("rows and columns of the cells turn clockwise")

    @property
    def classes(self) -> Classes:
        """Return the class of every cell, (rows, columns)."""
        return self._padded[1:-1, 1:-1]

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of rows and of columns."""
        rows, columns = self._padded.shape
        return rows - 2, columns - 2

    def classes_at(self, east_m: Floats, north_m: Floats) -> Ints:
        """Return the class at each point; `NO_RATE` beyond the cells and where there is none."""
        column, row = self.to_cells(east_m, north_m)
        rows, columns = self.shape
        inside = (column >= 0.0) & (column < columns) & (row >= 0.0) & (row < rows)
        # Cell 0 stands for the points outside, whose numbers may not even be finite.
        found = self._padded[
            np.where(inside, row, 0.0).astype(np.int64) + 1,
            np.where(inside, column, 0.0).astype(np.int64) + 1,
        ]
        return np.where(inside, found, NO_RATE).astype(np.int64)

    def class_at(self, east_m: float, north_m: float) -> int:
        """Return the class at one point, as `classes_at` does, but quicker."""
        column, row = self.to_cells.at(east_m, north_m)
        rows, columns = self.shape
        if not (0.0 <= column < columns and 0.0 <= row < rows):
            return NO_RATE
        return self._padded.item(int(row) + 1, int(column) + 1)

    def edges_in(
        self, west_m: float, south_m: float, east_m: float, north_m: float
    ) -> tuple[Floats, Ints]:
        """Return the edges between cells of different classes in and around a box.

        Each is there once for the cell on either side, directed with that cell on its left:
        (n, 4) east, north, east, north [m], and its class.
        """
        (row, row_end), (column, column_end) = self._window(west_m, south_m, east_m, north_m)
        if row >= row_end or column >= column_end:
            return np.empty((0, 4)), np.empty(0, dtype=np.int64)
        near = self._padded[row : row_end + 2, column : column_end + 2]
        upright = _between(near[1:-1, :-1], near[1:-1, 1:], (row, column), (1, 0))
        level = _between(near[1:, 1:-1], near[:-1, 1:-1], (row, column), (0, 1))
        start_row, start_column, end_row, end_column, owner = np.hstack([upright, level])
        count = len(owner)
        if not count:
            return np.empty((0, 4)), owner
        nodes = np.empty((2, 2 * count))
        nodes[0, :count], nodes[0, count:] = start_column, end_column
        nodes[1, :count], nodes[1, count:] = start_row, end_row
        east, north = self.to_frame(nodes[0], nodes[1])
        ends = np.empty((count, 4))
        ends[:, 0], ends[:, 1] = east[:count], north[:count]
        ends[:, 2], ends[:, 3] = east[count:], north[count:]
        return ends, owner

    def _window(
        self, west_m: float, south_m: float, east_m: float, north_m: float
    ) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return the rows and columns (first, end) of the cells that meet a box."""
        corners = [
            self.to_cells.at(east, north)
            for east, north in (
                (west_m, south_m), (east_m, south_m), (east_m, north_m), (west_m, north_m),
            )
        ]  # fmt: skip
        columns, rows = zip(*corners, strict=True)
        limits = []
        for values, count in ((rows, self.shape[0]), (columns, self.shape[1])):
            # One more on each side: an edge of the box is slightly bent among the cells.
            first, end = max(min(values) - 1.0, 0.0), min(max(values) + 2.0, float(count))
            limits.append((int(first), int(end)) if first < end else (0, 0))
        return limits[0], limits[1]

    @cached_property
    def outline(self) -> Polygon | MultiPolygon:
        """Return the ground of all cells that have a rate."""
        rated = np.where(self.classes == NO_RATE, NO_RATE, 0).astype(np.int32)
        return self._ground(rated, 1)[0]

    @cached_property
    def areas(self) -> list[Polygon | MultiPolygon]:
        """Return the ground of each class."""
        return self._ground(self.classes, len(self.rates_l_ha))

    def _ground(self, classes: Classes, count: int) -> list[Polygon | MultiPolygon]:
        """Return the ground of each class as polygons, with a vertex at every corner of a cell.

        Joined among the cell numbers, where all corners are whole numbers and so meet exactly.
        """
        blocks = rectangles(classes)
        boxes = shapely.box(blocks.column, blocks.row, blocks.column_end, blocks.row_end)
        found: list[Polygon | MultiPolygon] = []
        first = np.searchsorted(blocks.kind, np.arange(count + 1))
        for begin, end in zip(first[:-1].tolist(), first[1:].tolist(), strict=True):
            joined = shapely.segmentize(shapely.union_all(boxes[begin:end]), 1.0)
            if not isinstance(joined, Polygon | MultiPolygon):
                joined = MultiPolygon()
            found.append(shapely.transform(joined, self._to_frame_rows))
        return found

    def _to_frame_rows(self, points: Floats) -> Floats:
        return np.column_stack(self.to_frame(np.rint(points[:, 0]), np.rint(points[:, 1])))


def _between(left: Classes, right: Classes, origin: tuple[int, int], step: tuple[int, int]) -> Ints:
    """Return the edges between cells of different classes that lie side by side.

    Rows of the result: row and column of the start, row and column of the end, and the class on
    the left; forwards for the cells of `left`, backwards for those of `right`.
    """
    i, j = np.nonzero(left != right)
    count = len(i)
    found = np.empty((5, 2 * count), dtype=np.int64)
    start_row, start_column = i + origin[0], j + origin[1]
    for k, (start, end) in enumerate(
        ((start_row, start_row + step[0]), (start_column, start_column + step[1]))
    ):
        found[k, :count], found[k, count:] = start, end
        found[k + 2, :count], found[k + 2, count:] = end, start
    found[4, :count], found[4, count:] = left[i, j], right[i, j]
    return found[:, found[4] != NO_RATE]
