"""In a turn every valve follows its own arc at its own speed: against a fine integration."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.core.boom import STRAIGHT_LATERAL_M_S2, STRAIGHT_YAW_RATE_DEG_S
from companion.core.crossings import find_routes
from companion.core.motion import CRUISE
from companion.core.prescription import Prescription, Zone
from tests.builders import boom, flying

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
