"""From messages to the vehicle's state at any moment: time-stamped, filtered, extrapolated.

`observe` takes one input in, `estimate` carries the result to a time. Position, velocity and
acceleration come from GLOBAL_POSITION_INT through the filters of `motion.py`; the time of a
position is the autopilot's own clock on ours (`clock.py`), less the delay of the autopilot's
estimator (`lag.position_s`), so that jitter of the link is not taken for motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from companion.core.braking import (
    Approach,
    StoppingLeg,
    approach,
    learned,
    leg_of,
    mission_leg_of,
    stop_ahead,
)
from companion.core.clock import Clock, on_time_s, tick
from companion.core.inputs import MISSION_MODES
from companion.core.motion import (
    BELIEVING,
    BRIDGED_MAX_S,
    CRUISE,
    DOUBTING,
    MANOEUVRE,
    NOT_DRAWN,
    NOT_RAMPED,
    SHARE_MIN,
    STEADY,
    Axis,
    Belief,
    Drawn,
    Pair,
    Ramp,
    Seen,
    Told,
    Turning,
    agreed,
    doubted,
    drawn_after,
    follow_pair,
    later,
    seen_of,
    stretch,
    together,
    turning,
)
from companion.core.nozzle import is_override
from companion.core.options.inertial import NO_INERTIA, Inertia, blended
from companion.core.positions import (
    Arrival,
    LastPlace,
    PositionStream,
    look,
    noted,
    place_of,
    sorted_in,
)
from companion.core.safety import NO_CONSENT, Consent, consented
from companion.core.setup import Setup
from companion.core.types import (
    AttitudeReport,
    BatteryReport,
    ClockReport,
    DeclarationReport,
    EstimatorReport,
    EstopReport,
    FlowReport,
    GnssReport,
    HeartbeatReport,
    ImuReport,
    Input,
    LandedReport,
    LegReport,
    MissionLeg,
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
    WindReport,
)

# The vehicle's motion as its positions tell it: the filters of `motion.py`, course and height.

# After a jump the filters start anew, and nothing is sprayed until so many positions confirm it.
CONFIRM_COUNT = 5


class Motion(NamedTuple):
    """What the filters make of the positions, true at `time_s` on our clock.

    `agreed` is what all of them say together; `seen` is the last message, to the east and to the
    north, and `drawn` how the place is drawn beside the velocities of these.
    """

    time_s: float
    boot_s: float
    received_s: float
    believing: Pair
    doubting: Pair
    doubt_share: float
    agreed: Pair
    seen: tuple[Seen, Seen]
    drawn: tuple[Drawn, Drawn]
    heading_deg: float | None
    yaw: Turning
    height_m: float
    velocity_known: bool
    confirm_left: int
    ramp: tuple[Ramp, Ramp] = (NOT_RAMPED, NOT_RAMPED)
    likely: float | None = None  # how the filters found the last message; None: they begin with it

    def after(self, dt_s: float) -> tuple[Told, Told]:
        """Return the motion to the east and to the north `dt_s` later: the place as it is told.

        The velocity is the told one too, not that of the place, but for what has begun to draw the
        place just now, as far as the velocity is doubted at all (`motion.py`).
        """
        cruise, manoeuvre, share = self.agreed.cruise, self.agreed.manoeuvre, self.agreed.share
        calm, nimble = stretch(CRUISE.fade_s, dt_s), stretch(MANOEUVRE.fade_s, dt_s)
        doubt, (by_east, by_north) = self.doubt_share, self.drawn
        return (
            later(cruise.east, manoeuvre.east, calm, nimble, share, doubt * by_east.after(dt_s)),
            later(cruise.north, manoeuvre.north, calm, nimble, share, doubt * by_north.after(dt_s)),
        )

    @property
    def acceleration_fade_s(self) -> float:
        """Return the time constant with which the acceleration is expected to fade."""
        return CRUISE.fade_s + self.agreed.share * (MANOEUVRE.fade_s - CRUISE.fade_s)


def begun(item: Telemetry, place: tuple[float, float], time_s: float) -> Motion:
    """Return what a first position says."""
    east, north = seen_of(item, place)
    belief = Belief(
        Axis(place[0], east.velocity_m_s or 0.0, 0.0),
        Axis(place[1], north.velocity_m_s or 0.0, 0.0),
    )
    pair = Pair(belief, belief, 0.5)
    return Motion(
        time_s=time_s,
        boot_s=item.boot_s,
        received_s=item.received_s,
        believing=pair,
        doubting=pair,
        doubt_share=SHARE_MIN,
        agreed=pair,
        seen=(east, north),
        drawn=(NOT_DRAWN, NOT_DRAWN),
        heading_deg=item.heading_deg,
        yaw=STEADY,
        height_m=item.relative_altitude_m,
        velocity_known=east.velocity_m_s is not None,
        confirm_left=CONFIRM_COUNT,
    )


def followed(before: Motion, item: Telemetry, place: tuple[float, float], time_s: float) -> Motion:
    """Return the motion after one more position; it begins anew after a gap and after a jump."""
    dt_s = time_s - before.time_s
    if not 0.0 < dt_s < BRIDGED_MAX_S:
        return begun(item, place, time_s)
    east, north = seen_of(item, place)
    believing = follow_pair(BELIEVING, before.believing, dt_s, east, north)
    if believing is None:
        return begun(item, place, time_s)
    doubting = follow_pair(DOUBTING, before.doubting, dt_s, east, north)
    doubted_one = None if doubting is None else doubting[1]
    known = east.velocity_m_s is not None
    share = before.doubt_share
    if doubting is None:
        # No jump to those that believe: the doubters were led astray, and begin anew.
        doubting, share = believing, SHARE_MIN
    elif known:
        share = doubted(share, dt_s, believing[1], doubting[1])
    both = agreed(believing[0], doubting[0], share)
    calm, nimble = both.cruise, both.manoeuvre
    return Motion(
        time_s=time_s,
        boot_s=item.boot_s,
        received_s=item.received_s,
        believing=believing[0],
        doubting=doubting[0],
        doubt_share=share,
        agreed=both,
        seen=(east, north),
        drawn=(
            drawn_after(before.drawn[0], dt_s, before.seen[0], east),
            drawn_after(before.drawn[1], dt_s, before.seen[1], north),
        ),
        heading_deg=item.heading_deg,
        ramp=(
            before.ramp[0].followed(dt_s, calm.east, nimble.east, both.share),
            before.ramp[1].followed(dt_s, calm.north, nimble.north, both.share),
        ),
        yaw=turning(before.yaw, before.heading_deg, item.heading_deg, dt_s),
        height_m=item.relative_altitude_m,
        velocity_known=known,
        confirm_left=max(before.confirm_left - 1, 0),
        likely=believing[1] if doubted_one is None else together(share, believing[1], doubted_one),
    )


SPEED_REPORT_AGE_MAX_S = 1.0
# Fix, estimator and landed state come at 1 to 5 Hz; older than this they count as not known.
STATUS_AGE_MAX_S = 5.0
# Asked for at 5 to 10 Hz, of which a slowed-down link leaves a quarter.
RANGE_AGE_MAX_S = 1.0
_NOTHING_HEARD = PositionStream()


class Track(NamedTuple):
    """All that has been heard so far, as far as it matters."""

    motion: Motion | None = None
    last_place: LastPlace | None = None
    clock: Clock | None = None
    clock_report: ClockReport | None = None
    clock_refused: bool = False  # the last exchange cannot be true beside the positions
    order: PositionStream = _NOTHING_HEARD
    position_valid: bool = False
    position_received_s: float = -math.inf
    inertia: Inertia = NO_INERTIA
    speed: SpeedReport | None = None
    gnss: GnssReport | None = None
    estimator: EstimatorReport | None = None
    heartbeat: HeartbeatReport | None = None
    landed: LandedReport | None = None
    wind: WindReport | None = None
    range: RangeReport | None = None
    output: OutputReport | None = None
    flow: FlowReport | None = None
    counted: FlowReport | None = None  # the autopilot's, until the next position dates it
    pressure: PressureReport | None = None
    tank: TankReport | None = None
    leg: StoppingLeg | None = None
    mission_leg: MissionLeg | None = None  # only where lines are to be followed
    mission_leg_before: MissionLeg | None = None
    braking_m_s2: float | None = None  # as seen at the ends of legs so far
    rate_percent: float = 100.0
    consent: Consent = NO_CONSENT
    utc: UtcReport | None = None  # only where a label has hours


def observe(track: Track, item: Input, setup: Setup) -> Track:
    """Return `track` with one more input; whatever is not a number is kept out of the filter."""
    if isinstance(item, Telemetry):
        return _observe_position(track, item, setup)
    order = noted(track.order, item)
    if order is not track.order:
        track = track._replace(order=order)
    by_setup = _BY_SETUP.get(type(item))
    if by_setup is not None:
        return by_setup(track, item, setup)
    if isinstance(item, LegReport):
        leg = leg_of(item, setup.frame, setup.mission_braking_m_s2)
        told = None if setup.lines is None else mission_leg_of(item, setup.frame)
        is_new = _is_new_leg(track.mission_leg, told)
        before = track.mission_leg if is_new else track.mission_leg_before
        return track._replace(leg=leg, mission_leg=told, mission_leg_before=before)
    return _KEEP[type(item)](track, item)


def _is_new_leg(before: MissionLeg | None, now: MissionLeg | None) -> bool:
    """Return whether another leg is flown than before."""
    if now is None or before is None:
        return True
    return replace(before, received_s=now.received_s, longer=now.longer) != now


# Reports of which only the last one counts.
_KEEP: dict[type, Callable[[Track, Any], Track]] = {
    AttitudeReport: lambda track, item: track._replace(
        inertia=track.inertia._replace(attitude=item)
    ),
    SpeedReport: lambda track, item: track._replace(speed=item),
    GnssReport: lambda track, item: track._replace(gnss=item),
    EstimatorReport: lambda track, item: track._replace(estimator=item),
    LandedReport: lambda track, item: track._replace(landed=item),
    RangeReport: lambda track, item: track._replace(range=item),
    OutputReport: lambda track, item: track._replace(output=item),
    FlowReport: lambda track, item: track._replace(flow=item),
    PressureReport: lambda track, item: track._replace(pressure=item),
    TankReport: lambda track, item: track._replace(tank=item),
    ClockReport: lambda track, item: track._replace(clock_report=item),
    # What is out of bounds, or no number, leaves the rate as it was.
    RateOverride: lambda track, item: (
        track._replace(rate_percent=item.percent) if is_override(item.percent) else track
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
    return track._replace(counted=flow or track.counted, tank=tank or track.tank)


def _dated(track: Track, clock: Clock) -> FlowReport | None:
    """Return the flow meter's newest count, as old as it is by the positions around it."""
    counted = track.counted
    if counted is None:
        return track.flow
    return replace(counted, received_s=on_time_s(counted.received_s, track.clock, clock))


def _observe_consent(track: Track, item: Any, setup: Setup) -> Track:
    """Take what gives or takes back the operator's consent; of a heartbeat, the rest too."""
    consent = consented(track.consent, item, setup.limits, heartbeat=track.heartbeat)
    if isinstance(item, HeartbeatReport):
        return track._replace(heartbeat=item, consent=consent)
    return track._replace(consent=consent)


def _observe_wind(track: Track, item: WindReport, setup: Setup) -> Track:
    """Take what is known of the wind; not to know it does not calm one that was too strong."""
    before_m_s = None if track.wind is None else track.wind.speed_m_s
    is_calm = before_m_s is None or 0.0 <= before_m_s <= setup.limits.calm_max_m_s
    return track._replace(wind=item) if item.speed_m_s is not None or is_calm else track


def _observe_standstill(track: Track, item: StandstillReport, _setup: Setup) -> Track:
    """Forget what was heard: what comes now may have waited as long as we stood still.

    What the sprayer itself says stays, and the consent over a short standstill.
    """
    consent = track.consent.after_standstill(item.gap_s)
    return Track(
        heartbeat=track.heartbeat if consent.enabled else None,
        wind=track.wind,
        output=track.output,
        flow=track.flow,
        pressure=track.pressure,
        tank=track.tank,
        braking_m_s2=track.braking_m_s2,
        rate_percent=track.rate_percent,
        consent=consent,
    )


_BY_SETUP: dict[type, Callable[[Track, Any, Setup], Track]] = {
    ImuReport: lambda track, item, setup: track._replace(
        inertia=track.inertia.with_imu(item, setup.lag.position_s)
    ),
    HeartbeatReport: _observe_consent,
    OperatorCommand: _observe_consent,
    EstopReport: _observe_consent,
    RcReport: _observe_consent,
    StandstillReport: _observe_standstill,
    WindReport: _observe_wind,
    UtcReport: lambda track, item, setup: track._replace(utc=setup.limits.asked_utc(item)),
    DeclarationReport: _observe_consent,
    BatteryReport: _observe_battery,
}


def _observe_position(track: Track, item: Telemetry, setup: Setup) -> Track:
    order, kind = sorted_in(track.order, item)
    if kind is Arrival.AGAIN:
        return track._replace(order=order)  # a copy, or not yet known to be anything else
    if kind is Arrival.ANEW:
        track = _restarted(track, order)
    place = place_of(item, setup.frame)
    if place is None:
        track = track._replace(order=order)
        return track._replace(position_valid=False, position_received_s=item.received_s)
    before = track.motion
    stand = _stand(track, item)
    if before is not None and stand.is_frozen:
        # It is kept out of the filters, and what comes after it has to be confirmed.
        still = before._replace(boot_s=item.boot_s, confirm_left=CONFIRM_COUNT)
        track = track._replace(order=order)
        return track._replace(motion=still, last_place=stand)
    at_once = not track.consent.enabled or before is None
    ticked = tick(track.clock, item, track.clock_report, at_once=at_once)
    clock = ticked.clock
    if ticked.is_set:
        before = None
    if before is not None and ticked.moved_s != 0.0:
        before = before._replace(time_s=before.time_s + ticked.moved_s)
    time_s = item.boot_s + clock.sent_offset_s - setup.lag.position_s
    motion = begun(item, place, time_s) if before is None else followed(before, item, place, time_s)
    # Its age counts from its sending, for the limit on it too.
    sent_s = item.boot_s + clock.sent_offset_s
    motion = motion._replace(received_s=min(item.received_s, sent_s))
    return track._replace(
        order=order,
        motion=motion,
        inertia=track.inertia.after_position(
            motion.boot_s, motion.seen, motion.agreed.cruise, motion.likely
        ),
        clock=clock,
        clock_refused=ticked.is_refused,
        flow=_dated(track, clock),
        counted=None,
        last_place=stand,
        position_valid=motion.confirm_left == 0,
        position_received_s=motion.received_s,
        braking_m_s2=_learned_braking(track, motion, motion.received_s),
    )


def _restarted(track: Track, order: PositionStream) -> Track:
    """Forget what was known by the autopilot's old clock, but an exchange with the new one."""
    exchange = order.exchange
    return track._replace(
        motion=None,
        clock=None,
        clock_report=exchange,
        clock_refused=False,
        last_place=None,
        inertia=NO_INERTIA,
    )


def _stand(track: Track, item: Telemetry) -> LastPlace:
    """Return what shows a place that stands still while the vehicle does not."""
    motion, expected_m_s = track.motion, None
    # How fast it should be takes a while to find out, and only one that stands is asked.
    stands = item.velocity_east_m_s == 0.0 and item.velocity_north_m_s == 0.0
    if stands and motion is not None and 0.0 < item.boot_s - motion.boot_s < BRIDGED_MAX_S:
        east, north = motion.after(item.boot_s - motion.boot_s)
        expected_m_s = math.hypot(east.velocity_m_s, north.velocity_m_s)
    checked_m_s = _checked_speed(track, item.received_s)
    return look(track.last_place, item, expected_m_s=expected_m_s, reported_m_s=checked_m_s)


def estimate(track: Track, now_s: float) -> VehicleState | None:
    """Return the vehicle's state at `now_s`; None before the first position."""
    if (motion := track.motion) is None:
        return None
    dt_s = now_s - motion.time_s
    nose_deg, (turned_deg, yaw) = motion.heading_deg, motion.yaw.ending.after(dt_s)
    east, north = _after(track, motion, dt_s)
    velocity_east, velocity_north = east.velocity_m_s, north.velocity_m_s
    checked, known = _checked_speed(track, now_s), motion.velocity_known
    if not known and checked is not None:
        velocity_east, velocity_north, known = _reported_velocity(east, north, checked)
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
        heading_deg=None if nose_deg is None else (nose_deg + turned_deg) % 360.0,
        yaw_rate_deg_s=yaw.rate_deg_s,
        yaw_gain_deg_s2=yaw.gain_deg_s2,
        height_m=_height(track, motion, now_s),
        velocity_known=known,
        position_received_s=motion.received_s,
        position_valid=track.position_valid,
        position_frozen=track.last_place is not None and track.last_place.is_frozen,
        clock_agrees=_clock_agrees(track, now_s),
        checked_speed_m_s=checked,
        fix=None if gnss is None else gnss.fix,
        horizontal_accuracy_m=None if gnss is None else gnss.horizontal_accuracy_m,
        estimator_healthy=_is_healthy(track, now_s),
        heartbeat_received_s=None if heartbeat is None else heartbeat.received_s,
        armed=heartbeat is not None and heartbeat.armed,
        active=heartbeat is not None and heartbeat.active,
        mode=None if heartbeat is None else heartbeat.mode,
        in_air=track.landed.in_air if track.landed and _young(track.landed, now_s) else None,
        wind_m_s=track.wind.speed_m_s if track.wind else None,
        wind_received_s=track.wind.received_s if track.wind else None,
        rc_switch_on=track.consent.switch_on(now_s),
        output_healthy=track.output is None or track.output.healthy,
        link_up=track.output is None or track.output.link_up,
        output_guarded=track.output is None or track.output.guarded,
        enabled=track.consent.enabled,
        operator_wishes=track.consent.wishes,
        estop=track.consent.is_stopped,
        flow=track.flow,
        pressure=track.pressure,
        tank=track.tank,
        wind=track.wind if track.wind and track.wind.east_m_s is not None else None,
        rate_percent=track.rate_percent,
        stop_ahead=_stop_ahead(track, east, north, now_s),
        mission_leg=track.mission_leg,
        mission_leg_before=track.mission_leg_before,
        utc_offset_s=None if track.utc is None else track.utc.offset_s(now_s),
        declared=track.consent.declared,
    )


def _after(track: Track, motion: Motion, dt_s: float) -> tuple[Told, Told]:
    """Return the motion `dt_s` after the last position, by all that is known of it."""
    east, north = motion.after(dt_s)
    if track.heartbeat is not None and track.heartbeat.mode in MISSION_MODES:
        doubt, (by_east, by_north) = motion.doubt_share, motion.ramp
        east, north = by_east.after(east, dt_s, doubt), by_north.after(north, dt_s, doubt)
    inertia = track.inertia
    by_inertia = inertia.after(dt_s, motion.acceleration_fade_s)
    if by_inertia is None:
        return east, north
    share = inertia.share
    return blended(east, by_inertia[0], share), blended(north, by_inertia[1], share)


def _is_healthy(track: Track, now_s: float) -> bool | None:
    """Return whether the autopilot trusts its own position; None where it has not said lately."""
    report = track.estimator
    return report.healthy if report is not None and _young(report, now_s) else None


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


def _approach(
    track: Track, leg: StoppingLeg, east: Told, north: Told, now_s: float
) -> Approach | None:
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
    report: GnssReport | EstimatorReport | LandedReport | RangeReport | SpeedReport,
    now_s: float,
    limit_s: float = STATUS_AGE_MAX_S,
) -> bool:
    """Whether a report may be believed: no older than the limit, and not of the future."""
    return -0.1 <= now_s - report.received_s <= limit_s


def _height(track: Track, motion: Motion, now_s: float) -> float:
    """Return the height above the crop where a sensor sees it, else above home."""
    seen = track.range
    if seen is None or seen.height_m is None or not _young(seen, now_s, RANGE_AGE_MAX_S):
        return motion.height_m
    return seen.height_m


def _checked_speed(track: Track, now_s: float) -> float | None:
    """Return the second opinion on the ground speed, if it is young enough.

    One that is told and is not a number agrees with nothing: NaN, which closes.
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
