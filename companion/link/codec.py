"""Bytes to our types, from whom they count; nothing here does any I/O."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from companion.core.types import (
    BatteryReport,
    EstimatorReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    LandedReport,
    RangeReport,
    RcReport,
    SpeedReport,
    Telemetry,
    UtcReport,
    WindReport,
)
from companion.link.census import AUTOPILOT_COMPONENT, Census, Vehicle, autopilot_name, mode_name
from companion.link.framer import Counts, Head, decoded
from companion.link.intake import Source
from companion.link.messages import (
    CURRENT,
    INERTIAL,
    RADIO_STATUS,
    TRANSFERS,
    AckReceived,
    CommandReceived,
    Message,
    ParamAsked,
    ParamSet,
    ParamValue,
    PingReceived,
    Sender,
    ServoOutput,
    TimesyncReceived,
    finite,
)

__all__ = ["AUTOPILOT_COMPONENT", "Codec", "Vehicle"]


Accept = Callable[[bytes, int], bool]

_HEARTBEAT = 0
_HIL_ENABLED = 32  # MAV_MODE_FLAG_HIL_ENABLED
_SENDERS_MAX = 64
# So many frames in a row that seem overtaken, and their sender has begun to count anew.
_ANEW = 32


class _Sequence:
    """Counts the frames of one sender, and those that its numbers say are missing."""

    __slots__ = ("_behind", "_counts", "count", "last", "lost")

    def __init__(self) -> None:
        self.count, self.lost, self.last = 0, 0, -1
        self._behind, self._counts = 0, False

    def take(self, number: int) -> bool:
        """Count a frame; return whether it was overtaken or sent twice: half the circle ahead.

        A sender whose numbers never move (a script) sends nothing late.
        """
        self.count += 1
        ahead = 0 if self.last < 0 else (number - self.last - 1) % 256
        self._counts = self._counts or (self.last >= 0 and number != self.last)
        is_late = ahead >= 128 and self._counts
        self._behind = self._behind + 1 if is_late else 0
        if is_late and self._behind < _ANEW:
            return True
        self.lost += ahead if ahead < 128 else 0
        self.last = number
        return is_late


class Codec:
    """Decodes a byte stream; remembers the first autopilot it hears and believes no other.

    `system_id` 0 takes the first autopilot; another number waits for that one.
    """

    def __init__(self, *, system_id: int = 0, accept: Accept | None = None) -> None:
        self.census = Census(system_id)
        self.counts = Counts()
        self._accept = accept
        self._source = Source(self.counts)
        self._senders: dict[tuple[int, int], _Sequence] = {}
        self.vehicle_counts: dict[int, int] = {}
        # Frames that show who speaks from an address; a radio's report is signed by nobody.
        self.named_frame_count = 0
        self.vehicle_frame_count = 0
        # Whether the vehicle's last heartbeat spoke of hardware in the loop of a simulation.
        self.is_hil = False

    @property
    def vehicle(self) -> Vehicle | None:
        """Return the autopilot that the link belongs to; None before it was heard."""
        return self.census.vehicle

    @property
    def lost_frames(self) -> dict[tuple[int, int], tuple[int, int]]:
        """Return frames that came and frames that are missing, by (system, component).

        Gaps are normal behind a router that does not pass everything on.
        """
        return {sender: (one.count, one.lost) for sender, one in self._senders.items()}

    def is_autopilot(self, system_id: int, component_id: int) -> bool:
        """Whether a sender is the vehicle's autopilot, the only one who speaks for the vehicle.

        A camera or a gimbal of the same system may say what it likes.
        """
        vehicle = self.vehicle
        return vehicle is not None and (system_id, component_id) == (
            vehicle.system_id,
            AUTOPILOT_COMPONENT,
        )

    def decode(self, data: bytes, received_s: float, source: Source | None = None) -> list[Message]:
        """Return what `data` completes, in its order; never raises.

        Whoever sent it (`source`, without bounds if not given) has frames of his own, and a share.
        """
        source = source or self._source
        self.counts.bytes_in += len(data)
        messages = []
        for frame in source.framer.push(data, received_s):
            head = Head.of(frame)
            if self._is_believed(frame, head, received_s, source):
                message = self._understand(frame, head, received_s)
                if message is not None:
                    messages.append(message)
        return messages

    def _is_read(self, head: Head) -> bool:
        """Whether anything of a frame but its head is looked at."""
        if head.message_id in FROM_ANYONE or head.message_id == _HEARTBEAT:
            return True
        return head.message_id in FROM_VEHICLE and self.is_autopilot(*head.sender)

    def _is_believed(self, frame: bytes, head: Head, received_s: float, source: Source) -> bool:
        """Whether a frame is within its sender's share, and has a good signature if it needs one.

        The share is asked first: a signature is dear to check.
        """
        sender = None if self.is_autopilot(*head.sender) else head.sender
        if not source.may_decode(sender, is_read=self._is_read(head), now_s=received_s):
            self.counts.excess_frames += 1
            return False
        if self._accept is not None and not self._accept(frame, head.message_id):
            self.counts.refused_frames += 1
            return False
        self.counts.frames += 1
        return True

    def _understand(self, frame: bytes, head: Head, received_s: float) -> Message | None:
        sender, message_id = head.sender, head.message_id
        is_late = self._count(sender, head.sequence)
        raw = decoded(frame) if self._is_read(head) else None
        if message_id == _HEARTBEAT and raw is not None:
            self.census.heartbeat(*sender, kind=raw.type, autopilot=raw.autopilot, now_s=received_s)
        if message_id != RADIO_STATUS:
            self.named_frame_count += 1
            if self.vehicle is not None and sender[0] == self.vehicle.system_id:
                self.vehicle_frame_count += 1
        if message_id in FROM_ANYONE:
            message = None if raw is None else FROM_ANYONE[message_id](raw, received_s)
            if is_late and isinstance(message, CommandReceived):
                return replace(message, is_late=True)
            return message
        if not self.is_autopilot(*sender):
            return None
        self.vehicle_counts[message_id] = self.vehicle_counts.get(message_id, 0) + 1
        if raw is None:
            return None
        if message_id == _HEARTBEAT:
            self.is_hil = bool(raw.base_mode & _HIL_ENABLED)
        return FROM_VEHICLE[message_id](raw, received_s)

    def _count(self, sender: tuple[int, int], number: int) -> bool:
        """Count a frame of a sender; return whether it comes late."""
        one = self._senders.get(sender)
        if one is None:
            if len(self._senders) >= _SENDERS_MAX:
                return False
            one = self._senders[sender] = _Sequence()
        return one.take(number)


# One MAVLink message to one of our types: scale factors, sentinels and flags live here only.
#
# Raw units stay in this file. What a message does not know becomes `None`, and so does NaN or an
# infinite number; what it claims is passed on even where it is absurd (latitude 0), for the core to
# judge and the journal to keep. No content of a message may raise.

ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_ACTIVE = 4  # MAV_STATE: 3 is standby, 5 and above critical, emergency and the like
_LOOKS_DOWN = 25  # MAV_SENSOR_ROTATION_PITCH_270
_INT16_LIMIT = 32767
_HEADING_MAX_CDEG = 36_000  # UINT16_MAX is not known, and so is any other above a circle
_UINT8_MAX, _UINT16_MAX = 255, 65535
# The time of satellites lies between the beginnings of 2021 and 2100, or it is none yet.
_UTC_MIN_S, _UTC_MAX_S = 1_609_459_200.0, 4_102_444_800.0
# EKF_STATUS_FLAGS: what must be set, and what must not. ArduPilot documents that variances below
# 0.5 are good, 0.5 to 0.8 acceptable and above 1 bad.
_EKF_NEEDED = 2 | 16  # VELOCITY_HORIZ, POS_HORIZ_ABS
_EKF_REFUSED = 128 | 1024 | 32768  # CONST_POS_MODE, UNINITIALIZED, GPS_GLITCHING
_EKF_VARIANCE_MAX = 0.8
# ESTIMATOR_STATUS_FLAGS (PX4) share the low bits; the ratios are innovations over their limits.
_ESTIMATOR_NEEDED = 2 | 16
_ESTIMATOR_REFUSED = 1024  # GPS_GLITCH
# From 1.16 on CONST_POS_MODE is set at rest too (ekf2, ekf_helper.cpp; measured on the ground): it
# counts where satellites are not in use, for which PRED_POS_HORIZ_ABS stands there.
_CONST_POS_MODE, _PRED_POS_HORIZ_ABS = 128, 512
_ESTIMATOR_RATIO_MAX = 1.0


def _position(m: Any, received_s: float) -> Telemetry:
    return Telemetry(
        received_s=received_s,
        boot_s=m.time_boot_ms / 1000.0,
        latitude_deg=m.lat / 1e7,
        longitude_deg=m.lon / 1e7,
        relative_altitude_m=m.relative_alt / 1000.0,
        velocity_north_m_s=_velocity(m.vx),
        velocity_east_m_s=_velocity(m.vy),
        velocity_down_m_s=_velocity(m.vz),
        heading_deg=None if m.hdg > _HEADING_MAX_CDEG else m.hdg / 100.0,
    )


def _velocity(velocity_cm_s: int) -> float | None:
    """Return m/s; the ends of the range are no sprayer's speed but saturated or unknown."""
    return None if abs(velocity_cm_s) >= _INT16_LIMIT else velocity_cm_s / 100.0


def _speed(m: Any, received_s: float) -> SpeedReport:
    return SpeedReport(received_s=received_s, ground_speed_m_s=finite(m.groundspeed))


def _gnss(m: Any, received_s: float) -> GnssReport:
    # 7 (static) and 8 (precise point positioning) are three-dimensional fixes at least.
    known = Fix.FIX_3D if m.fix_type in (7, 8) else Fix.NONE
    fix = Fix(m.fix_type) if m.fix_type <= Fix.RTK_FIXED else known
    accuracy_m = m.h_acc / 1000.0 if m.h_acc else None
    is_placed = fix >= Fix.FIX_2D and (m.lat or m.lon)
    stamp_s = m.time_usec / 1e6
    return GnssReport(
        received_s=received_s,
        fix=fix,
        horizontal_accuracy_m=accuracy_m,
        satellites=None if m.satellites_visible == _UINT8_MAX else m.satellites_visible,
        # A time of day is no time since boot.
        boot_s=stamp_s if 0.0 < stamp_s < _UTC_MIN_S else None,
        latitude_deg=m.lat / 1e7 if is_placed else None,
        longitude_deg=m.lon / 1e7 if is_placed else None,
    )


def _ekf(m: Any, received_s: float) -> EstimatorReport:
    healthy = (
        m.flags & _EKF_NEEDED == _EKF_NEEDED
        and not m.flags & _EKF_REFUSED
        and 0.0 <= m.velocity_variance < _EKF_VARIANCE_MAX
        and 0.0 <= m.pos_horiz_variance < _EKF_VARIANCE_MAX
    )
    return EstimatorReport(received_s=received_s, healthy=healthy)


def _estimator(m: Any, received_s: float) -> EstimatorReport:
    healthy = (
        m.flags & _ESTIMATOR_NEEDED == _ESTIMATOR_NEEDED
        and not m.flags & _ESTIMATOR_REFUSED
        and m.flags & (_CONST_POS_MODE | _PRED_POS_HORIZ_ABS) != _CONST_POS_MODE
        and 0.0 <= m.vel_ratio < _ESTIMATOR_RATIO_MAX
        and 0.0 <= m.pos_horiz_ratio < _ESTIMATOR_RATIO_MAX
    )
    return EstimatorReport(received_s=received_s, healthy=healthy)


def _heartbeat(m: Any, received_s: float) -> HeartbeatReport:
    return HeartbeatReport(
        received_s=received_s,
        autopilot=autopilot_name(m.autopilot),
        armed=bool(m.base_mode & ARMED),
        active=m.system_status == _ACTIVE,
        mode=mode_name(m.autopilot, m.type, m.custom_mode),
    )


def _landed(m: Any, received_s: float) -> LandedReport:
    # MAV_LANDED_STATE: 0 unknown, 1 on ground, 2 in air, 3 taking off, 4 landing.
    in_air = None if m.landed_state == 0 else m.landed_state == 2
    return LandedReport(received_s=received_s, in_air=in_air, on_ground=m.landed_state == 1)


def _wind(m: Any, received_s: float) -> WindReport:
    # `direction` is where it comes from.
    speed_m_s, from_deg = finite(m.speed), finite(m.direction)
    if speed_m_s is None or from_deg is None:
        return WindReport(received_s=received_s, speed_m_s=speed_m_s)
    angle = math.radians(from_deg)
    return WindReport(
        received_s=received_s,
        speed_m_s=speed_m_s,
        east_m_s=-speed_m_s * math.sin(angle),
        north_m_s=-speed_m_s * math.cos(angle),
    )


def _wind_cov(m: Any, received_s: float) -> WindReport:
    # x is north, y is east, and both are where it blows to.
    north_m_s, east_m_s = finite(m.wind_x), finite(m.wind_y)
    if north_m_s is None or east_m_s is None:
        return WindReport(received_s=received_s, speed_m_s=None)
    return WindReport(
        received_s=received_s,
        speed_m_s=math.hypot(north_m_s, east_m_s),
        east_m_s=east_m_s,
        north_m_s=north_m_s,
    )


def _range(m: Any, received_s: float) -> RangeReport | None:
    """Return the height over the crop; None for a sensor that looks elsewhere."""
    if m.orientation != _LOOKS_DOWN:
        return None
    # Quality 1 is an invalid reading, 0 is not known; the ends of the range are no reading.
    sees = m.signal_quality != 1 and m.min_distance < m.current_distance < m.max_distance
    return RangeReport(received_s=received_s, height_m=m.current_distance / 100.0 if sees else None)


def _battery(m: Any, received_s: float) -> BatteryReport:
    # -1 is not known, in both.
    return BatteryReport(
        received_s=received_s,
        battery=m.id,
        consumed=None if m.current_consumed < 0 else float(m.current_consumed),
        remaining_percent=None if m.battery_remaining < 0 else float(m.battery_remaining),
    )


def _utc(m: Any, received_s: float) -> UtcReport | None:
    """Return the time of day; None while the autopilot has none (0, or the day it was built)."""
    utc_s = m.time_unix_usec / 1e6
    known = _UTC_MIN_S < utc_s < _UTC_MAX_S
    boot_s = m.time_boot_ms / 1000.0
    return UtcReport(received_s=received_s, utc_s=utc_s, boot_s=boot_s) if known else None


def _rc(m: Any, received_s: float) -> RcReport:
    raw = (getattr(m, f"chan{channel}_raw") for channel in range(1, 19))
    pulses = tuple(0 if pulse == _UINT16_MAX else pulse for pulse in raw)
    return RcReport(received_s=received_s, pulse_us=pulses, boot_s=m.time_boot_ms / 1000.0 or None)


def _servo(m: Any, received_s: float) -> ServoOutput:
    pulses = tuple(getattr(m, f"servo{channel}_raw") for channel in range(1, 17))
    boot_s = m.time_usec / 1e6 or None
    return ServoOutput(received_s=received_s, port=m.port, pulse_us=pulses, boot_s=boot_s)


def _ack(m: Any, received_s: float) -> AckReceived:
    return AckReceived(
        received_s=received_s,
        command=m.command,
        result=m.result,
        target_system=m.target_system,
        target_component=m.target_component,
    )


def _sender(m: Any) -> Sender:
    return Sender(system_id=m.get_srcSystem(), component_id=m.get_srcComponent())


def _command(m: Any, received_s: float) -> CommandReceived:
    return CommandReceived(
        received_s=received_s,
        sender=_sender(m),
        target_system=m.target_system,
        target_component=m.target_component,
        command=m.command,
        param1=finite(m.param1),
        param2=finite(m.param2),
        confirmation=getattr(m, "confirmation", None),  # COMMAND_INT has none
        sequence=m.get_seq(),
    )


def _timesync(m: Any, received_s: float) -> TimesyncReceived:
    return TimesyncReceived(received_s=received_s, sender=_sender(m), tc1_ns=m.tc1, ts1_ns=m.ts1)


def _ping(m: Any, received_s: float) -> PingReceived:
    return PingReceived(
        received_s=received_s,
        sender=_sender(m),
        time_us=m.time_usec,
        sequence=m.seq,
        target_system=m.target_system,
        target_component=m.target_component,
    )


def _param_list(m: Any, received_s: float) -> ParamAsked:
    return ParamAsked(
        received_s=received_s,
        target_system=m.target_system,
        target_component=m.target_component,
        is_all=True,
    )


def _param_read(m: Any, received_s: float) -> ParamAsked:
    return ParamAsked(
        received_s=received_s,
        target_system=m.target_system,
        target_component=m.target_component,
        is_all=False,
        name=m.param_id if m.param_index < 0 else "",
        index=m.param_index,
    )


def _param_set(m: Any, received_s: float) -> ParamSet:
    return ParamSet(
        received_s=received_s,
        target_system=m.target_system,
        target_component=m.target_component,
        name=m.param_id,
        value=finite(m.param_value),
        kind=m.param_type,
    )


def _param_value(m: Any, received_s: float) -> ParamValue:
    # Not `finite`: PX4 puts a whole number's bytes where the float would be, and -1 looks like NaN.
    return ParamValue(
        received_s=received_s, name=m.param_id, value=m.param_value, kind=m.param_type
    )


Decoder = Callable[[Any, float], Message | None]

# By message id. What describes the vehicle counts only when its autopilot sent it.
FROM_VEHICLE: dict[int, Decoder] = {
    0: _heartbeat,
    2: _utc,
    22: _param_value,
    24: _gnss,
    33: _position,
    36: _servo,
    65: _rc,
    74: _speed,
    77: _ack,
    132: _range,
    147: _battery,
    168: _wind,
    193: _ekf,
    230: _estimator,
    231: _wind_cov,
    245: _landed,
    **CURRENT,
    **INERTIAL,
}
FROM_ANYONE: dict[int, Decoder] = {
    4: _ping,
    20: _param_read,
    21: _param_list,
    23: _param_set,
    75: _command,
    76: _command,
    111: _timesync,
    **TRANSFERS,
}
