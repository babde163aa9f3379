"""Clients written by others, as tests drive them: MAVProxy by its console, items for MAVSDK.

MAVProxy is no part of the development environment; docs/contributing/testing.md says how to
have it.
"""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import AsyncIterator, Callable, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from sitl.stub.mission_items import MissionItem

MAVPROXY = os.environ.get("VRSPRAY_MAVPROXY") or shutil.which("mavproxy.py")
needs_mavproxy = pytest.mark.skipif(
    MAVPROXY is None, reason="MAVProxy is not installed, and VRSPRAY_MAVPROXY does not name it"
)
# MAVProxy 1.8.75 does not know PX4's modes by name: its `mode MISSION` fails in itself.
TO_AUTO = {"ardupilot": "mode AUTO", "px4": "long DO_SET_MODE 1 4 4"}
MODULES = "log,wp,param,mode,arm,cmdlong,misc,link,ftp"


class Console:
    """MAVProxy's console."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.said = ""
        self._process = process
        self._news = asyncio.Event()

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())

    async def read(self) -> None:
        assert self._process.stdout is not None
        while received := await self._process.stdout.read(4096):
            self.said += received.decode(errors="replace")
            self._news.set()

    def look_again(self) -> None:
        """Have `until` look again: something else than the console has changed."""
        self._news.set()

    async def until(self, done: Callable[[], bool], *, within_s: float = 30.0) -> None:
        try:
            async with asyncio.timeout(within_s):
                while not done():
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            pytest.fail(f"did not happen; MAVProxy said:\n{self.said}")

    async def answers(self, line: str, expected: str) -> None:
        """Type a line and wait for what it is to be answered."""
        before = self.said.count(expected)
        self.type(line)
        await self.until(lambda: self.said.count(expected) > before)


@asynccontextmanager
async def mavproxy(master: str, folder: Path) -> AsyncIterator[Console]:
    """Start MAVProxy on a link and wait until it knows the vehicle; it writes into the folder."""
    pipe = asyncio.subprocess.PIPE
    options = (f"--master={master}", "--mav20", "--no-state", f"--default-modules={MODULES}")
    process = await asyncio.create_subprocess_exec(
        *(str(MAVPROXY), *options),
        stdin=pipe,
        stdout=pipe,
        stderr=asyncio.subprocess.STDOUT,
        cwd=folder,
        env={**os.environ, "HOME": str(folder)},
    )
    console = Console(process)
    reading = asyncio.create_task(console.read())
    try:
        await console.until(lambda: "Detected vehicle 1:1" in console.said)
        yield console
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
        await reading


def waypoint_file(items: Iterable[MissionItem], folder: Path) -> Path:
    """Write a mission for MAVProxy's `wp load`."""
    lines = ["QGC WPL 110"]
    for number, item in enumerate(items):
        place = (item.x_e7 * 1e-7, item.y_e7 * 1e-7, item.z_m)
        row = (number, int(number == 0), item.frame, item.command, 0, 0, 0, 0, *place, 1)
        lines.append("\t".join(str(one) for one in row))
    path = folder / "field.waypoints"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def raw_items(items: Iterable[MissionItem]) -> list[Any]:
    """Return a mission as MAVSDK uploads it; it has to be installed."""
    from mavsdk.plugins.mission_raw import MissionItem as RawItem

    return [
        RawItem(
            seq=number,
            frame=item.frame,
            command=item.command,
            current=int(number == 0),
            autocontinue=1,
            param1=item.param1,
            param2=item.param2,
            param3=item.param3,
            param4=item.param4,
            x=item.x_e7,
            y=item.y_e7,
            z=item.z_m,
            mission_type=0,
        )
        for number, item in enumerate(items)
    ]
