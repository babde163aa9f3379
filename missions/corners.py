"""How autopilots fly the corners of a way, each by its own rule, and what its parts take so.

ArduCopter plans each leg from rest to rest, its jerk limited, and begins the next leg before the
last one has ended: as soon as both together stay within the waypoint's radius, the speed and the
corner's acceleration (AC_WPNav and SCurve of ArduPilot 4.1 and later). PX4 brakes to a speed that
the corner's angle allows within its radius, and from which it could stop at the end of the next leg
(PositionSmoothing and TrajectoryConstraints).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from missions.strips import Floats

Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]
CornerRule = Literal["stop", "ardupilot", "px4"]

# ArduPilot's WPNAV_RADIUS, and WPNAV_ACCEL_C at 0: twice the acceleration of the legs.
RADIUS_M, CORNER_ACCELERATIONS = 2.0, 2.0
# ATC_INPUT_TC, the time in which the jerk comes and goes: it lengthens speeding up by twice that.
JERK_COMES_S = 0.15
# What a corner takes beyond that: the target waits for a vehicle that lags behind it. Measured
# beside ArduCopter 4.7 at 3 to 8 m/s: 0 to 0.25 s, the most in narrow U turns.
LAGS_S, LAGGING_DEG = 0.15, 60.0
# PX4's NAV_ACC_RAD of a copter, MPC_XY_TRAJ_P, and from which bend on it holds its speed back.
PX4_RADIUS_M, PX4_CORNER_SHARE, PX4_TURNS_DEG, PX4_TURNING_S = 2.0, 0.5, 15.0, 0.3
# Its velocity controller learns the drag of the air along each new course by its integral alone
# (MPC_XY_VEL_I_ACC 0.4, MPC_XY_VEL_P_ACC 1.8), in seconds; meanwhile the aircraft flies slower, and
# its target waits. Timed beside PX4 1.16: what a turn of 90 degrees costs at last, how much is not
# yet felt, what is left after the braking.
PX4_DRAG_S, PX4_LEARNS_S, PX4_UNFELT_S, PX4_KEPT = 2.4, 7.0, 1.0, 0.85
LEAST_M_S = 1e-3
# The overlap of two legs is tried in so many steps: to 0.02 s.
OVERLAP_STEPS = 240
# A plan is timed more than once, most of its corners as they were.
CORNERS_KNOWN = 1 << 15
# So many are looked at together: the tables on the way stay small.
CORNERS_TOGETHER = 64


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

    @property
    def reaching_m(self) -> float:
        """Return how much way reaching the leg's speed takes; v^2 / 2a without a jerk.

        >>> round(Course(speed_m_s=6.0, acceleration_m_s2=2.5, jerk_m_s3=None).reaching_m, 1)
        7.2
        >>> round(Course(speed_m_s=6.0, acceleration_m_s2=2.5, jerk_m_s3=1.0).reaching_m, 1)
        15.6
        """
        return self.speed_m_s * self.reaching_s / 2.0

    def reached_m_s(self, way_m: float) -> float:
        """Return the speed that is reached from rest on a way, the leg's at most."""
        if way_m >= self.reaching_m:
            return self.speed_m_s
        low, high = 0.0, self.speed_m_s
        for _ in range(50):
            middle = (low + high) / 2.0
            fits = middle * self.reaching(middle) / 2.0 <= way_m
            low, high = (middle, high) if fits else (low, middle)
        return low


def parts_s(
    lengths_m: Sequence[float],
    bends_deg: Sequence[float],
    courses: Sequence[Course],
    rule: CornerRule,
) -> list[float]:
    """Return the time of each straight part of a way from rest to rest; a bend between each two.

    Bends to the left are below zero. What a corner spares is taken from the part after it.
    """
    if rule == "px4":
        return _slowed_s(lengths_m, bends_deg, courses)
    legs, overlaps_s = overlapping(lengths_m, bends_deg, courses)
    seconds = [leg.seconds for leg in legs]
    if rule == "ardupilot":
        for number, (overlap_s, bend_deg) in enumerate(
            zip(overlaps_s, bends_deg, strict=True), start=1
        ):
            seconds[number] -= overlap_s
            seconds[number] += LAGS_S if abs(bend_deg) > LAGGING_DEG else 0.0
    return seconds


def overlapping(
    lengths_m: Sequence[float], bends_deg: Sequence[float], courses: Sequence[Course]
) -> tuple[list[_Leg], list[float]]:
    """Return the parts from rest to rest, and how long before its end each lets the next begin."""
    legs = [_Leg.of(length, course) for length, course in zip(lengths_m, courses, strict=True)]
    bends = [math.radians(bend_deg) for bend_deg in bends_deg]
    return legs, _overlaps_s(list(zip(legs, legs[1:], bends, strict=False)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Leg:
    """A leg from rest to rest that reaches `peak_m_s` in `reaching_s`."""

    course: Course
    peak_m_s: float
    reaching_s: float
    seconds: float

    @classmethod
    @lru_cache(maxsize=CORNERS_KNOWN)
    def of(cls, length_m: float, course: Course) -> _Leg:
        peak = course.speed_m_s
        if peak * course.reaching(peak) > length_m:
            peak = course.reached_m_s(length_m / 2.0)
        reaching_s = course.reaching(peak)
        cruise_m = max(length_m - peak * reaching_s, 0.0)
        cruise_s = cruise_m / peak if cruise_m else 0.0
        return cls(
            course=course, peak_m_s=peak, reaching_s=reaching_s,
            seconds=2.0 * reaching_s + cruise_s,
        )  # fmt: skip

    def way_m(self, at_s: Floats) -> Floats:
        """Return how far along it is at some times; before it and after it, at its ends."""
        whole_m = self.peak_m_s * (self.seconds - self.reaching_s)
        cruise_s = np.clip(at_s - self.reaching_s, 0.0, self.seconds - 2.0 * self.reaching_s)
        first, last = (
            _speeding_up([self], np.clip(each, 0.0, self.reaching_s))[0][0]
            for each in (at_s, self.seconds - at_s)
        )
        found: Floats = (
            first + self.peak_m_s * cruise_s - last + self.peak_m_s * self.reaching_s / 2.0
        )
        return np.clip(found, 0.0, whole_m)

    @property
    def jerk_s(self) -> float:
        """Return how long the acceleration comes, and goes again, on the way to the peak."""
        jerk = self.course.jerk_m_s3
        if jerk is None:
            return 1e-6 * self.reaching_s
        if self.peak_m_s < self.course.acceleration_m_s2**2 / jerk:
            return self.reaching_s / 2.0
        steady_s = self.peak_m_s / self.course.acceleration_m_s2
        jerk_s = (self.reaching_s - steady_s) / 2.0 + JERK_COMES_S / 2.0
        return min(jerk_s, self.reaching_s / 2.0)


def _speeding_up(legs: Sequence[_Leg], after_s: Floats) -> tuple[Floats, Floats, Floats]:
    """Return way, speed and acceleration of legs after times up to `reaching_s`, a row for each."""
    known = np.array([(leg.peak_m_s, leg.reaching_s, leg.jerk_s) for leg in legs])
    # A jerk of one sign for `jerk_s`, a steady acceleration, the jerk of the other sign.
    peak, whole_s, jerk_s = known.T[..., None]
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


_Corner = tuple[_Leg, _Leg, float]


@lru_cache(maxsize=1)
def _known_overlaps_s() -> dict[_Corner, float]:
    """Return what `_overlaps_s` has found."""
    return {}


def _overlaps_s(corners: Sequence[_Corner]) -> list[float]:
    """Return how long before the end of a leg ArduCopter begins the next one, at each corner.

    A corner is two legs and the bend between them; those not known yet are looked at together.
    """
    known_s = _known_overlaps_s()
    new = [corner for corner in dict.fromkeys(corners) if corner not in known_s]
    if len(known_s) + len(new) > CORNERS_KNOWN:
        known_s.clear()
        new = list(dict.fromkeys(corners))
    for first in range(0, len(new), CORNERS_TOGETHER):
        some = new[first : first + CORNERS_TOGETHER]
        known_s.update(zip(some, _new_overlaps_s(some), strict=True))
    return [known_s[corner] for corner in corners]


def _new_overlaps_s(corners: Sequence[_Corner]) -> list[float]:
    ones, others = [one for one, _, _ in corners], [other for _, other, _ in corners]
    least = [
        (
            min(one.reaching_s, other.reaching_s, other.seconds / 2.0),
            math.cos(bend),
            min(one.course.speed_m_s, other.course.speed_m_s) + 1e-6,
            CORNER_ACCELERATIONS * one.course.acceleration_m_s2,
        )
        for one, other, bend in corners
    ]
    most_s, cosine, most_m_s, most_m_s2 = np.array(least).T[..., None]
    overlap_s = most_s * np.arange(1, OVERLAP_STEPS + 1) / OVERLAP_STEPS
    way_1, speed_1, gain_1 = _speeding_up(ones, overlap_s / 2.0)
    way_2, speed_2, gain_2 = _speeding_up(others, overlap_s / 2.0)
    allowed = _sum(way_1, way_2, -cosine) < RADIUS_M
    allowed &= _sum(speed_1, speed_2, cosine) <= most_m_s
    allowed &= _sum(gain_1, gain_2, -cosine) < most_m_s2
    found: list[float] = np.where(allowed, overlap_s, 0.0).max(axis=1).tolist()
    return found


def _sum(one: Floats, other: Floats, cosine: Floats) -> Floats:
    """Return the length of the sum of two vectors with this cosine between them."""
    square = one**2 + other**2 + 2.0 * one * other * cosine
    length: Floats = np.sqrt(np.maximum(square, 0.0))
    return length


@dataclass(frozen=True, slots=True, kw_only=True)
class _Slowed:
    """PX4's speed on a leg that ends in a corner: it brakes for the corner's speed by distance.

    The braking begins as if a change of acceleration from one end to the other came first, so that
    the corner's speed is there `held_m` before the waypoint.
    """

    course: Course
    corner_m_s: float

    @property
    def ramp_m_s(self) -> float:
        """Return what the change of acceleration adds to the speed's square, by the speed."""
        jerk = self.course.jerk_m_s3
        return 0.0 if jerk is None else 4.0 * self.course.acceleration_m_s2**2 / jerk

    @property
    def held_m(self) -> float:
        """Return how long before the waypoint the corner's speed is flown."""
        return self.ramp_m_s * self.corner_m_s / (2.0 * self.course.acceleration_m_s2)

    def before_m(self, speed_m_s: float) -> float:
        """Return how far before the waypoint a speed has to be given up."""
        if speed_m_s <= self.corner_m_s:
            return 0.0
        square = speed_m_s**2 + self.ramp_m_s * speed_m_s - self.corner_m_s**2
        return square / (2.0 * self.course.acceleration_m_s2)

    def at_m_s(self, distance_m: float) -> float:
        """Return the highest speed so far before the waypoint."""
        ramp = self.ramp_m_s
        square = 2.0 * self.course.acceleration_m_s2 * distance_m + self.corner_m_s**2
        return max((math.sqrt(ramp**2 + 4.0 * square) - ramp) / 2.0, self.corner_m_s)

    def braking_s(self, high_m_s: float, low_m_s: float) -> float:
        """Return the time between two speeds of the braking."""
        ramping = self.ramp_m_s / 2.0 * math.log(high_m_s / low_m_s)
        return (high_m_s - low_m_s + ramping) / self.course.acceleration_m_s2

    def peak_m_s(self, from_m_s: float, room_m: float) -> float:
        """Return the highest speed on a leg with so much room, begun at a speed."""

        def needed_m(peak: float) -> float:
            return _gaining(self.course, from_m_s, peak)[1] + max(self.before_m(peak), PX4_RADIUS_M)

        low, high = max(from_m_s, LEAST_M_S), self.course.speed_m_s
        if high <= low or needed_m(high) <= room_m:
            return max(low, high)
        for _ in range(40):
            middle = (low + high) / 2.0
            low, high = (low, middle) if needed_m(middle) > room_m else (middle, high)
        return low

    def flown(self, from_m_s: float, room_m: float) -> tuple[float, float]:
        """Return time and last speed of a leg, up to the waypoint's radius."""
        peak = self.peak_m_s(from_m_s, room_m)
        taken_s, gained_m = _gaining(self.course, from_m_s, peak)
        end_m_s = min(self.at_m_s(PX4_RADIUS_M), peak)
        brakes = peak > self.corner_m_s and max(self.before_m(peak), self.held_m) > PX4_RADIUS_M
        if not brakes:
            return taken_s + max(room_m - PX4_RADIUS_M - gained_m, 0.0) / peak, peak
        taken_s += max(room_m - gained_m - self.before_m(peak), 0.0) / peak
        taken_s += self.braking_s(peak, end_m_s) if peak > end_m_s else 0.0
        if self.held_m > PX4_RADIUS_M:
            taken_s += (self.held_m - PX4_RADIUS_M) / self.corner_m_s
        return taken_s, end_m_s


def _slowed_s(
    lengths_m: Sequence[float], bends_deg: Sequence[float], courses: Sequence[Course]
) -> list[float]:
    """Return the times of parts whose corners are flown at the speed that PX4 allows them.

    A leg counts as ended within the radius of its waypoint; the velocity so far is then turned, and
    what of it is along the next leg is kept. What the integral of the velocity's controller holds
    against the drag is along the last leg too, and is learnt anew.
    """
    found = []
    start_m_s, room_m = 0.0, lengths_m[0]
    held_along = held_aside = 0.0
    for number, course in enumerate(courses):
        bend = 0.0
        corner_m_s = 0.0
        if number + 1 < len(courses):
            bend = math.radians(bends_deg[number])
            corner_m_s = _corner_m_s(lengths_m[number + 1], bend, course)
        leg = _Slowed(course=course, corner_m_s=corner_m_s)
        taken_s, end_m_s = leg.flown(start_m_s, room_m)
        if number and abs(bends_deg[number - 1]) > PX4_TURNS_DEG:
            taken_s += PX4_TURNING_S * abs(math.sin(math.radians(bends_deg[number - 1])))
        learning_s = max(taken_s - PX4_UNFELT_S, 0.0)
        lost_s = PX4_DRAG_S * (1.0 - held_along) * -math.expm1(-learning_s / PX4_LEARNS_S)
        # Within the radius a corner is cut; no metre counts as flown faster for that.
        found.append(max(taken_s + lost_s, lengths_m[number] / course.speed_m_s))
        left = math.exp(-found[-1] / PX4_LEARNS_S)
        held_along, held_aside = 1.0 - (1.0 - held_along) * left, held_aside * left
        if abs(math.degrees(bend)) > PX4_TURNS_DEG:
            held_along *= PX4_KEPT
        cosine, sine = math.cos(bend), math.sin(bend)
        held_along, held_aside = (
            held_along * cosine + held_aside * sine,
            held_aside * cosine - held_along * sine,
        )
        if number + 1 < len(courses):
            start_m_s, room_m = end_m_s * cosine, lengths_m[number + 1] + PX4_RADIUS_M * cosine
    return found


def _corner_m_s(next_m: float, bend: float, course: Course) -> float:
    """Return PX4's speed at a waypoint: it sees one leg more, and must be able to stop at its end.

    A circle within the radius, at half of the acceleration (MPC_XY_TRAJ_P), joins both legs.
    """
    if next_m < PX4_RADIUS_M:
        return 0.0
    stopping = _Slowed(course=course, corner_m_s=0.0)
    half = max(math.pi - abs(bend), 0.0) / 2.0
    square = PX4_CORNER_SHARE * course.acceleration_m_s2 * PX4_RADIUS_M * math.tan(half)
    return min(math.sqrt(max(square, 0.0)), stopping.at_m_s(next_m), course.speed_m_s)


def _gaining(course: Course, from_m_s: float, to_m_s: float) -> tuple[float, float]:
    """Return time and way of a gain of speed; what ends it is part of the braking."""
    gain_m_s = max(to_m_s - from_m_s, 0.0)
    most, jerk = course.acceleration_m_s2, course.jerk_m_s3
    rising_s = 0.0 if jerk is None else min(math.sqrt(2.0 * gain_m_s / jerk), most / jerk)
    risen_m_s = 0.0 if jerk is None else jerk * rising_s**2 / 2.0
    risen_m = from_m_s * rising_s + risen_m_s * rising_s / 3.0
    steady_s = (gain_m_s - risen_m_s) / most
    mean_m_s = (from_m_s + risen_m_s + to_m_s) / 2.0
    return rising_s + steady_s, risen_m + steady_s * mean_m_s


# How long ways take: laws of a multirotor that speeds up and brakes within its jerk.

Turn = Literal["stop", "strafe", "rounded"]

# Passes so long, in accelerations, reach their speed; ways aside between them are tabled so far.
LONG, ASIDE_KNOTS_M = 10.0, np.geomspace(0.05, 20_000.0, 160)
SQUARE_DEG = 90.0
# From one pass to the next, and from a ferry into a pass, the nose turns by this much or less; and
# how fast it looks along the way again: ATC_SLEW_YAW of ArduCopter, MPC_YAWRAUTO_MAX of PX4.
NOSE_DEG, NOSE_DEG_S = 180.0, 60.0
# Shorter passes are left before the corner before them is done; ways aside as short as passes are.
SHORT_KNOTS_M = np.array([0.5, 1.5, 3.0, 5.0, 8.0, 12.0, 18.0, 28.0, 45.0])
BESIDE_KNOTS_M = np.array([0.5, 2.0, 4.0, 6.0, 9.0, 13.0, 20.0, 35.0, 60.0])
LONG_PASS_M = 300.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """How the aircraft flies: `turn` is what its nose does between passes, `corners` whose rule.

    Without a jerk the acceleration changes at once.
    """

    speed_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float | None = None
    turn: Turn = "stop"
    corners: CornerRule = "stop"

    def legs_s(self, length_m: Floats) -> Floats:
        """Return the time of straight legs that begin and end at rest.

        Without a jerk t = 2 sqrt(d / a) below v^2 / a, else d / v + v / a.

        >>> motion = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)
        >>> motion.legs_s(np.array([7.0, 60.0])).round(2).tolist()
        [3.35, 12.4]
        """
        speed, short = self.speed_m_s, _short_legs(self)
        taken: Floats = length_m / speed + short.reaching_s
        is_short = length_m < speed * short.reaching_s
        root_m = np.sqrt(np.maximum(length_m[is_short], 0.0))
        taken[is_short] = np.interp(root_m, short.root_m, short.seconds)
        return taken

    def leg_s(self, length_m: float) -> float:
        """Return the time of one leg, from rest to rest."""
        return float(self.legs_s(np.array([length_m]))[0])

    def between_passes_s(self, aside_m: float) -> float:
        """Return what the way from the end of one pass to the start of the next beside it adds.

        The passes themselves count from rest to rest. Below zero, where the corners are flown
        faster than that spares.

        >>> Motion(speed_m_s=6.0, acceleration_m_s2=2.5).between_passes_s(7.0) > 3.3
        True
        """
        return float(self.ways_s(np.array([aside_m]))[0])

    def ways_s(self, length_m: Floats) -> Floats:
        """Return what ways between two long passes add, with a square corner at both ends."""
        if self.corners == "stop":
            return self.legs_s(length_m)
        spared_s = _spared_at_corners_s(self)
        added: Floats = length_m / self.speed_m_s
        added += _short_legs(self).reaching_s - spared_s[-1]
        # Long ways, most of a table's, all spare the same.
        is_short = length_m < LONG * self.speed_m_s * _short_legs(self).reaching_s
        short_m = length_m[is_short]
        added[is_short] = self.legs_s(short_m) - np.interp(short_m, ASIDE_KNOTS_M, spared_s)
        return added

    def short_s(self, pass_m: Floats, aside_m: Floats) -> Floats:
        """Return what a way aside takes more for each short pass at its ends, shape of both.

        >>> motion = Motion(
        ...     speed_m_s=6.0, acceleration_m_s2=2.5, jerk_m_s3=1.0, corners="ardupilot"
        ... )
        >>> motion.short_s(np.array([[4.0], [200.0]]), np.array([6.0])).round(1).tolist()
        [[0.4], [0.0]]
        """
        table_s = _short_passes_s(self)
        low, share = _between_knots(pass_m, SHORT_KNOTS_M)
        left, part = _between_knots(aside_m, BESIDE_KNOTS_M)
        one: Floats = table_s[low, left] * (1.0 - part) + table_s[low, left + 1] * part
        other: Floats = table_s[low + 1, left] * (1.0 - part) + table_s[low + 1, left + 1] * part
        return one * (1.0 - share) + other * share

    def spared_straight_s(self, one_m: Floats, other_m: Floats) -> Floats:
        """Return what two legs take less than from rest to rest, where one goes on in the other.

        Legs of a row never spare more than they take.
        """
        one_s, other_s = self.legs_s(one_m), self.legs_s(other_m)
        if self.corners == "ardupilot":
            halves_s = np.minimum(one_s, other_s) / 2.0
            spared: Floats = np.minimum(halves_s, _short_legs(self).reaching_s)
            return spared
        stopping_s = one_s - one_m / self.speed_m_s + other_s - other_m / self.speed_m_s
        halved: Floats = stopping_s / 2.0
        return halved

    def at(self, speed_m_s: float) -> Course:
        """Return the course rules of a way at another speed."""
        return Course(
            speed_m_s=speed_m_s,
            acceleration_m_s2=self.acceleration_m_s2,
            jerk_m_s3=self.jerk_m_s3,
        )


def _between_knots(values: Floats, knots: Floats) -> tuple[Ints, Floats]:
    """Return the knot below each value, the last but one at most, and how far on to the next."""
    low = np.clip(np.searchsorted(knots, values, side="right") - 1, 0, len(knots) - 2)
    share: Floats = np.clip((values - knots[low]) / (knots[low + 1] - knots[low]), 0.0, 1.0)
    return low, share


@lru_cache(maxsize=64)
def _short_passes_s(motion: Motion) -> Floats:
    """Return what a corner beside a short pass spares less, by its length and the way aside."""
    if motion.corners == "stop":
        return np.zeros((len(SHORT_KNOTS_M), len(BESIDE_KNOTS_M)))
    course = motion.at(motion.speed_m_s)
    bends_deg = (SQUARE_DEG, SQUARE_DEG, -SQUARE_DEG, -SQUARE_DEG)
    found = np.zeros((len(SHORT_KNOTS_M), len(BESIDE_KNOTS_M)))
    for at, aside_m in enumerate(BESIDE_KNOTS_M.tolist()):
        taken = []
        for pass_m in (*SHORT_KNOTS_M.tolist(), 2.0 * LONG_PASS_M):
            parts_m = (LONG_PASS_M, aside_m, pass_m, aside_m, LONG_PASS_M)
            flown_s = sum(parts_s(parts_m, bends_deg, (course,) * 5, motion.corners))
            taken.append(flown_s - motion.leg_s(pass_m))
        found[:, at] = (np.array(taken[:-1]) - taken[-1]) / 2.0
    return np.maximum(found, 0.0)


@dataclass(frozen=True, slots=True)
class _ShortLegs:
    """Times of legs too short for the speed, by the root of their length."""

    reaching_s: float
    root_m: Floats
    seconds: Floats


@lru_cache(maxsize=64)
def _short_legs(motion: Motion) -> _ShortLegs:
    speeds = motion.speed_m_s * np.linspace(0.0, 1.0, 400) ** 2
    reaching_s = np.array([motion.at(max(v, 1e-9)).reaching_s for v in speeds.tolist()])
    return _ShortLegs(
        reaching_s=float(reaching_s[-1]),
        root_m=np.sqrt(speeds * reaching_s),
        seconds=np.concatenate([[0.0], 2.0 * reaching_s[1:]]),
    )


@lru_cache(maxsize=64)
def _spared_at_corners_s(motion: Motion) -> Floats:
    """Return what the two corners of ways aside spare, at the knots."""
    long_m = LONG * motion.speed_m_s * _short_legs(motion).reaching_s
    course = motion.at(motion.speed_m_s)
    spared = []
    for aside_m in ASIDE_KNOTS_M.tolist():
        # The third pass and the way to it: what the first takes more, from rest, counts once.
        parts_m = (long_m, aside_m, long_m, aside_m, long_m)
        bends_deg = (SQUARE_DEG, SQUARE_DEG, -SQUARE_DEG, -SQUARE_DEG)
        found_s = parts_s(parts_m, bends_deg, (course,) * 5, motion.corners)
        spared.append(float(motion.legs_s(np.array(parts_m[3:])).sum()) - sum(found_s[3:]))
    return np.array(spared)
