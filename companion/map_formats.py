"""What all that writes ground to a file shares: GeoJSON, KML, a shapefile's set, and a zip.

Maps, missions, trials and what was applied are written in several packages, each with columns of
its own; how a format wants its places, rings, texts and archives is said here once. Two runs give
the same bytes, so no file says when it was made.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterable, Mapping
from html import escape
from io import BytesIO
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry, MultiPolygon, Polygon

Floats = NDArray[np.float64]

# A tenth of a millimetre on the ground.
DEGREE_DECIMALS = 9

# --------------------------------------------------------------------- GeoJSON (RFC 7946)

GEOJSON_TAIL = "\n]}\n"


def geojson_head(**members: Any) -> str:
    r"""Return how a collection begins; other programs pass over its members (section 6.1).

    >>> geojson_head(boundary=None)
    '{"type": "FeatureCollection",\n"boundary": null,\n"features": [\n'
    """
    said = "".join(f'"{name}": {_json(value)},\n' for name, value in members.items())
    return f'{{"type": "FeatureCollection",\n{said}"features": [\n'


def geojson_text(features: Iterable[Mapping[str, Any]], **members: Any) -> str:
    """Return a collection, a feature a line; `members` stand beside the features."""
    return geojson_head(**members) + ",\n".join(map(_json, features)) + GEOJSON_TAIL


def geojson_feature(geometry: Geometry, properties: Mapping[str, Any]) -> dict[str, Any]:
    """Return the feature of a geometry in longitude and latitude."""
    return {"type": "Feature", "properties": properties, "geometry": geojson_geometry(geometry)}


def geojson_geometry(geometry: Geometry) -> dict[str, Any]:
    """Return a geometry, rounded, whose shells turn anticlockwise (section 3.1.6)."""
    turned = shapely.orient_polygons(geometry, exterior_cw=False)
    rounded = shapely.transform(turned, lambda points: np.round(points, DEGREE_DECIMALS))
    found: dict[str, Any] = json.loads(shapely.to_geojson(rounded))
    return found


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


# --------------------------------------------------------------------- KML (OGC 12-007r2)

KML_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n'
KML_TAIL = "</kml>\n"
# What XML 1.0 cannot hold, not even as a reference (section 2.2).
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def kml_text(text: str) -> str:
    r"""Return a text as XML holds it.

    >>> kml_text("A & B\x00")
    'A &amp; B '
    """
    return escape(_FORBIDDEN.sub(" ", text), quote=False)


def kml_colour(colour: tuple[int, int, int], *, opacity: str) -> str:
    """Return red, green and blue as KML writes them: alpha, blue, green, red.

    >>> kml_colour((253, 231, 37), opacity="d8")
    'd825e7fd'
    """
    red, green, blue = colour
    return f"{opacity}{blue:02x}{green:02x}{red:02x}"


def kml_places(points: Floats, *, decimals: int = DEGREE_DECIMALS) -> str:
    """Return rows of longitude and latitude, with or without a height, as coordinates."""
    form = f"%.{decimals}f,%.{decimals}f" + (",%.2f" if points.shape[1] == 3 else "")
    return " ".join(form % tuple(point) for point in points.tolist())


def kml_ground(ground: Polygon | MultiPolygon, *, decimals: int = DEGREE_DECIMALS) -> str:
    """Return polygons, the outside of each anticlockwise as KML wants it."""
    parts = shapely.get_parts(shapely.orient_polygons(ground)).tolist()
    found = "\n".join(_kml_polygon(part, decimals) for part in parts)
    return f"<MultiGeometry>\n{found}\n</MultiGeometry>" if len(parts) > 1 else found


def _kml_polygon(ground: Polygon, decimals: int) -> str:
    rings = [("outer", ground.exterior), *(("inner", ring) for ring in ground.interiors)]
    sides = "".join(
        f"<{side}BoundaryIs><LinearRing><coordinates>"
        f"{kml_places(shapely.get_coordinates(ring), decimals=decimals)}"
        f"</coordinates></LinearRing></{side}BoundaryIs>"
        for side, ring in rings
    )
    return f"<Polygon><tessellate>1</tessellate>{sides}</Polygon>"


# --------------------------------------------------------------------- shapefile (Esri, 1998)

# The widest text column that dBASE III knows.
_TEXT_WIDTH_MAX = 254
# WGS84 in Esri's dialect, which the programs that read a .prj understand best (EPSG:4326).
_PRJ = (
    'GEOGCS["GCS_WGS_1984",DATUM["D_WGS_1984",SPHEROID["WGS_1984",6378137.0,298.257223563]],'
    'PRIMEM["Greenwich",0.0],UNIT["Degree",0.0174532925199433]]'
)
# Year since 1900, month and day of the last change.
_TABLE_DATE = bytes((100, 1, 1))


def shapefile_rings(ground: Polygon | MultiPolygon) -> list[list[list[float]]]:
    """Return all rings, the ground clockwise and its holes the other way."""
    turned = shapely.orient_polygons(ground, exterior_cw=True)
    return [
        shapely.get_coordinates(ring).tolist()
        for part in shapely.get_parts(turned)
        for ring in shapely.get_rings(part)
    ]


def table_text(text: str) -> str:
    """Return a text cut between letters where it is wider than a column can be."""
    return text.encode("utf-8", "replace")[:_TEXT_WIDTH_MAX].decode("utf-8", "ignore")


def shapefile_set(*, shp: bytes, shx: bytes, dbf: bytes) -> dict[str, bytes]:
    """Return the content of each file of a set in WGS84, by its suffix."""
    return {
        ".cpg": b"UTF-8",
        ".dbf": dbf[:1] + _TABLE_DATE + dbf[4:],
        ".prj": _PRJ.encode("ascii"),
        ".shp": shp,
        ".shx": shx,
    }


# --------------------------------------------------------------------- zip

# The oldest date that a zip can state.
_NO_TIME = (1980, 1, 1, 0, 0, 0)
# Unix, and readable: else the members depend on the system that packs them.
_UNIX, _READ_BY_ALL = 3, 0o644 << 16


def zipped(members: Mapping[str, bytes], *, as_is: Iterable[str] = ()) -> bytes:
    """Return a zip of files by their names; those of `as_is` are not made smaller."""
    kept = frozenset(as_is)
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in members.items():
            member = zipfile.ZipInfo(name, _NO_TIME)
            member.create_system, member.external_attr = _UNIX, _READ_BY_ALL
            member.compress_type = zipfile.ZIP_STORED if name in kept else zipfile.ZIP_DEFLATED
            archive.writestr(member, content)
    return packed.getvalue()
