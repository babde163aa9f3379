"""`vrspray ground` as a process, with a terminal or a pipe, beside a vehicle on the ground."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import pty
import shutil
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests import builders
from tests.companion.wire_peer import WirePeer, free_port, over_udp

EXAMPLE = Path(__file__).parents[3] / "examples" / "anyang"
LOITER, AUTO = 5, 3
STROKE_S = 0.1


def example(folder: Path) -> Path:
    """Return the example's configuration, in a folder that may be written to."""
    shutil.copytree(EXAMPLE, folder / "anyang", ignore=shutil.ignore_patterns("flights"))
    return folder / "anyang" / "config.toml"


def standing() -> WirePeer:
    """Return a vehicle that stands, disarmed."""
    peer = WirePeer(builders.setup().frame, east_m=0.0, speed_m_s=0.0)
    peer.mode, peer.armed, peer.landed_state = LOITER, False, 1
    return peer


@dataclass
class Session:
    """One piece of work: its process, its vehicle, and the end at which a hand sits."""

    process: asyncio.subprocess.Process
    peer: WirePeer
    hand: int
    told: bytes = b""
    news: asyncio.Event = field(default_factory=asyncio.Event)
    strokes: asyncio.Task[None] | None = None

    def press(self, data: bytes) -> None:
        os.write(self.hand, data)

    def hold(self, stroke: bytes) -> None:
        """Press the key again and again, as the terminal of a held one does."""

        async def again() -> None:
            while True:
                self.press(stroke)
                await asyncio.sleep(STROKE_S)

        self.strokes = asyncio.create_task(again())

    async def let_go(self) -> None:
        if self.strokes is not None:
            self.strokes.cancel()
            await asyncio.gather(self.strokes, return_exceptions=True)
            self.strokes = None

    async def until_told(self, text: str) -> None:
        async with asyncio.timeout(30.0):
            while text.encode() not in self.told:
                self.news.clear()
                await self.news.wait()

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
async def session(
    config: Path, *arguments: str, peer: WirePeer | None = None, by_lines: bool = False
) -> AsyncIterator[Session]:
    """Begin `vrspray ground ...` beside a vehicle; end what is left of it."""
    vehicle, port = peer or standing(), free_port()
    near, far = os.pipe() if by_lines else (None, None)
    if near is None:
        far, near = pty.openpty()
    command = ("-m", "companion", "ground", *arguments, *(["--hold-lines"] if by_lines else []))
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, *command, "--json", "--config", str(config)),
        *("--set", f"link.url=udpin:127.0.0.1:{port}"),
        stdin=near,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    os.close(near)
    assert far is not None
    found = Session(process=process, peer=vehicle, hand=far)
    ear = asyncio.create_task(found.listen())
    try:
        async with over_udp(vehicle, port):
            yield found
    finally:
        await found.let_go()
        if process.returncode is None:
            process.kill()
        await process.wait()
        await ear
        with contextlib.suppress(OSError):
            os.close(found.hand)
