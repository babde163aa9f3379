"""The coordinate reference system that a GeoPackage states for a layer."""

from __future__ import annotations

from pathlib import Path

from pyproj import CRS

from missions.maps.crs import parse_crs
from missions.maps.geopackage.layers import LayerTable
from missions.maps.geopackage.sqlite import Database
from missions.maps.model import map_error

# srs_id of coordinates that nobody has placed on the earth: geographic, and in a plane.
UNDEFINED_SRS = (0, -1)
_TEXT_MAX = 100_000
_EXPORT_AGAIN = "export the map again"


def layer_crs(database: Database, table: LayerTable) -> CRS | None:
    """Return the layer's CRS, None where the file leaves it open (srs_id 0 and -1)."""
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
