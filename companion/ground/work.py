"""Ground work: the one state besides flight spraying in which a valve may open.

It is the opposite of the interlock's: the vehicle must be heard, disarmed, on the ground and in no
mission, and somebody must hold a key. Whatever is missing, stale or no number closes; the lease of
the plan ends with the hold, so that the executor closes even if no further step is made. Nothing
leads from here into a flight: arming ends the work for good, and enabling is not known here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import pairwise
from typing import Any

from companion.core.inputs import MISSION_MODES, RcReport
from companion.core.nozzle import NozzleSet
from companion.core.safety import RC_LOW_US
from companion.core.schedule import LagModel
from companion.core.types import (
    DrivePlan,
    EstopReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
    SprayPlan,
    TimedChange,
)

# Pieces of ground work as a course of duties over time: prime, flush, rinse, catch, click.
#
# A piece is at most `PIECE_MAX_S` long: what takes longer is done in several, each begun anew.

PIECE_MAX_S = 30.0
# Long enough to be heard and felt, and for the slowest valve to open; twice, to be sure of it.
CLICK_S = 0.2
CLICK_TIMES = 2


class GroundKind(StrEnum):
    """What is done on the ground with valves open."""

    PRIME = "prime"  # fill the lines: all valves, fully open
    FLUSH = "flush"  # push out what is in the lines
    RINSE = "rinse"  # the same with so much clean water
    CATCH = "catch"  # an exact time at one duty, over cups
    CLICK = "click"  # dry: each valve in turn, to be heard
    VALVES = "valves"  # a course of duties for one valve, read by the flow meter


@dataclass(frozen=True, slots=True, kw_only=True)
class Phase:
    """From `at_s` of the work on, each valve has its duty."""

    at_s: float
    duty: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundTask:
    """One piece of ground work; `is_whole` where an interruption makes it worthless.

    `drives` are what pump and atomisers do meanwhile, as in a plan.
    """

    kind: GroundKind
    phases: tuple[Phase, ...]
    seconds: float
    is_whole: bool = False
    drives: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.seconds <= PIECE_MAX_S:
            raise ValueError(f"takes {self.seconds:.3g} s; one piece lasts {PIECE_MAX_S:g} s")
        times = [phase.at_s for phase in self.phases]
        rising = all(a < b for a, b in pairwise(times))
        if not times or times[0] != 0.0 or not rising or not times[-1] < self.seconds:
            raise ValueError(f"phases must rise from 0 to below {self.seconds}, got {times}")
        counts = {len(phase.duty) for phase in self.phases}
        if len(counts) != 1 or counts == {0}:
            raise ValueError("every phase needs one duty for each valve")
        if not all(0.0 <= duty <= 1.0 for phase in self.phases for duty in phase.duty):
            raise ValueError("duties must lie in [0, 1]")
        if not all(0.0 <= fraction <= 1.0 for fraction in self.drives):
            raise ValueError("drives must lie in [0, 1]")

    @property
    def valve_count(self) -> int:
        """Return how many valves the sprayer has."""
        return len(self.phases[0].duty)


def _duties(count: int, valves: Sequence[int], duty: float) -> tuple[float, ...]:
    return tuple(duty if valve in valves else 0.0 for valve in range(count))


def together(
    kind: GroundKind, count: int, valves: Sequence[int], *, duty: float, seconds: float
) -> GroundTask:
    """Return the work that has some of `count` valves open at the same time."""
    return GroundTask(
        kind=kind,
        phases=(Phase(at_s=0.0, duty=_duties(count, valves, duty)),),
        seconds=seconds,
        is_whole=kind is GroundKind.CATCH,
    )


def in_turn(
    kind: GroundKind, count: int, valves: Sequence[int], *, duty: float, seconds: float
) -> GroundTask:
    """Return the work that has one valve open after the other, all for the same time.

    >>> task = in_turn(GroundKind.FLUSH, 3, (0, 2), duty=1.0, seconds=8.0)
    >>> [(phase.at_s, phase.duty) for phase in task.phases]
    [(0.0, (1.0, 0.0, 0.0)), (4.0, (0.0, 0.0, 1.0))]
    """
    each_s = seconds / max(len(valves), 1)
    phases = tuple(
        Phase(at_s=number * each_s, duty=_duties(count, (valve,), duty))
        for number, valve in enumerate(valves)
    )
    return GroundTask(kind=kind, phases=phases, seconds=seconds)


def clicks(count: int, valves: Sequence[int]) -> GroundTask:
    """Return the dry click: each valve in turn opens twice for a fifth of a second.

    >>> round(clicks(6, range(6)).seconds, 9)
    4.8
    """
    closed = (0.0,) * count
    phases = []
    for number, valve in enumerate(v for v in valves for _ in range(CLICK_TIMES)):
        phases.append(Phase(at_s=2 * number * CLICK_S, duty=_duties(count, (valve,), 1.0)))
        phases.append(Phase(at_s=(2 * number + 1) * CLICK_S, duty=closed))
    seconds = 2 * CLICK_TIMES * len(valves) * CLICK_S
    return GroundTask(kind=GroundKind.CLICK, phases=tuple(phases), seconds=seconds)


def flow_of(sets: Sequence[NozzleSet], valves: Sequence[int], duty: float) -> float:
    """Return what the measured curves say of these valves at one duty [L/min].

    By the set of just these valves, else by their share of the smallest set that has them all, else
    of the largest one.
    """
    wanted = frozenset(valves)
    if not wanted or not sets:
        return 0.0
    holding = [nozzles for nozzles in sets if wanted <= frozenset(nozzles.valves)]
    nozzles = min(holding or [sets[-1]], key=lambda each: len(each.valves))
    return nozzles.curve.flow_for(duty) * len(wanted) / len(nozzles.valves)


def expected_ml(flow_l_min: float, *, open_s: float, lag: LagModel) -> float:
    """Return what falls into the cups: the flow begins `on_s` late and ends `off_s` late."""
    flowing_s = max(open_s - lag.on_s + lag.off_s, 0.0) if open_s > 0.0 else 0.0
    return flow_l_min * flowing_s / 60.0 * 1000.0


# The dead-man of ground work: when strokes of a key, or lines of a script, are a held key.
#
# Nothing says when a stroke was made, only when it was heard: a connection that stood still hands
# over at once what was pressed in the meantime, though the key was let go long ago.

# A key that is held repeats 10 to 40 times a second; this is what may lie between two repeats.
HOLD_S = 0.5
# What a connection has held back comes in a burst. Strokes so close are one, and so many over so
# long are more than a burst is.
STROKE_GAP_S = 0.01
STROKES_MIN = 4
STROKES_OVER_S = 0.3
# Between clocks of two processes; what is further in the future is not a time at all.
EARLY_S = -0.1
# Sums of times are right to far better than this, and no key repeats faster.


@dataclass(frozen=True, slots=True, kw_only=True)
class Hold:
    """The dead-man: a key that repeats. A few strokes, or many in a burst, are no hold.

    `strokes` are those since `first_s`, as they were heard: when they were made nobody knows.
    """

    first_s: float = -math.inf
    last_s: float = -math.inf
    strokes: int = 0

    def renewed(self, now_s: float) -> Hold:
        """Return the hold after one more stroke; after a gap it begins anew."""
        if not self.last_s + STROKE_GAP_S <= now_s < math.inf:
            return self
        if now_s < self.last_s + HOLD_S:
            return Hold(first_s=self.first_s, last_s=now_s, strokes=self.strokes + 1)
        return Hold(first_s=now_s, last_s=now_s, strokes=1)

    def is_held(self, now_s: float) -> bool:
        """Whether the key is down now."""
        young = now_s < self.last_s + HOLD_S and now_s - self.last_s >= EARLY_S
        long = self.last_s - self.first_s >= STROKES_OVER_S - _BIT_S
        return young and long and self.strokes >= STROKES_MIN


# EXTENDED_SYS_STATE is asked for at 2 Hz.
LANDED_AGE_MAX_S = 2.5
# Whoever has started has this long to begin holding; then it needs a new start.
START_MAX_S = 30.0
# Sums of times are right to far better than this, and no valve is faster.
_BIT_S = 1e-6


class GroundReason(StrEnum):
    """Every reason why ground work keeps the valves closed."""

    NO_HEARTBEAT = "no-heartbeat"
    STALE_HEARTBEAT = "stale-heartbeat"
    ARMED = "armed"
    MISSION_MODE = "mission-mode"
    MISSION_ACTIVE = "mission-active"
    LANDED_UNKNOWN = "landed-unknown"
    NOT_LANDED = "not-landed"
    OUTPUT_FAULT = "output-fault"
    OUTPUTS_NEED_ARMING = "outputs-need-arming"
    UNGUARDED = "unguarded"
    STOPPED = "stopped"
    ESTOP_UNKNOWN = "estop-unknown"
    NO_ORDER = "no-order"
    NOT_HELD = "not-held"
    STALLED = "stalled"
    TIME_OVER = "time-over"
    DONE = "done"


# Before the first opening these end a piece at once; of the rest it waits for the end.
_END_AT_ONCE = frozenset(
    {GroundReason.ARMED, GroundReason.STOPPED, GroundReason.TIME_OVER, GroundReason.DONE}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundSetup:
    """What is constant: the modes that may spray in flight, ages, and how the outputs behave."""

    modes: frozenset[str] = MISSION_MODES
    heartbeat_age_max_s: float = 2.5
    lease_s: float = 0.3
    has_servo_outputs: bool = False
    has_estop_line: bool = False
    rc_channel: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundOrder:
    """A deliberate start of a piece of work, and the key that is held since."""

    task: GroundTask
    started_s: float
    hold: Hold


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundMemory:
    """What one step leaves to the next."""

    sequence: int = 0
    started_s: float = -math.inf
    stepped_s: float | None = None  # the step before
    anew_s: float = -math.inf  # the end of this process's last standstill
    began_s: float | None = None  # first opening of this piece
    since_s: float | None = None  # open without a break since
    done_s: float = 0.0  # of the work, before `since_s`
    lease_until_s: float = -math.inf
    over: frozenset[GroundReason] = frozenset()


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundDecision:
    """One step: why it is closed, the plan, how much of the work is done, whether it is over."""

    now_s: float
    reasons: frozenset[GroundReason]
    plan: SprayPlan
    done_s: float
    is_over: bool


def ground_step(
    setup: GroundSetup,
    state: GroundState,
    order: GroundOrder | None,
    memory: GroundMemory,
    now_s: float,
    *,
    valve_count: int,
) -> tuple[GroundDecision, GroundMemory]:
    """Return what to do from `now_s` on, and what the next step has to know."""
    memory = _watched(_counted(memory, now_s), now_s)
    reasons = ground_reasons(setup, state, now_s)
    if order is None or order.task.valve_count != valve_count:
        closed = reasons | {GroundReason.NO_ORDER}
        return _closed(setup, closed, memory, now_s, valve_count, is_over=False)
    if order.started_s > memory.started_s:
        memory = GroundMemory(
            sequence=memory.sequence,
            started_s=order.started_s,
            stepped_s=memory.stepped_s,
            anew_s=memory.anew_s,
        )
    reasons |= memory.over | _of_order(order, memory, now_s)
    if reasons:
        ends = memory.over or memory.began_s is not None or bool(reasons & _END_AT_ONCE)
        if reasons == {GroundReason.NOT_HELD} and not order.task.is_whole:
            ends = False  # let go: it goes on where it was, within its time
        over = memory.over or (reasons if ends else frozenset())
        memory = replace(memory, over=over)
        return _closed(setup, reasons, memory, now_s, valve_count, is_over=bool(over))
    return _open(setup, order, memory, now_s)


def ground_reasons(setup: GroundSetup, state: GroundState, now_s: float) -> frozenset[GroundReason]:
    """Return why the vehicle is not one at which ground work may be done; empty where it is."""
    found = [*_of_heartbeat(setup, state, now_s), *_of_landed(state, now_s)]
    if state.mission_active is True:
        found.append(GroundReason.MISSION_ACTIVE)
    if state.output is None or state.output.healthy is not True:
        found.append(GroundReason.OUTPUT_FAULT)
    elif state.output.guarded is not True:
        found.append(GroundReason.UNGUARDED)
    if state.was_stopped is not False or setup.rc_channel in state.turned_off:
        found.append(GroundReason.STOPPED)
    if setup.has_estop_line and state.estop_line is not False:
        found.append(GroundReason.ESTOP_UNKNOWN)
    return frozenset(found)


def _of_heartbeat(setup: GroundSetup, state: GroundState, now_s: float) -> list[GroundReason]:
    heartbeat = state.heartbeat
    if heartbeat is None:
        return [GroundReason.NO_HEARTBEAT]
    found = []
    if not EARLY_S <= now_s - heartbeat.received_s <= setup.heartbeat_age_max_s:
        found.append(GroundReason.STALE_HEARTBEAT)
    if heartbeat.armed is not False:
        found.append(GroundReason.ARMED)
    if not heartbeat.mode or heartbeat.mode in setup.modes | MISSION_MODES:
        found.append(GroundReason.MISSION_MODE)
    if setup.has_servo_outputs and heartbeat.autopilot != "ardupilot":
        # PX4's outputs follow no order while it is disarmed; of others nothing is known.
        found.append(GroundReason.OUTPUTS_NEED_ARMING)
    return found


def _of_landed(state: GroundState, now_s: float) -> list[GroundReason]:
    landed = state.landed
    if landed is None or not EARLY_S <= now_s - landed.received_s <= LANDED_AGE_MAX_S:
        return [GroundReason.LANDED_UNKNOWN]
    return [] if landed.on_ground is True else [GroundReason.NOT_LANDED]


def _of_order(order: GroundOrder, memory: GroundMemory, now_s: float) -> frozenset[GroundReason]:
    if not _done_s(memory, now_s) < order.task.seconds - _BIT_S:
        # A piece as long as may be ends by its time and by the limit at once: it is done.
        return frozenset({GroundReason.DONE})
    found = []
    hold = order.hold
    is_fresh = hold.first_s >= order.started_s and hold.first_s >= memory.anew_s
    if not hold.is_held(now_s) or not is_fresh:
        found.append(GroundReason.NOT_HELD)
    began_s = memory.began_s
    until_s = order.started_s + START_MAX_S if began_s is None else began_s + PIECE_MAX_S
    if not (order.started_s == memory.started_s and order.started_s <= now_s < until_s):
        found.append(GroundReason.TIME_OVER)
    if memory.since_s is None and began_s is not None and order.task.is_whole and not found:
        found.append(GroundReason.STALLED)
    return frozenset(found)


def _counted(memory: GroundMemory, now_s: float) -> GroundMemory:
    """Return the memory after a lease that has ended meanwhile: the executor closed then."""
    if memory.since_s is None or memory.since_s <= now_s < memory.lease_until_s:
        return memory
    done_s = memory.done_s + memory.lease_until_s - memory.since_s
    return replace(memory, since_s=None, done_s=done_s)


def _watched(memory: GroundMemory, now_s: float) -> GroundMemory:
    """Return the memory after a step that came too late: what was pressed before is void."""
    if memory.stepped_s is not None and not now_s - memory.stepped_s <= HOLD_S:
        memory = replace(memory, anew_s=now_s)
    return replace(memory, stepped_s=now_s)


def _done_s(memory: GroundMemory, now_s: float) -> float:
    return memory.done_s + (0.0 if memory.since_s is None else now_s - memory.since_s)


def _open(
    setup: GroundSetup, order: GroundOrder, memory: GroundMemory, now_s: float
) -> tuple[GroundDecision, GroundMemory]:
    task = order.task
    began_s = now_s if memory.began_s is None else memory.began_s
    since_s = now_s if memory.since_s is None else memory.since_s
    zero_s = since_s - memory.done_s  # when the work would have begun without its breaks
    until_s = min(
        now_s + setup.lease_s,
        order.hold.last_s + HOLD_S,
        began_s + PIECE_MAX_S,
        zero_s + task.seconds,
    )
    duty = planned = task.phases[0].duty
    changes: list[TimedChange] = []
    for phase in task.phases[1:]:
        at_s = zero_s + phase.at_s
        if at_s <= now_s:
            duty = phase.duty
        elif at_s < until_s:
            changes += [
                TimedChange(at_s=at_s, valve=valve, duty=after)
                for valve, (before, after) in enumerate(zip(planned, phase.duty, strict=True))
                if before != after
            ]
        planned = phase.duty
    plan = SprayPlan(
        sequence=memory.sequence + 1,
        issued_s=now_s,
        duty=duty,
        changes=tuple(changes),
        lease_until_s=until_s,
        drives=tuple(DrivePlan(fraction=fraction) for fraction in task.drives),
    )
    memory = replace(
        memory,
        sequence=plan.sequence,
        began_s=began_s,
        since_s=since_s,
        lease_until_s=until_s,
    )
    decision = GroundDecision(
        now_s=now_s,
        reasons=frozenset(),
        plan=plan,
        done_s=_done_s(memory, now_s),
        is_over=False,
    )
    return decision, memory


def _closed(
    setup: GroundSetup,
    reasons: frozenset[GroundReason],
    memory: GroundMemory,
    now_s: float,
    valve_count: int,
    *,
    is_over: bool,
) -> tuple[GroundDecision, GroundMemory]:
    # A time that is none makes a plan of the past: every executor closes by it or by its lease.
    at_s = now_s if math.isfinite(now_s) else 0.0
    done_s = _done_s(memory, now_s) if math.isfinite(now_s) else memory.done_s
    plan = SprayPlan(
        sequence=memory.sequence + 1,
        issued_s=at_s,
        duty=(0.0,) * valve_count,
        changes=(),
        lease_until_s=at_s + setup.lease_s,
    )
    memory = replace(memory, sequence=plan.sequence, since_s=None, done_s=done_s)
    decision = GroundDecision(
        now_s=now_s, reasons=reasons, plan=plan, done_s=done_s, is_over=is_over
    )
    return decision, memory


# What ground work has to know of the vehicle; neither place nor map is in it.
#
# Everything is as the vehicle said it last, with the time at which it was heard: whoever asks
# judges the age. What was never heard is `None`, and never counts as good.


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundState:
    """What has been heard so far.

    `mission_active` is what MISSION_CURRENT says, `None` where it does not say. `estop_line` is
    whether the switch on a line is pressed. `was_stopped` stays: whoever presses it, or enables,
    disables or stops by MAVLink, wants something else than ground work. `turned_off` are channels
    of the pilot's that were on and are off since, or lost: one that was never on says nothing.
    """

    heartbeat: HeartbeatReport | None = None
    landed: LandedReport | None = None
    output: OutputReport | None = None
    mission_active: bool | None = None
    estop_line: bool | None = None
    was_stopped: bool = False
    rc: RcReport | None = None
    turned_off: frozenset[int] = frozenset()


def _rc(state: GroundState, item: RcReport) -> GroundState:
    on = frozenset(channel for channel, us in enumerate(item.pulse_us, 1) if us >= RC_LOW_US)
    if state.rc is None:
        return replace(state, rc=item)
    was_on = {channel for channel, us in enumerate(state.rc.pulse_us, 1) if us >= RC_LOW_US}
    return replace(state, rc=item, turned_off=(state.turned_off | was_on) - on)


def _estop(state: GroundState, item: EstopReport) -> GroundState:
    if item.pressed is not False:
        state = replace(state, was_stopped=True)
    return replace(state, estop_line=item.pressed) if item.source == "line" else state


_OBSERVED: dict[type, Callable[[GroundState, Any], GroundState]] = {
    HeartbeatReport: lambda state, item: replace(state, heartbeat=item),
    LandedReport: lambda state, item: replace(state, landed=item),
    OutputReport: lambda state, item: replace(state, output=item),
    RcReport: _rc,
    EstopReport: _estop,
    OperatorCommand: lambda state, _: replace(state, was_stopped=True),
}


def observe_ground(state: GroundState, item: Input) -> GroundState:
    """Return `state` with one more input; what ground work does not need changes nothing."""
    take = _OBSERVED.get(type(item))
    return state if take is None else take(state, item)
