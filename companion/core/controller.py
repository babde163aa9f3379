"""The whole application as a function: from a vehicle state to a plan.

Read `step` from top to bottom: reasons not to spray, routes of the valves, changes of duty, plan,
interlock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from companion.core import flow_trim
from companion.core.boom import Boom
from companion.core.crossings import (
    STRAIGHT_YAW_RATE_DEG_S,
    Across,
    Border,
    Route,
    find_routes,
)
from companion.core.flow_trim import FlowTrim, TrimMemory, Trimming
from companion.core.frame import LocalFrame
from companion.core.interlock import Limits, closed_plan, guard, inhibits
from companion.core.nozzle import NozzleSet, PwmLimits, allowed_duty, choose_set
from companion.core.prescription import Prescription
from companion.core.rate import flow_for_rate
from companion.core.schedule import Dosing, LagModel, Timing, ValveSchedule, schedule
from companion.core.types import Decision, Inhibit, Method, SprayPlan, TimedChange, VehicleState

__all__ = ["Across", "Border", "Memory", "Setup", "step"]

# Below this share of its width across the motion, a boom that flies askew is dosed as at it: the
# flow that the law asks for would fall towards nothing while the strip is a blur.
SKEW_MIN = 0.3
# Crossings found in one step are carried on for this long, if the path does not leave its
# prediction by more than these and none of them is to be ordered within this time.
ROUTES_KEPT_S = 0.21
ROUTES_ASIDE_M = 0.05
ROUTES_ALONG_M = 0.2
ROUTES_EXACT_S = 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """All that is constant in a flight."""

    frame: LocalFrame
    prescription: Prescription
    boom: Boom
    nozzle_sets: tuple[NozzleSet, ...]
    pwm: PwmLimits
    lag: LagModel
    method: Method
    look_ahead_s: float
    limits: Limits
    border: Border = "inside"
    border_buffer_m: float = 0.1
    across: Across = "centre"
    lease_s: float = 0.3
    flow_trim: FlowTrim | None = None
    timing: Timing = field(init=False, repr=False, compare=False)
    trimming: Trimming | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.05 <= self.lease_s <= 5.0:
            raise ValueError(f"lease_s must lie in [0.05, 5] s, got {self.lease_s}")
        if not 0.0 <= self.look_ahead_s <= 30.0:
            raise ValueError(f"look_ahead_s must lie in [0, 30] s, got {self.look_ahead_s}")
        if not 0.0 <= self.border_buffer_m <= 100.0:
            raise ValueError(f"border_buffer_m must lie in [0, 100] m, got {self.border_buffer_m}")
        if not self.nozzle_sets:
            raise ValueError("at least one nozzle set is needed")
        count = len(self.boom.valves)
        if any(valve >= count for nozzles in self.nozzle_sets for valve in nozzles.valves):
            raise ValueError("a nozzle set names a valve that the boom does not have")
        timing = Timing.of(
            self.method, self.lag, look_ahead_s=self.look_ahead_s, period_s=self.pwm.period_s
        )
        object.__setattr__(self, "timing", timing)
        law = self.flow_trim
        trimming = None if law is None else Trimming.of(law, self.lag, self.pwm)
        object.__setattr__(self, "trimming", trimming)

    @property
    def back_s(self) -> float:
        """Return how far behind a path begins, so that short stays are seen whole."""
        return 0.1 + 2.0 * self.timing.dwell_min_s

    @property
    def ahead_s(self) -> float:
        """Return how far ahead a path must reach: the lease, the longest lead and a short stay."""
        timing = self.timing
        longest_s = timing.longest_s + 2.0 * timing.dwell_min_s
        return self.lease_s + longest_s + ROUTES_KEPT_S + 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What one step leaves to the next; a restart begins with nothing, closed."""

    plan: SprayPlan | None = None
    set_index: int = 0
    set_rate_l_ha: float | None = None
    routes: tuple[Route, ...] = ()
    routes_from: VehicleState | None = None
    trim: TrimMemory | None = None


def step(
    setup: Setup, state: VehicleState | None, memory: Memory, now_s: float
) -> tuple[Decision, Memory]:
    """Return what to do from `now_s` on, and what the next step has to know."""
    reasons = inhibits(state, setup.limits, field_bounds_m=setup.prescription.bounds_m, now_s=now_s)
    sequence = 1 if memory.plan is None else memory.plan.sequence + 1
    if reasons or state is None:
        return _closed(setup, state, reasons, sequence, memory, now_s)
    in_force = duty_in_force(memory.plan, now_s, len(setup.boom.valves))
    routes, routes_from = _routes(setup, state, memory, now_s)
    speed_m_s = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    index, set_rate = _nozzle_set(setup, routes, memory, speed_m_s)
    until_s = now_s + setup.lease_s
    trim = _trim(setup, state, memory, in_force, now_s)
    gain = 1.0 if trim is None else trim.sets[index].trim
    dosing = _dosing(setup, index, _skew(state, speed_m_s) / gain)
    soon_m_s = _speed_soon(setup, state, speed_m_s)
    valves = []
    for valve, route in enumerate(routes):
        # In a turn each valve has a speed of its own.
        own = route[0].speed_m_s / speed_m_s if abs(state.yaw_rate_deg_s) > 1.0 else 1.0
        valves.append(
            schedule(
                route,
                valve=valve,
                timing=setup.timing,
                dosing=dosing if valve in setup.nozzle_sets[index].valves else _shut,
                in_force=in_force[valve],
                speed_soon_m_s=soon_m_s * own,
                now_s=now_s,
                until_s=until_s,
            )
        )
    plan = SprayPlan(
        sequence=sequence,
        issued_s=now_s,
        duty=in_force,
        changes=_in_order(valves),
        lease_until_s=until_s,
    )
    plan = guard(plan, reasons, lease_s=setup.lease_s)
    flow_l_min = _flow(setup, plan, index)
    if setup.trimming is not None and trim is not None:
        trim = flow_trim.ordered(
            setup.trimming, trim, flow_l_min=flow_l_min, index=index, now_s=now_s
        )
    decision = _decision(
        setup, state, plan, valves,
        index=index, speed_m_s=speed_m_s, flow_l_min=flow_l_min * gain, trim=trim,
    )  # fmt: skip
    return decision, Memory(
        plan=plan,
        set_index=index,
        set_rate_l_ha=set_rate,
        routes=routes,
        routes_from=routes_from,
        trim=trim,
    )


def _trim(
    setup: Setup,
    state: VehicleState,
    memory: Memory,
    in_force: tuple[float, ...],
    now_s: float,
) -> TrimMemory | None:
    """Return the trims after the meter's newest count; None where no trim is configured."""
    if setup.trimming is None:
        return None
    before = memory.trim or flow_trim.begin(len(setup.nozzle_sets))
    is_steady, plan = memory.plan is not None, memory.plan
    for change in plan.changes if plan is not None else ():
        if change.at_s > now_s:
            break
        is_steady = is_steady and not change.restart
    duties = [in_force[valve] for valve in setup.nozzle_sets[memory.set_index].valves]
    low, high = min(duties), max(duties)
    return flow_trim.follow(
        setup.trimming,
        before,
        state.flow,
        is_steady=is_steady and low > 0.0,
        is_saturated=not setup.pwm.duty_min < low <= high < setup.pwm.duty_max,
        now_s=now_s,
    )


def _routes(
    setup: Setup, state: VehicleState, memory: Memory, now_s: float
) -> tuple[tuple[Route, ...], VehicleState]:
    """Return the valves' routes, and the state that they were found from.

    On a straight pass the same edges are crossed at every step: as long as the prediction holds
    and no crossing is due soon, the last ones are carried on and only their times are shifted.
    """
    found_from = memory.routes_from
    if found_from is not None:
        shift = _carried(setup, found_from, state, now_s)
        if shift is not None:
            routes = _shifted(memory.routes, shift, now_s)
            soon_s = now_s + setup.timing.longest_s + ROUTES_EXACT_S
            if all(len(route) == 1 or route[1].at_s > soon_s for route in routes):
                return routes, found_from
    routes = find_routes(
        setup.prescription,
        state,
        setup.boom,
        back_s=setup.back_s,
        ahead_s=setup.ahead_s,
        border=setup.border,
        border_buffer_m=setup.border_buffer_m,
        across=setup.across,
    )
    return routes, state


def _carried(
    setup: Setup, before: VehicleState, state: VehicleState, now_s: float
) -> tuple[float, float, float] | None:
    """Return how far along, how fast then and how fast now; None where the prediction fails."""
    age_s = now_s - before.time_s
    turning = max(abs(before.yaw_rate_deg_s), abs(state.yaw_rate_deg_s))
    if not (0.0 <= age_s <= ROUTES_KEPT_S and turning < STRAIGHT_YAW_RATE_DEG_S):
        return None
    then_east = before.velocity_east_m_s + before.acceleration_east_m_s2 * age_s
    then_north = before.velocity_north_m_s + before.acceleration_north_m_s2 * age_s
    east, north = state.velocity_east_m_s, state.velocity_north_m_s
    speed, then = math.hypot(east, north), math.hypot(then_east, then_north)
    if not (speed > 0.5 and then > 0.5):
        return None
    half = 0.5 * age_s * age_s
    off_east = state.east_m - before.east_m - before.velocity_east_m_s * age_s
    off_east -= before.acceleration_east_m_s2 * half
    off_north = state.north_m - before.north_m - before.velocity_north_m_s * age_s
    off_north -= before.acceleration_north_m_s2 * half
    aside = abs(off_north * east - off_east * north) / speed
    bend = abs(then_east * north - then_north * east) / (speed * then)
    turned_deg = ((state.heading_deg or 0.0) - (before.heading_deg or 0.0) + 180.0) % 360.0 - 180.0
    aside += bend * speed * (setup.timing.longest_s + ROUTES_EXACT_S)
    aside += math.radians(abs(turned_deg)) * setup.boom.reach_m
    along = (off_east * east + off_north * north) / speed
    if not (aside <= ROUTES_ASIDE_M and abs(along) <= ROUTES_ALONG_M):
        return None
    return along, then, speed


def _shifted(
    routes: tuple[Route, ...], shift: tuple[float, float, float], now_s: float
) -> tuple[Route, ...]:
    """Return the routes with their crossings at the times that the new position gives."""
    along_m, then, speed = shift
    moved: list[Route] = []
    for route in routes:
        if len(route) == 1:
            moved.append(route)
            continue
        moved.append(
            route[:1]
            + tuple(
                crossing._replace(at_s=now_s + ((crossing.at_s - now_s) * then - along_m) / speed)
                for crossing in route[1:]
            )
        )
    return tuple(moved)


def duty_in_force(plan: SprayPlan | None, now_s: float, valve_count: int) -> tuple[float, ...]:
    """Return what `plan` has brought about by `now_s`: its changes so far; closed after it."""
    if plan is None or not now_s < plan.lease_until_s:
        return (0.0,) * valve_count
    duty = list(plan.duty)
    for change in plan.changes:
        if change.at_s > now_s:
            break
        duty[change.valve] = change.duty
    return tuple(duty)


def _closed(
    setup: Setup,
    state: VehicleState | None,
    reasons: frozenset[Inhibit],
    sequence: int,
    memory: Memory,
    now_s: float,
) -> tuple[Decision, Memory]:
    count = len(setup.boom.valves)
    plan = closed_plan(sequence=sequence, valve_count=count, now_s=now_s, lease_s=setup.lease_s)
    trim = None
    if setup.trimming is not None:
        trim = memory.trim or flow_trim.begin(len(setup.nozzle_sets))
        trim = flow_trim.pause(trim, None if state is None else state.flow, now_s=now_s)
    decision = Decision(
        now_s=now_s,
        state=state,
        inhibits=reasons,
        plan=plan,
        rate_l_ha=(None,) * count,
        target_flow_l_min=0.0,
        flow_l_min=0.0,
        flow_trim=None if trim is None else trim.sets[trim.set_index].trim,
        flow_trim_state=None if trim is None else trim.state,
    )
    return decision, Memory(plan=plan, trim=trim)


def _skew(state: VehicleState, speed_m_s: float) -> float:
    """Return the boom's width across the motion over its width: |cos(heading - course)|."""
    if state.heading_deg is None or not speed_m_s > 0.0:
        return 1.0
    heading = math.radians(state.heading_deg)
    along = state.velocity_north_m_s * math.cos(heading)
    along += state.velocity_east_m_s * math.sin(heading)
    return max(abs(along) / speed_m_s, SKEW_MIN)


def _nozzle_set(
    setup: Setup, routes: tuple[Route, ...], memory: Memory, speed_m_s: float
) -> tuple[int, float | None]:
    """Return the set to spray with, chosen anew only where the rate ahead changes.

    Inside a zone the set stays, whatever the speed does, unless it can no longer deliver.
    """
    if len(setup.nozzle_sets) == 1:
        return 0, None
    middle = routes[len(routes) // 2]
    rates = [crossing.rate_l_ha for crossing in middle if crossing.rate_l_ha]
    if not rates:
        return memory.set_index, memory.set_rate_l_ha
    rate = rates[-1]
    flow = flow_for_rate(rate, speed_m_s, setup.boom.width_m)
    current = setup.nozzle_sets[memory.set_index]
    delivers = current.flow_min_l_min / 1.1 <= flow <= current.flow_max_l_min * 1.02
    if rate == memory.set_rate_l_ha and delivers:
        return memory.set_index, rate
    return choose_set(setup.nozzle_sets, flow, current=memory.set_index), rate


def _dosing(setup: Setup, index: int, skew: float) -> Dosing:
    """Return the function from rate and speed to the duty of a valve of the set in use."""
    width_m = setup.boom.width_m * skew
    curve, pwm = setup.nozzle_sets[index].curve, setup.pwm
    known: dict[tuple[float, float], float] = {}  # neighbours ask for the same

    def duty(rate_l_ha: float, speed_m_s: float) -> float:
        key = (rate_l_ha, speed_m_s)
        found = known.get(key)
        if found is None:
            flow = flow_for_rate(rate_l_ha, speed_m_s, width_m)
            found = known[key] = allowed_duty(curve.duty_for(flow), pwm)
        return found

    return duty


def _shut(rate_l_ha: float, speed_m_s: float) -> float:  # noqa: ARG001
    """Return the duty of a valve that the set in use does not have."""
    return 0.0


def _speed_soon(setup: Setup, state: VehicleState, speed_m_s: float) -> float:
    """Return the speed when an order given now takes effect.

    On a straight line, however long the lag: a flow that follows as an exponential keeps up with
    the speed if its order leads by dead time plus time constant, each direction by its own.
    """
    along = (
        state.velocity_east_m_s * state.acceleration_east_m_s2
        + state.velocity_north_m_s * state.acceleration_north_m_s2
    )
    lag_s = setup.timing.up_s if along > 0.0 else setup.timing.down_s
    return max(speed_m_s + along / speed_m_s * (lag_s + 0.5 * setup.pwm.period_s), 0.0)


def _in_order(valves: list[ValveSchedule]) -> tuple[TimedChange, ...]:
    changes = [change for valve in valves for change in valve.changes]
    changes.sort(key=lambda change: change.at_s)
    return tuple(changes)


def _decision(
    setup: Setup,
    state: VehicleState,
    plan: SprayPlan,
    valves: list[ValveSchedule],
    *,
    index: int,
    speed_m_s: float,
    flow_l_min: float,
    trim: TrimMemory | None,
) -> Decision:
    nozzles = setup.nozzle_sets[index]
    share = setup.boom.width_m / len(nozzles.valves)
    target = sum(
        flow_for_rate(valves[valve].rate_now_l_ha or 0.0, speed_m_s, share)
        for valve in nozzles.valves
    )
    return Decision(
        now_s=plan.issued_s,
        state=state,
        inhibits=frozenset(),
        plan=plan,
        rate_l_ha=tuple(valve.rate_now_l_ha for valve in valves),
        target_flow_l_min=target,
        flow_l_min=flow_l_min,
        late_count=sum(valve.late for valve in valves),
        unresolved_count=sum(valve.unresolved_count for valve in valves),
        flow_trim=None if trim is None else trim.sets[index].trim,
        flow_trim_state=None if trim is None else trim.state,
    )


def _flow(setup: Setup, plan: SprayPlan, index: int) -> float:
    """Return the flow [L/min] that the table says of the duties in force from now on."""
    nozzles = setup.nozzle_sets[index]
    now = duty_in_force(plan, plan.issued_s, len(setup.boom.valves))
    flows = {duty: nozzles.curve.flow_for(duty) for duty in set(now)}
    return sum(flows[now[valve]] for valve in nozzles.valves) / len(nozzles.valves)
