"""Braking for the end of a leg: foreseen where the mission says so, and only there."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.boom import predict
from companion.core.braking import (
    Approach,
    StoppingLeg,
    approach,
    braking_begins_s,
    learned,
    leg_of,
    speed_after,
    stop_ahead,
)
from companion.core.controller import Memory, step
from companion.core.estimator import Track, estimate, observe
from companion.core.setup import Setup
from companion.core.types import (
    HeartbeatReport,
    LegReport,
    StopAhead,
    VehicleState,
)
from tests.builders import flying, position, setup

NAN = math.nan
SETUP = setup(mission_braking_m_s2=2.5)
# Eastwards from 0 to 30 m, on the line of `flying`.
LEG = StoppingLeg(
    received_s=10.0,
    to_east_m=30.0,
    to_north_m=3.0,
    unit_east=1.0,
    unit_north=0.0,
    length_m=30.0,
    braking_m_s2=2.5,
)


def stop(
    leg: StoppingLeg = LEG,
    *,
    place: tuple[float, float] = (20.0, 3.0),
    velocity: tuple[float, float] = (5.0, 0.0),
    slowing_m_s2: float = 0.0,
    now_s: float = 10.5,
) -> StopAhead | None:
    seen = approach(
        leg, place=place, velocity=velocity, acceleration=(-slowing_m_s2, 0.0), now_s=now_s
    )
    return None if seen is None else stop_ahead(leg.braking_m_s2, seen)


def report(**change: object) -> LegReport:
    latitude, longitude = SETUP.frame.to_geographic(0.0, 3.0)
    to_latitude, to_longitude = SETUP.frame.to_geographic(30.0, 3.0)
    given_: dict[str, object] = {
        "received_s": 10.0,
        "from_latitude_deg": latitude,
        "from_longitude_deg": longitude,
        "to_latitude_deg": to_latitude,
        "to_longitude_deg": to_longitude,
        "stops": True,
    }
    return LegReport(**(given_ | change))  # type: ignore[arg-type]


def test_a_stop_lies_at_the_legs_end_along_the_track() -> None:
    assert stop(place=(20.0, 4.0)) == StopAhead(distance_m=10.0, braking_m_s2=2.5)


@pytest.mark.parametrize(
    ("place", "velocity", "now_s"),
    [
        ((20.0, 6.1), (5.0, 0.0), 10.5),  # beside the leg
        ((20.0, -0.1), (5.0, 0.0), 10.5),
        ((30.1, 3.0), (5.0, 0.0), 10.5),  # past its end
        ((-3.1, 3.0), (5.0, 0.0), 10.5),  # not on it yet
        ((20.0, 3.0), (4.8, 1.4), 10.5),  # on another course: 16 degrees
        ((20.0, 3.0), (-5.0, 0.0), 10.5),
        ((20.0, 3.0), (0.2, 0.0), 10.5),  # standing
        ((27.0, 3.0), (5.0, 0.0), 10.5),  # too fast to stop there: 4.2 m/s2
        ((20.0, 3.0), (5.0, 0.0), 13.01),  # stale
        ((20.0, 3.0), (5.0, 0.0), 9.9),  # from the future
        ((NAN, 3.0), (5.0, 0.0), 10.5),
        ((20.0, NAN), (5.0, 0.0), 10.5),
        ((20.0, 3.0), (NAN, 0.0), 10.5),
        ((20.0, 3.0), (5.0, NAN), 10.5),
        ((20.0, 3.0), (5.0, 0.0), NAN),
    ],
)
def test_a_vehicle_that_is_not_about_to_stop_there_has_no_stop_ahead(
    place: tuple[float, float], velocity: tuple[float, float], now_s: float
) -> None:
    assert stop(place=place, velocity=velocity, now_s=now_s) is None


def test_braking_that_has_begun_is_as_hard_as_the_way_left_asks_for() -> None:
    hard = stop(place=(26.0, 3.0), slowing_m_s2=2.5)
    soft = stop(place=(22.0, 3.0), slowing_m_s2=1.5)
    assert hard is not None
    assert soft is not None
    assert hard.braking_m_s2 == pytest.approx(25.0 / 8.0)
    assert soft.braking_m_s2 == pytest.approx(25.0 / 16.0)


def test_braking_that_is_late_is_not_foreseen_before_it_is_seen() -> None:
    late = stop(place=(25.6, 3.0))  # 2.84 m/s2 is asked for
    assert late is not None
    assert late.braking_m_s2 == pytest.approx(25.0 / 8.8)
    assert stop(place=(26.0, 3.0)) is None  # 3.1 m/s2


def test_the_braking_is_learned_from_the_ramps_that_are_seen() -> None:
    ramp = Approach(distance_m=3.0, speed_m_s=4.5, needed_m_s2=3.4, slowing_m_s2=3.2)
    usual = 2.5
    for _ in range(40):
        usual = learned(2.5, usual, ramp)
    assert usual == pytest.approx(3.4, abs=0.02)


@pytest.mark.parametrize(
    "change",
    [
        {"slowing_m_s2": 1.0},  # not braking yet
        {"slowing_m_s2": 9.0},  # for something else
        {"needed_m_s2": 0.9, "slowing_m_s2": 0.9},
        {"needed_m_s2": 4.1, "slowing_m_s2": 4.0},
        {"speed_m_s": 1.4},
        {"needed_m_s2": NAN},
        {"slowing_m_s2": NAN},
        {"speed_m_s": NAN},
    ],
)
def test_nothing_is_learned_from_what_is_no_even_ramp(change: dict[str, float]) -> None:
    ramp = Approach(distance_m=3.0, speed_m_s=4.5, needed_m_s2=3.4, slowing_m_s2=3.2)
    assert learned(2.5, 2.6, ramp._replace(**change)) == 2.6
    assert learned(2.5, 2.6, None) == 2.6


def test_what_is_slowing_down_for_no_stop_is_not_taken_for_braking() -> None:
    far = stop(place=(10.0, 3.0), slowing_m_s2=2.0)
    gust = stop(place=(22.0, 3.0), slowing_m_s2=0.8)
    assert far is not None
    assert gust is not None
    assert far.braking_m_s2 == gust.braking_m_s2 == 2.5


@pytest.mark.parametrize(
    "change",
    [
        {"stops": False},
        {"received_s": NAN},
        {"to_latitude_deg": NAN},
        {"from_longitude_deg": NAN},
        {"to_latitude_deg": 91.0},
        {"from_longitude_deg": -181.0},
    ],
)
def test_a_report_of_no_use_is_no_leg(change: dict[str, object]) -> None:
    assert leg_of(report(**change), SETUP.frame, 2.5) is None


def test_a_leg_without_length_is_none() -> None:
    same = report(to_latitude_deg=report().from_latitude_deg)
    same = replace(same, to_longitude_deg=same.from_longitude_deg)
    assert leg_of(same, SETUP.frame, 2.5) is None


def test_a_report_becomes_the_leg_in_the_flights_frame() -> None:
    leg = leg_of(report(), SETUP.frame, 2.5)
    assert leg is not None
    assert (leg.to_east_m, leg.to_north_m) == pytest.approx((30.0, 3.0), abs=1e-4)
    assert (leg.unit_east, leg.unit_north, leg.length_m) == pytest.approx(
        (1.0, 0.0, 30.0), abs=1e-4
    )
    assert leg_of(report(), SETUP.frame, None) is None


@given(
    distance_m=st.floats(0.1, 40.0),
    speed=st.floats(0.5, 12.0),
    braking=st.floats(0.5, 6.0),
    dt_s=st.floats(0.0, 3.0),
)
def test_speed_never_exceeds_what_can_still_be_stopped(
    distance_m: float, speed: float, braking: float, dt_s: float
) -> None:
    braking = max(braking, speed**2 / (2.0 * distance_m))
    ahead = StopAhead(distance_m=distance_m, braking_m_s2=braking)
    steps = 400
    speeds = [speed_after(ahead, speed, 0.0, 0.5, dt_s * k / steps) for k in range(steps + 1)]
    assert all(b <= a + 1e-9 for a, b in pairwise(speeds))
    way_m = 0.0
    for a, b in pairwise(speeds):
        way_m += 0.5 * (a + b) * dt_s / steps
        left_m = max(distance_m - way_m, 0.0)
        assert b <= max(0.2, math.sqrt(2.0 * braking * left_m)) + 0.05 * braking


def test_braking_begins_where_the_way_left_is_the_way_it_takes() -> None:
    ahead = StopAhead(distance_m=7.5, braking_m_s2=2.5)
    assert braking_begins_s(ahead, 5.0, 0.0, 0.5, 1.0) == pytest.approx(0.5)
    assert braking_begins_s(ahead, 5.0, 0.0, 0.5, 0.4) is None
    later = braking_begins_s(ahead, 5.0, -1.0, 3.0, 2.0)
    assert later is not None
    speed = 5.0 - 3.0 * (1 - math.exp(-later / 3))
    way = 5.0 * later - 3.0 * (later - 3.0 * (1 - math.exp(-later / 3)))
    assert speed**2 == pytest.approx(5.0 * (7.5 - way), abs=0.02)


def paths_east(state: VehicleState) -> tuple[list[float], list[float], list[float]]:
    paths = predict(state, np.zeros(1), np.zeros(1), back_s=0.2, ahead_s=1.0)
    times = [t - state.time_s for t in paths.time_s]
    return times, paths.east_m[0].tolist(), paths.speed_m_s[0].tolist()


def test_the_predicted_path_brakes_before_its_stop() -> None:
    state = flying(10.0, 20.0, stop_ahead=StopAhead(distance_m=7.5, braking_m_s2=2.5))
    times, east, pace = paths_east(state)
    assert times == pytest.approx([-0.2, 0.5, 1.0])
    assert east == pytest.approx([19.0, 22.5, 22.5 + 5.0 * 0.5 - 1.25 * 0.25])
    assert pace == pytest.approx([5.0, 5.0, 3.75])


def test_the_predicted_path_creeps_on_where_it_would_stand() -> None:
    state = flying(10.0, 20.0, stop_ahead=StopAhead(distance_m=0.2, braking_m_s2=2.5))
    state = replace(state, velocity_east_m_s=1.0)
    times, east, pace = paths_east(state)
    assert times == pytest.approx([-0.2, 0.0, 0.32, 1.0])
    assert pace == pytest.approx([1.0, 1.0, 0.2, 0.2])
    assert east[-1] == pytest.approx(20.0 + 0.6 * 0.32 + 0.2 * 0.68)


def test_a_stop_beyond_the_path_changes_nothing() -> None:
    far = flying(10.0, 20.0, stop_ahead=StopAhead(distance_m=40.0, braking_m_s2=2.5))
    assert paths_east(far) == paths_east(replace(far, stop_ahead=None))


def change_at_s(over: Setup, state: VehicleState) -> float:
    """Return when the change to the next plot is ordered, seen from two steps."""
    memory = Memory()
    _, memory = step(over, replace(state, time_s=9.95, position_received_s=9.95), memory, 9.95)
    decision, _ = step(over, state, memory, 10.0)
    return min(change.at_s for change in decision.plan.changes if change.restart)


def test_a_crossing_in_the_ramp_is_ordered_later() -> None:
    # The boundary at 24 m, 1.5 m ahead; from here on the vehicle brakes.
    state = flying(10.0, 22.5)
    braking = replace(state, stop_ahead=StopAhead(distance_m=5.0, braking_m_s2=2.5))
    crossing_s = 2.0 - math.sqrt(4.0 - 2.0 * 1.5 / 2.5)
    expected = crossing_s - 1.5 / 5.0
    assert change_at_s(SETUP, braking) - change_at_s(SETUP, state) == pytest.approx(
        expected, abs=2e-3
    )


def heard(over: Setup, *more: LegReport, mode: str = "AUTO") -> VehicleState:
    track = Track()
    beat = HeartbeatReport(received_s=9.0, autopilot="ardupilot", armed=True, mode=mode)
    track = observe(track, beat, over)
    for count in range(20):
        now_s = 9.5 + 0.05 * count
        track = observe(track, position(now_s, 15.0 + 0.25 * count, 3.0), over)
    for item in more:
        track = observe(track, item, over)
    state = estimate(track, 10.5)
    assert state is not None
    return state


@pytest.mark.parametrize("mode", ["AUTO", "MISSION"])
def test_a_report_of_a_leg_reaches_the_state(mode: str) -> None:
    ahead = heard(SETUP, report(), mode=mode).stop_ahead
    assert ahead is not None
    assert ahead.distance_m == pytest.approx(30.0 - 20.0, abs=0.1)


def test_a_mission_that_is_not_flown_is_not_used() -> None:
    assert heard(SETUP, report(), mode="LOITER").stop_ahead is None


def test_the_newest_leg_counts() -> None:
    assert heard(SETUP, report(), report(stops=False)).stop_ahead is None


def test_without_the_setting_a_leg_changes_nothing() -> None:
    assert heard(setup(), report()) == heard(setup())


@pytest.mark.parametrize("braking", [0.0, -1.0, NAN, 21.0])
def test_a_braking_that_no_vehicle_has_is_refused(braking: float) -> None:
    with pytest.raises(ValueError, match="mission_braking_m_s2"):
        setup(mission_braking_m_s2=braking)
