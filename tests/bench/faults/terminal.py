"""A serial device that can be unplugged."""

from __future__ import annotations

import asyncio
import os
import tty
from contextlib import suppress

from sitl.stub.server import StubServer


class Terminal:
    """A pseudo-terminal whose other end the companion takes for a serial device."""

    def __init__(self, hub: StubServer) -> None:
        self._file, other = os.openpty()
        tty.setraw(other)
        self.name = os.ttyname(other)
        self._other: int | None = other
        os.set_blocking(self._file, False)
        self._hub = hub
        self._channel = hub.attach("pty", self._send)
        self._is_open = True
        asyncio.get_running_loop().add_reader(self._file, self._read)

    def _send(self, frame: bytes) -> None:
        if self._is_open:
            # A full buffer: the device does not read, what is sent is lost.
            with suppress(OSError):
                os.write(self._file, frame)

    def _read(self) -> None:
        try:
            data = os.read(self._file, 4096)
        except OSError:
            return
        self._hub.received(self._channel, data)

    def close(self) -> None:
        """Unplug it."""
        if not self._is_open:
            return
        self._is_open = False
        asyncio.get_running_loop().remove_reader(self._file)
        self._hub.detach(self._channel)
        os.close(self._file)
        if self._other is not None:
            os.close(self._other)
