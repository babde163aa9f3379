"""How long each leg of a sortie takes, as its autopilot flies it: one model for all figures.

The way home after the last place is the return's: it begins and ends at rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

from missions.corners import parts_s
from missions.plan import Place, Settings, Sortie
from missions.stops import SAME_M, is_run

# Places nearer than this are one.
TOUCH_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class _Way:
    """A way between two waypoints; `legs` are (leg, metres) that it is of."""

    start: Place
    end: Place
    speed_m_s: float
    legs: tuple[tuple[int, float], ...]
    height_m: float | None = None

    @property
    def length_m(self) -> float:
        return math.dist(self.start, self.end)

    @property
    def course_deg(self) -> float:
        east_m, north_m = self.end[0] - self.start[0], self.end[1] - self.start[1]
        return math.degrees(math.atan2(east_m, north_m))


def timed(sorties: Sequence[Sortie], settings: Settings) -> tuple[Sortie, ...]:
    """Return the sorties with the seconds of each leg."""
    return tuple(_timed(sortie, settings) for sortie in sorties)


def _timed(sortie: Sortie, settings: Settings) -> Sortie:
    ways, motion = _ways(sortie), settings.motion
    seconds = _upright_s(sortie, settings)
    level = (list(some) for _, some in groupby(ways[:-1], key=lambda way: way.height_m))
    for some in (*map(_without_runs, level), ways[-1:]):
        bends_deg = [
            abs((after.course_deg - before.course_deg + 180.0) % 360.0 - 180.0)
            for before, after in pairwise(some)
        ]
        found = parts_s(
            [way.length_m for way in some], bends_deg, [motion.at(way.speed_m_s) for way in some],
            motion.corners,
        )  # fmt: skip
        for way, taken_s in zip(some, found, strict=True):
            whole_m = sum(length_m for _, length_m in way.legs)
            for leg, length_m in way.legs:
                seconds[leg] += taken_s * length_m / whole_m
    legs = (replace(leg, seconds=each) for leg, each in zip(sortie.legs, seconds, strict=True))
    return replace(sortie, legs=tuple(legs))


def _upright_s(sortie: Sortie, settings: Settings) -> list[float]:
    """Return what each leg takes to climb or descend: a ferry both, at its two ends."""
    lines_m = settings.height_m
    heights_m = [lines_m if leg.height_m is None else leg.height_m for leg in sortie.legs]
    seconds = [0.0] * len(heights_m)
    for number, (before_m, after_m) in enumerate(pairwise(heights_m)):
        if before_m != after_m:
            higher = number if before_m > after_m else number + 1
            seconds[higher] += settings.vertical.change_s(before_m, after_m)
    return seconds


def _ways(sortie: Sortie) -> list[_Way]:
    """Return the straight ways of a sortie, one after the other."""
    found = []
    here = sortie.legs[0].points[0]
    for number, leg in enumerate(sortie.legs):
        if leg.through and leg.length_m < SAME_M:
            # The ends of both lines are one waypoint.
            here = leg.points[-1]
            continue
        for place in leg.points:
            length_m = math.dist(here, place)
            if length_m > TOUCH_M:
                found.append(
                    _Way(
                        start=here, end=place, speed_m_s=leg.speed_m_s, legs=((number, length_m),),
                        height_m=leg.height_m,
                    )
                )  # fmt: skip
                here = place
    return found


def _without_runs(ways: list[_Way]) -> list[_Way]:
    """Return the ways between waypoints: those that lead straight on are one."""
    kept = ways[:1]
    for way in ways[1:]:
        last = kept[-1]
        if way.speed_m_s == last.speed_m_s and is_run(last.start, last.end, way.end):
            kept[-1] = replace(last, end=way.end, legs=(*last.legs, *way.legs))
        else:
            kept.append(way)
    return kept
