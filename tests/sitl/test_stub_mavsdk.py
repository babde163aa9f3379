"""MAVSDK, written by others, takes the stub for a vehicle."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from sitl.stub.build import StubOptions, build_autopilot
from sitl.stub.modes import AUTO, Phase
from sitl.stub.server import StubServer
from tests.sitl.test_stub_links import free_port
from tests.unit.stub_bench import HOME, mission

mavsdk = pytest.importorskip("mavsdk.asyncio")
pytestmark = pytest.mark.sitl


@asynccontextmanager
async def connected() -> AsyncIterator[tuple[StubServer, Any]]:
    """The stub and MAVSDK's system on one loopback link."""
    port = free_port()
    autopilot = build_autopilot(
        StubOptions(home=HOME, speed_m_s=10.0, gust_m_s=0.0), start_s=time.monotonic()
    )
    kind = mavsdk.ComponentType.GROUND_STATION
    async with (
        asyncio.timeout(60.0),
        StubServer(autopilot, [f"udpout:127.0.0.1:{port}"]) as server,
        mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(kind)) as client,
    ):
        await client.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await client.first_autopilot(20.0)
        assert system is not None
        yield server, system


def raw_items() -> list[Any]:
    from mavsdk.plugins.mission_raw import MissionItem

    return [
        MissionItem(
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
        for number, item in enumerate(mission((0.0, 20.0)))
    ]


async def test_mavsdk_uploads_a_mission_reads_it_back_arms_and_flies_it() -> None:
    from mavsdk.asyncio.plugins.action import ActionAsync
    from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync

    async with connected() as (server, system):
        flight = server.autopilot.flight
        missions, action = MissionRawAsync(system), ActionAsync(system)
        items = raw_items()
        await missions.upload_mission(items)
        assert len(flight.items) == len(items)
        back = await missions.download_mission()
        assert [(item.command, item.x, item.y) for item in back[1:]] == [
            (item.command, item.x, item.y) for item in items[1:]
        ]
        await action.arm()
        assert flight.armed
        await missions.start_mission()
        assert flight.mode == AUTO
        on_route = asyncio.Event()
        server.ticked = lambda _: on_route.set() if flight.phase is Phase.ROUTE else None
        async with asyncio.timeout(20.0):
            await on_route.wait()


async def test_mavsdk_reads_position_and_health_of_the_stub() -> None:
    from mavsdk.asyncio.plugins.telemetry import TelemetryAsync

    async with connected() as (_, system):
        telemetry = TelemetryAsync(system)
        await telemetry.set_rate_position(10.0)
        async for position in telemetry.subscribe_position():
            assert position.latitude_deg == pytest.approx(HOME.latitude_deg, abs=1e-6)
            assert position.longitude_deg == pytest.approx(HOME.longitude_deg, abs=1e-6)
            break
