"""MAVProxy, written by others, on one link with the companion and the autopilot.

Skipped where it is not installed: see docs/contributing/testing.md.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from sitl.stub.mission_items import Phase
from tests.companion.realtime.client_bench import Bench, flying_bench, passes, prescribed_l
from tests.companion.realtime.other_clients import (
    TO_AUTO,
    Console,
    mavproxy,
    needs_mavproxy,
    waypoint_file,
)

pytestmark = [pytest.mark.sitl, needs_mavproxy]


async def speak_to_the_companion(shown: Console) -> None:
    """Have parameters and commands of the companion's answered; spraying is enabled after it."""
    shown.type("vehicle 1:191")
    shown.type("set param_ftp 0")
    await shown.until(lambda: "Spray off: not enabled" in shown.said)
    await shown.answers("param fetch", "Received 8 parameters")
    await shown.answers("param show SPR_TANK_L", "SPR_TANK_L  ")
    await shown.answers("param set SPR_RATE_PCT 95", "rate 95 %")
    await shown.answers("long 31010 90", "USER_1: ACCEPTED")
    await shown.answers("long 31010 200", "USER_1: DENIED")
    await shown.until(lambda: "rate override: 80 to 110 only" in shown.said)
    await shown.answers("long 31011 12", "USER_2: ACCEPTED")
    await shown.answers("long DO_SPRAYER 1", "DO_SPRAYER: ACCEPTED")
    await shown.answers("status NAMED_VALUE_FLOAT", "name : SPR_")
    # Back to the autopilot, which was there all the time.
    await shown.answers("vehicle 1:1", "Set vehicle 1:1")


async def begin_the_mission(bench: Bench, shown: Console, folder: Path) -> None:
    """Upload the mission, arm, and have it flown."""
    shown.type(f"wp load {waypoint_file(passes(bench.name), folder)}")
    await shown.until(lambda: "TYPE_MISSION: ACCEPTED" in shown.said)
    shown.type("arm throttle")
    await bench.until(lambda: bench.stub.flight.armed)
    shown.type(TO_AUTO[bench.name])
    await bench.until(lambda: bench.stub.flight.phase is Phase.ROUTE)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a home for MAVProxy, which writes where it stands."""
    home = tmp_path / "mavproxy"
    home.mkdir()
    return home


async def test_the_companion_sprays_the_map_while_mavproxy_flies_its_mission(
    tmp_path: Path, folder: Path
) -> None:
    async with (
        asyncio.timeout(80.0),
        flying_bench("ardupilot", tmp_path) as bench,
        mavproxy(bench.url, folder) as shown,
    ):
        await speak_to_the_companion(shown)
        await begin_the_mission(bench, shown, folder)
        await bench.until(lambda: bench.has_flown, within_s=40.0)
        found = bench.judged(tmp_path / "truth")
    assert found["missed"] == 0
    # An order to close that a busy computer sends late puts some drops beyond the border.
    assert found["off_target_ml"] <= 0.01 * 1000.0 * found["volume_l"]
    assert found["volume_l"] == pytest.approx(0.9 * prescribed_l(), rel=0.1)


async def test_mavproxy_reaches_both_through_a_router_and_px4_flies_its_mission(
    tmp_path: Path, folder: Path
) -> None:
    async with (
        asyncio.timeout(80.0),
        flying_bench("px4", tmp_path) as bench,
        mavproxy(bench.url, folder) as shown,
    ):
        await speak_to_the_companion(shown)
        await begin_the_mission(bench, shown, folder)
        await bench.until(lambda: bench.has_opened)
