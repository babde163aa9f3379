"""MAVProxy, written by others, on one link with the companion and the autopilot.

Skipped where it is not installed: see `test_stub_mavproxy.py`.
"""

from __future__ import annotations

import asyncio
import os
import shutil
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from sitl.stub.mission_items import MissionItem
from sitl.stub.modes import Phase
from tests.sitl.client_bench import Bench, flying_bench, passes, prescribed_l

MAVPROXY = os.environ.get("VRSPRAY_MAVPROXY") or shutil.which("mavproxy.py")
pytestmark = [
    pytest.mark.sitl,
    pytest.mark.skipif(MAVPROXY is None, reason="MAVProxy is not installed"),
]
# MAVProxy 1.8.75 does not know PX4's modes by name.
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
async def console(bench: Bench, folder: Path) -> AsyncIterator[Console]:
    """Connect MAVProxy to the link of the bench."""
    pipe = asyncio.subprocess.PIPE
    options = (f"--master={bench.url}", "--mav20", "--no-state", f"--default-modules={MODULES}")
    process = await asyncio.create_subprocess_exec(
        *(str(MAVPROXY), *options),
        stdin=pipe,
        stdout=pipe,
        stderr=asyncio.subprocess.STDOUT,
        cwd=folder,
        env={**os.environ, "HOME": str(folder)},
    )
    shown = Console(process)
    reading = asyncio.create_task(shown.read())
    try:
        await shown.until(lambda: "Detected vehicle 1:1" in shown.said)
        yield shown
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
        await reading


def mission_file(items: tuple[MissionItem, ...], folder: Path) -> Path:
    """Write the mission for MAVProxy's `wp load`."""
    lines = ["QGC WPL 110"]
    for number, item in enumerate(items):
        place = (item.x_e7 * 1e-7, item.y_e7 * 1e-7, item.z_m)
        row = (number, int(number == 0), item.frame, item.command, 0, 0, 0, 0, *place, 1)
        lines.append("\t".join(str(one) for one in row))
    path = folder / "field.waypoints"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


async def speak_to_the_companion(shown: Console) -> None:
    """Have parameters and commands of the companion's answered; spraying is enabled after it."""
    shown.type("vehicle 1:191")
    shown.type("set param_ftp 0")
    await shown.until(lambda: "Spray: closed: not-enabled" in shown.said)
    await shown.answers("param fetch", "Received 8 parameters")
    await shown.answers("param show SPR_TANK_L", "SPR_TANK_L  ")
    await shown.answers("param set SPR_RATE_PCT 95", "rate 95 %")
    await shown.answers("long 31010 90", "USER_1: ACCEPTED")
    await shown.answers("long 31010 200", "USER_1: DENIED")
    await shown.until(lambda: "rate override: 80 to 110 only" in shown.said)
    await shown.answers("long 31011 12", "USER_2: ACCEPTED")
    await shown.answers("long DO_SPRAYER 1", "DO_SPRAYER: ACCEPTED")
    await shown.answers("status NAMED_VALUE_FLOAT", "name : SPR_")
    # Back to the autopilot, which was there all the time.
    await shown.answers("vehicle 1:1", "Set vehicle 1:1")


async def begin_the_mission(bench: Bench, shown: Console, folder: Path) -> None:
    """Upload the mission, arm, and have it flown."""
    shown.type(f"wp load {mission_file(passes(bench.name), folder)}")
    await shown.until(lambda: "TYPE_MISSION: ACCEPTED" in shown.said)
    shown.type("arm throttle")
    await bench.until(lambda: bench.stub.flight.armed)
    shown.type(TO_AUTO[bench.name])
    await bench.until(lambda: bench.stub.flight.phase is Phase.ROUTE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a home for MAVProxy, which writes where it stands."""
    home = tmp_path / "mavproxy"
    home.mkdir()
    return home


async def test_the_companion_sprays_the_map_while_mavproxy_flies_its_mission(
    tmp_path: Path, folder: Path
) -> None:
    async with (
        asyncio.timeout(80.0),
        flying_bench("ardupilot", tmp_path) as bench,
        console(bench, folder) as shown,
    ):
        await speak_to_the_companion(shown)
        await begin_the_mission(bench, shown, folder)
        await bench.until(lambda: bench.has_flown, within_s=40.0)
        found = bench.judged(tmp_path / "truth")
    assert (found["missed"], found["off_target_ml"]) == (0, 0.0)
    assert found["volume_l"] == pytest.approx(0.9 * prescribed_l(), rel=0.1)


async def test_mavproxy_reaches_both_through_a_router_and_px4_flies_its_mission(
    tmp_path: Path, folder: Path
) -> None:
    async with (
        asyncio.timeout(80.0),
        flying_bench("px4", tmp_path) as bench,
        console(bench, folder) as shown,
    ):
        await speak_to_the_companion(shown)
        await begin_the_mission(bench, shown, folder)
        await bench.until(lambda: bench.has_opened)
