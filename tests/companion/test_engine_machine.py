"""The engine under any sequence of plans good and bad, delays, silences and standstills.

Two engines live through the same. One of them is also sent what must be refused; both have to drive
their lines alike, whatever it was. What is measured is taken from the lines, not from reports.
"""

from __future__ import annotations

import math
import struct
from itertools import pairwise

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.engine.engine import GAP_S, KEPT, Engine
from companion.output.engine.lines import MemoryLines
from companion.output.engine.wire import (
    CHANGES_MAX,
    EngineSetup,
    Kind,
    Wiring,
    edges_from,
    pack_plan,
    unpack,
)

WIRING = Wiring(valves=(1, 2, 3), return_line=4, alive_line=5)
COUNT = len(WIRING.valves)
VALVES, RETURN, ALIVE = (1 << COUNT) - 1, 1 << COUNT, 2 << COUNT
PERIODS, SETTLE = 20, 3
PLAN_S, LEASE_S = 0.05, 0.3
# The smallest duty here, in shortest pulses a period. The controller orders none below 1.
SMALLEST = 0.4
LIMITS = (
    PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01),
    PwmLimits(frequency_hz=10.0, duty_min=0.2, duty_max=0.8, min_on_s=0.02, min_off_s=0.01),
    PwmLimits(frequency_hz=20.0, duty_min=0.1, duty_max=1.0, min_on_s=0.005, min_off_s=0.008),
)
# By how much a wake-up is usually late; more is the business of its own rule.
LATE_S = 0.0001


def on_edges(pwm: PwmLimits) -> tuple[float, ...]:
    """Return duties at which a pulse or a gap is just long enough, and their neighbours."""
    least, most = pwm.min_on_s / pwm.period_s, 1.0 - pwm.min_off_s / pwm.period_s
    ends = (least, 0.5 * least, most, 0.5 * (1.0 + most), pwm.duty_max)
    near = tuple(end + by for end in ends for by in (-1e-9, 0.0, 1e-9))
    return tuple(min(max(duty, 0.0), 1.0) for duty in (*near, 0.0, 1.0))


def duty_error_max(duty: float, pwm: PwmLimits) -> float:
    """Return how far the mean duty over 20 periods may be off.

    Half a percent. Where no single period can have the duty (a pulse or a gap too short for the
    valve), whole periods take turns: what is owed swings by at most one shortest pulse (or gap),
    and 20 periods that begin anywhere cut at most another one.
    """
    last = min(pwm.duty_max, 1.0 - pwm.min_off_s / pwm.period_s)
    one = 0.0
    if 0.0 < duty * pwm.period_s < pwm.min_on_s:
        one = pwm.min_on_s / pwm.period_s
    elif last < duty < 1.0:
        one = 1.0 - last
    return max(0.005, 2.0 * one / PERIODS)


def settle_periods(duty: float, pwm: PwmLimits, behind_s: float) -> int:
    """Return after how many periods pulses that are `behind_s` late are in their places again.

    None of them is skipped: in each period a twentieth of the pulse and what of the gap is not
    needed make up for it.
    """
    pulse_s = duty * pwm.period_s
    gained_s = (1.0 - KEPT) * pulse_s + max(pwm.period_s - pulse_s - pwm.min_off_s, 0.0)
    return SETTLE + math.ceil(behind_s / gained_s)


class Half:
    """An engine, its lines, and every change of them."""

    def __init__(self, pwm: PwmLimits, machine: EngineMachine) -> None:
        self.lines = MemoryLines(WIRING.safe_levels)
        self.levels: list[tuple[float, int]] = []
        self.closed_for_good_s: list[set[float]] = [set() for _ in range(COUNT)]
        self.engine = Engine(
            EngineSetup(wiring=WIRING, pwm=pwm, backend="memory"),
            self.lines,
            clock=lambda: machine.now_s,
            boot_clock=lambda: machine.now_s + machine.slept_s,
            send=self._take,
        )

    def _take(self, packet: bytes) -> bool:
        kind, body = unpack(packet)
        for edge in edges_from(body) if kind is Kind.EDGES else ():
            if edge.output < COUNT and edge.duty == 0.0:
                self.closed_for_good_s[edge.output].add(edge.actual_s)
        return True

    def note(self, now_s: float) -> None:
        levels = self.lines.levels
        if not self.levels or self.levels[-1][1] != levels:
            self.levels.append((now_s, levels))

    def spans(self, valve: int, until_s: float) -> list[tuple[float, float]]:
        """Return (from, until) of every time in which a valve was open."""
        found, since_s = [], None
        for at_s, levels in [*self.levels, (until_s, 0)]:
            is_open = bool(levels >> valve & 1)
            if is_open and since_s is None:
                since_s = at_s
            elif not is_open and since_s is not None:
                found.append((since_s, at_s))
                since_s = None
        return found


class EngineMachine(RuleBasedStateMachine):
    """What must hold whatever happens."""

    @initialize(pwm=st.sampled_from(LIMITS))
    def start(self, pwm: PwmLimits) -> None:
        self.now_s, self.slept_s = 50.0, 0.0
        self.pwm = pwm
        self.given, self.spared = Half(pwm, self), Half(pwm, self)
        self.sequence, self.refused = 0, 0
        self.lease_s = -math.inf
        self.since_s = self.now_s  # plans made before are void
        self.last: SprayPlan | None = None
        self.behind_s = 0.0  # the most by which a line may be late

    # ------------------------------------------------------------------------------- helpers

    def turn(self) -> None:
        for half in (self.given, self.spared):
            half.engine.turn()
            half.note(self.now_s)

    def pass_time(self, for_s: float, late_s: float = 0.0) -> None:
        end_s = self.now_s + for_s
        while (next_s := self.given.engine.next_s + late_s) < end_s:
            assert next_s == self.spared.engine.next_s + late_s
            self.now_s = max(next_s, self.now_s)
            self.turn()
        self.now_s = end_s
        self.turn()

    def plan(
        self,
        duty: tuple[float, ...],
        *,
        lease_s: float = LEASE_S,
        changes: tuple[TimedChange, ...] = (),
    ) -> None:
        """Send both a good plan."""
        self.sequence += 1
        self.last = SprayPlan(
            sequence=self.sequence,
            issued_s=self.now_s,
            duty=duty,
            changes=changes,
            lease_until_s=self.now_s + lease_s,
        )
        for half in (self.given, self.spared):
            half.engine.receive(*unpack(pack_plan(self.last)))
        self.lease_s = self.last.lease_until_s
        self.turn()

    # ---------------------------------------------------------------------------------- rules

    @rule(data=st.data(), late=st.booleans())
    def hold_a_plan(self, data: st.DataObject, late: bool) -> None:
        """A steady plan has its mean duty over 20 periods, whatever was before."""
        least = SMALLEST * self.pwm.min_on_s / self.pwm.period_s
        duties = st.one_of(st.floats(least, 1.0), st.sampled_from(on_edges(self.pwm)))
        duty = data.draw(st.tuples(*[duties] * COUNT))
        period_s = self.pwm.period_s
        settle = max(settle_periods(d, self.pwm, self.behind_s) for d in duty)
        begin_s = self.now_s + settle * period_s
        end_s = begin_s + PERIODS * period_s
        while self.now_s < end_s + PLAN_S:
            self.plan(duty)
            self.pass_time(PLAN_S, LATE_S if late else 0.0)
        for valve in range(COUNT):
            spans = self.given.spans(valve, self.now_s)
            open_s = sum(max(min(b, end_s) - max(a, begin_s), 0.0) for a, b in spans)
            error = abs(open_s / (end_s - begin_s) - duty[valve])
            assert error <= duty_error_max(duty[valve], self.pwm) + 1e-6
        self.behind_s = 0.0

    @rule(
        duty=st.tuples(*[st.sampled_from([0.0, 0.0, 0.15, 0.5, 0.77, 1.0])] * COUNT),
        lease_s=st.floats(0.02, 2.4),
        changes=st.lists(
            st.tuples(
                st.floats(-0.05, 0.6),
                st.integers(0, COUNT - 1),
                st.sampled_from([0.0, 0.3, 0.6, 0.93, 1.0]),
                st.booleans(),
            ),
            max_size=5,
        ),
        for_s=st.floats(0.0, 0.3),
    )
    def order(
        self,
        duty: tuple[float, ...],
        lease_s: float,
        changes: list[tuple[float, int, float, bool]],
        for_s: float,
    ) -> None:
        made = tuple(
            TimedChange(at_s=self.now_s + at_s, valve=valve, duty=new, restart=restart)
            for at_s, valve, new, restart in sorted(changes)
        )
        self.plan(duty, lease_s=lease_s, changes=made)
        self.pass_time(for_s)

    @rule(delay_s=st.floats(0.0, GAP_S - 0.001))
    def be_late(self, delay_s: float) -> None:
        self.now_s += delay_s
        self.behind_s += delay_s
        self.turn()

    @rule(for_s=st.floats(0.0, 1.5))
    def be_silent(self, for_s: float) -> None:
        """No plan: closed at the end of the lease, not a period later."""
        self.pass_time(for_s)

    @rule(for_s=st.floats(GAP_S + 0.001, 5.0), asleep=st.booleans())
    def stand_still(self, for_s: float, asleep: bool) -> None:
        if asleep:
            self.slept_s += for_s
        else:
            self.now_s += for_s
        self.turn()
        self.lease_s, self.since_s, self.behind_s = -math.inf, self.now_s, 0.0
        assert not self.given.lines.levels & VALVES

    @precondition(lambda self: self.last is not None and self.last.issued_s < self.since_s)
    @rule()
    def send_what_was_made_before_a_standstill(self) -> None:
        assert self.last is not None
        self._refused(pack_plan(self.last)[12:])

    @rule(
        kind=st.sampled_from(
            ["bytes", "cut", "nan duty", "nan time", "nan lease", "nan made", "again", "older",
             "future", "over", "long", "others", "too large", "duty", "valve", "unsorted"]
        ),
        data=st.data(),
    )  # fmt: skip
    def send_nonsense(self, kind: str, data: st.DataObject) -> None:
        self._refused(self._nonsense(kind, data))

    def _refused(self, body: bytes) -> None:
        engine = self.given.engine
        before = (engine.accepted, self.given.lines.levels, engine.status().sequence)
        engine.receive(Kind.PLAN, body)
        engine.turn()
        self.spared.engine.turn()
        self.refused += 1
        assert (engine.accepted, self.given.lines.levels, engine.status().sequence) == before
        assert engine.rejected == self.refused

    def _nonsense(self, kind: str, data: st.DataObject) -> bytes:
        """Return the body of a plan that would open everything, but for one thing."""
        now_s, count, changes = self.now_s, COUNT, b""
        values = {
            "sequence": self.sequence + 1,
            "made": now_s,
            "lease": now_s + LEASE_S,
            "duty": 1.0,
        }
        how_many = None
        if kind == "bytes":
            return data.draw(st.binary(max_size=200))
        if kind.startswith("nan") and kind != "nan time":
            values[kind[4:]] = data.draw(st.sampled_from([math.nan, math.inf, -math.inf]))
        off = {
            "again": ("sequence", self.sequence or -1), "older": ("sequence", -5),
            "future": ("made", now_s + 0.02), "over": ("lease", now_s),
            "long": ("lease", now_s + 2.6), "duty": ("duty", 1.0 + 1e-9),
        }  # fmt: skip
        if kind in off:
            name, value = off[kind]
            values[name] = value
        if kind == "others":
            count += data.draw(st.sampled_from([-1, 1]))
        change = struct.Struct("<ddHH")
        if kind == "nan time":
            changes = change.pack(math.nan, 0.5, 0, 1)
        if kind == "valve":
            changes = change.pack(now_s, 0.5, COUNT, 1)
        if kind == "unsorted":
            changes = change.pack(now_s + 0.2, 0.5, 0, 1) + change.pack(now_s + 0.1, 0.5, 0, 1)
        if kind == "too large":
            how_many = CHANGES_MAX + 1
            changes = change.pack(now_s, 0.5, 0, 1) * how_many
        number = len(changes) // change.size if how_many is None else how_many
        head = struct.pack(
            "<qddHH", int(values["sequence"]), values["made"], values["lease"], count, number
        )
        body = head + struct.pack(f"<{count}d", *[values["duty"]] * count) + changes
        return body[: data.draw(st.integers(0, len(body) - 1))] if kind == "cut" else body

    # ----------------------------------------------------------------------------- invariants

    @invariant()
    def refused_plans_change_nothing(self) -> None:
        assert self.given.levels == self.spared.levels
        assert self.given.engine.next_s == self.spared.engine.next_s

    @invariant()
    def nothing_is_open_without_a_lease(self) -> None:
        if not self.now_s < self.lease_s:
            assert not self.given.lines.levels & VALVES

    @invariant()
    def it_is_alive_while_a_lease_runs(self) -> None:
        assert self.given.engine.status().is_alive == (self.now_s < self.lease_s)

    @invariant()
    def pulses_and_gaps_have_their_minimum(self) -> None:
        self.given.engine.report()
        self.spared.engine.report()
        for valve in range(COUNT):
            spans = self.given.spans(valve, self.now_s)
            good_s = self.given.closed_for_good_s[valve]
            for opened_s, closed_s in spans:
                if closed_s < self.now_s and closed_s not in good_s:
                    assert closed_s - opened_s >= self.pwm.min_on_s - 1e-6
            for (_, closed_s), (opened_s, _) in pairwise(spans):
                assert opened_s - closed_s >= self.pwm.min_off_s - 1e-6

    @invariant()
    def the_pump_has_a_way_out(self) -> None:
        """The return valve is open while all valves are shut, but for the gaps between pulses."""
        levels = self.given.lines.levels
        if levels & RETURN:
            assert self.now_s < self.lease_s
        shut_since_s = self.now_s
        for at_s, found in reversed(self.given.levels):
            if found & VALVES or not found & RETURN:
                break
            shut_since_s = at_s
        # Of a duty too small for each period pulses are skipped.
        most_s = (1.5 + 1.0 / SMALLEST) * self.pwm.period_s
        assert not levels & RETURN or self.now_s - shut_since_s <= most_s

    def teardown(self) -> None:
        if hasattr(self, "given"):
            # Silence at last: closed with the lease, return open, ALIVE still.
            self.pass_time(max(self.lease_s - self.now_s, 0.0) + 1e-9)
            assert not self.given.lines.levels & (VALVES | RETURN)
            still = self.given.lines.levels & ALIVE
            self.pass_time(0.5)
            assert self.given.lines.levels & ALIVE == still


EngineMachine.TestCase.settings = settings(max_examples=60, stateful_step_count=15)
TestEngine = EngineMachine.TestCase


@pytest.mark.parametrize("pwm", LIMITS)
def test_what_is_allowed_is_half_a_percent_where_each_period_can_have_the_duty(
    pwm: PwmLimits,
) -> None:
    for duty in (0.0, pwm.min_on_s / pwm.period_s, 0.5, 1.0):
        assert duty_error_max(duty, pwm) == 0.005
    assert max(duty_error_max(duty / 100, pwm) for duty in range(101)) <= 0.0201
