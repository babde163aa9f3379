"""The items of a mission as they travel and as files hold them."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from companion.errors import ConfigError
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


# Mission files: QGC WPL 110 (`.waypoints`) and QGroundControl's plan (`.plan`).
#
# Both begin with home, as ArduPilot numbers it: item 0 of a waypoint file, `plannedHomePosition`
# of a plan.

_HEADER = "QGC WPL 110"


def read_mission(path: Path) -> tuple[MissionItem, ...]:
    """Return the items of a mission file, home first."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file; check the path") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as a mission ({error})") from error
    items = _plan_items(path, text) if path.suffix == ".plan" else _waypoint_items(path, text)
    if len(items) < 2:
        raise ConfigError(f"{path}: no mission items; plan at least a take-off and a waypoint")
    for number, item in enumerate(items[1:], start=1):
        if item.command not in FLOWN:
            raise ConfigError(
                f"{path}: item {number}: the stub does not fly command {item.command}"
            )
    return items


def _waypoint_items(path: Path, text: str) -> tuple[MissionItem, ...]:
    lines = text.splitlines()
    if not lines or lines[0].strip() != _HEADER:
        raise ConfigError(f"{path}: first line must be '{_HEADER}' (or name the file .plan)")
    items: list[MissionItem] = []
    for number, line in enumerate(lines[1:], start=2):
        fields = line.split()
        if not fields:
            continue
        try:
            if not items and fields[0] != "0":
                raise ValueError("row 0, home, is missing; write the file with it")
            items.append(_waypoint_item(fields))
        except (ValueError, OverflowError) as error:
            raise ConfigError(f"{path}: line {number}: {error}") from error
    if items and items[0].command != dialect.MAV_CMD_NAV_WAYPOINT:
        raise ConfigError(f"{path}: row 0 is home, and here it is command {items[0].command}")
    return tuple(items)


def _waypoint_item(fields: list[str]) -> MissionItem:
    if len(fields) != 12:
        raise ValueError(f"12 columns expected, {len(fields)} found")
    command = int(fields[3])
    scale = 1e7 if command in PLACES else 1.0
    return MissionItem(
        command=command,
        frame=int(fields[2]),
        param1=float(fields[4]),
        param2=float(fields[5]),
        param3=float(fields[6]),
        param4=float(fields[7]),
        x_e7=round(float(fields[8]) * scale),
        y_e7=round(float(fields[9]) * scale),
        z_m=float(fields[10]),
        autocontinue=int(fields[11]),
    )


def _plan_items(path: Path, text: str) -> tuple[MissionItem, ...]:
    try:
        mission = json.loads(text)["mission"]
        latitude_deg, longitude_deg, altitude_m = mission["plannedHomePosition"]
        home = MissionItem(
            command=dialect.MAV_CMD_NAV_WAYPOINT,
            frame=dialect.MAV_FRAME_GLOBAL,
            x_e7=round(latitude_deg * 1e7),
            y_e7=round(longitude_deg * 1e7),
            z_m=float(altitude_m),
        )
        simple = [entry for item in mission["items"] for entry in _simple_items(item)]
        return (home, *(_plan_item(entry) for entry in simple))
    except (ValueError, TypeError, KeyError, IndexError) as error:
        raise ConfigError(f"{path}: not a QGroundControl plan ({error!r})") from error


def _simple_items(item: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the simple items of one entry; a survey holds its own inside."""
    if item.get("type") == "SimpleItem":
        return [item]
    inner: list[dict[str, Any]] = item["TransectStyleComplexItem"]["Items"]
    return inner


def _plan_item(item: dict[str, Any]) -> MissionItem:
    command = int(item["command"])
    params = [0.0 if value is None else float(value) for value in item["params"]]
    scale = 1e7 if command in PLACES else 1.0
    return MissionItem(
        command=command,
        frame=int(item["frame"]),
        param1=params[0],
        param2=params[1],
        param3=params[2],
        param4=params[3],
        x_e7=round(params[4] * scale),
        y_e7=round(params[5] * scale),
        z_m=params[6],
        autocontinue=int(bool(item.get("autoContinue", True))),
    )


# ArduCopter's modes by number, the phases of a flight, and what a flight has to tell.

AUTO: int = dialect.COPTER_MODE_AUTO
GUIDED: int = dialect.COPTER_MODE_GUIDED
LOITER: int = dialect.COPTER_MODE_LOITER
RTL: int = dialect.COPTER_MODE_RTL
LAND: int = dialect.COPTER_MODE_LAND
BRAKE: int = dialect.COPTER_MODE_BRAKE

MODE_NAMES: dict[int, str] = {
    dialect.COPTER_MODE_STABILIZE: "STABILIZE",
    dialect.COPTER_MODE_ALT_HOLD: "ALT_HOLD",
    AUTO: "AUTO",
    GUIDED: "GUIDED",
    LOITER: "LOITER",
    RTL: "RTL",
    LAND: "LAND",
    dialect.COPTER_MODE_POSHOLD: "POSHOLD",
    BRAKE: "BRAKE",
}

INFO: int = dialect.MAV_SEVERITY_INFO
WARNING: int = dialect.MAV_SEVERITY_WARNING
CRITICAL: int = dialect.MAV_SEVERITY_CRITICAL


class Phase(Enum):
    """What the vehicle does."""

    GROUND = "ground"
    CLIMB = "climb"
    ROUTE = "route"
    HOVER = "hover"
    DESCEND = "descend"


# `landed_state` of GCS_MAVLink_Copter.cpp.
LANDED_STATES: dict[Phase, int] = {
    Phase.GROUND: dialect.MAV_LANDED_STATE_ON_GROUND,
    Phase.CLIMB: dialect.MAV_LANDED_STATE_TAKEOFF,
    Phase.ROUTE: dialect.MAV_LANDED_STATE_IN_AIR,
    Phase.HOVER: dialect.MAV_LANDED_STATE_IN_AIR,
    Phase.DESCEND: dialect.MAV_LANDED_STATE_LANDING,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightEvent:
    """Something to tell: a text, an item that was reached, an action of the mission."""

    text: str = ""
    severity: int = INFO
    reached: int | None = None
    action: MissionItem | None = None
