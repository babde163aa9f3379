"""Small pieces of ground under the strips of a flight, for rasters of what fell where."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from analysis.transitions import ML_M_PER_L_HA_M

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from analysis.strips import Strip
    from analysis.track import Bools, Floats, Ints, Track


class Grid(Protocol):
    """Cells of ground, in rows and columns."""

    @property
    def rows(self) -> int: ...  # noqa: D102
    @property
    def columns(self) -> int: ...  # noqa: D102

    def cells_of(self, east_m: Floats, north_m: Floats) -> Ints:
        """Return the number of each point's cell, row by row; rows x columns beside the grid."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SquareGrid:
    """Square cells along east and north: rows from the south, columns from the west."""

    west_m: float
    south_m: float
    cell_m: float
    rows: int
    columns: int

    @staticmethod
    def over(bounds_m: tuple[float, float, float, float], cell_m: float) -> SquareGrid:
        """Return the cells over a box (west, south, east, north), on whole multiples of a cell."""
        west, south, east, north = (value / cell_m for value in bounds_m)
        column, row = math.floor(west), math.floor(south)
        return SquareGrid(
            west_m=column * cell_m,
            south_m=row * cell_m,
            cell_m=cell_m,
            rows=max(math.ceil(north) - row, 1),
            columns=max(math.ceil(east) - column, 1),
        )

    def cells_of(self, east_m: Floats, north_m: Floats) -> Ints:
        """Return the number of each point's cell; rows x columns beside the grid."""
        column = np.floor((east_m - self.west_m) / self.cell_m).astype(np.int64)
        row = np.floor((north_m - self.south_m) / self.cell_m).astype(np.int64)
        # Without a sign what lies before the first is far behind the last.
        beside = (column.view(np.uint64) >= self.columns) | (row.view(np.uint64) >= self.rows)
        row *= self.columns
        row += column
        row[beside] = self.rows * self.columns
        return row

    def finer(self, count: int) -> SquareGrid:
        """Return the same ground in `count` times as many rows and columns."""
        rows, columns, cell_m = self.rows * count, self.columns * count, self.cell_m / count
        return replace(self, rows=rows, columns=columns, cell_m=cell_m)

    def middles(self, numbers: Ints) -> tuple[Floats, Floats]:
        """Return where the middles of cells are."""
        row, column = np.divmod(numbers, self.columns)
        east_m: Floats = self.west_m + self.cell_m * (column + 0.5)
        return east_m, self.south_m + self.cell_m * (row + 0.5)

    def corners(self) -> tuple[Floats, Floats]:
        """Return east and north of the cells' corners: (rows + 1, columns + 1) each."""
        north_m, east_m = np.meshgrid(
            self.south_m + self.cell_m * np.arange(self.rows + 1.0),
            self.west_m + self.cell_m * np.arange(self.columns + 1.0),
            indexing="ij",
        )
        return east_m, north_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Slices:
    """One strip cut across into slices of ground, one after the other along its way.

    `given_ml` and `asked_ml` fell and should have fallen on each, `area_m2` is its ground; `inside`
    says whether the strip's centre is in the field there.
    """

    track: Track
    time_s: Floats
    area_m2: Floats
    given_ml: Floats
    asked_ml: Floats
    inside: Bools

    def pieces(self, size_m: float, chosen: Ints) -> Iterator[tuple[Floats, Floats]]:
        """Yield east and north of the slices' pieces, each time one piece of every slice.

        A slice has so many that none is wider than `size_m`; they are of equal area.
        """
        count = self.count(size_m)
        time_s, track = self.time_s[chosen], self.track
        heading = track.at(track.heading_rad, time_s)
        east_m, north_m = track.at(track.east_m, time_s), track.at(track.north_m, time_s)
        cos, sin = np.cos(heading), np.sin(heading)
        for part in (np.arange(count) + 0.5) / count - 0.5:
            right_m = part * track.width_m
            yield east_m + cos * right_m, north_m - sin * right_m

    def count(self, size_m: float) -> int:
        """Return how many pieces a slice has."""
        return max(1, math.ceil(self.track.width_m / size_m - 1e-9))


def slices_of(strip: Strip, length_m: float) -> Slices:
    """Return the slices of a strip, none longer than `length_m` where the samples allow it.

    They end where the rate changes under the strip and where the field does: each has one rate.
    """
    track = strip.track
    wanted = np.arange(track.distance_m[0], track.distance_m[-1], length_m)
    ends = np.concatenate(
        ([0], np.searchsorted(track.distance_m, wanted), [len(track.distance_m) - 1])
    )
    ends = ends[np.diff(ends, prepend=-1) > 0]
    samples_s = track.time_s[ends]
    # The few turns are put between the samples, whose values are known.
    turns_s = np.unique([run.start_s for run in strip.stretches[1:]])
    places = np.searchsorted(samples_s, turns_s)
    is_between = samples_s[np.minimum(places, len(samples_s) - 1)] != turns_s
    turns_s, places = turns_s[is_between], places[is_between]
    ends_s = np.insert(samples_s, places, turns_s)

    def at_ends(values: Floats) -> Floats:
        return np.insert(values[ends], places, track.at(values, turns_s))

    metres = np.diff(at_ends(track.distance_m))
    kept = metres > 0.0
    middle_s = 0.5 * (ends_s[1:] + ends_s[:-1])[kept]
    area_m2 = track.at(track.across_m, middle_s) * metres[kept]
    inside = np.array([run.inside for run in strip.stretches], dtype=np.bool_)
    starts_s = np.array([run.start_s for run in strip.stretches])
    under = np.clip(np.searchsorted(starts_s, middle_s, "right") - 1, 0, None)
    return Slices(
        track=track,
        time_s=middle_s,
        area_m2=area_m2,
        given_ml=np.diff(at_ends(track.volume_ml))[kept],
        asked_ml=strip.rates_at(middle_s) * ML_M_PER_L_HA_M * area_m2,
        inside=inside[under],
    )


def summed(
    grid: Grid, slices: Slices, size_m: float, values: Sequence[Floats], chosen: Ints
) -> list[Floats]:
    """Return the sums of values of slices by cell, spread evenly over each slice's ground."""
    count, cells = slices.count(size_m), grid.rows * grid.columns
    sums = [np.zeros(cells + 1) for _ in values]
    parts = [value[chosen] / count for value in values]
    places = np.stack([grid.cells_of(*place) for place in slices.pieces(size_m, chosen)])
    low, high = int(places.min(initial=cells)), int(places.max(initial=0))
    if low > high:
        return sums
    for total, part in zip(sums, parts, strict=True):
        weights = np.broadcast_to(part, places.shape).ravel()
        total[low : high + 1] += np.bincount(
            places.ravel() - low, weights=weights, minlength=high - low + 1
        )
    return sums
