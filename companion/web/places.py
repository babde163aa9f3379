"""Which connections a page keeps: whoever waits gives way to whoever comes.

A stranger needs no token to connect. So nobody is turned away for others who only hold a place: a
connection has some seconds for a whole request, an address has its share, and where all places are
taken the longest waiting of the most crowded address goes. Who has a session, and every STOP, keeps
its place while it is answered. The connections are counted as they are accepted, before TLS.
"""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

# Descriptors of a process are 1024 by default, and as many again may be accepted at once.
PLACES, OF_ADDRESS, AT_ONCE = 200, 50, 100
WAIT_S = 10.0

Address = tuple[str, int]


@dataclass(slots=True)
class _Place:
    connection: socket.socket
    requests: int = 0
    is_kept: bool = False
    ends: asyncio.TimerHandle | None = None

    def end(self) -> None:
        with suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)

    def keep(self) -> None:
        self.is_kept = True


class Places:
    """The open connections of a page, those that have waited longest first."""

    def __init__(
        self, *, most: int = PLACES, of_address: int = OF_ADDRESS, wait_s: float = WAIT_S
    ) -> None:
        self._most, self._of_address, self._wait_s = most, of_address, wait_s
        self._open: dict[Address, _Place] = {}

    @property
    def count(self) -> int:
        """Return how many connections are open."""
        return sum(place.connection.fileno() >= 0 for place in self._open.values())

    def listening(self, listener: socket.socket) -> socket.socket:
        """Return the listener, whose connections have places here from now on."""
        return _Listener(self, listener)

    def admit(self, connection: socket.socket, address: Address) -> None:
        """Take a connection, in place of another where there are too many."""
        self._open = {key: one for key, one in self._open.items() if one.connection.fileno() >= 0}
        crowd = [key for key, one in self._open.items() if not one.is_kept]
        own = [key for key in crowd if key[0] == address[0]]
        if len(own) < self._of_address:
            own = []
            if len(self._open) >= self._most:
                own = crowd or list(self._open)
        if own:
            of = Counter(key[0] for key in own)
            self._open.pop(max(own, key=lambda key: of[key[0]])).end()
        self._open[address] = place = _Place(connection)
        self._wait(place)

    def _wait(self, place: _Place) -> None:
        place.is_kept = False
        place.ends = asyncio.get_running_loop().call_later(self._wait_s, place.end)

    @contextmanager
    def serving(self, address: Address | None) -> Iterator[Callable[[], None]]:
        """Answer a request of a connection; what is yielded keeps its place until then."""
        place = None if address is None else self._open.get(address)
        if place is None or address is None:
            yield lambda: None
            return
        place.requests += 1
        if place.ends is not None:
            place.ends.cancel()
        try:
            yield place.keep
        finally:
            place.requests -= 1
            if not place.requests:
                if self._open.get(address) is place:
                    self._open[address] = self._open.pop(address)
                self._wait(place)


class _Listener(socket.socket):
    def __init__(self, places: Places, listener: socket.socket) -> None:
        super().__init__(fileno=listener.detach())
        self._places = places

    def accept(self) -> tuple[socket.socket, Any]:
        connection, address = super().accept()
        self._places.admit(connection, address[:2])
        return connection, address
