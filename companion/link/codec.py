"""Bytes to our types, from whom they count; nothing here does any I/O."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from companion.link.census import AUTOPILOT_COMPONENT, Census, Vehicle
from companion.link.decode import FROM_ANYONE, FROM_VEHICLE
from companion.link.framer import Accept, Framer
from companion.link.messages import CommandReceived, Message
from companion.link.signing import RADIO_STATUS

_HEARTBEAT = 0
_SENDERS_MAX = 64
# So many frames in a row that seem overtaken, and their sender has begun to count anew.
_ANEW = 32

__all__ = ["AUTOPILOT_COMPONENT", "Codec", "Vehicle"]


class _Sequence:
    """Counts the frames of one sender, and those that its numbers say are missing."""

    __slots__ = ("_behind", "_counts", "count", "last", "lost")

    def __init__(self) -> None:
        self.count, self.lost, self.last = 0, 0, -1
        self._behind, self._counts = 0, False

    def take(self, number: int) -> bool:
        """Count a frame; return whether it was overtaken or sent twice: half the circle ahead.

        A sender whose numbers never move (a script) sends nothing late.
        """
        self.count += 1
        ahead = 0 if self.last < 0 else (number - self.last - 1) % 256
        self._counts = self._counts or (self.last >= 0 and number != self.last)
        is_late = ahead >= 128 and self._counts
        self._behind = self._behind + 1 if is_late else 0
        if is_late and self._behind < _ANEW:
            return True
        self.lost += ahead if ahead < 128 else 0
        self.last = number
        return is_late


class Codec:
    """Decodes a byte stream; remembers the first autopilot it hears and believes no other.

    `system_id` 0 takes the first autopilot; another number waits for that one.
    """

    def __init__(self, *, system_id: int = 0, accept: Accept | None = None) -> None:
        self.census = Census(system_id)
        self._framer = Framer(accept)
        self._senders: dict[tuple[int, int], _Sequence] = {}
        self.vehicle_counts: dict[int, int] = {}
        self.ignored_count = 0
        # Frames that show who speaks from an address; a radio's report is signed by nobody.
        self.named_frame_count = 0
        self.vehicle_frame_count = 0
        self.byte_count = 0

    @property
    def vehicle(self) -> Vehicle | None:
        """Return the autopilot that the link belongs to; None before it was heard."""
        return self.census.vehicle

    @property
    def frame_count(self) -> int:
        """Return how many valid frames came in, from whomever."""
        return self._framer.frame_count

    @property
    def dropped_byte_count(self) -> int:
        """Return how many bytes belonged to no valid frame."""
        return self._framer.dropped_byte_count

    @property
    def bad_frame_count(self) -> int:
        """Return how many frames had a wrong checksum; a false start in noise counts as one."""
        return self._framer.bad_frame_count

    @property
    def refused_frame_count(self) -> int:
        """Return how many sound frames had no good signature."""
        return self._framer.refused_frame_count

    @property
    def lost_frames(self) -> dict[tuple[int, int], tuple[int, int]]:
        """Return frames that came and frames that are missing, by (system, component).

        Gaps are normal behind a router that does not pass everything on.
        """
        return {sender: (one.count, one.lost) for sender, one in self._senders.items()}

    def is_autopilot(self, system_id: int, component_id: int) -> bool:
        """Whether a sender is the vehicle's autopilot, the only one who speaks for the vehicle.

        A camera or a gimbal of the same system may say what it likes.
        """
        vehicle = self.vehicle
        return vehicle is not None and (system_id, component_id) == (
            vehicle.system_id,
            AUTOPILOT_COMPONENT,
        )

    def decode(self, data: bytes, received_s: float) -> list[Message]:
        """Return what `data` completes, in its order; never raises."""
        self.byte_count += len(data)
        messages = []
        for raw in self._framer.push(data, received_s):
            message = self._understand(raw, received_s)
            if message is not None:
                messages.append(message)
        return messages

    def _understand(self, raw: Any, received_s: float) -> Message | None:
        sender = (raw.get_srcSystem(), raw.get_srcComponent())
        is_late = self._count(sender, raw.get_seq())
        message_id: int = raw.get_msgId()
        if message_id == _HEARTBEAT:
            self.census.heartbeat(*sender, kind=raw.type, autopilot=raw.autopilot, now_s=received_s)
        if message_id != RADIO_STATUS:
            self.named_frame_count += 1
            if self.vehicle is not None and sender[0] == self.vehicle.system_id:
                self.vehicle_frame_count += 1
        if message_id in FROM_ANYONE:
            message = FROM_ANYONE[message_id](raw, received_s)
            if is_late and isinstance(message, CommandReceived):
                return replace(message, is_late=True)
            return message
        if not self.is_autopilot(*sender):
            self.ignored_count += 1
            return None
        self.vehicle_counts[message_id] = self.vehicle_counts.get(message_id, 0) + 1
        decoder = FROM_VEHICLE.get(message_id)
        return None if decoder is None else decoder(raw, received_s)

    def _count(self, sender: tuple[int, int], number: int) -> bool:
        """Count a frame of a sender; return whether it comes late."""
        one = self._senders.get(sender)
        if one is None:
            if len(self._senders) >= _SENDERS_MAX:
                return False
            one = self._senders[sender] = _Sequence()
        return one.take(number)
