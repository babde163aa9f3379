"""Faults of the liquid: noticed, named, and closing the valves where they must."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.controller import Memory, Watched, step
from companion.core.options.flow_meter import Detection
from companion.core.options.flow_trim import FlowTrim
from companion.core.options.liquid_faults import WatchMemory, follow
from companion.core.types import (
    Decision,
    FaultKind,
    Finding,
    FlowReport,
    Inhibit,
    PressureReport,
    TankReport,
)
from companion.journal.codec import decode, encode
from sitl.anyang import demo_setup, demo_trajectory
from sitl.flight import FlightOptions, fly
from sitl.liquid_faults import LiquidFault, LiquidFaultKind
from sitl.profile import load_profile
from tests.builders import SPRAYING, flying, setup
from tests.companion.liquid_rig import LAW, NAN, OPEN_ML_S, STEP_S, Rig, healthy

# ----------------------------------------------------------------------------- noticed and named


@pytest.mark.parametrize("gain", [0.97, 1.0, 1.03])
@pytest.mark.parametrize("duty", [0.3, 0.6, 0.9])
def test_a_valve_that_shuts_is_named_within_three_seconds(gain: float, duty: float) -> None:
    rig = healthy(gain=gain, duty=(duty,) * 6)
    rig.flows = [1.025] * 5 + [0.0]
    rig.pressure = 1.05
    rig.until_found()
    rig.run(1.0)
    assert rig.kinds == [FaultKind.STUCK_CLOSED]
    assert not rig.memory.latched


def test_clogged_nozzles_are_no_valve() -> None:
    rig = healthy()
    rig.flows, rig.pressure = [0.9] * 6, 1.034
    rig.until_found()
    assert rig.kinds == [FaultKind.CLOG]
    assert not rig.memory.latched


def test_a_loss_of_more_than_a_quarter_closes() -> None:
    rig = healthy()
    rig.flows, rig.pressure = [0.65] * 6, 1.12
    rig.until_found()
    rig.run(0.5)
    assert Inhibit.FLOW_FAULT in rig.memory.latched


def test_a_leak_closes() -> None:
    rig = healthy()
    rig.leak_ml_s, rig.pressure = 0.10 * 6.0 * OPEN_ML_S, 0.95
    rig.until_found()
    assert rig.memory.latched == {Inhibit.LEAK}


def test_a_valve_that_stays_open_closes_the_others() -> None:
    rig = healthy(duty=(0.4,) * 6)
    rig.stuck_open, rig.pressure = {2}, 0.94
    rig.until_found()
    rig.run(0.5)
    assert rig.kinds == [FaultKind.STUCK_OPEN]
    assert rig.memory.latched == {Inhibit.VALVE_STUCK_OPEN}


def test_a_weak_pump_is_told_from_a_clog_by_the_pressure() -> None:
    rig = healthy()
    rig.supply, rig.pressure = 0.88, 0.88**2
    rig.until_found()
    assert rig.kinds == [FaultKind.SUPPLY]
    assert not rig.memory.latched


def test_without_a_pressure_sensor_a_loss_is_a_clog() -> None:
    rig = healthy(law=Detection())
    rig.supply = 0.9
    rig.until_found()
    assert rig.kinds == [FaultKind.CLOG]


def test_air_is_what_no_liquid_does() -> None:
    rig = healthy()
    rig.bubbles, rig.pressure = 0.9, 0.7
    rig.until_found()
    rig.run(1.0)
    assert rig.kinds == [FaultKind.AIR]


@pytest.mark.parametrize(
    ("pressure", "kind", "latched"),
    [
        (0.0, FaultKind.PUMP_OFF, {Inhibit.NO_FLOW}),
        (1.34, FaultKind.NO_FLOW, {Inhibit.NO_FLOW}),
        (1.0, FaultKind.DEAD_METER, set()),
    ],
)
def test_nothing_that_comes_is_named_by_its_pressure_within_two_seconds(
    pressure: float, kind: FaultKind, latched: set[Inhibit]
) -> None:
    rig = healthy()
    rig.supply, rig.pressure = 0.0, pressure
    assert rig.until_found() <= 2.0
    assert rig.kinds == [kind]
    assert rig.memory.latched == latched


def test_outputs_that_never_armed_are_noticed_within_two_seconds_of_the_first_order() -> None:
    rig = Rig(law=Detection(), duty=(0.0,) * 6, supply=0.0).run(5.0)
    rig.duty = (0.6,) * 6
    assert rig.until_found() <= 2.0
    assert rig.memory.latched == {Inhibit.NO_FLOW}


def test_air_before_nothing_is_an_empty_tank() -> None:
    rig = healthy()
    rig.bubbles, rig.pressure = 0.9, 0.7
    rig.run(2.0)
    rig.bubbles, rig.supply, rig.pressure = 0.0, 0.0, 0.0
    rig.run(2.0)
    assert rig.kinds == [FaultKind.TANK_EMPTY]
    assert Inhibit.TANK_EMPTY in rig.memory.latched


@pytest.mark.parametrize("level_l", [1.0, 0.0, NAN])
def test_a_tank_at_its_reserve_closes(level_l: float) -> None:
    rig = healthy()
    rig.tank = TankReport(received_s=rig.now_s, level_l=level_l)
    rig.step()
    assert rig.kinds == [FaultKind.TANK_LOW]
    assert rig.memory.latched == {Inhibit.TANK_EMPTY}


def test_a_tank_that_is_not_known_closes_nothing() -> None:
    rig = healthy()
    rig.tank = TankReport(received_s=rig.now_s, level_l=None)
    assert not rig.run(1.0).memory.findings


# ------------------------------------------------------------------------------ closed intervals


def test_flow_with_all_closed_is_a_leak_at_the_next_closed_interval() -> None:
    rig = healthy()
    rig.leak_ml_s = 0.03 * 6.0 * OPEN_ML_S  # too small to be noticed while spraying
    assert not rig.run(5.0).memory.findings
    rig.duty = (0.0,) * 6
    assert rig.until_found(4.0) <= 3.0
    assert rig.kinds == [FaultKind.LEAK]
    assert rig.memory.latched == {Inhibit.LEAK}


def test_what_the_lags_leave_after_closing_is_no_leak() -> None:
    rig = healthy()
    for _ in range(5):
        rig.duty = (0.0,) * 6
        rig.run(4.0)
        rig.duty = (0.6,) * 6
        rig.run(4.0)
    assert not rig.memory.findings


@pytest.mark.parametrize("late_s", [0.3, 0.6, 0.9])
def test_valves_that_were_told_late_to_close_are_no_leak(late_s: float) -> None:
    rig = healthy()
    rig.order_late_s, rig.duty = late_s, (0.0,) * 6
    assert not rig.run(6.0).memory.findings


def on_a_link_that_stops(rig: Rig, seconds: float, *, rest_s: float) -> Rig:
    """Have each order for less fall into 0.4 s in which nothing comes, and nothing is carried out.

    The orders, the counts and the positions of that time come after it.
    """
    until_s = rig.now_s + seconds
    while rig.now_s < until_s and not rig.memory.findings:
        rig.duty, rig.is_held_up = (0.3,) * 6, True
        rig.run(0.4)
        rig.is_held_up = False
        rig.run(rest_s)
        rig.duty = (0.5,) * 6
        rig.run(rest_s)
    return rig


@pytest.mark.parametrize("seed", range(5))
def test_a_healthy_sprayer_on_a_link_that_stops_again_and_again_has_no_fault(seed: int) -> None:
    rig = healthy(seed=seed, duty=(0.5,) * 6)
    assert not on_a_link_that_stops(rig, 20.0, rest_s=0.5).memory.findings


@pytest.mark.parametrize("seed", range(5))
def test_on_a_link_that_stops_again_and_again_a_stuck_valve_is_named(seed: int) -> None:
    rig = healthy(seed=seed, duty=(0.5,) * 6)
    rig.stuck_open = {2}
    on_a_link_that_stops(rig, 12.0, rest_s=0.9)
    assert rig.kinds == [FaultKind.STUCK_OPEN]


def test_positions_that_come_seldom_are_no_silence() -> None:
    rig = healthy(duty=(0.5,) * 6)
    for turn in range(200):
        if turn == 120:
            rig.stuck_open = {2}
        rig.is_held_up = turn % 4 > 0  # five positions and counts a second
        rig.step()
    assert rig.kinds == [FaultKind.STUCK_OPEN]


@pytest.mark.parametrize("begin_s", [1.0, 1.1, 1.2, 1.3])
def test_a_valve_that_opens_while_all_is_closed_is_no_small_leak(begin_s: float) -> None:
    rig = healthy()
    rig.duty = (0.0,) * 6
    assert not rig.run(begin_s).memory.findings
    rig.stuck_open = {2}
    assert rig.until_found(3.0) <= 1.6
    assert rig.kinds == [FaultKind.STUCK_OPEN]


def test_a_meter_before_the_return_valve_says_nothing_while_closed() -> None:
    rig = healthy(law=Detection(closed_check=False))
    rig.duty, rig.leak_ml_s = (0.0,) * 6, 50.0
    assert not rig.run(5.0).memory.findings


def test_a_valve_that_stays_open_at_a_high_duty_is_found_when_all_close() -> None:
    rig = healthy(duty=(0.9,) * 6)
    rig.stuck_open = {4}
    assert not rig.run(4.0).memory.findings
    rig.duty = (0.0,) * 6
    rig.until_found(4.0)
    assert rig.kinds == [FaultKind.STUCK_OPEN]


# -------------------------------------------------------------------------------- which valve


def clicks(rig: Rig, seconds: float = 1.2) -> Rig:
    """Open one valve after the other."""
    for valve in range(6):
        rig.duty = tuple(1.0 if each == valve else 0.0 for each in range(6))
        rig.run(seconds)
    return rig


@pytest.mark.parametrize("valve", [0, 3, 5])
def test_valves_that_spray_at_different_times_tell_which_is_shut(valve: int) -> None:
    law = replace(LAW, meter_minimum_l_min=0.2)
    rig = healthy(law=law, duty=(0.8, 0.8, 0.8, 0.4, 0.4, 0.4))
    rig.flows[valve] = 0.0
    rig.run(1.5)
    rig.duty = (0.5, 0.9, 0.4, 0.6, 0.3, 0.8)
    rig.run(1.0)
    clicks(rig)
    found = [finding for finding in rig.memory.findings if finding.valve is not None]
    assert [finding.valve for finding in found] == [valve]


def test_valves_that_do_the_same_are_not_told_apart() -> None:
    rig = healthy()
    rig.flows[2] = 0.0
    rig.run(5.0)
    assert [finding.valve for finding in rig.memory.findings] == [None]


# -------------------------------------------------------------------------------- false alarms


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_sprayer_that_changes_its_rate_is_left_alone(seed: int) -> None:
    chance = random.Random(seed)
    rig = Rig(seed=seed, gain=chance.uniform(0.97, 1.03))
    for _ in range(30):
        rig.duty = (chance.choice([0.0, 0.25, 0.4, 0.6, 0.8, 0.95]),) * 6
        rig.run(chance.uniform(0.8, 3.0))
    assert not rig.memory.findings


def test_what_is_learnt_has_bounds_so_that_a_slow_clog_is_found() -> None:
    rig = healthy()
    for share in range(160):
        rig.flows = [1.0 - share / 1000.0] * 6
        rig.run(0.5)
    assert rig.memory.gain >= 0.95
    assert rig.memory.findings


# ------------------------------------------------------------------------ sensors and latches


def test_a_meter_at_fault_is_said_and_is_no_flow_of_zero() -> None:
    rig = healthy()
    rig.fault = "flow meter: 5 pulses lost"
    rig.run(3.0)
    assert [(found.kind, found.text) for found in rig.memory.findings] == [
        (FaultKind.METER_FAULT, "flow meter: 5 pulses lost")
    ]
    assert not rig.memory.latched


def test_a_silent_meter_is_said_and_closes_where_it_is_required() -> None:
    rig = healthy(law=replace(LAW, meter_required=True))
    rig.meter = False
    assert 1.4 <= rig.until_found() <= 2.1
    assert rig.kinds == [FaultKind.METER_FAULT]
    assert rig.memory.latched == {Inhibit.FLOW_FAULT}


def test_a_meter_whose_counts_come_late_is_not_silent() -> None:
    rig = healthy(law=replace(LAW, meter_required=True))
    rig.count_late_s = 1.0
    assert not rig.run(5.0).memory.findings


def test_a_latch_holds_until_the_operator_disables() -> None:
    rig = healthy()
    rig.leak_ml_s = 20.0
    rig.until_found()
    rig.leak_ml_s, rig.duty = 0.0, (0.0,) * 6
    rig.run(10.0)
    assert rig.memory.latched
    rig.enabled = False
    rig.step()
    assert not rig.memory.latched
    assert rig.memory.findings
    rig.enabled = True
    rig.step()
    assert not rig.memory.findings
    assert not rig.run(5.0).memory.latched


@given(
    flow=st.one_of(st.none(), st.floats()),
    kpa=st.one_of(st.none(), st.floats()),
    level=st.one_of(st.none(), st.floats()),
    at=st.floats(),
)
def test_whatever_sensors_say_nothing_breaks_and_nothing_opens(
    flow: float | None, kpa: float | None, level: float | None, at: float
) -> None:
    rig = healthy_once()
    latched = rig.memory._replace(latched=frozenset({Inhibit.LEAK}))
    state = replace(
        SPRAYING,
        flow=None if flow is None else FlowReport(received_s=at, volume_ml=flow),
        pressure=PressureReport(received_s=at, pressure_kpa=kpa),
        tank=TankReport(received_s=at, level_l=level),
    )
    after = follow(rig.watching, latched, rig.plan, state, index=0, now_s=rig.now_s + STEP_S)
    assert Inhibit.LEAK in after.latched


_HEALTHY: list[Rig] = []


def healthy_once() -> Rig:
    if not _HEALTHY:
        _HEALTHY.append(healthy())
    return _HEALTHY[0]


# ------------------------------------------------------------------------------ in the controller

OF_THE_LIQUID = [
    Inhibit.LEAK,
    Inhibit.VALVE_STUCK_OPEN,
    Inhibit.NO_FLOW,
    Inhibit.TANK_EMPTY,
    Inhibit.FLOW_FAULT,
]


@pytest.mark.parametrize("inhibit", OF_THE_LIQUID)
def test_latched_reason_alone_closes_every_valve(inhibit: Inhibit) -> None:
    finding = Finding(kind=FaultKind.LEAK, at_s=9.0, text="leak")
    watch = WatchMemory(enabled=True, latched=frozenset({inhibit}), findings=(finding,))
    watched = setup(detection=LAW)
    assert not step(watched, SPRAYING, Memory(), 10.0)[0].plan.is_off
    decision, memory = step(watched, SPRAYING, Memory(watched=Watched(watch=watch)), 10.0)
    assert decision.inhibits == {inhibit}
    assert decision.plan.is_off
    assert decision.findings == (finding,)
    decision, memory = step(watched, flying(10.1, 6.5), memory, 10.1)
    assert decision.plan.is_off
    disabled = flying(10.2, 7.0, enabled=False, operator_wishes=1)
    decision, memory = step(watched, disabled, memory, 10.2)
    assert decision.inhibits == {Inhibit.NOT_ENABLED}
    enabled = flying(10.3, 7.5, operator_wishes=2)
    assert not step(watched, enabled, memory, 10.3)[0].plan.is_off


def test_decision_with_findings_comes_back_from_the_journal() -> None:
    finding = Finding(kind=FaultKind.STUCK_CLOSED, at_s=1 / 3, text="valve", valve=2)
    watch = WatchMemory(enabled=True, findings=(finding,))
    decision = step(setup(detection=LAW), SPRAYING, Memory(watched=Watched(watch=watch)), 10.0)[0]
    assert decode(encode(decision)) == decision
    assert decode(encode(setup(detection=LAW).detection)) == LAW


# ------------------------------------------------------------------------------- in a whole flight


def test_a_leak_in_flight_closes_the_valves_and_the_trim_does_not_hide_it() -> None:
    leak = LiquidFault(kind=LiquidFaultKind.LEAK, from_s=125.0, share=0.15)
    seen: list[Decision] = []
    fly(
        replace(demo_setup(6.0), detection=Detection(), flow_trim=FlowTrim(settle_s=0.5)),
        demo_trajectory(6.0, 1),
        load_profile("wang-2024"),
        FlightOptions(fidelity="averaged", meter_rate_hz=50.0, liquid_faults=(leak,)),
        speed_m_s=6.0,
        observer=seen.append,
    )
    first = next(decision for decision in seen if decision.findings)
    assert 125.0 < first.now_s < 128.0
    after = [decision for decision in seen if decision.now_s > first.now_s + 1.0]
    assert after
    assert all(decision.plan.is_off for decision in after)
    assert {Inhibit.LEAK, Inhibit.VALVE_STUCK_OPEN} & after[-1].inhibits
