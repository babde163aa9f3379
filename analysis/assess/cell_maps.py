"""P2's comparison cell by cell: what was commanded, what came, and how far apart they are.

As its Figs. 10, 15, 16 and 17: maps on the map's own grid (else square cells of a stated size),
relative error with small cells left blank, duty, histogram with mean and standard deviation. What
is measured here is the record's volume, over the ground of the field that the strips passed in each
cell, but for what they spared as treated before. What was commanded is the map's rate where a cell
lies in one zone, else the mean of what the strips were to spray there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from analysis.assess.ground_elements import Grid, Slices, SquareGrid, slices_of, summed
from analysis.changes import rates_of_squares
from companion.core.nozzle import flow_for_rate

if TYPE_CHECKING:
    from collections.abc import Sequence

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
# A cell of which less than this was passed says little about a cell.
PASSED_MIN = 0.10
PIECES_PER_CELL = 5
# Pieces of ground are not longer: one that lies across a boundary counts for one of its sides.
PIECE_MAX_M = 0.2
CELLS_MAX = 2_000_000
L_HA_PER_ML_M2 = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CellMaps:
    """Maps of one flight, (rows, columns) each, NaN where a cell was not passed.

    `corner_east_m` and `corner_north_m` are (rows + 1, columns + 1), in the flight's frame: what
    `pcolormesh` takes. `commanded_l_ha` is what was prescribed where the strips passed, `passes`
    how often the ground was passed on average, `duty` that of the orders in force. All are means
    over the field's ground: a cell that it has half of is judged by that half.
    """

    source: Literal["map", "squares"]
    cell_m: float
    corner_east_m: Floats
    corner_north_m: Floats
    commanded_l_ha: Floats
    measured_l_ha: Floats
    passes: Floats
    duty: Floats
    speed_m_s: Floats
    deviation_l_min: Floats
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
) -> CellMaps | None:
    """Return the maps of a flight; None where no strip came over the field.

    `duties` are those in force at every sample of the record, for each strip. With `cell_m` the
    cells are squares of that size, else the map's own, or squares of a strip's width.
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
    square_m = size_m if source == "squares" else None
    commanded = _commanded(record.prescription, sums, corners, square_m)
    return _maps(commanded, sums, corners, source, size_m, record.boom.width_m)


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
    given_ml: Floats
    duty: Floats
    speed: Floats


def _sums(grid: Grid, strips: Sequence[Strip], duties: Sequence[Floats], piece_m: float) -> _Sums:
    """Return areas, asked and given volume, area x duty and area x speed of each cell."""
    totals = np.zeros((6, grid.rows * grid.columns + 1))
    for strip, duty in zip(strips, duties, strict=True):
        slices = slices_of(strip, piece_m)
        # Closed over ground that was treated before, a strip takes no part: what fell there before
        # is what came, not the mean of that and nothing.
        passed = slices.inside & ~strip.spared_at(slices.time_s)
        chosen = np.flatnonzero(passed | (slices.given_ml > 1e-9))
        totals += summed(grid, slices, piece_m, _values(slices, duty), chosen)
    area, inside, asked_ml, given_ml, duty_m2, speed = (
        total[:-1].reshape(grid.rows, grid.columns) for total in totals
    )
    return _Sums(
        area=area, inside=inside, asked_ml=asked_ml, given_ml=given_ml, duty=duty_m2, speed=speed
    )


def _values(slices: Slices, duty: Floats) -> list[Floats]:
    track, area = slices.track, slices.area_m2
    at_duty, at_speed = track.at(duty, slices.time_s), track.at(track.speed_m_s, slices.time_s)
    inside = np.where(slices.inside, area, 0.0)
    return [area, inside, slices.asked_ml, slices.given_ml, area * at_duty, area * at_speed]


def _maps(
    commanded: Floats,
    sums: _Sums,
    corners: tuple[Floats, Floats],
    source: Literal["map", "squares"],
    cell_m: float,
    width_m: float,
) -> CellMaps:
    ground, passed = _ground(sums, corners)
    measured = L_HA_PER_ML_M2 * _share(sums.given_ml, ground, passed)
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
        passes=ground / _cell_areas(*corners),
        duty=_share(sums.duty, sums.area, passed),
        speed_m_s=speeds,
        deviation_l_min=flow_error,
        histogram_l_ha=Histogram.of((measured - commanded)[counts], "L/ha"),
        histogram_l_min=Histogram.of(flow_error[counts], "L/min"),
    )


def _commanded(
    prescription: Prescription, sums: _Sums, corners: tuple[Floats, Floats], size_m: float | None
) -> Floats:
    """Return the rate of each cell that was passed; of squares of that size, where it is given.

    A strip has the rate under its middle. A square in one zone that the end of a strip of another
    zone comes over is still to get its own rate.
    """
    ground, passed = _ground(sums, corners)
    commanded = L_HA_PER_ML_M2 * _share(sums.asked_ml, ground, passed)
    if size_m is not None:
        west_m, south_m = corners[0][:-1, :-1][passed], corners[1][:-1, :-1][passed]
        sure, rates = rates_of_squares(prescription, west_m, south_m, size_m)
        commanded[passed] = np.where(sure, rates, commanded[passed])
    return commanded


def _ground(sums: _Sums, corners: tuple[Floats, Floats]) -> tuple[Floats, Bools]:
    """Return the ground that counts in each cell, outside the field all; and if it is enough."""
    ground = np.where(sums.inside > 0.0, sums.inside, sums.area)
    return ground, ground > PASSED_MIN * _cell_areas(*corners)


def _share(total: Floats, ground: Floats, passed: Bools) -> Floats:
    share: Floats = np.divide(total, ground, out=np.full(ground.shape, np.nan), where=passed)
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
        self._cells = cells
        self.column = int(np.clip(np.floor(column.min()), 0, columns - 1))
        self.row = int(np.clip(np.floor(row.min()), 0, rows - 1))
        self.columns = int(np.clip(np.ceil(column.max()), self.column + 1, columns)) - self.column
        self.rows = int(np.clip(np.ceil(row.max()), self.row + 1, rows)) - self.row

    def cells_of(self, east_m: Floats, north_m: Floats) -> Ints:
        """Return the number of each point's cell; rows x columns beside the grid."""
        column, row = self._cells.to_cells(east_m, north_m)
        column, row = column - self.column, row - self.row
        inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        number = np.floor(row).astype(np.int64) * self.columns + np.floor(column).astype(np.int64)
        return np.where(inside, number, self.rows * self.columns)

    def corners(self) -> tuple[Floats, Floats]:
        """Return east and north of the cells' corners: (rows + 1, columns + 1) each."""
        rows, columns = np.meshgrid(
            np.arange(self.rows + 1.0) + self.row,
            np.arange(self.columns + 1.0) + self.column,
            indexing="ij",
        )
        east_m, north_m = self._cells.to_frame(columns.ravel(), rows.ravel())
        return east_m.reshape(rows.shape), north_m.reshape(rows.shape)
