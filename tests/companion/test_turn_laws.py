"""In a turn every valve follows its own arc at its own speed: against a fine integration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.core.boom import (
    STRAIGHT_LATERAL_M_S2,
    STRAIGHT_YAW_RATE_DEG_S,
    sweep_at,
    turning_of,
)
from companion.core.controller import Memory, step
from companion.core.crossings import find_routes
from companion.core.estimator import Track, estimate, observe
from companion.core.motion import (
    CRUISE,
    STEADY,
    YAW_FADE_S,
    YAW_RATE_MAX_DEG_S,
    Turning,
    turning,
)
from companion.core.prescription import Prescription, Zone
from tests.builders import boom, flying, position, setup

BEFORE_L_HA, AFTER_L_HA = 20.0, 25.0
PLAIN = Prescription(
    [
        Zone(name="west", polygon=shapely.box(-80.0, -80.0, 0.0, 80.0), rate_l_ha=BEFORE_L_HA),
        Zone(name="east", polygon=shapely.box(0.0, -80.0, 80.0, 80.0), rate_l_ha=AFTER_L_HA),
    ]
)
BOOM = boom(forward_m=0.4)
# What an order looks ahead: a lag of 0.1 s, a message that is 0.1 s old, and as much again.
AHEAD_S = 0.3
FINE_S = 0.0005


def crossing_by_integration(
    valve: int, *, speed_m_s: float, turn_rad_s: float, behind_m: float
) -> tuple[float, float] | None:
    """Return when a valve on its arc reaches the boundary, and how fast it is there."""
    right_m, forward_m = BOOM.valves[valve].right_m, BOOM.valves[valve].forward_m
    times = np.arange(0.0, 2.0, FINE_S)
    course = math.pi / 2 + turn_rad_s * times  # clockwise from north; eastwards at first
    step_m = speed_m_s * np.sin(course) * FINE_S
    middle = -behind_m + np.concatenate(([0.0], np.cumsum(0.5 * (step_m[1:] + step_m[:-1]))))
    east = middle + right_m * np.cos(course) + forward_m * np.sin(course)
    past = np.flatnonzero((east[:-1] <= 0.0) & (east[1:] > 0.0))
    if east[0] > 0.0 or not len(past):
        return None
    i = int(past[0])
    ahead = speed_m_s - turn_rad_s * right_m
    return float(times[i]), math.hypot(ahead, turn_rad_s * forward_m)


@given(
    radius_m=st.floats(8.0, 80.0),
    side=st.sampled_from([1.0, -1.0]),
    speed_m_s=st.floats(2.0, 8.0),
    due_s=st.floats(0.12, AHEAD_S),
)
def test_each_valve_reaches_a_boundary_when_its_own_arc_does(
    radius_m: float, side: float, speed_m_s: float, due_s: float
) -> None:
    turn_rad_s = side * speed_m_s / radius_m
    sideways_m_s2 = speed_m_s * turn_rad_s
    assume(abs(sideways_m_s2) <= 4.0)  # a bank of 22 degrees
    behind_m = speed_m_s * due_s
    state = flying(
        10.0,
        -behind_m,
        0.0,
        velocity_east_m_s=speed_m_s,
        velocity_north_m_s=0.0,
        acceleration_north_m_s2=-sideways_m_s2,  # a turn to the right leads south
        heading_deg=90.0,
        yaw_rate_deg_s=math.degrees(turn_rad_s),
    )
    straight = (
        abs(state.yaw_rate_deg_s) < STRAIGHT_YAW_RATE_DEG_S
        and abs(sideways_m_s2) < STRAIGHT_LATERAL_M_S2
    )
    routes = find_routes(
        PLAIN,
        state,
        BOOM,
        back_s=0.3,
        ahead_s=0.8,
        border="volume",
        border_buffer_m=0.0,
        across="centre",
    )
    for valve, route in enumerate(routes):
        truth = crossing_by_integration(
            valve, speed_m_s=speed_m_s, turn_rad_s=turn_rad_s, behind_m=behind_m
        )
        if truth is None or truth[0] > 2.0 * AHEAD_S:
            continue
        at_s, own_m_s = truth
        found = [crossing for crossing in route if crossing.rate_l_ha == AFTER_L_HA]
        assert len(found) == 1
        # The reference keeps a fading acceleration where the true one turns: of third order.
        bent_m = (abs(turn_rad_s) + 1.0 / CRUISE.fade_s) * abs(sideways_m_s2)
        off_m = 0.005 + bent_m * at_s**3 / 6.0
        if straight:
            # All valves are taken to be as fast as the middle: what the turn adds to an outer one.
            off_m += abs(turn_rad_s * BOOM.valves[valve].right_m) * at_s
        else:
            assert found[0].speed_m_s == pytest.approx(own_m_s, rel=0.06)
        assert abs(found[0].at_s - 10.0 - at_s) * own_m_s <= off_m


def test_the_outer_valve_of_a_turn_is_faster_and_the_straight_ones_are_alike() -> None:
    def speeds(yaw_rate_deg_s: float) -> list[float]:
        state = flying(10.0, -1.0, 0.0, yaw_rate_deg_s=yaw_rate_deg_s)
        routes = find_routes(
            PLAIN, state, BOOM, back_s=0.3, ahead_s=0.8,
            border="volume", border_buffer_m=0.0, across="centre",
        )  # fmt: skip
        return [route[-1].speed_m_s for route in routes]

    right = speeds(20.0)
    assert right == sorted(right, reverse=True)
    assert right[0] - right[-1] == pytest.approx(math.radians(20.0) * 5.0, rel=0.02)
    assert speeds(0.0) == pytest.approx([5.0] * 6)


TURN_S = 3.0


def turn(at_s: float, fastest_deg_s: float) -> tuple[float, float]:
    """Return heading and rate in a turn as copters fly it: it swells, and it dies away."""
    part = 2.0 * math.pi * min(max(at_s, 0.0), TURN_S) / TURN_S
    swept = (part - math.sin(part)) * TURN_S / (2.0 * math.pi)
    return 80.0 + 0.5 * fastest_deg_s * swept, 0.5 * fastest_deg_s * (1.0 - math.cos(part))


@pytest.mark.parametrize(("every_s", "share"), [(0.05, 0.72), (0.1, 0.74), (0.2, 0.95)])
@pytest.mark.parametrize("fastest_deg_s", [60.0, -120.0])
def test_a_turn_is_foretold_better_than_by_holding_what_it_is(
    every_s: float, share: float, fastest_deg_s: float
) -> None:
    track, over = Track(), setup()
    off, held = [], []
    for i in range(round(3.6 / every_s) + 1):
        at_s = i * every_s
        heading_deg = turn(at_s, fastest_deg_s)[0] % 360.0
        told = position(10.0 + at_s, 5.0 * at_s, 0.0, heading_deg=heading_deg)
        track = observe(track, told, over)
        state = estimate(track, 10.0 + at_s)
        assert state is not None
        turned_deg, later = turning_of(state).after(0.3)
        then_deg, then_deg_s = turn(at_s + 0.3, fastest_deg_s)
        now_deg, now_deg_s = turn(at_s, fastest_deg_s)
        off.append((later.rate_deg_s - then_deg_s, turned_deg - (then_deg - now_deg)))
        held.append((now_deg_s - then_deg_s, 0.3 * now_deg_s - (then_deg - now_deg)))
    found, holding = (np.sqrt(np.mean(np.square(each), axis=0)) for each in (off, held))
    # Who holds knows the true rate; what is told knows it only from headings.
    assert (found < share * holding).all()


@given(
    rate_deg_s=st.floats(-90.0, 90.0),
    gain_deg_s2=st.floats(-200.0, 200.0),
    heading_deg=st.floats(0.0, 359.0),
    ahead_s=st.floats(0.05, 0.4),
)
def test_a_valve_is_dosed_by_the_speed_that_it_has_then(
    rate_deg_s: float, gain_deg_s2: float, heading_deg: float, ahead_s: float
) -> None:
    state = flying(
        10.0, 0.0, heading_deg=heading_deg, yaw_rate_deg_s=rate_deg_s, yaw_gain_deg_s2=gain_deg_s2
    )
    speed_m_s = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    # The turn as it is meant: its change fades with YAW_FADE_S. Angles added up in small steps.
    fine_s = ahead_s / 2000.0
    times = (np.arange(2000) + 0.5) * fine_s
    faded = YAW_FADE_S * (1.0 - np.exp(-times / YAW_FADE_S))
    turned_deg = float(np.sum(rate_deg_s + gain_deg_s2 * faded) * fine_s)
    then_deg_s = rate_deg_s + gain_deg_s2 * YAW_FADE_S * (1.0 - math.exp(-ahead_s / YAW_FADE_S))
    nose = math.radians(heading_deg + turned_deg)
    spin = math.radians(then_deg_s)
    sweep = sweep_at(replace(state, mode="LOITER"), ahead_s)
    east, north = state.velocity_east_m_s, state.velocity_north_m_s
    along = east * math.sin(nose) + north * math.cos(nose)
    # Clockwise from north: a place to the right goes back, and so does the nose's own way.
    wanted = [along - spin * valve.right_m for valve in BOOM.valves]
    if max(wanted) < 0.0:  # tail first
        wanted = [-each for each in wanted]
    for found, each in zip(sweep.of(BOOM), wanted, strict=True):
        assert found == pytest.approx(max(each, 0.0), abs=0.01) or abs(max(wanted)) < 0.01
    assert sweep.speed_m_s == pytest.approx(speed_m_s)


@pytest.mark.parametrize(
    ("mode", "heading_deg", "ends"),
    [("AUTO", 80.0, True), ("LOITER", 80.0, False), ("AUTO", 60.0, False), ("AUTO", 91.0, False)],
)
def test_in_a_mission_a_turn_ends_where_the_nose_meets_the_course(
    mode: str, heading_deg: float, ends: bool
) -> None:
    state = flying(10.0, 0.0, heading_deg=heading_deg, yaw_rate_deg_s=60.0, mode=mode)
    east_m_s = state.velocity_east_m_s
    sweep = sweep_at(state, 0.3)
    if ends:
        assert sweep.along_m_s == pytest.approx(east_m_s)
        assert sweep.yaw_rad_s == 0.0
    else:
        nose = math.radians(heading_deg + 18.0)
        assert sweep.along_m_s == pytest.approx(east_m_s * math.sin(nose))
        assert sweep.yaw_rad_s == pytest.approx(math.radians(60.0))


@pytest.mark.parametrize(("gain_deg_s2", "opens"), [(40.0, False), (-40.0, True)])
def test_a_boom_that_swings_at_the_end_of_a_pass_opens_nothing_once_more(
    gain_deg_s2: float, opens: bool
) -> None:
    # 1 m/s, and 50 degrees a second to the right: the right half goes back.
    state = flying(
        10.0, 24.0, 0.0, velocity_east_m_s=1.2, checked_speed_m_s=1.2, yaw_rate_deg_s=50.0,
        yaw_gain_deg_s2=gain_deg_s2,
    )  # fmt: skip
    wide = Prescription(
        [Zone(name="a", polygon=shapely.box(-90, -90, 99, 99), rate_l_ha=20.0)],
        boundary=shapely.box(-95, -95, 100, 100),
    )
    decision, _ = step(setup(prescription=wide), state, Memory(), 10.0)
    duty = decision.plan.duty_at(10.0)
    assert not decision.inhibits
    assert duty[5] == 0.0
    assert (duty[0] > 0.0) is opens


def test_a_heading_that_is_no_number_or_jumps_leaves_no_turn_beyond_what_can_be() -> None:
    assert turning(Turning(20.0, 5.0), 80.0, math.nan, 0.1) == STEADY
    assert turning(Turning(20.0, 5.0), None, 80.0, 0.1) == STEADY
    for heading_deg in (0.0, 90.0, 179.0, 181.0, 359.0):
        found = turning(STEADY, 0.0, heading_deg, 0.02)
        assert abs(found.rate_deg_s) <= YAW_RATE_MAX_DEG_S
        assert math.isfinite(found.gain_deg_s2)


@pytest.mark.parametrize("jump_deg", [73.0, -34.0, 175.0])
def test_a_heading_that_an_estimator_sets_anew_is_no_turn(jump_deg: float) -> None:
    found = turning(Turning(38.0, 4.0), 165.0, (165.0 + jump_deg) % 360.0, 0.1)
    assert found == STEADY
    assert turning(found, 12.0, 15.8, 0.1).rate_deg_s == pytest.approx(36.0, abs=3.0)
    # A turn that begins within one message, as fast as any that is flown, is one.
    assert turning(STEADY, 0.0, 24.0, 0.1).rate_deg_s > 200.0


@pytest.mark.parametrize("gain_deg_s2", [40.0, -40.0])
def test_of_an_open_boom_only_the_valves_that_go_back_close(gain_deg_s2: float) -> None:
    wide = setup(
        prescription=Prescription(
            [Zone(name="a", polygon=shapely.box(-90, -90, 99, 99), rate_l_ha=20.0)],
            boundary=shapely.box(-95, -95, 100, 100),
        )
    )
    slow = {"velocity_east_m_s": 1.2, "checked_speed_m_s": 1.2}
    before, memory = step(wide, flying(10.0, 24.0, 0.0, **slow), Memory(), 10.0)
    assert all(duty > 0.0 for duty in before.plan.duty_at(10.01))
    turned = flying(
        10.05, 24.06, 0.0, yaw_rate_deg_s=50.0, yaw_gain_deg_s2=gain_deg_s2, **slow
    )  # fmt: skip
    decision, _ = step(wide, turned, memory, 10.05)
    duty = decision.plan.duty_at(10.051)
    assert duty[0] > 0.0
    assert duty[5] == 0.0
