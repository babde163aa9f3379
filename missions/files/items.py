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
    stops = waypoints_of(sortie, apart=with_sprayer)
    yaw_deg = _fixed_yaw(plan)
    speed_m_s = plan.settings.speed_m_s
    items = [_placed(plan, TAKEOFF, stops[0].place), _speed(speed_m_s)]
    for stop in stops[1:]:
        if stop.speed_m_s != speed_m_s:
            speed_m_s = stop.speed_m_s
            items.append(_speed(speed_m_s))
        items.append(_placed(plan, WAYPOINT, stop.place, yaw_deg=yaw_deg))
        if with_sprayer and stop.opens is not None:
            items.append(
                Item(command=SPRAYER, frame=NO_PLACE, params=(float(stop.opens), 0.0, 0.0, 0.0))
            )
    if speed_m_s != plan.settings.speed_m_s:
        items.append(_speed(plan.settings.speed_m_s))
    items.append(Item(command=RETURN_TO_LAUNCH, frame=NO_PLACE, params=(0.0, 0.0, 0.0, 0.0)))
    return tuple(items)


def _speed(speed_m_s: float) -> Item:
    """Return the item that sets the speed of all ways after it."""
    return Item(
        command=CHANGE_SPEED, frame=NO_PLACE,
        params=(GROUND_SPEED, round(speed_m_s, 3), -1.0, 0.0),
    )  # fmt: skip


def _fixed_yaw(plan: Plan) -> float | None:
    """Return the yaw that a strafing aircraft keeps: along the inner lines."""
    return plan.angle_deg % 360.0 if plan.settings.turn == "strafe" else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """A place of the way, the speed of the way to it, and whether a line begins or ends there."""

    place: Place
    speed_m_s: float
    opens: bool | None = None


def waypoints_of(sortie: Sortie, *, apart: bool = False) -> list[Stop]:
    """Return the places of a sortie from the depot on.

    Where one line goes on in the next, their ends are one place in the middle, unless `apart`;
    where the speed changes inside a line, there is a place and nothing closes.
    The way back to the depot is left to the return, but for its bends.
    """
    legs = sortie.legs
    stops = [Stop(place=legs[0].points[0], speed_m_s=legs[0].speed_m_s)]
    for number, leg in enumerate(legs):
        if leg.kind == "spray":
            goes_on = legs[number - 1].kind == "spray"
            ends = number + 1 == len(legs) or legs[number + 1].kind != "spray"
            if not goes_on:
                _add(stops, leg.points[0], legs[number - 1].speed_m_s, apart=apart)
            stops.append(
                Stop(place=leg.points[-1], speed_m_s=leg.speed_m_s, opens=False if ends else None)
            )
            continue
        stops += [Stop(place=place, speed_m_s=leg.speed_m_s) for place in leg.points[1:-1]]
    return stops


def _add(stops: list[Stop], place: Place, speed_m_s: float, *, apart: bool) -> None:
    """Add the start of a line; one that the last line goes on in is already there."""
    last = stops[-1]
    if last.opens is False and math.dist(last.place, place) < SAME_M and not apart:
        middle = ((last.place[0] + place[0]) / 2.0, (last.place[1] + place[1]) / 2.0)
        stops[-1] = Stop(place=middle, speed_m_s=last.speed_m_s)
        return
    stops.append(Stop(place=place, speed_m_s=speed_m_s, opens=True))


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
