"""From the items of a mission to the leg that is flown, and whether it ends in a stop.

Where the items leave that open it is taken not to: a stop that is foreseen and not made misplaces
a change, one that is not foreseen is seen by the positions a moment later.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from companion.core.types import LegReport
from companion.link.mission_messages import MissionItem

# MAV_CMD. Numbers below 95 are flown to or waited at, the rest is done on the way.
_WAYPOINT, _LOITER_UNLIMITED, _LOITER_TIME, _LAND, _TAKE_OFF = 16, 17, 19, 21, 22
_HOME, _SPLINE_WAYPOINT = 20, 82
_NAVIGATION_END = 95
_CHANGE_SPEED, _JUMP = 178, 177
_STRAIGHT_TO = frozenset({_WAYPOINT, _LOITER_UNLIMITED, _LOITER_TIME, _LAND})
_STRAIGHT_FROM = frozenset({_WAYPOINT, _LOITER_UNLIMITED, _LOITER_TIME, _TAKE_OFF})
# A copter that is not told to wait flies through a bend; one as sharp as this it brakes for: each
# leg is a ramp down to its end, and the next one's first acceleration leads across.
_STOPS_FROM_DEG = 60.0
# A leg lies on another as near as one lies along a line (`core.lines`), and is shorter by a width
# of that: two over the same line, there and back, are none the other's part.
_ON_M = 0.5
_LONGER_M = 1.0
_DEG_M = 111_320.0  # a degree of latitude, to 0.6 % everywhere

Place = tuple[float, float]


def leg_report(items: Sequence[MissionItem], sequence: int, received_s: float) -> LegReport | None:
    """Return the straight leg to item `sequence`; None where there is none, or none is known."""
    number = _next_flown(items, sequence)
    if number is None:
        return None
    before = _flown_before(items, number)
    if items[number].command == _HOME and before is not None:
        return _homewards(items[before].place, received_s)
    if items[number].command not in _STRAIGHT_TO:
        return None
    start, end = (None if before is None else items[before].place), items[number].place
    if start is None or end is None:
        return None
    return LegReport(
        received_s=received_s,
        from_latitude_deg=start[0],
        from_longitude_deg=start[1],
        to_latitude_deg=end[0],
        to_longitude_deg=end[1],
        stops=_stops(items, number, start, end),
        speed_m_s=_speed_m_s(items, number),
        longer=_longer(items, start, end),
    )


def _longer(items: Sequence[MissionItem], start: Place, end: Place) -> tuple[Place, Place] | None:
    """Return the shortest other leg on which that from `start` to `end` lies whole; None: none.

    In metres on a plane about `start`: legs are short beside the Earth.
    """
    east_deg_m = _DEG_M * math.cos(math.radians(start[0]))
    end_m = ((end[1] - start[1]) * east_deg_m, (end[0] - start[0]) * _DEG_M)
    least_m = math.hypot(*end_m) + _LONGER_M
    found: tuple[float, tuple[Place, Place]] | None = None
    for before, after in _legs(items):
        x0, y0 = (before[1] - start[1]) * east_deg_m, (before[0] - start[0]) * _DEG_M
        x1, y1 = (after[1] - start[1]) * east_deg_m, (after[0] - start[0]) * _DEG_M
        length_m = math.hypot(x1 - x0, y1 - y0)
        if not length_m >= least_m or (found is not None and length_m >= found[0]):
            continue
        ux, uy = (x1 - x0) / length_m, (y1 - y0) / length_m
        for x, y in ((0.0, 0.0), end_m):
            along = (x - x0) * ux + (y - y0) * uy
            if not (
                -_ON_M <= along <= length_m + _ON_M and abs(ux * (y - y0) - uy * (x - x0)) <= _ON_M
            ):
                break
        else:
            found = (length_m, (before, after))
    return None if found is None else found[1]


def _legs(items: Sequence[MissionItem]) -> Iterator[tuple[Place, Place]]:
    """Yield all straight legs between two places, one after the other."""
    start: Place | None = None
    for item in items:
        if item.command >= _NAVIGATION_END or (item.command == _TAKE_OFF and item.place is None):
            continue
        if start is not None and item.place is not None and item.command in _STRAIGHT_TO:
            yield start, item.place
        start = item.place if item.command in _STRAIGHT_FROM else None


def _homewards(place: tuple[float, float] | None, received_s: float) -> LegReport | None:
    """Return a leg without length where the way home begins: no line of the mission is flown."""
    if place is None:
        return None
    return LegReport(
        received_s=received_s,
        from_latitude_deg=place[0],
        from_longitude_deg=place[1],
        to_latitude_deg=place[0],
        to_longitude_deg=place[1],
        stops=False,
    )


def _next_flown(items: Sequence[MissionItem], first: int) -> int | None:
    for number in range(max(first, 0), len(items)):
        if items[number].command < _NAVIGATION_END:
            return number
    return None


def _flown_before(items: Sequence[MissionItem], number: int) -> int | None:
    """Return the item that the leg to `number` begins at; take-offs may have no place."""
    for before in range(number - 1, -1, -1):
        command = items[before].command
        if command == _TAKE_OFF and items[before].place is None:
            continue
        if command < _NAVIGATION_END:
            return before if command in _STRAIGHT_FROM else None
    return None


def _stops(
    items: Sequence[MissionItem], number: int, start: tuple[float, float], end: tuple[float, float]
) -> bool:
    item = items[number]
    if item.command != _WAYPOINT or (item.param1 or 0.0) > 0.0:
        return True
    following = _next_flown(items, number + 1)
    between = items[number + 1 : following]
    if any(one.command == _JUMP for one in between):
        return False
    if following is None or items[following].command not in (_WAYPOINT, _LAND):
        # Nothing follows, or the way home. A curve (a spline) is flown into without a stop.
        return following is None or items[following].command != _SPLINE_WAYPOINT
    after = items[following].place
    if after is None:
        return items[following].command == _LAND
    return _bend_deg(start, end, after) >= _STOPS_FROM_DEG


def _bend_deg(
    start: tuple[float, float], end: tuple[float, float], after: tuple[float, float]
) -> float:
    """Return the change of course at `end`; 180 where the next place is the same."""
    shrink = math.cos(math.radians(end[0]))
    north, east = end[0] - start[0], (end[1] - start[1]) * shrink
    next_north, next_east = after[0] - end[0], (after[1] - end[1]) * shrink
    if not math.hypot(next_north, next_east) > 1e-8:
        return 180.0
    cross = north * next_east - east * next_north
    return abs(math.degrees(math.atan2(cross, north * next_north + east * next_east)))


def _speed_m_s(items: Sequence[MissionItem], number: int) -> float | None:
    """Return the speed that was last set before an item."""
    for item in reversed(items[:number]):
        if item.command == _CHANGE_SPEED and (item.param2 or 0.0) > 0.0:
            return item.param2
    return None
