"""Waypoints over the ground: heights above home, and the points that a slope needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from missions.plan import Place, Sortie
from missions.stops import Stop
from missions.terrain.ground import Terrain

# The return that an autopilot flies unless told otherwise is 15 m above home (ArduPilot's RTL_ALT)
# or higher; ground that comes nearer to it than half of that is warned of.
RETURN_LOW_M = 7.5


def raised(stops: Sequence[Stop], terrain: Terrain, *, home: Place, height_m: float) -> list[Stop]:
    """Return the stops with heights above home, and more of them where the ground bends.

    `height_m` is that of the lines over the ground; a stop may have one of its own.
    """
    home_m = float(terrain.heights_m(np.array([home]))[0])
    first_m = height_m if stops[0].height_m is None else stops[0].height_m
    found = [replace(stops[0], height_m=_above(terrain, stops[0].place, home_m) + first_m)]
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
        found.append(replace(after, height_m=float(way.ground_m[-1]) - home_m + height_m))
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
