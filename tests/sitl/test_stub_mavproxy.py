"""MAVProxy, written by others, takes the stub for a vehicle: headless, driven by its own console.

It is no part of the development environment (its graphics weigh 900 MB). Name its `mavproxy.py` in
VRSPRAY_MAVPROXY, or have it on the PATH; without it this is skipped. It needs none of its graphics:

    python -m venv mp; mp/bin/pip install pymavlink pyserial numpy defusedxml pynmeagps setuptools
    mp/bin/pip install --no-deps MAVProxy==1.8.75
"""

from __future__ import annotations

import asyncio
import os
import shutil
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from sitl.stub.autopilot import Autopilot
from sitl.stub.build import StubOptions, build_autopilot
from sitl.stub.modes import AUTO, Phase
from sitl.stub.server import StubServer
from tests.sitl.test_stub_links import free_port
from tests.unit.stub_bench import HOME, mission

MAVPROXY = os.environ.get("VRSPRAY_MAVPROXY") or shutil.which("mavproxy.py")
pytestmark = [
    pytest.mark.sitl,
    pytest.mark.skipif(MAVPROXY is None, reason="MAVProxy is not installed"),
]
MODULES = "log,wp,param,mode,arm,cmdlong,misc,link,ftp"

# MAVProxy 1.8.75 does not know PX4's modes by name: its `mode MISSION` fails in itself.
TO_AUTO = {"ardupilot": "mode AUTO", "px4": "long DO_SET_MODE 1 4 4"}
PARAMETERS = {
    "ardupilot": ("SERVO9_FUNCTION", 22, "WPNAV_SPEED"),
    "px4": ("PWM_MAIN_FUNC9", 305, "MPC_XY_CRUISE"),
}


class Console:
    """MAVProxy's console and the stub on the other side of it."""

    def __init__(self, process: asyncio.subprocess.Process, stub: Autopilot) -> None:
        self.stub = stub
        self.said = ""
        self._process = process
        self._ticked = asyncio.Event()

    def tick(self, _now_s: float) -> None:
        """Take note that the stub has gone on."""
        self._ticked.set()

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())

    async def read(self) -> None:
        assert self._process.stdout is not None
        while received := await self._process.stdout.read(4096):
            self.said += received.decode(errors="replace")

    async def until(self, done: Callable[[], bool], *, within_s: float = 30.0) -> None:
        try:
            async with asyncio.timeout(within_s):
                while not done():
                    self._ticked.clear()
                    await self._ticked.wait()
        except TimeoutError:
            pytest.fail(f"did not happen; MAVProxy said:\n{self.said}")


@asynccontextmanager
async def console(autopilot: str, folder: Path) -> AsyncIterator[Console]:
    """MAVProxy on one loopback link with the stub."""
    port = free_port()
    stub = build_autopilot(
        StubOptions(home=HOME, autopilot=autopilot, speed_m_s=10.0, gust_m_s=0.0),
        start_s=time.monotonic(),
    )
    link = f"--master=udpin:127.0.0.1:{port}"
    options = (link, "--mav20", "--no-state", f"--default-modules={MODULES}")
    async with StubServer(stub, [f"udpout:127.0.0.1:{port}"]) as server:
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            *(str(MAVPROXY), *options),
            stdin=pipe,
            stdout=pipe,
            stderr=asyncio.subprocess.STDOUT,
            cwd=folder,
            env={**os.environ, "HOME": str(folder)},
        )
        shown = Console(process, stub)
        server.ticked = shown.tick
        reading = asyncio.create_task(shown.read())
        try:
            await shown.until(lambda: "Detected vehicle 1:1" in shown.said)
            yield shown
        finally:
            if process.returncode is None:
                process.kill()
            await process.wait()
            await reading


def mission_file(autopilot: str, folder: Path) -> Path:
    """Write the mission as each firmware wants it: ArduPilot's begins with home."""
    items = mission((0.0, 20.0))[0 if autopilot == "ardupilot" else 1 :]
    lines = ["QGC WPL 110"]
    for number, item in enumerate(items):
        place = (item.x_e7 * 1e-7, item.y_e7 * 1e-7, item.z_m)
        row = (number, int(number == 0), item.frame, item.command, 0, 0, 0, 0, *place, 1)
        lines.append("\t".join(str(one) for one in row))
    path = folder / "field.waypoints"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
async def test_mavproxy_sets_parameters_uploads_a_mission_arms_and_flies_it(
    autopilot: str, tmp_path: Path
) -> None:
    whole, number, real = PARAMETERS[autopilot]
    async with console(autopilot, tmp_path) as shown:
        stub = shown.stub
        count = len(stub.parameters)
        # The parameters come one by one, since files are refused.
        await shown.until(lambda: f"Received {count} parameters" in shown.said)
        shown.type(f"param set {whole} {number}")
        await shown.until(lambda: stub.parameters[whole] == number)
        shown.type(f"param set {real} 7.5")
        await shown.until(lambda: stub.parameters[real] == 7.5)
        shown.type(f"wp load {mission_file(autopilot, tmp_path)}")
        await shown.until(lambda: len(stub.flight.items) == 4)
        await shown.until(lambda: "TYPE_MISSION: ACCEPTED" in shown.said)
        shown.type("arm throttle")
        await shown.until(lambda: stub.flight.armed and "ARMED" in shown.said)
        shown.type(TO_AUTO[autopilot])
        await shown.until(lambda: stub.flight.mode == AUTO)
        await shown.until(lambda: stub.flight.phase is Phase.ROUTE)
        assert "DO_SET_MODE: ACCEPTED" in shown.said
