"""Plan files read by MAVSDK's own reader, which knows nothing of how they were written."""

from __future__ import annotations

import asyncio
import json
import math
from pathlib import Path
from typing import Any

import pytest

from missions.demand import Uniform
from missions.field import build_field
from missions.files.write import write_plan
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.surroundings import Surroundings
from missions.terrain import Terrain
from sitl.stub.mission_items import read_mission
from tests.bench.missions import FRAME, to_degrees
from tests.missions.realtime.upload_bench import stub_on_a_port
from tests.missions.test_missions_terrain import dem_of, hill

mavsdk = pytest.importorskip("mavsdk.asyncio")
pytestmark = pytest.mark.sitl


def plan_with(autopilot: Any) -> Plan:
    """Return a plan over a hill around a mast: heights, fence, obstacle and rally point."""
    from shapely import box

    field = build_field(
        to_degrees(box(0, 0, 200, 140)), obstacles=[to_degrees(box(90, 50, 100, 60))],
        swath_width_m=6.0, frame=FRAME,
    )  # fmt: skip
    settings = Settings(
        swath_width_m=6.0, speed_m_s=6.0, moves=0, angle_deg=90.0, autopilot=autopilot
    )
    terrain = Terrain(dem=dem_of(hill), frame=FRAME, by_vehicle=autopilot == "ardupilot")
    return plan_mission(
        field, settings, Uniform(rate_l_ha=20.0), depots=(FRAME.to_geographic(0.0, 0.0),),
        around=Surroundings(terrain=terrain),
    )  # fmt: skip


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
async def test_another_reader_finds_the_same_items_fence_and_rally_points(
    autopilot: str, tmp_path: Path
) -> None:
    from mavsdk.asyncio.plugins.mission_raw import MissionRawAsync

    path = write_plan(plan_with(autopilot), tmp_path / "m.plan",
                      with_sprayer=autopilot == "ardupilot")[0]  # fmt: skip
    configuration = mavsdk.Configuration.create_with_component_type(
        mavsdk.ComponentType.GROUND_STATION
    )
    async with (
        asyncio.timeout(60.0),
        stub_on_a_port(autopilot) as (_, url),
        mavsdk.Mavsdk(configuration) as client,
    ):
        await client.add_any_connection(url.replace("udpin:", "udpin://"))
        system = await client.first_autopilot(20.0)
        found = await MissionRawAsync(system).import_qgroundcontrol_mission(str(path))
    ours = read_mission(path)
    theirs = found.mission_items
    # MAVSDK puts home in front where the file is for ArduPilot, as ours always has it.
    skipped = len(ours) - len(theirs)
    assert skipped in (0, 1)
    pairs = list(zip(ours[skipped:], theirs, strict=True))[1 - skipped :]
    assert len(pairs) > 20
    for mine, other in pairs:
        assert mine.command == other.command
        # One rounds to whole 1e-7 degrees, the other cuts.
        assert max(abs(mine.x_e7 - other.x), abs(mine.y_e7 - other.y)) <= 1
        assert other.frame in (mine.frame, {3: 6, 10: 11, 0: 5}.get(mine.frame))
        assert other.z == pytest.approx(mine.z_m, abs=1e-3)
        assert other.param1 == pytest.approx(mine.param1)
        assert other.autocontinue == 1
        assert math.isnan(other.param4) or other.param4 == pytest.approx(mine.param4)
    fence = json.loads(path.read_text())["geoFence"]
    kinds = {5001 if each["inclusion"] else 5002 for each in fence["polygons"]}
    kinds |= {5003 if each["inclusion"] else 5004 for each in fence["circles"]}
    assert len(kinds) == 2  # where to be, and the mast
    assert {item.command for item in found.geofence_items} == kinds
    assert [(item.command, item.x) for item in found.rally_items] == [(5100, 480_000_000)]
