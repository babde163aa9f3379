"""Tells systemd that the control loop makes its steps; loaded by a run that is to tell it.

The protocol is a datagram of `KEY=VALUE` lines to the socket in NOTIFY_SOCKET (sd_notify(3)). In a
container, where there is no systemd, the same steps touch the file in VRSPRAY_ALIVE_FILE, whose age
the image's health check looks at.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, MutableMapping
from contextlib import suppress
from pathlib import Path
from typing import Self

# A journal takes up to 30 s to close; the valves are closed by then, and no step follows.
CLOSING_MAX_S = 35.0
# The file of a container is touched half as often as this says.
ALIVE_S = 2.0


class Notifier:
    """Sends READY=1 at the first step, and WATCHDOG=1 at most twice in the watchdog's time.

    It has no timer: a loop that stands still is silent, and systemd ends it.
    """

    def __init__(
        self,
        send: Callable[[bytes], None] | None = None,
        *,
        watchdog_s: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._send = send
        self._pause_s = None if watchdog_s is None else 0.5 * watchdog_s
        self._clock = clock
        self._fed_s: float | None = None

    @classmethod
    def from_environment(cls, environment: MutableMapping[str, str], *, pid: int) -> Notifier:
        """Return what the environment asks for, and take it out: it is not for our children."""
        address = environment.pop("NOTIFY_SOCKET", "")
        watchdog_us = environment.pop("WATCHDOG_USEC", "")
        meant = environment.pop("WATCHDOG_PID", str(pid))
        alive = environment.pop("VRSPRAY_ALIVE_FILE", "")
        if not address.startswith(("/", "@")):
            return cls(_toucher(Path(alive)), watchdog_s=ALIVE_S) if alive else cls()
        is_watched = watchdog_us.isdecimal() and int(watchdog_us) > 0 and meant == str(pid)
        return cls(
            _sender(address.replace("@", "\0", 1) if address[0] == "@" else address),
            watchdog_s=int(watchdog_us) / 1e6 if is_watched else None,
        )

    def stepped(self) -> None:
        """Take that the control loop has made a step."""
        if self._send is None:
            return
        now_s = self._clock()
        if self._fed_s is None:
            self._fed_s = now_s
            self._send(b"READY=1\nWATCHDOG=1")
        elif self._pause_s is not None and now_s - self._fed_s >= self._pause_s:
            self._fed_s = now_s
            self._send(b"WATCHDOG=1")

    def __enter__(self) -> Self:
        """Begin; nothing is sent before the first step."""
        return self

    def __exit__(self, *_: object) -> None:
        """Take that the loop has ended and all is closed: the journal may take its time."""
        if self._send is not None:
            self._send(f"STOPPING=1\nWATCHDOG_USEC={round(CLOSING_MAX_S * 1e6)}".encode())


def _toucher(file: Path) -> Callable[[bytes], None]:
    def send(_: bytes) -> None:
        with suppress(OSError):
            file.touch()

    return send


def _sender(address: str) -> Callable[[bytes], None]:
    def send(message: bytes) -> None:
        # What cannot be sent now is missed by systemd, which is what it is for.
        with (
            suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel,
        ):
            channel.setblocking(False)
            channel.sendto(message, address)

    return send
