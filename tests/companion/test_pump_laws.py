"""Laws of a pump that makes the flow, for maps, speeds and ways out as they come."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.controller import Memory, step
from companion.core.nozzle import FlowCurve
from companion.core.options.atomisers import Atomiser, DropletLaw
from companion.core.options.pump import Pump, PumpOutlet, behind_path
from companion.core.setup import Setup
from companion.core.types import DriveChange, DrivePlan, SprayPlan, TimedChange
from tests.builders import SPRAYING, flying
from tests.pump_flight import PUMP_LAG, fly, is_open, prescribed_ml, pump_setup

WAYS: tuple[PumpOutlet, ...] = ("valves", "return", "always")
RATES = st.lists(
    st.sampled_from([0.0, 12.0, 15.0, 18.0, 20.0, 22.0, 25.0]), min_size=1, max_size=3
).filter(any)
SPINNER = Atomiser(
    name="disc", speed=FlowCurve(duty=(0.1, 1.0), flow_l_min=(1500.0, 15_000.0)),
    law=DropletLaw(um=200.0, rpm=8000.0, flow_l_min=1.0), droplet_um=200.0, share=1.0,
    spin_up_s=0.6, run_on_s=0.5,
)  # fmt: skip


@settings(max_examples=6)
@given(rates=RATES, way=st.sampled_from(WAYS), speed_m_s=st.floats(3.5, 6.0))
def test_the_volume_over_the_field_is_within_one_percent(
    rates: list[float], way: PumpOutlet, speed_m_s: float
) -> None:
    made = pump_setup(rates, way)
    flown = fly(made, from_m=-20.0, to_m=30.0 * len(rates) + 20.0, speed_m_s=speed_m_s)
    assert flown.volume_ml(0.0, math.inf) == pytest.approx(prescribed_ml(rates), rel=0.01)


@settings(max_examples=5)
@given(rates=RATES, speed_m_s=st.floats(2.0, 9.0), valves=st.sampled_from([1, 3]))
def test_a_pump_behind_valves_runs_only_with_one_of_them_open(
    rates: list[float], speed_m_s: float, valves: int
) -> None:
    made = pump_setup(rates, "valves", length_m=12.0, valves=valves, atomisers=(SPINNER,))
    flown = fly(made, from_m=-15.0, to_m=12.0 * len(rates) + 15.0, speed_m_s=speed_m_s)
    assert any(decision.plan.drives[0].fraction for decision in flown.decisions)
    for decision in flown.decisions:
        assert_way_out(decision.plan)


def assert_way_out(plan: SprayPlan) -> None:
    """Fail if the pump is on while all valves of the plan are shut."""
    times = {plan.issued_s, *(each.at_s for each in (*plan.changes, *plan.drives[0].changes))}
    for at_s in times:
        assert is_open(plan, at_s) or plan.drives[0].at(at_s) == 0.0


@settings(max_examples=4)
@given(rates=RATES, speed_m_s=st.floats(3.0, 6.0))
def test_the_pump_stands_with_the_last_valve_and_nothing_falls_outside(
    rates: list[float], speed_m_s: float
) -> None:
    made = pump_setup(rates, "valves", border="inside", border_buffer_m=0.0)
    length_m = 30.0 * len(rates)
    flown = fly(made, from_m=-20.0, to_m=length_m + 25.0, speed_m_s=speed_m_s)
    entered_s, left_s = 20.0 / speed_m_s, (20.0 + length_m) / speed_m_s
    # 2 % of the flow is what counts as none.
    assert flown.volume_ml(0.0, entered_s) <= 0.02 * flown.volume_ml(0.0, math.inf)
    assert flown.volume_ml(left_s + 0.01, math.inf) == 0.0
    assert flown.decisions[-1].plan.is_off


CHANGES = st.lists(
    st.tuples(st.floats(0.0, 0.3), st.integers(0, 1), st.sampled_from([0.0, 1.0])), max_size=6
)
MOVES = st.lists(st.tuples(st.floats(0.0, 0.3), st.floats(0.0, 1.0)), max_size=6)


@given(
    changes=CHANGES, moves=MOVES, duty=st.tuples(*[st.sampled_from([0.0, 1.0])] * 2),
    fraction=st.floats(0.0, 1.0),
)  # fmt: skip
def test_no_plan_at_all_lets_a_pump_work_against_shut_valves(
    changes: list[tuple[float, int, float]],
    moves: list[tuple[float, float]],
    duty: tuple[float, ...],
    fraction: float,
) -> None:
    plan = SprayPlan(
        sequence=1,
        issued_s=-0.1,
        duty=duty,
        changes=tuple(
            TimedChange(at_s=at_s, valve=valve, duty=to) for at_s, valve, to in sorted(changes)
        ),
        lease_until_s=0.3,
    )
    drive = DrivePlan(
        fraction=fraction,
        changes=tuple(DriveChange(at_s=at_s, fraction=to) for at_s, to in sorted(moves)),
    )
    held = behind_path(plan, drive)
    assert_way_out(replace(plan, drives=(held,)))
    for at_s in {-0.1, *(at_s for at_s, *_ in changes), *(at_s for at_s, _ in moves)}:
        if is_open(plan, at_s):
            assert held.at(at_s) == drive.at(at_s)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "wrong",
    [
        {"east_m": math.nan},
        {"velocity_east_m_s": math.nan},
        {"position_received_s": 0.0},
        {"heartbeat_received_s": None},
        {"enabled": False},
        {"output_healthy": False},
        {"heading_deg": math.nan},
    ],
)
def test_what_is_stale_missing_or_no_number_stops_every_drive(
    way: PumpOutlet, wrong: dict[str, object]
) -> None:
    made = pump_setup([20.0, 20.0], way, atomisers=(SPINNER,))
    memory = Memory()
    for number in range(40):
        now_s = 10.0 + 0.05 * number
        decision, memory = step(made, flying(now_s, 10.0 + 0.25 * number), memory, now_s)
    assert all(drive.at(now_s + 0.01) > 0.0 for drive in decision.plan.drives)
    state = replace(replace(SPRAYING, time_s=now_s, position_received_s=now_s), **wrong)  # type: ignore[arg-type]
    decision, _ = step(made, state, memory, now_s + 0.05)
    assert decision.inhibits
    assert decision.plan.is_off


def test_a_constant_pump_runs_only_where_there_is_a_way_out() -> None:
    for way in ("valves", "return"):
        constant = Pump(control="constant", outlet=way, lag=PUMP_LAG, run_fraction=0.7)
        made = pump_setup([20.0, 0.0, 20.0], "valves", pump=constant)
        ran = set()
        for decision in fly_plans(made):
            if way == "valves":
                assert_way_out(decision)
            ran |= {(is_open(decision, decision.issued_s), decision.drives[0].fraction)}
        assert (True, 0.7) in ran
        assert ((False, 0.7) in ran) == (way == "return")


def fly_plans(made: Setup) -> Iterator[SprayPlan]:
    """Return the plans of a flight whose pump makes no flow."""
    memory = Memory()
    for number in range(280):
        now_s = number * 0.05
        state = flying(now_s, -15.0 + 5.0 * now_s)
        decision, memory = step(made, state, memory, now_s)
        if not decision.inhibits:
            yield decision.plan
