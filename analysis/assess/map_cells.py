"""The cells of a map that lie under a flight, as a grid for sums."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from analysis.track import Floats, Ints
    from companion.core.cells import CellGrid


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
