"""Runs of one rate in a map of cells, along the axis that is nearer to the passes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.core.frame import LocalFrame
from missions.maps.cells import to_degrees
from missions.maps.lint.survey import Survey
from missions.maps.model import MapCells

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class Runs(NamedTuple):
    """For every cell how many of its rate follow each other; a cell's size along and across."""

    length: Ints
    step_m: float
    width_m: float


def cell_steps(cells: MapCells, frame: LocalFrame) -> tuple[Floats, Floats]:
    """Return the steps (east, north) to the next cell of the row and of the column, mid-map."""
    rows, columns = cells.rates_l_ha.shape
    longitude, latitude = to_degrees(
        cells,
        np.array([0.0, 1.0, 0.0]) + columns // 2,
        np.array([0.0, 0.0, 1.0]) + rows // 2,
    )
    east, north = frame.to_local_all(latitude.tolist(), longitude.tolist())
    steps = np.column_stack([east, north])
    return steps[1] - steps[0], steps[2] - steps[0]


def runs_along(survey: Survey, direction: Floats) -> Runs:
    """Return the runs in rows or in columns, whichever is nearer to a direction (east, north)."""
    if survey.cells is None:
        raise ValueError("a map of zones has no runs of cells")
    along_row, along_column = cell_steps(survey.cells, survey.frame)
    row_m, column_m = float(np.hypot(*along_row)), float(np.hypot(*along_column))
    if abs(along_row @ direction) / row_m >= abs(along_column @ direction) / column_m:
        return Runs(run_lengths(survey.rates), row_m, column_m)
    return Runs(run_lengths(survey.rates.T).T, column_m, row_m)


def run_lengths(rates: Floats) -> Ints:
    """Return for every cell how many cells of its rate follow each other in its row.

    >>> run_lengths(np.array([[1.0, 1.0, 2.0], [1.0, np.nan, np.nan]])).tolist()
    [[2, 2, 1], [1, 2, 2]]
    """
    starts = np.ones(rates.shape, dtype=np.bool_)
    none = np.isnan(rates)
    starts[:, 1:] = (rates[:, 1:] != rates[:, :-1]) & ~(none[:, 1:] & none[:, :-1])
    length = np.diff(np.flatnonzero(starts), append=rates.size)
    result: Ints = np.repeat(length, length).reshape(rates.shape)
    return result
