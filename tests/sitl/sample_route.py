"""Lays straight passes over a real map, for the tests of flights over it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sitl.vehicle import Leg, Route

SPEED_M_S = 5.0
RUN_OUT_M = 15.0

# A straight line from start to end: (east, north), (east, north) [m].
Line = tuple[tuple[float, float], tuple[float, float]]


def swaths(
    middle_m: tuple[float, float],
    *,
    azimuth_deg: float,
    length_m: float,
    count: int,
    spacing_m: float = 6.0,
) -> list[Line]:
    """Return parallel lines around `middle_m`, flown back and forth."""
    angle = math.radians(azimuth_deg)
    along, right = (math.sin(angle), math.cos(angle)), (math.cos(angle), -math.sin(angle))
    half_m = 0.5 * length_m
    found: list[Line] = []
    for number in range(count):
        aside_m = (number - 0.5 * (count - 1)) * spacing_m
        east, north = (m + aside_m * r for m, r in zip(middle_m, right, strict=True))
        start = (east - half_m * along[0], north - half_m * along[1])
        end = (east + half_m * along[0], north + half_m * along[1])
        found.append((start, end) if number % 2 == 0 else (end, start))
    return found


def along_edge(start: tuple[float, float], end: tuple[float, float], angle_deg: float) -> Line:
    """Return a line that crosses the middle of an edge at `angle_deg` to it."""
    east, north = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
    azimuth_deg = math.degrees(math.atan2(end[0] - start[0], end[1] - start[1]))
    length_m = math.hypot(end[0] - start[0], end[1] - start[1]) + 2.0 * RUN_OUT_M
    return swaths((east, north), azimuth_deg=azimuth_deg + angle_deg, length_m=length_m, count=1)[0]


def route_of(lines: Sequence[Line], speed_m_s: float = SPEED_M_S) -> Route:
    """Return the route that flies the lines one after the other."""
    legs: list[Leg] = []
    for number, ((east_0, north_0), (east_1, north_1)) in enumerate(lines):
        if number:
            legs.append(Leg(east_m=east_0, north_m=north_0, speed_m_s=speed_m_s, kind="transit"))
        legs.append(Leg(east_m=east_1, north_m=north_1, speed_m_s=speed_m_s))
    return Route(start_east_m=lines[0][0][0], start_north_m=lines[0][0][1], legs=tuple(legs))
