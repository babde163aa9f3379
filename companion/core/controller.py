"""The whole application as a function: from a vehicle state to a plan.

`step` has five stages, each a function of what it is given: what came of the last plan (`_watch`),
whether anything may be sprayed (`permit`), the routes of the valves (`_routes`), their changes of
duty (`_orders`), and the plan that they make.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

from companion.core.boom import sweep_at, sweeps_alike
from companion.core.crossings import (
    NO_ROUTES,
    Crossing,
    KnownRoutes,
    Route,
    carried_on,
    find_routes,
    rate_at,
)
from companion.core.frame import Offset
from companion.core.nozzle import (
    NozzleSet,
    SetOfRate,
    acts_after_s,
    dosing_by_valve,
    dosing_of,
    flow_for_rate,
    overdrive_of,
    overridden,
    sets_ahead,
    skew_of,
    speed_soon,
)
from companion.core.options import flow_trim, treated_area
from companion.core.options.atomisers import flows_ahead, spinning
from companion.core.options.coverage import Coverage
from companion.core.options.drift import is_same, landed, offset
from companion.core.options.flow_trim import TrimMemory
from companion.core.options.lines import Piece, add_off_lines
from companion.core.options.overlap import guarded, treated_before
from companion.core.options.pump import (
    Pumping,
    constant_drive,
    liquid_of,
    modulated,
    on_off,
    sections,
)
from companion.core.options.treated_area import TreatedArea
from companion.core.safety import (
    NUMBER_MAX,
    UNASKED,
    Permission,
    closed_plan,
    guard,
    permit,
    shown,
)
from companion.core.schedule import (
    STICKY_S,
    Dosing,
    ValveSchedule,
    has_passed,
    in_zone,
    schedule,
    sticky_border_s,
)
from companion.core.setup import Setup
from companion.core.standing import Flowing, Standing, standing
from companion.core.types import (
    Decision,
    DriveChange,
    DrivePlan,
    Finding,
    Inhibit,
    Method,
    SprayPlan,
    TimedChange,
    VehicleState,
)

if TYPE_CHECKING:
    from companion.core.options.liquid_faults import WatchMemory


class Watched(NamedTuple):
    """What came of the plans so far: faults of the liquid, and the ground that was treated.

    `ran_s` is when something was last to flow, where a motor wants to know.
    """

    watch: WatchMemory | None = None
    area: TreatedArea | None = None
    ran_s: float = -math.inf


class Ordering(NamedTuple):
    """What the orders of one step leave to the next: sets in use, trims, a valve opened early."""

    set_index: int = 0
    set_of_rate: SetOfRate = ()
    trim: TrimMemory | None = None
    is_early: bool = False


NOTHING_WATCHED = Watched()
NOTHING_ORDERED = Ordering()
_NO_FAULTS = frozenset[Inhibit]()


@dataclass(frozen=True, slots=True, kw_only=True)
class Memory:
    """What one step leaves to the next, a part for each stage; a restart begins with nothing."""

    plan: SprayPlan | None = None
    watched: Watched = NOTHING_WATCHED
    permission: Permission = UNASKED
    routes: KnownRoutes = NO_ROUTES
    ordering: Ordering = NOTHING_ORDERED


class Orders(NamedTuple):
    """The schedule of each valve, and by which set, duty, speed, skew and gain it was made."""

    valves: list[ValveSchedule]
    ordering: Ordering
    in_force: tuple[float, ...]
    speed_m_s: float
    skew: float
    gain: float


def step(
    setup: Setup, state: VehicleState | None, memory: Memory, now_s: float
) -> tuple[Decision, Memory]:
    """Return what to do from `now_s` on, and what the next step has to know.

    It raises for no state and no time: all closes where one is no number.
    """
    before, ordering = memory.plan, memory.ordering
    if not abs(now_s) < NUMBER_MAX:  # the clock is broken: closed since the last step
        now_s, state = 0.0 if before is None else before.issued_s, None
    liquid = liquid_of(setup.pumping, before)
    watched = _watch(
        setup, state, memory.watched, before, liquid,
        set_index=ordering.set_index, drift_m=memory.routes.drift_m, now_s=now_s,
    )  # fmt: skip
    permission = permit(
        memory.permission,
        state,
        setup.limits,
        faults=_NO_FAULTS if watched.watch is None else watched.watch.latched,
        field_bounds_m=setup.prescription.bounds_m,
        now_s=now_s,
    )
    sequence = 1 if before is None else before.sequence + 1
    if permission.reasons or state is None:
        return _closed(setup, state, permission, watched, ordering.trim, sequence, now_s)
    routes = _routes(setup, state, memory.routes, watched.area, now_s)
    watched = _settled(watched, now_s, is_busy=routes.found_from is state)
    orders = _orders(setup, state, routes.routes, ordering, watched, before, now_s)
    stands = _stands(setup, state, routes)
    if stands is not None and not orders.ordering.is_early:
        orders = orders._replace(valves=_kept(setup, stands, orders, now_s))
    plan = SprayPlan(
        sequence=sequence,
        issued_s=now_s,
        duty=orders.in_force,
        changes=_in_order(orders.valves),
        lease_until_s=now_s + setup.lease_s,
    )
    if setup.pump is not None or setup.atomisers:
        drives = _drives(setup, state, plan, routes.routes, orders, before, watched.ran_s)
        if stands is not None and setup.pumping is not None:
            drives = (_kept_drive(setup.pumping, stands, plan, drives[0]), *drives[1:])
        plan = replace(plan, drives=drives)
    plan = guard(plan, permission.reasons, lease_s=setup.lease_s)
    decision, ordering = _decision(setup, state, plan, routes.routes, orders, watched, permission)
    return decision, Memory(
        plan=plan, watched=watched, permission=permission, routes=routes, ordering=ordering
    )


# --------------------------------------------------------------------- what came of the last plan


def _watch(
    setup: Setup,
    state: VehicleState | None,
    before: Watched,
    plan: SprayPlan | None,
    liquid: SprayPlan | None,
    *,
    set_index: int,
    drift_m: Offset | None,
    now_s: float,
) -> Watched:
    """Return what flow, pressure and tank say of the plan until now, and what it treated."""
    watch, area, ran_s = before
    if setup.watching is not None:
        # With the set-up it was loaded: here it is only looked up.
        from companion.core.options.liquid_faults import follow

        watch = follow(setup.watching, watch, liquid, state, index=set_index, now_s=now_s)
    if setup.recording is not None:
        area = treated_area.follow(
            setup.recording, area, plan, state,
            pumped=liquid if setup.pumping is not None else None,
            findings=_findings(setup, watch), drift_m=drift_m, now_s=now_s,
        )  # fmt: skip
    has_motors = setup.pump is not None or bool(setup.atomisers)
    if has_motors and liquid is not None and any(liquid.duty_at(now_s)):
        ran_s = now_s
    return Watched(watch, area, ran_s)


def _settled(watched: Watched, now_s: float, *, is_busy: bool) -> Watched:
    """Return it with its ground stamped: by a step that had no routes to find, or before long."""
    area = watched.area
    if area is None or area.unstamped is None or (is_busy and area.may_wait(now_s)):
        return watched
    return watched._replace(area=area.settled())


def _findings(setup: Setup, watch: WatchMemory | None) -> tuple[Finding, ...]:
    if watch is None:
        return ()
    if setup.pumping is None:
        return watch.findings
    # The one valve that was watched is the pump: nothing tells which section it is.
    return tuple(replace(finding, valve=None) for finding in watch.findings)


def expected_coverage(
    setup: Setup, memory: Memory, state: VehicleState | None, *, now_s: float, cut_s: float
) -> Coverage:
    """Return the ground treated if all goes on until `cut_s` and every valve closes then.

    With `cut_s` at `now_s` it is that of a flight that ends now. `memory` is what the step of
    `now_s` has left; nothing is treated where no record is kept.
    """
    if setup.recording is None:
        return Coverage()
    pumped = None if setup.pumping is None else liquid_of(setup.pumping, memory.plan)
    return treated_area.expected(
        setup.recording, memory.watched.area, memory.plan, state,
        pumped=pumped, findings=_findings(setup, memory.watched.watch),
        drift_m=memory.routes.drift_m, now_s=now_s, cut_s=cut_s,
    )  # fmt: skip


# ------------------------------------------------------------------------- where nothing may fall


def _closed(
    setup: Setup,
    state: VehicleState | None,
    permission: Permission,
    watched: Watched,
    trim: TrimMemory | None,
    sequence: int,
    now_s: float,
) -> tuple[Decision, Memory]:
    count = len(setup.boom.valves)
    plan = closed_plan(sequence=sequence, valve_count=count, now_s=now_s, lease_s=setup.lease_s)
    if setup.trimming is not None:
        trim = trim or flow_trim.begin(len(setup.nozzle_sets))
        trim = flow_trim.pause(trim, None if state is None else state.flow, now_s=now_s)
    decision = Decision(
        now_s=now_s,
        state=state,
        inhibits=permission.reasons,
        plan=plan,
        rate_l_ha=(None,) * count,
        target_flow_l_min=0.0,
        flow_l_min=0.0,
        flow_trim=None if trim is None else trim.sets[trim.set_index].trim,
        flow_trim_state=None if trim is None else trim.state,
        findings=_findings(setup, watched.watch),
        sprayer=shown(permission.sprayer, is_open=False),
    )
    return decision, Memory(
        plan=plan, watched=watched, permission=permission, ordering=Ordering(trim=trim)
    )


# --------------------------------------------------------------------------- routes of the valves


def _routes(
    setup: Setup, state: VehicleState, before: KnownRoutes, area: TreatedArea | None, now_s: float
) -> KnownRoutes:
    """Return what each valve is prescribed along its way: carried on, or found anew."""
    drift_m, flown = offset(setup.drift, state, now_s), _flown_lines(setup, state, before)
    if is_same(drift_m, before.drift_m) and flown != ():
        carried = carried_on(
            before,
            state,
            longest_s=setup.longest_s,
            reach_m=setup.boom.reach_m,
            now_s=now_s,
        )
        if carried is not None:
            return carried
    there = state if drift_m is None else landed(state, drift_m)
    routes = find_routes(
        setup.prescription,
        there,
        setup.boom,
        back_s=setup.back_s,
        ahead_s=setup.ahead_s,
        border=setup.border,
        border_buffer_m=setup.border_buffer_m,
        across=setup.across,
        drift_m=drift_m,
        close_more=None
        if flown is None
        else partial(add_off_lines, flown=flown, boom=setup.boom, strict=setup.border == "inside"),
        leads_s=setup.leads_s,
    )
    if setup.overlap is not None:
        treated = treated_before(
            setup.overlap, area, there, setup.boom, back_s=setup.back_s, now_s=now_s
        )
        routes = guarded(
            setup.overlap, routes, setup.treated if treated is None else treated, there,
            setup.boom, back_s=setup.back_s, ahead_s=setup.ahead_s,
        )  # fmt: skip
    return KnownRoutes(routes, state, drift_m)


def _flown_lines(
    setup: Setup, state: VehicleState, before: KnownRoutes
) -> tuple[Piece, ...] | None:
    """Return which planned lines are flown; None where spraying needs no line."""
    if setup.lines is None:
        return None
    was_on_one = any(zone.rate_l_ha is not None for route in before.routes for zone in route)
    return setup.lines.flown(
        state,
        back_s=setup.back_s,
        ahead_s=setup.ahead_s,
        reach_m=setup.boom.reach_m,
        ends_s=max(timing.border_off_s for timing in setup.timings),
        entering=not was_on_one,
    )


# -------------------------------------------------------------------------------- changes of duty


def _orders(
    setup: Setup,
    state: VehicleState,
    routes: tuple[Route, ...],
    before: Ordering,
    watched: Watched,
    plan: SprayPlan | None,
    now_s: float,
) -> Orders:
    """Return the changes of each valve along its route, after what the last plan has done."""
    speed_m_s = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    in_force = _in_force(setup, plan, now_s)
    # The middle of the boom decides on the set.
    index, set_of_rate = sets_ahead(
        setup.nozzle_sets, routes[len(routes) // 2],
        in_use=before.set_index, before=before.set_of_rate,
        flow_of=_flow_of(setup, state, speed_m_s), now_s=state.time_s,
    )  # fmt: skip
    # What the meter's flow is of.
    trim = _trim(setup, state, before, liquid_of(setup.pumping, plan), now_s)
    skew, is_alike = skew_of(state, speed_m_s), sweeps_alike(state)

    def dose(number: int, share: float) -> Dosing:
        own = share if trim is None else share * trim.sets[number].trim
        return dosing_of(setup, number, (skew if is_alike else 1.0) / own, state.rate_percent)

    dosing: Sequence[Dosing] = (on_off,) * len(in_force)
    is_early, own_routes = False, routes
    if setup.pumping is None:
        dosing = dosing_by_valve(setup.nozzle_sets, index, set_of_rate, dose, count=len(in_force))
    else:
        own_routes, is_early = sections(
            setup.pumping, routes, ran_s=watched.ran_s, was_early=before.is_early, now_s=now_s
        )
    shares = [1.0] * len(in_force)
    if not is_alike:
        own_routes, shares = _in_turn(setup, state, own_routes, in_force, now_s)
    each = zip(own_routes, shares, in_force, dosing, strict=True)
    valves = _scheduled(setup, state, list(each), index, speed_m_s, now_s)
    gain = 1.0 if trim is None else trim.sets[index].trim
    ordering = Ordering(index, set_of_rate, trim, is_early)
    return Orders(valves, ordering, in_force, speed_m_s, skew, gain)


# Of a valve: its route, its speed beside the boom's, the duty in force, and how it is dosed.
_Due = tuple[Route, float, float, Dosing]


def _scheduled(
    setup: Setup,
    state: VehicleState,
    due: list[_Due],
    set_index: int,
    speed_m_s: float,
    now_s: float,
) -> list[ValveSchedule]:
    """Return the changes of each valve until the lease ends."""
    soon_m_s = speed_soon(setup, state, speed_m_s)
    overdrive = overdrive_of(setup, set_index)
    sticky_s = sticky_border_s(setup.border_buffer_m, speed_m_s)
    until_s = now_s + setup.lease_s
    # A crossing after this is for no order of this step, nor does it hold one back.
    free_s = max(until_s, now_s + STICKY_S) + setup.longest_s
    valves: list[ValveSchedule] = []
    alike: dict[tuple[float | None, float, float, Dosing, bool], ValveSchedule] = {}
    for valve, (route, own, in_force, dosing) in enumerate(due):
        # Of several crossings a stay may be too short, which is counted.
        is_inside = len(route) == 1 or (len(route) == 2 and route[1].at_s > free_s)
        has_entered = not is_inside and overdrive is None and has_passed(route, now_s)
        if is_inside or has_entered:
            # Neighbours in the middle of one zone do the same.
            rate = route[has_entered].rate_l_ha
            key = (rate, own, in_force, dosing, has_entered)
            made = alike.get(key)
            if made is None:
                made = in_zone(
                    rate, valve, dosing, in_force, soon_m_s * own, now_s, has_entered=has_entered
                )
                alike[key] = made
            else:
                made = made.of(valve)
        else:
            made = schedule(
                route, valve=valve, timing=setup.timings[valve], dosing=dosing,
                in_force=in_force, speed_soon_m_s=soon_m_s * own, now_s=now_s, until_s=until_s,
                overdrive=overdrive, sticky_border_s=sticky_s,
            )  # fmt: skip
        valves.append(made)
    return valves


def _stands(setup: Setup, state: VehicleState, routes: KnownRoutes) -> Standing | None:
    """Return where the boom is by its present state, if it is near what nothing may fall on."""
    if setup.guarded is None or routes.found_from is not state:
        return None
    return standing(
        setup.guarded, state, setup.boom,
        most_m_s2=setup.most_m_s2, drift_m=routes.drift_m, within_s=setup.flows_s,
    )  # fmt: skip


def _kept(setup: Setup, stands: Standing, orders: Orders, now_s: float) -> list[ValveSchedule]:
    """Return the changes of the valves without those that the present state alone forbids."""
    flowing = []
    for valve, (timing, one) in enumerate(zip(setup.timings, orders.valves, strict=True)):
        # A pulse in the middle of its period comes so much later, if nothing follows soon.
        gaps = (b.at_s - a.at_s for a, b in pairwise(one.changes))
        is_alone = next(gaps, math.inf) >= timing.alone_s
        opens = max((change.duty for change in one.changes), default=0.0)
        duty = orders.in_force[valve] or opens
        flowing.append(
            Flowing(
                (valve,),
                orders.in_force[valve] > 0.0,
                [(change.at_s, change.duty) for change in one.changes],
                timing.border_on_s + (timing.rest_s(duty) if is_alone else 0.0),
                timing.border_off_s,
            )
        )
    each = enumerate(zip(orders.valves, stands.kept(flowing), strict=True))
    return [
        one if count is None else one._replace(
            changes=one.changes[:count] if count >= 0
            else (TimedChange(at_s=now_s, valve=valve, duty=0.0),)
        )
        for valve, (one, count) in each
    ]  # fmt: skip


def _in_turn(
    setup: Setup,
    state: VehicleState,
    routes: tuple[Route, ...],
    in_force: tuple[float, ...],
    now_s: float,
) -> tuple[tuple[Route, ...], list[float]]:
    """Return the routes, and how fast each valve sweeps the ground beside the reference's speed.

    Each by its own velocity along the nose: on the routes when it gets there, else when an order
    of now acts. A valve that the turn carries backwards closes. At the end of a pass, where the
    boom begins to swing about one end, nothing opens once more.
    """
    soon = sweep_at(state, acts_after_s(setup))
    swept_m_s = soon.of(setup.boom)
    swings = min(swept_m_s) == 0.0 and state.yaw_rate_deg_s * state.yaw_gain_deg_s2 > 0.0
    closed: Route = (Crossing(now_s, None, False, 0.0),)

    def swept(step: Crossing, valve: int) -> Crossing:
        there_m_s = sweep_at(state, step.at_s - state.time_s).of(setup.boom)
        return step._replace(speed_m_s=there_m_s[valve])

    held = [
        closed
        if not own > 0.0 or (swings and duty == 0.0)
        else tuple([swept(step, valve) for step in route])
        for valve, (route, own, duty) in enumerate(zip(routes, swept_m_s, in_force, strict=True))
    ]
    return tuple(held), [own / max(soon.speed_m_s, 1e-3) for own in swept_m_s]


def _trim(
    setup: Setup, state: VehicleState, before: Ordering, liquid: SprayPlan | None, now_s: float
) -> TrimMemory | None:
    """Return the trims after the meter's newest count; None where no trim is configured."""
    if setup.trimming is None:
        return None
    doses = setup.doses
    is_steady = liquid is not None
    for change in liquid.changes if liquid is not None else ():
        if change.at_s > now_s:
            break
        is_steady = is_steady and not change.restart
    in_force = _in_force(setup, liquid, now_s)
    duties = [in_force[valve] for valve in doses.nozzle_sets[before.set_index].valves]
    low, high = min(duties), max(duties)
    return flow_trim.follow(
        setup.trimming,
        before.trim or flow_trim.begin(len(setup.nozzle_sets)),
        state.flow,
        is_steady=is_steady and low > 0.0,
        is_saturated=not doses.pwm.duty_min < low <= high < doses.pwm.duty_max,
        now_s=now_s,
    )


def _flow_of(setup: Setup, state: VehicleState, speed_m_s: float) -> Callable[[float], float]:
    """Return the function from a rate of the map to the whole boom's flow [L/min] at a speed."""

    def flow_of(rate_l_ha: float) -> float:
        asked = overridden(rate_l_ha, state.rate_percent, setup.rate_max_l_ha)
        return flow_for_rate(asked, speed_m_s, setup.boom.width_m)

    return flow_of


# -------------------------------------------------------------------------------- plan and record


def _in_force(setup: Setup, plan: SprayPlan | None, now_s: float) -> tuple[float, ...]:
    """Return the duties that a plan has brought about by now; closed where there is none."""
    return (0.0,) * len(setup.boom.valves) if plan is None else plan.duty_at(now_s)


def _in_order(valves: list[ValveSchedule]) -> tuple[TimedChange, ...]:
    changes = [change for valve in valves for change in valve.changes]
    return tuple(sorted(changes, key=attrgetter("at_s")))


def _drives(
    setup: Setup,
    state: VehicleState,
    plan: SprayPlan,
    routes: tuple[Route, ...],
    orders: Orders,
    before: SprayPlan | None,
    ran_s: float,
) -> tuple[DrivePlan, ...]:
    """Return what the motors do beside a plan of the valves; `before` is the last whole plan."""
    now_s, until_s = plan.issued_s, plan.lease_until_s
    drives: list[DrivePlan] = []
    if setup.pumping is not None:
        drives.append(
            modulated(
                setup.pumping, state, plan, routes,
                in_force=0.0 if before is None else before.fraction_at(0, now_s),
                speed_m_s=orders.speed_m_s, skew=orders.skew / orders.gain,
                border_buffer_m=setup.border_buffer_m,
            )
        )  # fmt: skip
    elif setup.pump is not None:
        drives.append(constant_drive(setup.pump, plan))
    if setup.atomisers:
        flows = flows_ahead(
            setup.boom, routes,
            skew=orders.skew, percent=state.rate_percent, limit_l_ha=setup.rate_max_l_ha,
        )  # fmt: skip
        for number, atomiser in enumerate(setup.atomisers, start=len(drives)):
            drives.append(
                spinning(
                    atomiser, flows,
                    in_force=0.0 if before is None else before.fraction_at(number, now_s),
                    ran_s=ran_s, output_s=setup.lag.output_s, now_s=now_s, until_s=until_s,
                )
            )  # fmt: skip
    return tuple(drives)


def _kept_drive(pumping: Pumping, stands: Standing, plan: SprayPlan, drive: DrivePlan) -> DrivePlan:
    """Return a pump's plan without what the present state alone forbids, where it makes the edges.

    With a return valve the sections do. Behind valves alone it starts over those that are open.
    """
    if pumping.pump.outlet == "return" or pumping.method is not Method.SCHEDULED:
        return drive
    changes = [(change.at_s, change.fraction) for change in drive.changes]
    timing = pumping.timing
    every = range(len(stands.boom.valves))
    one = Flowing(every, drive.fraction > 0.0, changes, timing.border_on_s, timing.border_off_s)
    if pumping.pump.outlet == "valves":
        opening = one.opening()
        flows_s = plan.issued_s if opening is None else opening[1] + timing.border_on_s
        duty = plan.duty_at(flows_s)
        one = one._replace(valves=[valve for valve in every if duty[valve] > 0.0])
    (count,) = stands.kept([one])
    if count is None:
        return drive
    stop = (DriveChange(at_s=plan.issued_s, fraction=0.0),)
    return replace(drive, changes=drive.changes[:count] if count >= 0 else stop)


def _decision(
    setup: Setup,
    state: VehicleState,
    plan: SprayPlan,
    routes: tuple[Route, ...],
    orders: Orders,
    watched: Watched,
    permission: Permission,
) -> tuple[Decision, Ordering]:
    """Return the record of a step that may spray, and its trims with the flow that it orders."""
    now_s, ordering = plan.issued_s, orders.ordering
    index, trim = ordering.set_index, ordering.trim
    nozzles = setup.nozzle_sets[index]
    rates = [valve.rate_now_l_ha for valve in orders.valves]
    if setup.pumping is not None:  # of sections: what is prescribed for them, not open or shut
        rates = [rate_at(route, now_s) for route in routes]
    # As if all valves of the set had the rate of this one, across the boom.
    flow_of = _flow_of(setup, state, orders.speed_m_s * orders.skew)
    known = {rate: flow_of(rate or 0.0) for rate in set(rates)}
    flows = [known[rates[valve]] for valve in nozzles.valves]
    too_much = {flow for flow in known.values() if not nozzles.curve.delivers(flow)}
    flow_l_min = _flow(setup, plan, setup.doses.nozzle_sets[index])
    if setup.trimming is not None and trim is not None:
        trim = flow_trim.ordered(
            setup.trimming, trim, flow_l_min=flow_l_min, index=index, now_s=now_s
        )
    decision = Decision(
        now_s=now_s,
        state=state,
        inhibits=frozenset(),
        plan=plan,
        rate_l_ha=tuple(rates),
        target_flow_l_min=sum(flows) / len(flows),
        flow_l_min=flow_l_min * orders.gain,
        late_count=sum([valve.late for valve in orders.valves]),
        unresolved_count=sum([valve.unresolved_count for valve in orders.valves]),
        flow_trim=None if trim is None else trim.sets[index].trim,
        flow_trim_state=None if trim is None else trim.state,
        findings=_findings(setup, watched.watch),
        sprayer=shown(permission.sprayer, is_open=plan.opens),
        out_of_range_count=sum([flow in too_much for flow in flows]) if too_much else 0,
    )
    return decision, ordering if trim is ordering.trim else ordering._replace(trim=trim)


def _flow(setup: Setup, plan: SprayPlan, nozzles: NozzleSet) -> float:
    """Return the flow [L/min] that the table says of the duties in force from now on."""
    now = _in_force(setup, liquid_of(setup.pumping, plan), plan.issued_s)
    flows = {duty: nozzles.curve.flow_for(duty) for duty in set(now)}
    of_each = [flows[now[valve]] for valve in nozzles.valves]
    if nozzles.shares:
        of_each = [flow * share for flow, share in zip(of_each, nozzles.shares, strict=True)]
    return sum(of_each) / len(of_each)
