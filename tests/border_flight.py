"""Flights over random fields, judged by shapely alone: does anything fall outside?

The judge knows the order of every valve, the two ends of its lag and the vehicle's true way, and
asks of many moments whether the strip touches the outside. It uses no crossing, no contact and no
schedule of the core.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from shapely import Polygon
from shapely.affinity import rotate

from companion.core.controller import Memory, step
from companion.core.setup import Setup
from companion.core.types import SprayPlan, VehicleState
from tests.builders import flying

STEP_S = 0.05
# How finely the way of an open valve is looked at.
SAMPLE_S = 0.005
# What rounding may make of a strip that lies along the border.
TOUCH_M = 1e-3

# Where the vehicle is at a time: east, north, velocity east and north, heading [deg].
Pose = tuple[float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Way:
    """A steady flight: straight on, along a circle, or with a steady change of speed."""

    east_m: float
    north_m: float
    course_deg: float
    speed_m_s: float
    crab_deg: float = 0.0
    turn_deg_s: float = 0.0
    gain_m_s2: float = 0.0

    def at(self, time_s: float) -> Pose:
        """Return where the vehicle is."""
        speed_m_s = self.speed_m_s + self.gain_m_s2 * time_s
        course = math.radians(self.course_deg + self.turn_deg_s * time_s)
        if self.turn_deg_s:
            began, rate = math.radians(self.course_deg), math.radians(self.turn_deg_s)
            east_m = self.speed_m_s / rate * (math.cos(began) - math.cos(course))
            north_m = self.speed_m_s / rate * (math.sin(course) - math.sin(began))
        else:
            way_m = self.speed_m_s * time_s + 0.5 * self.gain_m_s2 * time_s**2
            east_m, north_m = way_m * math.sin(course), way_m * math.cos(course)
        return (
            self.east_m + east_m,
            self.north_m + north_m,
            speed_m_s * math.sin(course),
            speed_m_s * math.cos(course),
            math.degrees(course) + self.crab_deg,
        )

    def turned(self, angle_deg: float) -> Way:
        """Return the same way about the origin, clockwise."""
        angle = math.radians(angle_deg)
        return replace(
            self,
            east_m=self.east_m * math.cos(angle) + self.north_m * math.sin(angle),
            north_m=self.north_m * math.cos(angle) - self.east_m * math.sin(angle),
            course_deg=self.course_deg + angle_deg,
        )

    def state(self, time_s: float) -> VehicleState:
        """Return what a perfect estimate would say."""
        east_m, north_m, east_m_s, north_m_s, heading_deg = self.at(time_s)
        speed_m_s = math.hypot(east_m_s, north_m_s)
        rate = math.radians(self.turn_deg_s)
        along = self.gain_m_s2 / speed_m_s
        return flying(
            time_s, east_m, north_m,
            velocity_east_m_s=east_m_s, velocity_north_m_s=north_m_s,
            acceleration_east_m_s2=along * east_m_s + rate * north_m_s,
            acceleration_north_m_s2=along * north_m_s - rate * east_m_s,
            acceleration_fade_s=1000.0,
            heading_deg=heading_deg % 360.0, yaw_rate_deg_s=self.turn_deg_s,
            checked_speed_m_s=speed_m_s,
        )  # fmt: skip


def orders_of(made: Setup, way: Way, seconds: float) -> list[list[tuple[float, float]]]:
    """Return what each valve is ordered, and when, in a flight through the whole core."""
    return flown_orders(
        made, way, seconds, count=len(made.boom.valves),
        changes=lambda plan: [(c.at_s, c.valve, c.duty) for c in plan.changes],
    )  # fmt: skip


def pump_orders_of(made: Setup, way: Way, seconds: float) -> list[tuple[float, float]]:
    """Return what the pump is ordered, and when."""
    return flown_orders(
        made, way, seconds, count=1,
        changes=lambda plan: [(c.at_s, 0, c.fraction) for c in plan.drives[0].changes],
    )[0]  # fmt: skip


def flown_orders(
    made: Setup,
    way: Way,
    seconds: float,
    *,
    count: int,
    changes: Callable[[SprayPlan], list[tuple[float, int, float]]],
) -> list[list[tuple[float, float]]]:
    """Return the changes that come to pass: each plan's until the next one."""
    memory = Memory()
    orders: list[list[tuple[float, float]]] = [[] for _ in range(count)]
    for number in range(math.ceil(seconds / STEP_S)):
        now_s = number * STEP_S
        decision, memory = step(made, way.state(now_s), memory, now_s)
        assert not decision.inhibits
        for at_s, valve, value in changes(decision.plan):
            if at_s <= (number + 1) * STEP_S:
                orders[valve].append((at_s, value))
    return orders


def flows(
    orders: Iterable[Sequence[Any]], *, first_s: float, last_s: float
) -> list[tuple[float, float]]:
    """Return from when until when something flows, by orders (time, value, ...).

    From the first flow of each opening to its last.
    """
    found = []
    since_s = math.inf
    for at_s, value, *_ in [*orders, (math.inf, 0.0)]:
        if value > 0.0 and since_s == math.inf:
            since_s = at_s
        elif value == 0.0 and since_s < math.inf:
            if at_s + last_s > since_s + first_s:
                found.append((since_s + first_s, at_s + last_s))
            since_s = math.inf
    return found


def spilled_s(
    ground: Polygon,
    way: Way,
    spans: Sequence[tuple[float, float]],
    *,
    right_m: float,
    forward_m: float,
    half_m: float,
    until_s: float,
) -> list[float]:
    """Return the moments at which something flows from a strip that is partly outside."""
    times: list[float] = []
    for since_s, end_s in spans:
        end_s = min(end_s, until_s)
        if end_s - since_s > 2e-6:
            count = max(2, math.ceil((end_s - since_s) / SAMPLE_S))
            times += np.linspace(since_s + 1e-6, end_s - 1e-6, count).tolist()
    if not times:
        return []
    ends = []
    for time_s in times:
        east_m, north_m, _, _, heading_deg = way.at(time_s)
        sin, cos = math.sin(math.radians(heading_deg)), math.cos(math.radians(heading_deg))
        east_m, north_m = east_m + forward_m * sin, north_m + forward_m * cos
        ends.append(
            [(east_m + side * cos, north_m - side * sin)
             for side in (right_m - half_m, right_m + half_m)]
        )  # fmt: skip
    wider = ground.buffer(TOUCH_M)
    shapely.prepare(wider)
    inside = shapely.covers(wider, shapely.linestrings(ends))
    return [time_s for time_s, is_in in zip(times, inside.tolist(), strict=True) if not is_in]


def spilled_by_valve(
    made: Setup, ground: Polygon, way: Way, seconds: float
) -> list[tuple[int, float]]:
    """Return each valve and moment at which something fell outside, in a whole flight."""
    lag = made.lag
    found = []
    for valve, orders in enumerate(orders_of(made, way, seconds)):
        assert all(a[0] <= b[0] for a, b in pairwise(orders))
        spans = flows(
            orders, first_s=lag.output_s + lag.on_start_s, last_s=lag.output_s + lag.off_end_s
        )
        strip = made.boom.valves[valve]
        found += [
            (valve, time_s)
            for time_s in spilled_s(
                ground, way, spans, right_m=strip.right_m, forward_m=strip.forward_m,
                half_m=strip.width_m / 2.0, until_s=seconds,
            )
        ]  # fmt: skip
    return found


@dataclass(frozen=True)
class Ground:
    """A map before it becomes a prescription: strips with rates, holes, and what encloses them."""

    zones: list[tuple[Polygon, float]]
    exclusions: list[Polygon]
    boundary: Polygon | None

    def allowed(self) -> Polygon:
        """Return where something may fall, made here and not by the prescription."""
        ground = self.boundary
        if ground is None:
            ground = shapely.union_all([polygon for polygon, _ in self.zones])
        return ground.difference(shapely.union_all(self.exclusions))

    def turned(self, angle_deg: float) -> Ground:
        """Return the same ground about the origin, clockwise."""

        def moved(polygon: Polygon) -> Polygon:
            return rotate(polygon, -angle_deg, origin=(0.0, 0.0))

        return Ground(
            [(moved(polygon), rate) for polygon, rate in self.zones],
            [moved(polygon) for polygon in self.exclusions],
            None if self.boundary is None else moved(self.boundary),
        )
