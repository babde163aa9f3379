"""The polygons of a KML placemark, and how KML writes coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np
from shapely import MultiLineString, MultiPoint
from shapely.errors import ShapelyError
from shapely.geometry.base import BaseGeometry

from missions.maps.geopackage_layers import Floats, Rings
from missions.maps.model import MAX_VERTICES, check_coordinates

_GEOMETRIES = frozenset(
    {"Point", "LineString", "LinearRing", "Polygon", "Model", "Track", "MultiTrack"}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """The polygons of one placemark, or why there is none."""

    polygons: list[Rings]
    reason: str
    mark: BaseGeometry | None = None


def ground_of(placemark: Element) -> Ground:
    """Return a placemark's polygons; what else it draws is left out.

    Raises `ValueError` for a polygon whose coordinates cannot be read.
    """
    kinds: dict[str, None] = {}
    polygons: list[Rings] = []
    for geometry in _geometries(placemark):
        kind = local_name(geometry)
        kinds[kind] = None
        if kind == "Polygon":
            rings = _polygon(geometry)
            if rings:
                polygons.append(rings)
    if polygons:
        reason = ""
    elif not kinds:
        reason = "null-geometry"
    elif "Polygon" in kinds:
        reason = "no-area"
    else:
        reason = f"not-a-polygon:{next(iter(kinds))}"
    mark = None if polygons else _mark(placemark)
    return Ground(polygons=polygons, reason=reason, mark=mark)


def _mark(placemark: Element) -> BaseGeometry | None:
    """Return the points or the lines of a placemark; None for neither, both, or broken ones."""
    found: dict[str, list[Floats]] = {}
    for geometry in _geometries(placemark):
        text = " ".join(part.text or "" for part in geometry if local_name(part) == "coordinates")
        try:
            found.setdefault(local_name(geometry), []).append(positions(text))
        except ValueError:
            return None
    try:
        if set(found) == {"Point"}:
            return MultiPoint(np.vstack(found["Point"]))
        if set(found) == {"LineString"}:
            return MultiLineString(found["LineString"])
    except (ValueError, ShapelyError):
        pass
    return None


def local_name(element: Element) -> str:
    """Return an element's name without its namespace, which differs between versions of KML."""
    return element.tag.rpartition("}")[2]


def _geometries(element: Element) -> Iterator[Element]:
    for child in element:
        kind = local_name(child)
        if kind == "MultiGeometry":
            yield from _geometries(child)
        elif kind in _GEOMETRIES:
            yield child


def _polygon(polygon: Element) -> Rings:
    """Return the outside and the holes, nothing where there is neither."""
    shells = list(_rings(polygon, "outerBoundaryIs"))
    holes = list(_rings(polygon, "innerBoundaryIs"))
    if not shells and holes:
        raise ValueError("it has a hole, but no outside")
    if len(shells) > 1:
        raise ValueError("it has several outsides")
    return [*shells, *holes]


def _rings(polygon: Element, side: str) -> Iterator[Floats]:
    """Yield the rings of one side that have positions; some writers put all holes in one."""
    for boundary in polygon:
        if local_name(boundary) != side:
            continue
        for ring in boundary:
            if local_name(ring) == "LinearRing":
                text = " ".join(
                    part.text or "" for part in ring if local_name(part) == "coordinates"
                )
                points = positions(text)
                if len(points):
                    yield _closed(points)


def _closed(points: Floats) -> Floats:
    """Return a ring whose last position is its first; many writers leave that one out."""
    if not np.array_equal(points[0], points[-1]):
        points = np.vstack([points, points[:1]])
    if len(points) < 4:
        raise ValueError("a ring has fewer than three corners")
    return points


def positions(text: str) -> Floats:
    r"""Return longitude and latitude of a `coordinates` element, without heights.

    Blanks separate positions, commas the two or three numbers of one. Blanks beside a comma are
    wrong, but common and clear.

    >>> positions(" 15.1,48.1,0\n15.2, 48.1 ").tolist()
    [[15.1, 48.1], [15.2, 48.1]]
    """
    if text.count(",") > 2 * MAX_VERTICES:
        raise ValueError(f"it has more than {MAX_VERTICES} positions")
    tuples = " ".join(text.split()).replace(" ,", ",").replace(", ", ",").split()
    widths = {one.count(",") for one in tuples}
    if not widths <= {1, 2} or "_" in text:
        shown = next((one for one in tuples if one.count(",") not in (1, 2)), text.strip())
        raise ValueError(f"{shown[:40]!r} is not a longitude, latitude and height")
    if len(widths) > 1:
        tuples = [",".join(one.split(",")[:2]) for one in tuples]
        widths = {1}
    try:
        numbers = [float(number) for number in ",".join(tuples).split(",")] if tuples else []
    except ValueError:
        raise ValueError("a longitude, latitude or height is not a number") from None
    points = np.array(numbers, dtype=np.float64).reshape(-1, max(widths, default=1) + 1)[:, :2]
    check_coordinates(points)
    return points
