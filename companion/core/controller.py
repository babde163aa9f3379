"""The whole application as a function: from a vehicle state to a plan.

Read `step` from top to bottom: reasons not to spray, routes of the valves, changes of duty, plan,
interlock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from companion.core import detection, flow_trim, sprayer_state, swath
from companion.core.crossings import Route
from companion.core.detection import WatchMemory
from companion.core.dosing import dosing_of, overdrive_of, skew_of, speed_soon
from companion.core.drift import Offset
from companion.core.drives import liquid_of, ran, ways, with_drives, with_rates
from companion.core.flow_trim import TrimMemory
from companion.core.interlock import Held, closed_plan, guard, inhibits, settled
from companion.core.pump import DRY, PumpMemory, on_off
from companion.core.rate import flow_for_rate, overridden
from companion.core.routes import routes_ahead
from companion.core.schedule import Dosing, ValveSchedule, schedule, sticky_border_s
from companion.core.sets import SetOfRate, dosing_by_valve, sets_ahead
from companion.core.setup import Setup
from companion.core.sprayer_state import BOOT, Machine, shown
from companion.core.swath import Swath
from companion.core.types import (
    Decision,
    Finding,
    Inhibit,
    SprayerState,
    SprayPlan,
    TimedChange,
    VehicleState,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What one step leaves to the next; a restart begins with nothing, closed."""

    plan: SprayPlan | None = None
    set_index: int = 0
    set_of_rate: SetOfRate = ()
    routes: tuple[Route, ...] = ()
    routes_from: VehicleState | None = None
    drift_m: Offset | None = None
    trim: TrimMemory | None = None
    watch: WatchMemory | None = None
    reasons: frozenset[Inhibit] = frozenset()
    held: Held = ()
    machine: Machine = BOOT
    pump: PumpMemory = DRY
    swath: Swath | None = None


def step(
    setup: Setup, state: VehicleState | None, memory: Memory, now_s: float
) -> tuple[Decision, Memory]:
    """Return what to do from `now_s` on, and what the next step has to know."""
    memory = _watched(setup, state, memory, now_s)
    reasons = inhibits(
        state,
        setup.limits,
        field_bounds_m=setup.prescription.bounds_m,
        now_s=now_s,
        before=memory.reasons,
    )
    reasons, held = settled(reasons | detection.inhibits_of(memory.watch), memory.held, now_s)
    machine, reasons = sprayer_state.follow(memory.machine, reasons, state)
    memory = replace(
        memory,
        held=held,
        machine=machine,
        pump=ran(setup, memory.pump, memory.plan, now_s),
        swath=_swept(setup, state, memory, now_s),
    )
    sequence = 1 if memory.plan is None else memory.plan.sequence + 1
    if reasons or state is None:
        return _closed(setup, state, reasons, sequence, memory, now_s)
    in_force = duty_in_force(memory.plan, now_s, len(setup.boom.valves))
    routes, routes_from, drift_m = routes_ahead(setup, state, memory, now_s)
    speed_m_s = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    index, set_of_rate = _nozzle_sets(setup, state, routes, memory, speed_m_s)
    until_s = now_s + setup.lease_s
    trim = _trim(setup, state, memory, now_s)
    gain = 1.0 if trim is None else trim.sets[index].trim
    skew = skew_of(state, speed_m_s)

    def dose(number: int) -> Dosing:
        own = 1.0 if trim is None else trim.sets[number].trim
        return dosing_of(setup, number, skew / own, state.rate_percent)

    dosing = dosing_by_valve(setup.nozzle_sets, index, set_of_rate, dose)
    soon_m_s = speed_soon(setup, state, speed_m_s)
    overdrive = overdrive_of(setup, index)
    sticky_s = sticky_border_s(setup.border_buffer_m, speed_m_s)
    valves = []
    own_ways, pump_memory = ways(setup, routes, memory.pump, now_s)
    for valve, route in enumerate(own_ways):
        # In a turn each valve has a speed of its own.
        own = route[0].speed_m_s / speed_m_s if abs(state.yaw_rate_deg_s) > 1.0 else 1.0
        valves.append(
            schedule(
                route,
                valve=valve,
                timing=setup.timing,
                dosing=dosing(valve) if setup.pumping is None else on_off,
                in_force=in_force[valve],
                speed_soon_m_s=soon_m_s * own,
                now_s=now_s,
                until_s=until_s,
                overdrive=overdrive,
                sticky_border_s=sticky_s,
            )
        )
    plan = SprayPlan(
        sequence=sequence,
        issued_s=now_s,
        duty=in_force,
        changes=_in_order(valves),
        lease_until_s=until_s,
    )
    plan = with_drives(
        setup, state, plan, routes,
        before=memory.plan, memory=pump_memory, speed_m_s=speed_m_s, skew=skew, gain=gain,
    )  # fmt: skip
    plan = guard(plan, reasons, lease_s=setup.lease_s)
    flow_l_min = _flow(setup, plan, index)
    if setup.trimming is not None and trim is not None:
        trim = flow_trim.ordered(
            setup.trimming, trim, flow_l_min=flow_l_min, index=index, now_s=now_s
        )
    decision = _decision(
        setup, state, plan, with_rates(setup, valves, routes, now_s),
        index=index, speed_m_s=speed_m_s, flow_l_min=flow_l_min * gain, trim=trim,
        findings=_findings(setup, memory), sprayer=shown(machine, is_open=plan.opens),
    )  # fmt: skip
    return decision, Memory(
        plan=plan,
        set_index=index,
        set_of_rate=set_of_rate,
        routes=routes,
        routes_from=routes_from,
        drift_m=drift_m,
        trim=trim,
        watch=memory.watch,
        held=held,
        machine=machine,
        pump=pump_memory,
        swath=memory.swath,
    )


def _watched(setup: Setup, state: VehicleState | None, memory: Memory, now_s: float) -> Memory:
    """Return the memory with what flow, pressure and tank say of the plan until now."""
    if setup.watching is None:
        return memory
    watch = detection.follow(
        setup.watching,
        memory.watch or WatchMemory(),
        liquid_of(setup, memory.plan),
        state,
        index=memory.set_index,
        now_s=now_s,
    )
    return replace(memory, watch=watch)


def _swept(setup: Setup, state: VehicleState | None, memory: Memory, now_s: float) -> Swath | None:
    """Return what was treated until now; None where it is not kept."""
    if not setup.records_coverage:
        return None
    return swath.follow(
        setup, memory.swath, memory.plan, state,
        findings=_findings(setup, memory), drift_m=memory.drift_m, now_s=now_s,
    )  # fmt: skip


def _findings(setup: Setup, memory: Memory) -> tuple[Finding, ...]:
    if memory.watch is None:
        return ()
    if setup.pumping is None:
        return memory.watch.findings
    # The one valve that was watched is the pump: nothing tells which section it is.
    return tuple(replace(finding, valve=None) for finding in memory.watch.findings)


def _trim(
    setup: Setup,
    state: VehicleState,
    memory: Memory,
    now_s: float,
) -> TrimMemory | None:
    """Return the trims after the meter's newest count; None where no trim is configured."""
    if setup.trimming is None:
        return None
    before = memory.trim or flow_trim.begin(len(setup.nozzle_sets))
    plan, doses = liquid_of(setup, memory.plan), setup.doses
    is_steady = plan is not None
    for change in plan.changes if plan is not None else ():
        if change.at_s > now_s:
            break
        is_steady = is_steady and not change.restart
    in_force = duty_in_force(plan, now_s, len(setup.boom.valves))
    duties = [in_force[valve] for valve in doses.nozzle_sets[memory.set_index].valves]
    low, high = min(duties), max(duties)
    return flow_trim.follow(
        setup.trimming,
        before,
        state.flow,
        is_steady=is_steady and low > 0.0,
        is_saturated=not doses.pwm.duty_min < low <= high < doses.pwm.duty_max,
        now_s=now_s,
    )


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
        findings=_findings(setup, memory),
        sprayer=shown(memory.machine, is_open=False),
    )
    return decision, Memory(
        plan=plan,
        trim=trim,
        watch=memory.watch,
        reasons=reasons,
        held=memory.held,
        machine=memory.machine,
        pump=memory.pump._replace(is_early=False),
        swath=memory.swath,
    )


def _nozzle_sets(
    setup: Setup,
    state: VehicleState,
    routes: tuple[Route, ...],
    memory: Memory,
    speed_m_s: float,
) -> tuple[int, SetOfRate]:
    """Return the set in use and those of the rates ahead; the middle of the boom decides."""

    def flow_of(rate_l_ha: float) -> float:
        asked = overridden(rate_l_ha, state.rate_percent, setup.rate_max_l_ha)
        return flow_for_rate(asked, speed_m_s, setup.boom.width_m)

    return sets_ahead(
        setup.nozzle_sets,
        routes[len(routes) // 2],
        in_use=memory.set_index,
        before=memory.set_of_rate,
        flow_of=flow_of,
        now_s=state.time_s,
    )


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
    findings: tuple[Finding, ...],
    sprayer: SprayerState,
) -> Decision:
    nozzles = setup.nozzle_sets[index]
    percent, limit_l_ha = state.rate_percent, setup.rate_max_l_ha
    # As if all valves of the set had the rate of this one.
    flows = [
        flow_for_rate(
            overridden(valves[valve].rate_now_l_ha or 0.0, percent, limit_l_ha),
            speed_m_s,
            setup.boom.width_m,
        )
        for valve in nozzles.valves
    ]
    target = sum(flows) / len(flows)
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
        findings=findings,
        sprayer=sprayer,
        out_of_range_count=sum(not nozzles.curve.delivers(flow) for flow in flows),
    )


def _flow(setup: Setup, plan: SprayPlan, index: int) -> float:
    """Return the flow [L/min] that the table says of the duties in force from now on."""
    liquid = liquid_of(setup, plan)
    nozzles = setup.doses.nozzle_sets[index]
    now = duty_in_force(liquid, plan.issued_s, len(setup.boom.valves))
    flows = {duty: nozzles.curve.flow_for(duty) for duty in set(now)}
    return sum(flows[now[valve]] for valve in nozzles.valves) / len(nozzles.valves)
