"""The ground of a flight, zones and field, as layers of the journal: the very coordinates flown.

They lie in the flight's own frame, whose definition the file carries; so a map viewer shows the
prescription beside what was applied, and replay needs no map file.
"""

from __future__ import annotations

import json
import sqlite3
import zlib
from dataclasses import dataclass

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from companion.core.cells import CellGrid, Warp
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription
from companion.journal.geopackage import (
    LOCAL_ID,
    WGS84_ID,
    geometry_blob,
    layer_sql,
    place_of,
    wkb_of,
)

Area = Polygon | MultiPolygon
# Cells of no more rates than these are drawn as zones too, for whoever looks at the file.
CLASSES_DRAWN_MAX = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """Zones as (name, rate [L/ha], polygon) in their order, or cells; where spraying is allowed."""

    zones: tuple[tuple[str, float, Area], ...]
    cells: CellGrid | None
    field: Area


def write_layers(
    connection: sqlite3.Connection, frame: LocalFrame, prescription: Prescription
) -> None:
    """Register the layers of a journal and write the ground."""
    register_frame(connection, frame)
    connection.executescript(
        layer_sql("applied", "one row a decision", geometry="POINT", srs_id=WGS84_ID)
    )
    write_ground(connection, prescription)


def register_frame(connection: sqlite3.Connection, frame: LocalFrame) -> None:
    """Define the flight's own system, in which the ground lies."""
    definition = frame.crs.to_wkt("WKT1_GDAL")
    connection.execute(
        "INSERT INTO gpkg_spatial_ref_sys VALUES ('Flight', ?, 'NONE', ?, ?, ?)",
        (LOCAL_ID, LOCAL_ID, definition, "metres east and north of the flight's origin"),
    )


def write_ground(connection: sqlite3.Connection, prescription: Prescription) -> None:
    """Write zones or cells, and the field."""
    for sql in (
        layer_sql("zones", "the prescription", geometry="GEOMETRY", srs_id=LOCAL_ID),
        layer_sql("field", "where spraying is allowed", geometry="GEOMETRY", srs_id=LOCAL_ID),
    ):
        connection.executescript(sql)
    cells = prescription.cells
    drawn = cells is None or prescription.zone_count <= CLASSES_DRAWN_MAX
    zones = prescription.zones if drawn else ()
    if cells is not None:
        write_cells(connection, cells)
    blobs = _blobs([zone.polygon for zone in zones])
    connection.execute("BEGIN")
    connection.executemany(
        "INSERT INTO zones (geom, name, rate_l_ha) VALUES (?, ?, ?)",
        ((blob, zone.name, zone.rate_l_ha) for blob, zone in zip(blobs, zones, strict=True)),
    )
    connection.execute("INSERT INTO field (geom) VALUES (?)", _blobs([prescription.field]))
    for table, areas in (
        ("zones", [zone.polygon for zone in zones]),
        ("field", [prescription.field]),
    ):
        set_box(connection, table, _box(areas))
    connection.execute("COMMIT")


def set_box(
    connection: sqlite3.Connection, table: str, box: tuple[float, float, float, float] | None
) -> None:
    """Fill in the extent of a layer: min_x, min_y, max_x, max_y."""
    if box is not None:
        connection.execute(
            "UPDATE gpkg_contents SET min_x = ?, min_y = ?, max_x = ?, max_y = ? "
            "WHERE table_name = ?",
            (*box, table),
        )


def box_of_points(
    connection: sqlite3.Connection, table: str
) -> tuple[float, float, float, float] | None:
    """Return the extent of a layer of points; None without any."""
    rows = connection.execute(f"SELECT geom FROM {table} WHERE geom IS NOT NULL")
    places = [place_of(blob) for (blob,) in rows]
    if not places:
        return None
    xs, ys = zip(*places, strict=True)
    return min(xs), min(ys), max(xs), max(ys)


def read_ground(connection: sqlite3.Connection) -> Ground:
    """Return the ground as it was flown; ValueError where the layers are damaged."""
    cells = read_cells(connection)
    sql = "SELECT name, rate_l_ha, geom FROM zones ORDER BY id"
    rows = connection.execute(sql).fetchall() if cells is None else []
    fields = connection.execute("SELECT geom FROM field").fetchall()
    if len(fields) != 1:
        raise ValueError(f"one field expected, got {len(fields)}")
    areas = _areas([row[2] for row in rows] + [fields[0][0]])
    zones = tuple(
        (name, rate, area) for (name, rate, _), area in zip(rows, areas[:-1], strict=True)
    )
    return Ground(zones=zones, cells=cells, field=areas[-1])


def _blobs(areas: list[Area]) -> list[bytes]:
    """Return GeoPackage geometries; two dimensions, as the core sees the ground."""
    array = np.array(areas, dtype=object)
    binaries = shapely.to_wkb(array, byte_order=1, flavor="iso", output_dimension=2)
    return [
        geometry_blob(wkb, srs_id=LOCAL_ID, is_empty=area.is_empty)
        for wkb, area in zip(binaries, areas, strict=True)
    ]


def _areas(blobs: list[bytes]) -> list[Area]:
    try:
        geometries = shapely.from_wkb([wkb_of(blob) for blob in blobs])
    except (shapely.GEOSException, TypeError) as error:
        raise ValueError(f"a polygon is damaged: {error}") from error
    areas = [area for area in geometries if isinstance(area, Polygon | MultiPolygon)]
    if len(areas) != len(blobs):
        raise ValueError("a layer holds something other than polygons")
    return areas


def _box(areas: list[Area]) -> tuple[float, float, float, float] | None:
    if not areas:
        return None
    west, south, east, north = (float(value) for value in shapely.total_bounds(areas))
    return (west, south, east, north) if abs(west) < float("inf") else None


# Rows and columns of rates in the journal, exact to the last bit: one row of packed arrays.

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
