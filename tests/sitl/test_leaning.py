"""How the simulated copter leans, and that the companion hears its acceleration over the wire."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.options.inertial import Inertia
from companion.core.types import AttitudeReport, ImuReport
from companion.link.codec import Codec
from sitl.stub.firmware import Autopilot
from sitl.stub.streams import attitude, highres_imu, scaled_imu
from sitl.trajectory import Truth
from sitl.vehicle import AIR_DRAG_1_S, GRAVITY_M_S2, MEAN_S, Leaning, leaning

HEADING_DEG = 130.0
EAST_M_S2, NORTH_M_S2 = 1.8, -0.7


def moving(time_s: float, *, heading_deg: float = HEADING_DEG) -> Truth:
    return Truth(
        time_s=time_s,
        east_m=0.0,
        north_m=0.0,
        height_m=3.0,
        velocity_east_m_s=3.0 + EAST_M_S2 * time_s,
        velocity_north_m_s=-4.0 + NORTH_M_S2 * time_s,
        heading_deg=heading_deg,
    )


def leans(time_s: float) -> Leaning:
    return leaning(moving(time_s - MEAN_S), moving(time_s), MEAN_S)


def test_at_rest_it_is_level_and_feels_one_g_upwards() -> None:
    still = Truth(
        time_s=0.0,
        east_m=0.0,
        north_m=0.0,
        height_m=3.0,
        velocity_east_m_s=0.0,
        velocity_north_m_s=0.0,
        heading_deg=HEADING_DEG,
    )
    found = leaning(still, still, MEAN_S)
    assert (found.roll_rad, found.pitch_rad) == (0.0, 0.0)
    assert found.felt_m_s2 == pytest.approx((0.0, 0.0, -GRAVITY_M_S2))


def test_at_a_steady_speed_it_leans_forward_against_the_air() -> None:
    found = leaning(moving(0.0, heading_deg=143.13), moving(0.0, heading_deg=143.13), MEAN_S)
    assert math.degrees(found.pitch_rad) == pytest.approx(
        -math.degrees(math.atan(AIR_DRAG_1_S * 5.0 / GRAVITY_M_S2)), abs=1e-3
    )
    assert found.felt_m_s2[0] < 0.0  # the drag


@pytest.mark.parametrize("builder", [scaled_imu, highres_imu])
def test_the_companion_hears_the_true_acceleration(builder: Any) -> None:
    stub = cast("Autopilot", SimpleNamespace(boot_ms=lambda now_s: int(now_s * 1e3), leaning=leans))
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    codec = Codec()
    codec.decode(mavlink.MAVLink_heartbeat_message(2, 3, 129, 3, 4, 3).pack(sender), 1.0)
    inertia = Inertia()
    for build in (attitude, builder):
        (item,) = codec.decode(build(stub, 1.0).pack(sender), 1.0)
        if isinstance(item, AttitudeReport):
            inertia = Inertia(attitude=item)
        else:
            assert isinstance(item, ImuReport)
            inertia = inertia.with_imu(item, 0.0)
    (sample,) = inertia.samples
    assert sample.at_s == 1.0
    assert (sample.east_m_s2, sample.north_m_s2) == pytest.approx((EAST_M_S2, NORTH_M_S2), abs=0.02)
