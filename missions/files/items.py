"""The mission items of one sortie, as both file formats of ground stations hold them.

Home is not among them: a plan has it apart, a waypoint file as its row 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from missions.plan import Place, Plan, Sortie

WAYPOINT, RETURN_TO_LAUNCH, TAKEOFF, CHANGE_SPEED, SPRAYER = 16, 20, 22, 178, 216
# MAV_FRAME_GLOBAL_RELATIVE_ALT: metres above home; MAV_FRAME_MISSION: no place at all.
RELATIVE, NO_PLACE = 3, 2
GROUND_SPEED = 1.0
# Waypoints closer than this to the one before say nothing new: a border goes on in its next line.
SAME_M = 0.6
SAME_SEEN_M = 0.05


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
    """
    settings = plan.settings
    places = waypoints_of(sortie, apart=with_sprayer)
    yaw_deg = _fixed_yaw(plan)
    first = places[0][0]
    items = [
        _placed(plan, TAKEOFF, first),
        Item(
            command=CHANGE_SPEED, frame=NO_PLACE,
            params=(GROUND_SPEED, settings.speed_m_s, -1.0, 0.0),
        ),
    ]  # fmt: skip
    for place, opens in places[1:]:
        items.append(_placed(plan, WAYPOINT, place, yaw_deg=yaw_deg))
        if with_sprayer and opens is not None:
            items.append(
                Item(command=SPRAYER, frame=NO_PLACE, params=(float(opens), 0.0, 0.0, 0.0))
            )
    items.append(Item(command=RETURN_TO_LAUNCH, frame=NO_PLACE, params=(0.0, 0.0, 0.0, 0.0)))
    return tuple(items)


def _fixed_yaw(plan: Plan) -> float | None:
    """Return the yaw that a strafing aircraft keeps: along the inner lines."""
    return plan.angle_deg % 360.0 if plan.settings.turn == "strafe" else None


def waypoints_of(sortie: Sortie, *, apart: bool = False) -> list[tuple[Place, bool | None]]:
    """Return the places of a sortie from the depot on, and whether a line begins or ends there.

    Where one line goes on in the next, their ends are one place in the middle, unless `apart`.
    The way back to the depot is left to the return, but for its bends.
    """
    places: list[tuple[Place, bool | None]] = []
    legs = sortie.legs
    places.append((legs[0].points[0], None))
    for number, leg in enumerate(legs):
        if leg.kind == "spray":
            _add(places, leg.points[0], True, apart=apart)
            _add(places, leg.points[-1], False, apart=apart)
            continue
        is_last = number == len(legs) - 1
        for place in leg.points[1:-1]:
            places.append((place, None))
        if is_last:
            break
    return places


def _add(
    places: list[tuple[Place, bool | None]], place: Place, opens: bool, *, apart: bool
) -> None:
    near_m = SAME_SEEN_M if apart else SAME_M
    last, opened = places[-1]
    if opens and opened is False and math.dist(last, place) < near_m and not apart:
        middle = ((last[0] + place[0]) / 2.0, (last[1] + place[1]) / 2.0)
        places[-1] = (middle, None)
        return
    places.append((place, opens))


def _placed(plan: Plan, command: int, place: Place, *, yaw_deg: float | None = None) -> Item:
    latitude_deg, longitude_deg = plan.frame.to_geographic(*place)
    return Item(
        command=command,
        frame=RELATIVE,
        params=(0.0, 0.0, 0.0, yaw_deg),
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=plan.settings.height_m,
    )
