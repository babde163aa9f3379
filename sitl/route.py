"""Where a simulated flight goes: straight legs, one after the other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class Leg:
    """A straight way to a point; a transit is one on which nothing is to be sprayed."""

    east_m: float
    north_m: float
    speed_m_s: float
    kind: Literal["spray", "transit"] = "spray"

    def __post_init__(self) -> None:
        if not 0.1 <= self.speed_m_s <= 50.0:
            raise ValueError(f"speed of a leg must lie in [0.1, 50] m/s, got {self.speed_m_s}")
        if not (math.isfinite(self.east_m) and math.isfinite(self.north_m)):
            raise ValueError("a leg needs an end")


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """Where a flight starts, and its legs."""

    start_east_m: float
    start_north_m: float
    legs: tuple[Leg, ...]
    height_m: float = 3.5

    def __post_init__(self) -> None:
        if not self.legs:
            raise ValueError("a route needs a leg")


def lines_of(route: Route) -> list[tuple[float, float, float, float, float]]:
    """Return (start east, start north, sin, cos of the course, length) of each leg [m]."""
    lines: list[tuple[float, float, float, float, float]] = []
    east_m, north_m, sin, cos = route.start_east_m, route.start_north_m, 0.0, 1.0
    for leg in route.legs:
        length_m = math.hypot(leg.east_m - east_m, leg.north_m - north_m)
        if length_m > 0.0:
            sin, cos = (leg.east_m - east_m) / length_m, (leg.north_m - north_m) / length_m
        lines.append((east_m, north_m, sin, cos, length_m))
        east_m, north_m = leg.east_m, leg.north_m
    return lines
