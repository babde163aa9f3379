"""From a mission file to the route of a simulated flight, in the frame of its map.

The file is read and understood as the stub autopilot does it, so that one mission gives one
flight whichever way it is simulated. A flight without sockets begins in the air.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from shapely import LineString

from companion.core.frame import LocalFrame
from companion.errors import ConfigError
from sitl.earth import Earth
from sitl.stub.flight import SAME_PLACE_M, plan_flight
from sitl.stub.mission_items import read_mission
from sitl.vehicle import Leg, Route

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

    from sitl.stub.mission_items import MissionItem

SPEED_MIN_M_S, SPEED_MAX_M_S = 0.5, 20.0


def read_route(
    path: Path, frame: LocalFrame, *, speed_m_s: float | None, default_speed_m_s: float
) -> Route:
    """Return the route of a mission file in `frame`.

    Args:
        path: `.plan` or `.waypoints`.
        frame: of the map; the mission's own origin is its home.
        speed_m_s: flown on every leg, whatever the mission says; None leaves it to the mission.
        default_speed_m_s: until the mission sets one.
    """
    items = read_mission(path)
    places = [item for item in items if item.has_place]
    if not places:
        raise ConfigError(f"{path}: no item has a place; plan at least one waypoint")
    home = Earth(places[0].latitude_deg, places[0].longitude_deg)
    plan = plan_flight(
        items,
        home,
        first_sequence=1,
        speed_m_s=default_speed_m_s,
        home_altitude_m=_home_altitude_m(items),
    )
    legs = [_moved(leg, home, frame, speed_m_s) for leg in plan.legs]
    start = frame.to_local(places[0].latitude_deg, places[0].longitude_deg)
    legs = _without_standing(start, legs)
    height_m = plan.height_m if plan.height_m is not None else plan.take_off_height_m
    if not legs or height_m is None:
        raise ConfigError(f"{path}: the mission leads nowhere; plan at least one waypoint")
    return Route(start_east_m=start[0], start_north_m=start[1], legs=tuple(legs), height_m=height_m)


def lines(route: Route) -> list[tuple[Leg, LineString]]:
    """Return each leg with the straight line that it flies."""
    ends = [(route.start_east_m, route.start_north_m)]
    ends += [(leg.east_m, leg.north_m) for leg in route.legs]
    return [(leg, LineString(pair)) for leg, pair in zip(route.legs, pairwise(ends), strict=True)]


def legs_over(
    route: Route, ground: Polygon | MultiPolygon, *, reach_m: float
) -> list[tuple[Leg, LineString]]:
    """Return the legs on which a boom that reaches `reach_m` to each side comes over `ground`."""
    return [(leg, line) for leg, line in lines(route) if line.distance(ground) <= reach_m]


def _home_altitude_m(items: tuple[MissionItem, ...]) -> float:
    """Return the altitude of home above the sea, which absolute heights are counted from."""
    return items[0].z_m if items[0].has_place else 0.0


def _moved(leg: Leg, home: Earth, frame: LocalFrame, speed_m_s: float | None) -> Leg:
    east_m, north_m = frame.to_local(*home.to_geographic(leg.east_m, leg.north_m))
    speed = leg.speed_m_s if speed_m_s is None else speed_m_s
    return replace(leg, east_m=east_m, north_m=north_m, speed_m_s=speed)


def _without_standing(start: tuple[float, float], legs: list[Leg]) -> list[Leg]:
    """Return the legs that lead somewhere: a landing where the vehicle is takes no way."""
    kept: list[Leg] = []
    at = start
    for leg in legs:
        if max(abs(leg.east_m - at[0]), abs(leg.north_m - at[1])) > SAME_PLACE_M:
            kept.append(leg)
            at = (leg.east_m, leg.north_m)
    return kept
