"""Reads the mission once, and says on which leg of it the vehicle is.

The whole mission is asked for item by item when it is first heard of, when it has changed, and now
and then: paced, asked again, given up in the end. Only while the vehicle is disarmed, as ArduPilot
sends all streams at a quarter of their rate during a transfer, and never beside somebody else's.
Pure but for what it remembers; time is an argument.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.core.types import LegReport
from companion.link.encode import Encoder
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
_REFRESH_S = 30.0
_ACCEPTED, _CANCELLED = 0, 15  # MAV_MISSION_RESULT
_NO_TOTAL = 65535
_NEVER_S = float("-inf")


class MissionReader:
    """Implements the reading of one vehicle's mission; does nothing unless it is used."""

    def __init__(
        self,
        encoder: Encoder,
        send: Callable[[bytes], bool],
        warn: Callable[[str], None],
        *,
        is_used: bool,
    ) -> None:
        self._encoder, self._send, self._warn = encoder, send, warn
        self.is_used = is_used
        self._quiet_until_s = self._pause_until_s = self._known_s = _NEVER_S
        self.meet(0)

    def meet(self, system_id: int) -> None:
        """Take the vehicle, at the start and after a reboot: what was known of it may be old."""
        self._vehicle = system_id
        self._total: int | None = None
        self._forget()

    @property
    def items(self) -> tuple[MissionItem, ...] | None:
        """Return the mission; None while it is not known."""
        return self._items

    def take(self, message: MissionCurrent | MissionTransfer) -> tuple[LegReport, ...]:
        """Take what was heard; a MISSION_CURRENT gives the leg that is flown."""
        if not self.is_used:
            return ()
        if isinstance(message, MissionTransfer):
            self._take_transfer(message)
            return ()
        if message.total != self._total:
            self._forget()
            self._total = message.total
        if self._items is None or not message.is_flown:
            return ()
        leg = leg_report(self._items, message.sequence, message.received_s)
        return () if leg is None else (leg,)

    def tick(self, now_s: float, *, is_armed: bool) -> None:
        """Ask for what is due."""
        if not self.is_used or self._total is None or self._total == _NO_TOTAL:
            return
        if is_armed or now_s < self._quiet_until_s:
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

    def _forget(self) -> None:
        self._items: tuple[MissionItem, ...] | None = None
        self._is_given_up = False
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
            self._give_up("mission cannot be read")
            return
        self._asked_s, self._is_waiting = now_s, True
        if self._count is None:
            self._lists += 1
            self._send(self._encoder.mission_request_list())
        else:
            self._tries += 1
            self._send(self._encoder.mission_request(len(self._read)))

    def _give_up(self, why: str) -> None:
        """Try no more, and use no mission, until there is another one."""
        self._forget()
        self._is_given_up = True
        self._warn(why)

    def _take_transfer(self, message: MissionTransfer) -> None:
        own = (self._encoder.system_id, self._encoder.component_id)
        is_ours = (message.target_system, message.target_component) == own
        if not (is_ours and message.system_id == self._vehicle):
            self._stand_back(message)
        elif not self._is_waiting:
            return
        elif message.step is MissionStep.COUNT and self._count is None:
            self._take_count(message.number, message.received_s)
        elif message.step is MissionStep.ITEM and self._count is not None:
            if message.number == len(self._read) and message.item is not None:
                self._take_item(message.item, message.received_s)
        elif message.step is MissionStep.ENDED:  # refused
            self._begin_anew()
            self._pause_until_s = message.received_s + _QUIET_S

    def _stand_back(self, message: MissionTransfer) -> None:
        """Leave the wire to somebody else; what he writes is not what we know."""
        self._quiet_until_s = message.received_s + _QUIET_S
        if message.step is MissionStep.UPLOAD:
            self._forget()

    def _take_count(self, count: int, now_s: float) -> None:
        if count > ITEMS_MAX:
            self._send(self._encoder.mission_ack(_CANCELLED))
            self._give_up(f"mission of {count} items is not used")
            return
        self._count, self._is_waiting = count, False
        if count == 0:
            self._finish(now_s)

    def _take_item(self, item: MissionItem, now_s: float) -> None:
        self._read.append(item)
        self._tries, self._is_waiting = 0, False
        if len(self._read) == self._count:
            self._finish(now_s)

    def _finish(self, now_s: float) -> None:
        self._send(self._encoder.mission_ack(_ACCEPTED))
        self._items, self._known_s = tuple(self._read), now_s
        self._lists = 0
        self._begin_anew()
