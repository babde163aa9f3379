"""Serial: the autopilot's telemetry port, read and written by readiness of its descriptor."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import termios
from pathlib import Path

import serial

from companion.errors import LinkError
from companion.link.transport import (
    CLOSE_WAIT_S,
    LinkNotYetError,
    LinkUrl,
    OnBytes,
    OnChange,
    OnTrouble,
    Reconnecting,
)

# What waits here is behind what the kernel holds (4 kB on Linux): at 57600 baud 1 kB is 0.18 s.
_PENDING_MAX = 1024
_READ_MAX = 4096
# What pyserial's errors carry: a device that is not there, and one that another program holds.
_MISSING = frozenset({errno.ENOENT, errno.ENXIO, errno.ENODEV})
_TAKEN = frozenset({errno.EAGAIN, errno.EBUSY})


class SerialTransport(Reconnecting):
    """A serial device, taken exclusively: two programs on one port corrupt each other."""

    def __init__(
        self,
        url: LinkUrl,
        on_bytes: OnBytes,
        on_change: OnChange,
        on_trouble: OnTrouble | None = None,
    ) -> None:
        super().__init__(url, on_bytes, on_change, on_trouble)
        self._port: serial.Serial | None = None
        self._pending = bytearray()
        self._emptied = asyncio.Event()

    async def _connect(self) -> None:
        device, baud = self.url.place, self.url.number
        try:
            port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            # SerialException is an OSError.
            may_come = _number(error) in _MISSING | _TAKEN
            kind = LinkNotYetError if may_come else LinkError
            raise kind(f"link.url = {self.url.text!r}: {_reason(device, error)}") from error
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            # Adapters of USB collect bytes for 16 ms otherwise; others do not know the setting.
            port.set_low_latency_mode(True)
        self._port = self.handle = port
        self._pending.clear()
        asyncio.get_running_loop().add_reader(port.fileno(), self._readable)

    def _readable(self) -> None:
        assert self._port is not None
        try:
            data = os.read(self._port.fileno(), _READ_MAX)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._on_bytes(data)
        else:
            # Readable without bytes: the device is gone (unplugged, or the other end hung up).
            self._drop()

    def send(self, data: bytes) -> bool:
        """Send now, or as soon as the device takes more; False where too much waits already."""
        if self._port is None or len(self._pending) + len(data) > _PENDING_MAX:
            return False
        self._pending += data
        self._writable()
        return self._port is not None

    def _writable(self) -> None:
        """Write what the device takes; the rest waits for its readiness."""
        if self._port is None:
            return
        loop, descriptor = asyncio.get_running_loop(), self._port.fileno()
        try:
            written = os.write(descriptor, self._pending)
        except BlockingIOError:
            written = 0
        except OSError:
            self._drop()
            return
        del self._pending[:written]
        if self._pending:
            self._emptied.clear()
            loop.add_writer(descriptor, self._writable)
        else:
            self._emptied.set()
            loop.remove_writer(descriptor)

    def _drop(self) -> None:
        """Let the device go, which must happen before it can be opened again."""
        port, self._port, self.handle = self._port, None, None
        if port is None:
            return
        loop = asyncio.get_running_loop()
        loop.remove_reader(port.fileno())
        loop.remove_writer(port.fileno())
        self._pending.clear()
        self._emptied.set()
        with contextlib.suppress(OSError, termios.error):
            port.close()
        self._lost()

    async def _let_go(self) -> None:
        if self._pending:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CLOSE_WAIT_S):
                    await self._emptied.wait()
        self._drop()


_PLACES = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "ttyAMA*", "ttyTHS*")
_NAMED_MAX = 4


def devices(root: Path = Path("/dev")) -> list[str]:
    """Return the serial devices that are there; by their lasting names where they have one."""
    found: list[Path] = []
    for place in _PLACES:
        known = {one.resolve() for one in found}
        found.extend(one for one in sorted(root.glob(place)) if one.resolve() not in known)
    return [str(one) for one in found]


def _number(error: Exception) -> int | None:
    return error.errno if isinstance(error, OSError) else None


def _reason(device: str, error: Exception) -> str:
    number = _number(error)
    if number in _MISSING:
        there = devices()
        if not there:
            return f"there is no device {device}, nor any other serial one; plug it in"
        more = ", ..." if len(there) > _NAMED_MAX else ""
        return (
            f"there is no device {device}; there are {', '.join(there[:_NAMED_MAX])}{more}: plug "
            "it in, or write one of these"
        )
    if number == errno.EACCES:
        return f"no permission for {device}; add this user to the group dialout"
    if number in _TAKEN:
        return f"{device} is in use by another program; stop that program"
    return f"{device} cannot be opened as a serial port ({error}); check device and baud rate"
