"""What attitude and accelerometer say between two positions, and when it is not believed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from companion.core.estimator import Track, estimate, observe
from companion.core.motion import SHARE_MIN
from companion.core.options.inertial import (
    GAP_MAX_S,
    GRAVITY_M_S2,
    Inertia,
    Sample,
    gained_over,
    recent_of,
    turned,
)
from companion.core.types import AttitudeReport, ImuReport, Input, Telemetry, VehicleState
from tests import builders
from tests.builders import LAG, setup

LATE_S = 0.031
SETUP = replace(setup(), lag=replace(LAG, position_s=LATE_S))
SWING_S, SWING_M_S2 = 4.0, 1.5


def speed_at(time_s: float) -> float:
    return 5.0 + SWING_M_S2 * SWING_S / math.tau * math.sin(math.tau * time_s / SWING_S)


def place_at(time_s: float) -> float:
    turn = math.tau / SWING_S
    return 5.0 * time_s - SWING_M_S2 / turn**2 * math.cos(turn * time_s)


def felt_at(time_s: float) -> float:
    return SWING_M_S2 * math.cos(math.tau * time_s / SWING_S)


def attitude(boot_s: float, *, pitch: float = 0.0, yaw: float = 90.0) -> AttitudeReport:
    """Return one of a vehicle that flies east."""
    return AttitudeReport(
        received_s=boot_s,
        boot_s=boot_s,
        roll_deg=0.0,
        pitch_deg=pitch,
        yaw_deg=yaw,
        roll_rate_deg_s=0.0,
        pitch_rate_deg_s=0.0,
        yaw_rate_deg_s=0.0,
    )


def imu(boot_s: float, ahead: float, *, right: float = 0.0) -> ImuReport:
    return ImuReport(
        received_s=boot_s,
        boot_s=boot_s,
        forward_m_s2=ahead,
        right_m_s2=right,
        down_m_s2=-GRAVITY_M_S2,
    )


def swinging(hz: float, *, imu_hz: float, sign: float = 1.0, until_s: float = 30.0) -> Track:
    """Return what is heard of a flight whose speed swings; `sign` -1: mounted back to front."""
    track = Track()
    for item in messages(hz, imu_hz, sign, until_s):
        track = observe(track, item, SETUP)
    return track


def messages(hz: float, imu_hz: float, sign: float, until_s: float) -> Iterator[Input]:
    rng = np.random.default_rng(7)
    found: list[Input] = []
    for i in range(round(until_s * hz)):
        sent_s = i / hz
        noise = rng.standard_normal(4) * (0.014, 0.014, 0.03, 0.03)
        true_s = sent_s - LATE_S
        found.append(
            builders.position(
                sent_s,
                place_at(true_s) + noise[0],
                float(noise[1]),
                velocity_east_m_s=speed_at(true_s) + noise[2],
                velocity_north_m_s=float(noise[3]),
                boot_s=sent_s,
            )
        )
    for i in range(round(until_s * imu_hz)):
        sent_s = (i + 0.3) / imu_hz
        found.append(attitude(sent_s))
        found.append(imu(sent_s, sign * felt_at(sent_s) + 0.1 + 0.2 * rng.standard_normal()))
    return iter(sorted(found, key=lambda item: item.received_s))


def speed_errors(hz: float, **how: float) -> list[float]:
    """Return how far off the speed is, at moments all over the last position's time."""
    track, errors, last_s = Track(), [], -1.0
    for item in messages(hz, how.get("imu_hz", 20.0), how.get("sign", 1.0), 40.0):
        if isinstance(item, Telemetry) and item.received_s > 20.0:
            for late_s in (0.3, 0.6, 0.9):
                now_s = last_s + late_s / hz
                state = estimate(track, now_s)
                assert state is not None
                errors.append(state.velocity_east_m_s - speed_at(now_s))
        track = observe(track, item, SETUP)
        last_s = item.received_s if isinstance(item, Telemetry) else last_s
    return errors


def rms(values: list[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values))


def test_between_positions_at_5_hz_the_accelerometer_halves_the_error_of_the_speed() -> None:
    assert rms(speed_errors(5.0)) < 0.5 * rms(speed_errors(5.0, imu_hz=0.001))


def test_one_mounted_back_to_front_changes_nothing() -> None:
    alone, wrong = speed_errors(5.0, imu_hz=0.001), speed_errors(5.0, sign=-1.0)
    assert wrong == alone


def test_one_that_was_wrong_is_not_believed_for_the_next_ten_seconds() -> None:
    track = swinging(10.0, imu_hz=20.0, sign=-1.0, until_s=20.0)
    for item in messages(10.0, 20.0, 1.0, 30.0):
        if item.received_s > 20.0:
            track = observe(track, item, SETUP)
            if item.received_s < 24.0:
                assert track.inertia.share == SHARE_MIN


def test_a_sample_is_newer_than_a_position_of_the_same_time_by_the_estimators_delay() -> None:
    track = swinging(10.0, imu_hz=20.0, until_s=5.0)
    sent_s = max(item.received_s for item in messages(10.0, 20.0, 1.0, 5.0))
    assert track.inertia.samples[-1].at_s == pytest.approx(sent_s + LATE_S, abs=0.05)
    assert track.inertia.samples[-1].at_s > sent_s


def test_a_nose_down_attitude_turns_gravity_away() -> None:
    """A copter that leans at rest against the wind feels gravity alone, upwards."""
    pitch = math.radians(-8.0)
    body = (-GRAVITY_M_S2 * math.sin(-pitch), 0.0, -GRAVITY_M_S2 * math.cos(pitch))
    east, north, up = turned(body, 0.0, pitch, math.radians(30.0))
    assert (east, north, up) == pytest.approx((0.0, 0.0, GRAVITY_M_S2), abs=1e-9)


@pytest.mark.parametrize("yaw_deg", [0.0, 37.0, 200.0, -90.0])
@pytest.mark.parametrize("roll_deg", [0.0, 12.0, -25.0])
def test_turning_agrees_with_the_product_of_three_matrices(yaw_deg: float, roll_deg: float) -> None:
    roll, pitch, yaw = math.radians(roll_deg), math.radians(9.0), math.radians(yaw_deg)
    about_x = [[1, 0, 0], [0, math.cos(roll), -math.sin(roll)], [0, math.sin(roll), math.cos(roll)]]
    about_y = [
        [math.cos(pitch), 0, math.sin(pitch)],
        [0, 1, 0],
        [-math.sin(pitch), 0, math.cos(pitch)],
    ]
    about_z = [[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]]
    north, east, down = np.array(about_z) @ about_y @ about_x @ [1.0, -2.0, 3.0]
    assert turned((1.0, -2.0, 3.0), roll, pitch, yaw) == pytest.approx((east, north, -down))


def test_what_is_gained_is_the_integral_and_adds_up() -> None:
    samples = tuple(Sample(0.05 * i, math.sin(i), 0.3 * i) for i in range(30))
    whole = gained_over(samples, 0.11, 1.27)
    first, second = gained_over(samples, 0.11, 0.7), gained_over(samples, 0.7, 1.27)
    assert whole is not None
    assert first is not None
    assert second is not None
    assert whole.east_m_s == pytest.approx(first.east_m_s + second.east_m_s)
    way_m = first.east_m + first.east_m_s * 0.57 + second.east_m
    assert whole.east_m == pytest.approx(way_m)
    times = np.linspace(0.11, 1.27, 20_001)
    exact = np.trapezoid(
        np.interp(times, [s.at_s for s in samples], [s[1] for s in samples]), times
    )
    assert whole.east_m_s == pytest.approx(exact, abs=1e-6)


def test_nothing_is_said_of_a_time_without_samples() -> None:
    samples = (Sample(0.0, 1.0, 0.0), Sample(0.05, 1.0, 0.0))
    assert gained_over((), 0.0, 0.1) is None
    assert gained_over(samples, -1.0, 0.0) is None
    assert gained_over(samples, 0.0, 0.05 + 2.0 * GAP_MAX_S) is None


def test_a_gap_begins_anew_and_a_copy_is_nothing_new() -> None:
    known = Inertia(attitude=attitude(10.0)).with_imu(imu(10.0, 1.0), 0.0)
    again = known.with_imu(imu(10.0, 5.0), 0.0)
    assert again.samples == known.samples
    later = Inertia(attitude=attitude(11.0), samples=known.samples).with_imu(imu(11.0, 2.0), 0.0)
    assert [sample.at_s for sample in later.samples] == [11.0]


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, 1e30, 16.0])
def test_what_is_no_number_or_no_flight_is_dropped(wrong: float) -> None:
    level = Inertia(attitude=attitude(10.0))
    assert level.with_imu(imu(10.0, wrong), 0.0).samples == ()
    assert level.with_imu(imu(10.0, 0.0, right=wrong), 0.0).samples == ()
    if not abs(wrong) < 100.0:
        bad = Inertia(attitude=attitude(10.0, pitch=wrong))
        assert bad.with_imu(imu(10.0, 0.0), 0.0).samples == ()


def test_an_old_attitude_says_nothing_of_an_acceleration() -> None:
    assert Inertia(attitude=attitude(9.0)).with_imu(imu(10.0, 1.0), 0.0).samples == ()
    assert Inertia().with_imu(imu(10.0, 1.0), 0.0).samples == ()


def test_samples_do_not_pile_up() -> None:
    inertia = Inertia()
    for i in range(2000):
        at_s = 0.005 * i
        inertia = Inertia(attitude=attitude(at_s), samples=inertia.samples)
        inertia = inertia.with_imu(imu(at_s, 0.0), 0.0)
    assert len(inertia.samples) <= 700


def test_without_these_messages_no_bit_of_the_state_changes() -> None:
    """Recorded flights hold on to that; here it is said once more of the very track."""
    track = swinging(10.0, imu_hz=0.001, until_s=10.0)
    assert track.inertia.samples == ()
    assert track.inertia.belief is None
    state = estimate(track, 10.0)
    assert isinstance(state, VehicleState)
    assert state.velocity_east_m_s == track.motion.after(10.0 - track.motion.time_s)[0].velocity_m_s  # type: ignore[union-attr]


def test_a_line_through_the_newest_samples_is_followed_part_of_the_way() -> None:
    samples = tuple(Sample(0.05 * i, 1.0 * i, 2.0) for i in range(7))
    east, north = recent_of(samples)
    assert north == pytest.approx(2.0)
    assert 3.0 < east < 6.0
