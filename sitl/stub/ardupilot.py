"""ArduCopter, as the rest of the stub asks for it.

Also what each MAV_CMD does on it, with its results.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from sitl.stub import commands
from sitl.stub.commands import ACCEPTED, DENIED, FAILED, current
from sitl.stub.faults import FaultKind
from sitl.stub.firmware import Builder, CommandHandler, Firmware, MessageHandler, Params, Version
from sitl.stub.mission_items import refused_by_ardupilot
from sitl.stub.outputs import ServoOutputs
from sitl.stub.protocol import Message, dialect
from sitl.stub.streams import COMMON, HEALTHY, LOST, estimated, version_word

if TYPE_CHECKING:
    from sitl.stub.firmware import Autopilot
    from sitl.stub.protocol import Channel

# The main loop runs at 400 Hz; an interval below it is too fast to keep.
_INTERVAL_MIN_S = 0.0025


def _result(done: bool) -> int:
    return ACCEPTED if done else FAILED


def _arm(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return commands.arm(autopilot, params, now_s, refused=FAILED)


def _set_mode(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not (abs(params[0]) < 256 and int(params[0]) & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED):
        return DENIED
    if not 0.0 <= params[1] < 256.0:
        return FAILED
    return _result(autopilot.flight.set_mode(int(params[1]), now_s))


def _take_off(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return _result(autopilot.flight.take_off(params[6], now_s))


def _start_mission(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    if not (params[0] == 0.0 and params[1] == 0.0):
        return DENIED
    return _result(autopilot.flight.start_mission(now_s))


def _set_servo(autopilot: Autopilot, _channel: Channel, params: Params, now_s: float) -> int:
    return _result(write_servo(autopilot, params[0], params[1], now_s))


def write_servo(autopilot: Autopilot, channel: float, pulse_us: float, now_s: float) -> bool:
    """Write to an output if its function is free; the text is all that a mission gets."""
    outputs = autopilot.outputs
    if not isinstance(outputs, ServoOutputs):
        return False
    if not (1.0 <= channel < outputs.count + 1 and abs(pulse_us) < 1e6):
        return False
    refused = autopilot.faults.active(FaultKind.SERVO_REFUSED, now_s)
    if refused or not outputs.is_free(int(channel)):
        autopilot.tell(f"ServoRelayEvent: Channel {int(channel)} is already in use")
        return False
    outputs.write(int(channel), pulse_us, now_s=now_s)
    return True


def _set_relay(_autopilot: Autopilot, _channel: Channel, _params: Params, _now_s: float) -> int:
    """Fail without a text: no RELAYx_FUNCTION is set."""
    return FAILED


def _sprayer(autopilot: Autopilot, _channel: Channel, _params: Params, _now_s: float) -> int:
    """Accept whatever the value, as ArduPilot does, if there is a sprayer at all."""
    return _result(autopilot.parameters["SPRAY_ENABLE"] == 1.0)


def _set_interval(autopilot: Autopilot, channel: Channel, params: Params, now_s: float) -> int:
    """Set a stream of the peer that asks; param3 must be exactly 0, so a NaN is refused."""
    if not (params[2] == 0.0 and 0.0 <= params[0] < 2**24 and abs(params[1]) < 1e10):
        return DENIED
    message_id = int(params[0])
    if message_id in autopilot.firmware.silent:
        return ACCEPTED
    if message_id not in autopilot.firmware.builders:
        return DENIED
    if params[1] <= 0.0:
        channel.ask(message_id, None, now_s=now_s)
        return ACCEPTED
    interval_s = max(round(params[1] / 1000.0), 1) / 1000.0
    if interval_s < _INTERVAL_MIN_S:
        autopilot.tell(f"rate of message {message_id} is too fast")
        return DENIED
    kinds_max = autopilot.firmware.interval_kinds_max
    channel.ask(message_id, interval_s, now_s=now_s, kinds_max=kinds_max)
    return ACCEPTED


COMMANDS: Mapping[int, CommandHandler] = {
    **commands.shared(refused=FAILED, unknown=FAILED),
    dialect.MAV_CMD_COMPONENT_ARM_DISARM: _arm,
    dialect.MAV_CMD_DO_SET_MODE: _set_mode,
    dialect.MAV_CMD_NAV_TAKEOFF: _take_off,
    dialect.MAV_CMD_MISSION_START: _start_mission,
    dialect.MAV_CMD_DO_SET_MISSION_CURRENT: commands.set_current,
    dialect.MAV_CMD_DO_SET_SERVO: _set_servo,
    dialect.MAV_CMD_DO_SET_RELAY: _set_relay,
    dialect.MAV_CMD_DO_SPRAYER: _sprayer,
    dialect.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
}


def handle_set_mode(
    autopilot: Autopilot, _channel: Channel, message: Message, now_s: float
) -> None:
    """Change the mode by the older message, which has no acknowledgement of its own."""
    if message.base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        autopilot.flight.set_mode(message.custom_mode, now_s)


def handle_data_stream(
    autopilot: Autopilot, channel: Channel, message: Message, now_s: float
) -> None:
    """Switch a group of streams of the peer that asks."""
    rate_hz = message.req_message_rate if message.start_stop else 0
    switch_groups(autopilot, channel, message.req_stream_id, rate_hz, now_s)


def switch_groups(
    autopilot: Autopilot, channel: Channel, group: int, rate_hz: float, now_s: float
) -> None:
    """Set the rate of one group of streams, or of all of them (0)."""
    groups = autopilot.firmware.groups
    for number in list(groups) if group == 0 else [group]:
        for message_id in groups.get(number, ()):
            interval_s = max(1.0 / rate_hz, _INTERVAL_MIN_S) if rate_hz > 0 else None
            kinds_max = autopilot.firmware.interval_kinds_max
            channel.ask(message_id, interval_s, now_s=now_s, kinds_max=kinds_max)


NAME = "ardupilot"
VERSION: Version = (4, 6, 0)

# What both firmwares listen to.
MESSAGES: dict[str, MessageHandler] = {
    "COMMAND_LONG": commands.handle_long,
    "COMMAND_INT": commands.handle_int,
    "MISSION_COUNT": commands.handle_count,
    "MISSION_ITEM_INT": commands.handle_item,
    "MISSION_ITEM": commands.handle_item,
    "MISSION_REQUEST_LIST": commands.handle_list,
    "MISSION_REQUEST_INT": commands.handle_request,
    "MISSION_REQUEST": commands.handle_request,
    "MISSION_CLEAR_ALL": commands.handle_clear,
    "MISSION_SET_CURRENT": commands.handle_set_current,
    "PARAM_REQUEST_LIST": commands.handle_parameter_list,
    "PARAM_REQUEST_READ": commands.handle_parameter_read,
    "PARAM_SET": commands.handle_parameter_set,
    "TIMESYNC": commands.handle_timesync,
    "PING": commands.handle_ping,
    "FILE_TRANSFER_PROTOCOL": commands.handle_file_transfer,
}


def ardupilot(version: Version = VERSION) -> Firmware:
    """Return ArduCopter; the version is only what it says of itself."""
    return Firmware(
        name=NAME,
        version=version,
        heartbeat=heartbeat,
        messages={
            **MESSAGES,
            "SET_MODE": handle_set_mode,
            "REQUEST_DATA_STREAM": handle_data_stream,
        },
        commands=COMMANDS,
        builders=BUILDERS,
        refuses_item=refused_by_ardupilot,
        int_scale=1.0,
        silent=SILENT,
        also={dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: second_servo_output},
        withholds=withholds,
        groups=GROUPS,
        default_rates_hz={},
        # A port is slowed down while parameters, a mission or files run on it (GCS_Common.cpp).
        busy_factor=4.0,
        interval_kinds_max=10,
        timesync_s=10.0,
        system_in_timesync=True,
        carries_out_for_unheard=True,
    )


# What ArduCopter sends beside what both firmwares do, and how it groups its streams.
#
# A default ArduCopter streams nothing of this unasked; only HEARTBEAT comes by itself.


def ekf_status(autopilot: Autopilot, now_s: float) -> Message:
    """Return EKF_STATUS_REPORT; without a position it holds a constant one and says so."""
    lost = autopilot.estimator_lost(now_s)
    variance = 1.2 if lost else 0.05
    flags = LOST if lost else HEALTHY
    return dialect.MAVLink_ekf_status_report_message(flags, variance, variance, 0.05, 0.05, 0.0)


def autopilot_version(autopilot: Autopilot, _now_s: float) -> Message:
    """Return AUTOPILOT_VERSION: a Copter, without file transfer."""
    capabilities = (
        dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
        | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )
    zeros = [0] * 8
    version = version_word(autopilot.firmware.version)
    return dialect.MAVLink_autopilot_version_message(
        capabilities, version, 0, 0, 0, zeros, zeros, zeros, 0, 0, 1
    )


def wind(autopilot: Autopilot, now_s: float) -> Message:
    """Return WIND: the direction it comes from; exactly 0 where none is estimated."""
    if not autopilot.parameters["EK3_DRAG_BCOEF_X"] > 0.0:
        return dialect.MAVLink_wind_message(0.0, 0.0, 0.0)
    east_m_s, north_m_s = estimated(autopilot.wind_towards_m_s, now_s)
    from_deg = math.degrees(math.atan2(-east_m_s, -north_m_s)) % 360.0
    return dialect.MAVLink_wind_message(from_deg, math.hypot(east_m_s, north_m_s), 0.0)


def heartbeat(autopilot: Autopilot, _now_s: float) -> Message:
    """Return HEARTBEAT of an ArduCopter."""
    flight = autopilot.flight
    mode = (
        dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        | dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
        | dialect.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
        | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if flight.armed else 0)
    )
    status = dialect.MAV_STATE_ACTIVE if flight.in_air else dialect.MAV_STATE_STANDBY
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_QUADROTOR,
        dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
        mode,
        flight.mode,
        status,
        3,
    )


def battery_status(autopilot: Autopilot, now_s: float) -> Message:
    """Return BATTERY_STATUS of one monitor; they take turns (GCS_Common.cpp)."""
    monitors = autopilot.batteries(now_s)
    autopilot.battery_turn = (autopilot.battery_turn + 1) % len(monitors)
    found = monitors[autopilot.battery_turn]
    percent = -1 if found.remaining_percent is None else found.remaining_percent
    consumed = -1 if found.consumed is None else found.consumed
    return dialect.MAVLink_battery_status_message(
        found.number, 0, 0, 32767, [65535] * 10, -1, consumed, -1, percent
    )


BUILDERS: Mapping[int, Builder] = {
    **COMMON,
    dialect.MAVLINK_MSG_ID_HEARTBEAT: heartbeat,
    dialect.MAVLINK_MSG_ID_MISSION_CURRENT: lambda autopilot, _now_s: current(autopilot),
    dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION: autopilot_version,
    dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT: ekf_status,
    dialect.MAVLINK_MSG_ID_WIND: wind,
    dialect.MAVLINK_MSG_ID_BATTERY_STATUS: battery_status,
}


def withholds(autopilot: Autopilot, message_id: int, now_s: float) -> bool:
    """Return whether a message is not sent now: BATTERY_STATUS, without a monitor."""
    return message_id == dialect.MAVLINK_MSG_ID_BATTERY_STATUS and not autopilot.batteries(now_s)


def second_servo_output(autopilot: Autopilot, now_s: float) -> Message | None:
    """Return SERVO_OUTPUT_RAW of the outputs 17 to 32, where they are switched on."""
    pulses = autopilot.outputs.pulses_us(now_s)[16:]
    if not pulses:
        return None
    boot_us = (autopilot.boot_ms(now_s) * 1000) & 0xFFFFFFFF
    return dialect.MAVLink_servo_output_raw_message(boot_us, 1, *pulses)


# Known to an ArduCopter and granted, but never sent by one with these sensors.
SILENT = frozenset(
    {
        dialect.MAVLINK_MSG_ID_DISTANCE_SENSOR,
        dialect.MAVLINK_MSG_ID_RANGEFINDER,
        dialect.MAVLINK_MSG_ID_RPM,
        dialect.MAVLINK_MSG_ID_TERRAIN_REPORT,
    }
)

# What REQUEST_DATA_STREAM switches together, of what there is here.
GROUPS: dict[int, tuple[int, ...]] = {
    dialect.MAV_DATA_STREAM_EXTENDED_STATUS: (
        dialect.MAVLINK_MSG_ID_SYS_STATUS,
        dialect.MAVLINK_MSG_ID_GPS_RAW_INT,
        dialect.MAVLINK_MSG_ID_MISSION_CURRENT,
    ),
    dialect.MAV_DATA_STREAM_RC_CHANNELS: (
        dialect.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
        dialect.MAVLINK_MSG_ID_RC_CHANNELS,
    ),
    dialect.MAV_DATA_STREAM_POSITION: (dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,),
    dialect.MAV_DATA_STREAM_EXTRA1: (dialect.MAVLINK_MSG_ID_ATTITUDE,),
    dialect.MAV_DATA_STREAM_EXTRA2: (dialect.MAVLINK_MSG_ID_VFR_HUD,),
    dialect.MAV_DATA_STREAM_EXTRA3: (
        dialect.MAVLINK_MSG_ID_SYSTEM_TIME,
        dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    ),
}
