"""Bytes to our types, and which sender is the vehicle; nothing here does any I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from companion.link.decode import FROM_ANYONE, FROM_VEHICLE
from companion.link.framer import Framer
from companion.link.messages import Message
from companion.link.modes import ARDUPILOT, PX4

_HEARTBEAT = 0
AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
_AUTOPILOT_INVALID = 8
# MAV_TYPE of what is no vehicle although some of them claim an autopilot: antenna tracker, ground
# station, onboard controller, gimbal, ADS-B, camera.
_NO_VEHICLE = frozenset({5, 6, 18, 26, 27, 30})


@dataclass(frozen=True, slots=True, kw_only=True)
class Vehicle:
    """The autopilot that the link belongs to."""

    system_id: int
    autopilot: int

    @property
    def is_ardupilot(self) -> bool:
        """Whether it runs ArduPilot."""
        return self.autopilot == ARDUPILOT

    @property
    def is_px4(self) -> bool:
        """Whether it runs PX4."""
        return self.autopilot == PX4


class Codec:
    """Decodes a byte stream; remembers the first autopilot it hears and believes no other.

    `system_id` 0 takes the first autopilot; another number waits for that one.
    """

    def __init__(self, *, system_id: int = 0) -> None:
        self._wanted_system_id = system_id
        self._framer = Framer()
        self.vehicle: Vehicle | None = None
        self.vehicle_counts: dict[int, int] = {}
        self.ignored_count = 0

    @property
    def frame_count(self) -> int:
        """Return how many valid frames came in, from whomever."""
        return self._framer.frame_count

    @property
    def dropped_byte_count(self) -> int:
        """Return how many bytes belonged to no valid frame."""
        return self._framer.dropped_byte_count

    def decode(self, data: bytes, received_s: float) -> list[Message]:
        """Return what `data` completes, in its order; never raises."""
        messages = []
        for raw in self._framer.push(data, received_s):
            message = self._understand(raw, received_s)
            if message is not None:
                messages.append(message)
        return messages

    def _understand(self, raw: Any, received_s: float) -> Message | None:
        message_id: int = raw.get_msgId()
        if message_id in FROM_ANYONE:
            return FROM_ANYONE[message_id](raw, received_s)
        if message_id == _HEARTBEAT and self.vehicle is None:
            self._latch(raw)
        if not self._is_from_vehicle(raw):
            self.ignored_count += 1
            return None
        self.vehicle_counts[message_id] = self.vehicle_counts.get(message_id, 0) + 1
        decoder = FROM_VEHICLE.get(message_id)
        return None if decoder is None else decoder(raw, received_s)

    def _latch(self, heartbeat: Any) -> None:
        """Take the sender for the vehicle if it is an autopilot; never the first that speaks."""
        system_id = heartbeat.get_srcSystem()
        if (
            heartbeat.get_srcComponent() == AUTOPILOT_COMPONENT
            and heartbeat.autopilot != _AUTOPILOT_INVALID
            and heartbeat.type not in _NO_VEHICLE
            and system_id != 0
            and self._wanted_system_id in (0, system_id)
        ):
            self.vehicle = Vehicle(system_id=system_id, autopilot=heartbeat.autopilot)

    def _is_from_vehicle(self, raw: Any) -> bool:
        return (
            self.vehicle is not None
            and raw.get_srcComponent() == AUTOPILOT_COMPONENT
            and raw.get_srcSystem() == self.vehicle.system_id
        )
