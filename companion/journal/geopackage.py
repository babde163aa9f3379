"""The GeoPackage around the journal's tables: header, required tables, geometries as bytes.

OGC 12-128r18 (GeoPackage 1.4): application_id and user_version in the file's header, the tables
`gpkg_spatial_ref_sys`, `gpkg_contents` and `gpkg_geometry_columns`, geometries as a header of
eight bytes and well-known binary. No R-tree: its triggers call functions that plain SQLite lacks.

The ground of a flight, zones and field, as layers of the journal: the very coordinates flown. They
lie in the flight's own frame, whose definition the file carries; so a map viewer shows the
prescription beside what was applied, and replay needs no map file.
"""

from __future__ import annotations

import json
import sqlite3
import struct
import zlib
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from companion.core.cells import CellGrid, Warp
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription

APPLICATION_ID = 0x47504B47  # "GPKG"
USER_VERSION = 10400
JOURNAL_VERSION = "2"  # what journals of each version have where: `reader.py`
# Part of each page stays empty. Measured, a journal is 27.2 MB an hour with these, 27.5 with 2048,
# and 28.2 with 512: two rows of `applied` fill such a page, a third does not go in.
PAGE_BYTES = 1024
WGS84_ID = 4326
LOCAL_ID = 100_000  # the flight's own frame: metres east and north of its origin
_LITTLE_ENDIAN = 0x01
_EMPTY = 0x10
_HEADER = struct.Struct("<2sBBi")
_POINT = struct.Struct("<2sBBiBIdd")

WGS84_WKT = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,'
    'AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,'
    'AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],'
    'AXIS["Latitude",NORTH],AXIS["Longitude",EAST],AUTHORITY["EPSG","4326"]]'
)

# What every GeoPackage must have.
REGISTERS = f"""
PRAGMA page_size = {PAGE_BYTES};
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {USER_VERSION};
CREATE TABLE gpkg_spatial_ref_sys (
    srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
    organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT
);
CREATE TABLE gpkg_contents (
    table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
    description TEXT DEFAULT '',
    last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now')),
    min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
    CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id)
);
CREATE TABLE gpkg_geometry_columns (
    table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
    srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
    CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
    CONSTRAINT uk_gc_table_name UNIQUE (table_name),
    CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents (table_name),
    CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id)
);
INSERT INTO gpkg_spatial_ref_sys VALUES
    ('Undefined Cartesian', -1, 'NONE', -1, 'undefined', NULL),
    ('Undefined geographic', 0, 'NONE', 0, 'undefined', NULL),
    ('WGS 84', {WGS84_ID}, 'EPSG', {WGS84_ID}, '{WGS84_WKT}', 'longitude, latitude');
"""
# The ground of a flight, in its journal and in its flight map.
GROUND_TABLES = """CREATE TABLE zones (
    id INTEGER PRIMARY KEY NOT NULL, geom GEOMETRY, name TEXT, rate_l_ha DOUBLE
);
CREATE TABLE field (id INTEGER PRIMARY KEY NOT NULL, geom GEOMETRY);
"""
META_TABLE = (
    "CREATE TABLE meta (id INTEGER PRIMARY KEY NOT NULL, key TEXT NOT NULL UNIQUE, value TEXT);\n"
)
# The key of the row of `meta` that says nothing and takes room (`journal.py`).
RESERVE = "reserve"
# All tables at once: one that came in the flight would have its entry in the list of tables far
# behind, and nothing of a file that is cut off before it could be read.
SCHEMA = f"""{REGISTERS}CREATE TABLE applied (
    sequence INTEGER PRIMARY KEY NOT NULL, geom POINT, time DATETIME, time_s DOUBLE,
    rate_l_ha DOUBLE, target_flow_l_min DOUBLE, flow_l_min DOUBLE, duty DOUBLE,
    speed_m_s DOUBLE, course_deg DOUBLE, heading_deg DOUBLE, height_m DOUBLE,
    inhibits TEXT, valve_rates_l_ha TEXT
);
{GROUND_TABLES}CREATE TABLE blocks (
    first_sequence INTEGER PRIMARY KEY NOT NULL, last_sequence INTEGER, row_count INTEGER,
    from_s DOUBLE, until_s DOUBLE, dictionary INTEGER, crc32 INTEGER, body BLOB,
    decisions_crc32 INTEGER, decisions BLOB
);
CREATE TABLE block_dictionaries (id INTEGER PRIMARY KEY NOT NULL, body BLOB);
CREATE TABLE valve_changes (
    id INTEGER PRIMARY KEY NOT NULL, planned_us INTEGER, actual_us INTEGER, valve INTEGER,
    duty_permille INTEGER
);
CREATE TABLE link_stats (
    id INTEGER PRIMARY KEY NOT NULL, time_s DOUBLE, bytes_in INTEGER, bytes_out INTEGER,
    frames_in INTEGER, frames_out INTEGER, bad_frames INTEGER, refused_frames INTEGER,
    unsent_frames INTEGER, lost_percent DOUBLE, frames_per_s DOUBLE, bytes_in_per_s DOUBLE,
    bytes_out_per_s DOUBLE, position_hz DOUBLE, round_trip_s DOUBLE
);
CREATE TABLE events (
    sequence INTEGER PRIMARY KEY NOT NULL, time DATETIME, time_s DOUBLE, kind TEXT, text TEXT
);
CREATE TABLE coverage_tiles (
    id INTEGER PRIMARY KEY NOT NULL, kind TEXT NOT NULL, tile_east INTEGER NOT NULL,
    tile_north INTEGER NOT NULL, cells BLOB NOT NULL, UNIQUE (kind, tile_east, tile_north)
);
{META_TABLE}INSERT INTO gpkg_contents (table_name, data_type, identifier, description) VALUES
    ('blocks', 'attributes', 'blocks', 'every input and decision, in order, packed'),
    ('block_dictionaries', 'attributes', 'block_dictionaries', 'for the packing of the blocks'),
    ('valve_changes', 'attributes', 'valve_changes', 'changes of the valves'),
    ('link_stats', 'attributes', 'link_stats', 'how the link to the vehicle does'),
    ('events', 'attributes', 'events', 'what happened besides'),
    ('meta', 'attributes', 'meta', 'set-up, versions, state of the file');
"""


def layer_sql(table: str, description: str, *, geometry: str, srs_id: int) -> str:
    """Return the statements that register `table` as a layer with a geometry."""
    return (
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, srs_id) "
        f"VALUES ('{table}', 'features', '{table}', '{description}', {srs_id});"
        f"INSERT INTO gpkg_geometry_columns VALUES ('{table}', 'geom', '{geometry}', {srs_id}, "
        "0, 0);"
    )


def point_blob(longitude_deg: float, latitude_deg: float) -> bytes:
    """Return a point in WGS84 as GeoPackage bytes."""
    return _POINT.pack(
        b"GP", 0, _LITTLE_ENDIAN, WGS84_ID, _LITTLE_ENDIAN, 1, longitude_deg, latitude_deg
    )


def place_of(blob: bytes) -> tuple[float, float]:
    """Return longitude and latitude of a `point_blob`; ValueError for anything else."""
    if len(blob) != _POINT.size:
        raise ValueError("no point of this journal")
    longitude_deg, latitude_deg = _POINT.unpack(blob)[-2:]
    return longitude_deg, latitude_deg


def geometry_blob(wkb: bytes, *, srs_id: int, is_empty: bool) -> bytes:
    """Return well-known binary with the GeoPackage's header before it, without an envelope."""
    flags = _LITTLE_ENDIAN | (_EMPTY if is_empty else 0)
    return _HEADER.pack(b"GP", 0, flags, srs_id) + wkb


def wkb_of(blob: bytes) -> bytes:
    """Return the well-known binary of a geometry without an envelope; ValueError otherwise."""
    if len(blob) < _HEADER.size or blob[:2] != b"GP" or blob[3] & 0x0E:
        raise ValueError("no GeoPackage geometry of this journal")
    return blob[_HEADER.size :]


def time_text(utc_s: float) -> str | None:
    """Return seconds since 1970 as the GeoPackage writes a time; None for what is no time.

    >>> time_text(0.25)
    '1970-01-01T00:00:00.250Z'
    """
    try:
        moment = datetime.fromtimestamp(utc_s, UTC)
    except (ValueError, OverflowError, OSError):
        return None
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


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
