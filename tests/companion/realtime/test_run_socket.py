"""`run` over sockets, in real time: what opens, is lost and comes back; the rest of a flight is in
`test_run_flight.py`.
"""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator

import pytest

from companion.core.types import Inhibit
from companion.errors import LinkError
from companion.output.servo import REORDER_S
from companion.runtime import execute, run
from tests.companion.realtime.udp_router import a_way
from tests.companion.test_overtaken_orders import Swapping
from tests.companion.test_run_flight import SETUP, Companion, Flight, Scribe
from tests.companion.wire_peer import TcpHost, WirePeer, free_port, over_udp

pytestmark = pytest.mark.sitl


@pytest.fixture
async def flight() -> AsyncIterator[Flight]:
    """Yield a companion that has just begun, beside a vehicle that flies over the field."""
    port = free_port()
    companion = Companion(f"udpin:127.0.0.1:{port}")
    companion.start()
    async with over_udp(WirePeer(SETUP.frame, east_m=2.0), port) as peer:
        yield Flight(companion, peer)
        if companion.task is not None and not companion.task.done():
            companion.task.cancel()
        await asyncio.gather(companion.task, return_exceptions=True)  # type: ignore[arg-type]


async def test_the_heartbeat_is_heard_before_the_vehicle_says_anything() -> None:
    port = free_port()
    loop = asyncio.get_running_loop()
    heard: asyncio.Future[bytes] = loop.create_future()

    class Ear(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, addr: object) -> None:
            if not heard.done():
                heard.set_result(data)

    ear, _ = await loop.create_datagram_endpoint(Ear, local_addr=("127.0.0.1", port))
    companion = Companion(f"udpout:127.0.0.1:{port}")
    companion.start(duration_s=0.3)
    async with asyncio.timeout(1.0):
        frame = await heard
    ear.close()
    assert (frame[5], frame[6]) == (1, 191)
    assert await companion.result() == 0


async def test_it_sprays_over_udp_and_a_second_one_is_refused_the_port(flight: Flight) -> None:
    await flight.until_spraying()
    second = Companion(flight.companion.link._url)
    second.start()
    with pytest.raises(LinkError, match="in use"):
        await second.result()
    assert second.executor.order_count == 0
    flight.peer.enable(False)
    await flight.peer.until(lambda: flight.peer.is_all_closed)


async def test_orders_that_overtake_each_other_on_the_way_leave_no_valve_open() -> None:
    """As on Wi-Fi: an order to open waits up to 0.09 s, behind one to close that left later."""
    port = free_port()
    _, _, east_m, _ = SETUP.prescription.bounds_m
    companion = Companion(f"udpin:127.0.0.1:{port}")
    companion.start()
    peer = WirePeer(SETUP.frame, east_m=2.0)
    async with a_way(port) as (vehicle, ours):
        way = Swapping(vehicle)
        ours.take = way.deliver
        async with over_udp(peer, vehicle.transport.get_extra_info("sockname")[1]):
            await peer.until(lambda: len(peer.outputs) == 6)
            for number in range(6):
                # Refreshes have another place in each crossing: six valves take turns in a second.
                peer.place(east_m=east_m - 9.0 - 0.37 * number)
                peer.enable()
                await peer.until(lambda: len(peer.open_channels) == 6)
                await peer.until(lambda: peer.is_all_closed)
                beats = len(peer.of("HEARTBEAT"))
                await peer.until(lambda beats=beats: len(peer.of("HEARTBEAT")) >= beats + 2)
                peer.enable(False)
    companion.task.cancel()  # type: ignore[union-attr]
    await asyncio.gather(companion.task, return_exceptions=True)  # type: ignore[arg-type]
    # Its refresh alone would close it up to a second later.
    assert way.stayed_open_s <= 3.0 * REORDER_S


async def test_a_lost_tcp_link_closes_and_comes_back_closed_first() -> None:
    peer = WirePeer(SETUP.frame, east_m=2.0)
    host = TcpHost(peer)
    await host.listen()
    companion = Companion(f"tcp:127.0.0.1:{host.port}")
    companion.start()
    await host.connected.wait()
    peer.begin()
    flight = Flight(companion, peer)
    await flight.until_spraying()
    await host.hang_up()
    await companion.notes.until(lambda d: Inhibit.LINK_LOST in d.inhibits)
    assert companion.notes.decisions[-1].plan.is_off
    count = len(peer.orders)
    await host.connected.wait()
    await peer.until(lambda: len(peer.orders) >= count + 6)
    assert [order.pulse_us for order in peer.orders[count : count + 6]] == [1000] * 6
    await peer.until(lambda: peer.is_spraying)
    os.kill(os.getpid(), signal.SIGTERM)
    assert await companion.result() == 0
    assert peer.is_all_closed
    await peer.end()
    await host.close()


def test_the_precise_loop_runs_it_and_gives_the_result_back() -> None:
    scribe = Scribe()
    assert execute(lambda: run(SETUP, link=scribe, executor=scribe, duration_s=0.01)) == 0
    assert scribe.calls[-2:] == ["stop", "close"]
