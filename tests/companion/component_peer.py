"""The other end of a component: what an autopilot and a ground station say, and what it sent."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core.controller import Memory, step
from companion.link.component import Component, ComponentOptions
from tests import builders

VEHICLE = 7
SETUP = builders.setup()
OPEN, _ = step(SETUP, builders.SPRAYING, Memory(), 10.0)
CLOSED, _ = step(SETUP, None, Memory(), 10.0)


class Peer:
    """Encodes for an autopilot and a ground station, and reads what the component sent."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.is_up = True
        self._parser = mavlink.MAVLink(None)
        self._autopilot = mavlink.MAVLink(None, srcSystem=VEHICLE, srcComponent=1)
        self._ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

    def take(self, frame: bytes) -> bool:
        if self.is_up:
            self.sent.extend(self._parser.parse_buffer(frame) or [])
        return self.is_up

    def autopilot(self, name: str, *fields: Any, **more: Any) -> bytes:
        message = getattr(self._autopilot, f"{name}_encode")(*fields, **more)
        return bytes(message.pack(self._autopilot))

    def ground(self, name: str, *fields: Any) -> bytes:
        message = getattr(self._ground, f"{name}_encode")(*fields)
        return bytes(message.pack(self._ground))

    def heartbeat(self, autopilot: int = 3) -> bytes:
        return self.autopilot("heartbeat", 2, autopilot, 128, 3, 4)

    def position(self, boot_s: float) -> bytes:
        boot_ms = round(boot_s * 1000)
        return self.autopilot("global_position_int", boot_ms, 0, 0, 0, 0, 0, 0, 0, 0)

    def command(
        self,
        command: int,
        *params: float,
        system: int = VEHICLE,
        to: int = 191,
        confirmation: int = 0,
        sequence: int = 0,
    ) -> bytes:
        filled = (*params, *([0.0] * (7 - len(params))))
        self._ground.seq = sequence
        return self.ground("command_long", system, to, command, confirmation, *filled)

    def of(self, kind: str) -> list[Any]:
        return [message for message in self.sent if message.get_type() == kind]

    def texts(self) -> list[str]:
        return [message.text for message in self.of("STATUSTEXT")]

    def named(self, name: str) -> list[float]:
        return [m.value for m in self.of("NAMED_VALUE_FLOAT") if m.name == name]

    def asked(self) -> dict[int, float]:
        """Return the rate asked for, by message, of every SET_MESSAGE_INTERVAL so far."""
        commands = [m for m in self.of("COMMAND_LONG") if m.command == 511]
        return {int(m.param1): round(1e6 / m.param2, 3) for m in commands}


@pytest.fixture
def peer() -> Peer:
    return Peer()


@pytest.fixture
def component(peer: Peer) -> Component:
    return Component(ComponentOptions(), peer.take)


@pytest.fixture
def met(peer: Peer, component: Component) -> Component:
    """Return a component that knows its vehicle; what it sent so far is forgotten."""
    component.receive(peer.heartbeat(), 0.0)
    peer.sent.clear()
    return component


class UpAndDown:
    """A transport whose state the test sets."""

    speaker = None

    def adopt(self, speaker: object, now_s: float, *, is_vehicle: bool) -> None:
        """Do nothing: there is one other end."""

    def __init__(self, peer: Peer) -> None:
        self.is_up = True
        self._peer = peer

    def send(self, data: bytes) -> bool:
        return self.is_up and self._peer.take(data)

    async def close(self) -> None:
        self.is_up = False
