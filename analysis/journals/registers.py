"""What a GeoPackage must have besides the flight's rows, written again where damage took it."""

from __future__ import annotations

import sqlite3
from contextlib import suppress

from companion.core.frame import LocalFrame
from companion.record.distrust import empty_tables
from companion.record.geopackage import LOCAL_ID, WGS84_ID
from companion.record.layers import box_of_points, set_box

# Layers: geometry, and the system that they lie in.
_LAYERS = {
    "applied": ("POINT", WGS84_ID),
    "zones": ("GEOMETRY", LOCAL_ID),
    "field": ("GEOMETRY", LOCAL_ID),
}
_SYSTEM = "INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)"
_CONTENT = (
    "INSERT OR IGNORE INTO gpkg_contents (table_name, data_type, identifier, description, srs_id) "
    "VALUES (?, ?, ?, ?, ?)"
)
_GEOMETRY = "INSERT OR IGNORE INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)"
_ORIGIN = "SELECT value FROM meta WHERE key = 'origin_{}_deg'"


def register_again(connection: sqlite3.Connection) -> None:
    """Fill in what is missing of the registers, and the extent of what there is now.

    Without them no map viewer opens the file; what cannot be told is left out.
    """
    with empty_tables() as empty:
        systems = empty.execute("SELECT * FROM gpkg_spatial_ref_sys").fetchall()
        sql = "SELECT table_name, data_type, identifier, description, srs_id FROM gpkg_contents"
        contents = empty.execute(sql).fetchall()
    contents += [(name, "features", name, "", system) for name, (_, system) in _LAYERS.items()]
    contents.append(("coverage_tiles", "attributes", "coverage_tiles", "treated ground", None))
    with suppress(sqlite3.Error):
        connection.executemany(_SYSTEM, systems)
        connection.executemany(_CONTENT, contents)
        connection.executemany(
            _GEOMETRY, [(name, kind, system) for name, (kind, system) in _LAYERS.items()]
        )
    with suppress(sqlite3.Error, ValueError):
        set_box(connection, "applied", box_of_points(connection, "applied"))
    with suppress(sqlite3.Error, ValueError, TypeError, LookupError):
        _register_frame(connection)


def _register_frame(connection: sqlite3.Connection) -> None:
    """Fill in the flight's own system from its origin, which is in `meta`."""
    latitude_deg, longitude_deg = (
        float(connection.execute(_ORIGIN.format(name)).fetchone()[0])
        for name in ("latitude", "longitude")
    )
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        return
    definition = LocalFrame(latitude_deg, longitude_deg).crs.to_wkt("WKT1_GDAL")
    what = "metres east and north of the flight's origin"
    connection.execute(_SYSTEM, ("Flight", LOCAL_ID, "NONE", LOCAL_ID, definition, what))
