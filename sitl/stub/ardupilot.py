"""ArduCopter, as the rest of the stub asks for it."""

from __future__ import annotations

from sitl.stub import commands, mission, parameters, services
from sitl.stub.ardupilot_commands import COMMANDS, handle_data_stream, handle_set_mode
from sitl.stub.ardupilot_streams import (
    BUILDERS,
    GROUPS,
    SILENT,
    heartbeat,
    second_servo_output,
    withholds,
)
from sitl.stub.firmware import Firmware, MessageHandler, Version
from sitl.stub.mission_items import refused_by_ardupilot
from sitl.stub.protocol import dialect

NAME = "ardupilot"
VERSION: Version = (4, 6, 0)

# What both firmwares listen to.
MESSAGES: dict[str, MessageHandler] = {
    "COMMAND_LONG": commands.handle_long,
    "COMMAND_INT": commands.handle_int,
    "MISSION_COUNT": mission.handle_count,
    "MISSION_ITEM_INT": mission.handle_item,
    "MISSION_ITEM": mission.handle_item,
    "MISSION_REQUEST_LIST": mission.handle_list,
    "MISSION_REQUEST_INT": mission.handle_request,
    "MISSION_REQUEST": mission.handle_request,
    "MISSION_CLEAR_ALL": mission.handle_clear,
    "MISSION_SET_CURRENT": mission.handle_set_current,
    "PARAM_REQUEST_LIST": parameters.handle_list,
    "PARAM_REQUEST_READ": parameters.handle_read,
    "PARAM_SET": parameters.handle_set,
    "TIMESYNC": services.handle_timesync,
    "PING": services.handle_ping,
    "FILE_TRANSFER_PROTOCOL": services.handle_file_transfer,
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
