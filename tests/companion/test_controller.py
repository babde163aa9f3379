"""A step of the core orders each change ahead of its crossing by that change's own lag."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from companion.core.controller import Memory, step
from companion.core.crossings import Across, find_routes
from companion.core.nozzle import FlowCurve, NozzleSet, flow_for_rate
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.core.types import Method, SprayPlan, TimedChange, VehicleState
from tests.builders import CURVE, LAG, along, boom, flying, plots, setup

SPEED = 5.0


def duty_of(rate: float, speed: float = SPEED) -> float:
    return CURVE.duty_for(flow_for_rate(rate, speed, 6.0))


def fly(
    given: Setup, start_m: float, end_m: float, *, north_m: float = 3.0, hz: float = 20.0
) -> list[TimedChange]:
    """Return the changes that an executor would carry out on the way east at 5 m/s."""
    memory = Memory()
    done: list[TimedChange] = []
    pending: list[TimedChange] = []
    steps = int((end_m - start_m) / SPEED * hz)
    for i in range(steps):
        now = 10.0 + i / hz
        done += [change for change in pending if change.at_s <= now]
        state = flying(now, start_m + SPEED * i / hz, north_m)
        decision, memory = step(given, state, memory, now)
        assert decision.plan.lease_until_s > now
        pending = list(decision.plan.changes)
    return done


def crossing_s(at_m: float, start_m: float) -> float:
    return 10.0 + (at_m - start_m) / SPEED


def test_each_kind_of_change_is_ordered_ahead_by_its_own_lag() -> None:
    start = 6.0
    done = [change for change in fly(setup(), start, 45.0) if change.valve == 2 and change.restart]
    first, up, down, up_again = done
    assert first.at_s == 10.0
    assert up.at_s == pytest.approx(crossing_s(12.0, start) - LAG.up_s - LAG.output_s, abs=1e-6)
    assert down.at_s == pytest.approx(crossing_s(24.0, start) - LAG.down_s - LAG.output_s, abs=1e-6)
    assert up_again.at_s == pytest.approx(
        crossing_s(36.0, start) - LAG.up_s - LAG.output_s, abs=1e-6
    )
    assert [change.duty for change in done] == pytest.approx(
        [duty_of(20.0), duty_of(25.0), duty_of(15.0), duty_of(20.0)]
    )


def test_on_and_off_inside_the_field_have_lags_of_their_own() -> None:
    field = Prescription(plots([[20.0, 0.0, 25.0]]), boundary=shapely.box(0, -1, 36, 7))
    done = [c for c in fly(setup(prescription=field), 6.0, 32.0) if c.valve == 0]
    _, off, on = done
    assert off.duty == 0.0
    assert off.at_s == pytest.approx(crossing_s(12.0, 6.0) - LAG.off_s - LAG.output_s, abs=1e-6)
    assert on.at_s == pytest.approx(crossing_s(24.0, 6.0) - LAG.on_s - LAG.output_s, abs=1e-6)


def test_at_the_border_nothing_falls_outside() -> None:
    start = -10.0
    done = [c for c in fly(setup(border_buffer_m=0.1), start, 60.0) if c.valve == 1 and c.restart]
    on, off = done[0], done[-1]
    assert on.at_s == pytest.approx(crossing_s(0.1, start) - LAG.on_start_s - 0.01, abs=1e-6)
    assert off.duty == 0.0
    assert off.at_s == pytest.approx(crossing_s(47.9, start) - LAG.off_end_s - 0.01, abs=1e-6)


def test_the_volume_border_is_treated_as_any_boundary() -> None:
    start = -10.0
    done = [c for c in fly(setup(border="volume"), start, 60.0) if c.valve == 1 and c.restart]
    assert done[0].at_s == pytest.approx(crossing_s(0.0, start) - LAG.on_s - 0.01, abs=1e-6)
    assert done[-1].at_s == pytest.approx(crossing_s(48.0, start) - LAG.off_s - 0.01, abs=1e-6)


@pytest.mark.parametrize(("method", "lead"), [(Method.NONE, 0.0), (Method.LOOK_AHEAD, 0.97)])
def test_the_older_methods_have_one_lead_for_every_change(method: Method, lead: float) -> None:
    done = [c for c in fly(setup(method=method), 6.0, 40.0) if c.valve == 3 and c.restart]
    assert [c.at_s for c in done[1:3]] == pytest.approx(
        [crossing_s(12.0, 6.0) - lead, crossing_s(24.0, 6.0) - lead], abs=1e-6
    )


def test_settled_reference_puts_the_end_of_the_rise_on_the_boundary() -> None:
    given = setup(lag=replace(LAG, reference="settled"))
    done = [c for c in fly(given, 6.0, 20.0) if c.valve == 3 and c.restart]
    lead = LAG.up_s + (LAG.on_s - LAG.on_start_s) + LAG.output_s
    assert done[1].at_s == pytest.approx(crossing_s(12.0, 6.0) - lead, abs=1e-6)


def test_a_strip_that_touches_the_outside_stays_closed() -> None:
    memory = Memory()
    decision, _ = step(setup(), flying(10.0, 24.0, north_m=5.0), memory, 10.0)
    duty = decision.plan.duty_at(10.0)
    # The boom reaches from north 8 (left) to 2; the boundary lies at 7, its buffer at 6.9.
    assert [value > 0.0 for value in duty] == [False, False, True, True, True, True]


def test_flying_backwards_keeps_each_valve_on_its_side() -> None:
    state = flying(10.0, 24.0, north_m=5.0, heading_deg=270.0)
    decision, _ = step(setup(), state, Memory(), 10.0)
    duty = decision.plan.duty_at(10.0)
    assert [value > 0.0 for value in duty] == [True, True, True, True, False, False]


def test_the_heading_and_not_the_course_turns_the_boom() -> None:
    # Course east, nose 40 degrees off: the left end of the boom is 2.5 * sin(40) m behind.
    state = flying(10.0, 10.0, heading_deg=130.0)
    given = setup()
    routes = step(given, state, Memory(), 10.0)[1].routes.routes
    ahead = [route[1].at_s - 10.0 for route in routes]
    offset = [valve.right_m * math.cos(math.radians(130.0)) for valve in given.boom.valves]
    assert ahead == pytest.approx([(2.0 - east) / SPEED for east in offset], abs=1e-9)


def test_skewed_boom_is_dosed_by_its_width_across_the_motion() -> None:
    straight, _ = step(setup(), flying(10.0, 6.0), Memory(), 10.0)
    skewed, _ = step(setup(), flying(10.0, 6.0, heading_deg=120.0), Memory(), 10.0)
    ratio = skewed.flow_l_min / straight.flow_l_min
    assert ratio == pytest.approx(math.cos(math.radians(30.0)), rel=1e-3)


def test_a_braking_aircraft_is_dosed_by_the_speed_to_come() -> None:
    steady, _ = step(setup(), flying(10.0, 6.0), Memory(), 10.0)
    braking, _ = step(setup(), flying(10.0, 6.0, acceleration_east_m_s2=-2.5), Memory(), 10.0)
    assert braking.flow_l_min < steady.flow_l_min * 0.96


def test_a_zone_shorter_than_the_lag_is_not_chased_and_counted() -> None:
    zones = [
        Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=20.0),
        Zone(name="b", polygon=shapely.box(12, 0, 12.2, 6), rate_l_ha=25.0),
        Zone(name="c", polygon=shapely.box(12.2, 0, 40, 6), rate_l_ha=20.0),
    ]
    field = Prescription(zones, boundary=shapely.box(0, -1, 40, 7))
    given = setup(prescription=field)
    done = [c for c in fly(given, 6.0, 30.0) if c.valve == 2]
    assert len(done) == 1  # the opening, and nothing after it
    decision, _ = step(given, flying(10.0, 11.5), Memory(), 10.0)
    assert decision.unresolved_count == 6


def test_the_default_rate_is_used_where_no_zone_is() -> None:
    zones = [Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=20.0)]
    field = Prescription(zones, boundary=shapely.box(0, -1, 40, 7), default_rate_l_ha=15.0)
    decision, _ = step(setup(prescription=field), flying(10.0, 20.0), Memory(), 10.0)
    assert decision.rate_l_ha == (15.0,) * 6


def test_no_rate_and_no_default_is_closed() -> None:
    zones = [Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=20.0)]
    field = Prescription(zones, boundary=shapely.box(0, -1, 40, 7))
    decision, _ = step(setup(prescription=field), flying(10.0, 20.0), Memory(), 10.0)
    assert decision.plan.is_off


@pytest.mark.parametrize(("across", "rate"), [("centre", 20.0), ("mean", 22.1), ("max", 25.0)])
def test_a_strip_over_two_zones_takes_what_the_setting_says(across: str, rate: float) -> None:
    # One valve from 0.5 to 6.5 m north: 2.5 m of its 6 m lie in the upper zone.
    zones = [
        Zone(name="low", polygon=shapely.box(0, 0, 40, 4), rate_l_ha=20.0),
        Zone(name="high", polygon=shapely.box(0, 4, 40, 8), rate_l_ha=25.0),
    ]
    field = Prescription(zones, boundary=shapely.box(0, -2, 40, 10))
    given = setup(
        prescription=field,
        boom=boom(count=1),
        nozzle_sets=(NozzleSet(valves=(0,), curve=CURVE),),
        across=across,
    )
    decision, _ = step(given, flying(10.0, 20.0, north_m=3.5), Memory(), 10.0)
    expected = rate if across != "mean" else 20.0 + 5.0 * 2.5 / 6.0
    assert decision.rate_l_ha == (pytest.approx(expected, abs=5.0 / 40),)


def test_the_highest_rate_holds_however_little_of_the_strip_it_covers() -> None:
    zones = [
        Zone(name="low", polygon=shapely.box(0, 0, 40, 6.45), rate_l_ha=20.0),
        Zone(name="high", polygon=shapely.box(0, 6.45, 40, 8), rate_l_ha=25.0),
    ]
    given = setup(
        prescription=Prescription(zones, boundary=shapely.box(0, -2, 40, 10)),
        boom=boom(count=1),
        nozzle_sets=(NozzleSet(valves=(0,), curve=CURVE),),
        across="max",
    )
    decision, _ = step(given, flying(10.0, 20.0, north_m=3.5), Memory(), 10.0)
    assert decision.rate_l_ha == (25.0,)


def test_a_strip_whose_points_reach_a_boundary_together_changes_once() -> None:
    zones = [
        Zone(name="first", polygon=shapely.box(0, 0, 20, 8), rate_l_ha=20.0),
        Zone(name="second", polygon=shapely.box(20, 0, 40, 8), rate_l_ha=25.0),
    ]
    field = Prescription(zones, boundary=shapely.box(-5, -5, 45, 15))
    state = flying(10.0, 18.0, north_m=4.0, **along(90.3))
    ways: tuple[Across, ...] = ("mean", "max")
    for across in ways:
        routes = find_routes(
            field, state, boom(), back_s=0.1, ahead_s=1.0, border="inside", border_buffer_m=0.1,
            across=across,
        )  # fmt: skip
        assert [[step.rate_l_ha for step in route] for route in routes] == [[20.0, 25.0]] * 6


def test_a_change_that_comes_too_late_is_issued_at_once_and_counted() -> None:
    given = setup()
    _, memory = step(given, flying(10.0, 6.0), Memory(), 10.0)
    jumped = flying(10.05, 11.9)  # the change at 12 m was due 0.09 s ago
    decision, _ = step(given, jumped, memory, 10.05)
    assert decision.late_count == 6
    assert all(c.at_s == 10.05 and c.restart for c in decision.plan.changes[:6])


def test_noise_does_not_take_an_issued_change_back() -> None:
    given = setup()
    _, memory = step(given, flying(10.0, 10.0), Memory(), 10.0)
    # Order at crossing - 0.114 s: due at 10.286; position says that it is just past.
    decision, memory = step(given, flying(10.29, 11.45), memory, 10.29)
    assert all(value == pytest.approx(duty_of(25.0)) for value in
               decision.plan.duty_at(10.29))  # fmt: skip
    # The next position says that it is 15 ms ahead again: the change stands.
    decision, _ = step(given, flying(10.30, 11.36), memory, 10.30)
    assert all(value == pytest.approx(duty_of(25.0), abs=0.01) for value in
               decision.plan.duty_at(10.30))  # fmt: skip


# Wang et al. 2024, Table 2: one of twelve nozzles. Not `CURVE`: a judge has its own numbers.
TABLE_2_PERCENT = (20, 40, 50, 70, 80, 90, 100)
TABLE_2_NOZZLE_L_MIN = (0.123, 0.252, 0.273, 0.385, 0.421, 0.496, 0.508)


def given_l_min(duty: float) -> float:
    """Return what P1's sprayer gives at a duty if it is straight between what was measured."""
    return 12.0 * float(np.interp(100.0 * duty, TABLE_2_PERCENT, TABLE_2_NOZZLE_L_MIN))


@pytest.mark.parametrize("wanted_l_min", [1.5, 1.8, 2.39, 3.1, 4.0, 5.5, 6.05])
def test_a_sprayer_straight_between_its_measured_points_gives_what_was_asked(
    wanted_l_min: float,
) -> None:
    rate_l_ha = wanted_l_min / (0.006 * 6.0 * SPEED)
    field = Prescription(plots([[rate_l_ha] * 4]), boundary=shapely.box(0.0, -1.0, 48.0, 7.0))
    decision, _ = step(setup(prescription=field), flying(10.0, 6.0), Memory(), 10.0)
    duty = decision.plan.duty_at(10.0)
    assert [given_l_min(each) for each in duty] == pytest.approx([wanted_l_min] * 6, rel=1e-6)


def test_between_the_measured_points_the_curve_never_leaves_them() -> None:
    # A long flat stretch between steep ones: a smooth curve would swing past its points.
    curve = FlowCurve(duty=(0.1, 0.2, 0.8, 0.9), flow_l_min=(1.0, 3.0, 3.1, 5.0))
    for flow in np.linspace(1.0, 5.0, 401).tolist():
        expected = float(np.interp(flow, curve.flow_l_min, curve.duty))
        assert curve.duty_for(flow) == pytest.approx(expected, abs=1e-12)
        assert curve.flow_for(curve.duty_for(flow)) == pytest.approx(flow, rel=1e-12)


def test_small_trims_do_not_restart_the_period() -> None:
    given = setup()
    _, memory = step(given, flying(10.0, 6.0), Memory(), 10.0)
    faster = flying(10.05, 6.25, velocity_east_m_s=5.1)
    decision, _ = step(given, faster, memory, 10.05)
    now = [c for c in decision.plan.changes if c.at_s == 10.05]
    assert len(now) == 6
    assert not any(c.restart for c in now)


def test_the_nozzle_set_changes_with_hysteresis_and_not_inside_a_zone() -> None:
    large = NozzleSet(valves=tuple(range(6)), curve=CURVE)
    small = NozzleSet(
        valves=(0, 1, 2, 3),
        curve=FlowCurve(duty=(0.2, 0.5, 0.9), flow_l_min=(1.0, 2.2, 4.2)),
    )
    given = setup(nozzle_sets=(small, large))
    decision, memory = step(given, flying(10.0, 26.0), Memory(), 10.0)  # 15 L/ha: 2.7 L/min
    assert memory.ordering.set_index == 0
    duty = decision.plan.duty_at(10.0)
    assert [value > 0 for value in duty] == [True] * 4 + [False] * 2
    # Faster in the same zone: 3.9 L/min is still within the small set; it stays.
    state = flying(10.05, 26.3, velocity_east_m_s=7.2, checked_speed_m_s=7.2)
    _, memory = step(given, state, memory, 10.05)
    assert memory.ordering.set_index == 0


def test_plans_expire_and_what_is_in_force_after_that_is_closed() -> None:
    plan = SprayPlan(
        sequence=1,
        issued_s=1.0,
        duty=(0.5,),
        changes=(TimedChange(at_s=1.1, valve=0, duty=0.7),),
        lease_until_s=1.3,
    )
    assert plan.duty_at(1.05) == (0.5,)
    assert plan.duty_at(1.1) == (0.7,)
    assert plan.duty_at(1.3) == (0.0,)


def test_in_a_turn_each_valve_is_dosed_by_its_own_speed() -> None:
    state: VehicleState = flying(10.0, 24.0, yaw_rate_deg_s=20.0)
    field = Prescription(
        [Zone(name="a", polygon=shapely.box(-50, -50, 99, 99), rate_l_ha=20.0)],
        boundary=shapely.box(-60, -60, 100, 100),
    )
    decision, _ = step(setup(prescription=field), state, Memory(), 10.0)
    duty = decision.plan.duty_at(10.0)
    assert all(left > right for left, right in itertools.pairwise(duty))
    assert CURVE.flow_for(duty[0]) / CURVE.flow_for(duty[5]) == pytest.approx(
        (SPEED + 2.5 * math.radians(20)) / (SPEED - 2.5 * math.radians(20)), rel=0.02
    )


def test_the_course_may_point_anywhere() -> None:
    for course in range(0, 360, 15):
        state = flying(10.0, 24.0, **along(course))  # type: ignore[arg-type]
        decision, _ = step(setup(), state, Memory(), 10.0)
        assert not decision.inhibits


def test_a_valve_that_flies_along_the_edge_of_two_zones_sprays_one_of_them() -> None:
    zones = [
        Zone(name="left", polygon=shapely.box(0, 3, 40, 9), rate_l_ha=20.0),
        Zone(name="right", polygon=shapely.box(0, -3, 40, 3), rate_l_ha=25.0),
    ]
    field = Prescription(zones, boundary=shapely.box(-5, -10, 45, 16))
    given = setup(
        prescription=field,
        boom=boom(count=1, width_m=1.0),
        nozzle_sets=(NozzleSet(valves=(0,), curve=CURVE),),
    )
    for course, rate in ((90.0, 25.0), (270.0, 20.0)):
        state = flying(10.0, 20.0, north_m=3.0, **along(course))  # type: ignore[arg-type]
        decision, _ = step(given, state, Memory(), 10.0)
        assert decision.rate_l_ha == (rate,)
