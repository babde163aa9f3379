"""The sprayer's geometry: where each valve's strip lies on the ground, and meets the border.

Course is not heading: the lag is along the course, the boom lies across the heading. A copter
that flies a zig-zag backwards keeps its boom, and its left valve stays on its left.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from companion.core.arithmetic import log
from companion.core.braking import CREEP_M_S, braking_begins_s
from companion.core.frame import Box, Floats, Offset, PlainEdge, course_deg
from companion.core.inputs import MISSION_MODES
from companion.core.motion import Turning, gained_s
from companion.core.types import StopAhead, VehicleState


@dataclass(frozen=True, slots=True, kw_only=True)
class Valve:
    """One valve and the strip of ground that its nozzles cover, in the body frame.

    `right_m` and `forward_m` are from the autopilot's position reference to the strip's centre.
    `flow_factor` is what it delivers at a duty over what the mean valve of its set does, and the
    lags are how much later [s] it is than the set's own; measured by `vrspray calibrate valves`.
    """

    name: str
    right_m: float
    forward_m: float
    width_m: float
    channel: int = 0
    flow_factor: float = 1.0
    lag_on_s: float = 0.0
    lag_off_s: float = 0.0
    lag_up_s: float = 0.0
    lag_down_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.width_m < 1000.0:
            raise ValueError(f"width of valve {self.name} must be positive, got {self.width_m}")
        if not (abs(self.right_m) < 1000.0 and abs(self.forward_m) < 1000.0):
            raise ValueError(f"offset of valve {self.name} is not a length")
        if not 0.5 <= self.flow_factor <= 2.0:
            raise ValueError(f"flow_factor of valve {self.name} must lie in [0.5, 2]")
        if not all(abs(lag_s) <= 0.5 for lag_s in self.lags_s):
            raise ValueError(f"lags of valve {self.name} must lie in [-0.5, 0.5] s")

    @property
    def lags_s(self) -> tuple[float, float, float, float]:
        """Return how much later than its set it is: on, off, up, down."""
        return self.lag_on_s, self.lag_off_s, self.lag_up_s, self.lag_down_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Boom:
    """All valves, left to right, and the effective width B of every flow law."""

    width_m: float
    valves: tuple[Valve, ...]
    height_m: float = 3.5
    right_m: Floats = field(init=False, repr=False, compare=False)
    forward_m: Floats = field(init=False, repr=False, compare=False)
    half_width_m: Floats = field(init=False, repr=False, compare=False)
    reach_m: float = field(init=False, repr=False, compare=False)
    # Right, forward and half width of each in plain numbers; how far the farther tip is aside.
    strips_m: tuple[tuple[float, float, float], ...] = field(init=False, repr=False, compare=False)
    tip_m: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.width_m < 1000.0:
            raise ValueError(f"boom width must be positive, got {self.width_m}")
        if not self.valves:
            raise ValueError("a boom needs at least one valve")
        for name, values in (
            ("right_m", [valve.right_m for valve in self.valves]),
            ("forward_m", [valve.forward_m for valve in self.valves]),
            ("half_width_m", [valve.width_m / 2 for valve in self.valves]),
        ):
            object.__setattr__(self, name, np.array(values, dtype=np.float64))
        aside = np.abs(self.right_m) + self.half_width_m
        object.__setattr__(self, "tip_m", float(aside.max()))
        object.__setattr__(self, "reach_m", float(np.hypot(aside, self.forward_m).max()))
        each = (self.right_m, self.forward_m, self.half_width_m)
        strips = zip(*(values.tolist() for values in each), strict=True)
        object.__setattr__(self, "strips_m", tuple(strips))


def body_axes(heading_deg: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the unit vectors (east, north) of forward and of right.

    >>> forward, right = body_axes(90.0)
    >>> round(forward[0], 12), round(right[1], 12)
    (1.0, -1.0)
    """
    heading_rad = math.radians(heading_deg)
    sin, cos = math.sin(heading_rad), math.cos(heading_rad)
    return (sin, cos), (cos, -sin)


# Where each point of the boom will be: the predicted motion as chords, one on a straight pass.

# Below these, the estimate of a turn is mostly noise. What it leaves out: in the 0.3 s that an
# order looks ahead at most, a valve 2.5 m from the middle gains or loses up to 0.04 m.
STRAIGHT_YAW_RATE_DEG_S = 3.0
STRAIGHT_LATERAL_M_S2 = 1.0
# Beyond these each valve is dosed by the speed at which it sweeps the ground then, and not by what
# the boom's middle does now. At 5 m/s 0.3 m/s2 turn the course by 1 degree in 0.3 s.
STEADY_YAW_RATE_DEG_S = 1.0
STEADY_LATERAL_M_S2 = 0.3
# Two velocities have one course, 2 degrees apart at most (a sine).
SAME_COURSE = 0.035
# Knots of a path nearer than this are one.
KNOTS_APART_S = 1e-3
# In a turn a chord is so long, or this share of how far ahead it begins; leads nearer than
# `LEADS_APART_S` share a knot.
CURVE_CHORD_S, CURVE_CHORD_SHARE, LEADS_APART_S = 0.09, 0.6, 0.02
# A way is known to this when it is turned into a time.
WAY_SD_M, WAY_ROUNDS = 1e-6, 16


class Fading(NamedTuple):
    """How a straight chord is flown while an acceleration fades: to the metre, at every time.

    `behind_m` is how far back it begins, `goes_m_s` how fast the place goes now, `speed_m_s` the
    speed that is dosed by.
    """

    now_s: float
    behind_m: float
    goes_m_s: float
    speed_m_s: float
    gain_m_s2: float
    fade_s: float

    def at(self, way_m: float) -> tuple[float, float]:
        """Return when the path is so far along the chord, and its speed there.

        By Newton's method, from the time without a gain: it comes nearer from one side only.
        """
        way_m -= self.behind_m
        dt_s = way_m / self.goes_m_s
        if not dt_s > 0.0:  # into the past it goes at constant velocity
            return self.now_s + dt_s, self.speed_m_s
        gain, fade_s = self.gain_m_s2, self.fade_s
        gained = gained_s(dt_s, fade_s)
        for _ in range(WAY_ROUNDS):
            off_m = self.goes_m_s * dt_s + gain * fade_s * (dt_s - gained) - way_m
            if abs(off_m) <= WAY_SD_M:
                break
            dt_s -= off_m / (self.goes_m_s + gain * gained)
            gained = gained_s(dt_s, fade_s)
        return self.now_s + dt_s, self.speed_m_s + gain * gained

    def speed_at(self, at_s: float) -> float:
        """Return the speed at a time."""
        return self.speed_m_s + self.gain_m_s2 * gained_s(max(at_s - self.now_s, 0.0), self.fade_s)


class Chord(NamedTuple):
    """When a chord of a point's path begins and ends, how fast then, and how long it is.

    Its speed changes evenly: s = v0 t + (v1 - v0) t^2 / 2T, scaled to its end; or as `fading` says.
    """

    times_s: Sequence[float]
    speeds_m_s: Sequence[float]
    length_m: float
    fading: Fading | None = None

    def at(self, share: float) -> tuple[float, float]:
        """Return when the path is at a share of it, and how fast."""
        if self.fading is not None:
            return self.fading.at(share * self.length_m)
        (t0, t1), (v0, v1) = self.times_s, self.speeds_m_s
        v0_2 = v0 * v0
        speed = math.sqrt(v0_2 + (v1 * v1 - v0_2) * share)
        return t0 + share * (v0 + v1) / max(v0 + speed, 1e-9) * (t1 - t0), speed

    def speed_at(self, at_s: float) -> float:
        """Return the speed at a time."""
        if self.fading is not None:
            return self.fading.speed_at(at_s)
        (t0, t1), (v0, v1) = self.times_s, self.speeds_m_s
        return v0 + (at_s - t0) / (t1 - t0) * (v1 - v0)


class Pass(NamedTuple):
    """A straight pass in plain numbers, as there are few: one chord, all points go the same way.

    Of each point: east, north, its way east and north, how long that is, and on which side of
    itself it lies (way east x north - way north x east).
    """

    chord: Chord
    middle: tuple[tuple[float, float], tuple[float, float]]
    right: tuple[float, float]
    points: list[tuple[float, float, float, float, float, float]]


class Paths(NamedTuple):
    """Predicted paths of points of the boom: (points, knots) arrays, knots at `time_s`.

    `right` is where the boom points in the middle of each chord, and `off_m` (points, chords) how
    far the true arc is from the chord at most; `turned` the sine of half the chord's turn.
    """

    time_s: tuple[float, ...]
    east_m: Floats
    north_m: Floats
    speed_m_s: Floats
    middle: tuple[tuple[float, float], ...]
    right: tuple[tuple[float, float], ...]
    step_east_m: Floats
    step_north_m: Floats
    length_m: Floats
    off_m: Floats | None = None
    turned: tuple[float, ...] = ()
    fading: Fading | None = None  # of the first chord of a straight path

    def chord_of(self, point: int, chord: int) -> Chord:
        """Return how a chord of a point's path is flown."""
        both = slice(chord, chord + 2)
        return Chord(
            self.time_s[both],
            self.speed_m_s[point, both].tolist(),
            self.length_m.item(point, chord),
            self.fading if not chord else None,
        )

    def speed_at(self, point: int, at_s: float) -> float:
        """Return how fast a point is at a time."""
        chord = min(max(bisect_right(self.time_s, at_s) - 1, 0), len(self.time_s) - 2)
        return self.chord_of(point, chord).speed_at(at_s)


def box_of(middle: tuple[tuple[float, float], ...], reach_m: float) -> Box:
    """Return west, south, east, north of all within `reach_m` of the middle's path."""
    east, north = zip(*middle, strict=True)
    return min(east) - reach_m, min(north) - reach_m, max(east) + reach_m, max(north) + reach_m


def straight_pass(state: VehicleState, boom: Boom, *, back_s: float, ahead_s: float) -> Pass | None:
    """Return the boom's path as `predict` has it; None where it is no single chord."""
    motions = _motions(state, back_s, ahead_s)
    if motions is None or len(motions) != 2:
        return None
    (begin_s, *_, e0, n0), (end_s, *_, e1, n1) = motions
    angle = math.radians(state.heading_deg or 0.0)
    sin, cos = math.sin(angle), math.cos(angle)
    points = []
    for right, forward, _ in boom.strips_m:
        east, north = right * cos + forward * sin, forward * cos - right * sin
        px, py = east + e0, north + n0
        dx, dy = (east + e1) - px, (north + n1) - py
        # The length as numpy has it, by the C library; `math.hypot` rounds otherwise.
        points.append((px, py, dx, dy, abs(complex(dx, dy)), dx * py - dy * px))
    chord = Chord(
        (state.time_s + begin_s, state.time_s + end_s),
        (math.hypot(*motions[0][1:3]), math.hypot(*motions[1][1:3])),
        points[0][4],
        _fading(state, back_s),
    )
    return Pass(chord, ((e0, n0), (e1, n1)), (cos, -sin), points)


def predict(
    state: VehicleState,
    right_m: Floats,
    forward_m: Floats,
    *,
    back_s: float,
    ahead_s: float,
    leads_s: tuple[float, ...] = (),
) -> Paths:
    """Return the paths of points of the boom from `back_s` ago to `ahead_s` from now.

    The same motion as `estimator.estimate`: constant velocity plus a fading acceleration, in the
    turn of the nose as well; on a straight path that ends in a stop, the braking before it. It is
    exact at all times on a straight path; in a turn now, and at each of the `leads_s`.
    """
    heading_deg = state.heading_deg if state.heading_deg is not None else 0.0
    motions = _motions(state, back_s, ahead_s)
    if motions is None:
        return _curved(state, heading_deg, right_m, forward_m, _knots(back_s, ahead_s, leads_s))
    middle = [(motion[3], motion[4]) for motion in motions]
    aside = np.array(_offsets(heading_deg, right_m, forward_m))
    east = aside[:, :1] + np.array([place[0] for place in middle])
    north = aside[:, 1:] + np.array([place[1] for place in middle])
    pace = np.empty(east.shape)
    pace[:] = [math.hypot(motion[1], motion[2]) for motion in motions]
    angle = math.radians(heading_deg)
    dx, dy = east[:, 1:] - east[:, :-1], north[:, 1:] - north[:, :-1]
    return Paths(
        time_s=tuple([state.time_s + motion[0] for motion in motions]),
        east_m=east,
        north_m=north,
        speed_m_s=pace,
        middle=tuple(middle),
        right=((math.cos(angle), -math.sin(angle)),) * (len(motions) - 1),
        step_east_m=dx,
        step_north_m=dy,
        length_m=np.hypot(dx, dy),
        fading=_fading(state, back_s),
    )


@lru_cache(maxsize=8)
def _knots(back_s: float, ahead_s: float, leads_s: tuple[float, ...]) -> tuple[float, ...]:
    """Return the knots of a path in a turn: now, at each lead, and the denser the sooner.

    >>> [round(at_s, 2) for at_s in _knots(0.2, 1.0, (0.12, 0.13))]
    [-0.2, 0.0, 0.06, 0.12, 0.21, 0.34, 0.54, 0.77, 1.0]
    """
    found = [-back_s, 0.0]
    for due_s in (*sorted(lead_s for lead_s in leads_s if lead_s < ahead_s), ahead_s):
        if not due_s - found[-1] >= LEADS_APART_S:
            continue
        while due_s - found[-1] > (most_s := max(CURVE_CHORD_S, CURVE_CHORD_SHARE * found[-1])):
            left_s = due_s - found[-1]
            found.append(found[-1] + (most_s if left_s >= 2.0 * most_s else 0.5 * left_s))
        found.append(due_s)
    return (*found[:-1], ahead_s)


def _curved(
    state: VehicleState,
    heading_deg: float,
    right_m: Floats,
    forward_m: Floats,
    knots: tuple[float, ...],
) -> Paths:
    """Return the paths of points of the boom in a turn; what they leave out is told with them."""
    ae, an = state.acceleration_east_m_s2, state.acceleration_north_m_s2
    moved = np.array([_carried(state, dt_s, ae, an) for dt_s in knots]).T
    turns = [_turned(state, dt_s) for dt_s in knots]
    nose = [math.radians(heading_deg + turned_deg) for turned_deg, _ in turns]
    yaw_rate = np.radians([rate_deg_s for _, rate_deg_s in turns])
    # Not numpy's own, which rounds as the processor has it.
    sin, cos = np.array(list(map(math.sin, nose))), np.array(list(map(math.cos, nose)))
    right, forward = right_m[:, None], forward_m[:, None]
    offset_east, offset_north = right * cos + forward * sin, forward * cos - right * sin
    velocity_east, velocity_north = (
        moved[0] + yaw_rate * offset_north,
        moved[1] - yaw_rate * offset_east,
    )
    east, north = moved[2] + offset_east, moved[3] + offset_north
    dx, dy = east[:, 1:] - east[:, :-1], north[:, 1:] - north[:, :-1]
    # Of an even change of velocity over a chord the arc is off by an eighth of it.
    bent = np.hypot(np.diff(velocity_east, axis=1), np.diff(velocity_north, axis=1))
    middles = [0.5 * (a + b) for a, b in pairwise(nose)]
    return Paths(
        time_s=tuple([state.time_s + dt_s for dt_s in knots]),
        east_m=east,
        north_m=north,
        speed_m_s=np.hypot(velocity_east, velocity_north),
        middle=tuple(zip(moved[2].tolist(), moved[3].tolist(), strict=True)),
        right=tuple([(math.cos(angle), -math.sin(angle)) for angle in middles]),
        step_east_m=dx,
        step_north_m=dy,
        length_m=np.hypot(dx, dy),
        off_m=bent * np.diff(knots) / 8.0,
        turned=tuple([math.sin(min(0.5 * abs(b - a), 0.5 * math.pi)) for a, b in pairwise(nose)]),
    )


def _turned(state: VehicleState, dt_s: float) -> tuple[float, float]:
    """Return how far the nose turns in a time [deg], and how fast then; steadily in the past."""
    turning = turning_of(state)
    if not dt_s > 0.0:
        return turning.rate_deg_s * dt_s, turning.rate_deg_s
    turned_deg, then = turning.after(dt_s)
    return turned_deg, then.rate_deg_s


def turning_of(state: VehicleState) -> Turning:
    """Return how the nose turns."""
    return Turning(state.yaw_rate_deg_s, state.yaw_gain_deg_s2)


class Sweep(NamedTuple):
    """How the boom moves along the nose at some moment, and how the nose turns.

    A strip that moves along itself treats no new ground, so only its velocity along the nose counts
    for the dose. `speed_m_s` is how fast the reference goes in whatever direction.
    """

    along_m_s: float
    yaw_rad_s: float
    speed_m_s: float

    def of(self, boom: Boom) -> list[float]:
        """Return how fast the strip of each valve sweeps the ground [m/s].

        Where some go forwards and others back, the boom pivots: what goes back goes over ground
        that it has just left, and sweeps none. All go back where a copter flies tail first.
        """
        swept = [self.along_m_s - self.yaw_rad_s * right_m for right_m, _, _ in boom.strips_m]
        if max(swept) < 0.0:
            return [-each for each in swept]
        return [each if each > 0.0 else 0.0 for each in swept]


def sweep_at(state: VehicleState, dt_s: float) -> Sweep:
    """Return how the boom sweeps the ground `dt_s` from now."""
    turned_deg, rate_deg_s = _turned(state, dt_s)
    east, north, _, _ = _carried(
        state, dt_s, state.acceleration_east_m_s2, state.acceleration_north_m_s2
    )
    heading_deg = state.heading_deg or 0.0
    across = state.velocity_east_m_s * north - state.velocity_north_m_s * east
    if state.mode in MISSION_MODES and abs(across) <= SAME_COURSE * (east * east + north * north):
        # A mission turns the nose to its course, and no farther; not while the course turns, too.
        to_course_deg = (course_deg(east, north) - heading_deg + 180.0) % 360.0 - 180.0
        if turned_deg * to_course_deg > 0.0 and abs(turned_deg) > abs(to_course_deg):
            turned_deg, rate_deg_s = to_course_deg, 0.0
    angle = math.radians(heading_deg + turned_deg)
    along = east * math.sin(angle) + north * math.cos(angle)
    return Sweep(along, math.radians(rate_deg_s), math.hypot(east, north))


def sweeps_alike(state: VehicleState) -> bool:
    """Return whether all valves sweep the ground as fast as the reference, now and soon."""
    if turning_of(state).fastest_deg_s > STEADY_YAW_RATE_DEG_S:
        return False
    ve, vn = state.velocity_east_m_s, state.velocity_north_m_s
    across = ve * state.acceleration_north_m_s2 - vn * state.acceleration_east_m_s2
    return abs(across) <= STEADY_LATERAL_M_S2 * math.hypot(ve, vn)


def place_velocity(state: VehicleState) -> tuple[float, float]:
    """Return how fast the place goes, east and north: where it is told, not how it is dosed."""
    return (
        state.velocity_east_m_s + state.outrun_east_m_s,
        state.velocity_north_m_s + state.outrun_north_m_s,
    )


def velocity_at(state: VehicleState, dt_s: float) -> tuple[float, float]:
    """Return the velocity (east, north) of the reference `dt_s` from now."""
    ae, an = state.acceleration_east_m_s2, state.acceleration_north_m_s2
    return _carried(state, dt_s, ae, an)[:2]


def _carried(
    state: VehicleState, dt_s: float, ae: float, an: float
) -> tuple[float, float, float, float]:
    """Return velocity (east, north) and place (east, north) of the reference at `dt_s` from now.

    The place outruns the velocity where an autopilot tells two motions.
    """
    gained = carried = 0.0  # into the past it goes at constant velocity
    if dt_s > 0.0:
        fade_s = state.acceleration_fade_s
        gained = gained_s(dt_s, fade_s)
        carried = fade_s * (dt_s - gained)
    goes_east, goes_north = place_velocity(state)
    return (
        state.velocity_east_m_s + ae * gained,
        state.velocity_north_m_s + an * gained,
        state.east_m + goes_east * dt_s + ae * carried,
        state.north_m + goes_north * dt_s + an * carried,
    )


# dt_s, velocity (east, north) and place (east, north) of the reference then.
_Motion = tuple[float, float, float, float, float]


def _along(state: VehicleState) -> tuple[float, float]:
    """Return the acceleration along the way, all that counts on a straight path.

    One chord to where the other leads would miss the near end of the path by more than leaving it
    out.
    """
    east, north = place_velocity(state)
    gain = east * state.acceleration_east_m_s2 + north * state.acceleration_north_m_s2
    gain /= max(east * east + north * north, 1e-9)
    return gain * east, gain * north


def _fading(state: VehicleState, back_s: float) -> Fading | None:
    """Return how the first chord of a straight path is flown; None at an even speed."""
    east, north = place_velocity(state)
    goes_m_s = math.hypot(east, north)
    if not goes_m_s > CREEP_M_S:
        return None
    gain = (east * state.acceleration_east_m_s2 + north * state.acceleration_north_m_s2) / goes_m_s
    if gain == 0.0:
        return None
    speed_m_s = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    return Fading(
        state.time_s, goes_m_s * back_s, goes_m_s, speed_m_s, gain, state.acceleration_fade_s
    )


def _braked(
    state: VehicleState, stop: StopAhead, ae: float, an: float, back_s: float, ahead_s: float
) -> list[_Motion] | None:
    """Return the motion at the knots of a path that brakes for a stop; None if none does.

    Its chords are those before the braking, of the braking and, at the stop, a creeping on.
    """
    speed = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    if not speed > CREEP_M_S:
        return None
    along = (ae * state.velocity_east_m_s + an * state.velocity_north_m_s) / speed
    begins_s = braking_begins_s(stop, speed, along, state.acceleration_fade_s, ahead_s)
    if begins_s is None:
        return None
    motions = [(dt_s, *_carried(state, dt_s, ae, an)) for dt_s in (-back_s, begins_s)]
    _, ve, vn, east_m, north_m = motions[-1]
    pace = math.hypot(ve, vn)
    unit_east, unit_north = ve / pace, vn / pace
    creeps_s = max(pace - CREEP_M_S, 0.0) / stop.braking_m_s2
    for dt_s in (min(begins_s + creeps_s, ahead_s), ahead_s):
        braked_s = dt_s - motions[-1][0]
        if braked_s < KNOTS_APART_S:
            continue
        after = max(pace - stop.braking_m_s2 * braked_s, min(pace, CREEP_M_S))
        way_m = 0.5 * (pace + after) * braked_s
        east_m, north_m, pace = east_m + unit_east * way_m, north_m + unit_north * way_m, after
        motions.append((dt_s, unit_east * after, unit_north * after, east_m, north_m))
    return motions


def _motions(state: VehicleState, back_s: float, ahead_s: float) -> list[_Motion] | None:
    """Return the motion at the knots of a straight path; None in a turn."""
    ve, vn = state.velocity_east_m_s, state.velocity_north_m_s
    speed, lateral = math.hypot(ve, vn), 0.0
    if speed > 0.0:
        lateral = (ve * state.acceleration_north_m_s2 - vn * state.acceleration_east_m_s2) / speed
    is_straight = turning_of(state).fastest_deg_s < STRAIGHT_YAW_RATE_DEG_S
    if not (is_straight and abs(lateral) < STRAIGHT_LATERAL_M_S2):
        return None
    ae, an = _along(state)
    if state.stop_ahead is not None:
        braked = _braked(state, state.stop_ahead, ae, an, back_s, ahead_s)
        if braked is not None:
            return braked
    stands_s = _stands_s(state)
    ends_s = (-back_s, -back_s + (back_s + min(ahead_s, stands_s)))
    motions = [(dt_s, *_carried(state, dt_s, ae, an)) for dt_s in ends_s]
    if stands_s < ahead_s:
        # A path of no length crosses nothing: it creeps on, as behind a stop.
        _, ve, vn, east_m, north_m = motions[-1]
        goes_east, goes_north = place_velocity(state)
        by_s = CREEP_M_S * (ahead_s - stands_s) / math.hypot(goes_east, goes_north)
        motions.append((ahead_s, ve, vn, east_m + goes_east * by_s, north_m + goes_north * by_s))
    return motions


def _stands_s(state: VehicleState) -> float:
    """Return when a straight path has all but come to a stand, if its braking goes on."""
    fading = _fading(state, 0.0)
    if fading is None or not fading.gain_m_s2 < 0.0:
        return math.inf
    share = (fading.goes_m_s - CREEP_M_S) / (-fading.gain_m_s2 * fading.fade_s)
    return -fading.fade_s * log(1.0 - share) if share < 1.0 else math.inf


def _offsets(heading_deg: float, right_m: Floats, forward_m: Floats) -> list[tuple[float, float]]:
    """Return how far east and north each point is of the reference."""
    angle = math.radians(heading_deg)
    sin, cos = math.sin(angle), math.cos(angle)
    return [
        (right * cos + forward * sin, forward * cos - right * sin)
        for right, forward in zip(right_m.tolist(), forward_m.tolist(), strict=True)
    ]


# --------------------------------------------------------------------------------------- the border

# Which strip meets which edge, and the least and greatest way along the path where it does.
Contact = tuple[int, int, tuple[float, float]]
# Contacts of a strip with the sides of what an edge sweeps, to those with the edge (`drift.py`).
Merge = Callable[[list[Contact]], list[Contact]]
# From when until when a strip is closed.
Intervals = list[tuple[float, float]]

# A strip that lies nearly along its own motion is judged by what surrounds it, seen along the way.
ACROSS_MIN = 0.2


def add_contacts(
    paths: Paths,
    ends: Floats,
    boom: Boom,
    buffer_m: float,
    closed: list[Intervals],
    merge: Merge | None,
) -> None:
    """Add to `closed` when an edge of the border lies within a strip."""
    if not len(ends):
        return
    chords = len(paths.time_s) - 1
    for chord in range(chords):
        found = _contacts(paths, chord, ends, boom, buffer_m)
        _close(found, partial(_chord, paths, chord), closed, merge, is_last=chord == chords - 1)


def _chord(paths: Paths, chord: int, valve: int) -> Chord:
    return paths.chord_of(valve, chord)


def add_contacts_of_pass(
    way: Pass, edges: list[PlainEdge], boom: Boom, buffer_m: float, closed: list[Intervals]
) -> None:
    """Add to `closed` when an edge of the border lies within a strip, on a straight pass."""
    if edges:
        found = _contacts_of_pass(way, edges, boom, buffer_m)
        _close(found, lambda _: way.chord, closed, None, is_last=True)


def _close(
    contacts: list[Contact],
    chord_of: Callable[[int], Chord],
    closed: list[Intervals],
    merge: Merge | None,
    *,
    is_last: bool,
) -> None:
    """Add when the contacts of a chord are; `chord_of` is each valve's."""
    for valve, _, (first, last) in contacts if merge is None else merge(contacts):
        chord = chord_of(valve)
        reach = chord.length_m
        if last < 0.0 or first > reach:
            continue
        begin = chord.at(first / reach)[0] if first > 0.0 else chord.times_s[0]
        end = chord.at(last / reach)[0] if last < reach else chord.times_s[1]
        closed[valve].append((begin, math.inf if last > reach and is_last else end))


def _contacts_of_pass(
    way: Pass, edges: list[PlainEdge], boom: Boom, buffer_m: float
) -> list[Contact]:
    """Return the contacts on a straight pass, buffer included."""
    contacts: list[Contact] = []
    for valve, ((px, py, dx, dy, length, _), (_, _, half)) in enumerate(
        zip(way.points, boom.strips_m, strict=True)
    ):
        rx, ry = way.right
        safe = max(length, 1e-12)
        ux, uy = dx / safe, dy / safe
        turn = ux * ry - uy * rx  # sine of the angle from path to boom
        margin = buffer_m
        if not abs(turn) >= ACROSS_MIN:
            # What surrounds the strip lies square to the way.
            margin += half * abs(ux * rx + uy * ry)
            half, turn, rx, ry = half * abs(turn), -1.0, uy, -ux
        half += buffer_m
        for edge, (x0, y0, x1, y1, _) in enumerate(edges):
            across_0 = (ux * (y0 - py) - uy * (x0 - px)) / turn
            across_1 = (ux * (y1 - py) - uy * (x1 - px)) / turn
            if (across_0 > half and across_1 > half) or (across_0 < -half and across_1 < -half):
                continue
            along_0 = ((x0 - px) * ry - (y0 - py) * rx) / turn
            along_1 = ((x1 - px) * ry - (y1 - py) * rx) / turn
            first, last = _clip((across_0, along_0), (across_1, along_1), half)
            contacts.append((valve, edge, (first - margin, last + margin)))
    return contacts


def _contacts(paths: Paths, chord: int, ends: Floats, boom: Boom, buffer_m: float) -> list[Contact]:
    """Return the contacts of one chord, in the skewed frame of path and boom.

    What the chord leaves out of an arc is added to the buffer.
    """
    px, py = paths.east_m[:, chord], paths.north_m[:, chord]
    safe = np.maximum(paths.length_m[:, chord], 1e-12)
    ux, uy = paths.step_east_m[:, chord] / safe, paths.step_north_m[:, chord] / safe
    boom_x, boom_y = paths.right[chord]
    half, margin = boom.half_width_m, np.full(len(px), buffer_m)
    turn = ux * boom_y - uy * boom_x  # sine of the angle from path to boom
    if paths.off_m is not None:
        margin = margin + paths.off_m[:, chord]
    is_along = ~(np.abs(turn) >= ACROSS_MIN)
    aside = np.where(is_along, half * np.abs(turn), half) + margin
    if paths.turned:
        margin = margin + half * paths.turned[chord]
    margin = margin + np.where(is_along, half * np.abs(ux * boom_x + uy * boom_y), 0.0)
    rx, ry = np.where(is_along, uy, boom_x)[:, None], np.where(is_along, -ux, boom_y)[:, None]
    ux, uy, t2 = ux[:, None], uy[:, None], np.where(is_along, -1.0, turn)[:, None]
    x, y = ends[:, 0::2].ravel() - px[:, None], ends[:, 1::2].ravel() - py[:, None]
    across = (ux * y - uy * x) / t2
    across_0, across_1 = across[:, 0::2], across[:, 1::2]
    half = aside[:, None]
    touching = (np.minimum(across_0, across_1) <= half) & (np.maximum(across_0, across_1) >= -half)
    valves, hits = touching.nonzero()
    if not len(valves):
        return []
    along = (x * ry - y * rx) / t2
    along_0, along_1 = along[:, 0::2], along[:, 1::2]
    contacts: list[Contact] = []
    for valve, hit in zip(valves.tolist(), hits.tolist(), strict=True):
        first, last = _clip(
            (float(across_0[valve, hit]), float(along_0[valve, hit])),
            (float(across_1[valve, hit]), float(along_1[valve, hit])),
            float(aside[valve]),
        )
        contacts.append((valve, hit, (first - float(margin[valve]), last + float(margin[valve]))))
    return contacts


def _clip(a: tuple[float, float], b: tuple[float, float], half_m: float) -> tuple[float, float]:
    """Return the least and greatest `along` of the edge a-b within the strip's width."""
    (u0, s0), (u1, s1) = a, b
    if u0 == u1:
        return min(s0, s1), max(s0, s1)
    ends = []
    for u, s in (a, b):
        held = min(max(u, -half_m), half_m)
        ends.append(s if held == u else s0 + (s1 - s0) * (held - u0) / (u1 - u0))
    return min(ends), max(ends)


# ---------------------------------------------- liquid that lands beside its nozzle (`drift.py`)

SIDES = 4


def swept(ends: Floats, offset_m: Offset) -> Floats:
    """Return the four sides of what each edge sweeps when it is moved by the offset, in turn.

    A strip where liquid lands meets what an edge sweeps exactly while ground between it and its
    nozzle lies on that edge.
    """
    first, last = ends[:, :2], ends[:, 2:]
    moved = np.array(offset_m)
    sides = np.stack(
        [
            ends,
            np.hstack([first + moved, last + moved]),
            np.hstack([first, first + moved]),
            np.hstack([last, last + moved]),
        ],
        axis=1,
    )
    return sides.reshape(-1, 4)


def joined(contacts: list[Contact]) -> list[Contact]:
    """Return, of contacts with the sides of `swept`, one for each edge that it was made of.

    What an edge sweeps is convex: a strip that moves along touches it from the first contact with
    any of its sides to the last, and lies within it between.
    """
    found: dict[tuple[int, int], tuple[float, float]] = {}
    for valve, side, (low, high) in contacts:
        key = (valve, side // SIDES)
        before = found.get(key, (low, high))
        found[key] = (min(low, before[0]), max(high, before[1]))
    return [(valve, edge, limits) for (valve, edge), limits in found.items()]
