"""The one rule of polygons that lie in polygons, and the outline of a field in a map file.

Which of them is a hole is known by what lies in what, in every format alike. The turn of a ring
says it in a shapefile, a record of its own in the files of guidance systems, a mark in ISOXML, and
programs get each of these wrong: ground inside of ground is asked about, never sprayed unasked.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS
from shapely import MultiPolygon
from shapely.errors import ShapelyError

from missions.maps.crs import Objects, to_longitude_latitude
from missions.maps.local import Area, frame_around, make_valid, polygons_of, project_all
from missions.maps.model import Stated, map_error
from missions.maps.overlaps import overlaps

# What our writers call the outline, and so the name by which readers know it, in any case.
BOUNDARY_NAME = "boundary"

# So much of a polygon inside another is no overlap of two neighbours; and so much of both is one
# polygon drawn twice.
INSIDE_SHARE, SAME_SHARE = 0.6, 0.99


def check_apart(areas: Objects, names: Sequence[str], path: Path) -> None:
    """Refuse a record one of whose polygons lies in another: no hole, and sprayed as ground."""
    several = np.flatnonzero(shapely.get_num_geometries(areas) > 1)
    if not len(several):
        return
    areas, names = areas[several], [names[index] for index in several.tolist()]
    parts, owner = shapely.get_parts(areas, return_index=True)
    _check_nested(parts, [names[index] for index in owner.tolist()], path, own=True)


def _check_nested(parts: Objects, names: Sequence[str], path: Path, *, own: bool) -> None:
    """Refuse polygons in each other; `own` alone: only those of one record."""
    valid = [part if part.is_valid else make_valid(part) or MultiPolygon() for part in parts]
    local = project_all(np.array(valid, dtype=object), frame_around(parts))
    sizes = shapely.area(local)
    for pair in overlaps(local.tolist()):
        inner, outer = sorted((pair.first, pair.second), key=lambda index: float(sizes[index]))
        if own and names[inner] != names[outer]:
            continue
        if not pair.area_m2 >= INSIDE_SHARE * sizes[inner]:
            continue
        if pair.area_m2 >= SAME_SHARE * sizes[outer]:
            continue
        place = parts[inner].representative_point()
        alike = names[inner] == names[outer]
        raise map_error(
            path,
            f"{names[inner]}: {'a polygon of it' if alike else 'it'} ({sizes[inner]:.0f} m2 at "
            f"{place.y:.6f}, {place.x:.6f}) lies inside "
            f"{'another of it' if alike else names[outer]}, and would be sprayed as ground",
            fix="draw it as a hole (an inner ring), or delete it"
            + ("" if alike else " and give it with --no-spray or --obstacle"),
            code="nested-polygon",
        )


def united(
    areas: Sequence[Area | None], names: Sequence[str], path: Path, *, nested: bool = False
) -> MultiPolygon:
    """Return all ground in longitude and latitude as one; `nested`: polygons may lie in others.

    They may where what they cover is kept from spraying: a hole that is none keeps more.
    """
    here = [index for index, area in enumerate(areas) if area is not None]
    parts, owner = shapely.get_parts([areas[index] for index in here], return_index=True)
    try:
        if not nested:
            _check_nested(parts, [names[here[index]] for index in owner], path, own=False)
        return MultiPolygon(polygons_of(shapely.union_all(parts)))
    except ShapelyError as error:
        raise map_error(
            path,
            f"its polygons do not unite ({str(error)[:120]})",
            fix="repair them where the file is made",
            code="broken-geometry",
        ) from None


def outline_of(areas: Sequence[Area | None], crs: Stated, path: Path) -> MultiPolygon | None:
    """Return the outline of the field that a map file holds beside its rates; None: it has none.

    Rings that cross are refused, not repaired: they could be the limit of spraying.
    """
    here = [area for area in areas if area is not None]
    if not here:
        return None
    if not isinstance(crs, CRS):
        raise crs or map_error(
            path,
            "its boundary does not say its coordinate reference system",
            fix="export it again with its boundary",
            code="no-crs",
        )
    ground = to_longitude_latitude(np.array(here, dtype=object), crs, path=path)
    check_apart(ground, ["its boundary"] * len(ground), path)
    if not bool(shapely.is_valid(ground).all()):
        raise map_error(
            path,
            "the rings of its boundary cross themselves",
            fix="repair the boundary where it is made",
            code="broken-geometry",
        )
    found = united(ground.tolist(), ["its boundary"] * len(ground), path)
    return None if found.is_empty else found
