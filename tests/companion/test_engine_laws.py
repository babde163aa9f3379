"""The engine under any plans, delays and faults, in a time of its own."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.engine.engine import GAP_S, Engine
from companion.output.engine.lines import MemoryLines
from companion.output.engine.wire import (
    EngineSetup,
    Issued,
    Kind,
    RefusedError,
    Wiring,
    edges_from,
    pack_plan,
    plan_from,
    unpack,
)

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
T = PWM.period_s
WIRING = Wiring(valves=(1, 2, 3), return_line=4, alive_line=5)
VALVES = (1 << len(WIRING.valves)) - 1
RETURN = 1 << len(WIRING.valves)
DUTIES = st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 0.2, 0.5, 0.89, 0.95, 1.0]))


class Twin:
    """An engine whose time, lines and companion are this test's."""

    def __init__(self, wiring: Wiring = WIRING) -> None:
        self.now_s, self.slept_s = 50.0, 0.0
        self.lines = MemoryLines(wiring.safe_levels)
        self.issued: list[Issued] = []
        self.engine = Engine(
            EngineSetup(wiring=wiring, pwm=PWM, backend="memory"),
            self.lines,
            clock=lambda: self.now_s,
            boot_clock=lambda: self.now_s + self.slept_s,
            send=self._take,
        )
        self.open_s = -math.inf

    def _take(self, packet: bytes) -> bool:
        kind, body = unpack(packet)
        if kind is Kind.EDGES:
            self.issued += edges_from(body)
        return True

    def submit(self, plan: SprayPlan) -> bool:
        before = self.engine.accepted
        self.engine.receive(*unpack(pack_plan(plan)))
        self.engine.turn()
        return self.engine.accepted > before

    def run(self, for_s: float, *, late_s: float = 0.0) -> None:
        """Turn at each event, each wake-up late by as much."""
        end_s = self.now_s + for_s
        while self.engine.next_s + late_s < end_s:
            self.now_s = max(self.engine.next_s + late_s, self.now_s)
            self.engine.turn()
        self.now_s = max(end_s, self.now_s)
        self.engine.turn()


def held(duty: tuple[float, ...], number: int, now_s: float, lease_s: float = 0.3) -> SprayPlan:
    return SprayPlan(
        sequence=number, issued_s=now_s, duty=duty, changes=(), lease_until_s=now_s + lease_s
    )


def share(edges: list[Issued], begin_s: float, end_s: float) -> float:
    """Return the part of a time in which one valve was open."""
    moves = [(edge.actual_s, edge.is_open) for edge in edges]
    moves.append((end_s, False))
    spans = [(a, b) for (a, is_open), (b, _) in pairwise(moves) if is_open]
    clipped = np.clip(np.array(spans).reshape(-1, 2), begin_s, end_s)
    return float((clipped[:, 1] - clipped[:, 0]).sum()) / (end_s - begin_s)


@settings(max_examples=40)
@given(duty=st.floats(0.0, 1.0), late_s=st.sampled_from([0.0, 0.0001, 0.0002]))
def test_the_mean_duty_is_right_within_half_a_percent_over_twenty_periods(
    duty: float, late_s: float
) -> None:
    twin = Twin(Wiring(valves=(7,)))
    begin_s = twin.now_s
    for number in range(70):
        twin.submit(held((duty,), number, twin.now_s))
        twin.run(0.05, late_s=late_s)
    for first in (5, 15):
        span = (begin_s + first * T, begin_s + (first + 20) * T)
        assert abs(share(twin.issued, *span) - duty) < 0.005


@settings(max_examples=40)
@given(
    duty=st.tuples(DUTIES, DUTIES, DUTIES),
    late_s=st.lists(st.floats(0.0, 0.09), min_size=5, max_size=30),
)
def test_late_edges_are_issued_each_and_minimum_times_hold(
    duty: tuple[float, float, float], late_s: list[float]
) -> None:
    twin = Twin()
    for number, delay_s in enumerate(late_s):
        twin.submit(held(duty, number, twin.now_s))
        # One wake-up is late by as much, and then the machine is on time again.
        twin.now_s = max(twin.engine.next_s, twin.now_s) + delay_s
        twin.engine.turn()
        twin.run(0.05)
    for valve in range(3):
        moves = [edge for edge in twin.issued if edge.output == valve][1:]
        changes = [b for a, b in pairwise(moves) if a.is_open != b.is_open]
        # Opened and shut in turn, none twice, none at the same moment.
        for a, b in pairwise(changes):
            assert a.is_open != b.is_open
            assert b.actual_s - a.actual_s >= 0.01 - 1e-6 or b.duty == 0.0


@settings(max_examples=200)
@given(body=st.binary(max_size=300))
def test_no_bytes_are_anything_but_a_plan_or_refused(body: bytes) -> None:
    try:
        plan = plan_from(body)
    except RefusedError:
        return
    assert unpack(pack_plan(plan))[1] == body or plan.changes


class EngineMachine(RuleBasedStateMachine):
    """Plans good and bad, time, standstills, faults: what must hold all along."""

    @initialize()
    def start(self) -> None:
        self.twin = Twin()
        self.sequence = -1
        self.lease_s = -math.inf
        self.may_open = False

    @rule(
        duty=st.tuples(DUTIES, DUTIES, DUTIES),
        lease_s=st.floats(0.01, 3.5),
        age_s=st.floats(-0.1, 0.4),
        step=st.sampled_from([1, 1, 1, 0, -1]),
        at_s=st.lists(st.floats(-0.1, 0.6), max_size=3),
        restart=st.booleans(),
    )
    def submit(
        self,
        duty: tuple[float, float, float],
        lease_s: float,
        age_s: float,
        step: int,
        at_s: list[float],
        restart: bool,
    ) -> None:
        now_s = self.twin.now_s
        plan = SprayPlan(
            sequence=self.sequence + step,
            issued_s=now_s - age_s,
            duty=duty,
            changes=tuple(
                TimedChange(at_s=now_s + s, valve=k, duty=duty[k - 1], restart=restart)
                for k, s in enumerate(sorted(at_s))
            ),
            lease_until_s=now_s - age_s + lease_s,
        )
        if self.twin.submit(plan):
            assert step > 0
            assert now_s < plan.lease_until_s <= now_s + 2.5
            self.sequence += step
            self.lease_s = plan.lease_until_s
            self.may_open = not plan.is_off

    @rule(for_s=st.floats(0.0, 0.5))
    def pass_time(self, for_s: float) -> None:
        self.twin.run(for_s)

    @rule(delay_s=st.floats(0.0, GAP_S - 0.001))
    def be_late(self, delay_s: float) -> None:
        self.twin.now_s += delay_s
        self.twin.engine.turn()

    @rule(for_s=st.floats(GAP_S + 0.001, 5.0), asleep=st.booleans())
    def stand_still(self, for_s: float, asleep: bool) -> None:
        if asleep:
            self.twin.slept_s += for_s
        else:
            self.twin.now_s += for_s
        self.twin.engine.turn()
        assert not self.twin.lines.levels & VALVES
        self.lease_s = -math.inf

    @rule()
    def nonsense(self) -> None:
        before = self.twin.lines.levels
        self.twin.engine.receive(Kind.PLAN, b"\xff" * 60)
        assert self.twin.lines.levels == before

    @rule()
    def lose_the_device(self) -> None:
        self.twin.lines.broken = True
        self.twin.run(0.11)
        self.twin.lines.broken = False
        self.twin.run(0.06)
        assert self.twin.engine.fault is not None
        self.lease_s = -math.inf

    @invariant()
    def nothing_is_open_without_a_lease_or_with_a_fault(self) -> None:
        if self.twin.now_s >= self.lease_s or self.twin.engine.fault or not self.may_open:
            assert not self.twin.lines.levels & VALVES

    @invariant()
    def the_pump_has_a_way_out(self) -> None:
        """Return shut (its coil fed) only while a plan sprays."""
        if self.twin.lines.levels & RETURN:
            assert self.twin.now_s < self.lease_s


EngineMachine.TestCase.settings = settings(max_examples=40, stateful_step_count=25)
TestEngine = EngineMachine.TestCase
