"""Routes found in one step serve the next ones too, as long as the prediction holds."""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.core.crossings import Route
from companion.core.drift import Offset
from companion.core.paths import STRAIGHT_YAW_RATE_DEG_S, place_velocity
from companion.core.types import VehicleState

# Crossings found in one step are carried on for this long, if the path does not leave its
# prediction by more than these and none of them is to be ordered within this time.
ROUTES_KEPT_S = 0.21
ROUTES_ASIDE_M = 0.05
ROUTES_ALONG_M = 0.2
ROUTES_EXACT_S = 0.15


class KnownRoutes(NamedTuple):
    """The routes in view, the state that they were found from, and the wind's offset then."""

    routes: tuple[Route, ...] = ()
    found_from: VehicleState | None = None
    drift_m: Offset | None = None


NO_ROUTES = KnownRoutes()


def carried_on(
    known: KnownRoutes, state: VehicleState, *, longest_s: float, reach_m: float, now_s: float
) -> KnownRoutes | None:
    """Return the routes of before at the times that the new position gives; None if they are over.

    On a straight pass the same edges are crossed at every step: as long as the prediction holds
    and no crossing is due within `longest_s`, the longest lead, the last ones are carried on.
    """
    if known.found_from is None:
        return None
    exact_s = longest_s + ROUTES_EXACT_S
    shift = _shift(known.found_from, state, exact_s=exact_s, reach_m=reach_m, now_s=now_s)
    if shift is None:
        return None
    routes = _shifted(known.routes, shift, now_s)
    soon_s = now_s + exact_s
    if not all(len(route) == 1 or route[1].at_s > soon_s for route in routes):
        return None
    return known._replace(routes=routes)


def _shift(
    before: VehicleState, state: VehicleState, *, exact_s: float, reach_m: float, now_s: float
) -> tuple[float, float, float] | None:
    """Return how far along, how fast then and how fast now; None where the prediction fails."""
    age_s = now_s - before.time_s
    turning = max(abs(before.yaw_rate_deg_s), abs(state.yaw_rate_deg_s))
    if not (0.0 <= age_s <= ROUTES_KEPT_S and turning < STRAIGHT_YAW_RATE_DEG_S):
        return None
    went_east, went_north = place_velocity(before)
    then_east = went_east + before.acceleration_east_m_s2 * age_s
    then_north = went_north + before.acceleration_north_m_s2 * age_s
    east, north = place_velocity(state)
    speed, then = math.hypot(east, north), math.hypot(then_east, then_north)
    if not (speed > 0.5 and then > 0.5):
        return None
    half = 0.5 * age_s * age_s
    off_east = state.east_m - before.east_m - went_east * age_s
    off_east -= before.acceleration_east_m_s2 * half
    off_north = state.north_m - before.north_m - went_north * age_s
    off_north -= before.acceleration_north_m_s2 * half
    aside = abs(off_north * east - off_east * north) / speed
    bend = abs(then_east * north - then_north * east) / (speed * then)
    turned_deg = ((state.heading_deg or 0.0) - (before.heading_deg or 0.0) + 180.0) % 360.0 - 180.0
    aside += bend * speed * exact_s
    aside += math.radians(abs(turned_deg)) * reach_m
    along = (off_east * east + off_north * north) / speed
    if not (aside <= ROUTES_ASIDE_M and abs(along) <= ROUTES_ALONG_M):
        return None
    return along, then, speed


def _shifted(
    routes: tuple[Route, ...], shift: tuple[float, float, float], now_s: float
) -> tuple[Route, ...]:
    """Return the routes with their crossings at the times that the new position gives."""
    along_m, then, speed = shift
    moved: list[Route] = []
    for route in routes:
        if len(route) == 1:
            moved.append(route)
            continue
        moved.append(
            route[:1]
            + tuple(
                crossing._replace(at_s=now_s + ((crossing.at_s - now_s) * then - along_m) / speed)
                for crossing in route[1:]
            )
        )
    return tuple(moved)
