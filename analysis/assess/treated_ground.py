"""Which ground was treated, treated again, or left out between passes: counted on small squares.

Squares of half a metre: what is narrower than a quarter of a metre (the noise with which an
aircraft holds its line) is neither a gap nor an overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.assess.ground_elements import SquareGrid, slices_of, summed
from analysis.assess.ground_rates import ground_rates

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.flight_record import FlightRecord
    from analysis.strips import Strip
    from analysis.track import Bools, Floats

CELL_M = 0.5
PIECE_M = 0.125
CELLS_MAX = 4_000_000
# A slice was sprayed where it got this part of what was prescribed there.
WET_FROM = 0.10
DOUBLED_FROM = 1.5
LEFT_OUT_BELOW = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class TreatedGround:
    """Areas in square metres; `between_m2` is the untreated ground with treated on both sides."""

    treated_m2: float
    doubled_m2: float
    between_m2: float
    untreated_m2: float


def treated_ground(record: FlightRecord, strips: Sequence[Strip]) -> TreatedGround:
    """Return how the field was covered."""
    prescription = record.prescription
    if prescription.field.is_empty:
        return TreatedGround(treated_m2=0.0, doubled_m2=0.0, between_m2=0.0, untreated_m2=0.0)
    west, south, east, north = prescription.bounds_m
    cell_m = max(CELL_M, ((east - west) * (north - south) / CELLS_MAX) ** 0.5)
    grid = SquareGrid.over((west, south, east, north), cell_m)
    covered = np.zeros(grid.rows * grid.columns + 1)
    passed = np.zeros(grid.rows * grid.columns + 1)
    for strip in strips:
        slices = slices_of(strip, PIECE_M)
        active = np.flatnonzero((slices.given_ml > 1e-9) | (slices.asked_ml > 0.0))
        wet = np.where(slices.given_ml > WET_FROM * slices.asked_ml, slices.area_m2, 0.0)
        dry = slices.area_m2 - wet
        for total, each in zip(
            (covered, passed), summed(grid, slices, PIECE_M, [wet, dry], active), strict=True
        ):
            total += each
    shape = (grid.rows, grid.columns)
    area = cell_m * cell_m
    times = covered[:-1].reshape(shape) / area
    under = passed[:-1].reshape(shape) / area
    open_ground = _rated(record, grid, times < LEFT_OUT_BELOW)
    # What a strip passed with its valve closed is judged along the strip.
    missed = open_ground & (times + under < LEFT_OUT_BELOW)
    closed = _closed(times + under >= LEFT_OUT_BELOW, record.boom.width_m / cell_m)
    return TreatedGround(
        treated_m2=float((times >= LEFT_OUT_BELOW).sum()) * area,
        doubled_m2=float((times[times > DOUBLED_FROM] - 1.0).sum()) * area,
        between_m2=float((missed & closed).sum()) * area,
        untreated_m2=float(open_ground.sum()) * area,
    )


def _rated(record: FlightRecord, grid: SquareGrid, asked: Bools) -> Bools:
    """Return which of some squares have something prescribed in their middle."""
    row, column = np.nonzero(asked)
    east: Floats = grid.west_m + grid.cell_m * (column.astype(np.float64) + 0.5)
    north: Floats = grid.south_m + grid.cell_m * (row.astype(np.float64) + 0.5)
    found = np.zeros(asked.shape, dtype=np.bool_)
    found[row, column] = ground_rates(record.prescription, east, north) > 0.0
    return found


def _closed(treated: Bools, width: float) -> Bools:
    """Return the treated squares and what lies between them, up to `width` squares apart."""
    reach = max(int(width / 2.0), 1)
    padded = np.pad(treated, 2 * reach)
    grown = _box_sum(padded.astype(np.float64), reach) > 0.5
    shrunk = _box_sum((~grown).astype(np.float64), reach) < 0.5
    return shrunk[2 * reach : -2 * reach, 2 * reach : -2 * reach]


def _box_sum(values: Floats, reach: int) -> Floats:
    """Return the sum over the square of `reach` to each side."""
    for axis in (0, 1):
        total = np.cumsum(values, axis=axis)
        count = values.shape[axis]
        high = np.minimum(np.arange(count) + reach, count - 1)
        low = np.arange(count) - reach - 1
        below = np.take(total, np.maximum(low, 0), axis=axis)
        outside = np.expand_dims(low < 0, 1 - axis)
        values = np.take(total, high, axis=axis) - np.where(outside, 0.0, below)
    return values
