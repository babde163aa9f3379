"""The mission items of one sortie, and what QGroundControl's loader and autopilots ask of them.

The rules of form are in `plan.schema.json` as well, for other programs. Here are also those that
a schema cannot say. Where the documentation and the loader differ, the loader counts: geoFence
and rallyPoints must be there, and null stands for any number.

Home is not among them: a plan has it apart, a waypoint file as its row 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

from missions.errors import PlanError
from missions.heights import raised
from missions.plan import Place, Plan, Settings, Sortie
from missions.stops import Stop, waypoints_of
from missions.terrain import Terrain

# ------------------------------------------------------------------------------- what a loader asks

Problems = Iterator[str]

ALTITUDE_KEYS = ("AltitudeMode", "Altitude", "AMSLAltAboveTerrain")
# Altitude modes that name a frame: relative to home, above sea, computed from terrain, terrain.
MODE_FRAMES = {1: 3, 2: 0, 3: 0, 4: 10}
PARAMS, DO_JUMP = 7, 177
# ArduPilot: 650 items in 16 kB of storage, home among them; PX4: 500, and 50 on small boards.
ITEMS_MAX = {"ardupilot": 649, "px4": 500}
RALLY_MAX = {"ardupilot": 46, "px4": 8}
FENCE_CORNERS_MAX = {"ardupilot": 70, "px4": 64}


def plan_problems(content: object) -> list[str]:
    """Return what keeps QGroundControl from loading a plan, each with its place; none is good."""
    return list(_plan(content))


def _plan(content: object) -> Problems:
    if not isinstance(content, dict):
        yield "it is not a JSON object"
        return
    if content.get("fileType") != "Plan":
        yield "fileType must be 'Plan'"
    if content.get("version") != 1 or isinstance(content.get("version"), bool):
        yield "version must be 1"
    if not isinstance(content.get("groundStation"), str):
        yield "groundStation must be a text"
    parts: dict[str, Callable[[dict[str, Any]], Problems]] = {
        "mission": _mission, "geoFence": _fence, "rallyPoints": _rally,
    }  # fmt: skip
    for name, check in parts.items():
        part = content.get(name)
        if isinstance(part, dict):
            yield from check(part)
        else:
            yield f"{name} must be an object"


def _mission(mission: dict[str, Any]) -> Problems:
    home = mission.get("plannedHomePosition")
    if not (_are_numbers(home, 3) and _is_place(home)):
        yield "mission.plannedHomePosition must be [latitude, longitude, altitude]"
    if not _is_whole(mission.get("firmwareType")):
        yield "mission.firmwareType must be a whole number"
    items = mission.get("items")
    if not isinstance(items, list) or not items:
        yield "mission.items must be a list with at least one item"
        return
    for number, item in enumerate(items, start=1):
        problems = _item(item) if isinstance(item, dict) else iter(["must be an object"])
        yield from (f"item {number}: {problem}" for problem in problems)
    yield from _jumps([item for item in items if isinstance(item, dict)])


def _jumps(items: list[dict[str, Any]]) -> Problems:
    marks = [item["doJumpId"] for item in items if "doJumpId" in item]
    if len(set(map(repr, marks))) < len(marks):
        yield "two items have one doJumpId"
    for number, item in enumerate(items, start=1):
        target = (item.get("params") or [None])[0] if item.get("command") == DO_JUMP else None
        if target is not None and target not in marks:
            yield f"item {number}: it jumps to {target}, and no item has that doJumpId"


def _item(item: dict[str, Any]) -> Problems:
    if item.get("type") != "SimpleItem":
        yield "type must be 'SimpleItem'"
        return
    for name in ("frame", "command"):
        if not _is_whole(item.get(name)):
            yield f"{name} must be a whole number"
    if not isinstance(item.get("autoContinue"), bool):
        yield "autoContinue must be true or false"
    params: Any = item.get("params")
    if not _are_numbers(params, PARAMS):
        yield f"params must be {PARAMS} numbers or null"
    elif item.get("frame") in MODE_FRAMES.values() and not _is_place(params[4:6]):
        yield f"{params[4]}, {params[5]} is not a place"
    yield from _altitude(item)


def _altitude(item: dict[str, Any]) -> Problems:
    there = [name for name in ALTITUDE_KEYS if name in item]
    if there and len(there) < len(ALTITUDE_KEYS):
        yield f"of {', '.join(ALTITUDE_KEYS)} there must be all or none"
    mode = item.get("AltitudeMode")
    if "AltitudeMode" in item and mode not in (0, 1, 2, 3, 4, 5):
        yield f"AltitudeMode {mode!r:.20} does not exist"
    elif mode in MODE_FRAMES and item.get("frame") != MODE_FRAMES[mode]:
        yield f"AltitudeMode {mode} belongs to frame {MODE_FRAMES[mode]}, not {item.get('frame')}"


def _fence(fence: dict[str, Any]) -> Problems:
    if fence.get("version") != 2:
        yield "geoFence.version must be 2, or the fence is silently ignored"
    for name, key in (("polygons", "polygon"), ("circles", "circle")):
        shapes = fence.get(name)
        if not isinstance(shapes, list):
            yield f"geoFence.{name} must be a list"
            continue
        for number, shape in enumerate(shapes, start=1):
            if not _is_shape(shape, key):
                yield f"geoFence.{name} {number} has no version 1, inclusion and {key}"


def _is_shape(shape: object, key: str) -> bool:
    if not isinstance(shape, dict) or shape.get("version") != 1:
        return False
    if not isinstance(shape.get("inclusion"), bool):
        return False
    body = shape.get(key)
    if key == "polygon":
        return (
            isinstance(body, list)
            and len(body) >= 3
            and all(_are_numbers(corner, 2) and _is_place(corner) for corner in body)
            and body[0] != body[-1]  # the ring is not closed
        )
    return (
        isinstance(body, dict)
        and _are_numbers(body.get("center"), 2)
        and _is_place(body["center"])
        and _is_number(body.get("radius"))
        and float(body["radius"]) > 0.0
    )


def _rally(rally: dict[str, Any]) -> Problems:
    if rally.get("version") != 2:
        yield "rallyPoints.version must be 2"
    points = rally.get("points")
    if not isinstance(points, list):
        yield "rallyPoints.points must be a list"
        return
    for number, point in enumerate(points, start=1):
        if not (_are_numbers(point, 3) and _is_place(point)):
            yield f"rally point {number} must be [latitude, longitude, height]"


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are_numbers(values: object, count: int) -> bool:
    """Return whether it is a list of so many numbers; null counts as one."""
    return (
        isinstance(values, list)
        and len(values) == count
        and all(value is None or _is_number(value) for value in values)
    )


def _is_place(values: Any) -> bool:
    """Return whether a list starts with a latitude and a longitude."""
    return (
        _is_number(values[0])
        and _is_number(values[1])
        and abs(values[0]) <= 90.0
        and abs(values[1]) <= 180.0
    )


# What autopilots have room for and take, looked at before a file is written.

NAMES = {"ardupilot": "ArduPilot", "px4": "PX4"}


def check_sprayer(plan: Plan, *, with_sprayer: bool) -> None:
    """Refuse items that the autopilot refuses."""
    if with_sprayer and plan.settings.autopilot == "px4":
        raise PlanError("PX4 takes no DO_SPRAYER; plan without --sprayer: valves follow the map")


def check_items(plan: Plan, sortie: Sortie, count: int) -> None:
    """Refuse a sortie with more items than the autopilot has room for."""
    autopilot = plan.settings.autopilot
    limit = ITEMS_MAX[autopilot]
    if not count <= limit:
        raise PlanError(
            f"sortie {sortie.number} has {count} items, and {NAMES[autopilot]} has room for "
            f"{limit}; fill the tank less (mission.tank_l), or allow more height error "
            "(mission.terrain_tolerance_m)"
        )


def check_content(plan: Plan, sortie: Sortie, content: dict[str, Any]) -> None:
    """Refuse a plan file that a ground station or the autopilot would not take."""
    autopilot = plan.settings.autopilot
    rally = len(content["rallyPoints"]["points"])
    if not rally <= RALLY_MAX[autopilot]:
        raise PlanError(
            f"{rally} depots are more rally points than {NAMES[autopilot]}'s "
            f"{RALLY_MAX[autopilot]}; plan with fewer (mission.depots)"
        )
    problems = plan_problems(content)
    if problems:
        raise PlanError(f"sortie {sortie.number} makes no plan that loads: {problems[0]}")


# ---------------------------------------------------------------------------------------- the items

WAYPOINT, RETURN_TO_LAUNCH, LAND, TAKEOFF, CHANGE_SPEED, SPRAYER = 16, 20, 21, 22, 178, 216
# MAV_FRAME_GLOBAL_RELATIVE_ALT: metres above home; MAV_FRAME_MISSION: no place at all.
RELATIVE, NO_PLACE = 3, 2
# MAV_FRAME_GLOBAL_TERRAIN_ALT: metres above the ground as the vehicle knows it; ArduPilot only.
ABOVE_GROUND = 10
GROUND_SPEED = 1.0


Autopilot = Literal["ardupilot", "px4"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """One item; None is a parameter that is left to the autopilot."""

    command: int
    frame: int
    params: tuple[float | None, float | None, float | None, float | None]
    latitude_deg: float = 0.0
    longitude_deg: float = 0.0
    altitude_m: float = 0.0

    @property
    def has_place(self) -> bool:
        """Return whether the item is somewhere."""
        return self.command in (WAYPOINT, LAND, TAKEOFF)


def items_of(plan: Plan, sortie: Sortie, *, with_sprayer: bool = False) -> tuple[Item, ...]:
    """Return take-off, speed, the way, and the return.

    Valves follow the map by position; `with_sprayer` adds DO_SPRAYER before and after each line
    as a belt, for ArduPilot, which alone takes it.

    Raises:
        PlanError: for what the autopilot would refuse.
    """
    check_sprayer(plan, with_sprayer=with_sprayer)
    stops = stops_of(
        sortie, plan.settings, plan.terrain, home=plan.depots[sortie.depot],
        with_sprayer=with_sprayer,
    )  # fmt: skip
    yaw_deg = _fixed_yaw(plan)
    speed_m_s = plan.settings.speed_m_s
    items = [_placed(plan, TAKEOFF, stops[0]), _speed(speed_m_s)]
    for stop in stops[1:]:
        if stop.speed_m_s != speed_m_s:
            speed_m_s = stop.speed_m_s
            items.append(_speed(speed_m_s))
        items.append(_placed(plan, WAYPOINT, stop, yaw_deg=yaw_deg))
        if with_sprayer and stop.opens is not None:
            items.append(
                Item(command=SPRAYER, frame=NO_PLACE, params=(float(stop.opens), 0.0, 0.0, 0.0))
            )
    if speed_m_s != plan.settings.speed_m_s:
        items.append(_speed(plan.settings.speed_m_s))
    items.append(Item(command=RETURN_TO_LAUNCH, frame=NO_PLACE, params=(0.0, 0.0, 0.0, 0.0)))
    return tuple(items)


def stops_of(
    sortie: Sortie,
    settings: Settings,
    terrain: Terrain | None,
    *,
    home: Place,
    with_sprayer: bool = False,
) -> list[Stop]:
    """Return the places of a sortie, with those that the ground under it needs."""
    stops = waypoints_of(sortie, apart=with_sprayer)
    if terrain is not None and not terrain.by_vehicle:
        return raised(stops, terrain, home=home, height_m=settings.height_m)
    return stops


def count_of(stops: Sequence[Stop], settings: Settings, *, with_sprayer: bool = False) -> int:
    """Return how many items a sortie of these stops has."""
    speeds = [settings.speed_m_s, *(stop.speed_m_s for stop in stops[1:]), settings.speed_m_s]
    changes = sum(one != other for one, other in pairwise(speeds))
    orders = sum(stop.opens is not None for stop in stops[1:]) if with_sprayer else 0
    # Take-off, which is the first stop, the speed before it, and the return.
    return len(stops) + 2 + changes + orders


def _speed(speed_m_s: float) -> Item:
    """Return the item that sets the speed of all ways after it."""
    return Item(
        command=CHANGE_SPEED, frame=NO_PLACE,
        params=(GROUND_SPEED, round(speed_m_s, 3), -1.0, 0.0),
    )  # fmt: skip


def _fixed_yaw(plan: Plan) -> float | None:
    """Return the yaw that a strafing aircraft keeps: along the inner lines."""
    if plan.settings.turn != "strafe":
        return None
    # The north is 360: a waypoint file has 0 where the yaw is left open.
    return plan.angle_deg % 360.0 or 360.0


def _placed(plan: Plan, command: int, stop: Stop, *, yaw_deg: float | None = None) -> Item:
    latitude_deg, longitude_deg = plan.frame.to_geographic(*stop.place)
    over_ground = plan.terrain is not None and plan.terrain.by_vehicle and command == WAYPOINT
    return Item(
        command=command,
        frame=ABOVE_GROUND if over_ground else RELATIVE,
        params=(0.0, 0.0, 0.0, yaw_deg),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=plan.settings.height_m if stop.height_m is None else stop.height_m,
    )
