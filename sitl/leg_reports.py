"""What is read from an autopilot of the legs of a simulated flight, without the wire."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from companion.core.frame import LocalFrame
from companion.core.types import LegReport
from sitl.route import Route
from sitl.vehicle import STRAIGHT_DEG

if TYPE_CHECKING:
    from sitl.trajectory import Trajectory

EVERY_S = 0.5  # MISSION_CURRENT is asked for at 2 Hz


def leg_reports(route: Route, trajectory: Trajectory, frame: LocalFrame) -> Iterator[LegReport]:
    """Yield the leg that is flown, twice a second, in the order of time."""
    start_s, end_s = float(trajectory.time_s[0]), float(trajectory.time_s[-1])
    ends = [(route.start_east_m, route.start_north_m)]
    ends += [(leg.east_m, leg.north_m) for leg in route.legs]
    places = [frame.to_geographic(*end) for end in ends]
    step_s = float(trajectory.time_s[1]) - start_s
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
        )


def _bend_deg(ends: list[tuple[float, float]], number: int) -> float:
    """Return the change of course at the end of a leg; 180 at the end of the route."""
    if number + 2 >= len(ends):
        return 180.0
    (e0, n0), (e1, n1), (e2, n2) = ends[number : number + 3]
    turn = math.atan2(e2 - e1, n2 - n1) - math.atan2(e1 - e0, n1 - n0)
    return abs((math.degrees(turn) + 180.0) % 360.0 - 180.0)
