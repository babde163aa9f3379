"""What an independent client meets: the stub with its sprayer, and `vrspray run` as a process.

Two ways to share a link. ArduPilot: everybody has a TCP port of the autopilot, which passes on
what is for others, as its SITL does. PX4, which passes nothing on by itself: a router.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import shapely

from companion.cli.field_choice import RESTART, RESTARTS
from companion.config import load
from missions.maps.compiling import compiled_setup
from sitl.serve import judge
from sitl.stub.mission_items import MissionItem
from sitl.stub.server import StubOptions, StubServer, TruthLog, build_autopilot
from sitl.stub.sprayer import Sprayer, SprayerOptions
from sitl.stub.world import ARDUPILOT_NOISE, PX4_NOISE
from tests.companion.realtime.udp_router import udp_router
from tests.sitl.stub_bench import HOME, mission, of_firmware

EXAMPLE = Path(__file__).parents[3] / "examples" / "anyang"
SPEED_M_S = 5.0
RATES_L_HA = (15.0, 25.0)
PLOT_M, WIDTH_M, FIRST_M, RUN_OUT_M = 8.0, 6.0, 9.0, 7.0
CLOSED_US, FULL_US = 1000, 2000
# Without corrections PX4's position is 0.1 m off, which is more than is asked for here.
_PX4_RTK = replace(PX4_NOISE, drift_m=ARDUPILOT_NOISE.drift_m)


class Bench:
    """The vehicle as it truly is, and the companion's process; `url` is for the client."""

    def __init__(self, autopilot: str, config: Path) -> None:
        start_s = time.monotonic()
        self.name, self.config, self.url = autopilot, config, ""
        self.sprayer = Sprayer(SprayerOptions(seed=1), start_s=start_s)
        self.stub = build_autopilot(
            StubOptions(
                home=HOME,
                autopilot=autopilot,
                speed_m_s=SPEED_M_S,
                gust_m_s=0.0,
                noise=None if autopilot == "ardupilot" else _PX4_RTK,
                seed=1,
            ),
            start_s=start_s,
            written=self.sprayer.take,
        )
        self.truth = TruthLog(self.stub.flight.world, self.sprayer, HOME)
        self.said = ""
        self._ticked = asyncio.Event()

    def tick(self, now_s: float) -> None:
        """Let the sprayer and the log of the truth follow the stub."""
        self.sprayer.advance(now_s)
        self.truth.tick(now_s, flying=self.stub.flight.armed)
        self._ticked.set()

    async def until(self, done: Callable[[], bool], *, within_s: float = 20.0) -> None:
        """Wait until something that the stub has gone through makes `done` true."""
        try:
            async with asyncio.timeout(within_s):
                while not done():
                    self._ticked.clear()
                    await self._ticked.wait()
        except TimeoutError:
            pytest.fail(f"did not happen; the companion said:\n{self.said}")

    async def read(self, process: asyncio.subprocess.Process) -> None:
        """Keep what the companion's process says."""
        assert process.stderr is not None
        while line := await process.stderr.readline():
            self.said += line.decode()

    @property
    def is_in_the_air(self) -> bool:
        return self.stub.flight.in_air

    @property
    def has_opened(self) -> bool:
        """Tell whether a pulse that opens a valve has come out of the autopilot."""
        return any(order.pulse_us > CLOSED_US + 20 for order in self.sprayer.orders)

    @property
    def has_flown(self) -> bool:
        return self.stub.flight.mission_complete

    def judged(self, folder: Path) -> dict[str, Any]:
        """Return what truly reached the ground, in the flight's metrics and in litres."""
        summary = {"seed": 1, "speed_m_s": SPEED_M_S, **self.truth.summary()}
        self.truth.write(folder, summary)
        setup = compiled_setup(load(self.config))
        metrics = judge(folder, setup, closed_us=CLOSED_US, full_us=FULL_US)
        return {**metrics, "volume_l": summary["volume_l"]}


@asynccontextmanager
async def flying_bench(autopilot: str, folder: Path, *overrides: str) -> AsyncIterator[Bench]:
    """Run the stub and `vrspray run` on one link, to which a client may come."""
    async with (
        vehicle_bench(autopilot, write_field(folder, autopilot)) as bench,
        companion_of(bench, *overrides),
    ):
        yield bench


@asynccontextmanager
async def vehicle_bench(autopilot: str, config: Path) -> AsyncIterator[Bench]:
    """Run the stub alone, with the sprayer of a configuration."""
    bench = Bench(autopilot, config)
    async with AsyncExitStack() as stack:
        if autopilot == "ardupilot":
            server = await stack.enter_async_context(StubServer(bench.stub, ["tcpin:127.0.0.1:0"]))
            bench.url = f"tcp:127.0.0.1:{server.ports[0]}"
        else:
            router = await stack.enter_async_context(udp_router())
            bench.url = f"udpout:127.0.0.1:{router.port}"
            server = await stack.enter_async_context(StubServer(bench.stub, [bench.url]))
        server.ticked = bench.tick
        yield bench


def _started(bench: Bench, *overrides: str, **environment: str) -> Any:
    return asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "companion", "run", "--config", str(bench.config)),
        *(word for one in (f"link.url={bench.url}", *overrides) for word in ("--set", one)),
        env={**os.environ, **environment},
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )


@asynccontextmanager
async def service_of(bench: Bench, *overrides: str) -> AsyncIterator[list[int]]:
    """Run `vrspray run` as the service does: one that ends with 75 is started anew.

    Yields how each that has ended did so.
    """
    ended: list[int] = []
    running: list[asyncio.subprocess.Process] = []

    async def serve() -> None:
        while not ended or ended[-1] == RESTART:
            process = await _started(bench, *overrides, **{RESTARTS: str(RESTART)})
            running.append(process)
            await bench.read(process)
            ended.append(await process.wait())

    serving = asyncio.create_task(serve())
    try:
        yield ended
        assert not serving.done(), bench.said
        running[-1].terminate()
        async with asyncio.timeout(10.0):
            await serving
        assert ended[-1] == 0, bench.said
    finally:
        serving.cancel()
        for process in running:
            if process.returncode is None:
                process.kill()
                await process.wait()
        await asyncio.gather(serving, return_exceptions=True)
    assert "Traceback" not in bench.said, bench.said


@asynccontextmanager
async def companion_of(bench: Bench, *overrides: str) -> AsyncIterator[None]:
    """Run `vrspray run` on the bench's link; it ends in order."""
    process = await _started(bench, *overrides)
    reading = asyncio.create_task(bench.read(process))
    try:
        yield
        assert process.returncode is None, bench.said
        process.terminate()
        async with asyncio.timeout(10.0):
            assert await process.wait() == 0, bench.said
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
        await reading
    assert "Traceback" not in bench.said, bench.said


# ------------------------------------------------------------------------------------- the field


def _ring(south_m: float, north_m: float, half_m: float) -> dict[str, Any]:
    box = shapely.box(-half_m, south_m, half_m, north_m)
    placed = shapely.transform(
        box, lambda xy: [HOME.to_geographic(x, y)[::-1] for x, y in xy.tolist()]
    )
    geometry: dict[str, Any] = json.loads(shapely.to_geojson(placed))
    return geometry


def _features(*found: tuple[dict[str, Any], dict[str, float]]) -> str:
    features = [{"type": "Feature", "geometry": g, "properties": p} for g, p in found]
    return json.dumps({"type": "FeatureCollection", "features": features})


def write_field(folder: Path, autopilot: str) -> Path:
    """Write a row of plots, northwards, with a configuration for it; return that."""
    ends_m = [FIRST_M + i * PLOT_M for i in range(len(RATES_L_HA) + 1)]
    rings = [_ring(south, north, 0.5 * WIDTH_M) for south, north in pairwise(ends_m)]
    rated = zip(rings, ({"rate": rate} for rate in RATES_L_HA), strict=True)
    shutil.copy(EXAMPLE / "config.toml", folder)
    (folder / "field.geojson").write_text(_features(*rated))
    # A little wider than the boom: the border rule shall not cost the outer valves their plots.
    outline = _ring(ends_m[0], ends_m[-1], 0.5 * WIDTH_M + 0.6)
    (folder / "boundary.geojson").write_text(_features((outline, {})))
    config = folder / "config.toml"
    text = config.read_text().replace('"prescription.shp"', '"field.geojson"\nunit = "L/ha"')
    # No script runs on this stub, and no board is behind it.
    text = text.replace('kind = "servo"', 'kind = "servo"\nguard = "none-on-power-loss"')
    if autopilot == "px4":
        # Its channels are actuators, 1 to 6; the stub has them at its outputs 9 to 14.
        numbers = iter(range(1, 7))
        text = re.sub(r"channel = \d+", lambda _: f"channel = {next(numbers)}", text)
        text = text.replace('modes = ["AUTO"]', 'modes = ["MISSION"]')
        # Its positions are 10 ms late and not 31 (docs/howto/connect-px4.md).
        text = text.replace("position_s = 0.0349", "position_s = 0.0100")
    config.write_text(text)
    return config


def kept_parameters(folder: Path) -> dict[str, float]:
    """Return the parameters that the companion has kept for its next start."""
    kept: dict[str, float] = json.loads(next(folder.rglob("parameters.json")).read_text())
    return kept


def passes(autopilot: str) -> tuple[MissionItem, ...]:
    """Return one pass over the field, to hover behind it, as each firmware wants it."""
    items = mission((0.0, FIRST_M + len(RATES_L_HA) * PLOT_M + RUN_OUT_M), land=False)
    return of_firmware(autopilot, items)


def prescribed_l() -> float:
    """Return what the map asks for on the whole field."""
    return sum(RATES_L_HA) * PLOT_M * WIDTH_M / 10_000.0
