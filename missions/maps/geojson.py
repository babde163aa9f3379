"""GeoJSON: RFC 7946, and the `crs` member of the older specification of 2008."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiLineString, MultiPoint, MultiPolygon, Polygon
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from companion.map_formats import geojson_feature, geojson_geometry, geojson_text
from companion.wording import iconv
from missions.maps.bundle import Bundle, one_of, open_bundle
from missions.maps.crs import WGS84, crs_name, parse_crs, stated
from missions.maps.local import Area, as_area
from missions.maps.model import (
    Column,
    Layer,
    MapZone,
    Problem,
    Stated,
    Value,
    check_coordinates,
    check_counts,
    digest,
    map_error,
    read_bytes,
    write_whole,
)
from missions.maps.outlines import BOUNDARY_NAME, outline_of

_OUTLINES = ("Polygon", "MultiPolygon")
_COLUMNS_MAX = 255  # as many as a shapefile can have
_CELLS_MAX = 10_000_000  # as in an attribute table
_SUFFIXES = (".geojson", ".json")
# Other programs keep settings and metadata as JSON beside a map.
_FEATURES = re.compile(rb'"type"\s*:\s*"Feature(?:Collection)?"')
_HEAD_BYTES = 65_536
_EXPORT_AGAIN = "export the map again"


def read_geojson(path: Path, layer: str | None = None) -> Layer:
    """Return what a GeoJSON file holds, or one in a folder or a zip, which `layer` names.

    A file by itself has no layers, so `layer` is refused.
    """
    if path.is_dir() or path.suffix.casefold() == ".zip":
        bundle = open_bundle(path)
        names = [name for name in bundle.with_suffix(*_SUFFIXES) if is_geojson(bundle, name)]
        name = one_of(bundle, names, layer, kind="GeoJSON")
        return _layer(bundle.read(name), bundle.path / name)
    if layer is not None:
        raise map_error(path, "GeoJSON has no layers", fix="leave out --layer", code="no-layer")
    return _layer(read_bytes(path), path)


def is_geojson(bundle: Bundle, name: str) -> bool:
    """Tell whether a file is GeoJSON: by its suffix, or a `.json` by what it begins with."""
    if PurePosixPath(name).suffix.casefold() != ".json":
        return True
    return _FEATURES.search(bundle.read(name)[:_HEAD_BYTES]) is not None


def _layer(content: bytes, path: Path) -> Layer:
    document = _parse(content, path)
    features = _features(document, path)
    check_counts(path, records=len(features), vertices=0)
    geometries, skipped = _grounds(features, path)
    crs = stated(_crs, document, path)
    unit = document.get("unit")
    return Layer(
        format="geojson",
        crs=crs,
        columns=_columns(features, path),
        geometries=tuple(geometries),
        sha256=digest([content]),
        unit=unit if isinstance(unit, str) else None,
        boundary=_boundary(document, crs, path),
        skipped=skipped,
        problems=_old_member(crs, path),
        marks={
            index: mark
            for index in skipped
            if (mark := mark_in(features[index].get("geometry"))) is not None
        },
    )


def _parse(content: bytes, path: Path) -> dict[str, object]:
    # Before there is an object for each: every position opens a bracket and has two commas with
    # the one behind it, every feature opens two braces or three.
    counted = max(content.count(b"["), content.count(b",") // 3)
    check_counts(path, records=content.count(b"{") // 3, vertices=counted)
    try:
        document = json.loads(content.decode("utf-8-sig"), object_pairs_hook=_members)
    except UnicodeDecodeError as error:
        if b"\0" in content and content[:2] not in (b"\xff\xfe", b"\xfe\xff"):
            text = "this is not text, so it cannot be GeoJSON"
            raise map_error(path, text, fix=_EXPORT_AGAIN, code="encoding") from None
        text = f"its text is not in UTF-8, as GeoJSON has to be ({error.reason})"
        fix = f"save it as UTF-8, or: {iconv(content, path)}"
        raise map_error(path, text, fix=fix, code="encoding") from None
    except _DuplicateError as error:
        raise map_error(path, str(error), fix=_EXPORT_AGAIN, code="duplicate-member") from None
    except json.JSONDecodeError as error:
        text = f"this is not readable JSON ({str(error)[:120]})"
        raise map_error(path, text, fix=_EXPORT_AGAIN, code="truncated") from None
    except RecursionError:
        text = "it nests too deep"
        raise map_error(path, text, fix=_EXPORT_AGAIN, code="too-large") from None
    except ValueError:  # a whole number of more than 4300 digits, which Python reads no further
        text = "a number has too many digits"
        raise map_error(path, text, fix=_EXPORT_AGAIN, code="bad-number") from None
    if not isinstance(document, dict):
        raise _no_map(path, "this is JSON, but not GeoJSON")
    return document


class _DuplicateError(ValueError):
    """An object says two things under one name, and readers differ in which they believe."""


def _members(pairs: list[tuple[str, object]]) -> dict[str, object]:
    members = dict(pairs)
    if len(members) < len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise _DuplicateError(f"an object in it has the member {twice[:40]!r} twice")
    return members


def _features(document: dict[str, object], path: Path) -> list[dict[str, object]]:
    """Return the features; a bare geometry counts as one without properties."""
    kind = str(document.get("type"))
    if kind in GEOMETRIES:
        return [{"geometry": document}]
    features = document.get("features") if kind == "FeatureCollection" else [document]
    if kind not in ("FeatureCollection", "Feature") or not isinstance(features, list):
        raise _no_map(path, f"GeoJSON of type {kind[:40]!r} is not a map")
    if not all(isinstance(feature, dict) for feature in features):
        raise _no_map(path, "a feature is not an object")
    return features


def _no_map(path: Path, text: str) -> Exception:
    return map_error(path, text, fix=_EXPORT_AGAIN, code="unknown-format")


def _crs(document: dict[str, object], path: Path) -> CRS | None:
    """Return WGS84, or what the `crs` member of old files says.

    That member's coordinates are x before y, whatever the CRS; null says that it is unknown
    (GeoJSON 2008, sections 2.1.1 and 3).
    """
    if "crs" not in document:
        return WGS84
    member = document["crs"]
    if member is None:
        return None
    properties = member.get("properties") if isinstance(member, dict) else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str):
        raise map_error(
            path,
            "its crs member names no coordinate reference system",
            fix="remove the crs member if the map is in longitude and latitude (WGS84)",
            code="wrong-crs",
        )
    crs = parse_crs(name, path=path, source=f"its crs member {name[:80]!r}")
    if crs_name(crs) in ("EPSG:4326", "OGC:CRS84") or crs.name.startswith("WGS 84 (CRS84)"):
        return WGS84
    return crs


def _old_member(crs: Stated, path: Path) -> tuple[Problem, ...]:
    if not isinstance(crs, CRS) or crs == WGS84:
        return ()
    problem = Problem(
        severity="warning",
        code="old-crs-member",
        text=f"the coordinates are read in {crs_name(crs)}, by a crs member that RFC 7946 no "
        "longer knows",
        where=str(path),
        fix="export the map in longitude and latitude",
    )
    return (problem,)


def _grounds(
    features: list[dict[str, object]], path: Path
) -> tuple[list[Area | None], dict[int, str]]:
    """Return every feature's ground, and why there is none where there is none."""
    geometries: list[Area | None] = []
    skipped: dict[int, str] = {}
    for index, feature in enumerate(features):
        geometry = feature.get("geometry")
        try:
            polygons = list(polygons_in(geometry)) if geometry is not None else []
        except BROKEN as error:
            raise map_error(
                path,
                f"the geometry of feature {index + 1} is broken ({str(error)[:120]})",
                fix=_EXPORT_AGAIN,
                code="broken-geometry",
            ) from None
        geometries.append(as_area(polygons))
        if not polygons:
            skipped[index] = _reason(geometry)
    return geometries, skipped


def _boundary(document: dict[str, object], crs: Stated, path: Path) -> MultiPolygon | None:
    """Return the outline of the field where our own writer has put it, beside the features."""
    member = document.get(BOUNDARY_NAME)
    if not isinstance(member, dict) or member.get("type") not in _OUTLINES:
        return None
    try:
        area = as_area(list(polygons_in(member)))
    except BROKEN as error:
        raise map_error(
            path,
            f"its boundary is broken ({str(error)[:120]})",
            fix=_EXPORT_AGAIN,
            code="broken-geometry",
        ) from None
    return outline_of([area], crs, path)


def _reason(geometry: object) -> str:
    if not isinstance(geometry, dict):
        return "null-geometry"
    kind = str(geometry["type"])
    return "no-area" if "Polygon" in kind else f"not-a-polygon:{kind}"


def _columns(features: list[dict[str, object]], path: Path) -> tuple[Column, ...]:
    """Return the properties of all features as columns, and the features' ids."""
    rows = [
        ({"id": feature["id"]} if "id" in feature else {}) | properties
        for feature in features
        for properties in [feature.get("properties")]
        for properties in [properties if isinstance(properties, dict) else {}]
    ]
    names = list(dict.fromkeys(name for row in rows for name in row))
    if not (len(names) <= _COLUMNS_MAX and len(names) * len(rows) <= _CELLS_MAX):
        text = f"{len(names)} properties of {len(rows)} features are too many"
        raise map_error(path, text, fix="keep the rate and its unit", code="too-large")
    return tuple(_column(_text(name), [_value(row.get(name)) for row in rows]) for name in names)


def _column(name: str, values: list[Value]) -> Column:
    numeric = all(value is None or isinstance(value, float) for value in values)
    return Column(name=name, values=tuple(values), numeric=numeric)


def _value(value: object) -> Value:
    if value is None:
        return None
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return f"({type(value).__name__})"
    try:
        return None if math.isnan(value) else float(value)
    except OverflowError:
        return f"({type(value).__name__} beyond all numbers)"


def _text(value: str) -> str:
    """Return a text that can be written: JSON can hold halves of letters (lone surrogates)."""
    return value if value.isascii() else value.encode("utf-8", "replace").decode("utf-8")


# Geometries of GeoJSON: nested lists that may be anything, taken for polygons or refused.

GEOMETRIES = frozenset(
    {
        "Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon",
        "GeometryCollection",
    }
)  # fmt: skip
# What reading nested lists that are not what they should be raises.
BROKEN = (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, ShapelyError)
_DEPTH_MAX = 8  # of collections in each other


def polygons_in(geometry: object, *, depth: int = 0) -> Iterator[Polygon]:
    """Yield every polygon of a geometry; raises one of `BROKEN` where it is none."""
    if not isinstance(geometry, dict) or depth > _DEPTH_MAX:
        raise ValueError("it is not a geometry")
    kind = geometry.get("type")
    if kind not in GEOMETRIES:
        raise ValueError(f"its type is {kind!r}")
    if kind == "Polygon":
        yield from _polygon(geometry["coordinates"])
    elif kind == "MultiPolygon":
        for rings in geometry["coordinates"]:
            yield from _polygon(rings)
    elif kind == "GeometryCollection":
        for part in geometry["geometries"]:
            yield from polygons_in(part, depth=depth + 1)


def mark_in(geometry: object) -> BaseGeometry | None:
    """Return the points or lines of a geometry; None where it is neither, or broken."""
    if not isinstance(geometry, dict):
        return None
    try:
        content = geometry["coordinates"]
        match geometry.get("type"):
            case "Point":
                return MultiPoint(_positions([content]))
            case "MultiPoint":
                return MultiPoint(_positions(content))
            case "LineString":
                return MultiLineString([_positions(content)])
            case "MultiLineString":
                return MultiLineString([_positions(line) for line in content])
    except BROKEN:
        pass
    return None


def _positions(positions: list[list[float]]) -> NDArray[np.float64]:
    found = np.array([(x, y) for x, y, *_ in positions])
    if found.ndim != 2 or found.dtype.kind not in "if":
        raise ValueError("positions are lists of numbers")
    coordinates: NDArray[np.float64] = found.astype(np.float64)
    check_coordinates(coordinates)
    return coordinates


def _polygon(rings: list[list[list[float]]]) -> Iterator[Polygon]:
    """Yield the polygon of a list of rings, the first the outside; nothing for none."""
    if rings:
        shell, *holes = (_ring(ring) for ring in rings)
        yield Polygon(shell, holes)


def _ring(ring: list[list[float]]) -> NDArray[np.float64]:
    """Return the positions of a ring, without heights."""
    try:
        points = np.array(ring)
    except ValueError:  # only some positions have a height
        points = np.array([(x, y) for x, y, *_ in ring])
    if points.ndim != 2 or points.dtype.kind not in "if" or not points.shape[1] >= 2:
        raise ValueError("a ring is a list of positions, and these of numbers")
    if len(points) < 4:
        raise ValueError("a ring needs four positions of numbers")
    coordinates: NDArray[np.float64] = points[:, :2].astype(np.float64)
    check_coordinates(coordinates)
    return coordinates


# A prescription as GeoJSON (RFC 7946).

UNIT = "L/ha"
# A millionth of a litre.
_RATE_DECIMALS = 6


def write_geojson(
    zones: Sequence[MapZone], path: Path, *, boundary: MultiPolygon | None = None
) -> None:
    """Write a feature for every zone, one on a line.

    The outline of the field is a member of the collection beside the features, which other
    programs pass over (RFC 7946, section 6.1): as a feature it would be one more zone.
    """
    if not zones:
        raise map_error(
            path, "there is no zone to write", fix="take a map with zones", code="no-polygon"
        )
    beside = {} if boundary is None else {BOUNDARY_NAME: geojson_geometry(boundary)}
    text = geojson_text(map(_feature, zones), **beside)
    write_whole(path, text.encode("utf-8", "replace"))


def _feature(zone: MapZone) -> dict[str, object]:
    rate = None if zone.rate_l_ha is None else round(zone.rate_l_ha, _RATE_DECIMALS)
    return geojson_feature(zone.geometry, {"name": zone.name, "rate": rate, "unit": UNIT})
