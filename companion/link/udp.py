"""UDP: wait for the vehicle at a port (`udpin`) or speak to one (`udpout`)."""

from __future__ import annotations

import asyncio
import errno
from dataclasses import dataclass
from typing import Any, cast

from companion.errors import LinkError
from companion.link.transport import LinkUrl, OnBytes

_PEERS_MAX = 4
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
        self._socket: asyncio.DatagramTransport | None = None
        self._closed = asyncio.get_running_loop().create_future()
        self.is_up = True
        self._is_full = False
        self.error_count = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the socket over."""
        self._socket = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        """Hand the bytes over; `speaker` says meanwhile where they came from."""
        self.speaker = addr
        self._on_bytes(data)

    def adopt(self, speaker: Any, now_s: float, *, is_vehicle: bool) -> None:
        """Send to an address from now on, if there is a place for it."""
        if self._is_connected or speaker is None:
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

    def error_received(self, _exc: Exception) -> None:
        """Count what the network reports: nobody listens yet, or no longer."""
        self.error_count += 1

    def pause_writing(self) -> None:
        """Note that the system takes no more: what is sent now would be old when it leaves."""
        self._is_full = True

    def resume_writing(self) -> None:
        """Note that the system takes datagrams again."""
        self._is_full = False

    def connection_lost(self, _exc: Exception | None) -> None:
        """Note that the socket is gone."""
        self.is_up = False
        if not self._closed.done():
            self._closed.set_result(None)

    def send(self, data: bytes) -> bool:
        """Send a datagram to the peer or the peers; False where there is none."""
        socket = self._socket
        if socket is None or socket.is_closing() or self._is_full:
            return False
        if self._is_connected:
            socket.sendto(data)
            return True
        for peer in self._peers:
            socket.sendto(data, peer)
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
        raise LinkError(f"link.url = {url.text!r}: {_reason(url, error)}") from error
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
        return f"{url.place} is no address of this computer; write 127.0.0.1 or 0.0.0.0"
    return f"cannot be opened ({error.strerror or error}); check host and port"
