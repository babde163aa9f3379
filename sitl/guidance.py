"""How ArduCopter and PX4 lead a copter along its legs: a point goes ahead, the aircraft follows it.

Written from what both firmwares publish of it (AC_WPNav, SCurve and AC_PosControl of ArduPilot 4.1
and later; PositionSmoothing, TrajectoryConstraints and the multicopter's position controller of
PX4), in small steps of time. Times of a plan have no part in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sitl.trajectory import Route, lines_of

Floats = NDArray[np.float64]
Line = tuple[float, float, float, float, float]

STEP_S = 0.010
# Below this the aircraft stands, at the end of its way.
STANDS_M_S = 0.1


class Guidance(Protocol):
    """Where the aircraft is led, and where it is without gusts."""

    leg: int
    finished: bool
    # The velocity that it is led with, which the nose follows, and how fast the nose does.
    lead_east_m_s: float
    lead_north_m_s: float
    nose_deg_s: float
    copter: Follower

    def step(self) -> None:
        """Fly on for STEP_S."""


class Follower:
    """A copter that follows a point: place, then velocity, then a lean that takes its time.

    `integral_1_s2` learns what `drag_1_s` takes; both are 0 where the air hardly brakes.
    """

    def __init__(
        self, east_m: float, north_m: float, *, place_1_s: float, velocity_1_s: float,
        lean_s: float, integral_1_s2: float = 0.0, drag_1_s: float = 0.0,
    ) -> None:  # fmt: skip
        self.east_m, self.north_m = east_m, north_m
        self.velocity_east_m_s = self.velocity_north_m_s = 0.0
        self._gained = [0.0, 0.0]
        self._learnt = [0.0, 0.0]
        self._gains = (place_1_s, velocity_1_s, STEP_S / lean_s, integral_1_s2 * STEP_S, drag_1_s)

    def follow(
        self, place: tuple[float, float], velocity: tuple[float, float], gain: tuple[float, float]
    ) -> None:
        """Take one step towards a point that moves."""
        to_place, to_velocity, leans, learns, drag = self._gains
        here = (self.east_m, self.north_m)
        moves = (self.velocity_east_m_s, self.velocity_north_m_s)
        found = []
        for axis in (0, 1):
            missing = velocity[axis] + to_place * (place[axis] - here[axis]) - moves[axis]
            self._learnt[axis] += learns * missing
            wanted = gain[axis] + to_velocity * missing + self._learnt[axis]
            self._gained[axis] += (wanted - self._gained[axis]) * leans
            found.append(moves[axis] + (self._gained[axis] - drag * moves[axis]) * STEP_S)
        self.velocity_east_m_s, self.velocity_north_m_s = found
        self.east_m += found[0] * STEP_S
        self.north_m += found[1] * STEP_S


# --- ArduCopter ---------------------------------------------------------------------------------

# WPNAV_JERK; the time in which the jerk itself comes and goes, twice ATC_INPUT_TC; WPNAV_RADIUS;
# WPNAV_ACCEL_C, at 0 twice the acceleration of the legs; PSC_POSXY_P, PSC_VELXY_P.
JERK_M_S3, JERK_COMES_S, RADIUS_M, CORNER_ACCELERATIONS = 1.0, 0.3, 2.0, 2.0
PLACE_1_S, VELOCITY_1_S, LEAN_S = 1.0, 2.0, 0.25
NOSE_DEG_S = 60.0  # ATC_SLEW_YAW
# The target's clock slows down for an aircraft that lags behind it, with this lead and this delay
# (the acceleration by the jerk).
AHEAD, WAITS_S = 0.05, 2.5
SHORT_M = 1e-3


class _Profile:
    """Place, speed and acceleration on a leg that begins and ends at rest, by steps of time.

    A steady speed for as long as the leg needs it, seen through three moving means: over the time
    of the acceleration, of its rise, and of the jerk's.
    """

    def __init__(self, length_m: float, speed_m_s: float, acceleration_m_s2: float) -> None:
        peak = speed_m_s
        if length_m < peak * sum(_widths_s(peak, acceleration_m_s2)):
            low, high = 0.0, peak
            for _ in range(50):
                peak = (low + high) / 2.0
                fits = peak * sum(_widths_s(peak, acceleration_m_s2)) <= length_m
                low, high = (peak, high) if fits else (low, peak)
            peak = max(low, 1e-3)
        speeds: Floats = np.full(max(round(length_m / peak / STEP_S), 1), peak)
        self.changes = 0
        for width_s in _widths_s(peak, acceleration_m_s2):
            count = max(round(width_s / STEP_S), 1)
            speeds = np.convolve(speeds, np.full(count, 1.0 / count))
            self.changes += count
        speeds *= length_m / max(float(speeds.sum()) * STEP_S, 1e-12)
        self.speeds = [0.0, *speeds.tolist(), 0.0]
        self.places = np.concatenate([[0.0], np.cumsum(speeds) * STEP_S, [length_m]]).tolist()
        self.gains = np.gradient(np.array(self.speeds), STEP_S).tolist()
        self.last = len(self.speeds) - 1

    def at(self, step: float) -> tuple[float, float, float]:
        """Return place, speed and acceleration; before the start and after the end it stands."""
        if step >= self.last:
            return self.places[-1], 0.0, 0.0
        number = int(step)
        share = step - number
        places, speeds, gains = self.places, self.speeds, self.gains
        return (
            places[number] + share * (places[number + 1] - places[number]),
            speeds[number] + share * (speeds[number + 1] - speeds[number]),
            gains[number] + share * (gains[number + 1] - gains[number]),
        )


def _widths_s(speed_m_s: float, acceleration_m_s2: float) -> tuple[float, float, float]:
    rise_s = acceleration_m_s2 / JERK_M_S3
    if speed_m_s < acceleration_m_s2 * rise_s:
        root_s = math.sqrt(speed_m_s / JERK_M_S3)
        return root_s, root_s, JERK_COMES_S
    return speed_m_s / acceleration_m_s2, rise_s, JERK_COMES_S


class ArduCopter:
    """Each leg from rest to rest; the next begins as soon as both fit into the corner together."""

    nose_deg_s = NOSE_DEG_S

    def __init__(self, route: Route, acceleration_m_s2: float) -> None:
        self._lines: Sequence[Line] = lines_of(route)
        self._speeds = [leg.speed_m_s for leg in route.legs]
        self._acceleration = acceleration_m_s2
        self._profiles = [
            _Profile(line[4], speed, acceleration_m_s2) if line[4] > SHORT_M else None
            for line, speed in zip(self._lines, self._speeds, strict=True)
        ]
        self.copter = Follower(
            route.start_east_m, route.start_north_m, place_1_s=PLACE_1_S,
            velocity_1_s=VELOCITY_1_S, lean_s=LEAN_S,
        )  # fmt: skip
        self._before, self._now, self._next = 0.0, 0.0, 0.0  # steps of three legs
        self._pace = 1.0
        self.leg = 0
        self.finished = False
        self.lead_east_m_s = self.lead_north_m_s = 0.0

    def step(self) -> None:
        """Move the target on by its clock, and the aircraft after it."""
        last = self.leg + 1 >= len(self._lines)
        profile = self._profiles[self.leg]
        self._before += self._pace
        self._now += self._pace
        is_over = profile is None or self._now >= profile.last
        if self._next > 0.0:
            self._next += self._pace
            is_over |= profile is not None and self._next >= profile.last - self._now
        elif not last and profile is not None and self._may_begin(profile):
            self._next = self._pace
        place, velocity, gain = self._target()
        self.lead_east_m_s, self.lead_north_m_s = velocity
        self.copter.follow(place, velocity, gain)
        self._wait(place, velocity)
        if is_over and not last:
            self.leg += 1
            self._before, self._now, self._next = self._now, self._next, 0.0
        elif is_over:
            speed = math.hypot(self.copter.velocity_east_m_s, self.copter.velocity_north_m_s)
            self.finished = speed < STANDS_M_S

    def _may_begin(self, profile: _Profile) -> bool:
        """Whether the rest of this leg and as much of the next stay within the corner's limits."""
        after = self._profiles[self.leg + 1]
        left = profile.last - self._now
        if after is None or left > profile.changes or left >= after.last / 2.0:
            return False
        (_, _, sin, cos, length_m), (_, _, next_sin, next_cos, _) = (
            self._lines[self.leg], self._lines[self.leg + 1],
        )  # fmt: skip
        ending, beginning = profile.at(profile.last - left / 2.0), after.at(left / 2.0)
        way, speed, gain = (
            math.hypot(a * sin + b * next_sin, a * cos + b * next_cos)
            for a, b in zip((ending[0] - length_m, *ending[1:]), beginning, strict=True)
        )
        return (
            way < RADIUS_M
            and speed < min(self._speeds[self.leg : self.leg + 2]) + 1e-9
            and gain < CORNER_ACCELERATIONS * self._acceleration
        )

    def _target(self) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
        """Return place, velocity and acceleration: what three legs add up to."""
        sums = [0.0] * 6
        sums[0], sums[1] = self._lines[self.leg][:2]
        for leg, step, ends in (
            (self.leg - 1, self._before, True), (self.leg, self._now, False),
            (self.leg + 1, self._next, False),
        ):  # fmt: skip
            profile = self._profiles[leg] if 0 <= leg < len(self._profiles) else None
            if profile is None or (leg > self.leg and step <= 0.0):
                continue
            _, _, sin, cos, length_m = self._lines[leg]
            place_m, *rest = profile.at(step)
            for number, value in enumerate((place_m - length_m * ends, *rest)):
                sums[2 * number] += value * sin
                sums[2 * number + 1] += value * cos
        pace = self._pace
        return (
            (sums[0], sums[1]), (sums[2] * pace, sums[3] * pace), (sums[4] * pace, sums[5] * pace)
        )  # fmt: skip

    def _wait(self, place: tuple[float, float], velocity: tuple[float, float]) -> None:
        """Slow the target's clock down for an aircraft that lags behind."""
        wanted, speed = 1.0, math.hypot(*velocity)
        if speed > 1e-6:
            along = (velocity[0] / speed, velocity[1] / speed)
            behind_m = (place[0] - self.copter.east_m) * along[0] + (
                place[1] - self.copter.north_m
            ) * along[1]
            made = (
                self.copter.velocity_east_m_s * along[0] + self.copter.velocity_north_m_s * along[1]
            )
            wanted = min(max(AHEAD + (made - PLACE_1_S * behind_m) / speed, 0.0), 1.0)
        self._pace += (wanted - self._pace) * STEP_S / WAITS_S


# --- PX4 ----------------------------------------------------------------------------------------

# MPC_JERK_AUTO, NAV_ACC_RAD, MPC_XY_TRAJ_P, MPC_XY_ERR_MAX, the least L1 distance, MPC_XY_P,
# MPC_XY_VEL_P_ACC, MPC_XY_VEL_I_ACC, MPC_YAWRAUTO_MAX; the drag is that of its simulation, SIH_KDV
# by SIH_MASS.
PX4_JERK_M_S3, PX4_RADIUS_M, PX4_CORNER_SHARE, PX4_BEHIND_MAX_M, PX4_L1_M = 4.0, 2.0, 0.5, 2.0, 5.0
PX4_PLACE_1_S, PX4_VELOCITY_1_S, PX4_INTEGRAL_1_S2, PX4_NOSE_DEG_S = 0.95, 1.8, 0.4, 45.0
PX4_DRAG_1_S, PX4_LEAN_S = 1.0, 0.15
# It turns above this speed, where its course is farther off its target than this cosine.
PX4_TURNS_M_S, PX4_ALIGNED = 0.2, 0.98


class Px4:
    """A velocity towards the next waypoint, as fast as braking allows, smoothed by its jerk."""

    nose_deg_s = PX4_NOSE_DEG_S

    def __init__(self, route: Route, acceleration_m_s2: float) -> None:
        self._ends = [(route.start_east_m, route.start_north_m)]
        self._ends += [(leg.east_m, leg.north_m) for leg in route.legs]
        self._speeds = [leg.speed_m_s for leg in route.legs]
        self._most = acceleration_m_s2
        self._east_m, self._north_m = self._ends[0]
        self._gain = (0.0, 0.0)
        self._allowed = 0.0
        self.copter = Follower(
            self._east_m, self._north_m, place_1_s=PX4_PLACE_1_S, velocity_1_s=PX4_VELOCITY_1_S,
            lean_s=PX4_LEAN_S, integral_1_s2=PX4_INTEGRAL_1_S2, drag_1_s=PX4_DRAG_1_S,
        )  # fmt: skip
        self.leg = 0
        self.finished = False
        self.lead_east_m_s = self.lead_north_m_s = 0.0

    def step(self) -> None:
        """Move the target on, and the aircraft after it; go over to the next waypoint near one."""
        self._smooth(self._wanted(), self._stretched_s())
        velocity = (self.lead_east_m_s, self.lead_north_m_s)
        self.copter.follow((self._east_m, self._north_m), velocity, self._gain)
        away_m = math.dist(self._ends[self.leg + 1], (self.copter.east_m, self.copter.north_m))
        if self.leg + 1 < len(self._speeds):
            self.leg += away_m < PX4_RADIUS_M
        elif away_m < PX4_RADIUS_M:
            speed = math.hypot(self.copter.velocity_east_m_s, self.copter.velocity_north_m_s)
            self.finished = speed < STANDS_M_S

    def _wanted(self) -> tuple[float, float]:
        """Return the velocity that is smoothed then."""
        here, end = (self._east_m, self._north_m), self._ends[self.leg + 1]
        allowed = self._allowed_m_s(here, end)
        to_end, away_m = _unit(here, end)
        speed = math.hypot(self.lead_east_m_s, self.lead_north_m_s)
        along = self.lead_east_m_s * to_end[0] + self.lead_north_m_s * to_end[1]
        turns = speed > PX4_TURNS_M_S and along < PX4_ALIGNED * speed and away_m > PX4_RADIUS_M
        if not turns:
            self._allowed = allowed
            return to_end[0] * allowed, to_end[1] * allowed
        # While it turns, its speed is held, and it heads for a point of the leg some way ahead.
        allowed = min(self._allowed, allowed)
        start = self._ends[self.leg]
        course, _ = _unit(start, end)
        along_m = (here[0] - start[0]) * course[0] + (here[1] - start[1]) * course[1]
        nearest = (start[0] + along_m * course[0], start[1] + along_m * course[1])
        ahead_m = math.sqrt(max(PX4_L1_M**2 - math.dist(here, nearest) ** 2, 0.0))
        point = (nearest[0] + ahead_m * course[0], nearest[1] + ahead_m * course[1])
        towards, _ = _unit(here, point)
        return towards[0] * allowed, towards[1] * allowed

    def _allowed_m_s(self, here: tuple[float, float], end: tuple[float, float]) -> float:
        """Return the speed from which the corner's is reached in time, one leg ahead."""
        speed, corner = self._speeds[self.leg], 0.0
        after = self._ends[min(self.leg + 2, len(self._ends) - 1)]
        back, next_m = _unit(after, end)
        onward, away_m = _unit(here, end)
        if next_m >= PX4_RADIUS_M:
            cosine = min(max(onward[0] * back[0] + onward[1] * back[1], -1.0), 1.0)
            half = min(math.acos(cosine), math.pi - 1e-7) / 2.0
            square = PX4_CORNER_SHARE * self._most * PX4_RADIUS_M * math.tan(half)
            corner = min(math.sqrt(square), self._braked_m_s(next_m, 0.0), speed)
        return min(speed, self._braked_m_s(away_m, corner))

    def _braked_m_s(self, way_m: float, end_m_s: float) -> float:
        ramp = 4.0 * self._most**2 / PX4_JERK_M_S3
        square = 2.0 * self._most * way_m + end_m_s**2
        return max((math.sqrt(ramp**2 + 4.0 * square) - ramp) / 2.0, end_m_s)

    def _stretched_s(self) -> float:
        """Return the target's step of time: shorter for an aircraft that is behind."""
        behind = (self._east_m - self.copter.east_m, self._north_m - self.copter.north_m)
        if behind[0] * self.lead_east_m_s + behind[1] * self.lead_north_m_s < 0.0:
            return STEP_S
        return STEP_S * (1.0 - min(math.hypot(*behind) / PX4_BEHIND_MAX_M, 1.0))

    def _smooth(self, wanted: tuple[float, float], taken_s: float) -> None:
        """Change the target's velocity within acceleration and jerk."""
        missing = (wanted[0] - self.lead_east_m_s, wanted[1] - self.lead_north_m_s)
        size = math.hypot(*missing)
        gain = min(self._most, math.sqrt(2.0 * PX4_JERK_M_S3 * size)) / max(size, 1e-9)
        change = (missing[0] * gain - self._gain[0], missing[1] * gain - self._gain[1])
        share = min(PX4_JERK_M_S3 * taken_s / max(math.hypot(*change), 1e-9), 1.0)
        self._gain = (self._gain[0] + change[0] * share, self._gain[1] + change[1] * share)
        self.lead_east_m_s += self._gain[0] * taken_s
        self.lead_north_m_s += self._gain[1] * taken_s
        self._east_m += self.lead_east_m_s * taken_s
        self._north_m += self.lead_north_m_s * taken_s


def _unit(
    start: tuple[float, float], end: tuple[float, float]
) -> tuple[tuple[float, float], float]:
    """Return direction and distance; no direction where there is none."""
    away = (end[0] - start[0], end[1] - start[1])
    length_m = math.hypot(*away)
    if length_m < 1e-9:
        return (0.0, 0.0), length_m
    return (away[0] / length_m, away[1] / length_m), length_m
