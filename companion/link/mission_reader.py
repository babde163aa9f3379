"""Reads the mission once, and says on which leg of it the vehicle is.

The whole mission is asked for item by item when the vehicle is met, when the mission has changed,
and now and then: paced, asked again, given up in the end. Never beside somebody else's transfer,
and only while the vehicle is disarmed, as ArduPilot sends all streams at a quarter of their rate
meanwhile. Where nothing may open as long as the leg is not known that costs nothing: then it is
read in flight too. Pure but for what it remembers; time is an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from companion.core.frame import METRES_PER_DEGREE
from companion.core.types import LegReport
from companion.link.census import AUTOPILOT_COMPONENT
from companion.link.encode import Encoder
from companion.link.messages import (
    MissionCurrent,
    MissionItem,
    MissionStep,
    MissionTransfer,
)

ITEMS_MAX = 2000
_PACE_S = 0.05
_AGAIN_S = 1.5
_TRIES = 5
# After somebody else's transfer, and after a refusal, the wire is left alone for this long.
_QUIET_S = 3.0
# A mission of as many items may have taken the place of the one that was read: nobody tells us.
# So long, too, until one that could not be read is tried again, where nothing opens without it.
_REFRESH_S = 30.0
_ACCEPTED, _CANCELLED = 0, 15  # MAV_MISSION_RESULT
_NO_TOTAL = 65535
_NEVER_S = float("-inf")


class MissionReader:
    """Implements the reading of one vehicle's mission; does nothing unless it is used.

    `is_needed`: all stays closed where the mission is flown and its leg is not known.
    """

    def __init__(
        self,
        encoder: Encoder,
        send: Callable[[bytes], bool],
        warn: Callable[[str], None],
        *,
        is_used: bool,
        is_needed: bool = False,
    ) -> None:
        self._encoder, self._send, self._warn = encoder, send, warn
        self.is_used, self._is_needed = is_used, is_needed
        self._asker = MissionAsker(encoder)
        self._current: MissionCurrent | None = None
        self._quiet_until_s = self._known_s = _NEVER_S
        self.meet(0)

    def meet(self, system_id: int, *, is_streamed: bool = True) -> None:
        """Take the vehicle, at the start and after a reboot: what was known of it may be old.

        `is_streamed`: it sends MISSION_CURRENT as often as it is asked to. 0 is no vehicle yet.
        """
        self._vehicle = system_id
        self._total: int | None = None
        self._warned = ""
        self._asker.meet(is_streamed=is_streamed)
        self._forget()

    @property
    def items(self) -> tuple[MissionItem, ...] | None:
        """Return the mission; None while it is not known."""
        return self._items

    def take(self, message: MissionCurrent | MissionTransfer) -> tuple[LegReport, ...]:
        """Take what was heard; a MISSION_CURRENT gives the leg, and so does the last item read."""
        if not self.is_used:
            return ()
        if isinstance(message, MissionTransfer):
            was_known = self._items is not None
            self._take_transfer(message)
            return () if was_known else self._leg()
        self._asker.heard(message.received_s)
        self._take_total(message.total)
        self._current = message
        return self._leg()

    def answered(self, result: int) -> None:
        """Take the acknowledgement of a request for one message."""
        self._asker.answered(result)

    def tick(self, now_s: float, *, is_armed: bool, flies_mission: bool = False) -> None:
        """Ask for what is due; `flies_mission`: it is in the mode that flies the mission."""
        if not self.is_used or self._vehicle == 0:
            return
        request = self._asker.due(now_s)
        if request is not None:
            self._send(request)
        if self._total == _NO_TOTAL:
            return
        in_flight = self._is_needed and flies_mission and self._items is None
        if (is_armed and not in_flight) or now_s < self._quiet_until_s:
            self._begin_anew()
            self._lists = 0
            return
        if self._is_given_up or now_s < self._pause_until_s:
            return
        if self._items is not None and now_s - self._known_s < _REFRESH_S:
            return
        if now_s - self._asked_s >= (_AGAIN_S if self._is_waiting else _PACE_S):
            self._ask(now_s)

    # ------------------------------------------------------------------------------- inside

    def _leg(self) -> tuple[LegReport, ...]:
        """Return the leg to the item that was last said to be flown to."""
        current = self._current
        if self._items is None or current is None or not current.is_flown:
            return ()
        leg = leg_report(self._items, current.sequence, current.received_s)
        return () if leg is None else (leg,)

    def _take_total(self, total: int) -> None:
        """Take of how many items the mission is said to be; of another number it is another."""
        if self._total is None:
            self._is_given_up, self._pause_until_s = False, _NEVER_S
            known = self._count if self._items is None else len(self._items)
            # ArduPilot does not count home; 0 is not told.
            is_same = known is None or total in (known, known - 1, 0)
        else:
            is_same = total == self._total
        self._total = total
        if not is_same:
            self._warned = ""
            self._forget()

    def _forget(self) -> None:
        self._items: tuple[MissionItem, ...] | None = None
        self._current = None
        self._is_given_up = False
        self._pause_until_s = _NEVER_S
        self._lists = 0
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Put away what was read so far."""
        self._read: list[MissionItem] = []
        self._count: int | None = None
        self._asked_s = _NEVER_S
        self._tries = 0
        self._is_waiting = False

    def _ask(self, now_s: float) -> None:
        """Ask for the number of items, or for the next item."""
        if self._tries >= _TRIES:
            self._begin_anew()
        if self._count is None and self._lists >= _TRIES:
            self._give_up("mission cannot be read", now_s)
            return
        self._asked_s, self._is_waiting = now_s, True
        if self._count is None:
            self._lists += 1
            self._send(self._encoder.mission_request_list())
        else:
            self._tries += 1
            self._send(self._encoder.mission_request(len(self._read)))

    def _give_up(self, why: str, now_s: float) -> None:
        """Use no mission until there is another one; where one is needed try again some time."""
        self._forget()
        if self._is_needed:
            self._pause_until_s = now_s + _REFRESH_S
        else:
            self._is_given_up = True
        if why != self._warned:
            self._warned = why
            self._warn(why)
            if self._is_needed:
                self._warn("valves stay closed while it is flown")

    def _take_transfer(self, message: MissionTransfer) -> None:
        own = (self._encoder.system_id, self._encoder.component_id)
        is_ours = (message.target_system, message.target_component) == own
        is_autopilot = (message.system_id, message.component_id) == (
            self._vehicle,
            AUTOPILOT_COMPONENT,
        )
        if is_ours and not is_autopilot:
            return  # nobody else has a mission of the vehicle to give
        if not is_ours:
            if is_autopilot or self._is_to_vehicle(message):
                self._stand_back(message)
        elif not self._is_waiting:
            return
        elif message.step is MissionStep.COUNT and self._count is None:
            self._take_count(message.number, message.received_s)
        elif message.step is MissionStep.ITEM and self._count is not None:
            if message.number == len(self._read) and message.item is not None:
                self._take_item(message.item, message)
        elif message.step is MissionStep.ENDED:  # refused
            self._begin_anew()
            self._pause_until_s = message.received_s + _QUIET_S

    def _is_to_vehicle(self, message: MissionTransfer) -> bool:
        """Whether its autopilot takes a message for its own; other vehicles' missions are not."""
        return message.target_system in (0, self._vehicle) and message.target_component in (
            0,
            AUTOPILOT_COMPONENT,
        )

    def _stand_back(self, message: MissionTransfer) -> None:
        """Leave the wire to somebody else; what he writes is not what we know."""
        self._quiet_until_s = message.received_s + _QUIET_S
        if message.step is MissionStep.UPLOAD:
            self._forget()

    def _take_count(self, count: int, now_s: float) -> None:
        if count > ITEMS_MAX:
            self._send(self._encoder.mission_ack(_CANCELLED))
            self._give_up(f"mission of {count} items is not used", now_s)
            return
        self._count, self._is_waiting = count, False
        if count == 0:
            self._finish(now_s)

    def _take_item(self, item: MissionItem, message: MissionTransfer) -> None:
        now_s = message.received_s
        if message.is_current and self._current is None:
            # Nobody has said yet where the vehicle is in it; with the next item it says so.
            self._current = MissionCurrent(received_s=now_s, sequence=message.number, total=0)
        self._read.append(item)
        self._tries, self._is_waiting = 0, False
        if len(self._read) == self._count:
            self._finish(now_s)

    def _finish(self, now_s: float) -> None:
        self._send(self._encoder.mission_ack(_ACCEPTED))
        self._items, self._known_s = tuple(self._read), now_s
        self._lists, self._warned = 0, ""
        self._begin_anew()


# Asks which item of the mission is flown, where an autopilot does not stream that.
#
# PX4 says it at a change and every ten seconds, and refuses it as a stream. Whether it answers a
# request for one message was not tried on the firmware: the first refusal ends the asking, and so
# do a few requests in vain. Pure but for what it remembers; time is an argument.

_MISSION_CURRENT, _REQUEST_MESSAGE = 42, 512
# What the message is said to come at where it is streamed (common.xml: nominally at 1 Hz).
_EVERY_S = 1.0
_MISSION_TRIES = 3
# The wire may have been down for all of them.
_MISSION_AGAIN_S = 30.0
_REFUSED = frozenset({2, 3, 4})  # MAV_RESULT denied, unsupported, failed


class MissionAsker:
    """Says when to ask for a MISSION_CURRENT; nothing where they are streamed."""

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self.meet(is_streamed=True)

    def meet(self, *, is_streamed: bool) -> None:
        """Take another vehicle, or one that has forgotten us."""
        self._is_over = is_streamed
        self._tries = 0
        self._asked_s = self._heard_s = _NEVER_S

    def heard(self, now_s: float) -> None:
        """Take a MISSION_CURRENT, asked for or not."""
        if now_s - self._asked_s < _EVERY_S:
            self._tries = 0
        self._heard_s = now_s

    def answered(self, result: int) -> None:
        """Take the acknowledgement of a request."""
        self._is_over = self._is_over or result in _REFUSED

    def due(self, now_s: float) -> bytes | None:
        """Return a request, where one is due."""
        if self._is_over or now_s - max(self._heard_s, self._asked_s) < _EVERY_S:
            return None
        if self._tries >= _MISSION_TRIES and now_s - self._asked_s < _MISSION_AGAIN_S:
            return None
        self._tries = self._tries % _MISSION_TRIES + 1
        self._asked_s = now_s
        return self._encoder.command(_REQUEST_MESSAGE, float(_MISSION_CURRENT))


# From the items of a mission to the leg that is flown, and whether it ends in a stop.
#
# Where the items leave that open it is taken not to: a stop that is foreseen and not made misplaces
# a change, one that is not foreseen is seen by the positions a moment later.

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
    east_deg_m = METRES_PER_DEGREE * math.cos(math.radians(start[0]))
    end_m = ((end[1] - start[1]) * east_deg_m, (end[0] - start[0]) * METRES_PER_DEGREE)
    least_m = math.hypot(*end_m) + _LONGER_M
    found: tuple[float, tuple[Place, Place]] | None = None
    for before, after in _legs(items):
        x0, y0 = (before[1] - start[1]) * east_deg_m, (before[0] - start[0]) * METRES_PER_DEGREE
        x1, y1 = (after[1] - start[1]) * east_deg_m, (after[0] - start[0]) * METRES_PER_DEGREE
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
