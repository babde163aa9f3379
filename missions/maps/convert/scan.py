"""Which cells have their centre in which polygon: lines through the centres, cut by the edges.

A centre belongs to the polygon that it lies in, never to one that merely touches its cell, which
would make every zone larger by half a cell all round.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from missions.maps.model import map_error

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Objects = NDArray[np.object_]

# A field of a million cells cut into some thousand zones has some hundred thousand crossings;
# these bounds stop files whose polygons go to and fro, or lie on each other by the thousand.
MAX_CROSSINGS = 30_000_000
MAX_PAINTED = 400_000_000
_BITE = 4_000_000


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
        end = max(int(np.searchsorted(total, done + _BITE, side="right")), start + 1)
        long = lengths[start:end]
        flat = spans.row[start:end] * columns + spans.column[start:end]
        cell = np.repeat(flat - np.cumsum(long) + long, long) + np.arange(int(long.sum()))
        yield np.repeat(spans.owner[start:end], long), cell
        start = end
