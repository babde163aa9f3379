"""Ferries at a height of their own: climbing where a line ends, descending where one begins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from missions.plan import Leg, Place, Settings, Sortie

# A way inside the field that is at least so long is flown as high as a ferry.
LONG_TRANSIT_M = 100.0
# A ferry shorter than this is the way from a depot on the line's own end.
SHORT_M = 1.0
# Cosine of what counts as straight into a line.
STRAIGHT = 1.0 - 1e-6


def at_ferry_height(
    sorties: Sequence[Sortie], settings: Settings, *, run_in_m: float = 0.0
) -> tuple[Sortie, ...]:
    """Return the sorties with ferries and long transits at their own height, if they have one.

    The runs before and behind lines, each `run_in_m` at most, stay at the height of the lines.
    """
    height_m = settings.ferry_height_m
    if height_m is None:
        return tuple(sorties)
    found = []
    for sortie in sorties:
        legs: list[Leg] = []
        for number, leg in enumerate(sortie.legs):
            if not is_high(leg):
                legs.append(leg)
                continue
            before = sortie.legs[number - 1] if number else None
            after = sortie.legs[number + 1] if number + 1 < len(sortie.legs) else None
            legs += _raised(leg, before, after, height_m, run_in_m)
        found.append(replace(sortie, legs=tuple(legs)))
    return tuple(found)


def is_high(leg: Leg) -> bool:
    """Return whether a way is one that is flown at the height of ferries, where there is one."""
    if leg.kind == "spray" or leg.through:
        return False
    return leg.length_m >= (SHORT_M if leg.kind == "ferry" else LONG_TRANSIT_M)


def _raised(
    leg: Leg, before: Leg | None, after: Leg | None, height_m: float, run_in_m: float
) -> list[Leg]:
    """Return a way at its height, and the runs of the lines beside it as ways of their own."""
    points = list(leg.points)
    runs: list[Leg | None] = [None, None]
    if before is not None and _is_run(points[:2], before, len(points), run_in_m):
        runs[0] = _low(leg, points[:2])
        points = points[1:]
    if after is not None and _is_run(points[-2:], after, len(points), run_in_m):
        runs[1] = _low(leg, points[-2:])
        points = points[:-1]
    high = replace(leg, points=tuple(points), height_m=height_m)
    return [each for each in (runs[0], high, runs[1]) if each is not None]


def _low(leg: Leg, points: Sequence[Place]) -> Leg:
    return replace(leg, kind="transit", points=tuple(points))


def _is_run(points: Sequence[Place], line: Leg, count: int, run_in_m: float) -> bool:
    """Return whether the end of a way is a run in the direction of its line."""
    (x0, y0), (x1, y1) = points
    length_m = math.dist(*points)
    if count < 3 or not 0.0 < length_m <= run_in_m + 1e-6:
        return False
    (x2, y2), (x3, y3) = line.points[0], line.points[-1]
    along = (x1 - x0) * (x3 - x2) + (y1 - y0) * (y3 - y2)
    return along > STRAIGHT * length_m * line.length_m
