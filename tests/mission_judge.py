"""Judges a planned mission from its files, with shapely and the shape of the Earth alone.

Nothing of the planner is imported: outline and obstacles are those that were drawn, the plan is
the `.geojson` that was written, the fence that of the `.plan`. Places are turned into metres by
the tangent plane of WGS84 in the field's middle, in which ways that are straight on the ground
stay straight (3 mm over 2 km).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

Floats = NDArray[np.float64]

AXIS_M, FLATTENING = 6_378_137.0, 1.0 / 298.257_223_563
# An edge is straight on the ground for one program and in degrees for another.
STRAIGHT_M = 0.03
# A strip and the border that it is flown along differ by the digits of coordinates in files.
DIGITS_M = 1e-3
# Missed ground that is no more than the edge of some.
CRUMB_M2 = 1.0
STRIPS_GRID_M = 1e-6


def _centred(lon_lat: Floats) -> Floats:
    """Return places from the Earth's centre."""
    lon, lat = np.radians(lon_lat[:, 0]), np.radians(lon_lat[:, 1])
    square = FLATTENING * (2.0 - FLATTENING)
    normal = AXIS_M / np.sqrt(1.0 - square * np.sin(lat) ** 2)
    flat = normal * np.cos(lat)
    return np.column_stack(
        [flat * np.cos(lon), flat * np.sin(lon), normal * (1.0 - square) * np.sin(lat)]
    )


@dataclass(frozen=True)
class Plane:
    """The tangent plane at a place of longitude and latitude."""

    lon: float
    lat: float

    def metres(self, lon_lat: Floats) -> Floats:
        """Return east and north of the place."""
        away = _centred(lon_lat) - _centred(np.array([[self.lon, self.lat]]))
        lon, lat = np.radians(self.lon), np.radians(self.lat)
        east = np.array([-np.sin(lon), np.cos(lon), 0.0])
        north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
        return np.column_stack([away @ east, away @ north])

    def area(self, degrees: BaseGeometry) -> BaseGeometry:
        """Return an area in metres."""
        found: BaseGeometry = shapely.transform(degrees, self.metres)
        return found if found.is_valid else found.buffer(0.0)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What was drawn, in longitude and latitude; `tolerance_m` is what the plan may leave off."""

    outline: BaseGeometry
    obstacles: Sequence[BaseGeometry] = ()
    obstacle_buffer_m: float = 2.0
    no_spray: Sequence[BaseGeometry] = ()
    width_m: float = 6.0
    plane: Plane = field(init=False)

    def __post_init__(self) -> None:
        west, south, east, north = self.outline.bounds
        object.__setattr__(self, "plane", Plane((west + east) / 2.0, (south + north) / 2.0))

    def flown(self) -> BaseGeometry:
        """Return what may be flown over."""
        outline = self.plane.area(self.outline)
        parts = shapely.get_parts(outline)
        # A hole may be a pond: it is kept off as an obstacle is.
        holes = [shapely.Polygon(ring) for part in parts for ring in part.interiors]
        taken = [*holes, *(self.plane.area(each) for each in self.obstacles)]
        taken = [each.buffer(self.obstacle_buffer_m) for each in taken]
        return outline.difference(shapely.union_all(taken))

    def sprayed(self) -> BaseGeometry:
        """Return what may be sprayed."""
        return self.flown().difference(
            shapely.union_all([self.plane.area(each) for each in self.no_spray])
        )

    @cached_property
    def ground(self) -> BaseGeometry:
        """Return what may be sprayed, once."""
        return self.sprayed()

    @cached_property
    def reachable(self) -> BaseGeometry:
        """Return what of it a disc as wide as a swath reaches."""
        half_m = self.width_m / 2.0
        return self.ground.buffer(-half_m, quad_segs=32).buffer(half_m, quad_segs=32)


Legs = Sequence[tuple[str, Floats]]


def legs_of(drawn: Drawn, plan: dict[str, Any]) -> Legs:
    """Return kind and places of the legs of a plan as GeoJSON, in metres."""
    return [
        (each["properties"]["kind"], drawn.plane.metres(np.array(each["geometry"]["coordinates"])))
        for each in plan["features"]
        if each["geometry"]["type"] == "LineString"
    ]


def judge(drawn: Drawn, plan: dict[str, Any], *, speed_m_s: float, a_m_s2: float) -> dict[str, Any]:
    """Return the figures of a plan as GeoJSON."""
    return judge_legs(drawn, legs_of(drawn, plan), speed_m_s=speed_m_s, a_m_s2=a_m_s2)


def judge_legs(drawn: Drawn, legs: Legs, *, speed_m_s: float, a_m_s2: float) -> dict[str, Any]:
    """Return the figures of legs of kind `spray` and `transit`; others are not looked at."""
    strips, lengths_m = [], []
    for kind, points in legs:
        if kind == "spray":
            for a, b in pairwise(points):
                strips.append(_strip(a, b, drawn.width_m))
                lengths_m.append(float(np.hypot(*(b - a))))
    # Without a grid GEOS leaves strips out where sides of theirs nearly coincide.
    covered = shapely.union_all(strips, grid_size=STRIPS_GRID_M)
    ground, reachable = drawn.ground, drawn.reachable
    reached = covered.intersection(reachable).area
    off = covered.difference(ground.buffer(STRAIGHT_M))
    ways = [shapely.LineString(points[:, :2]) for kind, points in legs if kind == "transit"]
    free = drawn.flown().buffer(STRAIGHT_M)
    total_m = np.array(lengths_m)
    return {
        "area_ha": ground.area / 1e4,
        "lines": len(strips),
        "short_lines": int((total_m < speed_m_s**2 / a_m_s2).sum()),
        "under_1_m": int((total_m < 1.0).sum()),
        "spray_km": float(total_m.sum()) / 1e3,
        "covered_percent": 100.0 * covered.intersection(ground).area / ground.area,
        "reachable_percent": 100.0 * reached / reachable.area,
        "missed_m2": reachable.area - reached,
        "missed_places": _places(reachable.difference(covered), drawn.width_m),
        "twice_percent": 100.0 * (float(total_m.sum()) * drawn.width_m - covered.area)
        / ground.area,
        "off_m2": off.area if off.area > DIGITS_M else 0.0,
        "transit_outside_m": sum(way.difference(free).length for way in ways),
        "transit_km": sum(way.length for way in ways) / 1e3,
    }  # fmt: skip


def _places(missed: BaseGeometry, width_m: float) -> int:
    """Return at how many places ground is missed: what lies a swath apart is flown in one pass."""
    parts = shapely.get_parts(missed)
    together = shapely.union_all(parts[shapely.area(parts) > CRUMB_M2]).buffer(width_m / 2.0)
    return 0 if together.is_empty else len(shapely.get_parts(together))


def _strip(start: Floats, end: Floats, width_m: float) -> BaseGeometry:
    along = (end - start) / np.hypot(*(end - start))
    side = np.array([along[1], -along[0]]) * width_m / 2.0
    return shapely.Polygon([start + side, end + side, end - side, start - side])


def judge_fence(
    drawn: Drawn, plan: dict[str, Any], *, corners_max: int, outside_max_m: float
) -> list[str]:
    """Return what is wrong with the fence of a `.plan`."""
    polygons = plan["geoFence"]["polygons"]
    circles = plan["geoFence"]["circles"]
    corners = sum(len(each["polygon"]) for each in polygons)
    # As ArduPilot keeps it: 8 bytes a corner, 2 a polygon, 13 a circle, 5 in all.
    kept = 5 + 8 * corners + 2 * len(polygons) + 13 * len(circles)
    found = [f"{corners} corners, {kept} bytes"] if kept > 8 * corners_max else []
    inside, outside = [], []
    for each in polygons:
        ring = np.array(each["polygon"])[:, ::-1]
        area = shapely.Polygon(drawn.plane.metres(ring))
        if not area.is_valid:
            found.append("a ring crosses itself")
        (inside if each["inclusion"] else outside).append(area)
    for each in circles:
        lat, lon = each["circle"]["center"]
        middle = shapely.Point(*drawn.plane.metres(np.array([[lon, lat]]))[0])
        outside.append(middle.buffer(each["circle"]["radius"]))
    free = shapely.intersection_all(inside).difference(shapely.union_all(outside))
    items = [
        (item["params"][5], item["params"][4])
        for item in plan["mission"]["items"]
        if item["command"] in (16, 22) and item["params"][4]
    ]
    places = shapely.points(drawn.plane.metres(np.array(items)))
    beyond = int((~shapely.covers(free, places)).sum())
    if beyond:
        found.append(f"{beyond} items outside of it")
    ways = shapely.LineString(drawn.plane.metres(np.array(items)))
    if not free.buffer(DIGITS_M).covers(ways):
        found.append(f"{ways.difference(free).length:.1f} m of the way outside of it")
    outline = drawn.plane.area(drawn.outline)
    wanted = shapely.union_all([outline, *(way.buffer(2.0) for way in (ways,))])
    far_m = max(
        (
            float(shapely.distance(wanted, shapely.points(shapely.get_coordinates(each))).max())
            for each in inside
        ),
        default=0.0,
    )
    if far_m > outside_max_m:
        found.append(f"{far_m:.1f} m outside the field")
    return found
