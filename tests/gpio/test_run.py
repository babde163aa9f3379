"""`run` with the valve engine on a simulated chip: from a message on the wire to the pins."""

from __future__ import annotations

import asyncio
import os
import signal

import pytest

from companion.link.component import ComponentOptions
from companion.link.vehicle_link import VehicleLink
from companion.output.engine.wire import EngineSetup, Wiring
from companion.output.gpio import GpioExecutor
from companion.runtime import NoRecorder, run
from tests import builders
from tests.companion.wire_peer import WirePeer, free_port, over_udp
from tests.gpio.sim import SimChip

pytestmark = pytest.mark.needs_gpiosim

SETUP = builders.setup()
VALVES = len(SETUP.boom.valves)


@pytest.mark.parametrize("ending", ["disable", "kill the engine"])
async def test_it_sprays_when_it_may_and_closes(chip: SimChip, ending: str) -> None:
    port = free_port()
    link = VehicleLink(f"udpin:127.0.0.1:{port}", ComponentOptions())
    wiring = Wiring(valves=tuple(range(VALVES)), return_line=VALVES, alive_line=VALVES + 1)
    engine = EngineSetup(wiring=wiring, pwm=SETUP.pwm, device=chip.label, wake_late_max_s=60.0)
    executor = GpioExecutor(engine, late_max_s=60.0)
    task = asyncio.create_task(run(SETUP, link=link, executor=executor, recorder=NoRecorder()))

    def has_open_valves() -> bool:
        return any(chip.levels(*wiring.valves))

    try:
        async with over_udp(WirePeer(SETUP.frame, east_m=2.0), port) as peer:
            await peer.until(lambda: executor.status.accepted > 0)
            assert not has_open_valves()
            peer.enable()
            await peer.until(has_open_valves)
            if ending == "disable":
                peer.enable(False)
                await peer.until(lambda: not has_open_valves())
                await asyncio.sleep(0.2)
            else:
                os.kill(executor.engine_pid or 0, signal.SIGKILL)
                await peer.until(lambda: executor.fault is not None)
                await peer.until(lambda: any("engine" in text for text in peer.texts()))
            assert not has_open_valves()
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
    assert not has_open_valves()
