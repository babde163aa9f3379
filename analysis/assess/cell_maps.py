"""P2's comparison cell by cell: what was commanded, what came, and how far apart they are.

As its Figs. 10, 15, 16 and 17: maps on the map's own grid (else square cells of a stated size),
relative error with small cells left blank, duty, histogram with mean and standard deviation. What
is measured is a dose: the sum of all that fell on a cell, over the ground of the field in it that
the strips came over, once or often, or were to: the ends of a line that was flown are bare ground,
and no ground beside it. What was commanded is the map's rate where a cell lies in one zone, else
the mean of what the strips were to spray there.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.assess.ground import within
from analysis.assess.ground_elements import Grid, Slices, SquareGrid, slices_of, summed
from analysis.changes import ground_rates, rates_of_squares
from analysis.track import in_field
from companion.core.nozzle import flow_for_rate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shapely.geometry.base import BaseGeometry

    from analysis.flight_record import FlightRecord
    from analysis.strips import Strip
    from analysis.track import Bools, Floats, Ints
    from companion.core.cells import CellGrid
    from companion.core.prescription import Prescription


# How often cells deviate by how much.

HISTOGRAM_BINS = 41


@dataclass(frozen=True, slots=True, kw_only=True)
class Histogram:
    """Deviations of cells in one unit: + is too much; `edges` has one value more than `counts`."""

    unit: Literal["L/ha", "L/min"]
    edges: Floats
    counts: Ints
    mean: float
    sd: float
    mean_abs: float
    sd_abs: float
    cells: int

    @staticmethod
    def of(values: Floats, unit: Literal["L/ha", "L/min"]) -> Histogram | None:
        """Return the histogram of the values that are numbers; None without any."""
        known = values[np.isfinite(values)]
        if not len(known):
            return None
        # Nearly all: a few cells at the edge would make all others one bar.
        most = max(float(np.quantile(np.abs(known), 0.99)), 1e-6)
        counts, edges = np.histogram(
            np.clip(known, -most, most), bins=HISTOGRAM_BINS, range=(-most, most)
        )
        distances = np.abs(known)
        return Histogram(
            unit=unit,
            edges=edges,
            counts=counts,
            mean=float(known.mean()),
            sd=float(known.std()),
            mean_abs=float(distances.mean()),
            sd_abs=float(distances.std()),
            cells=len(known),
        )

    def as_json(self) -> dict[str, Any]:
        """Return it without its bars."""
        return {
            "unit": self.unit, "mean": self.mean, "sd": self.sd,
            "mean_abs": self.mean_abs, "sd_abs": self.sd_abs, "cells": self.cells,
        }  # fmt: skip


# P2 leaves cells blank whose commanded flow is below this part of the highest.
BLANK_BELOW = 0.10
OFF_BY = 0.10
# A cell of which less than this was passed says little about a cell.
PASSED_MIN = 0.10
PIECES_PER_CELL = 5
# Pieces of ground are not longer: one that lies across a boundary counts for one of its sides.
PIECE_MAX_M = 0.2
CELLS_MAX = 1_000_000
# The ground that strips came over is counted in parts of a cell, so many in all.
PARTS_MAX = 4_000_000
# Samples are not spaced as parts are: of one wholly under a strip so much is met at least.
TAKEN_FROM = 0.3
L_HA_PER_ML_M2 = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CellMaps:
    """Maps of one flight, (rows, columns) each, NaN where a cell was not passed.

    `corner_east_m` and `corner_north_m` are (rows + 1, columns + 1), in the flight's frame: what
    `pcolormesh` takes. `commanded_l_ha` is what was prescribed where the strips passed, `passes`
    how often the ground was passed on average, `duty` that of the orders in force, `ground_m2` what
    the strips came over. All are of the field's ground: a cell that it has half of is judged by
    that half.
    """

    source: Literal["map", "squares"]
    cell_m: float
    corner_east_m: Floats
    corner_north_m: Floats
    commanded_l_ha: Floats
    measured_l_ha: Floats
    ground_m2: Floats
    passes: Floats
    duty: Floats
    speed_m_s: Floats
    histogram_l_ha: Histogram | None
    histogram_l_min: Histogram | None

    @property
    def deviation_l_ha(self) -> Floats:
        """Return measured less commanded: + is too much."""
        difference: Floats = self.measured_l_ha - self.commanded_l_ha
        return difference

    @property
    def relative_error_percent(self) -> Floats:
        """Return the deviation over what was commanded; blank (NaN) for the smallest rates."""
        asked = self.commanded_l_ha
        most = float(np.nanmax(asked)) if np.isfinite(asked).any() else 0.0
        counts = np.isfinite(asked) & (asked > 0.0) & (asked >= BLANK_BELOW * most)
        error: Floats = np.full(asked.shape, np.nan)
        error[counts] = 100.0 * self.deviation_l_ha[counts] / asked[counts]
        return error

    @property
    def judged_m2(self) -> float:
        """Return the ground that had a rate and was passed."""
        return float(self.ground_m2[self.commanded_l_ha > 0.0].sum())

    @property
    def within_percent(self) -> float | None:
        """Return the share of that ground, cell by cell, that got its rate within 10 %."""
        if not self.judged_m2 > 0.0:
            return None
        asked = self.commanded_l_ha
        near = (asked > 0.0) & (np.abs(self.deviation_l_ha) <= OFF_BY * asked)
        return 100.0 * float(self.ground_m2[near].sum()) / self.judged_m2

    def as_json(self) -> dict[str, Any]:
        """Return what the maps say in sum; the maps themselves are arrays."""
        both = (self.histogram_l_ha, self.histogram_l_min)
        return {
            "source": self.source,
            "cell_m": self.cell_m,
            "rows": self.commanded_l_ha.shape[0],
            "columns": self.commanded_l_ha.shape[1],
            "passed": int(np.isfinite(self.commanded_l_ha).sum()),
            "deviation": [each.as_json() for each in both if each is not None],
        }


def cell_maps(
    record: FlightRecord,
    strips: Sequence[Strip],
    duties: Sequence[Floats],
    *,
    cell_m: float | None = None,
    flown: BaseGeometry | None = None,
) -> CellMaps | None:
    """Return the maps of a flight; None where no strip came over the field.

    `duties` are those in force at every sample of the record, for each strip. With `cell_m` the
    cells are squares of that size, else the map's own, or squares of a strip's width. `flown` is
    the ground of the lines that were flown, where there are lines.
    """
    bounds = _bounds(strips)
    if bounds is None:
        return None
    own = record.prescription.cells
    size_m = cell_m or max(1.0, min(strip.track.width_m for strip in strips))
    area_m2 = (bounds[2] - bounds[0]) * (bounds[3] - bounds[1])
    size_m = max(size_m, (area_m2 / CELLS_MAX) ** 0.5)
    grid: MapCells | SquareGrid
    source: Literal["map", "squares"]
    if own is not None and cell_m is None:
        grid, source = MapCells(own, bounds), "map"
        corners = grid.corners()
        size_m = float(np.hypot(*(np.diff(each[0, :2])[0] for each in corners)))
    else:
        grid = SquareGrid.over(bounds, size_m)
        source = "squares"
        corners = grid.corners()
    sums = _sums(grid, strips, duties, min(size_m / PIECES_PER_CELL, PIECE_MAX_M))
    fallen = _fallen(grid, strips, record.prescription, corners, flown)
    square_m = size_m if source == "squares" else None
    passed = fallen[0] > PASSED_MIN * _cell_areas(*corners)
    commanded = _commanded(record.prescription, sums, corners, square_m, passed)
    return _maps(commanded, sums, fallen, corners, source, size_m, record.boom.width_m)


def _bounds(strips: Sequence[Strip]) -> tuple[float, float, float, float] | None:
    """Return the box of ground on which a strip had something to spray, or sprayed."""
    boxes = []
    for strip in strips:
        marks = strip.track.marks
        active = np.diff(strip.asked_ml[marks]) + np.diff(strip.track.volume_ml[marks]) > 1e-9
        at = marks[:-1][active]
        if len(at):
            half_m = 0.5 * strip.track.width_m
            east_m, north_m = strip.track.east_m[at], strip.track.north_m[at]
            boxes.append(
                (east_m.min() - half_m, north_m.min() - half_m,
                 east_m.max() + half_m, north_m.max() + half_m)
            )  # fmt: skip
    if not boxes:
        return None
    low, high = np.array(boxes).min(axis=0), np.array(boxes).max(axis=0)
    return float(low[0]), float(low[1]), float(high[2]), float(high[3])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sums:
    """What was summed up in each cell; areas in m2, `inside` that of the field."""

    area: Floats
    inside: Floats
    asked_ml: Floats
    duty: Floats
    speed: Floats


def _sums(grid: Grid, strips: Sequence[Strip], duties: Sequence[Floats], piece_m: float) -> _Sums:
    """Return areas, asked volume, area x duty and area x speed of each cell, pass by pass."""
    totals = np.zeros((5, grid.rows * grid.columns + 1))
    for strip, duty in zip(strips, duties, strict=True):
        slices = slices_of(strip, piece_m)
        chosen = _taking_part(strip, slices)
        totals += summed(grid, slices, piece_m, _values(slices, duty), chosen)
    area, inside, asked_ml, duty_m2, speed = (
        total[:-1].reshape(grid.rows, grid.columns) for total in totals
    )
    return _Sums(area=area, inside=inside, asked_ml=asked_ml, duty=duty_m2, speed=speed)


def _taking_part(strip: Strip, slices: Slices) -> Ints:
    """Return the slices that count: not where nothing was asked, as all was treated before."""
    passed = slices.inside & ~strip.spared_at(slices.time_s)
    return np.flatnonzero(passed | (slices.given_ml > 1e-9))


def _fallen(
    grid: MapCells | SquareGrid,
    strips: Sequence[Strip],
    prescription: Prescription,
    corners: tuple[Floats, Floats],
    flown: BaseGeometry | None,
) -> tuple[Floats, Floats]:
    """Return each cell's ground that strips came over [m2], and all that fell on it [mL].

    Of a cell with ground in the field that ground alone counts, and what fell on it.
    """
    cells = grid.rows * grid.columns
    size_m = min(
        float(np.hypot(*(np.diff(each[:2, :2], axis=axis)[0, 0] for each in corners)))
        for axis in (0, 1)
    )
    count = max(2, min(math.ceil(size_m / PIECE_MAX_M), math.isqrt(PARTS_MAX // cells)))
    fine, piece_m = grid.finer(count), 0.5 * size_m / count
    totals = np.zeros((2, cells * count * count + 1))
    for strip in strips:
        slices = slices_of(strip, piece_m)
        values = [slices.area_m2, slices.given_ml]
        totals += summed(fine, slices, piece_m, values, _taking_part(strip, slices))
    over_m2, given_ml = totals[:, :-1]
    part_m2 = np.repeat(np.repeat(_cell_areas(*corners), count, 0), count, 1).ravel() / count**2
    over = over_m2 > TAKEN_FROM * part_m2
    if flown is not None:
        rest = np.flatnonzero(~over)
        over[rest] = within(flown, *fine.middles(rest))
    some = np.flatnonzero(over | (given_ml > 0.0))
    inside = np.zeros(len(over), dtype=np.bool_)
    inside[some] = in_field(prescription, *fine.middles(some))

    def of_cells(values: Floats) -> Floats:
        parts = values.reshape(grid.rows, count, grid.columns, count)
        total: Floats = parts.sum(axis=(1, 3))
        return total

    own_m2 = of_cells(part_m2 * (over & inside))
    ground_m2 = np.where(own_m2 > 0.0, own_m2, of_cells(part_m2 * over))
    fell_ml = np.where(own_m2 > 0.0, of_cells(given_ml * inside), of_cells(given_ml))
    return ground_m2, fell_ml


def _values(slices: Slices, duty: Floats) -> list[Floats]:
    track, area = slices.track, slices.area_m2
    at_duty, at_speed = track.at(duty, slices.time_s), track.at(track.speed_m_s, slices.time_s)
    inside = np.where(slices.inside, area, 0.0)
    return [area, inside, slices.asked_ml, area * at_duty, area * at_speed]


def _maps(
    commanded: Floats,
    sums: _Sums,
    fallen: tuple[Floats, Floats],
    corners: tuple[Floats, Floats],
    source: Literal["map", "squares"],
    cell_m: float,
    width_m: float,
) -> CellMaps:
    ground_m2, fell_ml = fallen
    passed = np.isfinite(commanded)
    measured = L_HA_PER_ML_M2 * _share(fell_ml, ground_m2, passed)
    speeds = _share(sums.speed, sums.area, passed)
    flow_error = (measured - commanded) * flow_for_rate(1.0, 1.0, width_m) * speeds
    counts = commanded > 0.0
    return CellMaps(
        source=source,
        cell_m=cell_m,
        corner_east_m=corners[0],
        corner_north_m=corners[1],
        commanded_l_ha=commanded,
        measured_l_ha=measured,
        ground_m2=ground_m2,
        passes=np.where(sums.inside > 0.0, sums.inside, sums.area) / _cell_areas(*corners),
        duty=_share(sums.duty, sums.area, passed),
        speed_m_s=speeds,
        histogram_l_ha=Histogram.of((measured - commanded)[counts], "L/ha"),
        histogram_l_min=Histogram.of(flow_error[counts], "L/min"),
    )


def _commanded(
    prescription: Prescription,
    sums: _Sums,
    corners: tuple[Floats, Floats],
    size_m: float | None,
    passed: Bools,
) -> Floats:
    """Return the rate of each cell that was passed; of squares of that size, where it is given.

    A strip has the rate under its middle. A square in one zone that the end of a strip of another
    zone comes over is still to get its own rate, and so is one that no strip came over.
    """
    commanded: Floats = np.full(passed.shape, np.nan)
    middle = [(each[1:, 1:] + each[:-1, :-1])[passed] / 2.0 for each in corners]
    commanded[passed] = np.nan_to_num(ground_rates(prescription, *middle))
    asked = passed & (sums.inside > 0.0)
    commanded[asked] = L_HA_PER_ML_M2 * sums.asked_ml[asked] / sums.inside[asked]
    if size_m is not None:
        west_m, south_m = corners[0][:-1, :-1][passed], corners[1][:-1, :-1][passed]
        sure, rates = rates_of_squares(prescription, west_m, south_m, size_m)
        commanded[passed] = np.where(sure, rates, commanded[passed])
    return commanded


def _share(total: Floats, ground: Floats, passed: Bools) -> Floats:
    where = passed & (ground > 0.0)
    share: Floats = np.divide(total, ground, out=np.full(ground.shape, np.nan), where=where)
    return share


def _cell_areas(east_m: Floats, north_m: Floats) -> Floats:
    """Return the area of each cell: half the cross product of its diagonals."""
    one_e, one_n = east_m[1:, 1:] - east_m[:-1, :-1], north_m[1:, 1:] - north_m[:-1, :-1]
    two_e, two_n = east_m[1:, :-1] - east_m[:-1, 1:], north_m[1:, :-1] - north_m[:-1, 1:]
    areas: Floats = 0.5 * np.abs(one_e * two_n - one_n * two_e)
    return areas


# The cells of a map that lie under a flight, as a grid for sums.


class MapCells:
    """The cells of the map that a box of ground meets."""

    def __init__(self, cells: CellGrid, bounds_m: tuple[float, float, float, float]) -> None:
        west, south, east, north = bounds_m
        column, row = cells.to_cells(
            np.array([west, west, east, east]), np.array([south, north, south, north])
        )
        (rows, columns) = cells.shape
        self._cells, self.count = cells, 1
        self.column = int(np.clip(np.floor(column.min()), 0, columns - 1))
        self.row = int(np.clip(np.floor(row.min()), 0, rows - 1))
        self.columns = int(np.clip(np.ceil(column.max()), self.column + 1, columns)) - self.column
        self.rows = int(np.clip(np.ceil(row.max()), self.row + 1, rows)) - self.row

    def cells_of(self, east_m: Floats, north_m: Floats) -> Ints:
        """Return the number of each point's cell; rows x columns beside the grid."""
        column, row = self._cells.to_cells(east_m, north_m)
        column, row = self.count * (column - self.column), self.count * (row - self.row)
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        number = np.floor(row).astype(np.int64) * self.columns + np.floor(column).astype(np.int64)
        return np.where(inside, number, self.rows * self.columns)

    def finer(self, count: int) -> MapCells:
        """Return the same ground in `count` times as many rows and columns."""
        found = copy(self)
        found.count = self.count * count
        found.rows, found.columns = self.rows * count, self.columns * count
        return found

    def middles(self, numbers: Ints) -> tuple[Floats, Floats]:
        """Return where the middles of cells are."""
        row, column = np.divmod(numbers, self.columns)
        return self._cells.to_frame(
            self.column + (column + 0.5) / self.count, self.row + (row + 0.5) / self.count
        )

    def corners(self) -> tuple[Floats, Floats]:
        """Return east and north of the cells' corners: (rows + 1, columns + 1) each."""
        rows, columns = np.meshgrid(
            np.arange(self.rows + 1.0) + self.row,
            np.arange(self.columns + 1.0) + self.column,
            indexing="ij",
        )
        east_m, north_m = self._cells.to_frame(columns.ravel(), rows.ravel())
        return east_m.reshape(rows.shape), north_m.reshape(rows.shape)
