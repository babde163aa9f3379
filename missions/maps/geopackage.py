"""GeoPackage (OGC 12-128r19): one layer of polygons out of an SQLite database.

Coordinates are always x (or longitude) before y, whatever the CRS says (section 2.1.3.1.1).
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
import shapely
from pyproj import CRS
from pyproj.enums import WktVersion
from shapely import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from missions.maps.bundle import one_of, open_bundle
from missions.maps.crs import WGS84, parse_crs, stated
from missions.maps.fields import column_of, stated_unit
from missions.maps.geopackage_layers import (
    Cell,
    CurvedError,
    Database,
    Found,
    LayerTable,
    Rings,
    areas_of,
    check_closed,
    check_size,
    chosen_layer,
    is_numeric,
    is_outline,
    layers_of,
    open_database,
    polygons_in,
    quoted,
    value_of,
)
from missions.maps.local import Area
from missions.maps.model import (
    Column,
    Layer,
    MapZone,
    Value,
    check_counts,
    digest,
    map_error,
    read_bytes,
    write_whole,
)
from missions.maps.outlines import BOUNDARY_NAME, outline_of

# Bytes of the envelope by its code in the header's flags (section 2.1.3.1.1).
_ENVELOPE_BYTES = (0, 32, 48, 48, 64)
_EXPORT_AGAIN = "export the map again"


@dataclass(slots=True)
class _Content:
    columns: tuple[Column, ...]
    polygons: list[list[Rings]] = field(default_factory=list)
    skipped: dict[int, str] = field(default_factory=dict)
    marks: dict[int, BaseGeometry] = field(default_factory=dict)

    @property
    def areas(self) -> list[Area | None]:
        return areas_of(self.polygons)


def read_geopackage(path: Path, layer: str | None = None) -> Layer:
    """Return one layer of a GeoPackage: the one that `layer` names, or the only one with numbers.

    A layer called "boundary" that holds no numbers is the outline of the field.
    """
    content, layer = _content_of(path, layer)
    with open_database(content, path) as database:
        tables = layers_of(database)
        chosen = chosen_layer(database, tables, layer)
        records = _content(database, chosen)
        crs = stated(layer_crs, database, chosen)
        outline = next((one for one in tables if is_outline(database, one, chosen)), None)
        boundary = None
        if outline is not None:
            areas = _content(database, outline).areas
            boundary = outline_of(areas, stated(layer_crs, database, outline), path)
    return Layer(
        format="geopackage",
        crs=crs,
        columns=records.columns,
        geometries=tuple(records.areas),
        sha256=digest([content]),
        boundary=boundary,
        skipped=records.skipped,
        marks=records.marks,
    )


def _content_of(path: Path, layer: str | None) -> tuple[bytes, str | None]:
    """Return the database, the file itself or one in a folder or an archive, and the layer in it.

    What names a file of several is no layer any more.
    """
    if not path.is_dir() and path.suffix.casefold() != ".zip":
        check_closed(path)
        return read_bytes(path), layer
    bundle = open_bundle(path)
    names = bundle.with_suffix(".gpkg")
    is_file = any(layer in (name, PurePosixPath(name).name) for name in names)
    name = one_of(bundle, names, layer if is_file or len(names) > 1 else None, kind="GeoPackage")
    if path.is_dir():
        check_closed(path / name)
    elif f"{name}-wal" in bundle.names:
        raise map_error(
            path,
            f"{name} was copied while a program had it open",
            fix="close the program, and make the archive again",
            code="file-in-use",
        )
    return bundle.read(name), None if is_file or len(names) > 1 else layer


def _content(database: Database, table: LayerTable) -> _Content:
    """Return attributes and ground, in one query: two could list the records in two orders."""
    check_size(database, table)
    names = [table.geometry, *(name for name, _, _ in table.columns)]
    sql = f"SELECT {', '.join(map(quoted, names))} FROM {quoted(table.name)}"
    values: list[list[Value]] = [[] for _ in table.columns]
    content = _Content(columns=())
    vertices = 0
    for index, (blob, *cells) in enumerate(database.rows(sql)):
        found = _found(database, table, index, blob)
        content.polygons.append(found.polygons if found is not None else [])
        reason = "null-geometry" if found is None else found.reason
        if reason:
            content.skipped[index] = reason
        if found is not None:
            if found.mark is not None:
                content.marks[index] = found.mark
            vertices += found.vertex_count
            check_counts(database.path, records=index, vertices=vertices)
        for column, cell, (_, kind, _) in zip(values, cells, table.columns, strict=True):
            column.append(value_of(cell, kind))
    content.columns = tuple(_columns(database, table, values))
    return content


def _columns(
    database: Database, table: LayerTable, values: Sequence[Sequence[Value]]
) -> Iterator[Column]:
    titles = _titles(database, table)
    for (name, kind, _), cells in zip(table.columns, values, strict=True):
        unit = stated_unit(titles.get(name.casefold(), ()), column=name, path=database.path)
        yield column_of(name, cells, declared=is_numeric(kind), unit=unit)


def _titles(database: Database, table: LayerTable) -> dict[str, list[str]]:
    """Return what the optional table of titles and descriptions says of each column."""
    if "gpkg_data_columns" not in database.tables:
        return {}
    database.check("gpkg_data_columns")
    sql = "SELECT table_name, column_name, name, title, description FROM gpkg_data_columns"
    return {
        str(column).casefold(): [str(text) for text in texts if text]
        for name, column, *texts in database.rows(sql)
        if str(name).casefold() == table.name.casefold()
    }


def _found(database: Database, table: LayerTable, index: int, blob: Cell) -> Found | None:
    """Return the polygons of one record, None where it has no geometry."""
    if blob is None:
        return None
    try:
        if not isinstance(blob, bytes):
            raise ValueError("it is not a geometry")
        srs_id, start = _header(blob)
        found = polygons_in(blob, start)
    except CurvedError as error:
        raise map_error(
            database.path,
            f"record {index + 1} of the layer {table.name} has round edges ({error})",
            fix="turn curves into straight edges (in QGIS: Convert to straight segments)",
            code="curved-geometry",
        ) from None
    except (ValueError, struct.error) as error:
        raise map_error(
            database.path,
            f"the geometry of record {index + 1} of the layer {table.name} is broken ({error})",
            fix=_EXPORT_AGAIN,
            code="broken-geometry",
        ) from None
    if srs_id not in (table.srs_id, *UNDEFINED_SRS):
        raise map_error(
            database.path,
            f"record {index + 1} of the layer {table.name} is in the coordinate reference system "
            f"{srs_id}, its layer in {table.srs_id}",
            fix=_EXPORT_AGAIN,
            code="wrong-crs",
        )
    return found


def _header(blob: bytes) -> tuple[int, int]:
    """Return the CRS's number, and where the well-known binary begins (section 2.1.3)."""
    if blob[:2] != b"GP" or len(blob) < 8:
        raise ValueError("it has no GeoPackage header")
    flags = blob[3]
    if flags & 0x20:
        raise ValueError("it is in a private encoding")
    envelope = flags >> 1 & 0x07
    if envelope >= len(_ENVELOPE_BYTES):
        raise ValueError(f"its envelope has the code {envelope}")
    srs_id = struct.unpack_from("<i" if flags & 1 else ">i", blob, 4)[0]
    return srs_id, 8 + _ENVELOPE_BYTES[envelope]


# The coordinate reference system that a GeoPackage states for a layer.

# srs_id of coordinates that nobody has placed on the earth: geographic, and in a plane.
UNDEFINED_SRS = (0, -1, 99999)
_TEXT_MAX = 100_000


def layer_crs(database: Database, table: LayerTable) -> CRS | None:
    """Return the layer's CRS, None where the file leaves it open: srs_id 0 and -1, GDAL's 99999."""
    if table.srs_id in UNDEFINED_SRS or "gpkg_spatial_ref_sys" not in database.tables:
        return None
    sql = (
        "SELECT organization, organization_coordsys_id, definition, srs_id "
        "FROM gpkg_spatial_ref_sys"
    )
    found = [row[:3] for row in database.rows(sql) if row[3] == table.srs_id]
    if len(found) != 1:
        raise map_error(
            database.path,
            f"it does not describe its coordinate reference system {table.srs_id}",
            fix=_EXPORT_AGAIN,
            code="no-crs",
        )
    organization, code, definition = (str(cell or "") for cell in found[0])
    return _defined(database.path, f"{organization}:{code}", definition)


def _defined(path: Path, code: str, definition: str) -> CRS | None:
    """Return the CRS of its EPSG code or else its text; the two may not name different ones."""
    # Only WKT: what else PROJ reads may be a name, a path, or an address.
    written = "[" in definition and len(definition) <= _TEXT_MAX
    text = parse_crs(definition, path=path, source="the definition in it") if written else None
    if not code.upper().startswith("EPSG:"):
        return text
    crs = parse_crs(code, path=path, source=f"its code {code}")
    own = _stated_code(text)
    if own is not None and own != code.upper():
        raise map_error(
            path,
            f"it names its coordinate reference system {code}, but describes {own}",
            fix=_EXPORT_AGAIN,
            code="wrong-crs",
        )
    return crs


def _stated_code(crs: CRS | None) -> str | None:
    """Return the EPSG code that a definition states itself, not one that merely fits."""
    if crs is None:
        return None
    source = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    stated = source.to_json_dict().get("id")
    if not isinstance(stated, dict) or str(stated.get("authority")).upper() != "EPSG":
        return None
    return f"EPSG:{stated.get('code')}"


# A GeoPackage (OGC 12-128r19, version 1.3) with the layers "prescription" and "boundary".

LAYER_NAME = "prescription"
_APPLICATION_ID = 0x47504B47  # "GPKG", section 1.1.1.1.1
_USER_VERSION = 10_300
_SRS_ID = 4326
# Little-endian, with an envelope of four numbers (section 2.1.3.1.1).
_FLAGS = 0b0000_0011
# Two runs give the same bytes, so no file says when it was made.
_LAST_CHANGE = "2000-01-01T00:00:00.000Z"

# The tables of annex C, without those of tiles and extensions, which are optional.
_SCHEMA = f"""
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL,
  definition TEXT NOT NULL,
  description TEXT
);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY,
  data_type TEXT NOT NULL,
  identifier TEXT UNIQUE,
  description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE,
  min_y DOUBLE,
  max_x DOUBLE,
  max_y DOUBLE,
  srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id)
);
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL,
  column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL,
  z TINYINT NOT NULL,
  m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id)
);
CREATE TABLE {LAYER_NAME} (
  fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  geom MULTIPOLYGON,
  name TEXT,
  rate REAL,
  unit TEXT
);
"""
_OUTLINE_SCHEMA = f"""
CREATE TABLE {BOUNDARY_NAME} (
  fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
  geom MULTIPOLYGON
);
"""


def write_geopackage(
    zones: Sequence[MapZone], path: Path, *, boundary: MultiPolygon | None = None
) -> None:
    """Write zones with their rates in L/ha, and the outline of the field as a second layer."""
    check_closed(path)
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {_USER_VERSION}")
        connection.executescript(_SCHEMA)
        connection.execute("BEGIN")
        connection.executemany(
            "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", _reference_systems()
        )
        _list_layer(connection, LAYER_NAME, [zone.geometry for zone in zones])
        connection.executemany(
            f"INSERT INTO {LAYER_NAME} (geom, name, rate, unit) VALUES (?, ?, ?, 'L/ha')",
            ((_blob(zone.geometry), _utf8(zone.name), zone.rate_l_ha) for zone in zones),
        )
        connection.execute("COMMIT")
        if boundary is not None:
            connection.executescript(_OUTLINE_SCHEMA)
            _list_layer(connection, BOUNDARY_NAME, [boundary])
            connection.execute(f"INSERT INTO {BOUNDARY_NAME} (geom) VALUES (?)", (_blob(boundary),))
        content = connection.serialize()
    write_whole(path, content)


def _reference_systems() -> list[tuple[str, int, str, int, str, str]]:
    """Return the three that every GeoPackage has to list (section 1.1.2.1.2)."""
    wkt = WGS84.to_wkt(WktVersion.WKT1_GDAL)
    return [
        ("Undefined Cartesian SRS", -1, "NONE", -1, "undefined", "undefined Cartesian coordinates"),
        ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "undefined geographic coordinates"),
        (CRS(WGS84).name, _SRS_ID, "EPSG", _SRS_ID, wkt, "longitude and latitude in degrees"),
    ]


def _list_layer(
    connection: sqlite3.Connection, name: str, areas: Sequence[Polygon | MultiPolygon]
) -> None:
    bounds = shapely.total_bounds(np.array(areas, dtype=object)).tolist() if areas else [None] * 4
    connection.execute(
        "INSERT INTO gpkg_contents VALUES (?, 'features', ?, '', ?, ?, ?, ?, ?, ?)",
        (name, name, _LAST_CHANGE, *bounds, _SRS_ID),
    )
    connection.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', 'MULTIPOLYGON', ?, 0, 0)",
        (name, _SRS_ID),
    )


def _blob(area: Polygon | MultiPolygon) -> bytes:
    """Return the GeoPackage's form of a geometry: a header, then well-known binary."""
    several = area if isinstance(area, MultiPolygon) else MultiPolygon([area])
    west, south, east, north = several.bounds
    header = struct.pack("<2sBBi4d", b"GP", 0, _FLAGS, _SRS_ID, west, east, south, north)
    return header + shapely.to_wkb(several, byte_order=1, output_dimension=2, flavor="iso")


def _utf8(text: str) -> str:
    """Return a name without the halves of characters that no file can hold."""
    return text.encode("utf-8", errors="replace").decode("utf-8").replace("\0", " ")
