"""Coordinate reference systems: read, named, and left behind for longitude and latitude.

Axis order is never guessed: shapefile and GeoJSON both store x before y, whatever the CRS says
(ESRI shapefile technical description, 1998; RFC 7946 section 3.1.1).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from companion.core.frame import METRES_PER_DEGREE
from companion.errors import MapError
from missions.maps.model import MAX_VERTICES, Problem, Stated, map_error

__all__ = [
    "EXTENT_MAX_M",
    "METRES_PER_DEGREE",
    "SEGMENT_M",
    "WGS84",
    "Floats",
    "Objects",
    "check_edges",
    "crs_name",
    "datum_problem",
    "densified",
    "is_wgs84",
    "parse_crs",
    "stated",
    "to_longitude_latitude",
]


Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Objects = NDArray[np.object_]

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
            f"{source} is not a usable coordinate reference system ({reason[:120]})",
            fix="give it with --crs, for example --crs EPSG:4326",
            code="wrong-crs",
        ) from None


def stated(read: Callable[..., CRS | None], *about: object) -> Stated:
    """Return what a file says of its CRS: where that is unusable, the refusal.

    Only who knows what the operator gives with --crs can tell whether it is one.
    """
    try:
        return read(*about)
    except MapError as error:
        if error.code not in ("no-crs", "wrong-crs"):
            raise
        return error


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


@lru_cache(maxsize=32)
def _into_degrees(crs: CRS) -> Transformer:
    # PROJ looks for the best way each time, for 30 ms; the files of a map mostly share their CRS.
    return Transformer.from_crs(crs, WGS84, always_xy=True)


def over_180(points: Floats) -> Floats:
    """Return degrees that go on beyond 180 where the ground lies on both sides of the meridian.

    RFC 7946 has it cut there, other programs write 180.0004 or -180.0004; all others are as before.
    """
    x = points[:, 0]
    beyond = bool((np.abs(x) > 180.0).any()) or (bool((x < 0.0).any()) and bool((x > 0.0).any()))
    size = np.abs(x)
    near = (size >= _NEAR_180_DEG) & (size <= 180.0 + LONGITUDES_MAX_DEG)
    if not (len(x) and beyond and bool(near.all())):
        return points
    moved = np.where(x < 0.0, x + 360.0, x)
    return np.column_stack([moved - 360.0 if (moved >= 180.0).all() else moved, points[:, 1]])


def _spans_180(geometries: Objects) -> bool:
    """Tell a ring with degrees on both sides of the meridian: it is cut there, or goes round."""
    rings = shapely.bounds(shapely.get_parts(geometries))
    return bool((rings[:, 2] - rings[:, 0] > 180.0).any())


def to_longitude_latitude(geometries: Objects, crs: CRS, *, path: Path) -> Objects:
    """Return the geometries in WGS84 longitude and latitude, or refuse what cannot lie there."""
    coordinates = shapely.get_coordinates(geometries)
    if not bool(np.isfinite(coordinates).all()):
        raise map_error(
            path,
            "a coordinate is not a finite number",
            fix="export the map again",
            code="broken-geometry",
        )
    if is_wgs84(crs):
        whole = coordinates if _spans_180(geometries) else over_180(coordinates)
        check_place(whole, coordinates, crs, path)
        if whole is not coordinates:
            geometries = shapely.set_coordinates(geometries.copy(), whole)
        return geometries
    transformer, jumps = _into_degrees(crs), _spans_180(geometries)

    def transform(points: Floats) -> Floats:
        degrees = np.column_stack(transformer.transform(points[:, 0], points[:, 1]))
        return degrees if crs.is_geographic and jumps else over_180(degrees)

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


# Whether coordinates can lie where their coordinate reference system puts them.
#
# A wrong CRS and exchanged axes mostly show: in numbers beyond 180, in a place far from where the
# CRS is meant for, in metres too small for a projection. What does not show stays for the check
# against field and home; nothing is ever turned round here.

WGS84 = CRS.from_epsg(4326)
_Box = tuple[float, float, float, float]

# A prescription is one field or a few. Beyond this the local frame is off by more than 4 cm
# (its scale error is x^2 / (2 R^2)), and a stray vertex is likelier than a field of that size.
EXTENT_MAX_M = 100_000.0
# The northernmost grain ripens at 70 degrees; beyond 85 a degree of longitude is a few paces.
LATITUDE_MAX_DEG = 85.0
# 100 km at that latitude.
LONGITUDES_MAX_DEG = 11.0
# What lies beyond it on both sides is cut by the 180th meridian.
_NEAR_180_DEG = 150.0
# Degrees beyond its area of use at which a CRS is a mistake. Maps are drawn in the next UTM zone
# on purpose, 6 degrees wide; more than one zone away nobody does.
_AREA_MARGIN_DEG = 6.0
_EXPORT = "export the map with longitude (x) first"


def crs_name(crs: CRS) -> str:
    """Return the EPSG code where PROJ finds one with some confidence, else the CRS's name.

    >>> crs_name(CRS.from_epsg(32650))
    'EPSG:32650'
    """
    code = _epsg(crs, confidence=20)
    return f"EPSG:{code}" if code is not None else _own(crs).name


def looks_like_metres(points: Floats) -> bool:
    """Tell numbers that cannot be degrees, in whichever order."""
    return bool(np.abs(points).max(initial=0.0) > 400.0)


def span(points: Floats) -> str:
    """Return the range of the coordinates, for a message."""
    west, south, east, north = _box(points)
    return f"x {west:.6g} to {east:.6g}, y {south:.6g} to {north:.6g}"


def check_place(points: Floats, raw: Floats, crs: CRS, path: Path) -> None:
    """Refuse points (in degrees; `raw` as in the file) that cannot be what their CRS says."""
    if not len(points):
        return
    longitude, latitude = np.abs(points).T
    over = _NEAR_180_DEG <= float(points[:, 0].min()) < 180.0
    most = 180.0 + (LONGITUDES_MAX_DEG if over else 0.0)
    if not bool((longitude <= most).all() and (latitude <= 90.0).all()):
        raise _out_of_range(raw, crs, path)
    _check_degrees_in_metres(raw, crs, path)
    _check_area_of_use(points, raw, crs, path)
    check_extent(_box(points), path)


def _check_degrees_in_metres(raw: Floats, crs: CRS, path: Path) -> None:
    """Refuse degrees in a file whose `.prj` is of a projection known to EPSG.

    Projections put their origin far from where they are used, UTM 500 km to the west.
    """
    x, y = np.abs(raw).T
    if crs.is_projected and _epsg(crs) and (x <= 180.0).all() and (y <= 180.0).all():
        raise map_error(
            path,
            f"coordinates ({span(raw)}) look like degrees, but the CRS {crs_name(crs)} is in "
            "metres",
            fix="give the right CRS with --crs, for example --crs EPSG:4326",
            code="wrong-crs",
        )


def _check_area_of_use(points: Floats, raw: Floats, crs: CRS, path: Path) -> None:
    """Refuse a map far from where its CRS is used, the more so if exchanging x and y mends it."""
    area = _area_of_use(crs)
    if area is None or _degrees_outside(points, area) <= _AREA_MARGIN_DEG:
        return
    if _fits_exchanged(raw, crs, area):
        raise _swapped(raw, crs, path)
    west, south, east, north = area
    raise map_error(
        path,
        f"the map lies at {span(points)} by its CRS {crs_name(crs)}, which is meant for "
        f"x {west:.4g} to {east:.4g}, y {south:.4g} to {north:.4g}",
        fix="give the right CRS with --crs",
        code="wrong-crs",
    )


def check_extent(box: _Box, path: Path) -> None:
    """Refuse a map (west, south, east, north in degrees) that is no field's, by size or place."""
    west, south, east, north = box
    if not max(abs(south), abs(north)) <= LATITUDE_MAX_DEG:
        raise map_error(
            path,
            f"the map reaches to latitude {max(south, north, key=abs):.4g}, where no field lies",
            fix="remove the stray zone, or correct the CRS with --crs",
            code="out-of-range",
        )
    if not east - west <= LONGITUDES_MAX_DEG:
        crosses = west < -_NEAR_180_DEG and east > _NEAR_180_DEG
        raise map_error(
            path,
            f"the map reaches over {east - west:.4g} degrees of longitude "
            f"(x {west:.6g} to {east:.6g}, y {south:.6g} to {north:.6g})",
            fix="split it where it crosses the 180th meridian; otherwise remove the stray zone"
            if crosses
            else "if these are metres from a local origin, export them in degrees or with their "
            "CRS; otherwise remove the stray zone",
            code="out-of-range",
        )
    narrow = np.cos(np.radians(min(abs(south), abs(north)) if south * north > 0 else 0.0))
    extent_m = METRES_PER_DEGREE * max((east - west) * float(narrow), north - south)
    if not extent_m <= EXTENT_MAX_M:
        text = f"x {west:.6g} to {east:.6g}, y {south:.6g} to {north:.6g}"
        raise map_error(
            path,
            f"the map reaches over {extent_m / 1000:.0f} km ({text})",
            fix="remove the stray zone, or correct the CRS with --crs",
            code="out-of-range",
        )


def _out_of_range(raw: Floats, crs: CRS, path: Path) -> MapError:
    """Return the refusal of coordinates that are not on Earth, with the likely reason."""
    x, y = np.abs(raw).T
    if crs.is_geographic and (x <= 90.0).all() and (y <= 180.0).all():
        return _swapped(raw, crs, path)
    area = _area_of_use(crs)
    if not crs.is_geographic and area is not None and _fits_exchanged(raw, crs, area):
        return _swapped(raw, crs, path)
    fix, code = "give the right CRS with --crs", "out-of-range"
    if crs.is_geographic and looks_like_metres(raw):
        fix = "they look like metres: give with --crs the projection that they were made in"
        code = "wrong-crs"
    elif crs.is_geographic:
        fix = "if they are metres, give with --crs their projection, or export them in degrees"
    text = f"coordinates ({span(raw)}) are outside what {crs_name(crs)} can hold"
    return map_error(path, text, fix=fix, code=code)


def _swapped(raw: Floats, crs: CRS, path: Path) -> MapError:
    names = "longitude and latitude" if crs.is_geographic else "x (east) and y (north)"
    return map_error(
        path,
        f"coordinates ({span(raw)}) are outside what {crs_name(crs)} can hold, and inside the "
        "other way round",
        fix=f"{names} look exchanged: {_EXPORT}",
        code="swapped-axes",
    )


def _own(crs: CRS) -> CRS:
    """Return the CRS itself: old WKT carries a datum shift (TOWGS84) that binds it."""
    return crs.source_crs if crs.is_bound and crs.source_crs is not None else crs


@lru_cache(maxsize=64)
def _epsg(crs: CRS, *, confidence: int = 70) -> int | None:
    own = _own(crs)
    code: int | None = own.to_epsg() or own.to_epsg(min_confidence=confidence)
    return code


def _area_of_use(crs: CRS) -> _Box | None:
    """Return west, south, east, north of what the CRS is meant for, None where that is unknown.

    A `.prj` does not say it, EPSG does; nothing is known of areas across the date line.
    """
    own = _own(crs)
    area = own.area_of_use
    # Of degrees PROJ is never sure, for the axes that a .prj does not have; their datum tells.
    code = _epsg(crs, confidence=20 if own.is_geographic else 70)
    if area is None and code is not None:
        known = CRS.from_epsg(code)
        area = known.area_of_use if _datum(known) == _datum(own) else None
    if area is None or not area.west < area.east:
        return None
    return area.west, area.south, area.east, area.north


def _datum(crs: CRS) -> str | None:
    return crs.datum.name.removesuffix(" ensemble") if crs.datum is not None else None


def _degrees_outside(points: Floats, area: _Box) -> float:
    """Return how far the middle of the map lies outside an area, 0 inside."""
    x, y = np.median(points, axis=0)
    west, south, east, north = area
    return float(max(west - x, x - east, south - y, y - north, 0.0))


def _fits_exchanged(raw: Floats, crs: CRS, area: _Box) -> bool:
    """Tell whether the map would lie inside the area with x and y exchanged."""
    transformer = _into_degrees(crs)
    points = np.column_stack(transformer.transform(raw[:, 1], raw[:, 0]))
    return bool(np.isfinite(points).all()) and _degrees_outside(points, area) == 0.0


def _box(points: Floats) -> _Box:
    west, south = points.min(axis=0)
    east, north = points.max(axis=0)
    return float(west), float(south), float(east), float(north)
