"""Runs a stub in real time: the monotonic clock, its links, and a tick when something is due."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol, cast

from companion.errors import LinkError
from sitl.stub.autopilot import Autopilot
from sitl.stub.protocol import Channel

_TICK_S = 0.02


class StubServer:
    """Use as `async with StubServer(autopilot, urls) as server`; `ports` are the local ones.

    `late_s` is how late each tick was: on a busy machine the vehicle itself is irregular, and a
    test that judges a companion has to know it.
    """

    def __init__(self, autopilot: Autopilot, urls: Sequence[str]) -> None:
        self.autopilot = autopilot
        self.ports: list[int] = []
        self.late_s: list[float] = []
        self.ticked: Callable[[float], None] = lambda _now_s: None
        self._urls = urls
        self._links: list[Link] = []
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> StubServer:
        try:
            for url in self._urls:
                self._links.append(await open_link(url, self))
        except BaseException:
            await self._close_links()
            raise
        self.ports = [link.port for link in self._links]
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await self._close_links()

    async def wait(self) -> None:
        """Wait for the end of the run, which comes only with an error."""
        if self._task is not None:
            await asyncio.shield(self._task)

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        """Take a new peer on."""
        return self.autopilot.attach(name, send)

    def detach(self, channel: Channel) -> None:
        """Let a peer go."""
        self.autopilot.detach(channel)

    def received(self, channel: Channel, received: bytes) -> None:
        """Take bytes of a peer in, with the time at which they were read."""
        self.autopilot.receive(channel, received, time.monotonic())

    async def _run(self) -> None:
        due_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            self.late_s.append(now_s - due_s)
            self.autopilot.tick(now_s)
            self.ticked(now_s)
            due_s = min(max(self.autopilot.next_due_s(), now_s), now_s + _TICK_S)
            await asyncio.sleep(max(due_s - time.monotonic(), 0.0))

    async def _close_links(self) -> None:
        for link in self._links:
            await link.close()
        self._links.clear()


# The sockets of the stub: UDP towards a peer or waiting for peers, TCP as client or server.
#
# Every peer is a channel of its own: every address on a UDP socket, every TCP connection.

_logger = logging.getLogger(__name__)

Address = tuple[str, int]

_PEERS_MAX = 16
_RECONNECT_S = 0.5
_CLOSE_WAIT_S = 0.5
_BACKLOG_MAX = 256 * 1024


class Hub(Protocol):
    """What peers are attached to."""

    def attach(self, name: str, send: Callable[[bytes], None]) -> Channel:
        """Take a new peer on."""

    def detach(self, channel: Channel) -> None:
        """Let a peer go."""

    def received(self, channel: Channel, received: bytes) -> None:
        """Take bytes of a peer in."""


class Link(Protocol):
    """An open socket; `port` is the local one where others find it."""

    port: int

    async def close(self) -> None:
        """Close it and let all of its peers go."""


@dataclass(frozen=True, slots=True)
class LinkUrl:
    """A kind of link with its host and port."""

    kind: str
    host: str
    port: int

    @classmethod
    def parse(cls, url: str) -> LinkUrl:
        """Return the parts of `KIND:HOST:PORT`.

        >>> LinkUrl.parse("udpout:127.0.0.1:14550")
        LinkUrl(kind='udpout', host='127.0.0.1', port=14550)
        """
        kind, _, rest = url.partition(":")
        host, _, port = rest.rpartition(":")
        if kind not in _OPENERS or not host or not port.isdigit() or int(port) > 65535:
            kinds = ", ".join(_OPENERS)
            raise LinkError(f"link {url!r}: write KIND:HOST:PORT, where KIND is one of {kinds}")
        return cls(kind, host, int(port))


async def open_link(url: str, hub: Hub) -> Link:
    """Open a link by its URL."""
    parts = LinkUrl.parse(url)
    try:
        return await _OPENERS[parts.kind](parts, hub)
    except OSError as error:
        reason = error.strerror or str(error)
        raise LinkError(f"link {url!r}: {reason}; choose another port with --link") from error


# ------------------------------------------------------------------------------------------ UDP


class _Udp(asyncio.DatagramProtocol):
    """A UDP socket with the peers that were heard on it."""

    port = 0

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._transport: asyncio.DatagramTransport | None = None
        self._channels: dict[Address, Channel] = {}

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)
        self.port = transport.get_extra_info("sockname")[1]

    def add_peer(self, address: Address) -> Channel:
        """Take an address on; the oldest goes where there are too many."""
        if len(self._channels) >= _PEERS_MAX:
            self._hub.detach(self._channels.pop(next(iter(self._channels))))

        def send(frame: bytes) -> None:
            if self._transport is not None and not self._transport.is_closing():
                self._transport.sendto(frame, address)

        channel = self._hub.attach(f"udp:{address[0]}:{address[1]}", send)
        self._channels[address] = channel
        return channel

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        address = (addr[0], addr[1])
        channel = self._channels.get(address) or self.add_peer(address)
        self._hub.received(channel, data)

    def error_received(self, exc: Exception) -> None:
        _logger.debug("udp: %s", exc)

    async def close(self) -> None:
        for channel in self._channels.values():
            self._hub.detach(channel)
        self._channels.clear()
        if self._transport is not None:
            self._transport.close()


async def _open_udpin(url: LinkUrl, hub: Hub) -> Link:
    loop = asyncio.get_running_loop()
    address = (url.host, url.port)
    _, udp = await loop.create_datagram_endpoint(lambda: _Udp(hub), local_addr=address)
    return udp


async def _open_udpout(url: LinkUrl, hub: Hub) -> Link:
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(url.host, url.port)
    family, address = found[0][0], found[0][4]
    # Not connected: a peer that is not there yet then makes no error, and others may speak up.
    _, udp = await loop.create_datagram_endpoint(lambda: _Udp(hub), family=family, local_addr=None)
    udp.add_peer((str(address[0]), int(address[1])))
    return udp


# ------------------------------------------------------------------------------------------ TCP


async def _serve_stream(
    hub: Hub, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
) -> None:
    """Keep one TCP connection as a channel until it ends."""

    def send(frame: bytes) -> None:
        # A peer that does not read loses messages; the vehicle does not wait for it.
        if not writer.is_closing() and writer.transport.get_write_buffer_size() < _BACKLOG_MAX:
            writer.write(frame)

    host, port = writer.get_extra_info("peername")[:2]
    channel = hub.attach(f"tcp:{host}:{port}", send)
    try:
        while received := await reader.read(4096):
            hub.received(channel, received)
    except OSError as error:
        _logger.debug("tcp: %s", error)
    finally:
        hub.detach(channel)
        writer.close()
        await _let_go(writer)


async def _let_go(writer: asyncio.StreamWriter) -> None:
    """Wait for a connection's end; a peer that does not read what is on its way loses it."""
    closed = asyncio.ensure_future(writer.wait_closed())
    if not (await asyncio.wait({closed}, timeout=_CLOSE_WAIT_S))[0]:
        writer.transport.abort()
    with suppress(OSError):
        await closed


class _TcpServer:
    """A TCP server; every client is a channel."""

    def __init__(self, hub: Hub) -> None:
        self.port = 0
        self._hub = hub
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def open(self, url: LinkUrl) -> None:
        self._server = await asyncio.start_server(self._accept, url.host, url.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        try:
            await _serve_stream(self._hub, reader, writer)
        except asyncio.CancelledError:
            _logger.debug("tcp: closed with the server")
        finally:
            self._tasks.discard(task)

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


class _TcpClient:
    """A TCP client that connects again for as long as it is open."""

    def __init__(self, url: LinkUrl, hub: Hub) -> None:
        self.port = 0
        self._task = asyncio.create_task(self._run(url, hub))

    async def _run(self, url: LinkUrl, hub: Hub) -> None:
        while True:
            try:
                reader, writer = await asyncio.open_connection(url.host, url.port)
            except OSError as error:
                _logger.debug("tcp: %s", error)
            else:
                await _serve_stream(hub, reader, writer)
            await asyncio.sleep(_RECONNECT_S)

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


async def _open_tcpin(url: LinkUrl, hub: Hub) -> Link:
    server = _TcpServer(hub)
    await server.open(url)
    return server


async def _open_tcp(url: LinkUrl, hub: Hub) -> Link:
    return _TcpClient(url, hub)


_OPENERS = {
    "udpout": _open_udpout,
    "udpin": _open_udpin,
    "tcp": _open_tcp,
    "tcpin": _open_tcpin,
}
