"""`run` with an engine that fails its self-test: it is told of, stays, and opens nothing."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.engine.wire import EngineSetup, Wiring
from companion.output.gpio import GpioExecutor
from companion.runtime import NoRecorder, run
from tests import builders
from tests.companion.wire_peer import WirePeer, free_port, over_udp

pytestmark = pytest.mark.sitl

SETUP = builders.setup()
VALVES = len(SETUP.boom.valves)


@pytest.mark.parametrize("cause", ["wakes up late", "no such device"])
async def test_it_is_told_once_stays_and_opens_nothing(tmp_path: Path, cause: str) -> None:
    late = cause == "wakes up late"
    levels = tmp_path / ("levels" if late else "missing/levels")
    port = free_port()
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions())
    executor = GpioExecutor(
        EngineSetup(
            wiring=Wiring(valves=tuple(range(VALVES))),
            pwm=SETUP.pwm,
            backend="file",
            device=str(levels),
            wake_late_max_s=0.0 if late else None,
        )
    )
    task = asyncio.create_task(run(SETUP, link=link, executor=executor, recorder=NoRecorder()))
    try:
        async with over_udp(WirePeer(SETUP.frame, east_m=2.0), port) as peer:
            await peer.until(lambda: any("engine" in text for text in peer.texts()))
            peer.enable()
            await asyncio.sleep(0.5)
            assert not task.done()
            assert executor.fault is not None
            assert sum("valve engine" in text for text in peer.texts()) == 1
            assert not any(levels.read_bytes() if levels.exists() else b"")
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert executor.engine_pid is None
