"""From messages to the vehicle's state at any moment: time-stamped, filtered, extrapolated.

`observe` takes one input in, `estimate` carries the result to a time. Position, velocity and
acceleration come from GLOBAL_POSITION_INT through a steady-state Kalman filter an axis; the time
of a position is the autopilot's own clock plus the mean offset of the arrivals, less the delay of
the autopilot's estimator (`lag.position_s`), so that jitter of the link is not taken for motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from companion.core.types import (
    EstimatorReport,
    FlowReport,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    OutputReport,
    RcReport,
    SpeedReport,
    Telemetry,
    VehicleState,
    WindReport,
)

if TYPE_CHECKING:
    from companion.core.controller import Setup

# Acceleration fades with this time constant in every prediction: gusts pass and brakes are
# released, and a constant acceleration carried over a second would overshoot.
ACCELERATION_TIME_S = 0.7
# Noise that the filter assumes: RTK position, fused velocity, and the wander of the acceleration
# of a multirotor in gusts of 1 m/s (accuracy.md section 4 for the first two).
POSITION_SD_M = 0.02
VELOCITY_SD_M_S = 0.03
ACCELERATION_WANDER_M_S2_SQRT_S = 0.7
YAW_RATE_TIME_S = 0.25
# A position that disagrees with its prediction by more than this is a jump, not motion: the
# filter starts anew and nothing is sprayed until the new place has been confirmed.
JUMP_M = 2.0
CONFIRM_COUNT = 5
# Arrivals later than this against the mean are late messages; the mean is not moved by more.
CLOCK_STEP_S = 0.02
CLOCK_RESET_S = 1.0
SPEED_REPORT_AGE_MAX_S = 1.0
# Fix, estimator and landed state come at 1 to 5 Hz; older than this they count as not known.
STATUS_AGE_MAX_S = 5.0
RC_HIGH_US = 1700
RC_LOW_US = 1300


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Mean of arrival time minus the autopilot's time, over the last messages."""

    offset_s: float
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """The filter's state, true at `time_s` on our clock."""

    time_s: float
    boot_s: float
    received_s: float
    east_m: float
    north_m: float
    velocity_east_m_s: float
    velocity_north_m_s: float
    acceleration_east_m_s2: float
    acceleration_north_m_s2: float
    heading_deg: float | None
    yaw_rate_deg_s: float
    height_m: float
    velocity_known: bool
    confirm_left: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """All that has been heard so far, as far as it matters."""

    motion: Motion | None = None
    clock: Clock | None = None
    position_valid: bool = False
    position_received_s: float = -math.inf
    speed: SpeedReport | None = None
    gnss: GnssReport | None = None
    estimator: EstimatorReport | None = None
    heartbeat: HeartbeatReport | None = None
    landed: LandedReport | None = None
    wind: WindReport | None = None
    rc: RcReport | None = None
    output: OutputReport | None = None
    flow: FlowReport | None = None
    enabled: bool = False


def observe(track: Track, item: Input, setup: Setup) -> Track:
    """Return `track` with one more input; whatever is no number is kept out of the filter."""
    if isinstance(item, Telemetry):
        return _observe_position(track, item, setup)
    if isinstance(item, HeartbeatReport):
        return _observe_heartbeat(track, item, setup)
    if isinstance(item, RcReport):
        return _observe_rc(track, item, setup)
    if isinstance(item, OperatorCommand):
        return replace(track, enabled=item.enable and item.source in setup.limits.enable_by)
    return _KEEP[type(item)](track, item)


# Reports of which only the last one counts.
_KEEP: dict[type, Callable[[Track, Any], Track]] = {
    SpeedReport: lambda track, item: replace(track, speed=item),
    GnssReport: lambda track, item: replace(track, gnss=item),
    EstimatorReport: lambda track, item: replace(track, estimator=item),
    LandedReport: lambda track, item: replace(track, landed=item),
    WindReport: lambda track, item: replace(track, wind=item),
    OutputReport: lambda track, item: replace(track, output=item),
    FlowReport: lambda track, item: replace(track, flow=item),
}


def _observe_heartbeat(track: Track, item: HeartbeatReport, setup: Setup) -> Track:
    """Disarming, and leaving the modes that may spray, take the operator's consent back."""
    before = track.heartbeat
    enabled = track.enabled
    if before is not None:
        if before.armed and not item.armed:
            enabled = False
        if before.mode in setup.limits.modes and item.mode not in setup.limits.modes:
            enabled = False
    return replace(track, heartbeat=item, enabled=enabled)


def _observe_rc(track: Track, item: RcReport, setup: Setup) -> Track:
    """Only the edges of the switch count: up enables, down disables, a lost signal disables."""
    channel, enabled = setup.limits.rc_channel, track.enabled
    if channel is not None and "rc" in setup.limits.enable_by and track.rc is not None:
        before, now = _pulse(track.rc, channel), _pulse(item, channel)
        if before <= RC_HIGH_US < now:
            enabled = before >= RC_LOW_US // 2  # an edge out of a lost signal is no wish
        elif now < RC_LOW_US <= before:
            enabled = False
    return replace(track, rc=item, enabled=enabled)


def _pulse(report: RcReport, channel: int) -> int:
    return report.pulse_us[channel - 1] if 0 < channel <= len(report.pulse_us) else 0


def _observe_position(track: Track, item: Telemetry, setup: Setup) -> Track:
    place = _place(item, setup)
    if place is None:
        return replace(track, position_valid=False, position_received_s=item.received_s)
    before = track.motion
    if before is not None and item.boot_s <= before.boot_s:
        if item.boot_s == before.boot_s:
            return track  # repeated: nothing new
        if item.boot_s > before.boot_s - 0.5:
            return replace(track, position_valid=False)  # time went back: until the next is newer
        before = None  # the autopilot's clock went back: it was restarted
        track = replace(track, clock=None)
    clock = _tick(track.clock, item)
    time_s = item.boot_s + clock.offset_s - setup.lag.position_s
    motion = _start(item, place, time_s) if before is None else _update(before, item, place, time_s)
    return replace(
        track,
        motion=motion,
        clock=clock,
        position_valid=motion.confirm_left == 0,
        position_received_s=item.received_s,
    )


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


def _tick(clock: Clock | None, item: Telemetry) -> Clock:
    """Return the clock with one more arrival; a late message hardly moves it."""
    seen_s = item.received_s - item.boot_s
    if clock is None or not abs(seen_s - clock.offset_s) < CLOCK_RESET_S:
        return Clock(offset_s=seen_s, count=1)
    step_s = min(max(seen_s - clock.offset_s, -CLOCK_STEP_S), CLOCK_STEP_S)
    count = min(clock.count + 1, 100)
    return Clock(offset_s=clock.offset_s + step_s / count, count=count)


def _start(item: Telemetry, place: tuple[float, float], time_s: float) -> Motion:
    known = item.velocity_east_m_s is not None and item.velocity_north_m_s is not None
    return Motion(
        time_s=time_s,
        boot_s=item.boot_s,
        received_s=item.received_s,
        east_m=place[0],
        north_m=place[1],
        velocity_east_m_s=item.velocity_east_m_s or 0.0,
        velocity_north_m_s=item.velocity_north_m_s or 0.0,
        acceleration_east_m_s2=0.0,
        acceleration_north_m_s2=0.0,
        heading_deg=item.heading_deg,
        yaw_rate_deg_s=0.0,
        height_m=item.relative_altitude_m,
        velocity_known=known,
        confirm_left=CONFIRM_COUNT,
    )


def _update(before: Motion, item: Telemetry, place: tuple[float, float], time_s: float) -> Motion:
    dt_s = time_s - before.time_s
    if not 0.0 < dt_s < 2.0:
        return _start(item, place, time_s)
    known = item.velocity_east_m_s is not None and item.velocity_north_m_s is not None
    gains = filter_gains(round(min(max(dt_s, 0.005), 0.5) / 0.005), known)
    east = _filter(
        before.east_m,
        before.velocity_east_m_s,
        before.acceleration_east_m_s2,
        dt_s=dt_s,
        seen_m=place[0],
        seen_m_s=item.velocity_east_m_s if known else None,
        gains=gains,
    )
    north = _filter(
        before.north_m,
        before.velocity_north_m_s,
        before.acceleration_north_m_s2,
        dt_s=dt_s,
        seen_m=place[1],
        seen_m_s=item.velocity_north_m_s if known else None,
        gains=gains,
    )
    if east is None or north is None:
        return _start(item, place, time_s)
    return Motion(
        time_s=time_s,
        boot_s=item.boot_s,
        received_s=item.received_s,
        east_m=east[0],
        north_m=north[0],
        velocity_east_m_s=east[1],
        velocity_north_m_s=north[1],
        acceleration_east_m_s2=east[2],
        acceleration_north_m_s2=north[2],
        heading_deg=item.heading_deg,
        yaw_rate_deg_s=_yaw_rate(before, item.heading_deg, dt_s),
        height_m=item.relative_altitude_m,
        velocity_known=known,
        confirm_left=max(before.confirm_left - 1, 0),
    )


def _yaw_rate(before: Motion, heading_deg: float | None, dt_s: float) -> float:
    if heading_deg is None or before.heading_deg is None:
        return 0.0
    turned_deg = (heading_deg - before.heading_deg + 180.0) % 360.0 - 180.0
    share = 1.0 - math.exp(-dt_s / YAW_RATE_TIME_S)
    return before.yaw_rate_deg_s + share * (turned_deg / dt_s - before.yaw_rate_deg_s)


Gains = tuple[tuple[float, float, float], tuple[float, float, float]]


def _filter(
    position_m: float,
    velocity_m_s: float,
    acceleration_m_s2: float,
    *,
    dt_s: float,
    seen_m: float,
    seen_m_s: float | None,
    gains: Gains,
) -> tuple[float, float, float] | None:
    """Return one axis after prediction and correction; None for a jump."""
    fade = math.exp(-dt_s / ACCELERATION_TIME_S)
    gained = ACCELERATION_TIME_S * (1.0 - fade)
    position_m += velocity_m_s * dt_s + acceleration_m_s2 * ACCELERATION_TIME_S * (dt_s - gained)
    velocity_m_s += acceleration_m_s2 * gained
    acceleration_m_s2 *= fade
    off_m = seen_m - position_m
    if not abs(off_m) <= JUMP_M:
        return None
    by_position, by_velocity = gains
    off_m_s = 0.0 if seen_m_s is None else seen_m_s - velocity_m_s
    return (
        position_m + by_position[0] * off_m + by_velocity[0] * off_m_s,
        velocity_m_s + by_position[1] * off_m + by_velocity[1] * off_m_s,
        acceleration_m_s2 + by_position[2] * off_m + by_velocity[2] * off_m_s,
    )


@lru_cache(maxsize=256)
def filter_gains(dt_5ms: int, velocity_known: bool) -> Gains:
    """Return the steady-state Kalman gains for messages every `dt_5ms` times 5 ms.

    The model is position, velocity and a fading acceleration driven by white noise (Singer, IEEE
    Trans. AES 1970); the Riccati equation is iterated until it stands.
    """
    dt_s = dt_5ms * 0.005
    fade = math.exp(-dt_s / ACCELERATION_TIME_S)
    gained = ACCELERATION_TIME_S * (1.0 - fade)
    carry = np.array(
        [
            [1.0, dt_s, ACCELERATION_TIME_S * (dt_s - gained)],
            [0.0, 1.0, gained],
            [0.0, 0.0, fade],
        ]
    )
    push = np.array([[dt_s**2 / 2], [dt_s], [1.0]])
    wander = push @ push.T * ACCELERATION_WANDER_M_S2_SQRT_S**2 * dt_s
    seen = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])[: 2 if velocity_known else 1]
    noise = np.diag([POSITION_SD_M**2, VELOCITY_SD_M_S**2])[: len(seen), : len(seen)]
    spread = np.eye(3)
    gain = np.zeros((3, len(seen)))
    for _ in range(400):
        spread = carry @ spread @ carry.T + wander
        gain = spread @ seen.T @ np.linalg.inv(seen @ spread @ seen.T + noise)
        spread = (np.eye(3) - gain @ seen) @ spread
    columns = [tuple(float(value) for value in gain[:, i]) for i in range(len(seen))]
    if not velocity_known:
        columns.append((0.0, 0.0, 0.0))
    return (
        (columns[0][0], columns[0][1], columns[0][2]),
        (columns[1][0], columns[1][1], columns[1][2]),
    )


def estimate(track: Track, now_s: float) -> VehicleState | None:
    """Return the vehicle's state at `now_s`; None before the first position."""
    motion = track.motion
    if motion is None:
        return None
    dt_s = now_s - motion.time_s
    fade = math.exp(-min(max(dt_s, 0.0), 10.0) / ACCELERATION_TIME_S)
    gained = ACCELERATION_TIME_S * (1.0 - fade)
    carried = ACCELERATION_TIME_S * (dt_s - gained) if dt_s > 0.0 else 0.0
    velocity_east = motion.velocity_east_m_s + motion.acceleration_east_m_s2 * gained
    velocity_north = motion.velocity_north_m_s + motion.acceleration_north_m_s2 * gained
    checked = _checked_speed(track, now_s)
    known = motion.velocity_known
    if not known and checked is not None:
        velocity_east, velocity_north, known = _reported_velocity(motion, checked)
    heading = motion.heading_deg
    if heading is not None:
        heading = (heading + motion.yaw_rate_deg_s * dt_s) % 360.0
    heartbeat = track.heartbeat
    return VehicleState(
        time_s=now_s,
        east_m=motion.east_m
        + motion.velocity_east_m_s * dt_s
        + motion.acceleration_east_m_s2 * carried,
        north_m=motion.north_m
        + motion.velocity_north_m_s * dt_s
        + motion.acceleration_north_m_s2 * carried,
        velocity_east_m_s=velocity_east,
        velocity_north_m_s=velocity_north,
        acceleration_east_m_s2=motion.acceleration_east_m_s2 * fade,
        acceleration_north_m_s2=motion.acceleration_north_m_s2 * fade,
        heading_deg=heading,
        yaw_rate_deg_s=motion.yaw_rate_deg_s,
        height_m=motion.height_m,
        velocity_known=known,
        position_received_s=motion.received_s,
        position_valid=track.position_valid,
        checked_speed_m_s=checked,
        fix=track.gnss.fix if track.gnss and _young(track.gnss, now_s) else None,
        estimator_healthy=(
            track.estimator.healthy if track.estimator and _young(track.estimator, now_s) else None
        ),
        heartbeat_received_s=None if heartbeat is None else heartbeat.received_s,
        armed=heartbeat is not None and heartbeat.armed,
        mode=None if heartbeat is None else heartbeat.mode,
        in_air=track.landed.in_air if track.landed and _young(track.landed, now_s) else None,
        wind_m_s=track.wind.speed_m_s if track.wind else None,
        output_healthy=track.output is None or track.output.healthy,
        enabled=track.enabled,
        flow=track.flow,
    )


def _young(report: GnssReport | EstimatorReport | LandedReport, now_s: float) -> bool:
    return now_s - report.received_s <= STATUS_AGE_MAX_S


def _checked_speed(track: Track, now_s: float) -> float | None:
    """Return the second opinion on the ground speed, if it is young enough."""
    if track.speed is None or not now_s - track.speed.received_s <= SPEED_REPORT_AGE_MAX_S:
        return None
    return track.speed.ground_speed_m_s


def _reported_velocity(motion: Motion, speed_m_s: float) -> tuple[float, float, bool]:
    """Return the reported ground speed along the course that the positions show."""
    east, north = motion.velocity_east_m_s, motion.velocity_north_m_s
    seen_m_s = math.hypot(east, north)
    if not seen_m_s > 0.5:
        return east, north, False
    return east * speed_m_s / seen_m_s, north * speed_m_s / seen_m_s, True
