"""`run` with the valve engine: from a message on the wire to the levels of the lines."""

from __future__ import annotations

import asyncio
import os
import signal
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
MASK = (1 << VALVES) - 1


@pytest.mark.parametrize("ending", ["disable", "kill the engine", "stop the engine"])
async def test_it_sprays_when_it_may_and_closes(tmp_path: Path, ending: str) -> None:
    levels = tmp_path / "levels"
    port = free_port()
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions())
    wiring = Wiring(valves=tuple(range(VALVES)), return_line=VALVES, alive_line=VALVES + 1)
    executor = GpioExecutor(
        EngineSetup(wiring=wiring, pwm=SETUP.pwm, backend="file", device=str(levels))
    )
    task = asyncio.create_task(run(SETUP, link=link, executor=executor, recorder=NoRecorder()))

    def open_valves() -> int:
        return int.from_bytes(levels.read_bytes(), "little") & MASK if levels.exists() else 0

    try:
        async with over_udp(WirePeer(SETUP.frame, east_m=2.0), port) as peer:
            await peer.until(lambda: executor.status.accepted > 0)
            assert open_valves() == 0
            peer.enable()
            await peer.until(lambda: open_valves() != 0)
            if ending == "disable":
                peer.enable(False)
                await peer.until(lambda: executor.status.at_s > 0 and not open_valves())
                await asyncio.sleep(0.2)
            else:
                number = signal.SIGKILL if ending == "kill the engine" else signal.SIGSTOP
                os.kill(executor.engine_pid or 0, number)
                await peer.until(lambda: executor.fault is not None)
                await peer.until(lambda: any("engine" in text for text in peer.texts()))
            assert open_valves() == 0
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert open_valves() == 0
