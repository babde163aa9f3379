"""Laws of ground work, whatever the vehicle says and whatever the hand does."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st

from companion.core.types import HeartbeatReport, LandedReport, OutputReport, SprayPlan
from companion.ground.work import (
    GroundKind,
    GroundMemory,
    GroundOrder,
    GroundSetup,
    GroundState,
    GroundTask,
    Hold,
    clicks,
    ground_step,
    in_turn,
    together,
)

COUNT = 4
TASKS = (
    together(GroundKind.PRIME, COUNT, range(COUNT), duty=1.0, seconds=30.0),
    together(GroundKind.CATCH, COUNT, (1, 2), duty=0.4, seconds=3.0),
    in_turn(GroundKind.FLUSH, COUNT, (0, 2, 3), duty=1.0, seconds=2.0),
    clicks(COUNT, range(COUNT)),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment:
    """One step: how much later, whether the key repeats, what the vehicle has said by then."""

    after_s: float
    stroke: bool
    restart: bool
    age_s: float | None
    armed: object
    mode: str
    autopilot: str
    landed_age_s: float | None
    on_ground: bool
    healthy: object
    guarded: bool
    mission: bool | None
    stopped: bool

    def state(self, now_s: float) -> GroundState:
        heartbeat = landed = output = None
        if self.age_s is not None:
            heartbeat = HeartbeatReport(
                received_s=now_s - self.age_s,
                autopilot=self.autopilot,
                armed=self.armed,  # type: ignore[arg-type]
                mode=self.mode,
            )
        if self.landed_age_s is not None:
            landed = LandedReport(
                received_s=now_s - self.landed_age_s, in_air=False, on_ground=self.on_ground
            )
        if self.healthy is not None:
            output = OutputReport(
                received_s=now_s,
                healthy=self.healthy,  # type: ignore[arg-type]
                guarded=self.guarded,
            )
        return GroundState(
            heartbeat=heartbeat,
            landed=landed,
            output=output,
            mission_active=self.mission,
            was_stopped=self.stopped,
        )

    @property
    def is_good(self) -> bool:
        """Whether ground work may be done: said anew, without the words of the core."""
        return (
            self.age_s is not None
            and -0.1 <= self.age_s <= 2.5
            and self.armed is False
            and self.mode in ("LOITER", "STABILIZE")
            and self.autopilot == "ardupilot"
            and self.landed_age_s is not None
            and -0.1 <= self.landed_age_s <= 2.5
            and self.on_ground
            and self.healthy is True
            and self.guarded
            and self.mission is not True
            and not self.stopped
        )


def mostly(good: object, *others: object) -> st.SearchStrategy[object]:
    """Draw what is well nine times of ten."""
    return st.integers(0, 9).flatmap(
        lambda number: st.just(good) if number else st.sampled_from(others)
    )


AGES = (None, math.nan, math.inf, -math.inf, -1.0, 2.6, 100.0)
MOMENTS = st.builds(
    Moment,
    after_s=mostly(0.05, 0.001, 0.3, 0.49, 0.6, 3.0, 40.0),  # type: ignore[arg-type]
    stroke=mostly(True, False),  # type: ignore[arg-type]
    restart=mostly(False, True),  # type: ignore[arg-type]
    age_s=mostly(0.3, *AGES),  # type: ignore[arg-type]
    armed=mostly(False, True, None, math.nan),
    mode=mostly("LOITER", "AUTO", "MISSION", "GUIDED", "", "STABILIZE"),  # type: ignore[arg-type]
    autopilot=mostly("ardupilot", "px4", "autopilot 0"),  # type: ignore[arg-type]
    landed_age_s=mostly(0.2, *AGES),  # type: ignore[arg-type]
    on_ground=mostly(True, False),  # type: ignore[arg-type]
    healthy=mostly(True, False, None, math.nan),
    guarded=mostly(True, False),  # type: ignore[arg-type]
    mission=mostly(False, None, True),  # type: ignore[arg-type]
    stopped=mostly(False, True),  # type: ignore[arg-type]
)
STEADY = Moment(
    after_s=0.05,
    stroke=True,
    restart=False,
    age_s=0.3,
    armed=False,
    mode="LOITER",
    autopilot="ardupilot",
    landed_age_s=0.2,
    on_ground=True,
    healthy=True,
    guarded=True,
    mission=None,
    stopped=False,
)
# Long stretches of a held key between what goes wrong, or nothing would ever be open.
STRETCHES = st.lists(st.tuples(MOMENTS, st.sampled_from([0, 3, 12])), min_size=1, max_size=12)


@dataclass
class Told:
    """The course of one session, with what an executor that minds leases has open."""

    plan: SprayPlan | None = None
    strokes: list[float] = field(default_factory=list)
    started_s: float = 0.0
    began_s: float | None = None


def steps(stretches: list[tuple[Moment, int]]) -> list[Moment]:
    return [each for moment, count in stretches for each in (moment, *[STEADY] * count)]


def check_open(told: Told, moment: Moment, plan: SprayPlan, now_s: float) -> None:
    """Judge a plan that opens: by the strokes and the words of the vehicle alone."""
    assert moment.is_good
    # Those that follow each other closely enough; ones in a burst count once.
    held = [told.strokes[-1]]
    for stroke_s in reversed(told.strokes[:-1]):
        if held[-1] - stroke_s >= 0.5:
            break
        held.append(stroke_s)
    last_s = held[0]
    held = [at_s for at_s in held if at_s >= told.started_s]
    assert len(held) >= 4
    assert last_s - held[-1] >= 0.3 - 1e-6
    assert now_s - last_s < 0.5
    assert plan.lease_until_s <= last_s + 0.5
    assert plan.lease_until_s <= now_s + 0.3
    if told.began_s is None:
        told.began_s = now_s
        assert now_s < told.started_s + 30.0
    assert plan.lease_until_s <= told.began_s + 30.0
    assert all(now_s < change.at_s < plan.lease_until_s for change in plan.changes)


@given(task=st.sampled_from(TASKS), stretches=STRETCHES)
def test_nothing_opens_unless_all_conditions_hold(
    task: GroundTask, stretches: list[tuple[Moment, int]]
) -> None:
    setup, memory, hold = GroundSetup(has_servo_outputs=True), GroundMemory(), Hold()
    now_s, told = 1000.0, Told(started_s=1000.0)
    is_over, lost = False, False
    for moment in steps(stretches):
        now_s += moment.after_s
        if moment.restart:
            told.started_s, told.began_s, is_over, lost = now_s, None, False, False
        if moment.stroke:
            hold = hold.renewed(now_s)
            told.strokes.append(now_s)
        order = GroundOrder(task=task, started_s=told.started_s, hold=hold)
        decision, memory = ground_step(
            setup, moment.state(now_s), order, memory, now_s, valve_count=COUNT
        )
        lost = lost or (told.began_s is not None and not moment.is_good)
        assert decision.plan.is_off == bool(decision.reasons) or not any(decision.plan.duty)
        if not decision.plan.is_off:
            check_open(told, moment, decision.plan, now_s)
            assert not is_over, "what is over opens only after a new start"
            assert not lost, "a condition that was lost ends the piece"
        is_over = is_over or decision.is_over
        if told.plan is not None:
            assert decision.plan.sequence == told.plan.sequence + 1
        told.plan = decision.plan


@given(stretches=STRETCHES)
def test_arming_ends_it_and_whatever_follows_opens_nothing(
    stretches: list[tuple[Moment, int]],
) -> None:
    task, memory, hold, now_s = TASKS[0], GroundMemory(), Hold(), 1000.0
    for number, moment in enumerate([*[STEADY] * 20, *steps(stretches)]):
        now_s += 0.05
        hold = hold.renewed(now_s)
        state = moment.state(now_s)
        if number == 20:
            beat = HeartbeatReport(
                received_s=now_s, autopilot="ardupilot", armed=True, mode="LOITER"
            )
            state = GroundState(heartbeat=beat, landed=state.landed, output=state.output)
        order = GroundOrder(task=task, started_s=1000.0, hold=hold)
        decision, memory = ground_step(
            GroundSetup(), state, order, memory, now_s, valve_count=COUNT
        )
        if number == 19:
            assert not decision.plan.is_off
        if number >= 20:
            assert decision.plan.is_off
