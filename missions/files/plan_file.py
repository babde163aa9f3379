"""QGroundControl's `.plan`: one sortie, with the field as its fence and the depots as rally points.

What the loader needs beyond its documentation: `geoFence` and `rallyPoints` must be there, a
simple item has exactly seven parameters, and of `Altitude`, `AltitudeMode` and
`AMSLAltAboveTerrain` all or none.
"""

from __future__ import annotations

import json
from typing import Any

import shapely
from shapely.geometry.polygon import orient

from missions.files.items import Item, items_of
from missions.plan import Plan, Sortie

ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT
COPTER = 2  # MAV_TYPE_QUADROTOR
RELATIVE_TO_HOME = 1
# Autopilots store few points of a fence; its edge may lie so much outside the field.
FENCE_OUT_M, FENCE_SIMPLER_M = 2.0, 0.5
DIGITS = 9


def plan_text(
    plan: Plan, sortie: Sortie, *, with_sprayer: bool = False, with_fence: bool = True
) -> str:
    """Return the content of the file."""
    home = plan.frame.to_geographic(*plan.depots[sortie.depot])
    items = items_of(plan, sortie, with_sprayer=with_sprayer)
    content = {
        "fileType": "Plan",
        "geoFence": _fence(plan) if with_fence else _no_fence(),
        "groundStation": "vrspray",
        "mission": {
            "cruiseSpeed": plan.settings.speed_m_s,
            "firmwareType": ARDUPILOT,
            "globalPlanAltitudeMode": RELATIVE_TO_HOME,
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
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


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
            "AltitudeMode": RELATIVE_TO_HOME,
        }
    return found


def _no_fence() -> dict[str, Any]:
    return {"circles": [], "polygons": [], "version": 2}


def _fence(plan: Plan) -> dict[str, Any]:
    """Return where the aircraft must stay: around the field and its depots, off its obstacles."""
    ferries = [
        shapely.LineString(leg.points).buffer(FENCE_OUT_M)
        for sortie in plan.sorties
        for leg in sortie.legs
        if leg.kind == "ferry"
    ]
    inside = shapely.union_all([plan.field.outline, *ferries])
    keep_in = shapely.get_parts(inside.buffer(FENCE_OUT_M).simplify(FENCE_SIMPLER_M))
    if len(keep_in) > 1:  # several inclusions would each forbid the others
        keep_in = shapely.get_parts(inside.convex_hull.buffer(FENCE_OUT_M))
    blocked = plan.field.blocked.buffer(-FENCE_SIMPLER_M).simplify(FENCE_SIMPLER_M / 2.0)
    polygons = [_polygon(plan, part, inclusion=True) for part in keep_in]
    polygons += [
        _polygon(plan, part, inclusion=False)
        for part in shapely.get_parts(blocked)
        if not part.is_empty
    ]
    return {"circles": [], "polygons": polygons, "version": 2}


def _polygon(plan: Plan, part: shapely.Polygon, *, inclusion: bool) -> dict[str, Any]:
    ring = shapely.get_coordinates(orient(part, sign=-1.0).exterior)[:-1]
    places = [_rounded(plan.frame.to_geographic(*point)) for point in ring.tolist()]
    return {"inclusion": inclusion, "polygon": places, "version": 1}
