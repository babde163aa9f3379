"""From ISOXML polygons (PLN) to ground: exterior and interior rings, latitude before longitude."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from missions.maps.isoxml.values import EXPORT_AGAIN, children, text
from missions.maps.layer import check_coordinates
from missions.maps.local import Area, as_area, polygons_of
from missions.maps.model import map_error

Floats = NDArray[np.float64]
# Types of a PLN (ISO 11783-10): 1 boundary of the field, 2 treatment zone; 3 to 7 and 12 are
# water, building, road, obstacle, flag and windbreak; 8 to 11 other, mainfield, headland, buffer.
FIELD, ZONE = "1", "2"
# What nobody sprays, wherever it lies in the field: water, building, road, obstacle, windbreak.
OBSTACLES = ("3", "4", "5", "6", "12")
# Types of a ring (LSG).
_EXTERIOR, _INTERIOR = "1", "2"
# What numbers are written with; keeps out "nan", "inf" and "1_000", which float() would take.
_DIGITS = frozenset("0123456789+-.eE")


def ground_of_polygons(
    elements: Sequence[Element], types: Container[str | None], *, where: str, path: Path
) -> tuple[Area | None, int]:
    """Return the ground of all polygons of the given types, and how many others were left out."""
    wanted = [one for one in elements if text(one, "A") in types]
    try:
        parts = [part for one in wanted for part in _parts(one)]
        whole = as_area(parts)
        # Polygons that touch along an edge are ground together, which is no fault; rings that
        # cross are left for the repair, which tells of them.
        if isinstance(whole, MultiPolygon) and not whole.is_valid and _valid(parts):
            whole = as_area(polygons_of(shapely.union_all(parts)))
    except (ValueError, ShapelyError) as error:
        raise map_error(
            path,
            f"a polygon of {where[:60]} is broken ({str(error)[:120]})",
            fix=EXPORT_AGAIN,
            code="broken-geometry",
        ) from None
    return whole, len(elements) - len(wanted)


def point_count(elements: Iterable[Element]) -> int:
    """Return the number of points of polygons, before anything is made of them."""
    return sum(len(ring) for one in elements for ring in children(one, "LSG"))


def _valid(parts: Sequence[Polygon]) -> bool:
    return bool(shapely.is_valid(np.array(parts, dtype=object)).all())


def _parts(element: Element) -> list[Polygon]:
    """Return the polygons of one PLN, each exterior with the interiors that lie in it."""
    rings = children(element, "LSG")
    outer = [_ring(ring) for ring in rings if text(ring, "A") == _EXTERIOR]
    inner = [_ring(ring) for ring in rings if text(ring, "A") == _INTERIOR]
    if len(rings) == 1 and not inner:
        # Some terminals mark the outline as a flag or a fence; a single ring can be nothing else.
        return [Polygon(_ring(rings[0]))]
    if not outer:
        raise ValueError("it has no exterior ring")
    if len(outer) == 1:
        return [Polygon(outer[0], inner)]
    shells = [Polygon(ring) for ring in outer]
    holes: list[list[Floats]] = [[] for _ in outer]
    for ring in inner:
        holes[_around(shells, ring)].append(ring)
    for index, shell in enumerate(shells):
        own = shell.representative_point()
        if any(other.contains(own) for other in shells[:index] + shells[index + 1 :]):
            # One of the two may be meant as a hole, and would be sprayed.
            raise ValueError("one exterior ring lies in another; a hole is an interior ring")
    return [Polygon(ring, own) for ring, own in zip(outer, holes, strict=True)]


def _around(shells: Sequence[Polygon], ring: Floats) -> int:
    """Return which exterior ring lies around an interior one."""
    point = Polygon(ring).representative_point()
    found = [index for index, shell in enumerate(shells) if shell.contains(point)]
    if not found:
        raise ValueError("an interior ring lies in no exterior ring")
    return min(found, key=lambda index: float(shells[index].area))


def _ring(element: Element) -> Floats:
    """Return the points of one LSG as longitude and latitude, closed."""
    points = children(element, "PNT")
    if any(point.get("J") for point in points):
        raise ValueError("its points are in a binary file, which is not read")
    pairs = [(point.get("D", "").strip(), point.get("C", "").strip()) for point in points]
    if not all(east and north for east, north in pairs):
        raise ValueError("a point lacks its latitude (C) or longitude (D)")
    if not _DIGITS.issuperset("".join(east + north for east, north in pairs)):
        raise ValueError("a coordinate is no plain decimal number")
    ring = np.array([(float(east), float(north)) for east, north in pairs], dtype=np.float64)
    if len(ring) and not np.array_equal(ring[0], ring[-1]):
        ring = np.vstack([ring, ring[:1]])
    if len(ring) < 4:
        raise ValueError("a ring needs three points")
    check_coordinates(ring)
    return ring
