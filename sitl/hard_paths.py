"""Flights that are hard to predict: along arcs, with a speed that sways, braking over the field.

All of them are the copter of `vehicle.py` on a straight line, whose way along and across the line
is then laid on another centre line. Along and across are the coordinates of `hard_fields.py` too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sitl.route import Leg, Route
from sitl.trajectory import Floats, Trajectory
from sitl.vehicle import STEP_S, Vehicle

HEIGHT_M = 3.5
RUN_M = 25.0  # before and behind the field, so that the speed is steady there
START_S = 100.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CentreLine:
    """A straight line (curvature 0) or an arc, to the right where the curvature is positive."""

    curvature_1_m: float = 0.0
    course_deg: float = 0.0

    def course_rad(self, along_m: Floats) -> Floats:
        """Return the course after `along_m`."""
        return math.radians(self.course_deg) + self.curvature_1_m * along_m

    def place(self, along_m: Floats, right_m: Floats) -> tuple[Floats, Floats]:
        """Return east and north of places beside the line."""
        course = self.course_rad(along_m)
        sin, cos = np.sin(course), np.cos(course)
        if self.curvature_1_m == 0.0:
            return along_m * sin + right_m * cos, along_m * cos - right_m * sin
        begin = math.radians(self.course_deg)
        radius_m = 1.0 / self.curvature_1_m
        east_m = radius_m * math.cos(begin) - (radius_m - right_m) * cos
        north_m = -radius_m * math.sin(begin) + (radius_m - right_m) * sin
        return east_m, north_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """How fast the field is flown over.

    `slow_m_s` is braked to at the end of every `fast_m`, held for `slow_m`, and left again. Speed
    sways by `sway_m_s` in `sway_period_s`, as a sine of any phase, on top of gusts.
    """

    speed_m_s: float = 5.0
    acceleration_m_s2: float = 2.5
    gust_m_s: float = 1.0
    sway_m_s: float = 0.0
    sway_period_s: float = 6.0
    slow_m_s: float | None = None
    fast_m: float = 50.0
    slow_m: float = 8.0


def hard_trajectory(line: CentreLine, pace: Pace, length_m: float, *, seed: int) -> Trajectory:
    """Return a flight along `line` from before its start to beyond `length_m`."""
    route = _straight(pace, length_m)
    flown = Vehicle(
        route,
        start_s=START_S,
        seed=seed,
        acceleration_m_s2=pace.acceleration_m_s2,
        gust_m_s=pace.gust_m_s,
    ).fly_to_end()
    if pace.gust_m_s > 1.0:
        # The strong gusts are those of the speed: across, the line is held as in gusts of 1 m/s.
        flown = replace(
            flown,
            east_m=flown.east_m / pace.gust_m_s,
            velocity_east_m_s=flown.velocity_east_m_s / pace.gust_m_s,
        )
    if pace.sway_m_s > 0.0:
        phase = float(np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi))
        flown = _swaying(flown, pace, phase)
    return laid_on(flown, line)


def _straight(pace: Pace, length_m: float) -> Route:
    """Return the way northwards: one leg, or legs of two speeds in turn."""
    end_m = length_m + RUN_M
    ends = [(end_m, pace.speed_m_s)]
    if pace.slow_m_s is not None:
        ends, at_m = [], 0.0
        while at_m + pace.fast_m + pace.slow_m < length_m:
            ends.append((at_m + pace.fast_m, pace.speed_m_s))
            at_m += pace.fast_m + pace.slow_m
            ends.append((at_m, pace.slow_m_s))
        ends.append((end_m, pace.speed_m_s))
    legs = tuple(Leg(east_m=0.0, north_m=north_m, speed_m_s=speed) for north_m, speed in ends)
    return Route(start_east_m=0.0, start_north_m=-RUN_M, legs=legs, height_m=HEIGHT_M)


def _swaying(flown: Trajectory, pace: Pace, phase: float) -> Trajectory:
    """Return the flight with its speed raised and lowered in proportion to itself."""
    turns = 2.0 * math.pi / pace.sway_period_s * (flown.time_s - flown.time_s[0]) + phase
    speed = flown.velocity_north_m_s * (1.0 + pace.sway_m_s / pace.speed_m_s * np.sin(turns))
    gone_m = np.cumsum(0.5 * (speed[1:] + speed[:-1])) * STEP_S
    north_m = flown.north_m[0] + np.concatenate(([0.0], gone_m))
    return replace(flown, north_m=north_m, velocity_north_m_s=speed)


def laid_on(flown: Trajectory, line: CentreLine) -> Trajectory:
    """Return a flight northwards along north 0 laid on `line`: the nose follows its course."""
    along_m, right_m = flown.north_m, flown.east_m
    east_m, north_m = line.place(along_m, right_m)
    course = line.course_rad(along_m)
    sin, cos = np.sin(course), np.cos(course)
    ahead = flown.velocity_north_m_s * (1.0 - line.curvature_1_m * right_m)
    aside = flown.velocity_east_m_s
    return replace(
        flown,
        east_m=east_m,
        north_m=north_m,
        velocity_east_m_s=ahead * sin + aside * cos,
        velocity_north_m_s=ahead * cos - aside * sin,
        heading_deg=np.degrees(course),
    )
