"""The ground of a flight, zones and field, as layers of the journal: the very coordinates flown.

They lie in the flight's own frame, whose definition the file carries; so a map viewer shows the
prescription beside what was applied, and replay needs no map file.
"""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from companion.core.cells import CellGrid
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription
from companion.record.cell_table import read_cells, write_cells
from companion.record.geopackage import (
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
