"""What the sprayer may do, as one state, and the latch of faults and emergency stops.

    BOOT -> SAFE -> READY -> ARMED <-> SPRAYING        any -> FAULT, ESTOP -> SAFE

A state follows from the reasons not to spray, so several arrows may be one step. FAULT and ESTOP
are latched: when their cause is gone they stay, and nothing opens, until the operator has
disabled, or enabled anew, after it. A stop outranks a fault.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.core.interlock import Held, Limits, inhibits, settled
from companion.core.types import Inhibit, SprayerState, VehicleState

# Somebody has to see to the sprayer.
FAULTS = frozenset(
    {
        Inhibit.OUTPUT_FAULT,
        Inhibit.LEAK,
        Inhibit.VALVE_STUCK_OPEN,
        Inhibit.NO_FLOW,
        Inhibit.TANK_EMPTY,
        Inhibit.FLOW_FAULT,
    }
)
# Until the vehicle was heard nobody can say more.
_UNHEARD = frozenset({Inhibit.NO_POSITION, Inhibit.NO_HEARTBEAT})
# What a flight goes through at each turn: too slow, too low, too high. Permission stays.
ENVELOPE = frozenset(
    {
        Inhibit.SPEED_BELOW_MIN,
        Inhibit.SPEED_ABOVE_MAX,
        Inhibit.HEIGHT_BELOW_MIN,
        Inhibit.HEIGHT_ABOVE_MAX,
    }
)
# What a sprayer on the ground, fit to fly, waits for.
_BEFORE_FLIGHT = ENVELOPE | {
    Inhibit.NOT_ENABLED,
    Inhibit.NOT_ARMED,
    Inhibit.NOT_ACTIVE,
    Inhibit.WRONG_MODE,
    Inhibit.NOT_IN_AIR,
    Inhibit.RC_SWITCH,
}
LATCHED = frozenset({SprayerState.FAULT, SprayerState.ESTOP})


class Machine(NamedTuple):
    """The state (never SPRAYING, which is an ARMED one that is open), and of a latch the answer.

    `wishes` is how many the operator had had when the cause of a latch was last there: the answer
    is one more.
    """

    state: SprayerState = SprayerState.BOOT
    wishes: int = 0


BOOT = Machine()


def follow(
    before: Machine, reasons: frozenset[Inhibit], state: VehicleState | None
) -> tuple[Machine, frozenset[Inhibit]]:
    """Return the state after `reasons`, and these with the reason that a latch adds."""
    cause = _cause(reasons)
    if cause is not None:
        is_stop = SprayerState.ESTOP in (cause, before.state)
        latched = SprayerState.ESTOP if is_stop else SprayerState.FAULT
        return Machine(latched, before.wishes if state is None else state.operator_wishes), reasons
    if before.state in LATCHED and not _is_answered(before, state):
        return before, reasons | {Inhibit.REARM_NEEDED}
    return Machine(_unlatched(before.state, reasons)), reasons


def _cause(reasons: frozenset[Inhibit]) -> SprayerState | None:
    if Inhibit.ESTOP in reasons:
        return SprayerState.ESTOP
    return SprayerState.FAULT if reasons & FAULTS else None


def _is_answered(latch: Machine, state: VehicleState | None) -> bool:
    """Return whether the operator has disabled, or enabled anew, since the cause was there."""
    return state is not None and state.operator_wishes > latch.wishes


def _unlatched(before: SprayerState, reasons: frozenset[Inhibit]) -> SprayerState:
    if before is SprayerState.BOOT and reasons & _UNHEARD:
        return SprayerState.BOOT
    if reasons <= ENVELOPE:
        return SprayerState.ARMED
    if Inhibit.NOT_ENABLED in reasons and reasons <= _BEFORE_FLIGHT:
        return SprayerState.READY
    return SprayerState.SAFE


def shown(machine: Machine, *, is_open: bool) -> SprayerState:
    """Return the state to be told: SPRAYING where a valve is open or about to be."""
    return SprayerState.SPRAYING if is_open else machine.state


class Permission(NamedTuple):
    """Every reason not to spray now, those that stay for a while, and the sprayer's state."""

    reasons: frozenset[Inhibit] = frozenset()
    held: Held = ()
    machine: Machine = BOOT


UNASKED = Permission()


def permit(
    before: Permission,
    state: VehicleState | None,
    limits: Limits,
    *,
    faults: frozenset[Inhibit],
    field_bounds_m: tuple[float, float, float, float],
    now_s: float,
) -> Permission:
    """Return whether anything may be sprayed now: only where there is no reason against it.

    `faults` are what flow, pressure and tank say.
    """
    reasons = inhibits(
        state, limits, field_bounds_m=field_bounds_m, now_s=now_s, before=before.reasons
    )
    reasons, held = settled(reasons | faults, before.held, now_s)
    machine, reasons = follow(before.machine, reasons, state)
    return Permission(reasons, held, machine)
