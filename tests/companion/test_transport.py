"""Links on loopback and on a pseudo-terminal: bytes both ways, loss, return, refusals."""

from __future__ import annotations

import asyncio
import os
import pty
import socket
import tty
from pathlib import Path

import pytest

import companion.link.transport as transport_module
from companion.errors import LinkError
from companion.link.transport import Transport
from companion.link.vehicle_link import open_transport
from tests.companion.wire_peer import free_port


class Inbox:
    """Collects what a link hands over; every arrival can be awaited."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.changes: list[bool] = []
        self._news = asyncio.Event()

    def on_bytes(self, data: bytes) -> None:
        self.data += data
        self._news.set()

    def on_change(self, is_up: bool) -> None:
        self.changes.append(is_up)
        self._news.set()

    async def until_bytes(self, count: int) -> bytes:
        async with asyncio.timeout(5.0):
            while len(self.data) < count:
                self._news.clear()
                await self._news.wait()
        return bytes(self.data)

    async def until_changes(self, count: int) -> list[bool]:
        async with asyncio.timeout(5.0):
            while len(self.changes) < count:
                self._news.clear()
                await self._news.wait()
        return self.changes

    async def open(self, url: str) -> Transport:
        return await open_transport(url, self.on_bytes, self.on_change)


@pytest.fixture
def quick_back_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transport_module, "BACK_OFF_MIN_S", 0.01)


async def test_udp_carries_bytes_both_ways() -> None:
    here, there = Inbox(), Inbox()
    port = free_port()
    listening = await here.open(f"udpin:127.0.0.1:{port}")
    speaking = await there.open(f"udpout:127.0.0.1:{port}")
    assert not listening.send(b"nobody is there yet")
    assert speaking.send(b"hello")
    assert await here.until_bytes(5) == b"hello"
    assert not listening.send(b"whoever you are")
    listening.adopt(listening.speaker, 0.0, is_vehicle=True)
    assert listening.send(b"welcome")
    assert await there.until_bytes(7) == b"welcome"
    await speaking.close()
    await listening.close()
    assert not listening.send(b"late")


async def test_udp_survives_a_peer_that_is_not_there_yet() -> None:
    port = free_port()
    speaking = await Inbox().open(f"udpout:127.0.0.1:{port}")
    for _ in range(3):
        assert speaking.send(b"anyone?")
        await asyncio.sleep(0)
    here = Inbox()
    listening = await here.open(f"udpin:127.0.0.1:{port}")
    speaking.send(b"hello")
    assert await here.until_bytes(5) == b"hello"
    await speaking.close()
    await listening.close()


async def test_udp_sends_to_four_and_the_vehicle_is_never_displaced() -> None:
    port = free_port()
    here = Inbox()
    listening = await here.open(f"udpin:127.0.0.1:{port}")
    inboxes = [Inbox() for _ in range(6)]
    speakers = []
    for number, inbox in enumerate(inboxes):
        speakers.append(await inbox.open(f"udpout:127.0.0.1:{port}"))
        speakers[-1].send(b"x")
        await here.until_bytes(number + 1)
        # Three strangers, the vehicle, and two more strangers for whom there is no place.
        listening.adopt(listening.speaker, 0.1 * number, is_vehicle=number == 3)
    listening.send(b"order")
    for inbox in inboxes[:4]:
        assert await inbox.until_bytes(5) == b"order"
    speakers[5].send(b"x")
    await here.until_bytes(7)
    # The vehicle speaks from another port; the stranger that was heard longest ago makes room.
    listening.adopt(listening.speaker, 1.0, is_vehicle=True)
    listening.send(b"again")
    for inbox in inboxes[1:4]:
        assert await inbox.until_bytes(10) == b"orderagain"
    assert await inboxes[5].until_bytes(5) == b"again"
    assert inboxes[0].data == b"order"
    assert not inboxes[4].data
    # Whoever has fallen silent makes room for anyone.
    speakers[4].send(b"x")
    await here.until_bytes(8)
    listening.adopt(listening.speaker, 7.0, is_vehicle=False)
    listening.send(b"last!")
    assert await inboxes[4].until_bytes(5) == b"last!"
    for transport in [*speakers, listening]:
        await transport.close()


class Server:
    """A TCP peer that takes connections one after the other."""

    def __init__(self) -> None:
        self.port = free_port(socket.SOCK_STREAM)
        self.accepted: asyncio.Queue[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = (
            asyncio.Queue()
        )
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        self._server = await asyncio.start_server(
            lambda reader, writer: self.accepted.put_nowait((reader, writer)),
            "127.0.0.1",
            self.port,
        )

    async def connection(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        async with asyncio.timeout(5.0):
            return await self.accepted.get()

    def stop(self) -> None:
        """Take no more connections; those that are there go on."""
        if self._server is not None:
            self._server.close()

    async def stopped(self) -> None:
        """Wait for its end: since Python 3.12 that of its connections too."""
        if self._server is not None:
            await self._server.wait_closed()

    async def close(self) -> None:
        self.stop()
        await self.stopped()


async def hang_up(writer: asyncio.StreamWriter) -> None:
    writer.close()
    await writer.wait_closed()


@pytest.mark.usefixtures("quick_back_off")
async def test_tcp_comes_back_after_the_peer_was_away() -> None:
    server, inbox = Server(), Inbox()
    await server.start()
    link = await inbox.open(f"tcp:127.0.0.1:{server.port}")
    reader, writer = await server.connection()
    assert link.send(b"one")
    assert await reader.readexactly(3) == b"one"
    await hang_up(writer)
    assert await inbox.until_changes(1) == [False]
    assert not link.send(b"lost")
    reader, writer = await server.connection()
    assert await inbox.until_changes(2) == [False, True]
    writer.write(b"two")
    assert await inbox.until_bytes(3) == b"two"
    assert link.send(b"three")
    assert await reader.readexactly(5) == b"three"
    await link.close()
    await hang_up(writer)
    await server.close()


@pytest.mark.usefixtures("quick_back_off")
async def test_tcp_goes_on_trying_while_nobody_listens() -> None:
    server, inbox = Server(), Inbox()
    await server.start()
    link = await inbox.open(f"tcp:127.0.0.1:{server.port}")
    _, writer = await server.connection()
    server.stop()
    await hang_up(writer)
    await server.stopped()
    await inbox.until_changes(1)
    await asyncio.sleep(0.05)
    assert inbox.changes == [False]
    await server.start()
    _, writer = await server.connection()
    await inbox.until_changes(2)
    await link.close()
    await hang_up(writer)
    await server.close()


async def test_tcp_close_sends_what_was_sent_before() -> None:
    server, inbox = Server(), Inbox()
    await server.start()
    link = await inbox.open(f"tcp:127.0.0.1:{server.port}")
    reader, writer = await server.connection()
    link.send(b"close all valves")
    await link.close()
    assert await reader.read() == b"close all valves"
    await hang_up(writer)
    await server.close()


async def test_a_tcp_peer_that_does_not_read_gets_no_old_orders() -> None:
    server, inbox = Server(), Inbox()
    await server.start()
    link = await inbox.open(f"tcp:127.0.0.1:{server.port}")
    _, writer = await server.connection()
    sent = sum(link.send(bytes(4096)) for _ in range(4000))
    assert sent < 4000
    writer.transport.abort()
    await link.close()
    await server.close()


async def read_exactly(descriptor: int, count: int) -> bytes:
    """Read from a descriptor by its readiness."""
    loop, data, ready = asyncio.get_running_loop(), bytearray(), asyncio.Event()
    loop.add_reader(descriptor, ready.set)
    try:
        async with asyncio.timeout(5.0):
            while len(data) < count:
                await ready.wait()
                ready.clear()  # or the next read would wait for bytes and block the loop
                data += os.read(descriptor, count - len(data))
                ready.clear()
    finally:
        loop.remove_reader(descriptor)
    return bytes(data)


async def test_serial_carries_bytes_both_ways(terminal: tuple[int, str]) -> None:
    far, device = terminal
    inbox = Inbox()
    link = await inbox.open(f"serial:{device}:57600")
    os.write(far, b"hello")
    assert await inbox.until_bytes(5) == b"hello"
    assert link.send(b"welcome")
    assert await read_exactly(far, 7) == b"welcome"
    await link.close()
    assert not link.send(b"late")


async def test_serial_finishes_partial_writes_in_order(terminal: tuple[int, str]) -> None:
    far, device = terminal
    link = await Inbox().open(f"serial:{device}:57600")
    sent = bytearray()
    for number in range(10_000):
        chunk = number.to_bytes(4, "big") * 11  # as long as an order
        if not link.send(chunk):
            break
        sent += chunk
    assert len(sent) < 10_000 * 44, "a device that takes nothing must be noticed"
    assert await read_exactly(far, len(sent)) == bytes(sent)
    assert link.send(b"again")
    assert await read_exactly(far, 5) == b"again"
    await link.close()


@pytest.mark.usefixtures("quick_back_off")
async def test_serial_notices_that_the_device_is_gone(terminal: tuple[int, str]) -> None:
    far, device = terminal
    inbox = Inbox()
    link = await inbox.open(f"serial:{device}:57600")
    os.close(far)
    assert await inbox.until_changes(1) == [False]
    assert not link.send(b"lost")
    await link.close()


@pytest.mark.usefixtures("quick_back_off")
async def test_serial_comes_back_when_the_device_does(tmp_path: Path) -> None:
    name = tmp_path / "ttyACM0"
    inbox = Inbox()
    far, near = pty.openpty()
    name.symlink_to(os.ttyname(near))
    os.close(near)
    link = await inbox.open(f"serial:{name}:57600")
    name.unlink()
    os.close(far)
    await inbox.until_changes(1)
    far, near = pty.openpty()
    tty.setraw(near)
    name.symlink_to(os.ttyname(near))
    os.close(near)
    assert await inbox.until_changes(2) == [False, True]
    os.write(far, b"back")
    assert await inbox.until_bytes(4) == b"back"
    await link.close()
    os.close(far)


async def test_two_programs_cannot_share_a_serial_device(terminal: tuple[int, str]) -> None:
    _, device = terminal
    link = await Inbox().open(f"serial:{device}:57600")
    with pytest.raises(LinkError, match="in use"):
        await Inbox().open(f"serial:{device}:57600")
    await link.close()


async def test_a_port_in_use_is_said_in_one_line() -> None:
    port = free_port()
    taken = await Inbox().open(f"udpin:127.0.0.1:{port}")
    with pytest.raises(LinkError, match=rf"^link.url = .*port {port} is in use; stop[^\n]*$"):
        await Inbox().open(f"udpin:127.0.0.1:{port}")
    await taken.close()


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("", "write udpin"),
        ("udp:127.0.0.1:14550", "write udpin"),
        ("udpin:14550", "write udpin"),
        ("udpin:127.0.0.1:port", "'port' is no port"),
        ("udpin:127.0.0.1:70000", "port 70000 does not exist"),
        ("udpout:127.0.0.1:0", "port 0 does not exist"),
        ("serial:/dev/ttyACM0:fast", "'fast' is no baud rate"),
        ("serial:/dev/does-not-exist:57600", "no device /dev/does-not-exist"),
        ("serial:/dev/null:57600", "cannot be opened as a serial port"),
        ("tcp:127.0.0.1:1", "connection refused"),
        ("udpin:192.0.2.1:14550", "not an address of this computer"),
    ],
)
async def test_a_wrong_url_is_refused_in_one_line(url: str, says: str) -> None:
    with pytest.raises(LinkError) as caught:
        await Inbox().open(url)
    text = str(caught.value)
    assert says in text
    assert text.startswith("link.url = ")
    assert "\n" not in text
