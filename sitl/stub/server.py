"""Runs a stub in real time: the monotonic clock, its links, and a tick when something is due."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence

from sitl.stub.autopilot import Autopilot
from sitl.stub.channel import Channel
from sitl.stub.transport import Link, open_link

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
