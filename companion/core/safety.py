"""All that permits spraying: limits, the operator's consent, stops, faults and their latch.

`permit` answers whether anything may be sprayed now: only where there is no reason against it.
Nothing here knows of rates or routes, and nothing here opens a valve; any reason makes the
all-closed plan (`guard`). Every check is written positively (`if not age <= limit`), so that NaN,
a missing value and a stale one close the valves.

In this order: limits and the reasons that follow from a state; the operator's consent; the
sprayer's state, which latches faults and emergency stops; `permit`, which puts them together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from companion.core.inputs import (
    DeclarationReport,
    EstopReport,
    HeartbeatReport,
    OperatorCommand,
    RcReport,
    UtcReport,
)
from companion.core.label import LabelLimits, label_broken
from companion.core.types import Fix, Inhibit, SprayerState, SprayPlan, VehicleState

# -------------------------------------------------------------- limits, and the reasons that follow

# What closed at a limit opens again this far inside it, so that noise does not make it chatter:
# three standard deviations and more of the filtered speed (0.03 m/s), of the height, and of the
# mean wind; never more than this share of the room between the limits.
SPEED_MARGIN_M_S = 0.1
HEIGHT_MARGIN_M = 0.3
WIND_MARGIN_M_S = 0.5
MARGIN_SHARE_MAX = 0.1
# What says that the place may be wrong stays for this long after it was last said: a fix that
# comes and goes is none.
HOLD_S = {
    Inhibit.FIX_TOO_LOW: 1.0,
    Inhibit.ACCURACY_TOO_LOW: 1.0,
    Inhibit.ESTIMATOR_UNHEALTHY: 1.0,
}
_WITH_MARGIN = frozenset(
    {
        Inhibit.SPEED_BELOW_MIN,
        Inhibit.SPEED_ABOVE_MAX,
        Inhibit.SPEED_DISAGREES,
        Inhibit.HEIGHT_BELOW_MIN,
        Inhibit.HEIGHT_ABOVE_MAX,
        Inhibit.WIND_ABOVE_MAX,
    }
)


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
    speed_check_required: bool = False
    wind_age_max_s: float = 5.0
    accuracy_max_m: float | None = None  # None: what the receiver says of itself is not judged
    estop_required: bool = False
    # Heartbeats that stayed away for longer take the operator's consent along.
    consent_gap_max_s: float = 10.0
    label: LabelLimits | None = None

    @property
    def calm_max_m_s(self) -> float:
        """Return the wind above which it has to be measured to have dropped."""
        span = None if self.label is None else self.label.wind_m_s
        return self.wind_max_m_s if span is None else min(self.wind_max_m_s, span[1])

    def asked_utc(self, report: UtcReport) -> UtcReport | None:
        """Return the time of day where a label has hours; None where nobody asks for it."""
        return report if self.label is not None and self.label.needs_utc else None

    def asked_declaration(self, report: DeclarationReport) -> DeclarationReport | None:
        """Return what of a declaration is checked: not its words, which are for the record."""
        return None if self.label is None else replace(report, said="")

    def allows(self, mode: str | None) -> bool:
        """Whether spraying is allowed in a mode; AUTO is also what PX4 calls MISSION."""
        return mode in self.modes or (mode == "MISSION" and "AUTO" in self.modes)


def inhibits(
    state: VehicleState | None,
    limits: Limits,
    *,
    field_bounds_m: tuple[float, float, float, float],
    now_s: float,
    before: frozenset[Inhibit] = frozenset(),
) -> frozenset[Inhibit]:
    """Return every reason not to spray now; those that held `before` take more to go away."""
    if state is None:
        return frozenset({Inhibit.NO_POSITION})
    limits = held(limits, before)
    found = [
        *_operator(state, limits),
        *_vehicle(state, limits, now_s),
        *_wind(state, limits, now_s),
        *_position(state, limits, field_bounds_m, now_s),
        *_speed_and_height(state, limits),
    ]
    if limits.label is not None:
        found += _label(state, limits, limits.label, before, now_s)
    return frozenset(found)


def held(limits: Limits, before: frozenset[Inhibit]) -> Limits:
    """Return the limits for one who was outside of them: a margin further in."""
    if not before & _WITH_MARGIN:
        return limits

    def margin(reason: Inhibit, wanted: float, room: float) -> float:
        # A room that is no room (limits the wrong way round) stays none.
        return min(wanted, MARGIN_SHARE_MAX * max(room, 0.0)) if reason in before else 0.0

    speeds = limits.speed_max_m_s - limits.speed_min_m_s
    heights = limits.height_max_m - limits.height_min_m
    apart, wind = limits.speed_disagreement_max_m_s, limits.wind_max_m_s
    return replace(
        limits,
        speed_min_m_s=limits.speed_min_m_s
        + margin(Inhibit.SPEED_BELOW_MIN, SPEED_MARGIN_M_S, speeds),
        speed_max_m_s=limits.speed_max_m_s
        - margin(Inhibit.SPEED_ABOVE_MAX, SPEED_MARGIN_M_S, speeds),
        speed_disagreement_max_m_s=apart - margin(Inhibit.SPEED_DISAGREES, SPEED_MARGIN_M_S, apart),
        height_min_m=limits.height_min_m
        + margin(Inhibit.HEIGHT_BELOW_MIN, HEIGHT_MARGIN_M, heights),
        height_max_m=limits.height_max_m
        - margin(Inhibit.HEIGHT_ABOVE_MAX, HEIGHT_MARGIN_M, heights),
        wind_max_m_s=wind - margin(Inhibit.WIND_ABOVE_MAX, WIND_MARGIN_M_S, wind),
    )


def _operator(state: VehicleState, limits: Limits) -> list[Inhibit]:
    found = []
    if state.estop is True or (limits.estop_required and state.estop is not False):
        found.append(Inhibit.ESTOP)
    if not state.enabled:
        found.append(Inhibit.NOT_ENABLED)
    if limits.rc_channel is not None and state.rc_switch_on is not True:
        found.append(Inhibit.RC_SWITCH)
    return found


def _vehicle(state: VehicleState, limits: Limits, now_s: float) -> list[Inhibit]:
    found = []
    if state.heartbeat_received_s is None:
        found.append(Inhibit.NO_HEARTBEAT)
    elif not -0.1 <= now_s - state.heartbeat_received_s <= limits.heartbeat_age_max_s:
        found.append(Inhibit.STALE_HEARTBEAT)
    if not state.armed:
        found.append(Inhibit.NOT_ARMED)
    if not state.active:
        found.append(Inhibit.NOT_ACTIVE)
    if not limits.allows(state.mode):
        found.append(Inhibit.WRONG_MODE)
    if state.in_air is not True:
        found.append(Inhibit.NOT_IN_AIR)
    if not state.output_healthy:
        found.append(Inhibit.OUTPUT_FAULT)
    if not state.link_up:
        found.append(Inhibit.LINK_LOST)
    if state.output_guarded is not True:
        found.append(Inhibit.UNGUARDED)
    return found


def _wind(state: VehicleState, limits: Limits, now_s: float) -> list[Inhibit]:
    """Check the wind; one that was too strong stays so until a newer report says otherwise."""
    found = []
    wind = state.wind_m_s
    if wind is not None and not 0.0 <= wind <= limits.wind_max_m_s:
        found.append(Inhibit.WIND_ABOVE_MAX)
    heard_s = state.wind_received_s
    is_young = heard_s is not None and -0.1 <= now_s - heard_s <= limits.wind_age_max_s
    if limits.wind_required and not (wind is not None and is_young):
        found.append(Inhibit.WIND_UNKNOWN)
    return found


# No place, speed, time or turn of a flight is larger.
NUMBER_MAX = 1e9


def _is_motion(state: VehicleState) -> bool:
    """Return whether a path can be foretold from it: numbers all, and none divides by 0.

    Place, speed and height have limits of their own.
    """
    stop = state.stop_ahead
    numbers = (
        state.time_s, state.acceleration_east_m_s2, state.acceleration_north_m_s2,
        state.outrun_east_m_s, state.outrun_north_m_s,
        state.yaw_rate_deg_s, state.yaw_gain_deg_s2, state.rate_percent,
        0.0 if stop is None else stop.distance_m,
    )  # fmt: skip
    if not 0.0 < state.acceleration_fade_s < NUMBER_MAX:
        return False
    if stop is not None and not 0.0 < stop.braking_m_s2 < NUMBER_MAX:
        return False
    return all(abs(number) < NUMBER_MAX for number in numbers)


def _position(
    state: VehicleState,
    limits: Limits,
    field_bounds_m: tuple[float, float, float, float],
    now_s: float,
) -> list[Inhibit]:
    found = []
    if not -0.1 <= now_s - state.position_received_s <= limits.position_age_max_s:
        found.append(Inhibit.STALE_POSITION)
    if not (state.position_valid and _is_motion(state)):
        found.append(Inhibit.INVALID_POSITION)
    if state.position_frozen is not False:
        found.append(Inhibit.POSITION_FROZEN)
    if state.clock_agrees is not True:
        found.append(Inhibit.CLOCK_DISAGREES)
    west, south, east, north = field_bounds_m
    reach = limits.distance_max_m
    if not (
        west - reach <= state.east_m <= east + reach
        and south - reach <= state.north_m <= north + reach
    ):
        found.append(Inhibit.FAR_FROM_FIELD)
    if state.fix is None or not state.fix >= limits.fix:
        found.append(Inhibit.FIX_TOO_LOW)
    accuracy_m, worst_m = state.horizontal_accuracy_m, limits.accuracy_max_m
    if accuracy_m is not None and worst_m is not None and not 0.0 <= accuracy_m <= worst_m:
        found.append(Inhibit.ACCURACY_TOO_LOW)
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
    if checked is None and limits.speed_check_required:
        found.append(Inhibit.SPEED_UNCHECKED)
    if not state.height_m >= limits.height_min_m:
        found.append(Inhibit.HEIGHT_BELOW_MIN)
    if not state.height_m <= limits.height_max_m:
        found.append(Inhibit.HEIGHT_ABOVE_MAX)
    return found


def _label(
    state: VehicleState,
    limits: Limits,
    label: LabelLimits,
    before: frozenset[Inhibit],
    now_s: float,
) -> list[Inhibit]:
    """Check what label and permit ask for, where they are given as data."""
    margins = {
        Inhibit.LABEL_SPEED: SPEED_MARGIN_M_S,
        Inhibit.LABEL_HEIGHT: HEIGHT_MARGIN_M,
        Inhibit.LABEL_WIND: WIND_MARGIN_M_S,
    }
    held_by = {reason: margin for reason, margin in margins.items() if reason in before}
    return label_broken(state, label, held_by, wind_age_max_s=limits.wind_age_max_s, now_s=now_s)


# Reasons that stay, and until when.
Held = tuple[tuple[Inhibit, float], ...]


def settled(
    reasons: frozenset[Inhibit], before: Held, now_s: float
) -> tuple[frozenset[Inhibit], Held]:
    """Return the reasons with those that have not been gone for long enough, and what stays."""
    if not reasons and not before:
        return reasons, before
    still = tuple((reason, s) for reason, s in before if reason not in reasons and not now_s >= s)
    anew = tuple((reason, now_s + hold_s) for reason, hold_s in HOLD_S.items() if reason in reasons)
    return reasons.union(reason for reason, _ in still), anew + still


# --------------------------------------------------------------------------- the operator's consent

# A companion that stood still for longer asks the operator again.
CONSENT_STANDSTILL_S = 2.0
# The switch is asked for at 5 to 10 Hz, of which a slowed-down link leaves a quarter.
RC_AGE_MAX_S = 2.0
CLOCK_SLACK_S = 0.1
RC_HIGH_US = 1700
RC_LOW_US = 1300
RC_SIGNAL_MAX_US = 2300


@dataclass(frozen=True, slots=True, kw_only=True)
class Consent:
    """Whether the operator allows spraying, by whichever way, and which stops are pressed.

    `wishes` is how often somebody has enabled anew, or disabled. `estops` is None where none was
    heard of; `switch_us` is of the operator's channel in `rc`, and 0 is no signal. `declared` is
    what was declared for label and permit since the start, where there are any.
    """

    enabled: bool = False
    wishes: int = 0
    estops: frozenset[str] | None = None
    rc: RcReport | None = None
    switch_us: int = 0
    declared: DeclarationReport | None = None

    @property
    def is_stopped(self) -> bool | None:
        """Whether an emergency stop is pressed; None where none was heard of."""
        return None if self.estops is None else bool(self.estops)

    def switch_on(self, now_s: float) -> bool | None:
        """Whether the operator's switch is not off; None where nothing young is known of it."""
        if self.rc is None or not -CLOCK_SLACK_S <= now_s - self.rc.received_s <= RC_AGE_MAX_S:
            return None
        return RC_LOW_US <= self.switch_us <= RC_SIGNAL_MAX_US

    def wished(self, enabled: bool) -> Consent:
        """Return the consent after a wish; to repeat that one may spray is no new wish."""
        is_new = not (enabled and self.enabled)
        return replace(self, enabled=enabled and not self.estops, wishes=self.wishes + is_new)

    def after_standstill(self, gap_s: float) -> Consent:
        """Return what is left of the consent after the companion itself stood still."""
        enabled = self.enabled and gap_s <= CONSENT_STANDSTILL_S
        return replace(self, enabled=enabled, rc=None, switch_us=0)


NO_CONSENT = Consent()


def consented(
    consent: Consent,
    item: HeartbeatReport | OperatorCommand | EstopReport | RcReport | DeclarationReport,
    limits: Limits,
    *,
    heartbeat: HeartbeatReport | None,
) -> Consent:
    """Return the consent after one more input; `heartbeat` is the last one before it."""
    if isinstance(item, HeartbeatReport):
        return _after_heartbeat(consent, item, limits, heartbeat)
    if isinstance(item, OperatorCommand):
        return _after_command(consent, item, limits)
    if isinstance(item, EstopReport):
        return _after_estop(consent, item)
    if isinstance(item, DeclarationReport):
        return replace(consent, declared=limits.asked_declaration(item))
    return _after_rc(consent, item, limits)


def _after_heartbeat(
    consent: Consent, item: HeartbeatReport, limits: Limits, before: HeartbeatReport | None
) -> Consent:
    """Disarming, and leaving the modes that may spray, take the operator's consent back."""
    if before is None or not consent.enabled:
        return consent
    disarms = before.armed and not item.armed
    leaves = limits.allows(before.mode) and not limits.allows(item.mode)
    stays = item.received_s - before.received_s <= limits.consent_gap_max_s
    return replace(consent, enabled=False) if disarms or leaves or not stays else consent


def _after_command(consent: Consent, item: OperatorCommand, limits: Limits) -> Consent:
    """Take the operator's wish; to disable also ends a stop that was commanded.

    Who may not enable changes nothing by trying; everyone may disable.
    """
    if item.enable and item.source not in limits.enable_by:
        return consent
    if not item.enable and consent.estops:
        consent = replace(consent, estops=consent.estops - {"command"})
    return consent.wished(item.enable)


def _after_estop(consent: Consent, item: EstopReport) -> Consent:
    """Take the consent back at a stop; while it is pressed nobody can give it."""
    pressed = consent.estops or frozenset()
    if item.pressed is not False:
        return replace(consent, estops=pressed | {item.source}, enabled=False)
    return replace(consent, estops=pressed - {item.source})


def _after_rc(consent: Consent, item: RcReport, limits: Limits) -> Consent:
    """Only the edges of the switch count: up enables, down disables, a lost signal disables."""
    channel, wish = limits.rc_channel, None
    if channel is not None and "rc" in limits.enable_by and consent.rc is not None:
        before, now = _pulse(consent.rc, channel), _pulse(item, channel)
        if before <= RC_HIGH_US < now:
            wish = before >= RC_LOW_US // 2  # an edge out of a lost signal is no wish
        elif now < RC_LOW_US <= before:
            wish = False
    if wish is not None:
        consent = consent.wished(wish)
    return replace(consent, rc=item, switch_us=0 if channel is None else _pulse(item, channel))


def _pulse(report: RcReport, channel: int) -> int:
    return report.pulse_us[channel - 1] if 0 < channel <= len(report.pulse_us) else 0


# --------------------------------------------------------------- the sprayer's state, and its latch

#     BOOT -> SAFE -> READY -> ARMED <-> SPRAYING        any -> FAULT, ESTOP -> SAFE
#
# A state follows from the reasons not to spray, so several arrows may be one step. FAULT and ESTOP
# are latched: when their cause is gone they stay, and nothing opens, until the operator has
# disabled, or enabled anew, after it. A stop outranks a fault.

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
        Inhibit.LABEL_SPEED,
        Inhibit.LABEL_HEIGHT,
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


class SprayerMemory(NamedTuple):
    """The state (never SPRAYING, which is an ARMED one that is open), and of a latch the answer.

    `wishes` is how many the operator had had when the cause of a latch was last there: the answer
    is one more.
    """

    state: SprayerState = SprayerState.BOOT
    wishes: int = 0


BOOT = SprayerMemory()


def follow(
    before: SprayerMemory, reasons: frozenset[Inhibit], state: VehicleState | None
) -> tuple[SprayerMemory, frozenset[Inhibit]]:
    """Return the state after `reasons`, and these with the reason that a latch adds."""
    cause = _cause(reasons)
    if cause is not None:
        is_stop = SprayerState.ESTOP in (cause, before.state)
        latched = SprayerState.ESTOP if is_stop else SprayerState.FAULT
        wishes = before.wishes if state is None else state.operator_wishes
        return SprayerMemory(latched, wishes), reasons
    if before.state in LATCHED and not _is_answered(before, state):
        return before, reasons | {Inhibit.REARM_NEEDED}
    return SprayerMemory(_unlatched(before.state, reasons)), reasons


def _cause(reasons: frozenset[Inhibit]) -> SprayerState | None:
    if Inhibit.ESTOP in reasons:
        return SprayerState.ESTOP
    return SprayerState.FAULT if reasons & FAULTS else None


def _is_answered(latch: SprayerMemory, state: VehicleState | None) -> bool:
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


def shown(sprayer: SprayerMemory, *, is_open: bool) -> SprayerState:
    """Return the state to be told: SPRAYING where a valve is open or about to be."""
    return SprayerState.SPRAYING if is_open else sprayer.state


# ---------------------------------------------------------- permission, and what is done without it


class Permission(NamedTuple):
    """Every reason not to spray now, those that stay for a while, and the sprayer's state."""

    reasons: frozenset[Inhibit] = frozenset()
    held: Held = ()
    sprayer: SprayerMemory = BOOT


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
    sprayer, reasons = follow(before.sprayer, reasons, state)
    return Permission(reasons, held, sprayer)


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
