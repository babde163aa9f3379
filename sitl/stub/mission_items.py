"""The items of a mission as they travel and as files hold them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sitl.stub.protocol import Message, dialect

# Commands whose fifth to seventh parameter are a place.
PLACES = frozenset(
    {
        dialect.MAV_CMD_NAV_WAYPOINT,
        dialect.MAV_CMD_NAV_LAND,
        dialect.MAV_CMD_NAV_TAKEOFF,
        dialect.MAV_CMD_DO_SET_HOME,
    }
)
ACTIONS = frozenset(
    {
        dialect.MAV_CMD_DO_CHANGE_SPEED,
        dialect.MAV_CMD_DO_SET_SERVO,
        dialect.MAV_CMD_DO_SET_ACTUATOR,
        dialect.MAV_CMD_DO_SPRAYER,
        dialect.MAV_CMD_CONDITION_YAW,
    }
)
FLOWN = PLACES | ACTIONS | {dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH}
SUPPORTED = FLOWN - {dialect.MAV_CMD_DO_SET_ACTUATOR}
# Measured on PX4 1.16, as in mavlink_mission.cpp: one list for frames with places, one for frame 2.
PX4_IN_PLACE_FRAMES = frozenset(
    {dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_LAND, dialect.MAV_CMD_NAV_TAKEOFF}
)
PX4_IN_MISSION_FRAME = frozenset(
    {
        dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH,
        dialect.MAV_CMD_DO_CHANGE_SPEED,
        dialect.MAV_CMD_DO_SET_HOME,
        dialect.MAV_CMD_DO_SET_ACTUATOR,
    }
)

ACTION_NAMES = {
    dialect.MAV_CMD_DO_CHANGE_SPEED: "ChangeSpeed",
    dialect.MAV_CMD_DO_SET_SERVO: "SetServo",
    dialect.MAV_CMD_DO_SET_ACTUATOR: "SetActuator",
    dialect.MAV_CMD_DO_SPRAYER: "Sprayer",
    dialect.MAV_CMD_CONDITION_YAW: "ConditionYaw",
}

ABSOLUTE_FRAMES = frozenset({dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_GLOBAL_INT})
FRAMES = ABSOLUTE_FRAMES | {
    dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
    dialect.MAV_FRAME_MISSION,
}
PLACE_FRAMES = FRAMES - {dialect.MAV_FRAME_MISSION}
# ArduPilot: places on the Earth, and heights that its Location holds (LOCATION_ALT_MAX_M).
LATITUDE_MAX_E7, LONGITUDE_MAX_E7, HEIGHT_MAX_M = 900_000_000, 1_800_000_000, 83_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionItem:
    """One item; `x_e7` and `y_e7` are latitude and longitude in 1e-7 degrees where it has a place.

    Whole numbers are kept, so that what was uploaded reads back the same.
    """

    command: int
    frame: int = dialect.MAV_FRAME_MISSION
    param1: float = 0.0
    param2: float = 0.0
    param3: float = 0.0
    param4: float = 0.0
    x_e7: int = 0
    y_e7: int = 0
    z_m: float = 0.0
    autocontinue: int = 1

    @property
    def has_place(self) -> bool:
        """Return whether the item names a place on the ground, as ArduPilot takes 0, 0."""
        return self.command in PLACES and (self.x_e7 != 0 or self.y_e7 != 0)

    @property
    def latitude_deg(self) -> float:
        """Return the latitude of the place."""
        return self.x_e7 * 1e-7

    @property
    def longitude_deg(self) -> float:
        """Return the longitude of the place."""
        return self.y_e7 * 1e-7


def waypoint(
    command: int, latitude_deg: float, longitude_deg: float, *, height_m: float
) -> MissionItem:
    """Return an item at a place, with its height above home."""
    return MissionItem(
        command=command,
        frame=dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT,
        x_e7=round(latitude_deg * 1e7),
        y_e7=round(longitude_deg * 1e7),
        z_m=height_m,
    )


def speed(speed_m_s: float) -> MissionItem:
    """Return the item that sets the ground speed and leaves the throttle alone."""
    return MissionItem(
        command=dialect.MAV_CMD_DO_CHANGE_SPEED, param1=1.0, param2=speed_m_s, param3=-1.0
    )


def landing(latitude_deg: float, longitude_deg: float) -> MissionItem:
    """Return a landing at a place.

    It has coordinates: 0, 0 means "here" to ArduPilot, and PX4 flies there.
    """
    return waypoint(dialect.MAV_CMD_NAV_LAND, latitude_deg, longitude_deg, height_m=0.0)


def item_of(message: Message) -> MissionItem:
    """Return the item that a MISSION_ITEM_INT or MISSION_ITEM carries."""
    x, y = message.x, message.y
    if message.get_type() == "MISSION_ITEM" and message.command in PLACES:
        x, y = round(x * 1e7), round(y * 1e7)
    return MissionItem(
        command=message.command,
        frame=message.frame,
        param1=message.param1,
        param2=message.param2,
        param3=message.param3,
        param4=message.param4,
        x_e7=int(x),
        y_e7=int(y),
        z_m=message.z,
        autocontinue=message.autocontinue,
    )


def item_message(
    item: MissionItem, sequence: int, *, current: bool, to: tuple[int, int], kind: int = 0
) -> Message:
    """Return MISSION_ITEM_INT for one item."""
    return dialect.MAVLink_mission_item_int_message(
        to[0],
        to[1],
        sequence,
        item.frame,
        item.command,
        int(current),
        item.autocontinue,
        item.param1,
        item.param2,
        item.param3,
        item.param4,
        item.x_e7,
        item.y_e7,
        item.z_m,
        kind,
    )


def refused_by_ardupilot(message: Message) -> int | None:
    """Return why ArduPilot refuses an item; item 0 is home and is never looked at."""
    if message.seq == 0:
        return None
    refusal: int | None = None
    if message.command not in SUPPORTED:
        refusal = dialect.MAV_MISSION_UNSUPPORTED
    elif message.command in PLACES and message.frame not in FRAMES:
        refusal = dialect.MAV_MISSION_UNSUPPORTED_FRAME
    else:
        refusal = _wrong_number(message)
    return refusal


def _wrong_number(message: Message) -> int | None:
    """Return the MAV_MISSION_RESULT that names the number ArduPilot does not take."""
    for index, value in enumerate((message.param1, message.param2, message.param3)):
        if not math.isfinite(value):
            return int(dialect.MAV_MISSION_INVALID_PARAM1 + index)
    if message.command not in PLACES:
        return None
    if not abs(message.x) <= LATITUDE_MAX_E7:
        return int(dialect.MAV_MISSION_INVALID_PARAM5_X)
    if not abs(message.y) <= LONGITUDE_MAX_E7:
        return int(dialect.MAV_MISSION_INVALID_PARAM6_Y)
    return None if abs(message.z) <= HEIGHT_MAX_M else int(dialect.MAV_MISSION_INVALID_PARAM7)


def refused_by_px4(message: Message) -> int | None:
    """Return why PX4 refuses an item: it looks at the command and its frame, and no further."""
    if message.frame in PLACE_FRAMES:
        taken = message.command in PX4_IN_PLACE_FRAMES
    elif message.frame == dialect.MAV_FRAME_MISSION:
        taken = message.command in PX4_IN_MISSION_FRAME
    else:
        return int(dialect.MAV_MISSION_UNSUPPORTED_FRAME)
    return None if taken else int(dialect.MAV_MISSION_UNSUPPORTED)
