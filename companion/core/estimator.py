"""From messages to the vehicle's state at any moment: time-stamped, filtered, extrapolated.

`observe` takes one input in, `estimate` carries the result to a time. Position, velocity and
acceleration come from GLOBAL_POSITION_INT through `vehicle_motion.py`; the time of a
position is the autopilot's own clock on ours (`clock.py`), less the delay of the autopilot's
estimator (`lag.position_s`), so that jitter of the link is not taken for motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from companion.core.braking import Approach, Leg, approach, learned, leg_of, stop_ahead, way_of
from companion.core.clock import Clock, on_time_s, tick
from companion.core.motion import BRIDGED_MAX_S, Told
from companion.core.nozzle import is_override
from companion.core.positions import Order, Place, Stand, look, noted, sorted_in
from companion.core.setup import Setup
from companion.core.types import (
    BatteryReport,
    ClockReport,
    EstimatorReport,
    EstopReport,
    FlowReport,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    LegReport,
    OperatorCommand,
    OutputReport,
    PressureReport,
    RangeReport,
    RateOverride,
    RcReport,
    SpeedReport,
    StandstillReport,
    StopAhead,
    TankReport,
    Telemetry,
    UtcReport,
    VehicleState,
    Way,
    WindReport,
)
from companion.core.vehicle_motion import CONFIRM_COUNT, Motion, begun, followed

SPEED_REPORT_AGE_MAX_S = 1.0
# Fix, estimator and landed state come at 1 to 5 Hz; older than this they count as not known.
STATUS_AGE_MAX_S = 5.0
# Both are asked for at 5 to 10 Hz, of which a slowed-down link leaves a quarter.
RC_AGE_MAX_S = 2.0
RANGE_AGE_MAX_S = 1.0
# A companion that stood still for longer asks the operator again.
CONSENT_STANDSTILL_S = 2.0
# ArduPilot's and PX4's names of the mode that flies the mission.
MISSION_MODES = frozenset({"AUTO", "MISSION"})
RC_HIGH_US = 1700
RC_LOW_US = 1300
RC_SIGNAL_MAX_US = 2300
_NOTHING_HEARD = Order()


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """All that has been heard so far, as far as it matters."""

    motion: Motion | None = None
    stand: Stand | None = None
    clock: Clock | None = None
    clock_report: ClockReport | None = None
    clock_refused: bool = False  # the last exchange cannot be true beside the positions
    order: Order = _NOTHING_HEARD
    position_valid: bool = False
    position_received_s: float = -math.inf
    speed: SpeedReport | None = None
    gnss: GnssReport | None = None
    estimator: EstimatorReport | None = None
    heartbeat: HeartbeatReport | None = None
    landed: LandedReport | None = None
    wind: WindReport | None = None
    rc: RcReport | None = None
    switch_us: int = 0  # of the operator's channel in `rc`; 0 is no signal
    range: RangeReport | None = None
    output: OutputReport | None = None
    flow: FlowReport | None = None
    counted: FlowReport | None = None  # the autopilot's, until the next position dates it
    pressure: PressureReport | None = None
    tank: TankReport | None = None
    leg: Leg | None = None
    way: Way | None = None  # only where lines are to be followed
    way_before: Way | None = None
    braking_m_s2: float | None = None  # as seen at the ends of legs so far
    rate_percent: float = 100.0
    enabled: bool = False
    operator_wishes: int = 0  # how often somebody has enabled anew, or disabled
    estops: frozenset[str] | None = None  # which are pressed; None: none was heard of


def observe(track: Track, item: Input, setup: Setup) -> Track:
    """Return `track` with one more input; whatever is no number is kept out of the filter."""
    if isinstance(item, Telemetry):
        return _observe_position(track, item, setup)
    order = noted(track.order, item)
    if order is not track.order:
        track = replace(track, order=order)
    by_setup = _BY_SETUP.get(type(item))
    if by_setup is not None:
        return by_setup(track, item, setup)
    if isinstance(item, LegReport):
        leg = leg_of(item, setup.frame, setup.mission_braking_m_s2)
        way = None if setup.lines is None else way_of(item, setup.frame)
        before = track.way if _is_new_way(track.way, way) else track.way_before
        return replace(track, leg=leg, way=way, way_before=before)
    return _KEEP[type(item)](track, item)


def _is_new_way(before: Way | None, now: Way | None) -> bool:
    """Return whether another leg is flown than before."""
    if now is None or before is None:
        return True
    return replace(before, received_s=now.received_s, longer=now.longer) != now


# Reports of which only the last one counts.
_KEEP: dict[type, Callable[[Track, Any], Track]] = {
    SpeedReport: lambda track, item: replace(track, speed=item),
    GnssReport: lambda track, item: replace(track, gnss=item),
    EstimatorReport: lambda track, item: replace(track, estimator=item),
    LandedReport: lambda track, item: replace(track, landed=item),
    RangeReport: lambda track, item: replace(track, range=item),
    OutputReport: lambda track, item: replace(track, output=item),
    FlowReport: lambda track, item: replace(track, flow=item),
    PressureReport: lambda track, item: replace(track, pressure=item),
    TankReport: lambda track, item: replace(track, tank=item),
    ClockReport: lambda track, item: replace(track, clock_report=item),
    UtcReport: lambda track, _item: track,
    # What is out of bounds, or no number, leaves the rate as it was.
    RateOverride: lambda track, item: (
        replace(track, rate_percent=item.percent) if is_override(item.percent) else track
    ),
}


def _observe_battery(track: Track, item: BatteryReport, setup: Setup) -> Track:
    """Take a flow meter or a level that the autopilot reads as one of its batteries.

    A count has no time of its own: it waits for the next position, which tells how late it came.
    """
    wiring = setup.autopilot_liquid
    if wiring is None:
        return track
    flow, tank = wiring.flow(item), wiring.tank(item)
    return replace(track, counted=flow or track.counted, tank=tank or track.tank)


def _dated(track: Track, clock: Clock) -> FlowReport | None:
    """Return the flow meter's newest count, as old as it is by the positions around it."""
    counted = track.counted
    if counted is None:
        return track.flow
    return replace(counted, received_s=on_time_s(counted.received_s, track.clock, clock))


def _observe_heartbeat(track: Track, item: HeartbeatReport, setup: Setup) -> Track:
    """Disarming, and leaving the modes that may spray, take the operator's consent back."""
    before = track.heartbeat
    enabled = track.enabled
    if before is not None:
        if before.armed and not item.armed:
            enabled = False
        if setup.limits.allows(before.mode) and not setup.limits.allows(item.mode):
            enabled = False
        if not item.received_s - before.received_s <= setup.limits.consent_gap_max_s:
            enabled = False
    return replace(track, heartbeat=item, enabled=enabled)


def _observe_operator(track: Track, item: OperatorCommand, setup: Setup) -> Track:
    """Take the operator's wish; to disable also ends a stop that was commanded.

    Who may not enable changes nothing by trying; everyone may disable.
    """
    if item.enable and item.source not in setup.limits.enable_by:
        return track
    if not item.enable and track.estops:
        track = replace(track, estops=track.estops - {"command"})
    return _wished(track, item.enable)


def _observe_estop(track: Track, item: EstopReport, _setup: Setup) -> Track:
    """Take the consent back at a stop; while it is pressed nobody can give it."""
    pressed = track.estops or frozenset()
    if item.pressed is not False:
        return replace(track, estops=pressed | {item.source}, enabled=False)
    return replace(track, estops=pressed - {item.source})


def _observe_wind(track: Track, item: WindReport, setup: Setup) -> Track:
    """Take what is known of the wind; not to know it does not calm one that was too strong."""
    before_m_s = None if track.wind is None else track.wind.speed_m_s
    is_calm = before_m_s is None or 0.0 <= before_m_s <= setup.limits.wind_max_m_s
    return replace(track, wind=item) if item.speed_m_s is not None or is_calm else track


def _observe_standstill(track: Track, item: StandstillReport, _setup: Setup) -> Track:
    """Forget what was heard: what comes now may have waited as long as we stood still.

    What the sprayer itself says stays, and the consent over a short standstill.
    """
    enabled = track.enabled and item.gap_s <= CONSENT_STANDSTILL_S
    return Track(
        heartbeat=track.heartbeat if enabled else None,
        wind=track.wind,
        output=track.output,
        flow=track.flow,
        pressure=track.pressure,
        tank=track.tank,
        braking_m_s2=track.braking_m_s2,
        rate_percent=track.rate_percent,
        enabled=enabled,
        operator_wishes=track.operator_wishes,
        estops=track.estops,
    )


def _wished(track: Track, enabled: bool) -> Track:
    """Return the track after a wish; to repeat that one may spray is no new wish."""
    is_new = not (enabled and track.enabled)
    return replace(
        track,
        enabled=enabled and not track.estops,
        operator_wishes=track.operator_wishes + is_new,
    )


def _observe_rc(track: Track, item: RcReport, setup: Setup) -> Track:
    """Only the edges of the switch count: up enables, down disables, a lost signal disables."""
    channel, wish = setup.limits.rc_channel, None
    if channel is not None and "rc" in setup.limits.enable_by and track.rc is not None:
        before, now = _pulse(track.rc, channel), _pulse(item, channel)
        if before <= RC_HIGH_US < now:
            wish = before >= RC_LOW_US // 2  # an edge out of a lost signal is no wish
        elif now < RC_LOW_US <= before:
            wish = False
    if wish is not None:
        track = _wished(track, wish)
    switch_us = 0 if channel is None else _pulse(item, channel)
    return replace(track, rc=item, switch_us=switch_us)


def _pulse(report: RcReport, channel: int) -> int:
    return report.pulse_us[channel - 1] if 0 < channel <= len(report.pulse_us) else 0


_BY_SETUP: dict[type, Callable[[Track, Any, Setup], Track]] = {
    HeartbeatReport: _observe_heartbeat,
    OperatorCommand: _observe_operator,
    EstopReport: _observe_estop,
    StandstillReport: _observe_standstill,
    RcReport: _observe_rc,
    WindReport: _observe_wind,
    BatteryReport: _observe_battery,
}


def _observe_position(track: Track, item: Telemetry, setup: Setup) -> Track:
    order, kind = sorted_in(track.order, item)
    if kind is Place.AGAIN:
        return replace(track, order=order)  # a copy, or not yet known to be anything else
    track = replace(track, order=order)
    if kind is Place.ANEW:
        track = _restarted(track)
    place = _place(item, setup)
    if place is None:
        return replace(track, position_valid=False, position_received_s=item.received_s)
    before = track.motion
    stand = _stand(track, item)
    if before is not None and stand.is_frozen:
        # It is kept out of the filters, and what comes after it has to be confirmed.
        still = replace(before, boot_s=item.boot_s, confirm_left=CONFIRM_COUNT)
        return replace(track, motion=still, stand=stand)
    at_once = not track.enabled or before is None
    ticked = tick(track.clock, item, track.clock_report, at_once=at_once)
    clock = ticked.clock
    # Its age counts from its sending, for the limit on it too.
    sent_s = item.boot_s + clock.sent_offset_s
    item = replace(item, received_s=min(item.received_s, sent_s))
    if ticked.is_set:
        before = None
    if before is not None and ticked.moved_s != 0.0:
        before = replace(before, time_s=before.time_s + ticked.moved_s)
    time_s = item.boot_s + clock.sent_offset_s - setup.lag.position_s
    motion = begun(item, place, time_s) if before is None else followed(before, item, place, time_s)
    return replace(
        track,
        motion=motion,
        clock=clock,
        clock_refused=ticked.is_refused,
        flow=_dated(track, clock),
        counted=None,
        stand=stand,
        position_valid=motion.confirm_left == 0,
        position_received_s=item.received_s,
        braking_m_s2=_learned_braking(track, motion, item.received_s),
    )


def _restarted(track: Track) -> Track:
    """Forget what was known by the autopilot's old clock, but an exchange with the new one."""
    exchange = track.order.exchange
    return replace(
        track, motion=None, clock=None, clock_report=exchange, clock_refused=False, stand=None
    )


def _stand(track: Track, item: Telemetry) -> Stand:
    """Return what shows a place that stands still while the vehicle does not."""
    motion, expected_m_s = track.motion, None
    if motion is not None and 0.0 < item.boot_s - motion.boot_s < BRIDGED_MAX_S:
        east, north = motion.after(item.boot_s - motion.boot_s)
        expected_m_s = math.hypot(east.velocity_m_s, north.velocity_m_s)
    checked_m_s = _checked_speed(track, item.received_s)
    return look(track.stand, item, expected_m_s=expected_m_s, reported_m_s=checked_m_s)


def _place(item: Telemetry, setup: Setup) -> tuple[float, float] | None:
    """Return (east_m, north_m); None for what is no position: NaN, out of range, or 0, 0."""
    latitude, longitude = item.latitude_deg, item.longitude_deg
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        return None
    if abs(latitude) < 1e-6 and abs(longitude) < 1e-6:
        return None
    if not (abs(item.received_s) < math.inf and abs(item.boot_s) < math.inf):
        return None
    east_m, north_m = setup.frame.to_local(latitude, longitude)
    if not (abs(east_m) < 1e8 and abs(north_m) < 1e8 and abs(item.relative_altitude_m) < 1e6):
        return None
    return east_m, north_m


def estimate(track: Track, now_s: float) -> VehicleState | None:
    """Return the vehicle's state at `now_s`; None before the first position."""
    motion = track.motion
    if motion is None:
        return None
    dt_s = now_s - motion.time_s
    east, north = motion.after(dt_s)
    velocity_east, velocity_north = east.velocity_m_s, north.velocity_m_s
    checked = _checked_speed(track, now_s)
    known = motion.velocity_known
    if not known and checked is not None:
        velocity_east, velocity_north, known = _reported_velocity(east, north, checked)
    heading = motion.heading_deg
    if heading is not None:
        heading = (heading + motion.yaw_rate_deg_s * dt_s) % 360.0
    heartbeat = track.heartbeat
    gnss = track.gnss if track.gnss is not None and _young(track.gnss, now_s) else None
    return VehicleState(
        time_s=now_s,
        east_m=east.position_m,
        north_m=north.position_m,
        velocity_east_m_s=velocity_east,
        velocity_north_m_s=velocity_north,
        acceleration_east_m_s2=east.acceleration_m_s2,
        acceleration_north_m_s2=north.acceleration_m_s2,
        acceleration_fade_s=motion.acceleration_fade_s,
        outrun_east_m_s=east.outrun_m_s,
        outrun_north_m_s=north.outrun_m_s,
        heading_deg=heading,
        yaw_rate_deg_s=motion.yaw_rate_deg_s,
        height_m=_height(track, motion, now_s),
        velocity_known=known,
        position_received_s=motion.received_s,
        position_valid=track.position_valid,
        position_frozen=track.stand is not None and track.stand.is_frozen,
        clock_agrees=_clock_agrees(track, now_s),
        checked_speed_m_s=checked,
        fix=None if gnss is None else gnss.fix,
        horizontal_accuracy_m=None if gnss is None else gnss.horizontal_accuracy_m,
        estimator_healthy=(
            track.estimator.healthy if track.estimator and _young(track.estimator, now_s) else None
        ),
        heartbeat_received_s=None if heartbeat is None else heartbeat.received_s,
        armed=heartbeat is not None and heartbeat.armed,
        active=heartbeat is not None and heartbeat.active,
        mode=None if heartbeat is None else heartbeat.mode,
        in_air=track.landed.in_air if track.landed and _young(track.landed, now_s) else None,
        wind_m_s=track.wind.speed_m_s if track.wind else None,
        wind_received_s=track.wind.received_s if track.wind else None,
        rc_switch_on=_switch_on(track, now_s),
        output_healthy=track.output is None or track.output.healthy,
        link_up=track.output is None or track.output.link_up,
        enabled=track.enabled,
        operator_wishes=track.operator_wishes,
        estop=None if track.estops is None else bool(track.estops),
        flow=track.flow,
        pressure=track.pressure,
        tank=track.tank,
        wind=track.wind if track.wind and track.wind.east_m_s is not None else None,
        rate_percent=track.rate_percent,
        stop_ahead=_stop_ahead(track, east, north, now_s),
        way=track.way,
        way_before=track.way_before,
    )


def _clock_agrees(track: Track, now_s: float) -> bool:
    """Return whether all that is known of the autopilot's clock goes together."""
    clock = track.clock
    return clock is not None and not track.clock_refused and not clock.is_doubtful(now_s)


def _learned_braking(track: Track, motion: Motion, now_s: float) -> float | None:
    """Return how hard the vehicle brakes at the ends of its legs, after one more position."""
    leg = track.leg
    if leg is None:
        return track.braking_m_s2
    usual_m_s2 = leg.braking_m_s2 if track.braking_m_s2 is None else track.braking_m_s2
    seen = _approach(track, leg, *motion.after(0.0), now_s)
    return learned(leg.braking_m_s2, usual_m_s2, seen)


def _stop_ahead(track: Track, east: Told, north: Told, now_s: float) -> StopAhead | None:
    """Return the stop at the end of the mission's leg, if one is about to be made."""
    leg = track.leg
    seen = None if leg is None else _approach(track, leg, east, north, now_s)
    if leg is None or seen is None:
        return None
    return stop_ahead(leg.braking_m_s2 if track.braking_m_s2 is None else track.braking_m_s2, seen)


def _approach(track: Track, leg: Leg, east: Told, north: Told, now_s: float) -> Approach | None:
    """Return how the vehicle comes to the end of its leg, while the mission is being flown."""
    if track.heartbeat is None or track.heartbeat.mode not in MISSION_MODES:
        return None
    return approach(
        leg,
        place=(east.position_m, north.position_m),
        velocity=(east.velocity_m_s, north.velocity_m_s),
        acceleration=(east.acceleration_m_s2, north.acceleration_m_s2),
        now_s=now_s,
    )


def _young(
    report: GnssReport | EstimatorReport | LandedReport | RcReport | RangeReport | SpeedReport,
    now_s: float,
    limit_s: float = STATUS_AGE_MAX_S,
) -> bool:
    """Whether a report may be believed: no older than the limit, and not of the future."""
    return -0.1 <= now_s - report.received_s <= limit_s


def _switch_on(track: Track, now_s: float) -> bool | None:
    """Whether the operator's switch is not off; None where nothing young is known of it."""
    if track.rc is None or not _young(track.rc, now_s, RC_AGE_MAX_S):
        return None
    return RC_LOW_US <= track.switch_us <= RC_SIGNAL_MAX_US


def _height(track: Track, motion: Motion, now_s: float) -> float:
    """Return the height above the crop where a sensor sees it, else above home."""
    seen = track.range
    if seen is None or seen.height_m is None or not _young(seen, now_s, RANGE_AGE_MAX_S):
        return motion.height_m
    return seen.height_m


def _checked_speed(track: Track, now_s: float) -> float | None:
    """Return the second opinion on the ground speed, if it is young enough.

    One that is told and is no number agrees with nothing: NaN, which closes.
    """
    if track.speed is None or not _young(track.speed, now_s, SPEED_REPORT_AGE_MAX_S):
        return None
    told_m_s = track.speed.ground_speed_m_s
    return math.nan if told_m_s is None else told_m_s


def _reported_velocity(east: Told, north: Told, speed_m_s: float) -> tuple[float, float, bool]:
    """Return the reported ground speed along the course that the positions show."""
    seen_m_s = math.hypot(east.velocity_m_s, north.velocity_m_s)
    if not seen_m_s > 0.5:
        return east.velocity_m_s, north.velocity_m_s, False
    share = speed_m_s / seen_m_s
    return east.velocity_m_s * share, north.velocity_m_s * share, True
