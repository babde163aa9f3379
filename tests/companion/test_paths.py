"""A foretold path is where its motion goes: straight ahead at all times, in a turn at its leads."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from companion.core.boom import LEADS_APART_S, predict
from companion.core.crossings import find_routes
from companion.core.motion import YAW_FADE_S
from companion.core.prescription import Prescription, Zone
from companion.core.types import VehicleState
from tests.builders import boom, flying

FINE_S = 1e-4
BOOM = boom(6, forward_m=-0.5)
LEADS_S = st.lists(st.floats(0.02, 5.0), max_size=8).map(lambda leads: tuple(sorted(leads)))


def integrated(state: VehicleState, until_s: float) -> np.ndarray:
    """Return east, north and nose [rad] of the reference in fine steps from now on."""
    times = (np.arange(math.ceil(until_s / FINE_S)) + 0.5) * FINE_S
    kept = np.exp(-times / state.acceleration_fade_s)
    turned = state.yaw_rate_deg_s + state.yaw_gain_deg_s2 * YAW_FADE_S * (
        1.0 - np.exp(-times / YAW_FADE_S)
    )

    def summed(rate: np.ndarray) -> np.ndarray:
        return np.concatenate(([0.0], np.cumsum(rate * FINE_S)))

    def gone(velocity: float, acceleration: float, outrun: float) -> np.ndarray:
        gained = summed(acceleration * kept)
        return summed(velocity + outrun + 0.5 * (gained[1:] + gained[:-1]))

    east = gone(state.velocity_east_m_s, state.acceleration_east_m_s2, state.outrun_east_m_s)
    north = gone(state.velocity_north_m_s, state.acceleration_north_m_s2, state.outrun_north_m_s)
    nose = math.radians(state.heading_deg or 0.0) + np.radians(summed(turned))
    return np.column_stack((state.east_m + east, state.north_m + north, nose))


@given(
    speed_m_s=st.floats(1.0, 10.0), gain=st.floats(-5.0, 5.0), aside=st.floats(-5.0, 5.0),
    fade_s=st.floats(0.5, 3.0), yaw=st.floats(-120.0, 120.0), yaw_gain=st.floats(-200.0, 200.0),
    leads_s=LEADS_S,
)  # fmt: skip
def test_in_a_turn_a_path_is_exact_now_and_at_its_leads_and_says_how_far_off_it_is_between(
    speed_m_s: float, gain: float, aside: float, fade_s: float, yaw: float, yaw_gain: float,
    leads_s: tuple[float, ...],
) -> None:  # fmt: skip
    state = flying(
        10.0, 0.0, velocity_east_m_s=speed_m_s, acceleration_east_m_s2=gain,
        acceleration_north_m_s2=math.copysign(max(abs(aside), 1.01), aside),
        acceleration_fade_s=fade_s, yaw_rate_deg_s=yaw, yaw_gain_deg_s2=yaw_gain,
    )  # fmt: skip
    ahead_s = 1.0 + max(leads_s, default=0.0)
    paths = predict(
        state, BOOM.right_m, BOOM.forward_m, back_s=0.3, ahead_s=ahead_s, leads_s=leads_s
    )
    times = [at_s - 10.0 for at_s in paths.time_s]
    truth = integrated(state, ahead_s + 0.01)
    for lead_s in (0.0, *leads_s):
        knot = min(range(len(times)), key=lambda k: abs(times[k] - lead_s))
        assert abs(times[knot] - lead_s) <= LEADS_APART_S + 1e-9
    checked = sorted({*times[1:], *leads_s, *(0.5 * (a + b) for a, b in pairwise(times[1:]))})
    for at_s in checked:
        index = round(at_s / FINE_S)
        east_m, north_m, nose = truth[index].tolist()
        sin, cos = math.sin(nose), math.cos(nose)
        east = east_m + BOOM.right_m * cos + BOOM.forward_m * sin
        north = north_m - BOOM.right_m * sin + BOOM.forward_m * cos
        chord = min(max(bisect_left(times, at_s) - 1, 0), len(times) - 2)
        off_m = 0.0 if at_s in times else paths.off_m[:, chord]  # type: ignore[index]
        for valve in range(len(BOOM.valves)):
            ends = np.column_stack((paths.east_m[valve], paths.north_m[valve]))[chord : chord + 2]
            away_m = shapely.distance(
                shapely.points(east[valve], north[valve]), shapely.linestrings(ends)
            )
            # A change that fades over the chord is a little more at its beginning.
            allowed = np.broadcast_to(off_m, (6,))[valve] * 1.5 + 0.01
            assert away_m <= allowed, (at_s, valve)


@given(
    speed_m_s=st.floats(2.0, 10.0), gain=st.floats(-5.0, 5.0), fade_s=st.floats(0.5, 3.0),
    due_s=st.floats(0.05, 5.0), slowest_s=st.floats(0.0, 6.0), outrun=st.floats(-0.3, 0.3),
)  # fmt: skip
def test_on_a_straight_path_a_crossing_is_exact_however_far_ahead_one_looks(
    speed_m_s: float, gain: float, fade_s: float, due_s: float, slowest_s: float, outrun: float
) -> None:
    state = flying(
        10.0, 0.0, velocity_east_m_s=speed_m_s, acceleration_east_m_s2=gain,
        acceleration_fade_s=fade_s, outrun_east_m_s=outrun,
    )  # fmt: skip
    truth = integrated(state, due_s + 0.01)[: round(due_s / FINE_S) + 1]
    pace = speed_m_s + outrun + gain * fade_s * (1.0 - math.exp(-due_s / fade_s))
    if not pace > 0.3:
        return
    border_m = float(truth[-1][0])
    zones = [
        Zone(name="a", polygon=shapely.box(-50.0, -50.0, border_m, 50.0), rate_l_ha=20.0),
        Zone(name="b", polygon=shapely.box(border_m, -50.0, 500.0, 50.0), rate_l_ha=25.0),
    ]
    routes = find_routes(
        Prescription(zones), replace(state, heading_deg=90.0), boom(1), back_s=0.2,
        ahead_s=due_s + 0.1 + slowest_s, border="inside", border_buffer_m=0.0, across="centre",
    )  # fmt: skip
    (_, crossing) = routes[0][:2]
    assert crossing.rate_l_ha == 25.0
    assert (crossing.at_s - 10.0 - due_s) * pace == pytest.approx(0.0, abs=2e-3)
    assert crossing.speed_m_s == pytest.approx(pace - outrun, abs=1e-2)


def test_who_brakes_to_a_stand_is_foretold_to_creep_and_not_to_turn_back() -> None:
    state = flying(10.0, 0.0, acceleration_east_m_s2=-5.0, acceleration_fade_s=3.0)
    paths = predict(state, BOOM.right_m, BOOM.forward_m, back_s=0.2, ahead_s=7.0)
    east = paths.middle
    assert [round(x, 2) for x, _ in east][-1] < 5.0
    assert all(b[0] > a[0] for a, b in pairwise(east))
