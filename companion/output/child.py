"""A process that drives or guards outputs: its start, packets to and from it, its end."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress

KILL_MAX_S, LOOK_S = 0.1, 0.01
# More than any packet.
RECEIVE_MAX = 1 << 17
_PACKETS_AT_ONCE = 64


class Child:
    """A child process and the socket to it. No threads and no shell; `ended` must be awaited."""

    def __init__(self, command: Sequence[str]) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ExitStack() as on_failure, theirs:
            on_failure.enter_context(ours)
            file = theirs.fileno()
            self._process = subprocess.Popen(
                [*command, str(file), str(os.getpid())],
                pass_fds=(file,),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Linux shares the processor among sessions first: in ours, a busy companion would
                # leave its wake-ups a twentieth of a processor that others want as well.
                start_new_session=True,
            )
            on_failure.pop_all()
        ours.setblocking(False)
        self.socket = ours
        self.is_connected = True

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    def send(self, packet: bytes) -> bool:
        """Hand over a packet; False if its socket is full, or it is gone."""
        try:
            self.socket.send(packet, socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError:
            return False
        return True

    def packets(self) -> Iterator[bytes]:
        """Yield what it sent, some packets at most; an empty packet is its end."""
        for _ in range(_PACKETS_AT_ONCE):
            if not self.is_connected:
                return
            try:
                packet = self.socket.recv(RECEIVE_MAX)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            yield packet
            if not packet:
                return

    def disconnect(self) -> None:
        """Close the socket, which ends an engine that is well."""
        self.is_connected = False
        self.socket.close()

    def kill(self) -> None:
        """End it whatever it does; the kernel releases its lines."""
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(KILL_MAX_S)

    async def ended(self, within_s: float) -> None:
        """Wait for its end while all else goes on, and kill it where that does not come."""
        until_s = time.monotonic() + within_s
        while self._process.poll() is None:
            if not time.monotonic() < until_s:
                self.kill()
                return
            await asyncio.sleep(LOOK_S)
