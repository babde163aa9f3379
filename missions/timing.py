"""How long each leg of a sortie takes, as its autopilot flies it: one model for all figures.

The way home after the last place is the return's: it begins and ends at rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from missions.corners import Course, parts_s
from missions.plan import Place, Settings, Sortie
from missions.stops import SAME_M, is_passed, is_run

# Places nearer than this are one.
TOUCH_M = 1e-3
SQUARE_DEG = 90.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Way:
    """A way between two waypoints; `legs` are (leg, metres) that it is of.

    One that leads `upright_m` up, or down, has both above each other.
    """

    start: Place
    end: Place
    speed_m_s: float
    legs: tuple[tuple[int, float], ...]
    upright_m: float = 0.0

    @property
    def length_m(self) -> float:
        return abs(self.upright_m) or math.dist(self.start, self.end)

    @property
    def course_deg(self) -> float:
        east_m, north_m = self.end[0] - self.start[0], self.end[1] - self.start[1]
        return math.degrees(math.atan2(east_m, north_m))


def timed(sorties: Sequence[Sortie], settings: Settings) -> tuple[Sortie, ...]:
    """Return the sorties with the seconds of each leg."""
    return tuple(_timed(sortie, settings) for sortie in sorties)


def _timed(sortie: Sortie, settings: Settings) -> Sortie:
    ways, motion = _ways(sortie, settings.height_m), settings.motion
    seconds = [0.0] * len(sortie.legs)
    sprays = [leg.kind == "spray" for leg in sortie.legs]
    for some in (_without_runs(ways[:-1], sprays), ways[-1:]):
        found = parts_s(
            [way.length_m for way in some],
            [_bend_deg(before, after) for before, after in pairwise(some)],
            [_course(way, settings) for way in some],
            motion.corners,
        )
        for way, taken_s in zip(some, found, strict=True):
            whole_m = sum(length_m for _, length_m in way.legs)
            for leg, length_m in way.legs:
                seconds[leg] += taken_s * length_m / whole_m
    legs = (replace(leg, seconds=each) for leg, each in zip(sortie.legs, seconds, strict=True))
    return replace(sortie, legs=tuple(legs))


def _course(way: _Way, settings: Settings) -> Course:
    """Return how fast a way is flown, and how that speed is reached."""
    if not way.upright_m:
        return settings.motion.at(way.speed_m_s)
    vertical = settings.vertical
    return Course(
        speed_m_s=vertical.climb_m_s if way.upright_m > 0.0 else vertical.descent_m_s,
        acceleration_m_s2=vertical.acceleration_m_s2,
        jerk_m_s3=settings.motion.jerk_m_s3,
    )


def _bend_deg(before: _Way, after: _Way) -> float:
    if before.upright_m or after.upright_m:
        return SQUARE_DEG
    return (after.course_deg - before.course_deg + 180.0) % 360.0 - 180.0


def _ways(sortie: Sortie, lines_m: float) -> list[_Way]:
    """Return the straight ways of a sortie, one after the other, climbs and descents among them.

    What a ferry takes to climb and descend, at its two ends, is its own.
    """
    found = []
    here = sortie.legs[0].points[0]
    heights_m = [lines_m if leg.height_m is None else leg.height_m for leg in sortie.legs]
    for number, leg in enumerate(sortie.legs):
        rise_m = heights_m[number] - heights_m[max(number - 1, 0)]
        if rise_m:
            higher = number if rise_m > 0.0 else number - 1
            found.append(
                _Way(
                    start=here, end=here, speed_m_s=leg.speed_m_s,
                    legs=((higher, abs(rise_m)),), upright_m=rise_m,
                )
            )  # fmt: skip
        if _is_no_way(sortie, number):
            # The ends of both lines are one waypoint.
            here = leg.points[-1]
            continue
        for place in leg.points:
            length_m = math.dist(here, place)
            if length_m > TOUCH_M:
                found.append(
                    _Way(
                        start=here, end=place, speed_m_s=leg.speed_m_s, legs=((number, length_m),),
                    )
                )  # fmt: skip
                here = place
    return found


def _is_no_way(sortie: Sortie, number: int) -> bool:
    """Whether a leg joins two lines whose ends are written as one waypoint."""
    leg = sortie.legs[number]
    if leg.kind == "spray" or len(leg.points) > 2 or leg.length_m >= SAME_M:
        return False
    around = (*sortie.legs[max(number - 1, 0) : number], *sortie.legs[number + 1 : number + 2])
    return [other.kind for other in around] == ["spray", "spray"]


def _without_runs(ways: list[_Way], sprays: Sequence[bool]) -> list[_Way]:
    """Return the ways between waypoints: those that lead straight on are one.

    `sprays` says of which legs are lines.
    """
    kept, passed = ways[:1], list[Place]()
    for way in ways[1:]:
        last = kept[-1]
        ends = (last.start, last.end, way.end)
        on_line = sprays[last.legs[-1][0]] or sprays[way.legs[0][0]]
        level = not way.upright_m and not last.upright_m
        same = level and way.speed_m_s == last.speed_m_s
        if same and (is_run(*ends) or (on_line and is_passed(*ends, passed))):
            passed.append(last.end)
            kept[-1] = replace(last, end=way.end, legs=(*last.legs, *way.legs))
        else:
            passed = []
            kept.append(way)
    return kept
