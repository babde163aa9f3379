"""MAVSDK, written by others, takes the stub for a vehicle."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest

from sitl.stub.mission_items import AUTO, Phase
from sitl.stub.server import StubOptions, StubServer, build_autopilot
from tests.companion.realtime.other_clients import raw_items
from tests.companion.wire_peer import free_port
from tests.sitl.stub_bench import HOME, mission, of_firmware

mavsdk = pytest.importorskip("mavsdk.asyncio")
pytestmark = pytest.mark.sitl
both = pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])


@asynccontextmanager
async def connected(autopilot: str) -> AsyncIterator[tuple[StubServer, Any]]:
    """The stub and MAVSDK's system on one loopback link."""
    port = free_port()
    stub = build_autopilot(
        StubOptions(home=HOME, autopilot=autopilot, speed_m_s=10.0, gust_m_s=0.0),
        start_s=time.monotonic(),
    )
    kind = mavsdk.ComponentType.GROUND_STATION
    async with (
        asyncio.timeout(60.0),
        StubServer(stub, [f"udpout:127.0.0.1:{port}"]) as server,
        mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind)) as client,
    ):
        await client.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await client.first_autopilot(20.0)
        assert system is not None
        yield server, system


async def until(server: StubServer, done: Callable[[], bool]) -> None:
    """Wait until something that the stub has gone through makes `done` true."""
    is_done = asyncio.Event()
    server.ticked = lambda _: is_done.set() if done() else None
    async with asyncio.timeout(20.0):
        await is_done.wait()


@both
async def test_mavsdk_uploads_a_mission_reads_it_back_arms_and_flies_it(autopilot: str) -> None:
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync

    async with connected(autopilot) as (server, system):
        flight = server.autopilot.flight
        missions, action = MissionRawAsync(system), ActionAsync(system)
        items = raw_items(of_firmware(autopilot, mission((0.0, 20.0))))
        await missions.upload_mission(items)
        assert len(flight.items) == len(items) + (autopilot == "px4")
        back = await missions.download_mission()
        first = 1 if autopilot == "ardupilot" else 0
        assert [(item.command, item.x, item.y) for item in back[first:]] == [
            (item.command, item.x, item.y) for item in items[first:]
        ]
        await action.arm()
        assert flight.armed
        await missions.start_mission()
        assert flight.mode == AUTO
        await until(server, lambda: flight.phase is Phase.ROUTE)


@both
async def test_mavsdk_reads_position_and_health_of_the_stub(autopilot: str) -> None:
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    async with connected(autopilot) as (_, system):
        telemetry = TelemetryAsync(system)
        await telemetry.set_rate_position(10.0)
        await telemetry.set_rate_health(5.0)
        async for position in telemetry.subscribe_position():
            assert position.latitude_deg == pytest.approx(HOME.latitude_deg, abs=1e-5)
            assert position.longitude_deg == pytest.approx(HOME.longitude_deg, abs=1e-5)
            break
        async with asyncio.timeout(20.0):
            async for well in telemetry.subscribe_health_all_ok():
                if well:
                    break


PARAMETERS = {
    "ardupilot": ("SERVO9_FUNCTION", "WPNAV_SPEED"),
    "px4": ("PWM_MAIN_FUNC9", "MIS_TAKEOFF_ALT"),
}


@both
async def test_mavsdk_reads_and_sets_parameters(autopilot: str) -> None:
    from mavsdk.asyncio.plugins.param import ParamAsync

    whole, real = PARAMETERS[autopilot]
    async with connected(autopilot) as (server, system):
        kept, client = server.autopilot.parameters, ParamAsync(system)
        assert await client.get_param_int(whole) == kept[whole]
        await client.set_param_int(whole, 305)
        assert kept[whole] == 305
        await client.set_param_float(real, 7.5)
        assert kept[real] == pytest.approx(7.5)
        everything = await client.get_all_params()
        names = {one.name for one in everything.int_params + everything.float_params}
        assert len(names) == len(kept)


@both
async def test_mavsdk_sets_an_actuator(autopilot: str) -> None:
    """One call and two units: microseconds on ArduPilot, -1 to 1 on PX4."""
    from mavsdk.asyncio.plugins.action import ActionAsync

    async with connected(autopilot) as (server, system):
        action, outputs = ActionAsync(system), server.autopilot.outputs
        await action.arm()
        if autopilot == "ardupilot":
            await action.set_actuator(9, 1500.0)
        else:
            await action.set_actuator(1, 0.0)
        await until(server, lambda: outputs.pulses_us(time.monotonic())[8] == 1500)
