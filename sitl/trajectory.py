"""The truth of a simulated flight: at one time, and as arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Where the autopilot's position reference really is."""

    time_s: float
    east_m: float
    north_m: float
    height_m: float
    velocity_east_m_s: float
    velocity_north_m_s: float
    heading_deg: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """A flight as arrays, evenly spaced; headings are unwrapped, so that they interpolate."""

    time_s: Floats
    east_m: Floats
    north_m: Floats
    velocity_east_m_s: Floats
    velocity_north_m_s: Floats
    heading_deg: Floats
    leg: NDArray[np.int64]
    height_m: float

    @property
    def speed_m_s(self) -> Floats:
        """Return the speed over the ground."""
        return np.hypot(self.velocity_east_m_s, self.velocity_north_m_s)

    def at(self, time_s: Floats) -> Trajectory:
        """Return the flight at other times, interpolated; held at its ends."""
        nearest = np.clip(np.searchsorted(self.time_s, time_s), 0, len(self.time_s) - 1)
        return Trajectory(
            time_s=time_s,
            east_m=np.interp(time_s, self.time_s, self.east_m),
            north_m=np.interp(time_s, self.time_s, self.north_m),
            velocity_east_m_s=np.interp(time_s, self.time_s, self.velocity_east_m_s),
            velocity_north_m_s=np.interp(time_s, self.time_s, self.velocity_north_m_s),
            heading_deg=np.interp(time_s, self.time_s, self.heading_deg),
            leg=self.leg[nearest],
            height_m=self.height_m,
        )

    def truth_at(self, time_s: float) -> Truth:
        """Return the truth at one time."""
        return self.truths_at([time_s])[0]

    def truths_at(self, times_s: list[float]) -> list[Truth]:
        """Return the truth at each of some times."""
        at = self.at(np.array(times_s, dtype=np.float64))
        columns = (
            at.east_m,
            at.north_m,
            at.velocity_east_m_s,
            at.velocity_north_m_s,
            at.heading_deg % 360.0,
        )
        rows = zip(times_s, *(column.tolist() for column in columns), strict=True)
        return [
            Truth(
                time_s=time_s,
                east_m=east_m,
                north_m=north_m,
                height_m=self.height_m,
                velocity_east_m_s=velocity_east,
                velocity_north_m_s=velocity_north,
                heading_deg=heading_deg,
            )
            for time_s, east_m, north_m, velocity_east, velocity_north, heading_deg in rows
        ]


# Where a simulated flight goes: straight legs, one after the other.


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
