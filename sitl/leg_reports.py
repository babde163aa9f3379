"""What is read from an autopilot of the legs of a simulated flight, without the wire."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import shapely

from companion.core.frame import LocalFrame
from companion.core.types import LegReport
from sitl.route import Route
from sitl.vehicle import STRAIGHT_DEG

if TYPE_CHECKING:
    from sitl.trajectory import Trajectory

EVERY_S = 0.5  # MISSION_CURRENT is asked for at 2 Hz
# A leg lies on another where both of its ends are so near to it, and it is so much shorter.
ON_M, LONGER_M = 0.5, 1.0


def leg_reports(route: Route, trajectory: Trajectory, frame: LocalFrame) -> Iterator[LegReport]:
    """Yield the leg that is flown, twice a second, in the order of time."""
    start_s, end_s = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    ends = [(route.start_east_m, route.start_north_m)]
    ends += [(leg.east_m, leg.north_m) for leg in route.legs]
    places = [frame.to_geographic(*end) for end in ends]
    step_s = float(trajectory.time_s[1]) - start_s
    longer = [_longer(ends, number) for number in range(len(route.legs))]
    for count in range(math.floor((end_s - start_s) / EVERY_S) + 1):
        now_s = start_s + EVERY_S * count
        number = int(trajectory.leg[min(int((now_s - start_s) / step_s), len(trajectory.leg) - 1)])
        yield LegReport(
            received_s=now_s,
            from_latitude_deg=places[number][0],
            from_longitude_deg=places[number][1],
            to_latitude_deg=places[number + 1][0],
            to_longitude_deg=places[number + 1][1],
            stops=_bend_deg(ends, number) >= STRAIGHT_DEG,
            speed_m_s=route.legs[number].speed_m_s,
            longer=None if (on := longer[number]) is None else (places[on], places[on + 1]),
        )


def _longer(ends: list[tuple[float, float]], number: int) -> int | None:
    """Return the shortest other leg on which a leg lies whole; None where it lies on none."""
    legs = shapely.linestrings(list(pairwise(ends)))
    length_m = shapely.length(legs)
    near = [shapely.distance(legs, shapely.Point(end)) <= ON_M for end in ends[number : number + 2]]
    found = np.flatnonzero(near[0] & near[1] & (length_m >= length_m[number] + LONGER_M))
    return None if found.size == 0 else int(found[length_m[found].argmin()])


def _bend_deg(ends: list[tuple[float, float]], number: int) -> float:
    """Return the change of course at the end of a leg; 180 at the end of the route."""
    if number + 2 >= len(ends):
        return 180.0
    (e0, n0), (e1, n1), (e2, n2) = ends[number : number + 3]
    turn = math.atan2(e2 - e1, n2 - n1) - math.atan2(e1 - e0, n1 - n0)
    return abs((math.degrees(turn) + 180.0) % 360.0 - 180.0)
