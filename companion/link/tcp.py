"""TCP: connect to a vehicle or a router that listens, and come back when it does."""

from __future__ import annotations

import asyncio
import socket

from companion.link.transport import (
    CLOSE_WAIT_S,
    LinkNotYetError,
    LinkUrl,
    OnBytes,
    OnChange,
    OnTrouble,
    Reconnecting,
)

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

    def __init__(
        self,
        url: LinkUrl,
        on_bytes: OnBytes,
        on_change: OnChange,
        on_trouble: OnTrouble | None = None,
    ) -> None:
        super().__init__(url, on_bytes, on_change, on_trouble)
        self._transport: asyncio.Transport | None = None
        self._connection: _Connection | None = None

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
        self._transport, self._connection = transport, connection

    def connection_ended(self, connection: _Connection) -> None:
        """Take the end of a connection; only that of the present one matters."""
        if connection is self._connection:
            self._transport = None
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
