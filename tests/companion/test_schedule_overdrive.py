"""A slow flow's changes are driven past their target, and the step still lies on the boundary."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.crossings import Crossing
from companion.core.schedule import LagModel, Overdrive, Timing, orders, schedule
from sitl.knowledge import measured_sets
from sitl.plants import PumpPlant
from sitl.profile import load_profile
from tests.bench.pump import flights

PUMP = load_profile("pump")
CURVE = measured_sets(PUMP)[0].curve
assert PUMP.pump is not None
LAW = Overdrive(
    up_time_s=PUMP.pump.up_s,
    down_time_s=PUMP.pump.down_s,
    duty_min=0.15,
    duty_max=1.0,
    flow_for=CURVE.flow_for,
)
TIMING = Timing(
    on_s=0.05, off_s=0.05, up_s=1.877, down_s=1.355, border_on_s=0.04, border_off_s=0.07,
    dwell_min_s=0.1,
)  # fmt: skip
duties = st.floats(0.2, 0.9)


def dosing(rate_l_ha: float, speed_m_s: float) -> float:
    return rate_l_ha * speed_m_s / 200.0


@given(before=duties, after=duties)
def test_a_drive_goes_the_way_of_its_change_and_saves_less_than_the_time_constant(
    before: float, after: float
) -> None:
    drive = LAW.between(before, after)
    if drive is None:
        assert abs(after - before) < 0.05
        return
    assert (drive.duty > after) == (after > before)
    assert LAW.duty_min <= drive.duty <= LAW.duty_max
    time_s = LAW.up_time_s if after > before else LAW.down_time_s
    assert 0.0 < drive.saved_s < time_s
    # The flow is at its target when the drive ends.
    a, b, u = (CURVE.flow_for(duty) for duty in (before, after, drive.duty))
    assert u + (a - u) * math.exp(-drive.for_s / time_s) == pytest.approx(b, abs=1e-9)


@pytest.mark.parametrize(("before", "after"), [(0.0, 0.5), (0.5, 0.0), (0.5, 0.5), (0.9, 1.0)])
def test_valves_and_changes_without_room_are_not_driven(before: float, after: float) -> None:
    assert LAW.between(before, after) is None


def test_a_flow_that_is_not_slow_is_not_driven() -> None:
    assert replace(LAW, up_time_s=0.0).between(0.4, 0.6) is None


@pytest.mark.parametrize(("before", "after"), [(0.4, 0.52), (0.52, 0.4), (0.3, 0.8), (0.8, 0.3)])
def test_the_volume_equivalent_step_of_a_driven_change_lies_on_its_crossing(
    before: float, after: float
) -> None:
    route = tuple(
        Crossing(at_s, duty * 40.0, False, 5.0) for at_s, duty in ((0.0, before), (30.0, after))
    )
    made = orders(route, TIMING, dosing, LAW)
    assert [order.driven for order in made] == [False, True, False]
    plant = PumpPlant(PUMP, seed=1, start_s=0.0)
    for order in made:
        plant.record_change(max(order.at_s, 1.0), 0, order.duty)
    times_s = np.array([20.0, 25.0, 40.0, 45.0])
    v0, v1, v2, v3 = plant.volume_ml(times_s)[:, 0].tolist()
    slow, fast = (v1 - v0) / 5.0, (v3 - v2) / 5.0
    step_s = (v2 - v1 - fast * 40.0 + slow * 25.0) / (slow - fast)
    # The pump's own table is straight between its points, the controller's curve is not.
    assert step_s == pytest.approx(30.0, abs=0.03)


def test_a_drive_under_way_goes_on_until_its_end_and_is_not_late() -> None:
    route = tuple(Crossing(at_s, rate, False, 5.0) for at_s, rate in ((0.0, 16.0), (30.0, 20.8)))
    _, driven, end = orders(route, TIMING, dosing, LAW)
    middle_s = 0.5 * (driven.at_s + end.at_s)
    found = schedule(
        route, valve=0, timing=TIMING, dosing=dosing, in_force=driven.duty, speed_soon_m_s=5.0,
        now_s=middle_s, until_s=middle_s + 1.0, overdrive=LAW,
    )  # fmt: skip
    assert [(change.at_s, change.duty) for change in found.changes] == [(end.at_s, end.duty)]
    assert not found.late


def test_a_change_that_overtakes_a_driven_one_takes_the_whole_of_its_place() -> None:
    route = tuple(
        Crossing(at_s, rate, False, 5.0) for at_s, rate in ((0.0, 16.0), (30.0, 30.0), (30.2, 10.0))
    )
    made = orders(route, TIMING, dosing, LAW)
    assert all(a.at_s < b.at_s for a, b in pairwise(made))
    assert made[-1].rate_l_ha == 10.0
    assert not made[-1].driven
    # No drive is left without its end.
    assert all(b.rate_l_ha == a.rate_l_ha for a, b in pairwise(made) if a.driven)


@pytest.mark.parametrize("name", ["up_time_s", "down_time_s"])
@pytest.mark.parametrize("value", [-0.1, 2.0, math.nan])
def test_a_time_constant_is_a_part_of_its_lag(name: str, value: float) -> None:
    lag = LagModel(
        on_s=0.1, off_s=0.1, up_s=1.9, down_s=1.4, on_start_s=0.05, off_end_s=0.2, output_s=0.0
    )
    with pytest.raises(ValueError, match=name):
        replace(lag, **{name: value})  # type: ignore[arg-type]


def test_in_gusts_a_pumps_steps_lie_within_half_a_metre() -> None:
    found = flights(PUMP, 1)["scheduled"].lag_distance_m
    assert found.count == 14
    assert (found.mean_abs or 9.0) <= 0.5
