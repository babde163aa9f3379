"""MAVProxy, written by others, takes the stub for a vehicle: headless, driven by its own console.

Skipped where it is not installed: see docs/contributing/testing.md.
"""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from sitl.stub.autopilot import Autopilot
from sitl.stub.mission_items import AUTO, Phase
from sitl.stub.server import StubOptions, StubServer, build_autopilot
from tests.companion.realtime.other_clients import (
    TO_AUTO,
    Console,
    mavproxy,
    needs_mavproxy,
    waypoint_file,
)
from tests.companion.wire_peer import free_port
from tests.sitl.stub_bench import HOME, mission, of_firmware

pytestmark = [pytest.mark.sitl, needs_mavproxy]
PARAMETERS = {
    "ardupilot": ("SERVO9_FUNCTION", 22, "WPNAV_SPEED"),
    "px4": ("PWM_MAIN_FUNC9", 305, "MPC_XY_CRUISE"),
}


@asynccontextmanager
async def stub_and_console(
    autopilot: str, folder: Path
) -> AsyncIterator[tuple[Autopilot, Console]]:
    """The stub and MAVProxy on one loopback link."""
    port = free_port()
    stub = build_autopilot(
        StubOptions(home=HOME, autopilot=autopilot, speed_m_s=10.0, gust_m_s=0.0),
        start_s=time.monotonic(),
    )
    async with (
        StubServer(stub, [f"udpout:127.0.0.1:{port}"]) as server,
        mavproxy(f"udpin:127.0.0.1:{port}", folder) as shown,
    ):
        server.ticked = lambda _: shown.look_again()
        yield stub, shown


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
async def test_mavproxy_sets_parameters_uploads_a_mission_arms_and_flies_it(
    autopilot: str, tmp_path: Path
) -> None:
    whole, number, real = PARAMETERS[autopilot]
    items = of_firmware(autopilot, mission((0.0, 20.0)))
    async with stub_and_console(autopilot, tmp_path) as (stub, shown):
        count = len(stub.parameters)
        # The parameters come one by one, since files are refused.
        await shown.until(lambda: f"Received {count} parameters" in shown.said)
        shown.type(f"param set {whole} {number}")
        await shown.until(lambda: stub.parameters[whole] == number)
        shown.type(f"param set {real} 7.5")
        await shown.until(lambda: stub.parameters[real] == 7.5)
        shown.type(f"wp load {waypoint_file(items, tmp_path)}")
        await shown.until(lambda: len(stub.flight.items) == 4)
        await shown.until(lambda: "TYPE_MISSION: ACCEPTED" in shown.said)
        shown.type("arm throttle")
        await shown.until(lambda: stub.flight.armed and "ARMED" in shown.said)
        shown.type(TO_AUTO[autopilot])
        await shown.until(lambda: stub.flight.mode == AUTO)
        await shown.until(lambda: stub.flight.phase is Phase.ROUTE)
        assert "DO_SET_MODE: ACCEPTED" in shown.said
