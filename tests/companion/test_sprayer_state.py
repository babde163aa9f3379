"""What the sprayer may do: the states, their latch, and who may end it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from companion.core.controller import Memory, step
from companion.core.estimator import Track, estimate, observe
from companion.core.safety import (
    BOOT,
    ENVELOPE,
    FAULTS,
    HOLD_S,
    LATCHED,
    Limits,
    SprayerMemory,
    follow,
    settled,
)
from companion.core.setup import Setup
from companion.core.types import (
    Decision,
    EstimatorReport,
    EstopReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Inhibit,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
    RcReport,
    SpeedReport,
    SprayerState,
    StandstillReport,
    VehicleState,
)
from tests.builders import SPRAYING, position, setup

REASONS = st.frozensets(st.sampled_from([r for r in Inhibit if r is not Inhibit.REARM_NEEDED]))


def after(*reasons: Inhibit, before: SprayerMemory | None = None, **change: object) -> SprayerState:
    state: VehicleState = replace(SPRAYING, **change)  # type: ignore[arg-type]
    return follow(before or SprayerMemory(SprayerState.SAFE), frozenset(reasons), state)[0].state


@pytest.mark.parametrize(
    ("reasons", "state"),
    [
        ((), SprayerState.ARMED),
        ((Inhibit.SPEED_BELOW_MIN, Inhibit.HEIGHT_ABOVE_MAX), SprayerState.ARMED),
        ((Inhibit.NOT_ENABLED,), SprayerState.READY),
        (
            (Inhibit.NOT_ENABLED, Inhibit.NOT_ARMED, Inhibit.WRONG_MODE, Inhibit.NOT_IN_AIR,
             Inhibit.SPEED_BELOW_MIN, Inhibit.RC_SWITCH),
            SprayerState.READY,
        ),
        ((Inhibit.NOT_ENABLED, Inhibit.FIX_TOO_LOW), SprayerState.SAFE),
        ((Inhibit.NOT_ARMED,), SprayerState.SAFE),
        ((Inhibit.STALE_POSITION,), SprayerState.SAFE),
        ((Inhibit.LINK_LOST,), SprayerState.SAFE),
        ((Inhibit.OUTPUT_FAULT,), SprayerState.FAULT),
        ((Inhibit.LEAK, Inhibit.NOT_ENABLED), SprayerState.FAULT),
        ((Inhibit.ESTOP,), SprayerState.ESTOP),
        ((Inhibit.ESTOP, Inhibit.OUTPUT_FAULT), SprayerState.ESTOP),
    ],
)  # fmt: skip
def test_a_state_follows_from_the_reasons(
    reasons: tuple[Inhibit, ...], state: SprayerState
) -> None:
    assert after(*reasons) is state


def test_all_that_may_be_missing_at_once_may_be() -> None:
    assert after(*ENVELOPE) is SprayerState.ARMED
    before_flight = (Inhibit.NOT_ENABLED, Inhibit.NOT_ARMED, Inhibit.WRONG_MODE,
                     Inhibit.NOT_IN_AIR, Inhibit.RC_SWITCH)  # fmt: skip
    assert after(*ENVELOPE, *before_flight) is SprayerState.READY


def test_until_the_vehicle_is_heard_it_boots_and_never_again() -> None:
    boot = BOOT
    assert after(Inhibit.NO_POSITION, before=boot) is SprayerState.BOOT
    assert after(Inhibit.NO_HEARTBEAT, Inhibit.NOT_ENABLED, before=boot) is SprayerState.BOOT
    assert after(Inhibit.NOT_ENABLED, before=boot) is SprayerState.READY
    assert after(Inhibit.NO_POSITION) is SprayerState.SAFE


@pytest.mark.parametrize("reason", sorted({Inhibit.ESTOP, *FAULTS}))
def test_what_is_latched_stays_until_somebody_answers_after_its_end(reason: Inhibit) -> None:
    latch, _ = follow(BOOT, frozenset({reason}), replace(SPRAYING, operator_wishes=3))
    assert latch.state in LATCHED
    for state in (None, SPRAYING, replace(SPRAYING, operator_wishes=3)):
        machine, reasons = follow(latch, frozenset(), state)
        assert machine == latch
        assert reasons == {Inhibit.REARM_NEEDED}
    answered = replace(SPRAYING, operator_wishes=4)
    machine, reasons = follow(latch, frozenset(), answered)
    assert (machine.state, reasons) == (SprayerState.ARMED, frozenset())


def test_an_answer_before_the_end_of_the_cause_is_none() -> None:
    answered = replace(SPRAYING, operator_wishes=1)
    machine, _ = follow(BOOT, frozenset({Inhibit.LEAK}), SPRAYING)
    machine, _ = follow(machine, frozenset({Inhibit.LEAK}), answered)
    machine, _ = follow(machine, frozenset({Inhibit.LEAK, Inhibit.NO_POSITION}), None)
    held, reasons = follow(machine, frozenset(), answered)
    assert held.state is SprayerState.FAULT
    assert reasons == {Inhibit.REARM_NEEDED}


def test_a_stop_is_not_lessened_by_a_fault() -> None:
    machine, _ = follow(BOOT, frozenset({Inhibit.ESTOP}), SPRAYING)
    machine, _ = follow(machine, frozenset({Inhibit.OUTPUT_FAULT}), SPRAYING)
    assert machine.state is SprayerState.ESTOP


@given(
    before=st.sampled_from([s for s in SprayerState if s is not SprayerState.SPRAYING]),
    reasons=REASONS,
    answered=st.booleans(),
)
def test_armed_is_only_where_nothing_but_the_envelope_is_missing(
    before: SprayerState, reasons: frozenset[Inhibit], answered: bool
) -> None:
    state = replace(SPRAYING, operator_wishes=int(answered))
    machine, found = follow(SprayerMemory(before), reasons, state)
    assert reasons <= found
    assert (machine.state is SprayerState.ARMED) <= (found <= ENVELOPE)
    assert (machine.state in LATCHED) == (
        bool(found & (FAULTS | {Inhibit.ESTOP, Inhibit.REARM_NEEDED}))
    )


def test_reasons_about_the_place_stay_for_a_second() -> None:
    for reason, hold_s in HOLD_S.items():
        reasons, held = settled(frozenset({reason}), (), 10.0)
        assert reasons == {reason}
        again, held = settled(frozenset({Inhibit.NOT_ARMED}), held, 10.0 + 0.99 * hold_s)
        assert again == {reason, Inhibit.NOT_ARMED}
        gone, held = settled(frozenset(), held, 10.0 + hold_s)
        assert (gone, held) == (frozenset(), ())
        stays, _ = settled(frozenset(), ((reason, 10.0),), math.nan)
        assert stays == {reason}


def test_an_accuracy_or_a_switch_that_nobody_asks_for_is_not_missed() -> None:
    state = replace(SPRAYING, horizontal_accuracy_m=5.0)
    assert not step(setup(limits=Limits()), state, Memory(), 10.0)[0].inhibits


def test_a_rate_beyond_the_valves_is_counted() -> None:
    slow = replace(SPRAYING, velocity_east_m_s=1.5, checked_speed_m_s=1.5)
    assert step(setup(), slow, Memory(), 10.0)[0].out_of_range_count == 6
    assert step(setup(), SPRAYING, Memory(), 10.0)[0].out_of_range_count == 0


class Sprayer:
    """A healthy flight, message by message, into which anything can be put."""

    def __init__(self, law: Setup | None = None) -> None:
        self.setup = law or setup()
        self.track, self.memory, self.now_s = Track(), Memory(), 0.0
        self.east_m = 2.0
        self.armed, self.mode = True, "AUTO"
        self.decision: Decision | None = None

    def hear(self, *items: Input) -> None:
        for item in items:
            self.track = observe(self.track, item, self.setup)

    def fly(self, seconds: float, *, heartbeats: bool = True) -> Decision:
        decision = None
        for _ in range(round(seconds / 0.05)):
            self.now_s += 0.05
            self.east_m = 2.0 + (self.east_m + 0.25 - 2.0) % 40.0
            self.hear(position(self.now_s, self.east_m, 3.0))
            if heartbeats:
                beat = HeartbeatReport(
                    received_s=self.now_s, autopilot="a", armed=self.armed, mode=self.mode
                )
                self.hear(beat)
            self.hear(
                SpeedReport(received_s=self.now_s, ground_speed_m_s=5.0),
                GnssReport(received_s=self.now_s, fix=Fix.RTK_FIXED),
                EstimatorReport(received_s=self.now_s, healthy=True),
                LandedReport(received_s=self.now_s, in_air=True),
            )
            decision = self.step()
        assert decision is not None
        return decision

    def step(self) -> Decision:
        state = estimate(self.track, self.now_s)
        self.decision, self.memory = step(self.setup, state, self.memory, self.now_s)
        return self.decision

    def wish(self, enable: bool) -> None:
        self.hear(OperatorCommand(received_s=self.now_s, enable=enable, source="command"))


def spraying(law: Setup | None = None) -> Sprayer:
    sprayer = Sprayer(law)
    assert sprayer.fly(1.5).sprayer is SprayerState.READY
    sprayer.wish(True)
    assert sprayer.fly(1.0).sprayer is SprayerState.SPRAYING
    return sprayer


def test_it_boots_gets_ready_sprays_and_is_safe_again() -> None:
    sprayer = Sprayer()
    assert sprayer.step().sprayer is SprayerState.BOOT
    assert sprayer.fly(1.5).sprayer is SprayerState.READY
    sprayer.wish(True)
    assert sprayer.fly(1.0).sprayer is SprayerState.SPRAYING
    sprayer.mode = "LOITER"
    assert sprayer.fly(0.1).sprayer is SprayerState.READY


@pytest.mark.parametrize("source", ["command", "line"])
def test_an_emergency_stop_needs_release_and_a_new_wish(source: str) -> None:
    sprayer = spraying()
    sprayer.hear(EstopReport(received_s=sprayer.now_s, pressed=True, source=source))
    stopped = sprayer.step()
    assert stopped.sprayer is SprayerState.ESTOP
    assert stopped.plan.is_off
    sprayer.wish(True)  # while it is pressed
    assert sprayer.fly(0.5).sprayer is SprayerState.ESTOP
    if source == "line":
        sprayer.hear(EstopReport(received_s=sprayer.now_s, pressed=False, source=source))
        held = sprayer.fly(0.5)
        assert held.sprayer is SprayerState.ESTOP
        assert held.inhibits == {Inhibit.REARM_NEEDED, Inhibit.NOT_ENABLED}
    sprayer.wish(False)
    assert sprayer.fly(0.5).sprayer is SprayerState.READY
    sprayer.wish(True)
    assert sprayer.fly(1.0).sprayer is SprayerState.SPRAYING


def test_repeating_the_last_wish_answers_nothing() -> None:
    sprayer = spraying()
    sprayer.hear(OutputReport(received_s=sprayer.now_s, healthy=False))
    assert sprayer.fly(0.5).sprayer is SprayerState.FAULT
    sprayer.hear(OutputReport(received_s=sprayer.now_s, healthy=True))
    sprayer.wish(True)  # the same command once more, its answer was lost
    held = sprayer.fly(0.5)
    assert (held.sprayer, held.inhibits) == (SprayerState.FAULT, {Inhibit.REARM_NEEDED})


def test_a_link_that_comes_back_needs_nobody() -> None:
    sprayer = spraying()
    sprayer.hear(OutputReport(received_s=sprayer.now_s, healthy=True, link_up=False))
    lost = sprayer.fly(0.5)
    assert (lost.sprayer, lost.inhibits) == (SprayerState.SAFE, {Inhibit.LINK_LOST})
    sprayer.hear(OutputReport(received_s=sprayer.now_s, healthy=True))
    assert sprayer.fly(0.5).sprayer is SprayerState.SPRAYING


@pytest.mark.parametrize(("away_s", "comes_back"), [(9.8, True), (10.2, False)])
def test_heartbeats_that_stay_away_take_the_consent_along(away_s: float, comes_back: bool) -> None:
    sprayer = spraying()
    assert sprayer.fly(away_s, heartbeats=False).inhibits == {Inhibit.STALE_HEARTBEAT}
    assert sprayer.fly(0.5).inhibits == (frozenset() if comes_back else {Inhibit.NOT_ENABLED})


@pytest.mark.parametrize(("gap_s", "keeps"), [(1.9, True), (2.1, False), (math.nan, False)])
def test_after_a_standstill_positions_are_confirmed_anew(gap_s: float, keeps: bool) -> None:
    sprayer = spraying()
    sprayer.now_s += 2.0
    sprayer.hear(StandstillReport(received_s=sprayer.now_s, gap_s=gap_s))
    closed = sprayer.step()
    assert closed.plan.is_off
    assert closed.inhibits == {Inhibit.NO_POSITION}
    assert Inhibit.INVALID_POSITION in sprayer.fly(0.2).inhibits
    last = sprayer.fly(1.5)
    assert last.inhibits == (frozenset() if keeps else {Inhibit.NOT_ENABLED})


def test_the_switch_is_a_wish_too() -> None:
    law = setup(limits=Limits(rc_channel=7, enable_by=frozenset({"rc"})))
    sprayer = Sprayer(law)
    for pulse_us in (1000, 2000):
        sprayer.hear(RcReport(received_s=sprayer.now_s, pulse_us=(0,) * 6 + (pulse_us,)))
        sprayer.fly(1.0)
    assert sprayer.step().sprayer is SprayerState.SPRAYING
    assert sprayer.track.consent.wishes == 1


def test_who_may_not_enable_takes_no_consent_away_and_may_stop() -> None:
    law = setup(limits=Limits(rc_channel=7, enable_by=frozenset({"rc"})))
    sprayer = Sprayer(law)
    for pulse_us in (1000, 2000):
        sprayer.hear(RcReport(received_s=sprayer.now_s, pulse_us=(0,) * 6 + (pulse_us,)))
        sprayer.fly(1.0)
    sprayer.wish(True)
    assert sprayer.step().sprayer is SprayerState.SPRAYING
    assert sprayer.track.consent.wishes == 1
    sprayer.wish(False)
    assert Inhibit.NOT_ENABLED in sprayer.step().inhibits


class AnyFlight(RuleBasedStateMachine):
    """Faults, stops and wishes in any order: nothing opens but in SPRAYING, nor under a latch."""

    def __init__(self) -> None:
        super().__init__()
        self.sprayer = Sprayer()
        self.pressed = False
        self.healthy = True
        self.consent_s = -math.inf  # of the last wish to spray after the last cause of a latch
        self.sprayer.fly(1.2)

    @rule(enable=st.booleans())
    def wishes(self, enable: bool) -> None:
        self.sprayer.wish(enable)
        self.sprayer.fly(0.05)
        if enable and not self.pressed and self.healthy:
            self.consent_s = self.sprayer.now_s
        if not enable:
            self.consent_s = -math.inf

    @rule(pressed=st.booleans())
    def stops(self, pressed: bool) -> None:
        now_s = self.sprayer.now_s
        self.sprayer.hear(EstopReport(received_s=now_s, pressed=pressed, source="line"))
        self.sprayer.fly(0.05)
        self.pressed = pressed
        if pressed:
            self.consent_s = -math.inf

    @rule(healthy=st.booleans())
    def fails(self, healthy: bool) -> None:
        self.sprayer.hear(OutputReport(received_s=self.sprayer.now_s, healthy=healthy))
        self.healthy = healthy
        self.sprayer.fly(0.05)
        if not healthy:
            self.consent_s = -math.inf

    @rule(armed=st.booleans(), mode=st.sampled_from(["AUTO", "LOITER"]))
    def is_flown(self, armed: bool, mode: str) -> None:
        self.sprayer.armed, self.sprayer.mode = armed, mode

    @rule(seconds=st.sampled_from([0.05, 0.3]), heartbeats=st.booleans())
    def flies(self, seconds: float, heartbeats: bool) -> None:
        self.sprayer.fly(seconds, heartbeats=heartbeats)

    @invariant()
    def nothing_opens_but_in_spraying(self) -> None:
        decision = self.sprayer.decision
        assert decision is not None
        is_open = not decision.plan.is_off
        assert is_open == (decision.sprayer is SprayerState.SPRAYING)
        if is_open:
            assert not decision.inhibits
            assert self.consent_s > -math.inf


TestAnyFlight = AnyFlight.TestCase
TestAnyFlight.settings = settings(max_examples=20, stateful_step_count=15)
