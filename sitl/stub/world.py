"""Where the vehicle truly is: a chain of motions in the metres of one frame.

A motion is resting, climbing, braking or flying a route; each begins at the pose where the last
one was left. Nothing in here knows MAVLink.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from sitl.airframes import Airframe, EstimatorNoise
from sitl.vehicle import Corners, Leg, Route, Truth, Vehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """The true position, velocity and heading at one time."""

    time_s: float
    east_m: float
    north_m: float
    height_m: float = 0.0
    velocity_east_m_s: float = 0.0
    velocity_north_m_s: float = 0.0
    velocity_up_m_s: float = 0.0
    heading_deg: float = 0.0

    @property
    def speed_m_s(self) -> float:
        """Return the speed over ground."""
        return math.hypot(self.velocity_east_m_s, self.velocity_north_m_s)


class Motion(Protocol):
    """One part of the flight."""

    def advance(self, until_s: float) -> None:
        """Work the motion out up to a time."""

    def pose_at(self, time_s: float) -> Pose:
        """Return the pose at a time that was worked out."""

    def finished(self, time_s: float) -> bool:
        """Return whether the motion has come to its end."""


class Rest:
    """Stands still, on the ground or in the air."""

    def __init__(self, pose: Pose) -> None:
        self._pose = _stopped(pose)

    def advance(self, until_s: float) -> None:
        """Do nothing: there is nothing to work out."""

    def pose_at(self, time_s: float) -> Pose:
        """Return the same pose, later."""
        return replace(self._pose, time_s=time_s)

    def finished(self, time_s: float) -> bool:
        """Return false: rest has no end of its own."""
        return time_s < self._pose.time_s


class Climb:
    """Climbs or descends on the spot at a constant speed."""

    def __init__(self, pose: Pose, *, height_m: float, speed_m_s: float) -> None:
        self._pose = _stopped(pose)
        self._height_m = height_m
        self._up_m_s = math.copysign(speed_m_s, height_m - pose.height_m)
        self._end_s = pose.time_s + abs(height_m - pose.height_m) / speed_m_s

    def advance(self, until_s: float) -> None:
        """Do nothing: the motion is a formula."""

    def pose_at(self, time_s: float) -> Pose:
        """Return the pose on the vertical line."""
        if time_s >= self._end_s:
            return replace(self._pose, time_s=time_s, height_m=self._height_m)
        elapsed_s = max(time_s - self._pose.time_s, 0.0)
        return replace(
            self._pose,
            time_s=time_s,
            height_m=self._pose.height_m + self._up_m_s * elapsed_s,
            velocity_up_m_s=self._up_m_s,
        )

    def finished(self, time_s: float) -> bool:
        """Return whether the height is reached."""
        return time_s >= self._end_s


class Brake:
    """Slows down along the course to a stop, then hovers."""

    def __init__(self, pose: Pose, *, deceleration_m_s2: float = 2.5) -> None:
        self._pose = pose
        self._duration_s = pose.speed_m_s / deceleration_m_s2

    def advance(self, until_s: float) -> None:
        """Do nothing: the motion is a formula."""

    def pose_at(self, time_s: float) -> Pose:
        """Return the pose on the braking line."""
        t_s = min(max(time_s - self._pose.time_s, 0.0), self._duration_s)
        left = 1.0 - t_s / self._duration_s if self._duration_s > 0.0 else 0.0
        path_s = t_s * 0.5 * (1.0 + left)
        return replace(
            self._pose,
            time_s=time_s,
            east_m=self._pose.east_m + self._pose.velocity_east_m_s * path_s,
            north_m=self._pose.north_m + self._pose.velocity_north_m_s * path_s,
            velocity_east_m_s=self._pose.velocity_east_m_s * left,
            velocity_north_m_s=self._pose.velocity_north_m_s * left,
            velocity_up_m_s=0.0,
        )

    def finished(self, time_s: float) -> bool:
        """Return whether the vehicle stands."""
        return time_s >= self._pose.time_s + self._duration_s


class RouteFlight:
    """Flies the legs of a route with the twin's vehicle."""

    def __init__(
        self, pose: Pose, legs: tuple[Leg, ...], *, airframe: Airframe, seed: int, corners: Corners
    ) -> None:
        route = Route(
            start_east_m=pose.east_m,
            start_north_m=pose.north_m,
            legs=legs,
            height_m=pose.height_m,
        )
        self._start_s = pose.time_s
        self._vehicle = Vehicle(
            route, start_s=pose.time_s, airframe=airframe, seed=seed, corners=corners
        )

    @property
    def leg(self) -> int:
        """Return the number of the leg that is flown."""
        return self._vehicle.leg_number

    def advance(self, until_s: float) -> None:
        """Integrate the vehicle up to a time."""
        self._vehicle.advance(until_s)

    def pose_at(self, time_s: float) -> Pose:
        """Return the vehicle's truth; what was not worked out yet is worked out first."""
        self._vehicle.advance(time_s)
        return _pose_of(self._vehicle.truth_at(time_s))

    def finished(self, time_s: float) -> bool:
        """Return whether the last leg is flown."""
        return time_s >= self._start_s and self._vehicle.finished


class World:
    """The chain of motions since the start, the newest last."""

    def __init__(self, pose: Pose) -> None:
        self._starts_s = [pose.time_s]
        self._motions: list[Motion] = [Rest(pose)]

    @property
    def start_s(self) -> float:
        """Return the time from which on the truth is known."""
        return self._starts_s[0]

    def begin(self, motion: Motion, *, now_s: float) -> None:
        """Leave the motion in force for another one."""
        self._starts_s.append(now_s)
        self._motions.append(motion)

    def advance(self, until_s: float) -> None:
        """Work the motion in force out up to a time."""
        self._motions[-1].advance(until_s)

    def finished(self, now_s: float) -> bool:
        """Return whether the motion in force has come to its end."""
        return self._motions[-1].finished(now_s)

    def pose_at(self, time_s: float) -> Pose:
        """Return the true pose at a time that was worked out."""
        index = max(bisect_right(self._starts_s, time_s) - 1, 0)
        return self._motions[index].pose_at(max(time_s, self._starts_s[0]))


def _stopped(pose: Pose) -> Pose:
    """Return the pose without its velocity."""
    return replace(pose, velocity_east_m_s=0.0, velocity_north_m_s=0.0, velocity_up_m_s=0.0)


def _pose_of(truth: Truth) -> Pose:
    """Return the twin's truth as a pose of this chain."""
    return Pose(
        time_s=truth.time_s,
        east_m=truth.east_m,
        north_m=truth.north_m,
        height_m=truth.height_m,
        velocity_east_m_s=truth.velocity_east_m_s,
        velocity_north_m_s=truth.velocity_north_m_s,
        heading_deg=truth.heading_deg,
    )


# What the flight controller believes of its position: the truth, late and with noise.

ARDUPILOT_NOISE = EstimatorNoise()
# Measured on the PX4 SIH SITL, by its own log of the truth: 10 ms late in all (five flights to and
# fro: 6.7 to 11.9 ms), with a slow bias of 0.1 m.
PX4_NOISE = EstimatorNoise(lag_s=0.006, drift_m=0.1, drift_time_s=120.0)


# How late a receiver is.
RECEIVER_S = 0.1


class Estimator:
    """Gives the estimated pose; the drift goes on between two looks."""

    def __init__(self, world: World, noise: EstimatorNoise, *, seed: int) -> None:
        self._world = world
        self._noise = noise
        self._random = np.random.default_rng(seed)
        self._drift_m = self._random.normal(0.0, noise.drift_m, 2)
        self._own_random = np.random.default_rng((seed, 1))
        self._drift_m_s = self._own_random.normal(0.0, noise.velocity_drift_m_s, 2)
        self._drift_at_s = world.start_s

    def estimate(self, now_s: float) -> Pose:
        """Return what is believed at `now_s`."""
        noise = self._noise
        pose = self._world.pose_at(now_s - noise.lag_s - noise.wire_s)
        keep, keeps, spread_m, spread_m_s = noise.kept(max(now_s - self._drift_at_s, 0.0))
        draw = self._random.normal(0.0, 1.0, 6)
        self._drift_m = self._drift_m * keep + spread_m * draw[:2]
        self._drift_m_s = self._drift_m_s * keeps + self._own_random.normal(0.0, spread_m_s, 2)
        self._drift_at_s = max(now_s, self._drift_at_s)
        off_m_s = self._drift_m_s + noise.velocity_m_s * draw[4:]
        return replace(
            pose,
            time_s=now_s,
            east_m=pose.east_m + float(self._drift_m[0] + noise.white_m * draw[2]),
            north_m=pose.north_m + float(self._drift_m[1] + noise.white_m * draw[3]),
            velocity_east_m_s=pose.velocity_east_m_s + float(off_m_s[0]),
            velocity_north_m_s=pose.velocity_north_m_s + float(off_m_s[1]),
        )

    def fix(self, now_s: float) -> Pose:
        """Return where the receiver says that the vehicle is now: it is late, as they are."""
        return replace(self.estimate(now_s - RECEIVER_S), time_s=now_s)

    def frozen(self, now_s: float) -> Pose:
        """Return the last estimate at rest: what is sent once there is none any more."""
        return replace(
            self.estimate(now_s),
            velocity_east_m_s=0.0,
            velocity_north_m_s=0.0,
            velocity_up_m_s=0.0,
        )
