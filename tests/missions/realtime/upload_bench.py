"""The stub on a socket, for what uploads to it."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import shapely

from missions.demand import Uniform
from missions.field import build_field
from missions.files.write import write_plan
from missions.plan import Settings
from missions.planner import plan_mission
from sitl.stub.server import StubOptions, StubServer, build_autopilot
from tests.bench.missions import FRAME, to_degrees
from tests.companion.wire_peer import free_port
from tests.sitl.stub_bench import HOME


@asynccontextmanager
async def stub_on_a_port(autopilot: str) -> AsyncIterator[tuple[StubServer, str]]:
    """Serve the stub and return it with the link URL that leads to it."""
    port = free_port()
    stub = build_autopilot(
        StubOptions(home=HOME, autopilot=autopilot, gust_m_s=0.0), start_s=time.monotonic()
    )
    async with StubServer(stub, [f"udpout:127.0.0.1:{port}"]) as server:
        yield server, f"udpin:127.0.0.1:{port}"


def sorties(folder: Path, count: int, *, suffix: str = ".plan") -> list[Path]:
    """Plan a field with a hole and return the files of its first sorties."""
    ground = shapely.box(0, 0, 300, 40.0 * (1 + count // 4)).difference(shapely.box(90, 12, 96, 18))
    assert isinstance(ground, shapely.Polygon)
    field = build_field(to_degrees(ground), swath_width_m=6.0, frame=FRAME)
    tank_l = field.area_m2 / 1e4 * 20.0 / count
    settings = Settings(
        swath_width_m=6.0, speed_m_s=6.0, tank_l=tank_l, reserve_l=0.0, angle_deg=90.0, moves=0
    )
    plan = plan_mission(field, settings, Uniform(rate_l_ha=20.0))
    return write_plan(plan, folder / f"m{suffix}")[:count]
