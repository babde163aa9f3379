"""Waypoints over the ground: heights above home, and the points that a slope needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from missions.errors import PlanError
from missions.plan import Leg, Place, Settings, Sortie
from missions.speeds import ROUND_M_S, Stretches
from missions.stops import Stop
from missions.strips import Floats
from missions.terrain import Profile, Terrain

# The return that an autopilot flies unless told otherwise is 15 m above home (ArduPilot's RTL_ALT)
# or higher; ground that comes nearer to it than half of that is warned of.
RETURN_LOW_M = 7.5


def raised(stops: Sequence[Stop], terrain: Terrain, *, home: Place, height_m: float) -> list[Stop]:
    """Return the stops with heights above home, and more of them where the ground bends.

    `height_m` is that of the lines over the ground; a stop may have one of its own.
    """
    home_m = float(terrain.heights_m(np.array([home]))[0])
    first_m = height_m if stops[0].height_m is None else stops[0].height_m
    found = [stops[0]._replace(height_m=_above(terrain, stops[0].place, home_m) + first_m)]
    lines_m = height_m
    for before, after in pairwise(stops):
        height_m = lines_m if after.height_m is None else after.height_m
        way = terrain.straight_parts([before.place, after.place])
        inner = zip(way.places[1:-1].tolist(), way.ground_m[1:-1].tolist(), strict=True)
        found += [
            Stop(
                place=(east_m, north_m),
                speed_m_s=after.speed_m_s,
                height_m=ground_m - home_m + height_m,
            )
            for (east_m, north_m), ground_m in inner
        ]
        found.append(after._replace(height_m=float(way.ground_m[-1]) - home_m + height_m))
    return found


def _above(terrain: Terrain, place: Place, home_m: float) -> float:
    return float(terrain.heights_m(np.array([place]))[0]) - home_m


def return_above_m(sortie: Sortie, terrain: Terrain, home: Place) -> float:
    """Return how far the ground rises above home between any place of a sortie and home.

    A return may begin anywhere, so it is looked at from every end of a leg.
    """
    home_m = float(terrain.heights_m(np.array([home]))[0])
    ends = {leg.points[-1] for leg in sortie.legs if leg.kind == "spray"}
    ways = [terrain.profile([end, home]).ground_m.max() for end in sorted(ends)]
    return float(max(ways, default=home_m)) - home_m


def return_warnings(
    sorties: Sequence[Sortie], terrain: Terrain, depots: Sequence[Place], height_m: float
) -> tuple[str, ...]:
    """Return what the return height must be where the ground comes near to the usual one."""
    highest = max(
        (return_above_m(each, terrain, depots[each.depot]) for each in sorties), default=0.0
    )
    if highest <= RETURN_LOW_M:
        return ()
    return (
        f"the ground rises {highest:.0f} m above home on straight ways back: set the height of "
        f"the return (RTL_ALT, PX4: RTL_RETURN_ALT) to {highest + height_m + 5.0:.0f} m or more",
    )


# Speeds over sloping ground: what climb and descent allow, and where nothing is allowed.

# No way is flown slower than this, whatever safety.speed_min_m_s says.
SLOWEST_M_S = 0.5


def speed_limits(found: Profile, terrain: Terrain) -> Floats:
    """Return the highest speed on each part of a profile: speed times slope is the climb."""
    slope = np.diff(found.ground_m) / np.maximum(np.diff(found.at_m), 1e-9)
    with np.errstate(divide="ignore"):
        limit = np.where(slope > 0.0, terrain.climb_m_s / slope, terrain.descent_m_s / -slope)
    return np.where(slope == 0.0, np.inf, limit)


def _checked(
    points: Sequence[Place], terrain: Terrain, settings: Settings, least_m_s: float
) -> tuple[Profile, Floats]:
    """Return profile and rounded limits of a way; PlanError where it is too steep to fly."""
    found = terrain.straight_parts(points)
    limits = speed_limits(found, terrain)
    rounded = np.floor(np.minimum(limits, 1e6) / ROUND_M_S + 1e-9) * ROUND_M_S
    least_m_s = min(max(least_m_s, SLOWEST_M_S), settings.speed_m_s)
    steep = np.flatnonzero(~(rounded >= least_m_s - 1e-9))
    if len(steep):
        at = int(steep[np.argmin(limits[steep])])
        east_m, north_m = ((found.places[at] + found.places[at + 1]) / 2.0).tolist()
        latitude_deg, longitude_deg = terrain.frame.to_geographic(east_m, north_m)
        run_m = float(found.at_m[at + 1] - found.at_m[at])
        rise_m = float(found.ground_m[at + 1] - found.ground_m[at])
        name = "climb_max_m_s" if rise_m > 0.0 else "descent_max_m_s"
        value = terrain.climb_m_s if rise_m > 0.0 else terrain.descent_m_s
        raise PlanError(
            f"the ground {'rises' if rise_m > 0.0 else 'falls'} {abs(rise_m):.1f} m on "
            f"{run_m:.1f} m near {latitude_deg:.6f}, {longitude_deg:.6f}: with {value:g} m/s "
            f"(mission.{name}) that takes less than {least_m_s:g} m/s; "
            "plan another course (--angle-deg), leave it out (--obstacle), or smooth the model"
        )
    return found, rounded


def capped(
    leg: Leg, parts: Stretches, taken: Floats, terrain: Terrain, settings: Settings
) -> tuple[Stretches, Floats]:
    """Return stretches and speeds of a spray line, no faster than its slopes allow."""
    found, limits = _checked(leg.points, terrain, settings, settings.speeds_m_s[0])
    if not bool((limits < taken.max()).any()):
        return parts, taken
    cuts = np.minimum(found.at_m[1:], parts.ends_m[-1])
    cuts[-1] = parts.ends_m[-1]
    ends = np.unique(np.concatenate([parts.ends_m, cuts]))
    ends = ends[ends > 0.0]
    middle = ends - np.diff(ends, prepend=0.0) / 2.0
    own = np.searchsorted(parts.ends_m, middle)
    limit = limits[np.searchsorted(cuts, middle)]
    share = np.diff(ends, prepend=0.0) / np.diff(parts.ends_m, prepend=0.0)[own]
    refined = Stretches(
        ends_m=ends,
        low=parts.low[own],
        high=parts.high[own],
        litres=parts.litres[own] * share,
        least_l_ha=parts.least_l_ha[own],
        most_l_ha=parts.most_l_ha[own],
    )
    return refined, np.minimum(taken[own], limit)


def slowed(leg: Leg, terrain: Terrain, settings: Settings) -> Leg:
    """Return a transit or ferry no faster than its steepest part allows."""
    if not leg.length_m > 0.0:
        return leg
    _, limits = _checked(leg.points, terrain, settings, SLOWEST_M_S)
    speed = float(min(leg.speed_m_s, limits.min()))
    if speed == leg.speed_m_s:
        return leg
    return replace(leg, speed_m_s=speed)
