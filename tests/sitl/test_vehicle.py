from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.vehicle import Corners, Leg, Route, Trajectory, Vehicle


def passes(speed_m_s: float = 5.0, count: int = 4) -> Route:
    legs = []
    for i in range(count):
        if i:
            legs.append(
                Leg(east_m=(-15.0, 135.0)[i % 2], north_m=6.0 * i, speed_m_s=2.0, kind="transit")
            )
        legs.append(Leg(east_m=(135.0, -15.0)[i % 2], north_m=6.0 * i, speed_m_s=speed_m_s))
    return Route(start_east_m=-15.0, start_north_m=0.0, legs=tuple(legs), height_m=3.5)


def fly(seed: int = 1, *, gust_m_s: float = 1.0, route: Route | None = None) -> Trajectory:
    return Vehicle(route or passes(), start_s=0.0, seed=seed, gust_m_s=gust_m_s).fly_to_end()


def over_field(flight: Trajectory) -> NDArray[np.bool_]:
    field: NDArray[np.bool_] = (
        (flight.leg % 2 == 0) & (flight.east_m > 0.0) & (flight.east_m < 120.0)
    )
    return field


def test_the_flight_visits_every_point_and_ends_at_the_last() -> None:
    flight = fly()
    for leg in passes().legs:
        way_m = np.hypot(flight.east_m - leg.east_m, flight.north_m - leg.north_m)
        assert way_m.min() < 0.5
    assert math.hypot(flight.east_m[-1] + 15.0, flight.north_m[-1] - 18.0) < 0.5
    assert abs(flight.velocity_east_m_s[-1]) < 0.1


def test_without_gusts_it_flies_its_line_at_its_speed() -> None:
    flight = fly(gust_m_s=0.0)
    field = over_field(flight)
    speed = np.hypot(flight.velocity_east_m_s, flight.velocity_north_m_s)[field]
    assert np.abs(speed - 5.0).max() < 1e-3
    assert np.abs(flight.north_m[field] - 6.0 * (flight.leg[field] // 2)).max() < 1e-3


def test_gusts_disturb_speed_and_line_by_as_much_as_stated() -> None:
    speeds, errors = [], []
    for seed in range(8):
        flight = fly(seed)
        field = over_field(flight)
        speeds.append(np.abs(flight.velocity_east_m_s[field]))
        errors.append(flight.north_m[field] - 6.0 * (flight.leg[field] // 2))
    assert np.std(np.concatenate(speeds)) == pytest.approx(0.15, abs=0.03)
    assert np.std(np.concatenate(errors)) == pytest.approx(0.03, abs=0.01)


def test_position_is_the_integral_of_velocity() -> None:
    flight = fly()
    step_s = np.diff(flight.time_s)
    moved_m = np.cumsum(flight.velocity_east_m_s[1:] * step_s)
    assert np.abs(moved_m - (flight.east_m[1:] - flight.east_m[0])).max() < 0.02


def test_acceleration_is_limited_and_nothing_jumps() -> None:
    flight = fly(gust_m_s=0.0)
    for velocity in (flight.velocity_east_m_s, flight.velocity_north_m_s):
        assert np.abs(np.diff(velocity)).max() <= 2.0 * 2.5 * 0.01 + 1e-9
    assert np.hypot(np.diff(flight.east_m), np.diff(flight.north_m)).max() < 0.06


def test_it_turns_only_when_it_has_braked() -> None:
    flight = fly()
    turning = np.abs(np.diff(flight.heading_deg)) > 1e-9
    speed = np.hypot(flight.velocity_east_m_s, flight.velocity_north_m_s)[1:]
    assert np.abs(np.diff(flight.heading_deg)).max() <= 0.9 + 1e-9
    assert turning.any()
    assert speed[turning].max() < 1.2


def test_the_nose_follows_the_legs_or_stays_where_it_is_told() -> None:
    flight = fly()
    assert np.unique(np.round(flight.heading_deg[over_field(flight)] % 360.0)).tolist() == [
        90.0,
        270.0,
    ]
    held = Vehicle(passes(), start_s=0.0, seed=1, heading=123.0).fly_to_end()
    assert np.unique(held.heading_deg).tolist() == [123.0]


def test_a_change_of_speed_on_a_straight_line_is_flown_without_a_stop() -> None:
    legs = (
        Leg(east_m=50.0, north_m=0.0, speed_m_s=3.0),
        Leg(east_m=100.0, north_m=0.0, speed_m_s=6.0),
    )
    flight = fly(gust_m_s=0.0, route=Route(start_east_m=0.0, start_north_m=0.0, legs=legs))
    middle = (flight.east_m > 20.0) & (flight.east_m < 80.0)
    assert flight.velocity_east_m_s[middle].min() > 2.9


LED: tuple[Corners, ...] = ("ardupilot", "px4")


@pytest.mark.parametrize("corners", LED)
def test_whom_an_autopilot_leads_does_not_stop_and_is_pushed_as_far(corners: Corners) -> None:
    flight = Vehicle(passes(), start_s=0.0, seed=1, corners=corners).fly_to_end()
    step_s = np.diff(flight.time_s)
    for at_m, speeds in (
        (flight.east_m, flight.velocity_east_m_s), (flight.north_m, flight.velocity_north_m_s),
    ):  # fmt: skip
        assert np.abs(np.cumsum(speeds[1:] * step_s) - (at_m[1:] - at_m[0])).max() < 0.02
        assert np.abs(np.diff(at_m)).max() < 0.08
    speed = np.hypot(flight.velocity_east_m_s, flight.velocity_north_m_s)
    assert speed[400:-400].min() > 0.15
    assert np.abs(np.diff(flight.heading_deg)).max() <= 0.6 + 1e-9
    assert flight.leg.tolist() == sorted(flight.leg.tolist())


@pytest.mark.parametrize("corners", LED)
def test_gusts_are_as_large_for_whom_an_autopilot_leads(corners: Corners) -> None:
    legs = (Leg(east_m=0.0, north_m=3000.0, speed_m_s=6.0),)
    route = Route(start_east_m=0.0, start_north_m=0.0, legs=legs)
    flight = Vehicle(route, start_s=0.0, seed=1, corners=corners).fly_to_end()
    cruise = (flight.north_m > 300.0) & (flight.north_m < 2900.0)
    assert flight.velocity_north_m_s[cruise].std() == pytest.approx(0.15, rel=0.15)
    assert flight.east_m[cruise].std() == pytest.approx(0.03, rel=0.3)


@pytest.mark.parametrize("corners", ["stop", *LED])
def test_flying_in_pieces_is_flying_at_once(corners: Corners) -> None:
    whole = Vehicle(passes(), start_s=0.0, seed=3, corners=corners).fly_to_end()
    pieces = Vehicle(passes(), start_s=0.0, seed=3, corners=corners)
    for i in range(500):
        pieces.advance(0.37 * i)
    assert pieces.finished
    again = pieces.trajectory()
    assert np.array_equal(again.east_m, whole.east_m)
    assert np.array_equal(again.heading_deg, whole.heading_deg)


def test_the_truth_at_a_time_lies_on_the_trajectory() -> None:
    vehicle = Vehicle(passes(), start_s=100.0, seed=2)
    flight = vehicle.fly_to_end()
    for time_s in (99.0, 100.0, 110.0037, 131.5, 140.0, 1000.0):
        one, other = vehicle.truth_at(time_s), flight.truth_at(time_s)
        assert one.east_m == pytest.approx(other.east_m, abs=1e-9)
        assert one.north_m == pytest.approx(other.north_m, abs=1e-9)
        assert one.velocity_north_m_s == pytest.approx(other.velocity_north_m_s, abs=1e-9)
        assert one.heading_deg == pytest.approx(other.heading_deg, abs=1e-6)


def test_a_time_not_yet_flown_is_refused() -> None:
    vehicle = Vehicle(passes(), start_s=0.0, seed=2)
    vehicle.advance(5.0)
    vehicle.truth_at(5.0)
    with pytest.raises(ValueError, match="not flown yet"):
        vehicle.truth_at(5.1)


def test_the_seed_decides_the_gusts() -> None:
    assert np.array_equal(fly(1).east_m, fly(1).east_m)
    assert not np.array_equal(fly(1).east_m[:5000], fly(2).east_m[:5000])


def test_wrong_legs_are_refused() -> None:
    with pytest.raises(ValueError, match="speed"):
        Leg(east_m=0.0, north_m=0.0, speed_m_s=math.nan)
    with pytest.raises(ValueError, match="end"):
        Leg(east_m=math.nan, north_m=0.0, speed_m_s=1.0)
    with pytest.raises(ValueError, match="leg"):
        Route(start_east_m=0.0, start_north_m=0.0, legs=())
