"""Flights that change their speed and turn near a border, and a judge of what fell outside.

A way is what a vehicle does: accelerations along its course and turns, each for a time. It is flown
through messages by the twin's plain loop. The judge has the true way, the true strips and what
each valve let out, and shapely; it knows no path that was foretold, no crossing and no order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from companion.core.types import Decision
from sitl.trajectory import Trajectory

Floats = NDArray[np.float64]

STEP_S = 0.005


class Stretch(NamedTuple):
    """For so long the speed changes by `gain_m_s2`, the course by `turn_deg_s`, and the nose."""

    seconds: float
    gain_m_s2: float = 0.0
    turn_deg_s: float = 0.0
    nose_deg_s: float | None = None  # None: as the course


def way(
    stretches: Sequence[Stretch],
    *,
    speed_m_s: float,
    course_deg: float = 90.0,
    crab_deg: float = 0.0,
    pushed: Floats | None = None,
) -> Trajectory:
    """Return the way from the origin; a speed ends at zero. `pushed` is added (n, 2), of gusts."""
    counts = [round(each.seconds / STEP_S) for each in stretches]

    def spread(values: Sequence[float]) -> Floats:
        return np.repeat(np.array(values, dtype=np.float64), counts)

    gain = spread([each.gain_m_s2 for each in stretches])
    turn = spread([each.turn_deg_s for each in stretches])
    nose = spread(
        [each.turn_deg_s if each.nose_deg_s is None else each.nose_deg_s for each in stretches]
    )

    def summed(rates: Floats) -> Floats:
        return np.concatenate(([0.0], np.cumsum(rates * STEP_S)))

    speed = np.maximum(speed_m_s + summed(gain), 0.0)
    course = np.radians(course_deg + summed(turn))
    east_m_s, north_m_s = speed * np.sin(course), speed * np.cos(course)
    if pushed is not None:
        east_m_s, north_m_s = east_m_s + pushed[:, 0], north_m_s + pushed[:, 1]

    def placed(velocity: Floats) -> Floats:
        return summed(0.5 * (velocity[1:] + velocity[:-1]))

    count = len(speed)
    return Trajectory(
        time_s=np.arange(count) * STEP_S,
        east_m=placed(east_m_s),
        north_m=placed(north_m_s),
        velocity_east_m_s=east_m_s,
        velocity_north_m_s=north_m_s,
        heading_deg=course_deg + crab_deg + summed(nose),
        leg=np.zeros(count, dtype=np.int64),
        height_m=3.5,
    )


@dataclass(frozen=True)
class Outside:
    """What fell outside: how far at most, on how much ground."""

    most_m: float
    area_m2: float


def fell_outside(
    field: shapely.Geometry,
    strips: Sequence[tuple[float, float, float]],
    flown: Trajectory,
    volume_ml: Floats,
    *,
    least_ml_s: float = 0.05,
) -> Outside:
    """Return what fell outside: volumes (n, valves) are cumulative, at the times of `flown`.

    Of each strip: right, forward, width. What flows less than `least_ml_s` has ended.
    """
    area_m2 = most_m = 0.0
    rate = np.diff(volume_ml, axis=0) / np.diff(flown.time_s)[:, None]
    nose = np.radians(flown.heading_deg)
    sin, cos = np.sin(nose), np.cos(nose)
    for valve, (right_m, forward_m, width_m) in enumerate(strips):
        flows = rate[:, valve] > least_ml_s
        both = np.flatnonzero(flows)
        if not len(both):
            continue
        ends = []
        for side_m in (right_m - width_m / 2.0, right_m + width_m / 2.0):
            east = flown.east_m + side_m * cos + forward_m * sin
            north = flown.north_m - side_m * sin + forward_m * cos
            ends.append(np.column_stack((east, north)))
        (a, b) = ends
        quads = shapely.polygons(np.stack((a[both], b[both], b[both + 1], a[both + 1]), axis=1))
        swept = shapely.union_all(quads[shapely.is_valid(quads)])
        area_m2 += float(shapely.difference(swept, field).area)
        lines = shapely.linestrings(np.stack((a[both + 1], b[both + 1]), axis=1))
        beyond = shapely.difference(lines, field)
        for each in beyond[~shapely.is_empty(beyond)]:
            points = shapely.points(shapely.get_coordinates(each))
            most_m = max(most_m, float(shapely.distance(points, field).max()))
    return Outside(most_m, area_m2)


def circle(radius_m: float, speed_m_s: float) -> float:
    """Return the turn [deg/s] that flies a circle of this radius."""
    return math.degrees(speed_m_s / radius_m)


# ------------------------------------------------------------------ ours, and a causal reference

Orders = list[list[tuple[float, float]]]
# Of a valve: from when until when something may flow.
Spans = Sequence[tuple[float, float]]
JUDGED_S = 0.01


def executed(decisions: Sequence[Decision], count: int) -> Orders:
    """Return the changes of the valves that come to pass: each plan's until the next one.

    A plan that has a valve shut from its beginning shuts it: that of an interlock.
    """
    orders: Orders = [[] for _ in range(count)]
    for here, then in pairwise(decisions):
        for own, duty in zip(orders, here.plan.duty, strict=True):
            if duty == 0.0 and own and own[-1][1] > 0.0:
                own.append((here.now_s, 0.0))
        for change in here.plan.changes:
            if change.at_s <= then.now_s:
                orders[change.valve].append((change.at_s, change.duty))
    return orders


class Strip(NamedTuple):
    """A valve's strip beside the position reference, and when its flow begins and ends."""

    right_m: float
    forward_m: float
    width_m: float
    first_s: float
    last_s: float

    def ends(self, east: Floats, north: Floats, nose_deg: Floats) -> Floats:
        """Return both ends (n, 2, 2) of the strip, for places of the reference."""
        sin, cos = np.sin(np.radians(nose_deg)), np.cos(np.radians(nose_deg))
        return np.stack(
            [
                np.column_stack(
                    (
                        east + side_m * cos + self.forward_m * sin,
                        north - side_m * sin + self.forward_m * cos,
                    )
                )
                for side_m in (
                    self.right_m - self.width_m / 2.0,
                    self.right_m + self.width_m / 2.0,
                )
            ],
            axis=1,
        )

    def beyond_m(self, field: shapely.Geometry, flown: Trajectory, spans: Spans) -> float:
        """Return how far outside something fell at most."""
        end_s = float(flown.time_s[-1])
        times = [np.arange(a, min(b, end_s), JUDGED_S) for a, b in spans if min(b, end_s) > a]
        if not times:
            return 0.0
        at = flown.at(np.concatenate(times))
        lines = shapely.linestrings(self.ends(at.east_m, at.north_m, at.heading_deg))
        outside = shapely.get_coordinates(shapely.difference(lines, field))
        away = shapely.distance(shapely.points(outside), field)
        return float(away.max(initial=0.0))


def by_reference(
    field: shapely.Geometry,
    strip: Strip,
    flown: Trajectory,
    at_s: Floats,
    *,
    believed_s: float = STEP_S,
    decisions: int = 0,
) -> list[tuple[float, float]]:
    """Return the orders of who knows the true state, and takes its acceleration for constant.

    At the same times as ours. It closes when the strip would be outside when the flow ends, and
    opens when it would be inside when the flow begins, and then. Its acceleration is the mean over
    `believed_s`; it closes once that has been so for some `decisions` more.
    """
    at = flown.at(at_s)
    # The acceleration and the turn that have been, up to now: nobody knows those to come.
    before = flown.at(at_s - believed_s)
    gain_e = (at.velocity_east_m_s - before.velocity_east_m_s) / believed_s
    gain_n = (at.velocity_north_m_s - before.velocity_north_m_s) / believed_s
    turn = (at.heading_deg - before.heading_deg) / believed_s
    shapely.prepare(field)

    def inside(by_s: float) -> NDArray[np.bool_]:
        ends = strip.ends(
            at.east_m + at.velocity_east_m_s * by_s + 0.5 * gain_e * by_s**2,
            at.north_m + at.velocity_north_m_s * by_s + 0.5 * gain_n * by_s**2,
            at.heading_deg + turn * by_s,
        )
        found: NDArray[np.bool_] = shapely.covers(field, shapely.linestrings(ends))
        return found

    stays, begins = inside(strip.last_s), inside(strip.first_s)
    for _ in range(decisions):
        stays = stays | np.append(True, stays[:-1])
    orders, is_open = [], False
    for time_s, may_stay, may_begin in zip(
        at_s.tolist(), stays.tolist(), begins.tolist(), strict=True
    ):
        wanted = may_stay and (is_open or may_begin)
        if wanted is not is_open:
            orders.append((time_s, float(wanted)))
            is_open = wanted
    return orders
