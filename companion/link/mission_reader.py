"""Reads the mission once, and says on which leg of it the vehicle is.

The whole mission is asked for item by item when the vehicle is met, when the mission has changed,
and now and then: paced, asked again, given up in the end. Never beside somebody else's transfer,
and only while the vehicle is disarmed, as ArduPilot sends all streams at a quarter of their rate
meanwhile. Where nothing may open as long as the leg is not known that costs nothing: then it is
read in flight too. Pure but for what it remembers; time is an argument.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.core.types import LegReport
from companion.link.census import AUTOPILOT_COMPONENT
from companion.link.encode import Encoder
from companion.link.mission_asker import MissionAsker
from companion.link.mission_legs import leg_report
from companion.link.mission_messages import (
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
