"""Speeds over sloping ground: what climb and descent allow, and where nothing is allowed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from missions.errors import PlanError
from missions.plan import Leg, Place, Settings
from missions.speeds import ROUND_M_S, Stretches
from missions.strips import Floats
from missions.terrain.ground import Profile, Terrain

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
