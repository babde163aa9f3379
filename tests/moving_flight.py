"""Flights that change their speed and turn near a border, and a judge of what fell outside.

A way is what a vehicle does: accelerations along its course and turns, each for a time. It is flown
through messages by the twin's plain loop. The judge has the true way, the true strips and what
each valve let out, and shapely; it knows no path that was foretold, no crossing and no order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

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
