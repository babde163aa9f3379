"""The places of a sortie at which something changes, one after the other."""

from __future__ import annotations

import math
from dataclasses import dataclass

from missions.plan import Place, Sortie

# Waypoints closer than this to the one before say nothing new: a border goes on in its next line.
SAME_M = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """A place of the way, the speed of the way to it, and whether a line begins or ends there.

    `height_m` is above home; None leaves it to the plan's one height.
    """

    place: Place
    speed_m_s: float
    opens: bool | None = None
    height_m: float | None = None


def waypoints_of(sortie: Sortie, *, apart: bool = False) -> list[Stop]:
    """Return the places of a sortie from the depot on.

    Where one line goes on in the next, their ends are one place in the middle, unless `apart`;
    where the speed changes inside a line, there is a place and nothing closes.
    The way back to the depot is left to the return, but for its bends.
    """
    legs = sortie.legs
    stops = [Stop(place=legs[0].points[0], speed_m_s=legs[0].speed_m_s)]
    for number, leg in enumerate(legs):
        if leg.kind == "spray":
            goes_on = legs[number - 1].kind == "spray"
            ends = number + 1 == len(legs) or legs[number + 1].kind != "spray"
            if not goes_on:
                _add(stops, leg.points[0], legs[number - 1].speed_m_s, apart=apart)
            stops.append(
                Stop(place=leg.points[-1], speed_m_s=leg.speed_m_s, opens=False if ends else None)
            )
            continue
        stops += [Stop(place=place, speed_m_s=leg.speed_m_s) for place in leg.points[1:-1]]
    return stops


def _add(stops: list[Stop], place: Place, speed_m_s: float, *, apart: bool) -> None:
    """Add the start of a line; one that the last line goes on in is already there."""
    last = stops[-1]
    if last.opens is False and math.dist(last.place, place) < SAME_M and not apart:
        middle = ((last.place[0] + place[0]) / 2.0, (last.place[1] + place[1]) / 2.0)
        stops[-1] = Stop(place=middle, speed_m_s=last.speed_m_s)
        return
    stops.append(Stop(place=place, speed_m_s=speed_m_s, opens=True))
