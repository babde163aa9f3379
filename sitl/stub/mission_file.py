"""Mission files: QGC WPL 110 (`.waypoints`) and QGroundControl's plan (`.plan`).

Both begin with home, as ArduPilot numbers it: item 0 of a waypoint file, `plannedHomePosition`
of a plan.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from companion.errors import ConfigError
from sitl.stub.mission_items import FLOWN, PLACES, MissionItem
from sitl.stub.protocol import dialect

_HEADER = "QGC WPL 110"


def read_mission(path: Path) -> tuple[MissionItem, ...]:
    """Return the items of a mission file, home first."""
    try:
        text = path.read_text(encoding="utf-8")
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
    items = []
    for number, line in enumerate(lines[1:], start=2):
        fields = line.split()
        if not fields:
            continue
        try:
            items.append(_waypoint_item(fields))
        except (ValueError, OverflowError) as error:
            raise ConfigError(f"{path}: line {number}: {error}") from error
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
