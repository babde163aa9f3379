"""The true flight: a copter that follows straight legs through gusts, and how it leans in them.

A copter pushes straight up along its own axis. So it leans into its acceleration and against the
air, and its accelerometer feels that push and the drag, but never gravity.

It stops and turns at every corner, which is all that a method of spraying needs; or it flies as one
of the two autopilots does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from sitl.airframes import DRAWN, Airframe
from sitl.guidance import STEP_S, ArduCopter, Guidance, Px4
from sitl.trajectory import Leg, Route, Trajectory, Truth, lines_of

# ------------------------------------------------------------------------------------- how it leans

GRAVITY_M_S2 = 9.80665
# The air's drag: 5 m/s are 0.7 m/s2, which a copter leans against by 4 degrees.
AIR_DRAG_1_S = 0.14
# What is felt is a mean of about so long: of ArduPilot's filter of 20 Hz.
MEAN_S = 0.02


class Moves(Protocol):
    """The true motion at one time."""

    @property
    def velocity_east_m_s(self) -> float:
        """Return the velocity to the east."""

    @property
    def velocity_north_m_s(self) -> float:
        """Return the velocity to the north."""

    @property
    def heading_deg(self) -> float:
        """Return where the nose points."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Leaning:
    """Roll, pitch and yaw, and what is felt along the body: forward, right, down."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    felt_m_s2: tuple[float, float, float]


def leaning(before: Moves, now: Moves, dt_s: float) -> Leaning:
    """Return how it leans between two moments `dt_s` apart."""
    yaw = math.radians(now.heading_deg)
    sin, cos = math.sin(yaw), math.cos(yaw)
    east = (now.velocity_east_m_s - before.velocity_east_m_s) / dt_s
    north = (now.velocity_north_m_s - before.velocity_north_m_s) / dt_s
    ahead, aside = east * sin + north * cos, east * cos - north * sin
    speed_ahead = now.velocity_east_m_s * sin + now.velocity_north_m_s * cos
    speed_aside = now.velocity_east_m_s * cos - now.velocity_north_m_s * sin
    push_ahead, push_aside = ahead + AIR_DRAG_1_S * speed_ahead, aside + AIR_DRAG_1_S * speed_aside
    pitch = -math.atan2(push_ahead, GRAVITY_M_S2)
    roll = math.atan2(push_aside, math.hypot(GRAVITY_M_S2, push_ahead))
    # What is felt has no gravity in it: level and at rest, 9.8 m/s2 upwards.
    forward = ahead * math.cos(pitch) + GRAVITY_M_S2 * math.sin(pitch)
    below = ahead * math.sin(pitch) - GRAVITY_M_S2 * math.cos(pitch)
    right = aside * math.cos(roll) + below * math.sin(roll)
    down = below * math.cos(roll) - aside * math.sin(roll)
    return Leaning(roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw, felt_m_s2=(forward, right, down))


# ------------------------------------------------------------------------------------- how it flies

__all__ = ["STEP_S", "Leg", "Route", "Trajectory", "Truth", "Vehicle"]

TURN_SPEED_M_S = 0.5
TURN_RATE_DEG_S = 90.0
# Two legs that differ by less than this in course are flown through without a stop.
STRAIGHT_DEG = 5.0
# Speed controller and drag, such that gusts of 1 m/s (1 sd, 1.5 s) make 0.15 m/s (1 sd) of
# along-track speed: sd = drag / sqrt(gain (gain + 1 / time)).
SPEED_GAIN_1_S = 2.0
DRAG_1_S = 0.346
# Whom an autopilot holds to a place on its way, the same gusts push against a spring: the drag is
# such that their speed is as large as without it (from the Lyapunov equation of both).
HELD_SPRING_1_S2, HELD_DRAG_1_S = 2.0, 0.505
# The nose follows the way of whom is led at this share of the leg's speed or more.
NOSE_SHARE = 0.05
_BLOCK = 4096

Corners = Literal["stop", "ardupilot", "px4"]


class Vehicle:
    """Flies a route, leg by leg: accelerates, holds its line in gusts, brakes, turns.

    Its state is along and across the present leg; the history is turned into east and north only
    when it is asked for.
    """

    def __init__(
        self,
        route: Route,
        *,
        start_s: float,
        seed: int,
        acceleration_m_s2: float = 2.5,
        gust_m_s: float | None = None,
        gust_time_s: float | None = None,
        airframe: Airframe = DRAWN,
        heading: Literal["course"] | float = "course",
        corners: Corners = "stop",
    ) -> None:
        gust_m_s = airframe.gust_m_s if gust_m_s is None else gust_m_s
        gust_time_s = airframe.gust_time_s if gust_time_s is None else gust_time_s
        if not (acceleration_m_s2 > 0.0 and gust_m_s >= 0.0 and gust_time_s > 0.0):
            raise ValueError("acceleration and gust time must be positive, gusts not negative")
        self.route = route
        self._start_s = start_s
        self._acceleration = acceleration_m_s2
        self._decay = math.exp(-STEP_S / gust_time_s)
        self._kick = gust_m_s * math.sqrt(1.0 - self._decay**2)
        rate = airframe.cross_rate_1_s
        driven_m = gust_m_s * airframe.cross_sd_m
        self._cross_kick = driven_m * math.sqrt(4.0 * rate**3 * STEP_S)
        # Spring and damper of one step.
        self._cross_held = rate**2 * STEP_S, 2.0 * rate * STEP_S
        self._rng = np.random.default_rng(seed)
        self._noise: list[tuple[float, float]] = []
        self._fixed_heading_deg = None if heading == "course" else float(heading)
        self._legs = lines_of(route)
        self._leg = 0
        self._turning = False
        self._led: Guidance | None = None
        if corners == "stop" and airframe.guided:
            corners = "ardupilot"
        self._turned_deg, self._nose_gain = 0.0, airframe.nose_gain_deg_s2
        if corners != "stop":
            self._led = (ArduCopter if corners == "ardupilot" else Px4)(route, acceleration_m_s2)
        self._pushed = (0.0, 0.0, 0.0, 0.0)  # along, its speed, across, its speed
        self._along_m = self._speed = self._reference = 0.0
        self._cross_m = self._cross_speed = self._gust = 0.0
        self._heading_deg = self._course_of(0)
        # (leg, along, cross, speed, cross speed, heading) of every step.
        self._history: list[tuple[int, float, float, float, float, float]] = []
        self.finished = False
        self._remember()

    @property
    def time_s(self) -> float:
        """Return the time that the flight has been computed to."""
        return self._start_s + STEP_S * (len(self._history) - 1)

    @property
    def leg_number(self) -> int:
        """Return the number of the leg now flown."""
        return self._leg

    @property
    def leg(self) -> Leg:
        """Return the leg now flown."""
        return self.route.legs[self._leg]

    def advance(self, until_s: float) -> None:
        """Fly on until `until_s` or the end of the route."""
        steps = math.ceil((until_s - self._start_s) / STEP_S - 1e-9) - (len(self._history) - 1)
        self._fly(steps)

    def fly_to_end(self, limit_s: float = 36_000.0) -> Trajectory:
        """Fly the whole route and return it."""
        self.advance(self._start_s + limit_s)
        if not self.finished:
            raise ValueError(f"the route takes more than {limit_s} s")
        return self.trajectory()

    def truth_at(self, time_s: float) -> Truth:
        """Return the truth at a time up to now; before the start and after the end it stands."""
        place = (time_s - self._start_s) / STEP_S
        last = len(self._history) - 1
        if not (place <= last + 1e-6 or self.finished):
            raise ValueError(f"{time_s} s is not flown yet, only {self.time_s} s")
        place = min(max(place, 0.0), float(last))
        i = min(int(place), max(last - 1, 0))
        first, second = self._world(i), self._world(min(i + 1, last))
        share = place - i
        turn_deg = (second[4] - first[4] + 180.0) % 360.0 - 180.0
        east_m, north_m, velocity_east, velocity_north = (
            a + share * (b - a) for a, b in zip(first[:4], second[:4], strict=True)
        )
        return Truth(
            time_s=time_s,
            east_m=east_m,
            north_m=north_m,
            height_m=self.route.height_m,
            velocity_east_m_s=velocity_east,
            velocity_north_m_s=velocity_north,
            heading_deg=(first[4] + share * turn_deg) % 360.0,
        )

    def trajectory(self) -> Trajectory:
        """Return the flight so far."""
        history = np.array(self._history)
        leg = history[:, 0].astype(np.int64)
        lines = np.array(self._legs)[leg]
        along, cross, speed, cross_speed = history[:, 1:5].T
        sin, cos = lines[:, 2], lines[:, 3]
        return Trajectory(
            time_s=self._start_s + STEP_S * np.arange(len(history), dtype=np.float64),
            east_m=lines[:, 0] + along * sin + cross * cos,
            north_m=lines[:, 1] + along * cos - cross * sin,
            velocity_east_m_s=speed * sin + cross_speed * cos,
            velocity_north_m_s=speed * cos - cross_speed * sin,
            heading_deg=np.unwrap(history[:, 5], period=360.0),
            leg=leg,
            height_m=self.route.height_m,
        )

    def _world(self, i: int) -> tuple[float, float, float, float, float]:
        leg, along, cross, speed, cross_speed, heading_deg = self._history[i]
        east_m, north_m, sin, cos, _ = self._legs[leg]
        return (
            east_m + along * sin + cross * cos,
            north_m + along * cos - cross * sin,
            speed * sin + cross_speed * cos,
            speed * cos - cross_speed * sin,
            heading_deg,
        )

    def _course_of(self, leg: int) -> float:
        """Return the heading that is wanted on a leg."""
        if self._fixed_heading_deg is not None:
            return self._fixed_heading_deg % 360.0
        _, _, sin, cos, _ = self._legs[leg]
        return math.degrees(math.atan2(sin, cos)) % 360.0

    def _bend_deg(self, leg: int) -> float:
        """Return the change of course at the end of `leg`; 180 at the end of the route."""
        if leg + 1 >= len(self._legs):
            return 180.0
        _, _, sin, cos, _ = self._legs[leg]
        _, _, next_sin, next_cos, _ = self._legs[leg + 1]
        return math.degrees(math.acos(min(max(sin * next_sin + cos * next_cos, -1.0), 1.0)))

    def _end_speed(self, leg: int) -> float:
        if self._bend_deg(leg) < STRAIGHT_DEG:
            return min(self.route.legs[leg].speed_m_s, self.route.legs[leg + 1].speed_m_s)
        return min(TURN_SPEED_M_S, self.route.legs[leg].speed_m_s)

    def _remember(self) -> None:
        self._history.append(
            (
                self._leg,
                self._along_m,
                self._cross_m,
                self._speed,
                self._cross_speed,
                self._heading_deg,
            )
        )

    def _draw(self) -> tuple[float, float]:
        if not self._noise:
            block = self._rng.standard_normal((_BLOCK, 2)) * (self._kick, self._cross_kick)
            self._noise = [(a, b) for a, b in block[::-1].tolist()]
        return self._noise.pop()

    def _fly(self, steps: int) -> None:
        if self._led is not None and not self.finished:
            self._follow(self._led, steps)
        while steps > 0 and not self.finished and self._led is None:
            steps = self._turn(steps) if self._turning else self._run(steps)

    def _run(self, steps: int) -> int:
        """Fly along the leg for up to `steps`; return how many are left.

        One loop on local variables: three minutes of flight are 18 000 steps.
        """
        length_m = self._legs[self._leg][4]
        speed_m_s = self.route.legs[self._leg].speed_m_s
        end_2 = self._end_speed(self._leg) ** 2
        twice, most = 2.0 * self._acceleration, self._acceleration * STEP_S
        along, speed, reference, gust = self._along_m, self._speed, self._reference, self._gust
        cross, cross_speed = self._cross_m, self._cross_speed
        leg, heading, decay, draw = self._leg, self._heading_deg, self._decay, self._draw
        append, sqrt = self._history.append, math.sqrt
        spring, damper = self._cross_held
        gain, drag = SPEED_GAIN_1_S * STEP_S, DRAG_1_S * STEP_S
        while steps > 0 and along < length_m:
            steps -= 1
            kick, cross_kick = draw()
            gust = decay * gust + kick
            wanted = min(reference + most, speed_m_s, sqrt(end_2 + twice * (length_m - along)))
            wanted = max(wanted, reference - 2.0 * most)
            speed += wanted - reference + gain * (wanted - speed) + drag * gust
            reference = wanted
            along += speed * STEP_S
            cross_speed += cross_kick - damper * cross_speed - spring * cross
            cross += cross_speed * STEP_S
            append((leg, along, cross, speed, cross_speed, heading))
        self._along_m, self._speed, self._reference, self._gust = along, speed, reference, gust
        self._cross_m, self._cross_speed = cross, cross_speed
        if along >= length_m:
            self._end_leg()
        return steps

    def _follow(self, led: Guidance, steps: int) -> None:
        """Fly as an autopilot leads, for up to `steps`; gusts push the copter off that way."""
        along, along_speed, across, across_speed = self._pushed
        spring, damper = self._cross_held
        for _ in range(steps):
            leg = led.leg
            led.step()
            kick, cross_kick = self._draw()
            self._gust = self._decay * self._gust + kick
            along_speed += STEP_S * (
                HELD_DRAG_1_S * self._gust - SPEED_GAIN_1_S * along_speed - HELD_SPRING_1_S2 * along
            )
            along += along_speed * STEP_S
            across_speed += cross_kick - damper * across_speed - spring * across
            across += across_speed * STEP_S
            if led.leg != leg:
                _, _, sin_0, cos_0, _ = self._legs[leg]
                _, _, sin_1, cos_1, _ = self._legs[led.leg]
                cosine, sine = sin_0 * sin_1 + cos_0 * cos_1, cos_0 * sin_1 - sin_0 * cos_1
                along, across = along * cosine + across * sine, across * cosine - along * sine
                along_speed, across_speed = (
                    along_speed * cosine + across_speed * sine,
                    across_speed * cosine - along_speed * sine,
                )
            self._leg = led.leg
            start_east, start_north, sin, cos, _ = self._legs[self._leg]
            copter = led.copter
            east_m, north_m = copter.east_m - start_east, copter.north_m - start_north
            ve, vn = copter.velocity_east_m_s, copter.velocity_north_m_s
            self._along_m = east_m * sin + north_m * cos + along
            self._cross_m = east_m * cos - north_m * sin + across
            self._speed = ve * sin + vn * cos + along_speed
            self._cross_speed = ve * cos - vn * sin + across_speed
            self._turn_nose(led)
            self._remember()
            if led.finished:
                self.finished = True
                break
        self._pushed = (along, along_speed, across, across_speed)

    def _turn_nose(self, led: Guidance) -> None:
        """Turn the nose towards where the copter is led, as fast as it turns."""
        speed = math.hypot(led.lead_east_m_s, led.lead_north_m_s)
        least = NOSE_SHARE * self.route.legs[self._leg].speed_m_s
        if self._fixed_heading_deg is not None or speed < least:
            return
        target_deg = math.degrees(math.atan2(led.lead_east_m_s, led.lead_north_m_s))
        left_deg = (target_deg - self._heading_deg + 180.0) % 360.0 - 180.0
        most_deg = led.nose_deg_s * STEP_S
        turned_deg = min(max(left_deg, -most_deg), most_deg)
        if self._nose_gain < math.inf:
            # No faster than it can still come to rest from, and its rate takes time to change.
            stops_deg = math.sqrt(2.0 * self._nose_gain * abs(left_deg)) * STEP_S
            turned_deg = min(max(turned_deg, -stops_deg), stops_deg)
            change_deg, before_deg = self._nose_gain * STEP_S**2, self._turned_deg
            turned_deg = min(max(turned_deg, before_deg - change_deg), before_deg + change_deg)
            self._turned_deg = turned_deg
        self._heading_deg += turned_deg

    def _end_leg(self) -> None:
        if self._bend_deg(self._leg) < STRAIGHT_DEG:
            self._next_leg()
        else:
            self._turning = True

    def _next_leg(self) -> None:
        """Go over to the next leg: the same place and velocity, seen along another line."""
        east_m, north_m, velocity_east, velocity_north, _ = self._world(len(self._history) - 1)
        self._leg += 1
        start_east, start_north, sin, cos, _ = self._legs[self._leg]
        east_m, north_m = east_m - start_east, north_m - start_north
        self._along_m = east_m * sin + north_m * cos
        self._cross_m = east_m * cos - north_m * sin
        self._speed = self._reference = velocity_east * sin + velocity_north * cos
        self._cross_speed = velocity_east * cos - velocity_north * sin
        self._turning = False

    def _turn(self, steps: int) -> int:
        """Stop, and turn the nose to the next leg; return how many steps are left."""
        is_last = self._leg + 1 >= len(self._legs)
        target_deg = self._heading_deg if is_last else self._course_of(self._leg + 1)
        most_deg, most = TURN_RATE_DEG_S * STEP_S, self._acceleration * STEP_S
        spring, damper = self._cross_held
        while steps > 0:
            left_deg = (target_deg - self._heading_deg + 180.0) % 360.0 - 180.0
            if left_deg == 0.0 and self._speed == 0.0:
                break
            steps -= 1
            kick, cross_kick = self._draw()
            self._gust = self._decay * self._gust + kick
            self._heading_deg += min(max(left_deg, -most_deg), most_deg)
            if abs(left_deg) <= most_deg:
                self._heading_deg = target_deg
            self._speed -= min(max(self._speed, -most), most)
            self._along_m += self._speed * STEP_S
            self._cross_speed += cross_kick - damper * self._cross_speed - spring * self._cross_m
            self._cross_m += self._cross_speed * STEP_S
            self._remember()
        else:
            return 0
        if is_last:
            self.finished = True
        else:
            self._next_leg()
        return steps
