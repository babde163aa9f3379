"""Ready-made parts for tests: a field of plots, a boom, a state that may spray, messages, plans."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from dataclasses import replace

import shapely

from companion.core.boom import Boom, Valve
from companion.core.frame import LocalFrame
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.prescription import Prescription, Zone
from companion.core.safety import Limits
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.core.types import (
    Fix,
    Method,
    PwmLimits,
    SprayPlan,
    Telemetry,
    TimedChange,
    VehicleState,
)

CURVE = FlowCurve(
    duty=(0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0),
    flow_l_min=(1.476, 3.024, 3.276, 4.62, 5.052, 5.952, 6.096),
)
FRAME = LocalFrame(36.0, 114.5)
LAG = LagModel(
    on_s=0.10, off_s=0.11, up_s=0.104, down_s=0.106, on_start_s=0.085, off_end_s=0.13, output_s=0.01
)


def boom(count: int = 6, width_m: float = 6.0, forward_m: float = 0.0) -> Boom:
    strip = width_m / count
    return Boom(
        width_m=width_m,
        valves=tuple(
            Valve(
                name=str(k + 1),
                right_m=(k + 0.5) * strip - width_m / 2,
                forward_m=forward_m,
                width_m=strip,
            )
            for k in range(count)
        ),
    )


def plots(
    rates: Sequence[Sequence[float]], length_m: float = 12.0, width_m: float = 6.0
) -> list[Zone]:
    """Return plots side by side: rows northwards, columns eastwards, from the origin."""
    return [
        Zone(
            name=f"{row}-{column}",
            polygon=shapely.box(
                column * length_m, row * width_m, (column + 1) * length_m, (row + 1) * width_m
            ),
            rate_l_ha=rate,
        )
        for row, line in enumerate(rates)
        for column, rate in enumerate(line)
    ]


def setup(**change: object) -> Setup:
    """Return a set-up that may spray: one row of plots of 20, 25, 15, 20 L/ha along the east."""
    zones = plots([[20.0, 25.0, 15.0, 20.0]])
    given: dict[str, object] = {
        "frame": FRAME,
        "prescription": Prescription(zones, boundary=shapely.box(0.0, -1.0, 48.0, 7.0)),
        "boom": boom(),
        "nozzle_sets": (NozzleSet(valves=tuple(range(6)), curve=CURVE),),
        "pwm": PwmLimits(
            frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01
        ),
        "lag": LAG,
        "method": Method.SCHEDULED,
        "look_ahead_s": 0.97,
        "limits": Limits(),
    }
    return Setup(**(given | change))  # type: ignore[arg-type]


SPRAYING = VehicleState(
    time_s=10.0,
    east_m=6.0,
    north_m=3.0,
    velocity_east_m_s=5.0,
    velocity_north_m_s=0.0,
    acceleration_east_m_s2=0.0,
    acceleration_north_m_s2=0.0,
    heading_deg=90.0,
    yaw_rate_deg_s=0.0,
    height_m=3.5,
    velocity_known=True,
    position_received_s=10.0,
    position_valid=True,
    checked_speed_m_s=5.0,
    fix=Fix.RTK_FIXED,
    estimator_healthy=True,
    heartbeat_received_s=9.5,
    armed=True,
    mode="AUTO",
    in_air=True,
    wind_m_s=None,
    output_healthy=True,
    enabled=True,
)


def flying(now_s: float, east_m: float, north_m: float = 3.0, **change: object) -> VehicleState:
    """Return `SPRAYING` at another time and place."""
    moved = replace(
        SPRAYING,
        time_s=now_s,
        east_m=east_m,
        north_m=north_m,
        position_received_s=now_s,
        heartbeat_received_s=now_s - 0.2,
    )
    return replace(moved, **change)  # type: ignore[arg-type]


def along(course_deg: float, speed_m_s: float = 5.0) -> dict[str, float]:
    """Return velocity and heading for flying along a course."""
    course = math.radians(course_deg)
    return {
        "velocity_east_m_s": speed_m_s * math.sin(course),
        "velocity_north_m_s": speed_m_s * math.cos(course),
        "heading_deg": course_deg % 360.0,
        "checked_speed_m_s": speed_m_s,
    }


def position(received_s: float, east_m: float, north_m: float, /, **change: object) -> Telemetry:
    """Return the message of a position in the frame of `setup`, eastwards at 5 m/s."""
    latitude, longitude = FRAME.to_geographic(east_m, north_m)
    given: dict[str, object] = {
        "received_s": received_s,
        "boot_s": received_s,
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "relative_altitude_m": 3.5,
        "velocity_north_m_s": 0.0,
        "velocity_east_m_s": 5.0,
        "velocity_down_m_s": 0.0,
        "heading_deg": 90.0,
    }
    return Telemetry(**(given | change))  # type: ignore[arg-type]


def now() -> float:
    """Return the time of the running loop, by which executors act."""
    return asyncio.get_running_loop().time()


def plan(
    sequence: int, *duty: float, changes: tuple[TimedChange, ...] = (), lease_s: float = 2.0
) -> SprayPlan:
    """Return a plan that is issued now."""
    issued_s = now()
    return SprayPlan(
        sequence=sequence,
        issued_s=issued_s,
        duty=duty,
        changes=changes,
        lease_until_s=issued_s + lease_s,
    )
