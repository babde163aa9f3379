"""Coordinate reference systems: read, named, and left behind for longitude and latitude.

Axis order is never guessed: shapefile and GeoJSON both store x before y, whatever the CRS says
(ESRI shapefile technical description, 1998; RFC 7946 section 3.1.1).
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from missions.maps.crs_place import (
    EXTENT_MAX_M,
    METRES_PER_DEGREE,
    WGS84,
    check_place,
    crs_name,
    looks_like_metres,
)
from missions.maps.layer import MAX_VERTICES
from missions.maps.model import Problem, map_error

__all__ = [
    "EXTENT_MAX_M", "METRES_PER_DEGREE", "SEGMENT_M", "WGS84", "Floats", "Objects", "check_edges",
    "crs_name", "datum_problem", "densified", "is_wgs84", "parse_crs", "to_longitude_latitude",
]  # fmt: skip

Objects = NDArray[np.object_]
Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# A straight line of a projection is an arc in another. Over 100 m the two part by 0.4 mm at
# 60 degrees of latitude (sagitta L^2 tan(lat) / (8 R)), over 1 km by 3 cm.
SEGMENT_M = 100.0
# The longest WKT in PROJ's database has some 10 000 characters.
_TEXT_MAX = 100_000


def parse_crs(text: str, *, path: Path, source: str) -> CRS:
    """Return the horizontal CRS that `text` names, as WKT, `EPSG:…` or what else PROJ reads."""
    try:
        # `+init=` names a file of the computer, which a map has no business to.
        if len(text) > _TEXT_MAX or "init=" in text:
            raise ValueError("too long" if len(text) > _TEXT_MAX else "it refers to a file")
        return _known(text.strip())
    except (CRSError, ProjError, ValueError) as error:
        reason = str(error).split("(Internal")[0].strip(" :")
        if isinstance(error, UnicodeError) or reason.startswith("Invalid projection"):
            reason = "it is unknown or damaged"
        raise map_error(
            path,
            f"{source} is no usable coordinate reference system ({reason[:120]})",
            fix="give it with --crs, for example --crs EPSG:4326",
            code="wrong-crs",
        ) from None


@lru_cache(maxsize=32)
def _known(text: str) -> CRS:
    """Return the CRS of a text; long ones take PROJ 10 ms, and the files of a field repeat them."""
    crs = CRS.from_user_input(text).to_2d()
    if not (crs.is_geographic or crs.is_projected):
        raise ValueError(f"{crs.name} is neither geographic nor projected")
    Transformer.from_crs(crs, WGS84, always_xy=True)
    return crs


def datum_problem(crs: CRS) -> Problem | None:
    """Return what to say about a datum that is not WGS84.

    PROJ shifts between datums as well as it knows, for many by nothing at all. The receiver's
    base uses yet another realisation, and plate-fixed datums are up to two metres away.
    """
    datum = crs.geodetic_crs.datum if crs.geodetic_crs is not None else None
    name = datum.name if datum is not None else "unknown"
    if name.startswith("World Geodetic System 1984"):
        return None
    return Problem(
        severity="warning",
        code="datum",
        text=f"the coordinates are on the datum {name}, and can lie metres from the receiver's",
        where=crs_name(crs),
        fix="compare one point on the ground; set prescription.offset_east_m and offset_north_m",
    )


@lru_cache(maxsize=32)
def is_wgs84(crs: CRS) -> bool:
    """Tell whether the coordinates are WGS84 degrees already; the question takes 0.1 s."""
    return bool(crs.to_epsg() == 4326)


def to_longitude_latitude(geometries: Objects, crs: CRS, *, path: Path) -> Objects:
    """Return the geometries in WGS84 longitude and latitude, or refuse what cannot lie there."""
    coordinates = shapely.get_coordinates(geometries)
    if not bool(np.isfinite(coordinates).all()):
        raise map_error(
            path,
            "a coordinate is no finite number",
            fix="export the map again",
            code="broken-geometry",
        )
    if is_wgs84(crs):
        check_place(coordinates, coordinates, crs, path)
        return geometries
    transformer = Transformer.from_crs(crs, WGS84, always_xy=True)

    def transform(points: Floats) -> Floats:
        return np.column_stack(transformer.transform(points[:, 0], points[:, 1]))

    if crs.is_geographic and looks_like_metres(coordinates):
        check_place(coordinates, coordinates, crs, path)
    check_place(transform(coordinates), coordinates, crs, path)
    if not crs.is_geographic:
        unit_m = crs.axis_info[0].unit_conversion_factor or 1.0
        geometries = densified(geometries, SEGMENT_M / unit_m, path=path)
    result: Objects = shapely.transform(geometries, transform)
    return result


def densified(geometries: Objects, step: float, *, path: Path | None = None) -> Objects:
    """Return the geometries with no edge longer than `step`.

    Only valid ones: GEOS would repair the others on the way, in silence, and drop ground.
    """
    result: Objects = geometries.copy()
    long = _with_long_edges(geometries, step, path)
    if len(long):
        result[long] = shapely.segmentize(geometries[long], step)
    return result


def check_edges(degrees: Objects, path: Path) -> None:
    """Refuse ground whose edges, cut as a flight needs them, are more than a map may have."""
    _with_long_edges(degrees, SEGMENT_M / METRES_PER_DEGREE, path)


def _with_long_edges(geometries: Objects, step: float, path: Path | None) -> Indices:
    """Return which valid geometries have an edge to be cut, if all of them have not too many."""
    points, owner = shapely.get_coordinates(geometries, return_index=True)
    # From the end of a ring to the next one too: a way that makes nothing long is no edge either.
    long: Indices = np.unique(owner[1:][np.hypot(*np.diff(points, axis=0).T) > step])
    long = long[shapely.is_valid(geometries[long])]
    rings = shapely.get_rings(shapely.get_parts(geometries[long]))
    corners, ring = shapely.get_coordinates(rings, return_index=True)
    edges = np.hypot(*np.diff(corners, axis=0).T)[ring[1:] == ring[:-1]]
    count = len(points) + float(np.floor(edges / step).sum())
    if not count <= MAX_VERTICES:
        raise map_error(
            Path("map") if path is None else path,
            f"its edges are so long that they take {count:.0f} vertices, one every "
            f"{SEGMENT_M:.0f} m, more than {MAX_VERTICES}",
            fix="remove the stray zone, or cut the map to one field",
            code="too-large",
        )
    return long
