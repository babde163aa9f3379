"""Valves tracked by the total meter: a blocked one is named; noise and the gain move none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from analysis.journals.content import read_journal
from analysis.replay import FlownCore, replay
from companion.config import load
from companion.core.controller import Memory, step
from companion.core.nozzle import NozzleSet
from companion.core.options.valve_tracking import (
    NAMED_SHARE,
    TrackMemory,
    ValveTracking,
    deviations,
    follow,
)
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.core.types import (
    EstimatorReport,
    FaultKind,
    Fix,
    FlowReport,
    GnssReport,
    HeartbeatReport,
    LandedReport,
    OperatorCommand,
    SprayPlan,
)
from companion.errors import ConfigError
from companion.journal.journal import Journal
from missions.maps.compiling import compiled_setup
from tests.builders import CURVE, LAG, flying, position, setup

ANYANG = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
VALVES, STEP_S, DUTY = 6, 0.05, 0.8
TRACKED = setup(valve_tracking=ValveTracking())


class Sprayer:
    """A sprayer over spots: each valve opens and closes by itself; its meter has gain and noise."""

    def __init__(
        self, truth: list[float], *, gain: float = 1.0, seed: int = 1, together: bool = False,
        delay_s: float = 0.001, given: Setup = TRACKED,
    ) -> None:  # fmt: skip
        self.truth, self.gain, self.together, self.delay_s = truth, gain, together, delay_s
        self.given, self.rng = given, np.random.default_rng(seed)
        self.memory: TrackMemory | None = None
        self.number, self.is_open = 0, np.zeros(VALVES, dtype=bool)
        self.edges: list[tuple[float, int, float]] = []
        self.findings: list[int | None] = []

    def run(self, seconds: float) -> Sprayer:
        assert self.given.tracking is not None
        for _ in range(round(seconds / STEP_S)):
            now_s = 10.0 + self.number * STEP_S
            duty = tuple(DUTY if each else 0.0 for each in self.is_open)
            plan = SprayPlan(
                sequence=self.number + 1, issued_s=now_s - STEP_S, duty=duty, changes=(),
                lease_until_s=now_s + 1.0,
            )  # fmt: skip
            report = FlowReport(received_s=now_s, volume_ml=self.counted_ml(now_s))
            self.memory = follow(self.given.tracking, self.memory, plan, report, now_s=now_s)
            if self.number % 12 == 0:
                self.switch(now_s)
            self.number += 1
        return self

    def switch(self, at_s: float) -> None:
        drawn = self.rng.random(VALVES) < 0.6
        after = np.full(VALVES, drawn[0]) if self.together else drawn
        for valve in np.flatnonzero(after != self.is_open):
            is_on = bool(after[valve])
            lag_s = (LAG.on_s if is_on else LAG.off_s) + LAG.output_s
            # The share of the truth at that time, so that a valve may block in flight.
            flow = self.truth[valve] * CURVE.flow_for(DUTY) / VALVES * 1000.0 / 60.0
            self.edges.append((at_s + lag_s, int(valve), flow if is_on else 0.0))
        self.is_open = after

    def counted_ml(self, now_s: float) -> float:
        until_s, volume, flows, last_s = now_s - self.delay_s, 0.0, [0.0] * VALVES, 0.0
        if not hasattr(self, "past"):
            self.past = (0.0, [0.0] * VALVES, 0.0)
        last_s, flows, volume = self.past[0], list(self.past[1]), self.past[2]
        left = []
        for at_s, valve, flow in sorted(self.edges):
            if at_s > until_s:
                left.append((at_s, valve, flow))
                continue
            volume += sum(flows) * (at_s - last_s)
            last_s, flows[valve] = at_s, flow
        volume += sum(flows) * (until_s - last_s)
        self.edges, self.past = left, (until_s, flows, volume)
        # Whole pulses, and what a meter's reading wanders.
        pulses = np.floor(self.gain * volume * 4.6 + self.rng.random())
        self.shown = max(getattr(self, "shown", 0.0), float(pulses) / 4.6)
        return self.shown

    def shares(self) -> tuple[float, ...]:
        assert self.memory is not None
        return self.memory.nozzles.shares or (1.0,) * VALVES

    def named(self) -> list[int | None]:
        assert self.memory is not None
        return [finding.valve for finding in self.memory.findings]


HEALTHY = [1.0] * VALVES


def test_a_valve_that_blocks_in_flight_is_named_once_and_dosed_for() -> None:
    sprayer = Sprayer(list(HEALTHY)).run(60.0)
    assert sprayer.named() == []
    sprayer.truth[2] = 0.85
    sprayer.run(400.0)
    assert sprayer.named() == [2]
    assert sprayer.memory is not None
    (finding,) = sprayer.memory.findings
    assert finding.kind is FaultKind.VALVE_DRIFT
    assert "less than the others" in finding.text
    found = sprayer.shares()
    assert 0.85 < found[2] < 0.96
    assert max(found[:2] + found[3:]) < 1.04
    assert sum(found) / VALVES == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("gain", [0.97, 1.03])
def test_neither_noise_nor_the_meters_gain_moves_a_factor(gain: float) -> None:
    for seed in range(4):
        sprayer = Sprayer(list(HEALTHY), gain=gain, seed=seed).run(120.0)
        assert sprayer.named() == []
        assert sprayer.shares() == pytest.approx(HEALTHY, abs=0.001)


def test_a_factor_stops_at_its_limit_and_the_mean_stays_1() -> None:
    given = setup(valve_tracking=ValveTracking(limit=0.05))
    sprayer = Sprayer([1.0, 1.0, 0.6, 1.0, 1.0, 1.0], given=given).run(120.0)
    found = sprayer.shares()
    assert found[2] == pytest.approx(0.95, abs=1e-6)
    assert max(abs(share - 1.0) for share in found) <= 0.05 + 1e-9
    assert sum(found) / VALVES == pytest.approx(1.0, abs=1e-9)


def test_valves_that_do_the_same_tell_nothing() -> None:
    sprayer = Sprayer([1.0, 1.0, 0.7, 1.0, 1.0, 1.0], together=True).run(120.0)
    assert sprayer.shares() == (1.0,) * VALVES
    assert sprayer.memory is not None
    assert sprayer.given.tracking is not None
    off = deviations(sprayer.given.tracking, sprayer.memory.estimate)
    assert [value for value, _ in off] == pytest.approx([0.0] * VALVES, abs=1e-12)


def test_the_meters_delay_counts() -> None:
    late = setup(valve_tracking=ValveTracking(meter_delay_s=0.3))
    right = Sprayer(list(HEALTHY), delay_s=0.3, given=late).run(60.0)
    wrong = Sprayer(list(HEALTHY), delay_s=0.3).run(60.0)
    assert right.memory is not None
    assert wrong.memory is not None
    assert right.memory.estimate.scale < 0.5 * wrong.memory.estimate.scale


def test_a_meter_that_falls_silent_teaches_nothing() -> None:
    sprayer = Sprayer(list(HEALTHY)).run(30.0)
    tracking = sprayer.given.tracking
    assert tracking is not None
    before = sprayer.memory
    assert before is not None
    after = follow(tracking, before, None, None, now_s=100.0)
    assert after.estimate is before.estimate
    assert after.begun_s is None
    report = FlowReport(received_s=101.0, volume_ml=9e9)
    again = follow(tracking, after, None, report, now_s=101.0)
    assert again.estimate is before.estimate


def test_known_factors_are_kept_beside_what_is_tracked() -> None:
    known = NozzleSet.with_factors(tuple(range(VALVES)), CURVE, (0.9, 1.1, 1.0, 1.0, 1.0, 1.0))
    given = setup(valve_tracking=ValveTracking(), nozzle_sets=(known,))
    sprayer = Sprayer([0.9, 1.1, 1.0, 1.0, 1.0, 1.0], given=given).run(120.0)
    assert sprayer.named() == []
    assert sprayer.shares() == pytest.approx(known.shares, abs=0.02)


def test_the_dose_follows_the_tracked_share() -> None:
    """The controller asks more duty of a valve that is known to give less."""
    zone = Zone(name="all", polygon=shapely.box(0, 0, 2000, 6), rate_l_ha=20.0)
    given = setup(
        prescription=Prescription([zone], boundary=shapely.box(0, -1, 2000, 7)),
        valve_tracking=ValveTracking(),
    )
    assert given.tracking is not None
    memory = Memory()
    _, memory = step(given, flying(10.0, 300.0), memory, 10.0)
    assert memory.watched.track is not None
    shares = (1.02, 1.02, 0.9, 1.02, 1.02, 1.02)
    known = replace(given.nozzle_sets[0], shares=shares)
    track = memory.watched.track._replace(nozzles=known)
    memory = replace(memory, watched=memory.watched._replace(track=track))
    for number in range(1, 20):  # a trim takes a few steps
        now_s = 10.0 + STEP_S * number
        decision, memory = step(given, flying(now_s, 300.0 + 5.0 * (now_s - 10.0)), memory, now_s)
    duty = decision.plan.duty
    ratio = CURVE.flow_for(duty[2]) / CURVE.flow_for(duty[0])
    assert ratio == pytest.approx(1.02 / 0.9, rel=0.01)


@pytest.mark.parametrize(
    "change", [{"limit": 0.3}, {"tau_s": 1.0}, {"meter_delay_s": 2.0}, {"meter_minimum_l_min": -1}]
)
def test_a_setting_out_of_bounds_is_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(change))):
        ValveTracking(**change)


GPIO = ["flow_meter.source=gpio", "flow_meter.line=17", "flow_meter.pulses_per_l=4600"]


def test_the_configuration_turns_it_on_only_with_a_meter_read_here() -> None:
    assert compiled_setup(load(ANYANG)).valve_tracking is None
    on = ["valve_tracking.enabled=true", "valve_tracking.limit=0.05"]
    given = compiled_setup(load(ANYANG, overrides=[*on, *GPIO]))
    assert given.valve_tracking == ValveTracking(limit=0.05)
    for meter in ([], ["flow_meter.source=autopilot"]):
        with pytest.raises(ConfigError, match=r"valve_tracking\.enabled.*flow_meter\.source"):
            load(ANYANG, overrides=[*on, *meter])


def test_named_only_beyond_half_of_the_trades_rule() -> None:
    assert NAMED_SHARE == 0.05
    sprayer = Sprayer([1.0, 1.0, 0.97, 1.0, 1.0, 1.0]).run(200.0)
    assert sprayer.named() == []


def test_a_tracked_flight_is_replayed_to_the_bit(tmp_path: Path) -> None:
    drawn = np.random.default_rng(3).random((60, VALVES)) < 0.6
    spots = [
        Zone(
            name=f"{column}-{row}",
            polygon=shapely.box(4.0 * column, row, 4.0 * column + 4.0, row + 1.0),
            rate_l_ha=25.0 if drawn[column, row] else 0.0,
        )
        for column in range(60)
        for row in range(VALVES)
    ]
    field = Prescription(spots, boundary=shapely.box(0, -1, 240, 7))
    given = setup(prescription=field, valve_tracking=ValveTracking())
    core, volume_ml, made = FlownCore(given), 0.0, []
    with Journal.create(tmp_path, setup=given, started_s=10.0, waits=True) as journal:
        for number in range(400):
            now_s = 10.0 + number * STEP_S
            # Valve 3, counted from the right, gives half.
            duty = made[-1].plan.duty_at(now_s - 0.1) if made else (0.0,) * VALVES
            flows = [CURVE.flow_for(each) for each in duty]
            volume_ml += (sum(flows) - 0.5 * flows[3]) / VALVES * STEP_S / 0.06
            for item in (
                HeartbeatReport(received_s=now_s, autopilot="ardupilot", armed=True, mode="AUTO"),
                GnssReport(received_s=now_s, fix=Fix.RTK_FIXED),
                EstimatorReport(received_s=now_s, healthy=True),
                LandedReport(received_s=now_s, in_air=True),
                OperatorCommand(received_s=now_s, enable=True, source="command"),
                FlowReport(received_s=now_s, volume_ml=volume_ml),
                position(now_s, 10.0 + 0.25 * number, 3.0, boot_s=number * STEP_S),
            ):
                journal.record_input(item)
                core.observe(item)
            made.append(core.decide(now_s))
            journal.record_decision(made[-1])
    assert [finding.valve for finding in made[-1].findings] == [3]
    assert read_journal(journal.path).setup.valve_tracking == ValveTracking()
    found = replay(journal.path)
    assert (found.decisions, found.differences) == (400, 0)
