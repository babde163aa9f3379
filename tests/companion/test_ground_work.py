"""Ground work opens while all holds, closes in the same step when anything is missing."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.core.inputs import RcReport
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.types import (
    EstopReport,
    HeartbeatReport,
    LandedReport,
    OperatorCommand,
    OutputReport,
    SpeedReport,
)
from companion.ground.work import (
    PIECE_MAX_S,
    GroundDecision,
    GroundKind,
    GroundMemory,
    GroundOrder,
    GroundReason,
    GroundSetup,
    GroundState,
    GroundTask,
    Hold,
    Phase,
    clicks,
    expected_ml,
    flow_of,
    ground_step,
    in_turn,
    observe_ground,
    together,
)
from tests import builders

NOW_S = 100.0
SETUP = GroundSetup()
PRIME = together(GroundKind.PRIME, 3, (0, 1, 2), duty=1.0, seconds=10.0)
CATCH = together(GroundKind.CATCH, 3, (1,), duty=0.5, seconds=5.0)


def state_at(now_s: float, **change: object) -> GroundState:
    state = GroundState(
        heartbeat=HeartbeatReport(
            received_s=now_s - 0.4, autopilot="ardupilot", armed=False, mode="LOITER"
        ),
        landed=LandedReport(received_s=now_s - 0.2, in_air=False, on_ground=True),
        output=OutputReport(received_s=now_s, healthy=True),
    )
    return replace(state, **change)  # type: ignore[arg-type]


def held(until_s: float, *, since_s: float = NOW_S) -> Hold:
    """Return the hold of a key that repeats ten times a second."""
    hold, at_s = Hold(), since_s
    while at_s <= until_s:
        hold, at_s = hold.renewed(at_s), at_s + 0.1
    return hold


class Bench:
    """Steps one piece of work; the vehicle stands well unless it is told otherwise."""

    def __init__(self, task: GroundTask = PRIME, setup: GroundSetup = SETUP) -> None:
        self.task, self.setup = task, setup
        self.memory = GroundMemory()
        self.hold = Hold()
        self.started_s = NOW_S
        self.now_s = NOW_S

    def step(self, now_s: float, *, stroke: bool = True, **change: object) -> GroundDecision:
        self.now_s = now_s
        if stroke:
            self.hold = self.hold.renewed(now_s)
        order = GroundOrder(task=self.task, started_s=self.started_s, hold=self.hold)
        decision, self.memory = ground_step(
            self.setup, state_at(now_s, **change), order, self.memory, now_s, valve_count=3
        )
        return decision

    def pressed(self, *times_s: float) -> Bench:
        """Begin earlier, with strokes from before the first step."""
        self.started_s = NOW_S + times_s[0]
        for at_s in times_s:
            self.hold = self.hold.renewed(NOW_S + at_s)
        return self

    def run(self, until_s: float, *, step_s: float = 0.05, **kind: object) -> GroundDecision:
        decision = self.step(self.now_s + step_s, **kind)  # type: ignore[arg-type]
        while self.now_s + step_s <= until_s:
            decision = self.step(self.now_s + step_s, **kind)  # type: ignore[arg-type]
        return decision

    def opened(self) -> Bench:
        assert not self.run(NOW_S + 0.5).plan.is_off
        return self


def heartbeat(**change: object) -> HeartbeatReport:
    given: dict[str, object] = {
        "received_s": NOW_S + 0.5,
        "autopilot": "ardupilot",
        "armed": False,
        "mode": "LOITER",
    }
    return HeartbeatReport(**(given | change))  # type: ignore[arg-type]


def landed(**change: object) -> LandedReport:
    given: dict[str, object] = {"received_s": NOW_S + 0.5, "in_air": False, "on_ground": True}
    return LandedReport(**(given | change))  # type: ignore[arg-type]


REFUSED: list[tuple[GroundReason, dict[str, object]]] = [
    (GroundReason.NO_HEARTBEAT, {"heartbeat": None}),
    (GroundReason.STALE_HEARTBEAT, {"heartbeat": heartbeat(received_s=NOW_S - 2.1)}),
    (GroundReason.STALE_HEARTBEAT, {"heartbeat": heartbeat(received_s=NOW_S + 1.0)}),
    (GroundReason.STALE_HEARTBEAT, {"heartbeat": heartbeat(received_s=math.nan)}),
    (GroundReason.ARMED, {"heartbeat": heartbeat(armed=True)}),
    (GroundReason.ARMED, {"heartbeat": heartbeat(armed=None)}),
    (GroundReason.MISSION_MODE, {"heartbeat": heartbeat(mode="AUTO")}),
    (GroundReason.MISSION_MODE, {"heartbeat": heartbeat(mode="MISSION")}),
    (GroundReason.MISSION_MODE, {"heartbeat": heartbeat(mode="")}),
    (GroundReason.MISSION_MODE, {"heartbeat": heartbeat(mode=None)}),
    (GroundReason.MISSION_ACTIVE, {"mission_active": True}),
    (GroundReason.LANDED_UNKNOWN, {"landed": None}),
    (GroundReason.LANDED_UNKNOWN, {"landed": landed(received_s=NOW_S - 2.1)}),
    (GroundReason.LANDED_UNKNOWN, {"landed": landed(received_s=math.nan)}),
    (GroundReason.NOT_LANDED, {"landed": landed(in_air=None, on_ground=False)}),
    (GroundReason.NOT_LANDED, {"landed": landed(in_air=True, on_ground=False)}),
    # Taking off and landing are not in the air, and not on the ground either.
    (GroundReason.NOT_LANDED, {"landed": landed(in_air=False, on_ground=False)}),
    (GroundReason.OUTPUT_FAULT, {"output": None}),
    (GroundReason.OUTPUT_FAULT, {"output": OutputReport(received_s=NOW_S, healthy=False)}),
    (
        GroundReason.UNGUARDED,
        {"output": OutputReport(received_s=NOW_S, healthy=True, guarded=False)},
    ),
    (GroundReason.STOPPED, {"was_stopped": True}),
]


@pytest.mark.parametrize(("reason", "change"), REFUSED)
def test_each_condition_closes_alone_and_ends_the_piece(
    reason: GroundReason, change: dict[str, object]
) -> None:
    bench = Bench().opened()
    decision = bench.step(bench.now_s + 0.05, **change)
    assert decision.reasons == {reason}
    assert decision.plan.is_off
    assert decision.is_over
    assert bench.run(NOW_S + 5.0).plan.is_off, "it needs a new start"


@pytest.mark.parametrize(("reason", "change"), REFUSED)
def test_nothing_opens_at_first_while_a_condition_is_missing(
    reason: GroundReason, change: dict[str, object]
) -> None:
    bench = Bench()
    decision = bench.run(NOW_S + 0.5, **change)
    assert decision.plan.is_off
    assert reason in decision.reasons


def test_a_mode_that_may_spray_in_flight_is_none_for_ground_work() -> None:
    bench = Bench(setup=GroundSetup(modes=frozenset({"GUIDED"})))
    decision = bench.run(NOW_S + 0.5, heartbeat=heartbeat(mode="GUIDED"))
    assert decision.reasons == {GroundReason.MISSION_MODE}


@pytest.mark.parametrize("autopilot", ["px4", "autopilot 0"])
def test_servo_outputs_of_px4_are_refused_and_gpio_beside_it_is_not(autopilot: str) -> None:
    beat = heartbeat(autopilot=autopilot)
    servo = Bench(setup=GroundSetup(has_servo_outputs=True)).run(NOW_S + 0.5, heartbeat=beat)
    assert servo.reasons == {GroundReason.OUTPUTS_NEED_ARMING}
    assert not Bench().run(NOW_S + 0.5, heartbeat=beat).plan.is_off


def test_an_emergency_stop_that_is_wired_must_be_heard() -> None:
    setup = GroundSetup(has_estop_line=True)
    assert Bench(setup=setup).run(NOW_S + 0.5).reasons == {GroundReason.ESTOP_UNKNOWN}
    assert not Bench(setup=setup).run(NOW_S + 0.5, estop_line=False).plan.is_off


def switched(state: GroundState, *pulses_us: tuple[int, ...]) -> GroundState:
    for pulse_us in pulses_us:
        state = observe_ground(state, RcReport(received_s=NOW_S, pulse_us=pulse_us))
    return state


ON, MIDDLE, OFF, LOST = (1500, 1900), (1500, 1500), (1500, 1000), (0, 0)


@pytest.mark.parametrize("last", [OFF, LOST, ()])
def test_turning_the_switch_off_ends_ground_work_until_it_is_on_again(
    last: tuple[int, ...],
) -> None:
    setup = GroundSetup(rc_channel=2)
    on = switched(state_at(NOW_S), OFF, ON, MIDDLE)
    off = switched(on, last)
    bench = Bench(setup=setup).opened()
    assert not bench.step(NOW_S + 0.55, turned_off=on.turned_off).plan.is_off
    stopped = bench.step(NOW_S + 0.6, turned_off=off.turned_off)
    assert (stopped.plan.is_off, stopped.is_over) == (True, True)
    assert stopped.reasons == {GroundReason.STOPPED}
    assert switched(off, OFF).turned_off >= {2}
    assert 2 not in switched(off, ON).turned_off


def test_a_switch_that_was_never_on_or_is_not_configured_stops_nothing() -> None:
    off = switched(state_at(NOW_S), OFF, LOST, OFF)
    decision = Bench(setup=GroundSetup(rc_channel=2)).run(NOW_S + 0.5, turned_off=off.turned_off)
    assert not decision.plan.is_off
    turned = switched(state_at(NOW_S), ON, OFF)
    assert not Bench().run(NOW_S + 0.5, turned_off=turned.turned_off).plan.is_off


@pytest.mark.parametrize(
    "item",
    [
        OperatorCommand(received_s=NOW_S, enable=False, source="command"),
        OperatorCommand(received_s=NOW_S, enable=True, source="command"),
        EstopReport(received_s=NOW_S, pressed=True, source="line"),
        EstopReport(received_s=NOW_S, pressed=True, source="command"),
    ],
)
def test_whoever_commands_the_sprayer_ends_ground_work_for_good(
    item: OperatorCommand | EstopReport,
) -> None:
    state = observe_ground(state_at(NOW_S), item)
    assert state.was_stopped
    released = EstopReport(received_s=NOW_S, pressed=False, source="line")
    assert observe_ground(state, released).was_stopped


def test_what_ground_work_does_not_need_changes_nothing() -> None:
    state = state_at(NOW_S)
    assert observe_ground(state, SpeedReport(received_s=NOW_S, ground_speed_m_s=3.0)) is state


# ----------------------------------------------------------------------------------------- hold


def test_it_opens_with_the_fourth_stroke_over_three_tenths_and_not_before() -> None:
    bench = Bench()
    for at_s in (0.1, 0.2, 0.3):
        assert bench.step(NOW_S + at_s).reasons == {GroundReason.NOT_HELD}
    assert bench.step(NOW_S + 0.35, stroke=False).plan.is_off
    assert not bench.step(NOW_S + 0.4).plan.is_off
    quick = Bench()
    for number in range(1, 7):
        assert quick.step(NOW_S + 0.05 * number).plan.is_off
    assert not quick.step(NOW_S + 0.35).plan.is_off


def test_few_strokes_over_a_long_time_are_no_hold() -> None:
    bench = Bench()
    for at_s in (0.1, 0.5, 0.9):
        assert bench.step(NOW_S + at_s).plan.is_off
    assert not bench.step(NOW_S + 1.3).plan.is_off
    late = Bench()
    for at_s in (0.1, 0.2, 0.3, 0.8, 0.9, 1.0):
        assert late.step(NOW_S + at_s).plan.is_off, "after half a second it begins anew"
    assert not late.step(NOW_S + 1.1).plan.is_off


def test_a_burst_of_strokes_is_one_however_long_it_takes() -> None:
    hold = Hold()
    for number in range(1000):
        hold = hold.renewed(NOW_S + 0.001 * number % 0.0095)
    assert (hold.strokes, hold.last_s) == (1, NOW_S)
    # A connection that trickles for less than three tenths of a second opens nothing either.
    for number in range(29):
        hold = hold.renewed(NOW_S + 0.01 * number)
        assert not hold.is_held(hold.last_s)


def test_after_a_standstill_of_this_process_a_hold_begins_anew() -> None:
    bench = Bench().opened()
    for number in range(1, 6):
        bench.hold = bench.hold.renewed(bench.now_s + 0.1 * number)
    went_on_s = bench.now_s + 0.51
    late = bench.step(went_on_s)
    assert late.reasons == {GroundReason.NOT_HELD}, "strokes came, but nobody was there"
    assert bench.run(went_on_s + 0.4).plan.is_off, "nor does it help that they go on"
    bench.run(went_on_s + 1.2, stroke=False)
    assert not bench.run(went_on_s + 1.8).plan.is_off


def test_a_step_half_a_second_after_the_last_is_no_standstill() -> None:
    bench = Bench().opened()
    for number in range(1, 5):
        bench.hold = bench.hold.renewed(bench.now_s + 0.1 * number)
    assert not bench.step(bench.now_s + 0.49).plan.is_off


def test_a_key_that_was_down_before_the_start_does_not_count() -> None:
    bench = Bench()
    bench.hold = held(NOW_S, since_s=NOW_S - 1.0)
    assert bench.run(NOW_S + 3.0).reasons == {GroundReason.NOT_HELD}


def test_silence_closes_half_a_second_after_the_last_stroke_even_without_a_step() -> None:
    bench = Bench().opened()
    decision = bench.step(bench.now_s + 0.4, stroke=False)
    assert not decision.plan.is_off
    assert decision.plan.lease_until_s == pytest.approx(bench.hold.last_s + 0.5)
    assert bench.step(bench.hold.last_s + 0.5, stroke=False).plan.is_off


@pytest.mark.parametrize("wrong_s", [math.nan, math.inf, -math.inf, NOW_S - 5.0])
def test_a_stroke_at_no_time_is_none(wrong_s: float) -> None:
    hold = held(NOW_S + 0.3)
    assert hold.renewed(wrong_s) == hold
    assert not Hold(first_s=NOW_S, last_s=math.nan, strokes=9).is_held(NOW_S)
    assert not Hold(first_s=math.nan, last_s=NOW_S, strokes=9).is_held(NOW_S)
    assert not Hold(first_s=NOW_S, last_s=NOW_S + 9.0, strokes=9).is_held(NOW_S + 1.0)


def test_priming_goes_on_where_the_key_was_let_go() -> None:
    bench = Bench().opened()
    bench.run(NOW_S + 4.0)
    pause = bench.run(NOW_S + 8.0, stroke=False)
    assert pause.reasons == {GroundReason.NOT_HELD}
    assert not pause.is_over
    done_s = pause.done_s
    again = bench.run(NOW_S + 9.0)
    assert not again.plan.is_off
    assert done_s < again.done_s < done_s + 1.0


def test_a_catch_that_is_let_go_is_over() -> None:
    bench = Bench(CATCH).opened()
    end = bench.run(NOW_S + 2.0, stroke=False)
    assert end.is_over
    assert end.reasons == {GroundReason.NOT_HELD}
    assert bench.run(NOW_S + 4.0).reasons >= {GroundReason.NOT_HELD}


def test_a_catch_during_which_the_computer_stood_still_is_over() -> None:
    bench = Bench(CATCH).opened()
    bench.hold = held(NOW_S + 0.95)
    decision = bench.step(NOW_S + 0.95)
    assert decision.reasons == {GroundReason.STALLED}
    assert decision.is_over


def test_a_time_that_is_none_closes() -> None:
    bench = Bench().opened()
    for wrong_s in (math.nan, math.inf):
        order = GroundOrder(task=PRIME, started_s=NOW_S, hold=bench.hold)
        decision, _ = ground_step(
            SETUP, state_at(bench.now_s), order, bench.memory, wrong_s, valve_count=3
        )
        assert decision.plan.is_off
        assert decision.is_over


def test_without_an_order_or_with_one_for_another_sprayer_all_is_closed() -> None:
    decision, _ = ground_step(SETUP, state_at(NOW_S), None, GroundMemory(), NOW_S, valve_count=3)
    assert decision.reasons == {GroundReason.NO_ORDER}
    order = GroundOrder(task=PRIME, started_s=NOW_S - 1.0, hold=held(NOW_S, since_s=NOW_S - 0.5))
    decision, _ = ground_step(SETUP, state_at(NOW_S), order, GroundMemory(), NOW_S, valve_count=4)
    assert decision.reasons == {GroundReason.NO_ORDER}


# ----------------------------------------------------------------------------------------- time


def test_the_piece_ends_at_its_time_and_the_lease_with_it() -> None:
    bench = Bench().pressed(-0.1, 0.0)
    bench.step(NOW_S + 0.1)
    began = bench.step(NOW_S + 0.2)
    assert not began.plan.is_off
    late = bench.run(NOW_S + 10.15)
    assert late.plan.lease_until_s == pytest.approx(NOW_S + 10.2, abs=1e-6)
    end = bench.step(NOW_S + 10.2)
    assert end.reasons == {GroundReason.DONE}
    assert end.is_over
    assert end.done_s == pytest.approx(10.0, abs=1e-6)


@pytest.mark.parametrize("kind", [GroundKind.PRIME, GroundKind.FLUSH, GroundKind.CATCH])
def test_a_piece_as_long_as_may_be_is_done_and_not_out_of_time(kind: GroundKind) -> None:
    task = together(kind, 3, (0,), duty=1.0, seconds=PIECE_MAX_S)
    bench = Bench(task).pressed(-0.1, 0.0)
    while not (end := bench.step(bench.now_s + 0.0503)).is_over:
        assert bench.now_s < NOW_S + 2.0 * PIECE_MAX_S
    assert end.reasons == {GroundReason.DONE}
    assert end.done_s == pytest.approx(PIECE_MAX_S, abs=0.06)


def test_after_thirty_seconds_in_all_it_needs_a_new_start() -> None:
    bench = Bench(together(GroundKind.FLUSH, 3, (0,), duty=1.0, seconds=30.0)).opened()
    began_s = bench.memory.began_s
    assert began_s is not None
    bench.run(NOW_S + 10.0, stroke=False)
    last = bench.run(began_s + 29.9)
    assert not last.plan.is_off
    assert last.plan.lease_until_s <= began_s + 30.0
    assert bench.run(NOW_S + 31.0).reasons >= {GroundReason.TIME_OVER}
    bench.started_s = bench.now_s
    assert bench.run(bench.now_s + 0.4).reasons == {GroundReason.NOT_HELD}, "the key must be let go"
    bench.run(bench.now_s + 1.0, stroke=False)
    assert not bench.run(bench.now_s + 0.4).plan.is_off


def test_a_start_is_good_for_thirty_seconds_and_an_older_one_for_nothing() -> None:
    bench = Bench()
    bench.run(NOW_S + 30.0, stroke=False)
    assert bench.run(NOW_S + 31.0).reasons >= {GroundReason.TIME_OVER}
    bench = Bench().opened()
    bench.started_s = NOW_S - 5.0
    assert bench.run(bench.now_s + 1.0).reasons == {GroundReason.TIME_OVER}
    bench.started_s = math.nan
    assert bench.step(bench.now_s + 0.05).reasons >= {GroundReason.TIME_OVER}


# ---------------------------------------------------------------------------------------- tasks


def test_a_click_opens_each_valve_twice_for_a_fifth_of_a_second() -> None:
    bench = Bench(clicks(3, (0, 2))).pressed(-0.195, -0.095, 0.0)
    edges: dict[int, list[tuple[float, float]]] = {0: [], 1: [], 2: []}
    duty = (0.0,) * 3
    bench.step(NOW_S + 0.1)
    for number in range(2000):
        at_s = NOW_S + 0.11 + number * 0.001
        plan = bench.step(at_s).plan
        for valve in range(3):
            if plan.duty[valve] != duty[valve]:
                edges[valve].append((at_s - NOW_S - 0.11, plan.duty[valve]))
        duty = plan.duty
        assert sum(map(bool, duty)) <= 1
    assert edges[1] == []
    assert [edge[0] for edge in edges[0]] == pytest.approx([0.0, 0.2, 0.4, 0.6], abs=2e-3)
    assert [edge[0] for edge in edges[2]] == pytest.approx([0.8, 1.0, 1.2, 1.4], abs=2e-3)


def test_what_comes_within_the_lease_is_ordered_ahead_at_its_time() -> None:
    bench = Bench(in_turn(GroundKind.FLUSH, 3, (0, 1), duty=1.0, seconds=4.0))
    bench.pressed(-0.1, 0.0)
    bench.step(NOW_S + 0.1)
    bench.step(NOW_S + 0.2)
    plan = bench.run(NOW_S + 2.0).plan
    assert plan.duty == (1.0, 0.0, 0.0)
    changes = [(change.valve, change.duty) for change in plan.changes]
    assert changes == [(0, 0.0), (1, 1.0)]
    assert all(change.at_s == pytest.approx(NOW_S + 2.2) for change in plan.changes)


def test_the_drives_run_while_it_is_open_and_stand_when_it_is_not() -> None:
    bench = Bench(replace(PRIME, drives=(0.4,))).opened()
    plan = bench.step(bench.now_s + 0.05).plan
    assert [drive.fraction for drive in plan.drives] == [0.4]
    closed = bench.step(bench.now_s + 0.05, heartbeat=None).plan
    assert closed.is_off
    assert all(drive.is_off for drive in closed.drives)


@pytest.mark.parametrize(
    "change",
    [
        {"seconds": 30.1},
        {"seconds": 0.0},
        {"seconds": math.nan},
        {"phases": ()},
        {"phases": (Phase(at_s=0.5, duty=(1.0,)),)},
        {"phases": (Phase(at_s=0.0, duty=(1.1,)),)},
        {"phases": (Phase(at_s=0.0, duty=(math.nan,)),)},
        {"phases": (Phase(at_s=0.0, duty=()),)},
        {"phases": (Phase(at_s=0.0, duty=(1.0,)), Phase(at_s=9.0, duty=(0.0, 1.0)))},
        {"phases": (Phase(at_s=0.0, duty=(1.0,)), Phase(at_s=10.0, duty=(0.0,)))},
        {"drives": (1.5,)},
    ],
)
def test_a_task_that_makes_no_sense_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        replace(PRIME, **change)  # type: ignore[arg-type]


def test_what_is_expected_in_the_cups_is_that_of_the_curve_and_the_lags() -> None:
    curve = FlowCurve(duty=(0.2, 0.5, 1.0), flow_l_min=(1.2, 3.0, 6.0))
    small = FlowCurve(duty=(0.2, 0.5, 1.0), flow_l_min=(1.0, 2.2, 4.4))
    sets = (
        NozzleSet(valves=(0, 1, 2, 3), curve=small),
        NozzleSet(valves=tuple(range(6)), curve=curve),
    )
    assert flow_of(sets, tuple(range(6)), 0.5) == pytest.approx(3.0)
    assert flow_of(sets, (0, 1, 2, 3), 0.5) == pytest.approx(2.2)
    assert flow_of(sets, (5,), 0.5) == pytest.approx(0.5)
    assert flow_of(sets, (), 0.5) == flow_of((), (1,), 0.5) == 0.0
    lag = builders.LAG
    ml = expected_ml(3.0, open_s=30.0, lag=lag)
    assert ml == pytest.approx(3000.0 / 60.0 * (30.0 + lag.off_s - lag.on_s))
    assert expected_ml(3.0, open_s=0.0, lag=lag) == 0.0
