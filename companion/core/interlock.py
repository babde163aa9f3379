"""The last word of the core: any reason not to spray makes the all-closed plan.

It knows nothing of rates. Every check is written positively (`if not age <= limit`), so that NaN,
a missing value and a stale one close the valves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.core.types import Fix, Inhibit, SprayPlan, VehicleState


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """What must hold before a valve may open; the contract's `[safety]` table."""

    modes: frozenset[str] = frozenset({"AUTO"})
    position_age_max_s: float = 0.8
    heartbeat_age_max_s: float = 2.5
    speed_min_m_s: float = 1.0
    speed_max_m_s: float = 12.0
    speed_disagreement_max_m_s: float = 1.0
    height_min_m: float = 1.0
    height_max_m: float = 10.0
    fix: Fix = Fix.RTK_FLOAT
    wind_max_m_s: float = 6.0
    wind_required: bool = False
    distance_max_m: float = 20_000.0
    enable_by: frozenset[str] = frozenset({"command", "rc", "web"})
    rc_channel: int | None = None


def inhibits(
    state: VehicleState | None,
    limits: Limits,
    *,
    field_bounds_m: tuple[float, float, float, float],
    now_s: float,
) -> frozenset[Inhibit]:
    """Return every reason not to spray now."""
    if state is None:
        return frozenset({Inhibit.NO_POSITION})
    return frozenset(
        [
            *_operator_and_vehicle(state, limits, now_s),
            *_position(state, limits, field_bounds_m, now_s),
            *_speed_and_height(state, limits),
        ]
    )


def _operator_and_vehicle(state: VehicleState, limits: Limits, now_s: float) -> list[Inhibit]:
    found = []
    if not state.enabled:
        found.append(Inhibit.NOT_ENABLED)
    if state.heartbeat_received_s is None:
        found.append(Inhibit.NO_HEARTBEAT)
    elif not -0.1 <= now_s - state.heartbeat_received_s <= limits.heartbeat_age_max_s:
        found.append(Inhibit.STALE_HEARTBEAT)
    if not state.armed:
        found.append(Inhibit.NOT_ARMED)
    if state.mode not in limits.modes:
        found.append(Inhibit.WRONG_MODE)
    if state.in_air is not True:
        found.append(Inhibit.NOT_IN_AIR)
    if not state.output_healthy:
        found.append(Inhibit.OUTPUT_FAULT)
    wind = state.wind_m_s
    if (wind is None and limits.wind_required) or (
        wind is not None and not 0.0 <= wind <= limits.wind_max_m_s
    ):
        found.append(Inhibit.WIND_ABOVE_MAX)
    return found


def _position(
    state: VehicleState,
    limits: Limits,
    field_bounds_m: tuple[float, float, float, float],
    now_s: float,
) -> list[Inhibit]:
    found = []
    if not -0.1 <= now_s - state.position_received_s <= limits.position_age_max_s:
        found.append(Inhibit.STALE_POSITION)
    if not state.position_valid:
        found.append(Inhibit.INVALID_POSITION)
    west, south, east, north = field_bounds_m
    reach = limits.distance_max_m
    if not (
        west - reach <= state.east_m <= east + reach
        and south - reach <= state.north_m <= north + reach
    ):
        found.append(Inhibit.FAR_FROM_FIELD)
    if state.fix is None or not state.fix >= limits.fix:
        found.append(Inhibit.FIX_TOO_LOW)
    if state.estimator_healthy is not True:
        found.append(Inhibit.ESTIMATOR_UNHEALTHY)
    if state.heading_deg is None or not abs(state.heading_deg) <= 360.0:
        found.append(Inhibit.HEADING_UNKNOWN)
    return found


def _speed_and_height(state: VehicleState, limits: Limits) -> list[Inhibit]:
    found = []
    speed = math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)
    if not state.velocity_known:
        found.append(Inhibit.SPEED_UNKNOWN)
    if not speed >= limits.speed_min_m_s:
        found.append(Inhibit.SPEED_BELOW_MIN)
    if not speed <= limits.speed_max_m_s:
        found.append(Inhibit.SPEED_ABOVE_MAX)
    checked = state.checked_speed_m_s
    if checked is not None and not abs(checked - speed) <= limits.speed_disagreement_max_m_s:
        found.append(Inhibit.SPEED_DISAGREES)
    if not state.height_m >= limits.height_min_m:
        found.append(Inhibit.HEIGHT_BELOW_MIN)
    if not state.height_m <= limits.height_max_m:
        found.append(Inhibit.HEIGHT_ABOVE_MAX)
    return found


def closed_plan(*, sequence: int, valve_count: int, now_s: float, lease_s: float) -> SprayPlan:
    """Return the plan that closes every valve at once."""
    return SprayPlan(
        sequence=sequence,
        issued_s=now_s,
        duty=(0.0,) * valve_count,
        changes=(),
        lease_until_s=now_s + lease_s,
    )


def guard(plan: SprayPlan, reasons: frozenset[Inhibit], *, lease_s: float) -> SprayPlan:
    """Return `plan`, or the all-closed plan if there is any reason."""
    if not reasons:
        return plan
    return closed_plan(
        sequence=plan.sequence,
        valve_count=len(plan.duty),
        now_s=plan.issued_s,
        lease_s=lease_s,
    )
