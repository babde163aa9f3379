"""Ground work: the one state besides flight spraying in which a valve may open.

It is the opposite of the interlock's: the vehicle must be heard, disarmed, on the ground and in no
mission, and somebody must hold a key. Whatever is missing, stale or no number closes; the lease of
the plan ends with the hold, so that the executor closes even if no further step is made. Nothing
leads from here into a flight: arming ends the work for good, and enabling is not known here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

from companion.core.ground_hold import EARLY_S, HOLD_S, Hold
from companion.core.ground_state import GroundState
from companion.core.ground_task import PIECE_MAX_S, GroundTask
from companion.core.types import DrivePlan, SprayPlan, TimedChange

# EXTENDED_SYS_STATE is asked for at 2 Hz.
LANDED_AGE_MAX_S = 2.5
# Whoever has started has this long to begin holding; then it needs a new start.
START_MAX_S = 30.0
MISSION_MODES = frozenset({"AUTO", "MISSION"})
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
    if state.was_stopped is not False:
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
    found = []
    hold = order.hold
    is_fresh = hold.first_s >= order.started_s and hold.first_s >= memory.anew_s
    if not hold.is_held(now_s) or not is_fresh:
        found.append(GroundReason.NOT_HELD)
    began_s = memory.began_s
    until_s = order.started_s + START_MAX_S if began_s is None else began_s + PIECE_MAX_S
    if not (order.started_s == memory.started_s and order.started_s <= now_s < until_s):
        found.append(GroundReason.TIME_OVER)
    if not _done_s(memory, now_s) < order.task.seconds - _BIT_S:
        found.append(GroundReason.DONE)
    elif memory.since_s is None and began_s is not None and order.task.is_whole and not found:
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
