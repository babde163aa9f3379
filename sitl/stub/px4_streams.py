"""What PX4 sends beside what both firmwares do, and what it streams unasked.

Rates are those of the mode ONBOARD in mavlink_main.cpp (v1.16), of what there is here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from sitl.stub.faults import FaultKind
from sitl.stub.firmware import Builder
from sitl.stub.protocol import Message, dialect
from sitl.stub.px4_modes import base_mode, custom_mode
from sitl.stub.streams import COMMON, HEALTHY, LOST, estimated, version_word

if TYPE_CHECKING:
    from sitl.stub.autopilot import Autopilot

# ekf2 says CONST_POS_MODE of a vehicle at rest.
CONST_POS_AT_REST_SINCE = (1, 16, 0)
DEFAULT_RATES_HZ: Mapping[int, float] = {
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE: 100.0,
    dialect.MAVLINK_MSG_ID_VFR_HUD: 10.0,
    dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: 10.0,
    dialect.MAVLINK_MSG_ID_RC_CHANNELS: 20.0,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: 10.0,
    dialect.MAVLINK_MSG_ID_WIND_COV: 10.0,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 5.0,
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
}

# Streams that end while the estimator has no position (streams/GLOBAL_POSITION_INT.hpp).
_NEED_POSITION = frozenset({dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT})


def withholds(autopilot: Autopilot, message_id: int, now_s: float) -> bool:
    """Return whether a message is not sent now."""
    lost = autopilot.faults.active(FaultKind.STALE_POSITION, now_s) is not None
    return message_id in _NEED_POSITION and lost


def heartbeat(autopilot: Autopilot, _now_s: float) -> Message:
    """Return HEARTBEAT of a PX4 multicopter."""
    flight = autopilot.flight
    status = dialect.MAV_STATE_ACTIVE if flight.armed else dialect.MAV_STATE_STANDBY
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_QUADROTOR,
        dialect.MAV_AUTOPILOT_PX4,
        base_mode(flight.mode, armed=flight.armed),
        custom_mode(flight.mode),
        status,
        3,
    )


def estimator_status(autopilot: Autopilot, now_s: float) -> Message:
    """Return ESTIMATOR_STATUS."""
    lost = autopilot.estimator_lost(now_s)
    ratio = 1.5 if lost else 0.05
    accuracy_m = 25.0 if lost else 0.15
    at_rest = autopilot.firmware.version >= CONST_POS_AT_REST_SINCE and not autopilot.flight.in_air
    good = HEALTHY | (dialect.ESTIMATOR_CONST_POS_MODE if at_rest else 0)
    return dialect.MAVLink_estimator_status_message(
        autopilot.boot_ms(now_s) * 1000,
        LOST if lost else good,
        *(ratio, ratio, 0.05, 0.05, 0.0, 0.0),
        accuracy_m,
        0.3,
    )


def wind_cov(autopilot: Autopilot, now_s: float) -> Message:
    """Return WIND_COV: where it blows to."""
    east_m_s, north_m_s = estimated(autopilot.wind_towards_m_s, now_s)
    return dialect.MAVLink_wind_cov_message(
        autopilot.boot_ms(now_s) * 1000, north_m_s, east_m_s, 0.0, 0.3, 0.0, 60.0, 0.3, 0.0
    )


def autopilot_version(autopilot: Autopilot, _now_s: float) -> Message:
    """Return AUTOPILOT_VERSION, without file transfer."""
    capabilities = (
        dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | dialect.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
        | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    zeros = [0] * 8
    version = version_word(autopilot.firmware.version)
    return dialect.MAVLink_autopilot_version_message(
        capabilities, version, 0, 0, 0, zeros, zeros, zeros, 0, 0, 1
    )


# MISSION_CURRENT is not among them: it comes when it changes and every ten seconds, and asking for
# it fails (measured).
BUILDERS: Mapping[int, Builder] = {
    **COMMON,
    dialect.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: estimator_status,
    dialect.MAVLINK_MSG_ID_WIND_COV: wind_cov,
    dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
}
