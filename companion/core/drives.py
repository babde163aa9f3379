"""What the motors do: the pump by the laws of the valves, the atomisers by the flow to come."""

from __future__ import annotations

from companion.core.atomiser import Flow
from companion.core.boom import Boom
from companion.core.boom_route import boom_route
from companion.core.crossings import Route
from companion.core.dosing import dosing_of, overdrive_of, speed_soon
from companion.core.drive_plans import (
    as_drive,
    behind_path,
    liquid_plan,
)
from companion.core.pump import Pumping, pump_route
from companion.core.rate import flow_for_rate, overridden
from companion.core.schedule import schedule, sticky_border_s
from companion.core.types import DrivePlan, SprayPlan, VehicleState


def modulated(
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
    """Return the plan of a pump that makes the flow, behind the valves' `plan`."""
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


def flows_ahead(
    boom: Boom, routes: tuple[Route, ...], *, skew: float, percent: float, limit_l_ha: float | None
) -> list[Flow]:
    """Return the boom's flow along its way, as it comes out of the nozzles."""
    width_m = boom.width_m * skew
    return [
        Flow(
            step.at_s,
            flow_for_rate(
                overridden(step.rate_l_ha or 0.0, percent, limit_l_ha),
                step.speed_m_s,
                width_m,
            ),
        )
        for step in boom_route(routes, boom)
    ]


def liquid_of(pumping: Pumping | None, plan: SprayPlan | None) -> SprayPlan | None:
    """Return the plan that the meter's flow follows: the valves', or that of the pump."""
    return plan if pumping is None else liquid_plan(plan, pumping.pump.way)
