"""GeoJSON: RFC 7946, and the `crs` member of the older specification of 2008."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from companion.maps.crs import WGS84, crs_name, parse_crs
from companion.maps.layer import (
    Column,
    Layer,
    Value,
    check_coordinates,
    check_counts,
    digest,
    read_bytes,
)
from companion.maps.local import as_area
from companion.maps.model import Problem, map_error

_GEOMETRIES = frozenset(
    {
        "Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon",
        "GeometryCollection",
    }
)  # fmt: skip
# What reading nested lists that are not what they should be raises.
_BROKEN = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, ShapelyError)
_COLUMNS_MAX = 255  # as many as a shapefile can have
_EXPORT_AGAIN = "export the map again"


def read_geojson(path: Path, layer: str | None = None) -> Layer:
    """Return what a GeoJSON file holds; it has no layers, so `layer` is refused."""
    if layer is not None:
        raise map_error(path, "GeoJSON has no layers", fix="leave out --layer")
    content = read_bytes(path)
    document = _parse(content, path)
    features = _features(document, path)
    check_counts(path, records=len(features), vertices=content.count(b"["))
    geometries: list[Polygon | MultiPolygon | None] = []
    skipped: dict[int, str] = {}
    for index, feature in enumerate(features):
        geometry, reason = _ground(feature.get("geometry"), path, index)
        geometries.append(geometry)
        if reason:
            skipped[index] = reason
    crs, problems = _crs(document, path)
    unit = document.get("unit")
    return Layer(
        format="geojson",
        crs=crs,
        columns=_columns(features, path),
        geometries=tuple(geometries),
        sha256=digest([content]),
        unit=unit if isinstance(unit, str) else None,
        skipped=skipped,
        problems=problems,
    )


def _parse(content: bytes, path: Path) -> dict[str, object]:
    try:
        document = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise map_error(
            path, f"this is not readable JSON ({str(error)[:120]})", fix=_EXPORT_AGAIN
        ) from None
    if not isinstance(document, dict):
        raise map_error(path, "this is JSON, but not GeoJSON", fix=_EXPORT_AGAIN)
    return document


def _features(document: dict[str, object], path: Path) -> list[dict[str, object]]:
    """Return the features; a bare geometry counts as one without properties."""
    kind = str(document.get("type"))
    if kind in _GEOMETRIES:
        return [{"geometry": document}]
    features = document.get("features") if kind == "FeatureCollection" else [document]
    if kind not in ("FeatureCollection", "Feature") or not isinstance(features, list):
        raise map_error(path, f"GeoJSON of type {kind!r} is no map", fix=_EXPORT_AGAIN)
    if not all(isinstance(feature, dict) for feature in features):
        raise map_error(path, "a feature is no object", fix=_EXPORT_AGAIN)
    return features


def _crs(document: dict[str, object], path: Path) -> tuple[CRS, tuple[Problem, ...]]:
    """Return WGS84, or what the `crs` member of old files says.

    That member's coordinates are x before y, whatever the CRS (GeoJSON 2008, section 2.1.1).
    """
    member = document.get("crs")
    if member is None:
        return WGS84, ()
    properties = member.get("properties") if isinstance(member, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str):
        raise map_error(
            path, "its crs member names no coordinate reference system", fix="remove the crs member"
        )
    crs = parse_crs(name, path=path, source=f"its crs member {name!r}")
    if crs_name(crs) in ("EPSG:4326", "OGC:CRS84") or crs.name.startswith("WGS 84 (CRS84)"):
        return WGS84, ()
    problem = Problem(
        severity="warning",
        code="old-crs-member",
        text=f"the coordinates are read in {crs_name(crs)}, by a crs member that RFC 7946 no "
        "longer knows",
        where=str(path),
        fix="export the map in longitude and latitude",
    )
    return crs, (problem,)


def _ground(geometry: object, path: Path, index: int) -> tuple[Polygon | MultiPolygon | None, str]:
    """Return a feature's ground, or None and why it has none."""
    if geometry is None:
        return None, "null-geometry"
    try:
        polygons = list(_polygons(geometry, depth=0))
    except _BROKEN as error:
        raise map_error(
            path, f"the geometry of feature {index + 1} is broken ({str(error)[:120]})",
            fix=_EXPORT_AGAIN,
        ) from None  # fmt: skip
    kind = geometry["type"] if isinstance(geometry, dict) else ""
    if polygons:
        return as_area(polygons), ""
    return None, "no-area" if "Polygon" in kind else f"not-a-polygon:{kind}"


def _polygons(geometry: object, *, depth: int) -> Iterator[Polygon]:
    if not isinstance(geometry, dict) or depth > 8:
        raise ValueError("it is no geometry")
    kind = geometry.get("type")
    if kind not in _GEOMETRIES:
        raise ValueError(f"its type is {kind!r}")
    if kind == "Polygon":
        yield from _polygon(geometry["coordinates"])
    elif kind == "MultiPolygon":
        for rings in geometry["coordinates"]:
            yield from _polygon(rings)
    elif kind == "GeometryCollection":
        for part in geometry["geometries"]:
            yield from _polygons(part, depth=depth + 1)


def _polygon(rings: list[list[list[float]]]) -> Iterator[Polygon]:
    """Yield the polygon of a list of rings, the first the outside; nothing for none."""
    if rings:
        shell, *holes = (_ring(ring) for ring in rings)
        yield Polygon(shell, holes)


def _ring(ring: list[list[float]]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    points = np.array([(x, y) for x, y, *_ in ring])
    if points.dtype.kind not in "if" or len(points) < 4:
        raise ValueError("a ring needs four positions of numbers")
    coordinates = points.astype(np.float64)
    check_coordinates(coordinates)
    return coordinates


def _columns(features: list[dict[str, object]], path: Path) -> tuple[Column, ...]:
    """Return the properties of all features as columns, and the features' ids."""
    rows = [
        ({"id": feature["id"]} if "id" in feature else {}) | properties
        for feature in features
        for properties in [feature.get("properties")]
        for properties in [properties if isinstance(properties, dict) else {}]
    ]
    names = list(dict.fromkeys(name for row in rows for name in row))
    if not len(names) <= _COLUMNS_MAX:
        text = f"{len(names)} properties are more than {_COLUMNS_MAX}"
        raise map_error(path, text, fix="keep the rate and its unit")
    return tuple(_column(name, [_value(row.get(name)) for row in rows]) for name in names)


def _column(name: str, values: list[Value]) -> Column:
    numeric = all(value is None or isinstance(value, float) for value in values)
    return Column(name=name, values=tuple(values), numeric=numeric)


def _value(value: object) -> Value:
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"({type(value).__name__})"
    try:
        return None if math.isnan(value) else float(value)
    except OverflowError:
        return f"({type(value).__name__} beyond all numbers)"
