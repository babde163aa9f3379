"""The slow trim of the flow: it follows a drift, waits when it must, and never hides a clog."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import shapely

from analysis.journals.content import read_journal
from analysis.replay import FlownCore, replay
from companion.config import load
from companion.core.controller import Memory, step
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.options import flow_trim
from companion.core.options.flow_meter import Sample, flows_over, with_order
from companion.core.options.flow_trim import FlowTrim
from companion.core.prescription import Prescription
from companion.core.setup import Setup
from companion.core.types import (
    Decision,
    EstimatorReport,
    Fix,
    FlowReport,
    FlowTrimState,
    GnssReport,
    HeartbeatReport,
    LandedReport,
    OperatorCommand,
)
from companion.journal.journal import Journal
from missions.maps.compiling import compiled_setup
from tests.builders import CURVE, flying, plots, position, setup
from tests.companion.trim_bench import STEP_S, TrimBench, tracking

NAN, INF = math.nan, math.inf
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"


# ------------------------------------------------------------------------------------- it follows


def test_the_trim_becomes_metered_over_expected_flow() -> None:
    assert tracking(gain=1.08).trim == pytest.approx(1.08, abs=0.002)
    assert tracking(gain=0.93).trim == pytest.approx(0.93, abs=0.002)


def test_the_reference_bench_tracks() -> None:
    assert tracking().state is FlowTrimState.TRACKING


def test_it_is_as_slow_as_its_time_constant() -> None:
    bench = TrimBench(law=FlowTrim(tau_s=5.0))
    while bench.state is not FlowTrimState.TRACKING:
        bench.step()
    bench.run(5.0)
    assert (bench.trim - 1.0) / 0.08 == pytest.approx(1.0 - math.exp(-1.0), abs=0.03)


def test_a_right_table_is_left_alone() -> None:
    bench = tracking(gain=1.0, meter_noise=0.01)
    assert max(abs(trim - 1.0) for trim in bench.trims) < 0.003


def test_an_order_whose_flow_is_on_its_way_is_no_error() -> None:
    bench = tracking(gain=1.0)
    trim = bench.trim
    for number in range(200):  # the speed moves the duties, as gusts do, without a change of zone
        bench.wanted_l_min = 4.0 * (1.0 + 0.2 * math.sin(number * STEP_S))
        bench.step()
    assert bench.state is FlowTrimState.TRACKING
    assert bench.trim == pytest.approx(trim, abs=0.003)


def test_each_nozzle_set_has_its_own() -> None:
    bench = TrimBench(gain=1.08, set_count=2).run(30.0)
    bench.index, bench.gain = 1, 0.95
    bench.run(40.0)
    assert bench.memory.sets[0].trim == pytest.approx(1.08, abs=0.003)
    assert bench.memory.sets[1].trim == pytest.approx(0.95, abs=0.003)


# ---------------------------------------------------------------------------------------- it waits


def moved(bench: TrimBench, **how: object) -> float:
    """Return how far the trim goes in one step."""
    before = bench.trim
    bench.step(**how)  # type: ignore[arg-type]
    return abs(bench.trim - before)


def drifting() -> TrimBench:
    """Return a bench that tracks and still has far to go."""
    bench = TrimBench(gain=1.08).run(4.0)
    assert bench.state is FlowTrimState.TRACKING
    assert moved(bench) > 0.0
    return bench


def test_at_an_end_of_the_duties_range_it_waits() -> None:
    bench = drifting()
    assert moved(bench, is_saturated=True) == 0.0
    assert bench.state is FlowTrimState.FROZEN


def steps_until_tracking(bench: TrimBench) -> int:
    for number in range(1, 200):
        trim = bench.trim
        bench.step()
        if bench.state is FlowTrimState.TRACKING:
            return number
        assert bench.trim == trim
    raise AssertionError("it never tracks again")


def test_after_a_change_it_waits_for_its_time() -> None:
    bench = drifting()
    assert moved(bench, is_steady=False) == 0.0
    assert bench.state is FlowTrimState.FROZEN
    assert steps_until_tracking(bench) * STEP_S == pytest.approx(2.0, abs=1.5 * STEP_S)


def test_a_longer_lag_than_the_waiting_time_is_waited_for() -> None:
    bench = TrimBench(law=FlowTrim(settle_s=0.0)).run(4.0)
    bench.step(is_steady=False)
    waited_s = steps_until_tracking(bench) * STEP_S
    least_s = bench.trimming.clear_s + bench.trimming.window_s
    assert 3 * 0.11 + 1.0 < least_s == pytest.approx(waited_s, abs=2.0 * STEP_S)


def test_after_a_change_of_the_nozzle_set_it_waits() -> None:
    bench = TrimBench(gain=1.08, set_count=2).run(4.0)
    bench.index = 1
    bench.step()
    assert bench.state is FlowTrimState.FROZEN
    assert steps_until_tracking(bench) * STEP_S == pytest.approx(2.0, abs=1.5 * STEP_S)


def test_after_a_pause_it_waits_and_keeps_the_trim() -> None:
    bench = drifting()
    trim = bench.trim
    bench.memory = flow_trim.pause(bench.memory, bench.report(), now_s=bench.now_s)
    assert bench.state is FlowTrimState.FROZEN
    assert bench.trim == trim
    assert steps_until_tracking(bench) * STEP_S == pytest.approx(2.0, abs=1.5 * STEP_S)


def test_a_pause_without_a_meter_says_so() -> None:
    memory = flow_trim.pause(flow_trim.begin(1), None, now_s=1.0)
    assert memory.state is FlowTrimState.NO_METER


@pytest.mark.parametrize("wanted_l_min", [0.0, 0.3])
def test_below_the_meters_minimum_it_waits(wanted_l_min: float) -> None:
    bench = TrimBench(wanted_l_min=wanted_l_min).run(10.0)
    assert bench.state is FlowTrimState.FROZEN
    assert set(bench.trims) == {1.0}


def test_a_flow_that_the_meter_sees_below_its_minimum_is_not_taken() -> None:
    bench = TrimBench(wanted_l_min=0.55, gain=0.88).run(10.0)
    assert bench.state is FlowTrimState.FROZEN
    assert set(bench.trims) == {1.0}


def test_without_a_meter_the_trim_stays_1_and_says_so() -> None:
    bench = TrimBench()
    for _ in range(200):
        bench.step(meter=False)
    assert bench.state is FlowTrimState.NO_METER
    assert set(bench.trims) == {1.0}


def test_a_silent_meter_stops_the_trim_within_half_a_second() -> None:
    bench = drifting()
    for _ in range(12):
        assert moved(bench, meter=False) == 0.0
    assert bench.state is FlowTrimState.NO_METER
    assert steps_until_tracking(bench) * STEP_S > 1.0  # a whole window of new counts


UNSOUND = {
    "nan": lambda now_s, ml: FlowReport(received_s=now_s, volume_ml=NAN),
    "infinite": lambda now_s, ml: FlowReport(received_s=now_s, volume_ml=INF),
    "backwards": lambda now_s, ml: FlowReport(received_s=now_s, volume_ml=ml - 1.0),
    "from zero again": lambda now_s, ml: FlowReport(received_s=now_s, volume_ml=0.0),
    "from the future": lambda now_s, ml: FlowReport(received_s=now_s + 1.0, volume_ml=ml),
    "late": lambda now_s, ml: FlowReport(received_s=now_s - 1.0, volume_ml=ml),
    "out of order": lambda now_s, ml: FlowReport(received_s=now_s - 0.2, volume_ml=ml),
    "without a time": lambda now_s, ml: FlowReport(received_s=NAN, volume_ml=ml),
    "changed": lambda now_s, ml: FlowReport(received_s=now_s - STEP_S, volume_ml=ml + 1.0),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_an_unsound_count_is_no_evidence(name: str) -> None:
    bench = drifting()
    assert bench.memory.report is not None
    wrong = UNSOUND[name](bench.now_s + STEP_S, bench.memory.report.volume_ml)
    assert moved(bench, report=wrong) == 0.0
    assert bench.state is FlowTrimState.NO_METER
    assert not bench.memory.samples
    bench.run(3.0)
    assert bench.state is FlowTrimState.TRACKING


def test_a_count_heard_twice_moves_nothing() -> None:
    bench = drifting()
    assert moved(bench, report=bench.memory.report) == 0.0


# ----------------------------------------------------------------------------- it hides no failure


def test_a_clog_is_reported_and_not_compensated() -> None:
    bench = tracking(gain=1.05)
    trim = bench.trim
    bench.gain = 1.05 * 0.853  # one of six valves shut, as on the twin
    bench.run(2.0)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE
    bench.run(60.0)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE
    assert bench.trim == pytest.approx(trim, abs=0.001)


def test_a_burst_hose_is_no_drift_either() -> None:
    bench = tracking(gain=1.0)
    bench.gain = 1.14
    bench.run(10.0)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE
    assert bench.trim == pytest.approx(1.0, abs=0.001)


def test_a_clog_during_a_change_is_seen_after_it() -> None:
    bench = tracking(gain=1.0)
    bench.gain = 0.85
    bench.step(is_steady=False)
    bench.run(10.0)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE
    assert bench.trim == pytest.approx(1.0, abs=0.001)


def test_the_report_of_a_clog_stands_through_changes_and_pauses() -> None:
    bench = tracking(gain=1.0)
    bench.gain = 0.85
    bench.run(3.0)
    bench.step(is_steady=False)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE
    bench.memory = flow_trim.pause(bench.memory, bench.report(), now_s=bench.now_s)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE


def test_when_the_flow_is_back_the_trim_goes_on() -> None:
    bench = tracking(gain=1.0)
    bench.gain = 0.8
    bench.run(5.0)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE
    bench.gain = 1.02
    bench.run(40.0)
    assert bench.state is FlowTrimState.TRACKING
    assert bench.trim == pytest.approx(1.02, abs=0.002)


def test_a_slow_drift_is_no_sudden_change() -> None:
    bench = tracking(gain=1.0)
    for number in range(400):
        bench.gain = 1.0 - 0.12 * number / 400
        bench.step()
    assert FlowTrimState.SUDDEN_CHANGE not in bench.states


def test_a_dead_meter_is_not_believed() -> None:
    bench = TrimBench(gain=0.0).run(20.0)
    assert bench.state is FlowTrimState.IMPLAUSIBLE
    assert set(bench.trims) == {1.0}


def test_a_meter_that_dies_holds_the_trim() -> None:
    bench = tracking(gain=1.05)
    trim = bench.trim
    bench.gain = 0.0
    bench.run(20.0)
    assert bench.state is FlowTrimState.SUDDEN_CHANGE
    assert bench.trim == pytest.approx(trim, abs=0.001)


@pytest.mark.parametrize(("gain", "end"), [(1.2, 1.15), (0.8, 0.85)])
def test_the_trim_ends_at_its_limit_and_says_so_after_ten_seconds(gain: float, end: float) -> None:
    bench = TrimBench(gain=gain)
    while bench.trim != end:
        bench.step()
        assert 0.85 <= bench.trim <= 1.15
        assert bench.state is not FlowTrimState.AT_LIMIT
    bench.run(9.5)
    assert bench.state is FlowTrimState.TRACKING
    bench.run(1.0)
    assert bench.state is FlowTrimState.AT_LIMIT
    assert bench.trim == end
    bench.step(is_steady=False)
    assert bench.state is FlowTrimState.AT_LIMIT


def test_a_trim_that_leaves_its_limit_says_so_no_more() -> None:
    bench = TrimBench(gain=1.16).run(60.0)
    assert bench.state is FlowTrimState.AT_LIMIT
    bench.gain = 1.08
    bench.run(5.0)
    assert bench.state is FlowTrimState.TRACKING


@pytest.mark.parametrize(
    "change",
    [
        {"tau_s": 0.5}, {"tau_s": NAN}, {"limit": 0.0}, {"limit": 0.3}, {"limit": NAN},
        {"meter_minimum_l_min": -1.0}, {"meter_minimum_l_min": NAN}, {"settle_s": -1.0},
        {"settle_s": INF},
    ],
)  # fmt: skip
def test_a_law_out_of_bounds_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        FlowTrim(**change)


# ---------------------------------------------------------------------------------- over a window


def test_flows_are_taken_between_counts_over_exactly_the_window() -> None:
    samples = (Sample(0.0, 0.0, 0.0), Sample(1.0, 20.0, 10.0), Sample(2.0, 30.0, 30.0))
    flows = flows_over(samples, 1.5)
    assert flows is not None
    assert flows.metered_ml_s == pytest.approx(20.0 / 1.5)
    assert flows.expected_ml_s == pytest.approx(25.0 / 1.5)
    assert flows_over(samples, 2.5) is None
    assert flows_over(samples[:1], 0.5) is None


def test_the_same_flow_ordered_again_takes_no_room() -> None:
    past = with_order((), flow_l_min=3.0, now_s=1.0, keep_s=1.0)
    assert with_order(past, flow_l_min=3.0, now_s=1.05, keep_s=1.0) is past
    more = with_order(past, flow_l_min=6.0, now_s=2.0, keep_s=1.0)
    assert [order.volume_ml for order in more] == pytest.approx([0.0, 50.0])
    assert len(with_order(more, flow_l_min=3.0, now_s=9.0, keep_s=1.0)) == 2


# ----------------------------------------------------------------------------- in the controller

ZONE = Prescription(plots([[20.0]], length_m=2000.0), boundary=shapely.box(0, -1, 2000, 7))
TRIMMED = setup(prescription=ZONE, flow_trim=FlowTrim())


class Sprayer:
    """Drives `step` along one long zone, with a sprayer of another gain than its table's."""

    def __init__(self, given: Setup, gain: float) -> None:
        self.given, self.gain = given, gain
        self.memory, self.number, self.volume_ml = Memory(), 0, 0.0
        self.flow_ml_s = 0.0
        self.decisions: list[Decision] = []

    def step(self, **change: object) -> Decision:
        now_s = 10.0 + self.number * STEP_S
        self.volume_ml += self.gain * self.flow_ml_s * STEP_S
        report = FlowReport(received_s=now_s, volume_ml=self.volume_ml)
        given = {"flow": report} | change
        state = flying(now_s, 10.0 + 5.0 * self.number * STEP_S, **given)
        decision, self.memory = step(self.given, state, self.memory, now_s)
        duty = decision.plan.duty_at(now_s)
        self.flow_ml_s = sum(CURVE.flow_for(value) for value in duty) / 6 * 1000.0 / 60.0
        self.number += 1
        self.decisions.append(decision)
        return decision

    def run(self, steps: int) -> Sprayer:
        for _ in range(steps):
            self.step()
        return self


def test_the_loop_delivers_what_is_wanted() -> None:
    sprayer = Sprayer(TRIMMED, gain=1.08).run(800)
    last = sprayer.decisions[-1]
    wanted = 20.0 * 5.0 * 6.0 * 60.0 / 10_000.0
    assert last.flow_trim == pytest.approx(1.08, abs=0.003)
    assert last.flow_trim_state is FlowTrimState.TRACKING
    assert sprayer.gain * sprayer.flow_ml_s * 0.06 == pytest.approx(wanted, rel=0.005)
    assert last.target_flow_l_min == pytest.approx(wanted)
    assert last.flow_l_min == pytest.approx(wanted, rel=0.005)


def test_the_trim_restarts_no_period() -> None:
    sprayer = Sprayer(TRIMMED, gain=1.08).run(800)
    changes = [change for decision in sprayer.decisions[5:] for change in decision.plan.changes]
    assert changes
    assert not any(change.restart for change in changes)


def test_without_a_trim_configured_the_meter_changes_nothing() -> None:
    given = setup(prescription=ZONE)
    metered, alone = Sprayer(given, gain=1.08).run(200), Sprayer(given, gain=1.0)
    for _ in range(200):
        alone.step(flow=None)
    plans = [decision.plan for decision in metered.decisions]
    assert plans == [decision.plan for decision in alone.decisions]
    assert metered.decisions[-1].flow_trim is None
    assert metered.decisions[-1].flow_trim_state is None


def test_a_trim_of_1_changes_nothing() -> None:
    plain, trimmed = Sprayer(setup(prescription=ZONE), gain=1.0), Sprayer(TRIMMED, gain=1.0)
    for _ in range(100):
        assert plain.step(flow=None).plan == trimmed.step(flow=None).plan
    assert trimmed.decisions[-1].flow_trim == 1.0
    assert trimmed.decisions[-1].flow_trim_state is FlowTrimState.NO_METER


def test_an_inhibit_closes_and_the_trim_outlives_it() -> None:
    sprayer = Sprayer(TRIMMED, gain=1.08).run(200)
    trim = sprayer.decisions[-1].flow_trim
    closed = sprayer.step(enabled=False)
    assert closed.plan.is_off
    assert closed.flow_trim == trim != 1.0
    assert closed.flow_trim_state is FlowTrimState.FROZEN
    opened = sprayer.step()
    assert opened.flow_trim == trim
    assert not opened.plan.is_off


def test_without_a_state_no_count_is_known() -> None:
    decision, _ = step(TRIMMED, None, Memory(), 10.0)
    assert decision.flow_trim == 1.0
    assert decision.flow_trim_state is FlowTrimState.NO_METER


def test_a_change_of_zone_freezes_the_trim() -> None:
    field = Prescription(
        plots([[20.0, 25.0]], length_m=100.0), boundary=shapely.box(0.0, -1.0, 200.0, 7.0)
    )
    sprayer = Sprayer(setup(prescription=field, flow_trim=FlowTrim()), gain=1.03).run(340)
    assert sprayer.decisions[-1].flow_trim_state is FlowTrimState.TRACKING
    frozen = []
    for _ in range(80):  # the change is ordered at 100 m less the lag: 17.9 s after the start
        decision = sprayer.step()
        if decision.flow_trim_state is FlowTrimState.FROZEN:
            frozen.append(decision.now_s)
    assert frozen[-1] - frozen[0] == pytest.approx(2.0, abs=2 * STEP_S)


def test_at_the_end_of_the_range_nothing_is_trimmed() -> None:
    field = Prescription(plots([[40.0]], length_m=2000.0), boundary=shapely.box(0, -1, 2000, 7))
    sprayer = Sprayer(setup(prescription=field, flow_trim=FlowTrim()), gain=1.05).run(200)
    assert max(sprayer.decisions[-1].plan.duty) == 1.0
    assert sprayer.decisions[-1].flow_trim == 1.0
    assert sprayer.decisions[-1].flow_trim_state is FlowTrimState.FROZEN


def test_a_boom_that_sprays_in_part_is_not_compared() -> None:
    boundary = shapely.box(0.0, 1.0, 2000.0, 7.0)
    field = Prescription(plots([[20.0]], length_m=2000.0), boundary=boundary)
    sprayer = Sprayer(setup(prescription=field, flow_trim=FlowTrim()), gain=1.05).run(200)
    assert min(sprayer.decisions[-1].plan.duty) == 0.0 < max(sprayer.decisions[-1].plan.duty)
    assert sprayer.decisions[-1].flow_trim == 1.0


def test_the_trim_is_that_of_the_set_in_use() -> None:
    large = NozzleSet(valves=tuple(range(6)), curve=CURVE)
    small = NozzleSet(
        valves=(0, 1, 2, 3),
        curve=FlowCurve(duty=(0.2, 0.5, 0.9), flow_l_min=(1.0, 2.2, 3.0)),
    )
    given = setup(prescription=ZONE, flow_trim=FlowTrim(), nozzle_sets=(small, large))
    sprayer = Sprayer(given, gain=1.08).run(200)
    assert sprayer.memory.ordering.trim is not None
    assert sprayer.memory.ordering.set_index == 1
    small_trim, large_trim = (trim.trim for trim in sprayer.memory.ordering.trim.sets)
    assert small_trim == 1.0
    assert sprayer.decisions[-1].flow_trim == large_trim > 1.02


# ------------------------------------------------------------------------- journal, configuration


def test_a_trimmed_flight_is_replayed_to_the_bit(tmp_path: Path) -> None:
    core, volume_ml, made = FlownCore(TRIMMED), 0.0, []
    with Journal.create(tmp_path, setup=TRIMMED, started_s=10.0, waits=True) as journal:
        for number in range(200):
            now_s = 10.0 + number * STEP_S
            volume_ml += 0.0 if not made else made[-1].flow_l_min * 1.05 * STEP_S / 0.06
            inputs = [
                HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=True, mode="AUTO"),
                GnssReport(received_s=now_s, fix=Fix.RTK_FIXED),
                EstimatorReport(received_s=now_s, healthy=True),
                LandedReport(received_s=now_s, in_air=True),
                OperatorCommand(received_s=now_s, enable=True, source="command"),
                FlowReport(received_s=now_s, volume_ml=volume_ml),
                position(now_s, 10.0 + 0.25 * number, 3.0, boot_s=number * STEP_S),
            ]
            for item in inputs:
                journal.record_input(item)
                core.observe(item)
            made.append(core.decide(now_s))
            journal.record_decision(made[-1])
    assert made[-1].flow_trim_state is FlowTrimState.TRACKING
    assert made[-1].flow_trim != 1.0
    assert read_journal(journal.path).setup.flow_trim == FlowTrim()
    found = replay(journal.path)
    assert (found.decisions, found.differences) == (200, 0)
    other = replay(journal.path, overrides=["flow_trim.tau_s=20"])
    assert other.differences > 0


def test_the_configuration_reaches_the_core() -> None:
    assert compiled_setup(load(EXAMPLE)).flow_trim is None
    overrides = [
        "flow_trim.enabled=true", "flow_trim.tau_s=8", "flow_trim.limit=0.1",
        "flow_trim.meter_minimum_l_min=0.8", "flow_trim.settle_s=3",
    ]  # fmt: skip
    law = FlowTrim(tau_s=8.0, limit=0.1, meter_minimum_l_min=0.8, settle_s=3.0)
    assert compiled_setup(load(EXAMPLE, overrides=overrides)).flow_trim == law


def test_defaults_of_configuration_and_core_are_the_same() -> None:
    enabled = load(EXAMPLE, overrides=["flow_trim.enabled=true"])
    assert compiled_setup(enabled).flow_trim == FlowTrim()


def test_a_sprayer_with_slow_lags_is_waited_for() -> None:
    slow = replace(TRIMMED.lag, up_s=2.0, down_s=1.5)
    trimming = replace(TRIMMED, lag=slow).trimming
    assert trimming is not None
    assert trimming.clear_s > 6.0
    assert trimming.wait_s > 7.0
