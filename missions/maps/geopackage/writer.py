"""A GeoPackage (OGC 12-128r19, version 1.3) with the layers "prescription" and "boundary"."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS
from pyproj.enums import WktVersion
from shapely import MultiPolygon, Polygon

from missions.maps.crs import WGS84
from missions.maps.geopackage.sqlite import check_closed
from missions.maps.model import MapZone
from missions.maps.outline import BOUNDARY_NAME
from missions.maps.whole_file import write_whole

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
