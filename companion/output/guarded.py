"""Servo outputs with a guardian beside them: a process that closes them when this one cannot.

With each plan it is told how the vehicle is reached. What it has closed is ordered anew only after
it has said that it rests. Without it nothing opens: see `companion.guardian`.
"""

from __future__ import annotations

import asyncio
import json
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from companion.core.types import SprayPlan
from companion.output.autopilot_options import ServoOptions
from companion.output.child import RECEIVE_MAX, Child
from companion.output.servo import Order, ServoExecutor

COMMAND = (sys.executable, "-P", "-m", "companion.guardian")
START_MAX_S = 10.0
# Its signs of life come every 0.1 s. What this process itself missed counts for little.
SILENCE_MAX_S, GAP_MAX_S = 1.0, 0.1
NOTE_NAME = "guardian.json"

Way = Callable[[], tuple[Any, dict[str, Any]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardianSetup:
    """What the guardian is told once, besides the outputs; `note` is where it leaves its word."""

    lease_s: float
    component: int
    is_udp: bool
    key: bytes
    note: Path

    def packet(self, options: ServoOptions) -> bytes:
        """Return it as the guardian has it: the return valve opens first, the valves come last."""
        opened = [] if options.return_channel is None else [options.return_channel]
        closed_us = [
            *((channel, options.full_us) for channel in opened),
            *((drive.channel, drive.stop_us) for drive in options.drives),
            *((channel, options.closed_us) for channel in options.channels),
        ]
        told = {
            "closed_us": closed_us,
            "ends_us": (options.closed_us, options.full_us),
            "lease_s": self.lease_s,
            "component": self.component,
            "is_udp": self.is_udp,
            "key": self.key.hex(),
            "note": str(self.note),
        }
        return json.dumps(told).encode()


class GuardedServoExecutor(ServoExecutor):
    """Watches its guardian as the guardian watches it; `way` says how the vehicle is reached."""

    def __init__(
        self,
        options: ServoOptions,
        order: Order,
        guardian: GuardianSetup,
        way: Way,
        *,
        flush: Callable[[], bool],
        say: Callable[[str], None],
        baud: int | None = None,
    ) -> None:
        super().__init__(
            options, order, flush=flush, say=say, baud=baud, is_signed=bool(guardian.key)
        )
        self._setup, self._way, self._say = guardian, way, say
        self._child: Child | None = None
        self._given: Any = None
        self._is_px4: bool | None = None
        self._unguarded: str | None = None
        self._closings, self._is_closing = 0, True
        self._silent_s, self._looked_s = 0.0, 0.0

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted, or closed without us."""
        return super().fault or self._unguarded

    def met(self, is_px4: bool) -> Any:
        """Take that the vehicle was met: the guardian has to know by which orders it closes."""
        self._is_px4 = is_px4
        return super().met(is_px4)

    async def guard(self) -> None:
        """Start the guardian, which closes from its first moment on; once."""
        if self._child is not None:
            return
        loop = asyncio.get_running_loop()
        self._looked_s = loop.time()
        try:
            self._child = Child(COMMAND)
            self._child.send(self._setup.packet(self._options))
            async with asyncio.timeout(START_MAX_S):
                if not await loop.sock_recv(self._child.socket, RECEIVE_MAX):
                    self._unguarded = "guardian ended at its start"
        except (OSError, TimeoutError) as error:
            self._unguarded = f"no guardian: {error or 'not ready'}"

    async def start(self) -> None:
        """Have the guardian there first; tell what that of an earlier run left word of."""
        await self.guard()
        await super().start()
        with suppress(OSError, ValueError):
            told = json.loads(self._setup.note.read_text(encoding="utf-8"))
            self._setup.note.unlink()
            at = time.strftime("%H:%M:%S", time.gmtime(told["closed_s"]))
            self._say(f"last run was killed: guardian closed all, {at} UTC")

    def submit(self, plan: SprayPlan) -> None:
        """Carry a plan out once the guardian rests; until then all stays closed."""
        self._look()
        if self._is_closing:
            plan = replace(plan, duty=(0.0,) * len(plan.duty), changes=(), drives=())
        super().submit(plan)
        self.attend()

    def attend(self) -> None:
        """Give the guardian a sign of life, with how the vehicle is reached now."""
        if self._child is None:
            return
        handle, told = self._way()
        told |= {"taken": self._closings, "is_px4": self._is_px4, "is_up": handle is not None}
        files = [] if handle is None or handle is self._given else [handle.fileno()]
        with suppress(OSError):
            flags = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL
            socket.send_fds(self._child.socket, [json.dumps(told).encode()], files, flags)
            self._given = handle

    async def stop(self) -> None:
        """Close all, and let the guardian go."""
        try:
            await super().stop()
        finally:
            child, self._child = self._child, None
            if child is not None:
                child.send(b'"end"')
                child.disconnect()
                await child.ended(SILENCE_MAX_S)

    def _look(self) -> None:
        """Take what the guardian said; what it closed is to be ordered anew."""
        if self._child is None:
            return
        now_s = asyncio.get_running_loop().time()
        self._silent_s += min(now_s - self._looked_s, GAP_MAX_S)
        self._looked_s = now_s
        for packet in self._child.packets():
            if not packet:
                self._unguarded = self._unguarded or "guardian ended: restart"
                return
            self._silent_s = 0.0
            closings, is_closing, why = json.loads(packet)
            if closings > self._closings > 0:
                self._say(f"guardian closed all: {why}")
            self._closings, self._is_closing = closings, is_closing
        if not self._silent_s <= SILENCE_MAX_S:
            self._unguarded = self._unguarded or "guardian silent: restart"
