"""What stands between two ends of a UDP link: a router, or a way that may hold datagrams up.

A router of one UDP port, for three parties and more on one link, is as mavlink-router is one.

Who sends to the port is an end, and is known by the (system, component) that it was heard with.
What is for everybody goes to every other end; what is for one goes where that one was heard.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from sitl.stub.protocol import Listener, sender, target

Address = tuple[str, int]


class UdpRouter(asyncio.DatagramProtocol):
    """Passes frames on as they came, byte by byte."""

    def __init__(self) -> None:
        self.port = 0
        self.heard: dict[Address, set[tuple[int, int]]] = {}
        self._listeners: dict[Address, Listener] = {}
        self._transport: Any = None

    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Address) -> None:
        listener = self._listeners.setdefault(addr, Listener())
        heard = self.heard.setdefault(addr, set())
        for message in listener.messages(data):
            heard.add(sender(message))
            for end in self._ends_for(*target(message)):
                if end != addr:
                    self._transport.sendto(bytes(message.get_msgbuf()), end)

    def _ends_for(self, system: int, component: int) -> list[Address]:
        return [
            end
            for end, heard in self.heard.items()
            if system == 0 or any(one[0] == system and component in (0, one[1]) for one in heard)
        ]


@asynccontextmanager
async def udp_router() -> AsyncIterator[UdpRouter]:
    """Run a router on a free port of this machine."""
    transport, router = await asyncio.get_running_loop().create_datagram_endpoint(
        UdpRouter, local_addr=("127.0.0.1", 0)
    )
    try:
        yield router
    finally:
        transport.close()


class End(asyncio.DatagramProtocol):
    """One end of a way: hands on what it hears, and answers who spoke last."""

    def __init__(self) -> None:
        self.take: Callable[[bytes], None] = lambda data: None
        self.speaker: Address | None = None
        self.transport: Any = None

    def connection_made(self, transport: Any) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self.speaker = addr
        self.take(data)

    def feed(self, data: bytes) -> None:
        if not self.transport.is_closing():
            self.transport.sendto(data, self.speaker)


@asynccontextmanager
async def a_way(port: int) -> AsyncIterator[tuple[End, End]]:
    """Yield the vehicle's and the companion's end of a way to a companion at `port`."""
    loop = asyncio.get_running_loop()
    _, vehicle = await loop.create_datagram_endpoint(End, local_addr=("127.0.0.1", 0))
    _, companion = await loop.create_datagram_endpoint(End, remote_addr=("127.0.0.1", port))
    vehicle.take, companion.take = companion.transport.sendto, vehicle.feed
    try:
        yield vehicle, companion
    finally:
        vehicle.transport.close()
        companion.transport.close()
