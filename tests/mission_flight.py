"""Flies the waypoints of a mission by ArduCopter's rule, from its items alone.

Nothing of the planner is imported. Each leg is planned from rest to rest, its jerk in pulses with
raised-cosine flanks, which are integrated in small steps here; the next leg begins as soon as the
middle of the turn lies within the waypoint's radius, below both speeds and the corner's
acceleration (SCurve::advance_target_along_track and AC_WPNav of ArduPilot 4.7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.mission_judge import Plane

Floats = NDArray[np.float64]

# ArduCopter as it comes: WPNAV_ACCEL, WPNAV_JERK, WPNAV_RADIUS; WPNAV_ACCEL_C 0 is twice the first.
# The jerk comes and goes in twice ATC_INPUT_TC of 0.15 s.
ACCELERATION_M_S2, JERK_M_S3, RADIUS_M, FLANK_S = 2.5, 1.0, 2.0, 0.3
CORNER_M_S2 = 2.0 * ACCELERATION_M_S2
STEPS = 400
# Take-off to 3.5 m, and the return at 15 m with 5 s over home and a landing at 0.5 m/s from 10 m,
# timed beside ArduCopter 4.7, the ways over ground not among them.
UPRIGHT_S = 47.0
WAYPOINT, SPLINE, RETURN, LAND, TAKEOFF, CHANGE_SPEED = 16, 82, 20, 21, 22, 178


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """Home, waypoints and home again in metres; the speed of each leg."""

    places: Floats
    speeds_m_s: Floats

    def without_ends(self, *, first: bool, last: bool) -> Way:
        """Return the way without the one from home, or the one back to it."""
        start, end = int(first), len(self.places) - int(last)
        return Way(places=self.places[start:end], speeds_m_s=self.speeds_m_s[start : end - 1])

    @property
    def lengths_m(self) -> Floats:
        found: Floats = np.hypot(*np.diff(self.places, axis=0).T)
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class _SpeedingUp:
    """Way, speed and acceleration at even times of speeding up to `peak_m_s` from rest."""

    peak_m_s: float
    takes_s: float
    way_m: Floats
    speed_m_s: Floats
    gain_m_s2: Floats

    def at(self, after_s: Floats) -> tuple[Floats, Floats, Floats]:
        times = np.linspace(0.0, self.takes_s, STEPS + 1)
        return (
            np.interp(after_s, times, self.way_m),
            np.interp(after_s, times, self.speed_m_s),
            np.interp(after_s, times, self.gain_m_s2),
        )


def _ramp_s(peak_m_s: float) -> tuple[float, float, float]:
    """Return flank, length and steady rest of the jerk's pulses that reach a speed."""
    longest_s = ACCELERATION_M_S2 / JERK_M_S3 + FLANK_S
    if peak_m_s >= ACCELERATION_M_S2 * longest_s:
        return FLANK_S, longest_s, peak_m_s / ACCELERATION_M_S2 - longest_s
    pulse_s = FLANK_S / 2.0 + math.sqrt(FLANK_S**2 / 4.0 + peak_m_s / JERK_M_S3)
    if pulse_s >= 2.0 * FLANK_S:
        return FLANK_S, pulse_s, 0.0
    # Too short for the whole jerk: it comes and goes as fast, and is less.
    snap = JERK_M_S3 * math.pi / (2.0 * FLANK_S)
    flank_s = (peak_m_s * math.pi / (4.0 * snap)) ** (1.0 / 3.0)
    return flank_s, 2.0 * flank_s, 0.0


@lru_cache(maxsize=4096)
def _speeding_up(peak_m_s: float) -> _SpeedingUp:
    flank_s, pulse_s, steady_s = _ramp_s(peak_m_s)
    takes_s = 2.0 * pulse_s + steady_s
    fine = np.linspace(0.0, takes_s, 8 * STEPS + 1)
    step_s = fine[1]
    middle = (fine[1:] + fine[:-1]) / 2.0
    jerk = _pulse(middle, pulse_s, flank_s) - _pulse(middle - pulse_s - steady_s, pulse_s, flank_s)
    gain = np.concatenate([[0.0], np.cumsum(jerk) * step_s])
    speed = np.concatenate([[0.0], np.cumsum((gain[1:] + gain[:-1]) / 2.0) * step_s])
    scale = peak_m_s / speed[-1]
    gain, speed = gain * scale, speed * scale
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2.0) * step_s])
    return _SpeedingUp(
        peak_m_s=peak_m_s, takes_s=takes_s, way_m=way[::8], speed_m_s=speed[::8],
        gain_m_s2=gain[::8],
    )  # fmt: skip


def _pulse(after_s: Floats, pulse_s: float, flank_s: float) -> Floats:
    """Return a pulse of height 1 whose flanks are raised cosines."""
    rises = np.clip(np.minimum(after_s, pulse_s - after_s) / flank_s, 0.0, 1.0)
    found: Floats = (1.0 - np.cos(math.pi * rises)) / 2.0
    return found


@lru_cache(maxsize=65536)
def _leg(length_m: float, speed_m_s: float) -> tuple[_SpeedingUp, float]:
    """Return how a leg speeds up, and what it takes from rest to rest."""
    whole = _speeding_up(speed_m_s)
    if 2.0 * whole.way_m[-1] <= length_m:
        cruise_s = (length_m - 2.0 * float(whole.way_m[-1])) / speed_m_s
        return whole, 2.0 * whole.takes_s + cruise_s
    low, high = 0.0, speed_m_s
    for _ in range(40):
        peak = (low + high) / 2.0
        _, pulse_s, steady_s = _ramp_s(peak)
        # Speeding up and braking are each other's mirror: their mean speed is half of the peak.
        low, high = (low, peak) if peak * (2.0 * pulse_s + steady_s) > length_m else (peak, high)
    # In steps of a millimetre a second: legs of nearly one length share their table.
    found = _speeding_up(max(round(low, 3), 1e-3))
    return found, 2.0 * length_m / found.peak_m_s


def flown_s(way: Way) -> float:
    """Return the time of a way whose last leg is the return, which begins at rest."""
    return float(legs_s(way).sum())


def legs_s(way: Way) -> Floats:
    """Return the time of each leg of a way, what it has together with the one before left out."""
    lengths_m = way.lengths_m
    steps = np.diff(way.places, axis=0)
    found = np.zeros(len(lengths_m))
    # Two waypoints at one place are one.
    apart = lengths_m > 0.01
    lengths_m, steps, speeds = lengths_m[apart], steps[apart], way.speeds_m_s[apart]
    if not len(lengths_m):
        return found
    along = steps / lengths_m[:, None]
    legs = [
        _leg(round(length, 3), round(speed, 3))
        for length, speed in zip(lengths_m.tolist(), speeds.tolist(), strict=True)
    ]
    taken_s = np.array([whole_s for _, whole_s in legs])
    for number in range(len(legs) - 2):
        cosine = float(np.clip(along[number] @ along[number + 1], -1.0, 1.0))
        slower = float(min(speeds[number], speeds[number + 1]))
        taken_s[number + 1] -= _together_s(legs[number], legs[number + 1], cosine, slower)
    found[apart] = taken_s
    return found


def _together_s(
    one: tuple[_SpeedingUp, float], other: tuple[_SpeedingUp, float], cosine: float, slower: float
) -> float:
    """Return how long before its end a leg lets the next one begin."""
    (braking, _), (going, other_s) = one, other
    most_s = min(braking.takes_s, going.takes_s, other_s / 2.0)
    left_s = most_s * np.arange(1, STEPS + 1) / STEPS
    back_m, in_m_s, loss = braking.at(left_s / 2.0)
    on_m, out_m_s, gain = going.at(left_s / 2.0)
    turns = _long(back_m, on_m, -cosine) < RADIUS_M
    turns &= _long(in_m_s, out_m_s, cosine) < slower + 1e-9
    turns &= _long(loss, gain, -cosine) < CORNER_M_S2
    return float(left_s[turns].max(initial=0.0))


def _long(one: Floats, other: Floats, cosine: float) -> Floats:
    found: Floats = np.sqrt(np.maximum(one**2 + other**2 + 2.0 * one * other * cosine, 0.0))
    return found


def way_of(items: Sequence[tuple[int, float, float, float]], plane: Plane, speed_m_s: float) -> Way:
    """Return the way of items (command, second parameter, latitude, longitude) from take-off on."""
    places, speeds = [], []
    for command, second, lat, lon in items:
        if command == CHANGE_SPEED:
            speed_m_s = second
        elif command in (TAKEOFF, WAYPOINT, SPLINE):
            places.append((lon, lat))
            speeds.append(speed_m_s)
        elif command in (RETURN, LAND):
            places.append(places[0])
            speeds.append(speed_m_s)
    return Way(places=plane.metres(np.array(places)), speeds_m_s=np.array(speeds[1:]))


def items_of_plan(content: dict[str, Any]) -> list[tuple[int, float, float, float]]:
    """Return the items of a `.plan`."""
    return [
        (each["command"], each["params"][1] or 0.0, each["params"][4], each["params"][5])
        for each in content["mission"]["items"]
    ]


def items_of_waypoints(text: str) -> list[tuple[int, float, float, float]]:
    """Return the items of a QGC WPL 110, without its home."""
    rows = [line.split("\t") for line in text.splitlines()[2:] if line.strip()]
    return [(int(row[3]), float(row[5]), float(row[8]), float(row[9])) for row in rows]


@dataclass(frozen=True, slots=True, kw_only=True)
class Power:
    """What the aircraft draws, as it is configured; `limit_wh` may be taken in one sortie."""

    hover_w: float
    cruise_w: float
    per_kg_w: float
    limit_wh: float

    def wh(self, *, ground_s: float, way_m: float, speed_m_s: float, litres: float) -> float:
        """Return the use: the way over its speed is cruising, all else is hovering."""
        cruise_s = min(way_m / speed_m_s, ground_s)
        other_s = ground_s - cruise_s + UPRIGHT_S
        drawn = cruise_s * self.cruise_w + other_s * self.hover_w
        return (drawn + (cruise_s + other_s) * litres * self.per_kg_w) / 3600.0


def near(way: Way, within_m: float) -> int:
    """Return how many waypoints are nearer than that to the one before."""
    return int((way.lengths_m[1:-1] < within_m).sum())


def length_m(way: Way) -> float:
    """Return the length of a way."""
    return sum(math.dist(a, b) for a, b in pairwise(way.places.tolist()))
