"""The outline of the field, where a map file holds it as a layer or folder of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS
from shapely import MultiPolygon
from shapely.errors import ShapelyError

from missions.maps.crs import to_longitude_latitude
from missions.maps.local import Area, polygons_of
from missions.maps.model import map_error

# What our writers call it, and so the name by which readers know it, in any case.
BOUNDARY_NAME = "boundary"


def outline_of(areas: Sequence[Area | None], crs: CRS, path: Path) -> MultiPolygon | None:
    """Return the ground of all areas in longitude and latitude, or None where there is none.

    Rings that cross are refused, not repaired: they could be the limit of spraying.
    """
    here = [area for area in areas if area is not None]
    if not here:
        return None
    try:
        ground = to_longitude_latitude(np.array(here, dtype=object), crs, path=path)
        if not bool(shapely.is_valid(ground).all()):
            raise map_error(
                path,
                "the rings of its boundary cross themselves",
                fix="repair the boundary where it is made",
                code="broken-geometry",
            )
        parts = polygons_of(shapely.union_all(ground))
    except ShapelyError as error:
        raise map_error(
            path,
            f"its boundary cannot be used ({str(error)[:120]})",
            fix="repair the boundary where it is made",
            code="broken-geometry",
        ) from None
    return MultiPolygon(parts) if parts else None
