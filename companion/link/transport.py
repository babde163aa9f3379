"""From a link URL to something that sends bytes and hands over bytes; no threads, no polling.

`send` never waits and never raises: it returns False where the bytes could not leave, and the
sender decides whether they are still worth sending later. Old orders are not queued up.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

from companion.errors import LinkError

OnBytes = Callable[[bytes], None]
OnChange = Callable[[bool], None]
OnTrouble = Callable[[str], None]

BACK_OFF_MIN_S, BACK_OFF_MAX_S = 0.5, 5.0
CLOSE_WAIT_S = 0.5
_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class LinkNotYetError(LinkError):
    """The link cannot be opened now, and may be later: a device to plug in, a router to start."""


class Transport(Protocol):
    """An open link."""

    is_up: bool
    speaker: Any  # where the bytes that are being handed over came from, where there are several
    handle: Any  # what is sent by, which has a `fileno`; None while the link is down

    @property
    def peers(self) -> Sequence[Any]:
        """Return the addresses that are sent to; none where there is one other end."""

    def send(self, data: bytes) -> bool:
        """Send now or not at all; return whether it left."""

    def adopt(self, speaker: Any, now_s: float, *, is_vehicle: bool) -> None:
        """Take that a valid frame came from `speaker`, of the vehicle's system or of another."""

    async def close(self) -> None:
        """Let what was sent go out, for half a second at most, and let go."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkUrl:
    """A link URL in its parts; `number` is the port or the baud rate."""

    kind: str
    place: str
    number: int
    text: str


def parse_url(url: str) -> LinkUrl:
    """Return the parts of `url`, or raise a `LinkError` that says what to write.

    >>> parse_url("udpin:127.0.0.1:14550").number
    14550
    """
    kind, _, rest = url.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in ("udpin", "udpout", "tcp", "serial") or not place:
        raise LinkError(f"link.url = {url!r}: not a link; write {_FORMS}")
    if not (number.isascii() and number.isdigit()):
        what = "baud rate" if kind == "serial" else "port"
        raise LinkError(f"link.url = {url!r}: {number!r} is no {what}; write {_FORMS}")
    value = int(number)
    if kind != "serial" and not (0 if kind == "udpin" else 1) <= value <= 65535:
        raise LinkError(f"link.url = {url!r}: port {value} does not exist; write 1 to 65535")
    return LinkUrl(kind=kind, place=place.strip("[]"), number=value, text=url)


def serial_baud(url: str) -> int | None:
    """Return the baud rate of a serial link; None for any other, whose speed is not known.

    >>> serial_baud("serial:/dev/ttyAMA0:57600"), serial_baud("udpin:127.0.0.1:14550")
    (57600, None)
    """
    return parse_url(url).number if url.startswith("serial:") else None


class Reconnecting:
    """What links that can be lost have in common: they try again with growing pauses."""

    def __init__(
        self,
        url: LinkUrl,
        on_bytes: OnBytes,
        on_change: OnChange,
        on_trouble: OnTrouble | None = None,
    ) -> None:
        self.url = url
        self.is_up = False
        self.speaker: Any = None
        self.handle: Any = None
        self.peers: Sequence[Any] = ()
        self._on_bytes = on_bytes
        self._on_change = on_change
        self._on_trouble = on_trouble
        self._said: str | None = None
        self._again: asyncio.Task[None] | None = None
        self._closed = False

    async def open(self) -> None:
        """Connect for the first time, or begin to try; raises a `LinkError`."""
        try:
            await self._connect()
        except LinkNotYetError as error:
            if self._on_trouble is None:
                raise
            self._say(error)
            self._try_soon()
        else:
            self.is_up = True

    def _say(self, error: LinkError) -> None:
        """Tell why it is down, once for each reason."""
        if self._on_trouble is not None and str(error) != self._said:
            self._said = str(error)
            self._on_trouble(self._said)

    @abstractmethod
    async def _connect(self) -> None:
        """Connect, or raise a `LinkError` of one line."""

    @abstractmethod
    def send(self, data: bytes) -> bool:
        """Send now or not at all; return whether it left."""

    def adopt(self, speaker: Any, now_s: float, *, is_vehicle: bool) -> None:
        """Do nothing: there is one other end, and we chose it."""

    async def close(self) -> None:
        """Stop trying and let go."""
        self._closed = True
        self.is_up = False
        if self._again is not None:
            self._again.cancel()
            await asyncio.gather(self._again, return_exceptions=True)
            self._again = None
        await self._let_go()

    @abstractmethod
    async def _let_go(self) -> None:
        """Let what was sent go out, and close."""

    def _lost(self) -> None:
        """Tell of the loss and begin to try again."""
        if self._closed or not self.is_up:
            return
        self.is_up = False
        self._on_change(False)
        self._try_soon()

    def _try_soon(self) -> None:
        self._again = asyncio.get_running_loop().create_task(self._try_again())

    async def _try_again(self) -> None:
        pause_s = BACK_OFF_MIN_S
        while not self.is_up:
            await asyncio.sleep(pause_s)
            try:
                await self._connect()
            except LinkError as error:
                self._say(error)
                pause_s = min(2.0 * pause_s, BACK_OFF_MAX_S)
            else:
                self.is_up = True
                self._said = None
                self._on_change(True)


_PEERS_MAX = 4
_DATAGRAM_MAX = 65_535
_DATAGRAMS_AT_ONCE = 128
# The kernel gives what it may; it counts a datagram as 768 bytes at least.
_BUFFER_BYTES = 4 << 20
# A peer that has said nothing valid for so long may lose its place; heartbeats come every second.
_SILENT_S = 5.0


@dataclass(slots=True)
class _Peer:
    """When an address last said something valid, and whether the vehicle speaks from it."""

    heard_s: float
    is_vehicle: bool


class UdpTransport(asyncio.DatagramProtocol):
    """One socket. `udpin` sends to the addresses that were adopted, four at most.

    Anyone can send a datagram here, so nobody becomes a peer by that alone: the link adopts an
    address once a frame from it has been found valid. A newcomer never displaces a peer that is
    still heard, but for the vehicle, which displaces a stranger.
    """

    def __init__(self, on_bytes: OnBytes, *, is_connected: bool) -> None:
        self._on_bytes = on_bytes
        self._is_connected = is_connected
        self._peers: dict[Any, _Peer] = {}
        self.speaker: Any = None
        self.handle: Any = None
        self._socket: asyncio.DatagramTransport | None = None
        self._closed = asyncio.get_running_loop().create_future()
        self.is_up = True
        self._is_full = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the socket over."""
        self._socket = cast(asyncio.DatagramTransport, transport)
        self.handle = ours = transport.get_extra_info("socket")
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._rest = socket.socket(fileno=os.dup(ours.fileno()))

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Hand over what the socket holds; `speaker` says where it came from, if we called nobody.

        The event loop would bring one datagram a turn, and what waits in the socket behind those
        of others is lost when that is full.
        """
        left = _DATAGRAMS_AT_ONCE
        while True:
            self.speaker = None if self._is_connected else addr
            self._on_bytes(data)
            left -= 1
            if left <= 0:
                return
            try:
                data, addr = self._rest.recvfrom(_DATAGRAM_MAX, socket.MSG_DONTWAIT)
            except OSError:  # there is no more; or what the event loop will be told of
                return

    @property
    def peers(self) -> Sequence[Any]:
        """Return the addresses that were adopted."""
        return tuple(self._peers)

    def adopt(self, speaker: Any, now_s: float, *, is_vehicle: bool) -> None:
        """Send to an address from now on, if there is a place for it."""
        if speaker is None:
            return
        known = self._peers.get(speaker)
        if known is None:
            if len(self._peers) >= _PEERS_MAX and not self._make_room(now_s, is_vehicle):
                return
            self._peers[speaker] = _Peer(now_s, is_vehicle)
            return
        known.heard_s = now_s
        known.is_vehicle = known.is_vehicle or is_vehicle

    def _make_room(self, now_s: float, is_vehicle: bool) -> bool:
        """Let go of a peer that has fallen silent, or of a stranger where the vehicle speaks."""
        by_age = sorted(self._peers, key=lambda address: self._peers[address].heard_s)
        for address in by_age:
            if now_s - self._peers[address].heard_s > _SILENT_S:
                del self._peers[address]
                return True
        strangers = [address for address in by_age if not self._peers[address].is_vehicle]
        if not (is_vehicle and strangers):
            return False
        del self._peers[strangers[0]]
        return True

    def pause_writing(self) -> None:
        """Note that the system takes no more: what is sent now would be old when it leaves."""
        self._is_full = True

    def resume_writing(self) -> None:
        """Note that the system takes datagrams again."""
        self._is_full = False

    def connection_lost(self, _exc: Exception | None) -> None:
        """Note that the socket is gone."""
        self.is_up = False
        self._rest.close()
        if not self._closed.done():
            self._closed.set_result(None)

    def send(self, data: bytes) -> bool:
        """Send a datagram to the peer or the peers; False where there is none."""
        ours = self._socket
        if ours is None or ours.is_closing() or self._is_full:
            return False
        if self._is_connected:
            ours.sendto(data)
            return True
        for peer in self._peers:
            ours.sendto(data, peer)
        return bool(self._peers)

    async def close(self) -> None:
        """Close the socket; a datagram that was sent has left already."""
        if self._socket is not None:
            self._socket.close()
            await self._closed

    @property
    def port(self) -> int:
        """Return the local port: the one asked for, or the one that the system chose for 0."""
        assert self._socket is not None
        return int(self._socket.get_extra_info("sockname")[1])


async def open_udp(url: LinkUrl, on_bytes: OnBytes) -> UdpTransport:
    """Open the socket or say why not."""
    address = (url.place, url.number)
    listens = url.kind == "udpin"
    try:
        _, transport = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: UdpTransport(on_bytes, is_connected=not listens),
            local_addr=address if listens else None,
            remote_addr=None if listens else address,
        )
    except OSError as error:
        kind = LinkNotYetError if error.errno == errno.EADDRINUSE else LinkError
        raise kind(f"link.url = {url.text!r}: {_reason(url, error)}") from error
    return transport


def _reason(url: LinkUrl, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"port {url.number} is in use; stop the program that has it "
            "(another companion, a ground station), or write another port"
        )
    if error.errno == errno.EACCES:
        return f"port {url.number} is not allowed to this user; write one above 1023"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{url.place} is not an address of this computer; write 127.0.0.1 or 0.0.0.0"
    return f"cannot be opened ({error.strerror or error}); check host and port"


_PENDING_MAX = 8 * 1024
# Short of the five seconds within which the operator is told what is wrong.
_CONNECT_WAIT_S = 3.0
# A peer that vanished without a word is given up when what we sent stays unanswered this long;
# otherwise the system would go on trying for a quarter of an hour.
_UNANSWERED_MS = 5000


class _Connection(asyncio.Protocol):
    """One connection; it reports its own end once."""

    def __init__(self, owner: TcpTransport, on_bytes: OnBytes) -> None:
        self._owner = owner
        self._on_bytes = on_bytes
        self.ended = asyncio.get_running_loop().create_future()

    def data_received(self, data: bytes) -> None:
        self._on_bytes(data)

    def connection_lost(self, _exc: Exception | None) -> None:
        if not self.ended.done():
            self.ended.set_result(None)
        self._owner.connection_ended(self)


class TcpTransport(Reconnecting):
    """A client; a peer that reads too slowly gets nothing rather than old orders."""

    _transport: asyncio.Transport | None = None
    _connection: _Connection | None = None

    async def _connect(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_CONNECT_WAIT_S):
                transport, connection = await loop.create_connection(
                    lambda: _Connection(self, self._on_bytes), self.url.place, self.url.number
                )
        except ConnectionRefusedError as error:
            raise LinkNotYetError(
                f"link.url = {self.url.text!r}: connection refused; nobody listens at "
                f"{self.url.place} port {self.url.number}: start the autopilot or its router first"
            ) from error
        except (OSError, TimeoutError) as error:
            raise LinkNotYetError(
                f"link.url = {self.url.text!r}: cannot connect "
                f"({error or 'no answer'}); check host, port and cable"
            ) from error
        if transport.is_closing():
            raise LinkNotYetError(f"link.url = {self.url.text!r}: the other end hung up at once")
        tcp: socket.socket = transport.get_extra_info("socket")
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNANSWERED_MS)
        self._transport, self._connection, self.handle = transport, connection, tcp

    def connection_ended(self, connection: _Connection) -> None:
        """Take the end of a connection; only that of the present one matters."""
        if connection is self._connection:
            self._transport = self.handle = None
            self._lost()

    def send(self, data: bytes) -> bool:
        """Send now, unless the peer is behind."""
        transport = self._transport
        if transport is None or transport.is_closing():
            return False
        if transport.get_write_buffer_size() > _PENDING_MAX:
            return False
        transport.write(data)
        return True

    async def _let_go(self) -> None:
        transport, connection = self._transport, self._connection
        if transport is None or connection is None:
            return
        transport.close()
        try:
            async with asyncio.timeout(CLOSE_WAIT_S):
                await asyncio.shield(connection.ended)
        except TimeoutError:
            transport.abort()
            await connection.ended
