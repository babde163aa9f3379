"""`vrspray doctor` as a process with a terminal, and an operator who answers what is asked."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import pty
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

STROKE_S = 0.1
BROKEN_OFF = b"broken off ("


@dataclass
class Guided:
    """The process, the end of the terminal at which the operator sits, and what was said."""

    process: asyncio.subprocess.Process
    hand: int
    told: bytes = b""
    seen: int = 0
    news: asyncio.Event = field(default_factory=asyncio.Event)

    async def until_told(self, text: str) -> None:
        """Wait until `text` is said, after what was waited for before."""
        async with asyncio.timeout(40.0):
            while (place := self.told.find(text.encode(), self.seen)) < 0:
                self.news.clear()
                await self.news.wait()
        self.seen = place + len(text)

    async def answer(self, question: str, text: str) -> None:
        """Type `text` once `question` was asked."""
        await self.until_told(question)
        os.write(self.hand, text.encode())

    async def hold_until(self, question: str) -> None:
        """Hold the space bar until `question` is asked, or the process ends.

        A hand that a busy computer holds up has let go: what is broken off is begun again.
        """
        waiting = asyncio.create_task(self.until_told(question))
        over = asyncio.create_task(self.process.wait())
        broken_off = self.told.count(BROKEN_OFF)
        while not (waiting.done() or over.done()):
            if self.told.count(BROKEN_OFF) > broken_off:
                broken_off += 1
                os.write(self.hand, b"\n")
            os.write(self.hand, b" ")
            await asyncio.sleep(STROKE_S)
        for task in (waiting, over):
            task.cancel()
        await asyncio.gather(waiting, over, return_exceptions=True)
        self.seen -= len(question) if not over.done() or waiting.done() else 0

    async def listen(self) -> None:
        assert self.process.stderr is not None
        while data := await self.process.stderr.read(4096):
            self.told += data
            self.news.set()

    async def ended(self) -> tuple[int, dict[str, Any]]:
        """Return the exit code, and the JSON object of stdout."""
        assert self.process.stdout is not None
        async with asyncio.timeout(45.0):
            text = await self.process.stdout.read()
            code = await self.process.wait()
        return code, json.loads(text) if text else {}


@contextlib.asynccontextmanager
async def guided(config: Path, port: int, *arguments: str) -> AsyncIterator[Guided]:
    """Begin `vrspray doctor ...` on a terminal; end what is left of it."""
    far, near = pty.openpty()
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "companion", "doctor", "--json", "--config", str(config)),
        *("--set", f"link.url=udpin:127.0.0.1:{port}"),
        *arguments,
        stdin=near,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    os.close(near)
    found = Guided(process=process, hand=far)
    ear = asyncio.create_task(found.listen())
    try:
        yield found
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
        await ear
        with contextlib.suppress(OSError):
            os.close(far)
