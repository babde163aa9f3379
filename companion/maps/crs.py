"""Coordinate reference systems: read, named, and left behind for longitude and latitude.

Axis order is never guessed: shapefile and GeoJSON both store x before y, whatever the CRS says
(ESRI shapefile technical description, 1998; RFC 7946 section 3.1.1).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from companion.maps.model import Problem, map_error

WGS84 = CRS.from_epsg(4326)
Objects = NDArray[np.object_]
Floats = NDArray[np.float64]

# A prescription is one field or a few. Beyond this the local frame is off by more than 4 cm
# (its scale error is x^2 / (2 R^2)), and a stray vertex is likelier than a field of that size.
EXTENT_MAX_M = 100_000.0
# A straight line of a projection is an arc in another. Over 100 m the two part by 0.4 mm at
# 60 degrees of latitude (sagitta L^2 tan(lat) / (8 R)), over 1 km by 3 cm.
SEGMENT_M = 100.0
METRES_PER_DEGREE = 111_320.0


def parse_crs(text: str, *, path: Path, source: str) -> CRS:
    """Return the horizontal CRS that `text` names, as WKT, `EPSG:…` or what else PROJ reads."""
    try:
        crs = CRS.from_user_input(text.strip()).to_2d()
        Transformer.from_crs(crs, WGS84, always_xy=True)
    except (CRSError, ProjError, ValueError) as error:
        reason = str(error).split("(Internal")[0].strip(" :")
        raise map_error(
            path,
            f"{source} is no usable coordinate reference system ({reason[:120]})",
            fix="give it with --crs, for example --crs EPSG:4326",
        ) from None
    return crs


def crs_name(crs: CRS) -> str:
    """Return the EPSG code where PROJ finds one with some confidence, else the CRS's name.

    >>> crs_name(CRS.from_epsg(32650))
    'EPSG:32650'
    """
    # Old WKT carries its datum shift (TOWGS84), which makes it a CRS bound to that shift.
    crs = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    code = crs.to_epsg() or crs.to_epsg(min_confidence=20)
    return f"EPSG:{code}" if code is not None else crs.name


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


def to_longitude_latitude(geometries: Objects, crs: CRS, *, path: Path) -> Objects:
    """Return the geometries in WGS84 longitude and latitude, or refuse what cannot lie there."""
    coordinates = shapely.get_coordinates(geometries)
    if not bool(np.isfinite(coordinates).all()):
        raise map_error(path, "a coordinate is no finite number", fix="export the map again")
    if crs.to_epsg() == 4326:
        _check_range(coordinates, coordinates, crs, path)
        return geometries
    transformer = Transformer.from_crs(crs, WGS84, always_xy=True)

    def transform(points: Floats) -> Floats:
        return np.column_stack(transformer.transform(points[:, 0], points[:, 1]))

    if crs.is_geographic and float(np.abs(coordinates).max(initial=0.0)) > 400.0:
        _check_range(coordinates, coordinates, crs, path)
    _check_range(transform(coordinates), coordinates, crs, path)
    if not crs.is_geographic:
        unit_m = crs.axis_info[0].unit_conversion_factor or 1.0
        geometries = densified(geometries, SEGMENT_M / unit_m)
    result: Objects = shapely.transform(geometries, transform)
    return result


def densified(geometries: Objects, step: float) -> Objects:
    """Return the geometries with no edge longer than `step`.

    Only valid ones: GEOS would repair the others on the way, in silence, and drop ground.
    """
    valid = shapely.is_valid(geometries)
    result: Objects = geometries.copy()
    result[valid] = shapely.segmentize(geometries[valid], step)
    return result


def _check_range(points: Floats, raw: Floats, crs: CRS, path: Path) -> None:
    """Refuse points that are no longitude and latitude, or lie too far apart."""
    if not len(points):
        return
    longitude, latitude = points[:, 0], points[:, 1]
    if not bool((np.abs(longitude) <= 180.0).all() and (np.abs(latitude) <= 90.0).all()):
        raise map_error(path, _out_of_range(raw, crs), fix=_range_fix(raw, crs))
    _, south, _, north = _box(points)
    narrow = np.cos(np.radians(min(abs(south), abs(north)) if south * north > 0 else 0.0))
    extent_m = METRES_PER_DEGREE * max(np.ptp(longitude) * narrow, north - south)
    if not extent_m <= EXTENT_MAX_M:
        raise map_error(
            path,
            f"the map reaches over {extent_m / 1000:.0f} km ({_span(points)})",
            fix="remove the stray zone, or correct the CRS with --crs",
        )


def _out_of_range(raw: Floats, crs: CRS) -> str:
    return f"coordinates ({_span(raw)}) are outside what {crs_name(crs)} can hold"


def _range_fix(raw: Floats, crs: CRS) -> str:
    x, y = np.abs(raw[:, 0]), np.abs(raw[:, 1])
    if crs.is_geographic and bool((x <= 90.0).all() and (y <= 180.0).all()):
        return "longitude and latitude look exchanged: export the map with longitude first"
    if crs.is_geographic:
        return "they look like metres: give their CRS with --crs, for example --crs EPSG:32650"
    return "give the right CRS with --crs"


def _box(points: Floats) -> tuple[float, float, float, float]:
    west, south = points.min(axis=0)
    east, north = points.max(axis=0)
    return float(west), float(south), float(east), float(north)


def _span(points: Floats) -> str:
    west, south, east, north = _box(points)
    return f"x {west:.6g} to {east:.6g}, y {south:.6g} to {north:.6g}"
