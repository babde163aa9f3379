"""The mission items of one sortie, as both file formats of ground stations hold them.

Home is not among them: a plan has it apart, a waypoint file as its row 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from missions.files.plan_rules import check_sprayer
from missions.heights import raised
from missions.plan import Place, Plan, Settings, Sortie
from missions.stops import Stop, waypoints_of
from missions.terrain import Terrain

WAYPOINT, RETURN_TO_LAUNCH, TAKEOFF, CHANGE_SPEED, SPRAYER = 16, 20, 22, 178, 216
# MAV_FRAME_GLOBAL_RELATIVE_ALT: metres above home; MAV_FRAME_MISSION: no place at all.
RELATIVE, NO_PLACE = 3, 2
# MAV_FRAME_GLOBAL_TERRAIN_ALT: metres above the ground as the vehicle knows it; ArduPilot only.
ABOVE_GROUND = 10
GROUND_SPEED = 1.0


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
        return self.command in (WAYPOINT, TAKEOFF)


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
