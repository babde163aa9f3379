"""A pump and atomisers in the core: leads, merged sections, run-on, what the flow is taken for."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise

import pytest

from companion.core.controller import Memory, step
from companion.core.crossings import Crossing
from companion.core.nozzle import FlowCurve
from companion.core.options.atomisers import Atomiser, DropletLaw, Flow, spinning
from companion.core.options.flow_meter import Detection
from companion.core.options.flow_trim import FlowTrim
from companion.core.options.pump import Pump, liquid_plan
from companion.core.options.whole_boom import boom_route, bridged
from companion.core.types import DriveChange, DrivePlan, SprayPlan, TimedChange
from companion.journal.codec import FIELD_NAMES, decode, encode
from tests.builders import boom, flying, setup
from tests.pump_flight import CURVE, PUMP_LAG, fly, prescribed_ml, pump, pump_setup

SPINNER = Atomiser(
    name="disc", speed=FlowCurve(duty=(0.1, 1.0), flow_l_min=(1500.0, 15_000.0)),
    law=DropletLaw(um=200.0, rpm=8000.0, flow_l_min=1.0), droplet_um=200.0, share=0.5,
    spin_up_s=0.6, run_on_s=0.5,
)  # fmt: skip


def route(*steps: tuple[float, float | None]) -> tuple[Crossing, ...]:
    return tuple(Crossing(at_s, rate, False, 5.0) for at_s, rate in steps)


def test_sections_that_cross_one_after_another_are_one_step_of_the_same_volume() -> None:
    routes = tuple(route((0.0, 12.0), (1.0 + 0.1 * n, 24.0)) for n in range(3))
    plain = boom_route(routes, boom(3))
    assert [step.rate_l_ha for step in plain] == pytest.approx([12.0, 16.0, 20.0, 24.0])
    first, one = boom_route(routes, boom(3), merge_s=0.5)
    assert (first.rate_l_ha, one.rate_l_ha) == (12.0, 24.0)
    assert one.at_s == pytest.approx(1.1)


def test_starts_and_stops_are_not_merged() -> None:
    routes = (route((0.0, None), (1.0, 20.0), (1.1, 30.0), (1.2, None)),)
    assert [step.at_s for step in boom_route(routes, boom(1), merge_s=9.0)] == [0.0, 1.0, 1.1, 1.2]


def test_a_gap_that_is_too_short_to_stop_for_is_bridged_at_the_rate_before() -> None:
    gap = route((0.0, 20.0), (1.0, None), (1.4, 30.0), (3.0, None))
    assert [(s.at_s, s.rate_l_ha) for s in bridged(gap, 0.5)] == [
        (0.0, 20.0), (1.4, 30.0), (3.0, None),
    ]  # fmt: skip
    assert bridged(gap, 0.3) == gap


def first_running_s(plans: list[SprayPlan]) -> float:
    return min(
        change.at_s for plan in plans for change in plan.drives[0].changes if change.fraction > 0.0
    )


def test_the_pump_is_ordered_ahead_by_its_own_lag_and_the_first_valve_with_it() -> None:
    plans = [d.plan for d in fly(pump_setup([20.0], "valves"), from_m=-20.0, to_m=10.0).decisions]
    # 20 m at 5 m/s, and its volume-equivalent lag from standing still: 0.3 s and 0.5 s.
    assert first_running_s(plans) == pytest.approx(4.0 - 0.8, abs=0.02)
    opens = min(c.at_s for plan in plans for c in plan.changes if c.duty == 1.0)
    assert opens == pytest.approx(first_running_s(plans), abs=0.02)
    assert opens <= first_running_s(plans)


def test_no_valve_opens_ahead_while_the_pump_may_still_run_out() -> None:
    # 2 s of closed ground: the pump's lead of 0.8 s would reach into the 1.5 s that it runs out.
    flown = fly(pump_setup([20.0, 0.0, 20.0], "valves", length_m=10.0), from_m=0.0, to_m=22.0)
    shut = [d.now_s for d in flown.decisions if d.now_s > 1.0 and not any(d.plan.duty)]
    assert shut[0] == pytest.approx(2.0, abs=0.06)
    assert shut[-1] == pytest.approx(2.0 + PUMP_LAG.off_end_s, abs=0.06)
    # Less than a thousandth of the 60 mL that flow in a second.
    assert flown.volume_ml(2.01, 2.0 + PUMP_LAG.off_end_s) <= 0.06


def test_with_a_return_valve_the_pump_stands_at_its_flow_before_the_first_valve_opens() -> None:
    plans = [d.plan for d in fly(pump_setup([20.0], "return"), from_m=-20.0, to_m=10.0).decisions]
    opens = min(c.at_s for plan in plans for c in plan.changes if c.duty == 1.0)
    assert opens == pytest.approx(4.0 - 0.02, abs=0.02)
    assert first_running_s(plans) == pytest.approx(4.0 - 0.3 - 4.0 * 0.5, abs=0.05)


def test_valves_behind_a_pump_are_open_or_shut() -> None:
    flown = fly(pump_setup([20.0, 0.0, 15.0], "valves"), from_m=-10.0, to_m=100.0)
    for decision in flown.decisions:
        duties = {*decision.plan.duty, *(change.duty for change in decision.plan.changes)}
        assert duties <= {0.0, 1.0}
    rates = {rate for decision in flown.decisions for rate in decision.rate_l_ha}
    assert rates == {None, 0.0, 15.0, 20.0}


def test_the_decisions_flow_is_that_of_the_pump_and_of_open_valves_only() -> None:
    flown = fly(pump_setup([20.0], "return"), from_m=-20.0, to_m=50.0)
    inside = flown.decisions[round(7.0 / 0.05)]
    assert inside.flow_l_min == pytest.approx(3.6, rel=0.01)
    assert inside.target_flow_l_min == pytest.approx(3.6, rel=1e-6)
    ahead = flown.decisions[round(3.5 / 0.05)]
    assert ahead.plan.drives[0].fraction > 0.0
    assert ahead.flow_l_min == 0.0


def test_the_pump_follows_the_speed() -> None:
    made, memory, seen = pump_setup([20.0] * 4, "valves"), Memory(), {}
    for number in range(160):
        now_s = 0.05 * number
        speed = 4.0 if number < 80 else 5.0
        at = flying(now_s, 20.0 + 4.5 * now_s, velocity_east_m_s=speed, checked_speed_m_s=speed)
        decision, memory = step(made, at, memory, now_s)
        seen[number] = decision.flow_l_min
    assert seen[79] == pytest.approx(20.0 * 4.0 * 6.0 * 0.006, rel=0.01)
    assert seen[159] == pytest.approx(20.0 * 5.0 * 6.0 * 0.006, rel=0.01)


def test_an_override_and_the_trim_reach_the_pump() -> None:
    made = pump_setup([20.0], "valves")
    flown = fly(made, from_m=-20.0, to_m=50.0, rate_percent=110.0)
    assert flown.volume_ml(0.0, math.inf) == pytest.approx(1.1 * prescribed_ml([20.0]), rel=0.01)


def test_trim_and_detection_watch_the_pumps_flow() -> None:
    watched = pump_setup(
        [20.0], "valves", flow_trim=FlowTrim(), detection=Detection(spread=0.05),
    )  # fmt: skip
    assert watched.trimming is not None
    assert watched.trimming.delay_s > PUMP_LAG.down_s
    assert watched.watching is not None
    assert watched.watching.valves == ((0,),)
    flown = fly(watched, from_m=-20.0, to_m=50.0)
    assert flown.decisions[-1].flow_trim == 1.0


def test_a_liquid_plan_is_the_pumps_with_what_the_meter_takes_for_a_new_zone() -> None:
    plan = SprayPlan(
        sequence=3, issued_s=0.0, duty=(1.0,),
        changes=(TimedChange(at_s=0.2, valve=0, duty=0.0),), lease_until_s=0.3,
        drives=(DrivePlan(fraction=0.5, changes=(DriveChange(at_s=0.1, fraction=0.51),)),),
    )  # fmt: skip
    liquid = liquid_plan(plan, "return")
    assert liquid is not None
    assert liquid.duty == (0.5,)
    assert [(c.at_s, c.duty, c.restart) for c in liquid.changes] == [
        (0.1, 0.51, False), (0.2, 0.0, True),
    ]  # fmt: skip


def test_without_a_pump_no_plan_has_drives() -> None:
    decision, _ = step(setup(), flying(10.0, 6.0), Memory(), 10.0)
    assert decision.plan.drives == ()
    assert not decision.plan.is_off


def test_a_plan_of_an_older_journal_reads_back_without_drives() -> None:
    names = {**FIELD_NAMES, "SprayPlan": FIELD_NAMES["SprayPlan"][:-1]}
    assert FIELD_NAMES["SprayPlan"][-1] == "drives"
    old = decode('{"SprayPlan":[1,0.0,[0.5],[],0.3]}', names)
    assert old == SprayPlan(sequence=1, issued_s=0.0, duty=(0.5,), changes=(), lease_until_s=0.3)
    new = replace(old, drives=(DrivePlan(fraction=0.3),))  # type: ignore[type-var]
    assert decode(encode(new)) == new
    assert json.loads(encode(pump("valves")))["Pump"][0] == "modulates"
    for motor in (pump("return"), SPINNER):
        assert decode(encode(motor)) == motor


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, math.inf])
def test_a_drives_fraction_is_one(value: float) -> None:
    with pytest.raises(ValueError, match="fraction"):
        DrivePlan(fraction=value)
    with pytest.raises(ValueError, match="fraction"):
        DriveChange(at_s=0.0, fraction=value)


def test_a_drives_changes_have_times_in_order() -> None:
    with pytest.raises(ValueError, match="finite"):
        DriveChange(at_s=math.nan, fraction=0.5)
    late, soon = (DriveChange(at_s=at_s, fraction=0.5) for at_s in (1.0, 0.5))
    with pytest.raises(ValueError, match="order"):
        DrivePlan(fraction=0.0, changes=(late, soon))


def test_a_drive_alone_makes_a_plan_that_is_not_off() -> None:
    off = SprayPlan(sequence=1, issued_s=0.0, duty=(0.0,), changes=(), lease_until_s=0.3)
    assert off.is_off
    soon = DrivePlan(fraction=0.0, changes=(DriveChange(at_s=0.1, fraction=0.2),))
    assert not replace(off, drives=(soon,)).is_off


@pytest.mark.parametrize(
    "wrong",
    [
        {"control": "modulates", "curve": None},
        {"control": "constant", "run_fraction": 0.5},
        {"control": "constant", "curve": None, "run_fraction": 0.0},
        {"fraction_min": 1.0},
        {"fraction_min": math.nan},
    ],
)
def test_a_pump_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    given: dict[str, object] = {
        "control": "modulates", "outlet": "valves", "lag": PUMP_LAG, "curve": CURVE,
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"fraction|curve"):
        Pump(**(given | wrong))  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------ atomisers


def spin(*flows: tuple[float, float], in_force: float, now_s: float, ran_s: float) -> DrivePlan:
    return spinning(
        SPINNER, [Flow(*flow) for flow in flows], in_force=in_force, ran_s=ran_s, output_s=0.01,
        now_s=now_s, until_s=now_s + 0.3,
    )  # fmt: skip


def test_an_atomiser_is_up_before_the_liquid_comes() -> None:
    plan = spin((0.0, 0.0), (10.0, 2.0), in_force=0.0, now_s=9.2, ran_s=-math.inf)
    (change,) = plan.changes
    assert change.at_s == pytest.approx(10.0 - 0.6 - 0.01)
    # 1 L/min for each of two, at which 8000 rpm make 200 um.
    assert change.fraction == pytest.approx(SPINNER.speed.duty_for(8000.0))


def test_it_runs_on_after_the_liquid_ended_and_stops_then() -> None:
    running = SPINNER.fraction_for(2.0)
    flows = ((8.0, 2.0), (10.0, 0.0))
    assert spin(*flows, in_force=running, now_s=10.1, ran_s=10.0).at(10.3) == running
    late = spin(*flows, in_force=running, now_s=10.3, ran_s=10.0)
    assert late.at(10.45) == running
    assert late.at(10.55) == 0.0
    # Nothing of the end is in view any more: the memory of the liquid counts.
    blind = spin((10.2, 0.0), in_force=running, now_s=10.3, ran_s=10.0)
    assert (blind.at(10.45), blind.at(10.55)) == (running, 0.0)


def test_its_speed_follows_the_flow_by_the_law() -> None:
    flows = (1.0, 2.0, 4.0)
    fractions = [SPINNER.fraction_for(flow) for flow in flows]
    assert all(a < b for a, b in pairwise(fractions))
    for flow, fraction in zip(flows, fractions, strict=True):
        rpm = SPINNER.speed.flow_for(fraction)
        assert SPINNER.law.size_um(rpm, 0.5 * flow) == pytest.approx(200.0, rel=1e-4)


def test_it_is_held_to_its_curve() -> None:
    assert SPINNER.fraction_for(1e6) == 1.0
    assert SPINNER.fraction_for(1e-9) == 0.1
    assert SPINNER.fraction_for(0.0) == SPINNER.fraction_for(math.nan) == 0.0


def test_an_atomiser_spins_over_a_field_and_not_beyond() -> None:
    made = pump_setup([20.0], "valves", atomisers=(SPINNER,))
    flown = fly(made, from_m=-20.0, to_m=60.0)
    spins = [(d.now_s, d.plan.drives[1].at(d.now_s)) for d in flown.decisions]
    on = [now_s for now_s, fraction in spins if fraction > 0.0]
    assert on[0] == pytest.approx(4.0 - 0.6, abs=0.06)
    assert on[-1] == pytest.approx(10.0 + 0.5, abs=0.1)


@pytest.mark.parametrize(
    "wrong", [{"um": 0.0}, {"rpm": math.nan}, {"rpm_exponent": 0.0}, {"flow_exponent": -0.1}]
)
def test_a_law_that_is_none_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(SPINNER.law, **wrong)
    for name, value in (("share", 0.0), ("droplet_um", math.nan), ("run_on_s", 31.0)):
        with pytest.raises(ValueError, match=name):
            replace(SPINNER, **{name: value})  # type: ignore[arg-type]
