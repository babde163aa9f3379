"""The operator's refill reaches the tank's sensor, and detection's level with it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass

import pytest

from companion.cli.sensor_parts import TankSensor, follow_refills
from companion.core.options.flow_meter import Detection
from companion.core.types import FaultKind, Inhibit, TankReport
from companion.link.component import ComponentOptions
from companion.output.servo import ServoExecutor, ServoOptions
from companion.runtime import run
from tests import builders
from tests.companion.test_run_flight import CHANNELS, Notes
from tests.companion.wire_peer import WirePeer, over_wire
from tests.virtual_time import WireLink, now_s

pytestmark = [pytest.mark.sitl, pytest.mark.virtual_time]

REFILLED = 31011
SETUP = builders.setup(
    detection=Detection(spread=0.0125, closed_share=0.02, meter_minimum_l_min=0.5, reserve_l=1.0)
)


class Counter:
    """A meter that has counted nothing since the start."""

    def volume_ml(self) -> float:
        return 0.0


@dataclass
class Flight:
    peer: WirePeer
    notes: Notes

    @property
    def levels(self) -> list[float | None]:
        return [item.level_l for item in self.notes.inputs if isinstance(item, TankReport)]


@pytest.fixture
async def flight() -> AsyncIterator[Flight]:
    link = WireLink("udpin:127.0.0.1:14550", ComponentOptions(), clock=now_s)
    executor = ServoExecutor(ServoOptions(channels=CHANNELS), link.order)
    tank = TankSensor(Counter(), None, capacity_l=40.0, filled_l=0.9)
    follow_refills([tank], link)
    notes = Notes()
    task = asyncio.create_task(
        run(
            SETUP,
            link=link,
            executor=executor,
            recorder=notes,
            sensors=[tank],
            clock=now_s,
            boot_clock=now_s,
        )
    )
    async with over_wire(WirePeer(SETUP.frame, east_m=2.0), link) as peer:
        yield Flight(peer, notes)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_a_tank_at_its_reserve_sprays_again_after_the_refill(flight: Flight) -> None:
    peer, notes = flight.peer, flight.notes
    await peer.until(lambda: bool(peer.outputs))
    peer.enable()
    await notes.until(lambda decision: Inhibit.TANK_EMPTY in decision.inhibits)
    assert notes.decisions[-1].findings[-1].kind is FaultKind.TANK_LOW
    assert not peer.is_spraying
    assert flight.levels[-1] == 0.9
    peer.enable(False)
    peer.command_companion(REFILLED, 25.0)
    await notes.until(lambda decision: flight.levels[-1] == 25.0)
    peer.place(east_m=2.0)
    peer.enable()
    await peer.until(lambda: len(peer.open_channels) == 6)


@pytest.mark.parametrize("litres", [41.0, -1.0, float("nan"), float("inf")])
async def test_what_does_not_go_into_the_tank_is_denied_and_changes_nothing(
    flight: Flight, litres: float
) -> None:
    peer = flight.peer
    await peer.until(lambda: bool(peer.outputs))
    peer.command_companion(REFILLED, litres)
    await peer.until(
        lambda: any(ack.command == REFILLED and ack.result == 2 for ack in peer.of("COMMAND_ACK"))
    )
    assert flight.levels[-1] == 0.9
