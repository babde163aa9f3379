"""QGroundControl's `.plan`: one sortie, with the field as its fence and the depots as rally points.

What the loader needs beyond its documentation: `geoFence` and `rallyPoints` must be there, a
simple item has exactly seven parameters, and of `Altitude`, `AltitudeMode` and
`AMSLAltAboveTerrain` all or none.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import shapely
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from missions.files.items import ABOVE_GROUND, RELATIVE, Item, items_of
from missions.files.limits import check_content, corners_max
from missions.plan import Plan, Sortie

FIRMWARES = {"ardupilot": 3, "px4": 12}  # MAV_AUTOPILOT
COPTER = 2  # MAV_TYPE_QUADROTOR
# By frame: heights above home, absolute, and above the ground as the vehicle knows it.
ALTITUDE_MODES = {RELATIVE: 1, 0: 2, ABOVE_GROUND: 4}
# The fence lies so much outside the field, at least. Autopilots store few points of it: it is drawn
# simpler until they have room, obstacles by less than their buffer.
FENCE_OUT_M, FENCE_SIMPLER_M, OBSTACLE_LESS_M = 1.0, (0.5, 1.0, 2.0, 4.0, 8.0), 1.0
FERRY_M = 2.0
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


def _no_fence() -> dict[str, Any]:
    return {"circles": [], "polygons": [], "version": 2}


def _fence(plan: Plan) -> dict[str, Any]:
    """Return where the aircraft must stay: around the field and its depots, off its obstacles."""
    around = plan.field.outline.buffer(FENCE_SIMPLER_M[0])
    shapely.prepare(around)
    outside = [
        shapely.LineString(leg.points).buffer(FERRY_M)
        for sortie in plan.sorties
        for leg in sortie.legs
        if leg.kind != "spray" and not shapely.covers(around, shapely.LineString(leg.points))
    ]
    inside = shapely.union_all([plan.field.outline, *outside])
    polygons: list[dict[str, Any]] = []
    for simpler_m in FENCE_SIMPLER_M:
        polygons = _polygons(plan, inside, simpler_m)
        if sum(len(polygon["polygon"]) for polygon in polygons) <= corners_max(plan):
            break
    return {"circles": [], "polygons": polygons, "version": 2}


def _polygons(plan: Plan, inside: BaseGeometry, simpler_m: float) -> list[dict[str, Any]]:
    """Return a fence whose edges are drawn so much simpler: wider outside, obstacles smaller."""
    # A ring is simplified once along it and once at its start: it moves by twice that at most.
    wider_m = FENCE_OUT_M + 2.0 * simpler_m
    keep_in = shapely.get_parts(inside.buffer(wider_m).simplify(simpler_m))
    if len(keep_in) > 1:  # several inclusions would each forbid the others
        keep_in = shapely.get_parts(inside.convex_hull.buffer(wider_m))
    less_m = min(simpler_m, OBSTACLE_LESS_M)
    blocked = plan.field.blocked.buffer(-less_m).simplify(less_m / 2.0)
    polygons = [_polygon(plan, part, inclusion=True) for part in keep_in]
    polygons += [
        _polygon(plan, part, inclusion=False)
        for part in shapely.get_parts(blocked)
        if not part.is_empty
    ]
    return polygons


def _polygon(plan: Plan, part: shapely.Polygon, *, inclusion: bool) -> dict[str, Any]:
    ring = shapely.get_coordinates(orient(part, sign=-1.0).exterior)[:-1]
    places = [_rounded(plan.frame.to_geographic(*point)) for point in ring.tolist()]
    return {"inclusion": inclusion, "polygon": places, "version": 1}
