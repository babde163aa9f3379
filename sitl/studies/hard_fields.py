"""Fields for hard flights: bands or plots whose edges lie askew to the path, along any line.

Places are given along and across the centre line of a `CentreLine`, so that one map serves a
straight pass and an arc.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from shapely import Polygon

from companion.core.prescription import Prescription, Zone
from sitl.trajectory import Floats, Leg, Route, Trajectory
from sitl.vehicle import STEP_S, Vehicle

# The field reaches farther to both sides than a boom of 6 m, so that no strip meets the border
# sideways: an edge there would shut its valve, whatever the zone.
HALF_M = 5.0
OUTERMOST_M = 2.5  # the outermost valves' centres
LEAD_M = 10.0  # from the field's ends to the first and the last edge, under every valve
ACROSS = np.linspace(-HALF_M, HALF_M, 11)
# Changes smaller than 8 % are counted apart; these are not to be mistaken for them.
STEP_MIN = 0.10
TRIES = 50


def edges_of(
    count: int, *, spacing_m: float, slants_deg: Sequence[float]
) -> tuple[list[Floats], float]:
    """Return `count` edges between the field's two ends, those among them, and its length.

    An edge is its place along the line at every one of `ACROSS`. Edge k is `spacing_m` behind the
    one before it and turned by `slants_deg[k]`, in turn, out of the square to the path; clockwise
    is positive.
    """
    slopes = [
        -math.tan(math.radians(slants_deg[number % len(slants_deg)])) for number in range(count)
    ]
    lead_m = LEAD_M + OUTERMOST_M * max(map(abs, slopes))
    length_m = 2.0 * lead_m + (count - 1) * spacing_m
    edges = [np.zeros_like(ACROSS)]
    edges += [
        np.clip(lead_m + number * spacing_m + slope * ACROSS, 0.0, length_m)
        for number, slope in enumerate(slopes)
    ]
    edges.append(np.full_like(ACROSS, length_m))
    return edges, length_m


def bands(line: CentreLine, edges: Sequence[Floats], rates_l_ha: Sequence[float]) -> Prescription:
    """Return the bands between the edges with one rate each."""
    return _field(
        [
            Zone(name=str(number), polygon=_band(line, *pair), rate_l_ha=rate)
            for number, (pair, rate) in enumerate(zip(pairwise(edges), rates_l_ha, strict=True))
        ]
    )


def _band(line: CentreLine, begin_m: Floats, end_m: Floats) -> Polygon:
    """Return the ground between two edges."""
    left = np.linspace(begin_m[0], end_m[0], 15)[1:-1]
    right = np.linspace(begin_m[-1], end_m[-1], 15)[1:-1]
    along_m = np.concatenate((begin_m, right, end_m[::-1], left[::-1]))
    aside = (ACROSS, np.full(len(right), HALF_M), ACROSS[::-1], np.full(len(left), -HALF_M))
    east_m, north_m = line.place(along_m, np.concatenate(aside))
    return Polygon(np.stack((east_m, north_m), axis=1))


def plots(
    line: CentreLine,
    rates_l_ha: Sequence[float],
    *,
    side_m: float,
    turn_deg: float,
    length_m: float,
) -> Prescription:
    """Return square plots in rows and columns, turned, on straight ground; neighbours differ."""
    corners = [(0.0, -HALF_M), (0.0, HALF_M), (length_m, HALF_M), (length_m, -HALF_M)]
    ring = [np.array(part) for part in zip(*corners, strict=True)]
    ground = Polygon(np.stack(line.place(*ring), axis=1))
    middle = ground.centroid
    reach = math.ceil(length_m / side_m / math.sqrt(2.0)) + 1
    zones = []
    for row in range(-reach, reach):
        for column in range(-reach, reach):
            box = shapely.box(
                column * side_m, row * side_m, (column + 1) * side_m, (row + 1) * side_m
            )
            turned = shapely.affinity.rotate(box, -turn_deg, origin=(0.0, 0.0))
            part = shapely.affinity.translate(turned, middle.x, middle.y).intersection(ground)
            if isinstance(part, Polygon) and part.area > 1.0:
                # Two apart in the list along a row, three across: no neighbours are alike.
                rate = rates_l_ha[(2 * column + 3 * row) % len(rates_l_ha)]
                zones.append(Zone(name=f"{row},{column}", polygon=part, rate_l_ha=rate))
    return _field(zones)


def _field(zones: Sequence[Zone]) -> Prescription:
    """Return the map: spraying is allowed where there is a zone."""
    return Prescription(zones)


def drawn_rates(choice: Sequence[float], count: int, *, seed: int) -> list[float]:
    """Return `count` rates at random, each at least a tenth off the one before it."""
    rng = np.random.default_rng(seed)
    rates: list[float] = []
    while len(rates) < count:
        rate = float(rng.choice(choice))
        if not rates or _differ(rate, rates[-1]):
            rates.append(rate)
    return rates


def deliverable_rates(
    edges: Sequence[Floats],
    along_m: Floats,
    speed_m_s: Floats,
    within: tuple[float, float],
    *,
    seed: int,
) -> list[float]:
    """Return rates at random that the speeds over each band leave within the sprayer's range.

    `within` is the least and the greatest rate times speed, L/ha times m/s. Where nothing within
    it is a tenth off the rate before, the end of the range that is farther off is taken.
    """
    rng = np.random.default_rng(seed)
    rates: list[float] = []
    for begin, end in pairwise(edges):
        over = (along_m >= begin.min()) & (along_m <= end.max())
        low = within[0] / float(speed_m_s[over].min())
        high = max(within[1] / float(speed_m_s[over].max()), low)
        drawn = rng.uniform(low, high, size=TRIES).tolist()
        ends = sorted((low, high), key=lambda rate: -abs(rate - rates[-1]) if rates else 0.0)
        rates.append(
            next((rate for rate in drawn if not rates or _differ(rate, rates[-1])), ends[0])
        )
    return rates


def _differ(rate: float, other: float) -> bool:
    return abs(rate - other) >= STEP_MIN * min(rate, other)


# Flights that are hard to predict: along arcs, with a speed that sways, braking over the field.
#
# All of them are the copter of `vehicle.py` on a straight line, whose way along and across the line
# is then laid on another centre line. Along and across are the coordinates of `hard_fields.py` too.

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
