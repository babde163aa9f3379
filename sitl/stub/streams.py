"""The messages that a peer can ask for, each built from the state at one moment.

What both firmwares send alike; `ardupilot.py` and `px4.py` hold the rest.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from sitl.stub.faults import RC_COUNT, FaultClock, FaultKind, rc_pulses_us
from sitl.stub.firmware import Builder
from sitl.stub.mission_items import LANDED_STATES
from sitl.stub.protocol import (
    AUTOPILOT_SYSTEM,
    COMPANION_COMPONENT,
    GROUND_COMPONENT,
    GROUND_SYSTEM,
    Message,
    Speaker,
    clipped,
    dialect,
)
from sitl.stub.world import Pose
from sitl.vehicle import GRAVITY_M_S2

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot

_HEADING_UNKNOWN = 65535
# MAVLink gives EKF_STATUS_REPORT and ESTIMATOR_STATUS the same flags.
HEALTHY: int = (
    dialect.ESTIMATOR_ATTITUDE
    | dialect.ESTIMATOR_VELOCITY_HORIZ
    | dialect.ESTIMATOR_VELOCITY_VERT
    | dialect.ESTIMATOR_POS_HORIZ_REL
    | dialect.ESTIMATOR_POS_HORIZ_ABS
    | dialect.ESTIMATOR_POS_VERT_ABS
    | dialect.ESTIMATOR_PRED_POS_HORIZ_REL
    | dialect.ESTIMATOR_PRED_POS_HORIZ_ABS
)
LOST: int = dialect.ESTIMATOR_ATTITUDE | dialect.ESTIMATOR_CONST_POS_MODE
_SENSORS = (
    dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
    | dialect.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | dialect.MAV_SYS_STATUS_SENSOR_GPS
)

_STILL = (0, 0, 0)
# Rates of turning are taken over so long.
_TURN_S = 0.02
# A second vehicle on the link would lie here: a latitude in no field of ours.
_EXTREME_E7 = 0x7FFFFFFF


def _place_e7(autopilot: Autopilot, pose: Pose) -> tuple[int, int]:
    latitude_deg, longitude_deg = autopilot.flight.frame.to_geographic(pose.east_m, pose.north_m)
    return round(latitude_deg * 1e7), round(longitude_deg * 1e7)


def _heading_cdeg(heading_deg: float) -> int:
    return round(heading_deg * 100.0) % 36000


def global_position(autopilot: Autopilot, now_s: float) -> Message:
    """Return GLOBAL_POSITION_INT.

    ArduPilot stamps it with the time of sending, and goes on with the last place when it has
    none; PX4 stamps it with the time of the estimate.
    """
    at_s = autopilot.sample_s(now_s)
    pose = autopilot.believed(at_s)
    latitude_e7, longitude_e7 = _place_e7(autopilot, pose)
    if autopilot.faults.active(FaultKind.ZERO_POSITION, now_s):
        latitude_e7 = longitude_e7 = 0
    if autopilot.faults.active(FaultKind.EXTREME_POSITION, now_s):
        latitude_e7 = longitude_e7 = _EXTREME_E7
    heading = _heading_cdeg(pose.heading_deg)
    if autopilot.faults.active(FaultKind.HEADING_UNKNOWN, now_s):
        heading = _HEADING_UNKNOWN
    return dialect.MAVLink_global_position_int_message(
        autopilot.boot_ms(at_s),
        latitude_e7,
        longitude_e7,
        round((autopilot.flight.home_altitude_m + pose.height_m) * 1000.0),
        round(pose.height_m * 1000.0),
        clipped(pose.velocity_north_m_s * 100.0, -32768, 32767),
        clipped(pose.velocity_east_m_s * 100.0, -32768, 32767),
        clipped(-pose.velocity_up_m_s * 100.0, -32768, 32767),
        heading,
    )


def vfr_hud(autopilot: Autopilot, now_s: float) -> Message:
    """Return VFR_HUD."""
    pose = autopilot.believed(now_s)
    return dialect.MAVLink_vfr_hud_message(
        pose.speed_m_s,
        pose.speed_m_s,
        round(pose.heading_deg) % 360,
        40 if autopilot.flight.in_air else 0,
        autopilot.flight.home_altitude_m + pose.height_m,
        pose.velocity_up_m_s,
    )


def gps_raw(autopilot: Autopilot, now_s: float) -> Message:
    """Return GPS_RAW_INT: RTK fixed, unless a fault says otherwise."""
    pose = autopilot.received(now_s)
    latitude_e7, longitude_e7 = _place_e7(autopilot, pose)
    drop = autopilot.faults.active(FaultKind.GPS_DROP, now_s)
    course_deg = math.degrees(math.atan2(pose.velocity_east_m_s, pose.velocity_north_m_s))
    return dialect.MAVLink_gps_raw_int_message(
        autopilot.boot_ms(pose.time_s) * 1000,
        dialect.GPS_FIX_TYPE_RTK_FIXED if drop is None else drop.fix,
        latitude_e7,
        longitude_e7,
        round((autopilot.flight.home_altitude_m + pose.height_m) * 1000.0),
        60 if drop is None else 9999,
        90 if drop is None else 9999,
        clipped(pose.speed_m_s * 100.0, 0, 65535),
        _heading_cdeg(course_deg),
        24 if drop is None else 3,
        h_acc=14 if drop is None else 25_000,
        v_acc=20 if drop is None else 40_000,
        vel_acc=30,
    )


def extended_state(autopilot: Autopilot, _now_s: float) -> Message:
    """Return EXTENDED_SYS_STATE."""
    return dialect.MAVLink_extended_sys_state_message(
        dialect.MAV_VTOL_STATE_UNDEFINED, LANDED_STATES[autopilot.flight.phase]
    )


def servo_output(autopilot: Autopilot, now_s: float) -> Message:
    """Return SERVO_OUTPUT_RAW of the first sixteen outputs."""
    return dialect.MAVLink_servo_output_raw_message(
        (autopilot.boot_ms(now_s) * 1000) & 0xFFFFFFFF, 0, *autopilot.outputs.pulses_us(now_s)[:16]
    )


def rc_channels(autopilot: Autopilot, now_s: float) -> Message:
    """Return RC_CHANNELS: what the transmitter says."""
    pulses = [*rc_pulses_us(autopilot.faults, now_s), 0, 0]
    return dialect.MAVLink_rc_channels_message(autopilot.boot_ms(now_s), RC_COUNT, *pulses, 254)


def sys_status(_autopilot: Autopilot, _now_s: float) -> Message:
    """Return SYS_STATUS with every sensor healthy."""
    return dialect.MAVLink_sys_status_message(
        _SENSORS, _SENSORS, _SENSORS, 250, 46_000, 4_000, 80, 0, 0, 0, 0, 0, 0
    )


def attitude(autopilot: Autopilot, now_s: float) -> Message:
    """Return ATTITUDE: how the copter leans, and how fast that changes."""
    now, before = autopilot.leaning(now_s), autopilot.leaning(now_s - _TURN_S)
    full = 2.0 * math.pi
    angles = (now.roll_rad, now.pitch_rad, now.yaw_rad)
    old = (before.roll_rad, before.pitch_rad, before.yaw_rad)
    rates = (math.remainder(a - b, full) / _TURN_S for a, b in zip(angles, old, strict=True))
    wrapped = (math.remainder(angle, full) for angle in angles)
    return dialect.MAVLink_attitude_message(autopilot.boot_ms(now_s), *wrapped, *rates)


def scaled_imu(autopilot: Autopilot, now_s: float) -> Message:
    """Return SCALED_IMU: the accelerometer in thousandths of gravity."""
    felt = autopilot.leaning(now_s).felt_m_s2
    scaled = (clipped(each * 1000.0 / GRAVITY_M_S2, -32768, 32767) for each in felt)
    return dialect.MAVLink_scaled_imu_message(autopilot.boot_ms(now_s), *scaled, *_STILL, *_STILL)


def highres_imu(autopilot: Autopilot, now_s: float) -> Message:
    """Return HIGHRES_IMU with nothing but an accelerometer."""
    felt = autopilot.leaning(now_s).felt_m_s2
    return dialect.MAVLink_highres_imu_message(
        autopilot.boot_ms(now_s) * 1000, *felt, *_STILL, *_STILL, 0.0, 0.0, 0.0, 0.0, 7
    )


def home_position(autopilot: Autopilot, now_s: float) -> Message:
    """Return HOME_POSITION: the origin of the frame."""
    frame = autopilot.flight.frame
    return dialect.MAVLink_home_position_message(
        round(frame.latitude_deg * 1e7),
        round(frame.longitude_deg * 1e7),
        round(autopilot.flight.home_altitude_m * 1000.0),
        *(0.0, 0.0, 0.0),
        [1.0, 0.0, 0.0, 0.0],
        *(0.0, 0.0, 0.0),
        autopilot.boot_ms(now_s) * 1000,
    )


def system_time(autopilot: Autopilot, now_s: float) -> Message:
    """Return SYSTEM_TIME."""
    utc_us = round((now_s + autopilot.utc_offset_s) * 1e6)
    return dialect.MAVLink_system_time_message(utc_us, autopilot.boot_ms(now_s))


def estimated(wind_m_s: tuple[float, float], now_s: float) -> tuple[float, float]:
    """Return a wind as an estimator tells it: its last digits never stand still."""
    return (
        wind_m_s[0] + 0.02 * math.sin(0.7 * now_s),
        wind_m_s[1] + 0.02 * math.cos(0.7 * now_s),
    )


def version_word(version: tuple[int, int, int]) -> int:
    """Return a version as AUTOPILOT_VERSION has it, marked as a release."""
    major, minor, patch = version
    official: int = dialect.FIRMWARE_VERSION_TYPE_OFFICIAL
    return major << 24 | minor << 16 | patch << 8 | official


COMMON: dict[int, Builder] = {
    dialect.MAVLINK_MSG_ID_SYS_STATUS: sys_status,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME: system_time,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: gps_raw,
    dialect.MAVLINK_MSG_ID_ATTITUDE: attitude,
    dialect.MAVLINK_MSG_ID_SCALED_IMU: scaled_imu,
    dialect.MAVLINK_MSG_ID_HIGHRES_IMU: highres_imu,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: global_position,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: servo_output,
    dialect.MAVLINK_MSG_ID_RC_CHANNELS: rc_channels,
    dialect.MAVLINK_MSG_ID_VFR_HUD: vfr_hud,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: home_position,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: extended_state,
}


# The others on the link: a gimbal, a transponder, a ground station, a second of each of us.

_SECOND_SYSTEM = 2
_NONE = dialect.MAV_AUTOPILOT_INVALID
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED
_POSITION_S = 0.1
_NEAR_E7 = 3000  # 33 m north of home: a place in the same field


class Strangers:
    """Gives their frames as far as a fault puts them on the link."""

    def __init__(self, faults: FaultClock, *, home_e7: tuple[int, int], autopilot: int) -> None:
        self._faults = faults
        self._home_e7 = home_e7
        self._autopilot = autopilot
        self._gimbal = Speaker(AUTOPILOT_SYSTEM, dialect.MAV_COMP_ID_GIMBAL)
        self._transponder = Speaker(AUTOPILOT_SYSTEM, dialect.MAV_COMP_ID_ADSB)
        self._ground = Speaker(GROUND_SYSTEM, GROUND_COMPONENT)
        self._companion = Speaker(AUTOPILOT_SYSTEM, COMPANION_COMPONENT)
        self._second = Speaker(_SECOND_SYSTEM, dialect.MAV_COMP_ID_AUTOPILOT1)
        self._position_due_s = 0.0

    def heartbeats(self, now_s: float) -> list[bytes]:
        """Return what they send once a second."""
        frames: list[bytes] = []
        if self._faults.active(FaultKind.FOREIGN, now_s):
            frames += self._foreign()
        if self._faults.active(FaultKind.SECOND_COMPANION, now_s):
            beat = _heartbeat(dialect.MAV_TYPE_ONBOARD_CONTROLLER, _NONE)
            frames.append(self._companion.frame(beat))
        if self._faults.active(FaultKind.SECOND_VEHICLE, now_s):
            beat = _heartbeat(dialect.MAV_TYPE_QUADROTOR, self._autopilot, armed=True, mode=3)
            frames.append(self._second.frame(beat))
        if self._faults.active(FaultKind.STATION_RATES, now_s):
            frames.append(self._ground.frame(_heartbeat(dialect.MAV_TYPE_GCS, _NONE)))
        return frames

    def positions(self, now_s: float) -> list[bytes]:
        """Return where the second vehicle flies, ten times a second."""
        if now_s < self._position_due_s:
            return []
        if not self._faults.active(FaultKind.SECOND_VEHICLE, now_s):
            return []
        self._position_due_s = now_s + _POSITION_S
        latitude_e7, longitude_e7 = self._home_e7
        place = (latitude_e7 + _NEAR_E7, longitude_e7, 63_000, 3_000)
        return [self._second.frame(_position(place))]

    def _foreign(self) -> list[bytes]:
        far = (473_977_420, 85_455_940, 488_000, 10_000)
        second = _heartbeat(dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
        return [
            self._gimbal.frame(_heartbeat(dialect.MAV_TYPE_GIMBAL, _NONE)),
            self._transponder.frame(_heartbeat(dialect.MAV_TYPE_ADSB, _NONE)),
            self._ground.frame(_heartbeat(dialect.MAV_TYPE_GCS, _NONE)),
            self._second.frame(second),
            self._second.frame(_position(far)),
        ]


def _heartbeat(kind: int, autopilot: int, *, armed: bool = False, mode: int = 0) -> Message:
    flags = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (_ARMED if armed else 0)
    return dialect.MAVLink_heartbeat_message(
        kind, autopilot, flags, mode, dialect.MAV_STATE_ACTIVE, 3
    )


def _position(place: tuple[int, int, int, int]) -> Message:
    return dialect.MAVLink_global_position_int_message(1000, *place, 900, 900, 0, 4500)
