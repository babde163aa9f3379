"""Rows and columns of rates in the journal, exact to the last bit: one row of packed arrays."""

from __future__ import annotations

import json
import sqlite3
import zlib

import numpy as np

from companion.core.cells import CellGrid, Warp

# A damaged length must not take the reader's memory.
CELLS_MAX = 64_000_000
_SQL = """
CREATE TABLE cells (
    id INTEGER PRIMARY KEY NOT NULL, row_count INTEGER, column_count INTEGER, classes BLOB,
    rates_l_ha BLOB, warps TEXT
);
INSERT INTO gpkg_contents (table_name, data_type, identifier, description) VALUES
    ('cells', 'attributes', 'cells', 'the prescription in rows and columns');
"""


def write_cells(connection: sqlite3.Connection, cells: CellGrid) -> None:
    """Write the cells: classes as int32 and rates as float64, little-endian, deflated."""
    connection.executescript(_SQL)
    connection.execute(
        "INSERT INTO cells (row_count, column_count, classes, rates_l_ha, warps) "
        "VALUES (?, ?, ?, ?, ?)",
        (
            *cells.shape,
            zlib.compress(cells.classes.astype("<i4").tobytes(), level=1),
            zlib.compress(cells.rates_l_ha.astype("<f8").tobytes(), level=1),
            json.dumps(
                [
                    {"x0": warp.x0, "y0": warp.y0, "scale": warp.scale, "terms": warp.terms}
                    for warp in (cells.to_frame, cells.to_cells)
                ]
            ),
        ),
    )


def read_cells(connection: sqlite3.Connection) -> CellGrid | None:
    """Return the cells, None where the flight had zones; ValueError where they are damaged."""
    there = connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'cells'").fetchone()
    if there is None:
        return None
    found = connection.execute(
        "SELECT row_count, column_count, classes, rates_l_ha, warps FROM cells"
    ).fetchall()
    if len(found) != 1:
        raise ValueError(f"one set of cells expected, got {len(found)}")
    rows, columns, classes, rates, warps = found[0]
    try:
        if not (rows > 0 and columns > 0 and rows * columns <= CELLS_MAX):
            raise ValueError(f"{rows} rows of {columns} cells")
        to_frame, to_cells = (
            Warp(
                x0=float(warp["x0"]),
                y0=float(warp["y0"]),
                scale=float(warp["scale"]),
                terms=tuple((float(u), float(v)) for u, v in warp["terms"]),
            )
            for warp in json.loads(warps)
        )
        return CellGrid(
            np.frombuffer(_unpacked(classes, 4 * rows * columns), dtype="<i4").reshape(
                rows, columns
            ),
            np.frombuffer(_unpacked(rates, 8 * rows * columns), dtype="<f8"),
            to_frame,
            to_cells,
        )
    except (KeyError, TypeError, zlib.error) as error:
        raise ValueError(f"the cells are damaged: {error!r}") from error


def _unpacked(packed: bytes, most_bytes: int) -> bytes:
    """Return deflated bytes in full, or refuse more than such a grid can have."""
    worker = zlib.decompressobj()
    content = worker.decompress(packed, most_bytes + 1)
    if len(content) > most_bytes or not worker.eof:
        raise ValueError("the cells are cut off, or more than a grid can have")
    return content
