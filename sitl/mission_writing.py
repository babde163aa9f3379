"""Mission files for simulated flights: QGC WPL 110 and QGroundControl's plan.

What `stub/mission_file.py` reads; home comes first, as ArduPilot numbers it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sitl.stub.mission_items import PLACES, MissionItem
from sitl.stub.protocol import dialect

CRUISE_M_S, HOVER_M_S = 5.0, 5.0
ARDUPILOT, COPTER = 3, 2  # MAV_AUTOPILOT_ARDUPILOTMEGA, MAV_TYPE_QUADROTOR
OPEN_YAW = (dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_TAKEOFF, dialect.MAV_CMD_NAV_LAND)
ABSOLUTE = 0  # MAV_FRAME_GLOBAL: the frame of home


def place_of(item: MissionItem) -> tuple[float, float]:
    """Return latitude and longitude as files have them; 0 for an item without a place."""
    if item.command not in PLACES:
        return 0.0, 0.0
    return round(item.latitude_deg, 7), round(item.longitude_deg, 7)


def waypoint_lines(items: tuple[MissionItem, ...]) -> list[str]:
    """Return the lines of a QGC WPL 110 file."""
    lines = ["QGC WPL 110"]
    for number, item in enumerate(items):
        latitude_deg, longitude_deg = place_of(item)
        columns = [
            number,
            int(number == 0),
            item.frame if number else ABSOLUTE,
            item.command,
            *(f"{value:g}" for value in (item.param1, item.param2, item.param3, item.param4)),
            f"{latitude_deg:.7f}",
            f"{longitude_deg:.7f}",
            f"{item.z_m:g}",
            item.autocontinue,
        ]
        lines.append("\t".join(str(column) for column in columns))
    return lines


def plan(items: tuple[MissionItem, ...]) -> dict[str, Any]:
    """Return the content of QGroundControl's plan."""
    home = [*place_of(items[0]), items[0].z_m]
    return {
        "fileType": "Plan",
        "geoFence": {"circles": [], "polygons": [], "version": 2},
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": CRUISE_M_S,
            "firmwareType": ARDUPILOT,
            "globalPlanAltitudeMode": 1,
            "hoverSpeed": HOVER_M_S,
            "items": [_simple(number, item) for number, item in enumerate(items) if number],
            "plannedHomePosition": home,
            "vehicleType": COPTER,
            "version": 2,
        },
        "rallyPoints": {"points": [], "version": 2},
        "version": 1,
    }


def _simple(number: int, item: MissionItem) -> dict[str, Any]:
    place = place_of(item)
    heights = {"AMSLAltAboveTerrain": None, "Altitude": item.z_m, "AltitudeMode": 1}
    # A yaw of 0 is the north to PX4; null leaves it to the autopilot.
    yaw_deg = item.param4 if item.param4 or item.command not in OPEN_YAW else None
    return {
        **(heights if item.command in PLACES else {}),
        "autoContinue": bool(item.autocontinue),
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame,
        "params": [item.param1, item.param2, item.param3, yaw_deg, *place, item.z_m],
        "type": "SimpleItem",
    }


def write_mission(items: tuple[MissionItem, ...], folder: Path) -> None:
    """Write `mission.waypoints` and `mission.plan` into a folder."""
    lines = "\n".join(waypoint_lines(items)) + "\n"
    (folder / "mission.waypoints").write_text(lines, encoding="utf-8")
    text = json.dumps(plan(items), indent=1) + "\n"
    (folder / "mission.plan").write_text(text, encoding="utf-8")
