"""The stub over real sockets on loopback, with a client of a few lines on the other side."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from companion.errors import LinkError
from sitl.stub.protocol import Listener, Speaker, dialect
from sitl.stub.server import StubOptions, StubServer, build_autopilot
from tests.companion.wire_peer import free_port
from tests.sitl.stub_bench import HOME

pytestmark = pytest.mark.sitl

POSITION = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT


def stub(*urls: str) -> StubServer:
    autopilot = build_autopilot(StubOptions(home=HOME), start_s=time.monotonic())
    return StubServer(autopilot, urls)


class Client(asyncio.DatagramProtocol):
    """Hears everything; an event is set for each message that arrives."""

    def __init__(self, component: int = 191) -> None:
        self.messages: list[Any] = []
        self.send: Callable[[bytes], None] = lambda _frame: None
        self._speaker = Speaker(1, component)
        self._listener = Listener()
        self._arrived = asyncio.Event()
        self._transport: asyncio.DatagramTransport | None = None

    def connection_made(self, transport: Any) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        transport = self._transport
        assert transport is not None
        self.send = lambda frame: transport.sendto(frame, addr)
        self.take(data)

    def take(self, data: bytes) -> None:
        self.messages += self._listener.messages(data)
        self._arrived.set()

    def say(self, message: Any) -> None:
        self.send(self._speaker.frame(message))

    def command(self, command: int, *params: float) -> None:
        padded = [*params, *([0.0] * (7 - len(params)))]
        self.say(dialect.MAVLink_command_long_message(1, 1, command, 0, *padded))

    async def hear(self, kind: str, *, count: int = 1, within_s: float = 5.0) -> Any:
        """Wait for the next `count` messages of a kind and return the last."""
        start = len(self.messages)
        async with asyncio.timeout(within_s):
            while True:
                found = [m for m in self.messages[start:] if m.get_type() == kind]
                if len(found) >= count:
                    return found[-1]
                self._arrived.clear()
                await self._arrived.wait()


@asynccontextmanager
async def udp_client(
    *, local: int | None = None, remote: int | None = None
) -> AsyncIterator[Client]:
    loop = asyncio.get_running_loop()
    transport, client = await loop.create_datagram_endpoint(
        Client,
        local_addr=("127.0.0.1", local) if local else None,
        remote_addr=("127.0.0.1", remote) if remote else None,
    )
    if remote:
        client.send = transport.sendto
    try:
        yield client
    finally:
        transport.close()


@asynccontextmanager
async def tcp_client(port: int) -> AsyncIterator[Client]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    client = Client()
    client.send = writer.write

    async def listen() -> None:
        while data := await reader.read(4096):
            client.take(data)

    task = asyncio.create_task(listen())
    try:
        yield client
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        writer.close()
        await writer.wait_closed()


async def ask_and_hear(client: Client) -> None:
    """A heartbeat comes unasked, a command is acknowledged, a stream comes when asked for."""
    client.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, POSITION, 50_000)
    ack = await client.hear("COMMAND_ACK")
    assert (ack.result, ack.target_system, ack.target_component) == (0, 1, 191)
    await client.hear("GLOBAL_POSITION_INT", count=5)


async def test_the_stub_reaches_a_client_that_waits_on_udp() -> None:
    port = free_port()
    async with udp_client(local=port) as client, stub(f"udpout:127.0.0.1:{port}"):
        await client.hear("HEARTBEAT")
        assert {m.get_type() for m in client.messages} == {"HEARTBEAT"}
        await ask_and_hear(client)


async def test_the_stub_may_be_there_before_its_client() -> None:
    port = free_port()
    async with stub(f"udpout:127.0.0.1:{port}"), udp_client(local=port) as client:
        await client.hear("HEARTBEAT")


async def test_clients_come_to_a_stub_that_waits_on_udp() -> None:
    async with (
        stub("udpin:127.0.0.1:0") as server,
        udp_client(remote=server.ports[0]) as first,
        udp_client(remote=server.ports[0]) as second,
    ):
        second.say(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        await second.hear("HEARTBEAT")
        await ask_and_hear(first)
        assert not [m for m in second.messages if m.get_type() == "GLOBAL_POSITION_INT"]


async def test_the_stub_serves_tcp() -> None:
    async with stub("tcpin:127.0.0.1:0") as server, tcp_client(server.ports[0]) as client:
        await ask_and_hear(client)


async def test_a_client_that_is_gone_leaves_the_others_alone() -> None:
    async with stub("tcpin:127.0.0.1:0") as server, tcp_client(server.ports[0]) as stays:
        async with tcp_client(server.ports[0]) as goes:
            await ask_and_hear(goes)
        await ask_and_hear(stays)
        await stays.hear("HEARTBEAT", count=2)
        assert len(server.autopilot.channels) == 1


async def test_the_stub_connects_to_a_tcp_server_and_again_after_it_hung_up() -> None:
    greeted: asyncio.Queue[bytes] = asyncio.Queue()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        greeted.put_nowait(await reader.read(100))
        writer.close()

    listener = await asyncio.start_server(accept, "127.0.0.1", 0)
    port = listener.sockets[0].getsockname()[1]
    async with listener, stub(f"tcp:127.0.0.1:{port}"), asyncio.timeout(10.0):
        assert (await greeted.get())[0] == 0xFD
        assert (await greeted.get())[0] == 0xFD


async def test_a_command_to_the_companion_passes_through_to_it_alone() -> None:
    async with (
        stub("tcpin:127.0.0.1:0") as server,
        tcp_client(server.ports[0]) as companion,
        tcp_client(server.ports[0]) as ground,
    ):
        companion.say(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        beat = await ground.hear("HEARTBEAT", within_s=2.0)
        while beat.get_srcComponent() != 191:
            beat = await ground.hear("HEARTBEAT", within_s=2.0)
        order = dialect.MAVLink_command_long_message(
            *(1, 191, dialect.MAV_CMD_DO_SPRAYER, 0),
            *(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        )
        ground.say(order)
        arrived = await companion.hear("COMMAND_LONG")
        assert arrived.command == dialect.MAV_CMD_DO_SPRAYER
        assert not [m for m in ground.messages if m.get_type() == "COMMAND_ACK"]


async def test_garbage_costs_no_more_than_the_frames_that_it_swallows() -> None:
    async with (
        stub("udpin:127.0.0.1:0") as server,
        udp_client(remote=server.ports[0]) as client,
    ):
        client.send(bytes(range(256)) * 4)
        client.send(b"\xfd\xff\x00")  # a frame of 267 bytes seems to begin
        for _ in range(8):
            client.say(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            client.command(dialect.MAV_CMD_GET_HOME_POSITION)
        await client.hear("HOME_POSITION")
        await ask_and_hear(client)


async def test_a_port_in_use_is_told_in_one_line() -> None:
    async with stub("udpin:127.0.0.1:0") as server:
        with pytest.raises(LinkError, match="in use") as caught:
            async with stub(f"udpin:127.0.0.1:{server.ports[0]}"):
                pass
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("url", ["", "udpin", "udpin:14550", "serial:/dev/x:1", "udpin:h:99999"])
async def test_a_link_that_is_no_link_is_told_in_one_line(url: str) -> None:
    with pytest.raises(LinkError, match="KIND:HOST:PORT"):
        async with stub(url):
            pass
