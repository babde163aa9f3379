"""What the motors do: the pump by the laws of the valves, the atomisers by the flow to come."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from companion.core.atomiser import Flow, spinning
from companion.core.boom_route import boom_route
from companion.core.crossings import Route
from companion.core.dosing import dosing_of, overdrive_of, speed_soon
from companion.core.drive_plans import (
    as_drive,
    behind_path,
    constant_drive,
    fraction_in_force,
    liquid_plan,
)
from companion.core.pump import Pumping, PumpMemory, pump_route, sections
from companion.core.rate import flow_for_rate, overridden
from companion.core.schedule import ValveSchedule, rate_at, schedule, sticky_border_s
from companion.core.types import DrivePlan, SprayPlan, VehicleState

if TYPE_CHECKING:
    from companion.core.setup import Setup


def ways(
    setup: Setup, routes: tuple[Route, ...], memory: PumpMemory, now_s: float
) -> tuple[tuple[Route, ...], PumpMemory]:
    """Return the routes that the valves follow: their own, or those of on-off sections."""
    if setup.pumping is None:
        return routes, memory
    found, is_early = sections(setup.pumping, routes, memory, now_s)
    return found, memory._replace(is_early=is_early)


def with_rates(
    setup: Setup, valves: list[ValveSchedule], routes: tuple[Route, ...], now_s: float
) -> list[ValveSchedule]:
    """Return schedules of sections with what is prescribed for them now."""
    if setup.pumping is None:
        return valves
    return [
        valve._replace(rate_now_l_ha=rate_at(route, now_s))
        for valve, route in zip(valves, routes, strict=True)
    ]


def with_drives(
    setup: Setup,
    state: VehicleState,
    plan: SprayPlan,
    routes: tuple[Route, ...],
    *,
    before: SprayPlan | None,
    memory: PumpMemory,
    speed_m_s: float,
    skew: float,
    gain: float,
) -> SprayPlan:
    """Return a plan of the valves with those of the drives: the pump's, the atomisers'.

    `before` is the last plan, `gain` the flow trim's. Without drives it is the plan as it is.
    """
    if setup.pump is None and not setup.atomisers:
        return plan
    now_s, until_s = plan.issued_s, plan.lease_until_s
    drives: list[DrivePlan] = []
    if setup.pumping is not None:
        drives.append(
            _pump(
                setup.pumping, state, plan, routes,
                in_force=fraction_in_force(before, 0, now_s),
                speed_m_s=speed_m_s, skew=skew / gain, border_buffer_m=setup.border_buffer_m,
            )
        )  # fmt: skip
    elif setup.pump is not None:
        drives.append(constant_drive(setup.pump, plan))
    if setup.atomisers:
        flows = _flows(setup, state, routes, skew)
        for number, atomiser in enumerate(setup.atomisers, start=len(drives)):
            drives.append(
                spinning(
                    atomiser, flows,
                    in_force=fraction_in_force(before, number, now_s), ran_s=memory.ran_s,
                    output_s=setup.lag.output_s, now_s=now_s, until_s=until_s,
                )
            )  # fmt: skip
    return replace(plan, drives=tuple(drives))


def _pump(
    pumping: Pumping,
    state: VehicleState,
    plan: SprayPlan,
    routes: tuple[Route, ...],
    *,
    in_force: float,
    speed_m_s: float,
    skew: float,
    border_buffer_m: float,
) -> DrivePlan:
    found = schedule(
        pump_route(pumping, routes),
        valve=0,
        timing=pumping.timing,
        dosing=dosing_of(pumping, 0, skew, state.rate_percent),
        in_force=in_force,
        speed_soon_m_s=speed_soon(pumping, state, speed_m_s),
        now_s=plan.issued_s,
        until_s=plan.lease_until_s,
        overdrive=overdrive_of(pumping, 0),
        sticky_border_s=sticky_border_s(border_buffer_m, speed_m_s),
    )
    drive = as_drive(in_force, found.changes)
    return behind_path(plan, drive) if pumping.pump.way == "valves" else drive


def _flows(setup: Setup, state: VehicleState, routes: tuple[Route, ...], skew: float) -> list[Flow]:
    """Return the boom's flow along its way, as it comes out of the nozzles."""
    width_m, percent = setup.boom.width_m * skew, state.rate_percent
    return [
        Flow(
            step.at_s,
            flow_for_rate(
                overridden(step.rate_l_ha or 0.0, percent, setup.rate_max_l_ha),
                step.speed_m_s,
                width_m,
            ),
        )
        for step in boom_route(routes, setup.boom)
    ]


def liquid_of(setup: Setup, plan: SprayPlan | None) -> SprayPlan | None:
    """Return the plan that the meter's flow follows: the valves', or that of the pump."""
    if setup.pumping is None:
        return plan
    return liquid_plan(plan, setup.pumping.pump.way)


def ran(setup: Setup, memory: PumpMemory, plan: SprayPlan | None, now_s: float) -> PumpMemory:
    """Return the memory with the last moment at which something was to flow."""
    liquid = liquid_of(setup, plan)
    if liquid is None or not now_s < liquid.lease_until_s:
        return memory
    duty = list(liquid.duty)
    for change in liquid.changes:
        if not change.at_s <= now_s:
            break
        duty[change.valve] = change.duty
    return memory._replace(ran_s=now_s) if any(duty) else memory
