"""Routes found in one step serve the next ones too, as long as the prediction holds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from companion.core.crossings import Route, find_routes
from companion.core.drift import Offset, is_same, offset
from companion.core.lines import Piece
from companion.core.overlap_guard import guarded
from companion.core.paths import STRAIGHT_YAW_RATE_DEG_S, place_velocity
from companion.core.types import VehicleState

if TYPE_CHECKING:
    from companion.core.controller import Memory
    from companion.core.setup import Setup

# Crossings found in one step are carried on for this long, if the path does not leave its
# prediction by more than these and none of them is to be ordered within this time.
ROUTES_KEPT_S = 0.21
ROUTES_ASIDE_M = 0.05
ROUTES_ALONG_M = 0.2
ROUTES_EXACT_S = 0.15


def routes_ahead(
    setup: Setup, state: VehicleState, memory: Memory, now_s: float
) -> tuple[tuple[Route, ...], VehicleState, Offset | None]:
    """Return the valves' routes, the state that they were found from, and their wind offset.

    On a straight pass the same edges are crossed at every step: as long as the prediction holds
    and no crossing is due soon, the last ones are carried on and only their times are shifted.
    """
    found_from = memory.routes_from
    drift_m = offset(setup.drift, state, now_s)
    if found_from is not None and is_same(drift_m, memory.drift_m):
        shift = _shift(setup, found_from, state, now_s)
        if shift is not None:
            routes = _shifted(memory.routes, shift, now_s)
            soon_s = now_s + setup.longest_s + ROUTES_EXACT_S
            if all(len(route) == 1 or route[1].at_s > soon_s for route in routes):
                return routes, found_from, memory.drift_m
    routes = find_routes(
        setup.prescription,
        state,
        setup.boom,
        back_s=setup.back_s,
        ahead_s=setup.ahead_s,
        border=setup.border,
        border_buffer_m=setup.border_buffer_m,
        across=setup.across,
        drift_m=drift_m,
        flown=_flown(setup, state, memory),
    )
    return guarded(setup, memory, state, routes, now_s, drift_m=drift_m), state, drift_m


def _flown(setup: Setup, state: VehicleState, memory: Memory) -> tuple[Piece, ...] | None:
    """Return the planned lines that the vehicle is on; None where spraying needs none."""
    if setup.lines is None:
        return None
    was_on_one = any(zone.rate_l_ha is not None for route in memory.routes for zone in route)
    return setup.lines.flown(
        state,
        back_s=setup.back_s,
        ahead_s=setup.ahead_s,
        reach_m=setup.boom.reach_m,
        entering=not was_on_one,
    )


def _shift(
    setup: Setup, before: VehicleState, state: VehicleState, now_s: float
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
    aside += bend * speed * (setup.longest_s + ROUTES_EXACT_S)
    aside += math.radians(abs(turned_deg)) * setup.boom.reach_m
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
