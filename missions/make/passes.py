"""The ground as the aircraft meets it: rows across the passes, places along them.

Places lie `along_m` in the direction of the passes and `right_m` to their right, both from the
frame's origin. A *band* is the ground of one pass, from half way to one neighbour to half way to
the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from missions.maps.convert.rasterise import spans_of
from missions.strips import Floats, lengths_m

Scalar = TypeVar("Scalar", bound=np.generic)

# Lines within a degree of the main course are passes; others are flown along the border.
PARALLEL_DEG = 1.0
# Passes closer than this share of the swath belong to parts of the field that lie side by side.
APART_MIN = 0.6
# Where passes overlap, less than this share of an outer strip is left to the next one.
STRIP_MIN = 0.5
# What a line may be beside the middle of its band.
BESIDE_MAX_M = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Passes:
    """The bands of all passes, by their edges to the right.

    `aligned_percent` of the planned metres are flown along the middle of a band, the others
    across bands or beside them.
    """

    angle_deg: float
    edges_m: Floats
    aligned_percent: float

    def turned(self, points: Floats) -> Floats:
        """Return (east, north) as (along, right)."""
        angle = math.radians(self.angle_deg)
        along = np.array([math.sin(angle), math.cos(angle)])
        return np.column_stack([points @ along, points @ np.array([along[1], -along[0]])])

    def back(self, points: Floats) -> Floats:
        """Return (along, right) as (east, north).

        >>> passes = Passes(angle_deg=30.0, edges_m=np.zeros(2), aligned_percent=100.0)
        >>> np.round(passes.back(passes.turned(np.array([[3.0, 4.0]]))), 9).tolist()
        [[3.0, 4.0]]
        """
        angle = math.radians(self.angle_deg)
        matrix = np.array([[math.sin(angle), math.cos(angle)], [math.cos(angle), -math.sin(angle)]])
        result: Floats = points @ matrix
        return result


def passes_of(lines: Floats, angle_deg: float, ground: BaseGeometry, swath_m: float) -> Passes:
    """Return the bands of planned lines (rows of both ends), carried on to the field's edges."""
    plain = Passes(angle_deg=angle_deg, edges_m=np.zeros(0), aligned_percent=0.0)
    corners = plain.turned(shapely.get_coordinates(ground))
    low, high = float(corners[:, 1].min()), float(corners[:, 1].max())
    start, end = plain.turned(lines[:, :2]), plain.turned(lines[:, 2:])
    step = np.abs(end - start)
    parallel = step[:, 1] <= math.tan(math.radians(PARALLEL_DEG)) * step[:, 0]
    length_m = lengths_m(lines)
    right = (start[:, 1] + end[:, 1]) / 2.0
    middles: list[float] = []
    for index in np.argsort(-length_m, kind="stable").tolist():
        if parallel[index] and all(abs(right[index] - one) >= APART_MIN * swath_m
                                   for one in middles):  # fmt: skip
            middles.append(float(right[index]))
    middles = sorted(middles) or [(low + high) / 2.0]
    edges = [(one + two) / 2.0 for one, two in pairwise(middles)]
    edges = [middles[0] - swath_m / 2.0, *edges, middles[-1] + swath_m / 2.0]
    edges = _filled(edges, swath_m)
    # What passes keep from the border is no band: nothing is flown there.
    beside_m = (1.0 - APART_MIN) * swath_m
    while edges[0] > low + beside_m:
        edges.insert(0, edges[0] - swath_m)
    while edges[-1] < high - beside_m:
        edges.append(edges[-1] + swath_m)
    edges[0], edges[-1] = min(edges[0], low), max(edges[-1], high)
    beside = np.abs(right[:, None] - np.array(middles)[None, :]).min(axis=1)
    aligned = parallel & (beside <= BESIDE_MAX_M)
    share = float(length_m[aligned].sum() / length_m.sum()) if len(lines) else 0.0
    return Passes(angle_deg=angle_deg, edges_m=np.array(edges), aligned_percent=100.0 * share)


def _filled(edges: list[float], swath_m: float) -> list[float]:
    """Return the edges with those of bands between, where passes lie more than a swath apart."""
    found = [edges[0]]
    for edge in edges[1:]:
        count = max(round((edge - found[-1]) / swath_m - 0.25), 1)
        found += np.linspace(found[-1], edge, count + 1)[1:].tolist()
    return found


def by_valve(passes: Passes, strips_m: Sequence[float]) -> Passes:
    """Return bands as wide as the strips of single valves, from left to right of the boom.

    Flown to and fro a strip lies on the other side: `strips_m` must read the same from both ends.

    >>> whole = Passes(angle_deg=0.0, edges_m=np.array([0.0, 5.0]), aligned_percent=100.0)
    >>> by_valve(whole, (2.0, 2.0, 2.0)).edges_m.tolist()
    [0.0, 1.5, 3.5, 5.0]
    """
    inner = np.cumsum(strips_m)[:-1] - sum(strips_m) / 2.0
    edges = passes.edges_m
    least_m = STRIP_MIN * min(strips_m)
    found = [edges[:1]]
    for left, right in pairwise(edges.tolist()):
        places = (left + right) / 2.0 + inner
        within = (places >= left + least_m) & (places <= right - least_m)
        found.append(np.append(places[within], right))
    return replace(passes, edges_m=np.concatenate(found))


@dataclass(frozen=True, slots=True, kw_only=True)
class Places:
    """Small places in the field, all inside: where each is, and its share of the ground.

    Each of the `bands` has `rows` rows of places; `row` counts them through, `column` counts
    steps of `step_m` along the passes from `start_m`.
    """

    passes: Passes
    rows: int
    start_m: float
    step_m: float
    columns: int
    row: NDArray[np.int32]
    column: NDArray[np.int32]

    @property
    def bands(self) -> int:
        """Return the number of passes side by side."""
        return len(self.passes.edges_m) - 1

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of the lattice."""
        return self.bands * self.rows, self.columns

    @property
    def row_m(self) -> Floats:
        """Return the width of every row."""
        return np.repeat(np.diff(self.passes.edges_m) / self.rows, self.rows)

    @property
    def area_m2(self) -> Floats:
        """Return the ground of every place."""
        result: Floats = (self.row_m * self.step_m)[self.row]
        return result

    def points(self, part: slice) -> Floats:
        """Return east and north of some places."""
        edges = self.passes.edges_m
        bounds = np.interp(
            np.arange(self.shape[0]) / self.rows + 0.5 / self.rows, np.arange(len(edges)), edges
        )
        along = self.start_m + (self.column[part] + 0.5) * self.step_m
        return self.passes.back(np.column_stack([along, bounds[self.row[part]]]))

    def spread(self, values: NDArray[Scalar], missing: float) -> NDArray[Scalar]:
        """Return values of places as rows and columns."""
        found = np.full(self.shape, missing, dtype=values.dtype)
        found[self.row, self.column] = values
        return found


def places_in(ground: BaseGeometry, passes: Passes, *, size_m: float, path: Path) -> Places:
    """Return the places of about `size_m` whose middles lie in the field."""
    widest = float(np.diff(passes.edges_m).max())
    rows = max(round(widest / size_m), 1)
    turned = shapely.transform(ground, passes.turned)
    start, _, end, _ = turned.bounds
    columns = max(math.ceil((end - start) / size_m), 1)
    shape = ((len(passes.edges_m) - 1) * rows, columns)

    def numbered(points: Floats) -> Floats:
        row = np.interp(points[:, 1], passes.edges_m, np.arange(len(passes.edges_m))) * rows
        return np.column_stack([(points[:, 0] - start) / size_m, row])

    # Bands may differ in width: an edge is bent where it crosses into the next.
    fine = shapely.segmentize(turned, widest / 2.0)
    spans = spans_of(np.array([shapely.transform(fine, numbered)], dtype=object), shape, path=path)
    count = spans.column_end - spans.column
    column = np.repeat(spans.column - np.cumsum(count) + count, count) + np.arange(count.sum())
    return Places(
        passes=passes, rows=rows, start_m=start, step_m=size_m, columns=columns,
        row=np.repeat(spans.row, count).astype(np.int32), column=column.astype(np.int32),
    )  # fmt: skip
