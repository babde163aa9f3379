"""From longitude and latitude to metres in the flight's frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import TypeVar

import numpy as np
import shapely
from pyproj import CRS, Transformer
from shapely import Geometry, MultiPolygon, Polygon

from companion.core.frame import LocalFrame
from missions.maps.crs import (
    METRES_PER_DEGREE,
    SEGMENT_M,
    Floats,
    Objects,
    densified,
)

Area = Polygon | MultiPolygon
AnyArea = TypeVar("AnyArea", bound=Geometry)


@lru_cache(maxsize=8)
def _transformer(frame: LocalFrame) -> Transformer:
    return Transformer.from_crs(CRS.from_epsg(4326), frame.crs, always_xy=True)


def project_all(
    geometries: Objects, frame: LocalFrame, *, offset_m: tuple[float, float] = (0.0, 0.0)
) -> Objects:
    """Return the geometries in metres east and north of the frame's origin, moved by an offset.

    Long edges are cut first: straight in degrees is bent in metres, and a long edge beside two
    short ones would part from them by centimetres.
    """
    transformer = _transformer(frame)

    def transform(points: Floats) -> Floats:
        local = np.column_stack(transformer.transform(points[:, 0], points[:, 1]))
        moved: Floats = local + np.array(offset_m)
        return moved

    cut = densified(geometries, SEGMENT_M / METRES_PER_DEGREE)
    result: Objects = shapely.transform(cut, transform)
    return result


def places(points: Sequence[tuple[float, float]], frame: LocalFrame) -> Floats:
    """Return (latitude, longitude) points as rows of east and north, infinite beyond the earth."""
    degrees = np.array(points, dtype=np.float64).reshape(-1, 2)
    return np.column_stack(_transformer(frame).transform(degrees[:, 1], degrees[:, 0]))


# Corners to a quarter of a circle.
ROUND_SEGMENTS = 16
# A point or a line is ground too.
WIDTH_MIN_M = 0.01


def grown(geometries: Sequence[Geometry], distance_m: float, frame: LocalFrame) -> MultiPolygon:
    """Return all ground within a distance of areas, lines and points in longitude and latitude."""
    local = project_all(np.array(list(geometries), dtype=object), frame)
    # A circle drawn with corners lies inside of the true one; never less than the distance.
    far_m = max(distance_m, WIDTH_MIN_M) / math.cos(math.pi / (4 * ROUND_SEGMENTS))
    wider = shapely.union_all(shapely.buffer(local, far_m, quad_segs=ROUND_SEGMENTS))

    def back(points: Floats) -> Floats:
        latitude_deg, longitude_deg = frame.to_geographic_all(*points.T.tolist())
        return np.column_stack([longitude_deg, latitude_deg])

    found = shapely.transform(wider, back)
    return MultiPolygon([part for part in shapely.get_parts(found) if isinstance(part, Polygon)])


def project(
    geometry: AnyArea, frame: LocalFrame, *, offset_m: tuple[float, float] = (0.0, 0.0)
) -> AnyArea:
    """Return one geometry in metres east and north of the frame's origin, moved by an offset."""
    one = np.array([geometry], dtype=object)
    projected: AnyArea = project_all(one, frame, offset_m=offset_m)[0]
    return projected


def frame_around(geometries: Iterable[Geometry]) -> LocalFrame:
    """Return the frame whose origin is the centre of the bounds of all geometries."""
    west, south, east, north = shapely.total_bounds(np.array(list(geometries), dtype=object))
    middle = float((west + east) / 2)
    return LocalFrame(
        latitude_deg=float((south + north) / 2),
        longitude_deg=middle if middle <= 180.0 else middle - 360.0,
    )


def polygons_of(geometry: Geometry) -> list[Polygon]:
    """Return all polygons with an area inside a geometry, however nested."""
    parts = shapely.get_parts(shapely.get_parts(np.array([geometry], dtype=object)))
    return [part for part in parts if isinstance(part, Polygon) and part.area > 0.0]


def as_area(polygons: list[Polygon]) -> Area | None:
    """Return one polygon as it is, several as one multipolygon, none as None."""
    if not polygons:
        return None
    return polygons[0] if len(polygons) == 1 else MultiPolygon(polygons)


def make_valid(geometry: Area) -> Area | None:
    """Return the ground of rings that cross themselves, or None when there is none.

    "Structure" makes every ring valid, joins the shells and takes away the holes; shapely's
    default would turn ground that two shells share into a hole. A hole outside of its shell would
    become ground: nothing outside of the shells does.
    """
    found = shapely.make_valid(geometry, method="structure", keep_collapsed=False)
    parts = shapely.get_parts(geometry).tolist()
    if any(part.interiors for part in parts):
        shells = [Polygon(part.exterior) for part in parts]
        drawn = [
            shapely.make_valid(shell, method="structure", keep_collapsed=False) for shell in shells
        ]
        found = shapely.intersection(found, shapely.union_all(drawn))
    return as_area(polygons_of(found))
