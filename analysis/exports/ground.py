"""From the flight's own frame to longitude and latitude, for whole geometries."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
import shapely
from numpy.typing import NDArray

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

    from companion.core.frame import LocalFrame

    Ground = Polygon | MultiPolygon

Floats = NDArray[np.float64]


def geographic(grounds: list[Ground], frame: LocalFrame) -> list[Ground]:
    """Return polygons in longitude and latitude, counter-clockwise (RFC 7946)."""
    if not grounds:
        return []

    def moved(points: Floats) -> Floats:
        latitude_deg, longitude_deg = frame.to_geographic_all(*points.T.tolist())
        return np.stack((longitude_deg, latitude_deg), axis=1)

    turned = shapely.orient_polygons(np.array(grounds, dtype=object))
    return cast("list[Ground]", shapely.transform(turned, moved).tolist())
