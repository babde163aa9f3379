"""How autopilots fly the corners of a way, each by its own rule, and what its parts take so.

ArduCopter plans each leg from rest to rest, its jerk limited, and begins the next leg before the
last one has ended: as soon as both together stay within the waypoint's radius, the speed and the
corner's acceleration (AC_WPNav and SCurve of ArduPilot 4.1 and later). PX4 brakes to a speed that
the corner's angle allows within its radius (PositionSmoothing and TrajectoryConstraints).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from missions.strips import Floats

CornerRule = Literal["stop", "ardupilot", "px4"]

# ArduPilot's WPNAV_RADIUS, and WPNAV_ACCEL_C at 0: twice the acceleration of the legs.
RADIUS_M, CORNER_ACCELERATIONS = 2.0, 2.0
# ATC_INPUT_TC, the time in which the jerk comes and goes: it lengthens speeding up by twice that.
JERK_COMES_S = 0.15
# What a corner takes beyond that: the target waits for a vehicle that lags behind it. Measured
# beside ArduCopter 4.7 at 3 to 8 m/s: 0 to 0.25 s, the most in narrow U turns.
LAGS_S, LAGGING_DEG = 0.15, 60.0
# PX4's NAV_ACC_RAD of a copter.
PX4_RADIUS_M = 2.0
# The overlap of two legs is tried in so many steps: to 0.02 s.
OVERLAP_STEPS = 240


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """The speed of a leg, and how it is reached."""

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float | None

    def reaching(self, speed_m_s: float) -> float:
        """Return how long reaching a speed from rest takes [s]."""
        jerk, acceleration = self.jerk_m_s3, self.acceleration_m_s2
        if jerk is None:
            return speed_m_s / acceleration
        if speed_m_s >= acceleration**2 / jerk:
            return speed_m_s / acceleration + acceleration / jerk + 2.0 * JERK_COMES_S
        return 2.0 * math.sqrt(speed_m_s / jerk) + 2.0 * JERK_COMES_S

    @property
    def reaching_s(self) -> float:
        """Return how long reaching the leg's speed takes."""
        return self.reaching(self.speed_m_s)


def parts_s(
    lengths_m: Sequence[float],
    bends_deg: Sequence[float],
    courses: Sequence[Course],
    rule: CornerRule,
) -> list[float]:
    """Return the time of each straight part of a way from rest to rest; a bend between each two.

    What a corner spares is taken from the part after it.
    """
    if rule == "px4":
        return _slowed_s(lengths_m, bends_deg, courses)
    legs = [_Leg.of(length, course) for length, course in zip(lengths_m, courses, strict=True)]
    seconds = [leg.seconds for leg in legs]
    if rule == "ardupilot":
        for number, ((one, other), bend_deg) in enumerate(
            zip(pairwise(legs), bends_deg, strict=True), start=1
        ):
            seconds[number] -= _overlap_s(one, other, math.radians(bend_deg))
            seconds[number] += LAGS_S if abs(bend_deg) > LAGGING_DEG else 0.0
    return seconds


@dataclass(frozen=True, slots=True, kw_only=True)
class _Leg:
    """A leg from rest to rest that reaches `peak_m_s` in `reaching_s`."""

    course: Course
    peak_m_s: float
    reaching_s: float
    seconds: float

    @classmethod
    def of(cls, length_m: float, course: Course) -> _Leg:
        peak = course.speed_m_s
        if peak * course.reaching(peak) > length_m:
            low, high = 0.0, peak
            for _ in range(50):
                peak = (low + high) / 2.0
                low, high = (low, peak) if peak * course.reaching(peak) > length_m else (peak, high)
        reaching_s = course.reaching(peak)
        cruise_m = max(length_m - peak * reaching_s, 0.0)
        cruise_s = cruise_m / peak if cruise_m else 0.0
        return cls(
            course=course, peak_m_s=peak, reaching_s=reaching_s,
            seconds=2.0 * reaching_s + cruise_s,
        )  # fmt: skip

    def speeding_up(self, after_s: Floats) -> tuple[Floats, Floats, Floats]:
        """Return way, speed and acceleration after a time up to `reaching_s`."""
        peak, whole_s = self.peak_m_s, self.reaching_s
        # A jerk of one sign for `jerk_s`, a steady acceleration, the jerk of the other sign.
        jerk_s = whole_s / 2.0
        if self.course.jerk_m_s3 is None:
            jerk_s = 1e-6 * whole_s
        elif peak >= self.course.acceleration_m_s2**2 / self.course.jerk_m_s3:
            jerk_s = (whole_s - peak / self.course.acceleration_m_s2) / 2.0 + JERK_COMES_S / 2.0
            jerk_s = min(jerk_s, whole_s / 2.0)
        steady = peak / (whole_s - jerk_s)
        jerk = steady / jerk_s
        first = np.minimum(after_s, jerk_s)
        middle = np.clip(after_s - jerk_s, 0.0, whole_s - 2.0 * jerk_s)
        last = np.clip(after_s - (whole_s - jerk_s), 0.0, jerk_s)
        speed_1 = jerk * first**2 / 2.0
        speed_2 = speed_1 + steady * middle
        way = jerk * first**3 / 6.0 + speed_1 * middle + steady * middle**2 / 2.0
        way = way + speed_2 * last + steady * last**2 / 2.0 - jerk * last**3 / 6.0
        speed = speed_2 + steady * last - jerk * last**2 / 2.0
        return way, speed, jerk * (first - last)


def _overlap_s(one: _Leg, other: _Leg, bend: float) -> float:
    """Return how long before the end of a leg ArduCopter begins the next one."""
    most_s = min(one.reaching_s, other.reaching_s, other.seconds / 2.0)
    overlap_s = most_s * np.arange(1, OVERLAP_STEPS + 1) / OVERLAP_STEPS
    way_1, speed_1, gain_1 = one.speeding_up(overlap_s / 2.0)
    way_2, speed_2, gain_2 = other.speeding_up(overlap_s / 2.0)
    cosine = math.cos(bend)
    radius = _sum(way_1, way_2, -cosine)
    speed = _sum(speed_1, speed_2, cosine)
    gain = _sum(gain_1, gain_2, -cosine)
    acceleration = one.course.acceleration_m_s2
    allowed = radius < RADIUS_M
    allowed &= speed <= min(one.course.speed_m_s, other.course.speed_m_s) + 1e-6
    allowed &= gain < CORNER_ACCELERATIONS * acceleration
    return float(overlap_s[allowed].max(initial=0.0))


def _sum(one: Floats, other: Floats, cosine: float) -> Floats:
    """Return the length of the sum of two vectors with this cosine between them."""
    square = one**2 + other**2 + 2.0 * one * other * cosine
    length: Floats = np.sqrt(np.maximum(square, 0.0))
    return length


def _slowed_s(
    lengths_m: Sequence[float], bends_deg: Sequence[float], courses: Sequence[Course]
) -> list[float]:
    """Return the times of parts whose corners are flown at the speed that PX4 allows them."""
    corners = [0.0]
    for (one, other), bend_deg in zip(pairwise(courses), bends_deg, strict=True):
        slowest = min(one.speed_m_s, other.speed_m_s)
        half = math.radians(max(180.0 - abs(bend_deg), 0.0)) / 2.0
        turning = slowest
        if bend_deg:
            turning = math.sqrt(one.acceleration_m_s2 * PX4_RADIUS_M * math.tan(half))
        corners.append(min(slowest, turning))
    corners.append(0.0)
    for number in range(len(courses) - 1, -1, -1):
        reached = _reached_m_s(courses[number], lengths_m[number], corners[number + 1])
        corners[number] = min(corners[number], reached)
    for number, course in enumerate(courses):
        reached = _reached_m_s(course, lengths_m[number], corners[number])
        corners[number + 1] = min(corners[number + 1], reached)
    return [
        _between_corners_s(length, course, *speeds)
        for length, course, speeds in zip(lengths_m, courses, pairwise(corners), strict=True)
    ]


def _change(course: Course, one_m_s: float, other_m_s: float) -> tuple[float, float]:
    """Return time and way of a change of speed."""
    taken_s = course.reaching(abs(other_m_s - one_m_s)) if one_m_s != other_m_s else 0.0
    return taken_s, taken_s * (one_m_s + other_m_s) / 2.0


def _reached_m_s(course: Course, length_m: float, from_m_s: float) -> float:
    """Return the highest speed that is reached on a length from another one."""
    low, high = from_m_s, max(course.speed_m_s, from_m_s)
    if _change(course, from_m_s, high)[1] <= length_m:
        return high
    for _ in range(40):
        middle = (low + high) / 2.0
        fits = _change(course, from_m_s, middle)[1] <= length_m
        low, high = (middle, high) if fits else (low, middle)
    return low


def _between_corners_s(length_m: float, course: Course, start_m_s: float, end_m_s: float) -> float:
    """Return the time of a part that begins and ends at speeds."""
    low, high = max(start_m_s, end_m_s), max(course.speed_m_s, start_m_s, end_m_s)
    for _ in range(40):
        peak = (low + high) / 2.0 if low < high else high
        up_s, up_m = _change(course, start_m_s, peak)
        down_s, down_m = _change(course, peak, end_m_s)
        if up_m + down_m > length_m:
            high = peak
        elif low < high and high - peak > 1e-9:
            low = peak
        else:
            break
    cruise_m = max(length_m - up_m - down_m, 0.0)
    return up_s + down_s + (cruise_m / peak if cruise_m else 0.0)
