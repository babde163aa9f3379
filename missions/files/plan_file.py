"""QGroundControl's `.plan`: one sortie, with the field as its fence and the depots as rally points.

What the loader needs beyond its documentation: `geoFence` and `rallyPoints` must be there, a
simple item has exactly seven parameters, and of `Altitude`, `AltitudeMode` and
`AMSLAltAboveTerrain` all or none.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from missions.files.fence import Fences, fence_content
from missions.files.items import ABOVE_GROUND, RELATIVE, Item, items_of
from missions.files.limits import check_content, check_items
from missions.plan import Plan, Sortie

FIRMWARES = {"ardupilot": 3, "px4": 12}  # MAV_AUTOPILOT
COPTER = 2  # MAV_TYPE_QUADROTOR
# By frame: heights above home, absolute, and above the ground as the vehicle knows it.
ALTITUDE_MODES = {RELATIVE: 1, 0: 2, ABOVE_GROUND: 4}
DIGITS = 9


def plan_text(
    plan: Plan, sortie: Sortie, *, with_sprayer: bool = False, fences: Fences | None = None
) -> str:
    """Return the content of the file; `fences` are those of the plan, where they are at hand."""
    fence = (fences or Fences(plan)).of(sortie)
    home = plan.frame.to_geographic(*plan.depots[sortie.depot])
    items = items_of(plan, sortie, with_sprayer=with_sprayer)
    check_items(plan, sortie, len(items))
    content = {
        "fileType": "Plan",
        "geoFence": fence_content(plan, fence),
        "groundStation": "vrspray",
        "mission": {
            "cruiseSpeed": plan.settings.speed_m_s,
            "firmwareType": FIRMWARES[plan.settings.autopilot],
            "globalPlanAltitudeMode": _mode_of_all(items),
            "hoverSpeed": plan.settings.speed_m_s,
            "items": [_simple(number, item) for number, item in enumerate(items, start=1)],
            "plannedHomePosition": [*_rounded(home), 0.0],
            "vehicleType": COPTER,
            "version": 2,
        },
        "rallyPoints": {
            "points": [[*_rounded(plan.frame.to_geographic(*depot)), 0.0] for depot in plan.depots],
            "version": 2,
        },
        "version": 1,
    }
    check_content(plan, sortie, content)
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _mode_of_all(items: Sequence[Item]) -> int:
    """Return the one altitude mode of a plan; 0 where they are mixed."""
    modes = {ALTITUDE_MODES[item.frame] for item in items if item.has_place}
    return modes.pop() if len(modes) == 1 else 0


def _rounded(place: tuple[float, float]) -> list[float]:
    return [round(place[0], DIGITS), round(place[1], DIGITS)]


def _simple(number: int, item: Item) -> dict[str, Any]:
    place = _rounded((item.latitude_deg, item.longitude_deg))
    found: dict[str, Any] = {
        "autoContinue": True,
        "command": item.command,
        "doJumpId": number,
        "frame": item.frame,
        "params": [*item.params, *place, item.altitude_m],
        "type": "SimpleItem",
    }
    if item.has_place:
        found |= {
            "AMSLAltAboveTerrain": None,
            "Altitude": item.altitude_m,
            "AltitudeMode": ALTITUDE_MODES[item.frame],
        }
    return found
