"""From the items of a mission to what is flown: a take-off, legs, and how it ends."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from sitl.earth import Earth
from sitl.stub.mission_items import ABSOLUTE_FRAMES, ACTIONS, MissionItem
from sitl.stub.parameters import SPEED_MAX_M_S, SPEED_MIN_M_S
from sitl.stub.protocol import dialect
from sitl.vehicle import Leg

# A waypoint farther away than this is a mistake of the test, or a place that the frame has not.
FAR_M = 100_000.0
# Two places nearer than this are one.
SAME_PLACE_M = 0.01


class Ending(Enum):
    """What comes after the last leg."""

    HOVER = "hover"
    LAND = "land"


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """The legs with the number of the item that each one flies to."""

    take_off_height_m: float | None
    height_m: float | None
    legs: tuple[Leg, ...]
    sequences: tuple[int, ...]
    ending: Ending


def starts_with_take_off(items: tuple[MissionItem, ...]) -> bool:
    """Return whether the first item that flies is a take-off (item 0 is home)."""
    for item in items[1:]:
        if item.command not in ACTIONS:
            return bool(item.command == dialect.MAV_CMD_NAV_TAKEOFF)
    return False


def home_leg(speed_m_s: float) -> Leg:
    """Return the way home, which is the origin of the frame."""
    return Leg(east_m=0.0, north_m=0.0, speed_m_s=speed_m_s, kind="transit")


def plan_flight(
    items: tuple[MissionItem, ...],
    frame: Earth,
    *,
    first_sequence: int,
    speed_m_s: float,
    home_altitude_m: float,
    zero_is_a_place: bool = False,
) -> FlightPlan:
    """Return what is flown from the item `first_sequence` on.

    The whole route keeps one height, that of its lowest waypoint: the lines', where ferries are
    higher. To PX4, 0, 0 is a place
    (`zero_is_a_place`), and it flies off towards it.
    """
    take_off_height_m: float | None = None
    height_m: float | None = None
    legs: list[Leg] = []
    sequences: list[int] = []
    ending = Ending.HOVER
    for sequence, item in enumerate(items):
        if (
            item.command == dialect.MAV_CMD_DO_CHANGE_SPEED
            and SPEED_MIN_M_S <= item.param2 <= SPEED_MAX_M_S
        ):
            speed_m_s = item.param2
        if sequence < max(first_sequence, 1) or item.command in ACTIONS:
            continue
        item_height_m = item.z_m - (home_altitude_m if item.frame in ABSOLUTE_FRAMES else 0.0)
        if item.command == dialect.MAV_CMD_NAV_TAKEOFF:
            take_off_height_m = item_height_m
            continue
        leg = _leg(item, frame, speed_m_s, zero_is_a_place=zero_is_a_place)
        if leg is not None and not _ends_there(item, leg, legs):
            legs.append(leg)
            sequences.append(sequence)
        if item.command != dialect.MAV_CMD_NAV_WAYPOINT:
            ending = Ending.LAND
            break
        height_m = item_height_m if height_m is None else min(item_height_m, height_m)
    return FlightPlan(
        take_off_height_m=take_off_height_m,
        height_m=height_m,
        legs=tuple(legs),
        sequences=tuple(sequences),
        ending=ending,
    )


def _ends_there(item: MissionItem, leg: Leg, before: list[Leg]) -> bool:
    """Return whether an item lands where the last leg ends: no way leads there."""
    if item.command != dialect.MAV_CMD_NAV_LAND or not before:
        return False
    last = before[-1]
    return math.hypot(leg.east_m - last.east_m, leg.north_m - last.north_m) < SAME_PLACE_M


def _leg(item: MissionItem, frame: Earth, speed_m_s: float, *, zero_is_a_place: bool) -> Leg | None:
    """Return the way to an item's place; none for an item without one."""
    if item.command == dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH:
        return home_leg(speed_m_s)
    if not item.has_place:
        return _leg_to_zero(frame, speed_m_s) if zero_is_a_place else None
    east_m, north_m = frame.to_local(item.latitude_deg, item.longitude_deg)
    if not math.hypot(east_m, north_m) < FAR_M:
        return None
    return Leg(east_m=east_m, north_m=north_m, speed_m_s=speed_m_s, kind="spray")


def _leg_to_zero(frame: Earth, speed_m_s: float) -> Leg:
    """Return the way towards latitude 0, longitude 0, as far as the local frame goes."""
    latitude, longitude = math.radians(frame.latitude_deg), math.radians(frame.longitude_deg)
    course = math.atan2(-math.sin(longitude), -math.sin(latitude) * math.cos(longitude))
    return Leg(
        east_m=FAR_M * math.sin(course),
        north_m=FAR_M * math.cos(course),
        speed_m_s=speed_m_s,
        kind="transit",
    )
