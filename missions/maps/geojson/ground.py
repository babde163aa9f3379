"""Geometries of GeoJSON: nested lists that may be anything, taken for polygons or refused."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from shapely import MultiLineString, MultiPoint, Polygon
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from missions.maps.layer import check_coordinates

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
        raise ValueError("it is no geometry")
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
