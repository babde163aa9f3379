"""A field planned, uploaded, flown, sprayed and judged by four commands, each a process."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.bench.wire import RTK, start
from tests.sitl.client_bench import PLOT_M, RATES_L_HA, prescribed_l, write_field
from tests.sitl.wire_peer import free_port
from tests.unit.stub_bench import HOME

pytest.importorskip("mavsdk.asyncio")
pytestmark = pytest.mark.sitl

# Beside the field: the way home then crosses it at an angle.
DEPOT = "{:.7f},{:.7f}".format(*HOME.to_geographic(12.0, 0.0))
LENGTH_M = PLOT_M * len(RATES_L_HA)


async def done(*command: str) -> dict[str, Any]:
    """Run a command to its end and return its one object."""
    process = await start(*command, "--json")
    async with asyncio.timeout(60.0):
        out, err = await process.communicate()
    assert process.returncode == 0, err.decode()
    found: dict[str, Any] = json.loads(out)
    return found


async def flown(config: Path, serve: tuple[str, ...], port: int) -> tuple[dict[str, Any], ...]:
    """Return what plan, upload and serve say."""
    folder = config.parent
    plan = await done(
        *("plan", str(folder / "field.geojson"), "--config", str(config)),
        *("--angle-deg", "0", "--depot", DEPOT, "--out", str(folder / "field.plan")),
    )
    link, lines = f"udpin:127.0.0.1:{port}", folder / "field.lines.geojson"
    vehicle = await start(
        *("sitl", "serve", "--wait-mission", "--lines", str(lines), "--json"),
        *("--home", str(folder / "field.plan")),
        *("--link", f"udpout:127.0.0.1:{port}", "--field-config", str(config), *serve),
    )
    companion: asyncio.subprocess.Process | None = None
    try:
        upload = await done("upload", str(folder / "field.plan"), "--link", link)
        companion = await start(
            *("run", "--config", str(config), "--set", f"link.url={link}"),
            *("--set", f"mission.lines={lines}"),
        )
        async with asyncio.timeout(60.0):
            out, err = await vehicle.communicate()
        assert vehicle.returncode == 0, err.decode()
        companion.terminate()
        async with asyncio.timeout(10.0):
            _, said = await companion.communicate()
        assert companion.returncode == 0, said.decode()
    finally:
        for process in (vehicle, companion):
            if process is not None and process.returncode is None:
                process.kill()
                await process.communicate()
    return plan, upload, json.loads(out)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
async def test_what_was_planned_is_uploaded_flown_and_sprayed_on_its_lines(
    tmp_path: Path, autopilot: Literal["ardupilot", "px4"]
) -> None:
    config = write_field(tmp_path, autopilot)
    if autopilot == "px4":
        config.write_text(config.read_text().replace("[mission]", '[mission]\nautopilot = "px4"'))
    scenario = tmp_path / "rtk.toml"
    scenario.write_text(RTK)
    plan, upload, flight = await flown(
        config,
        ("--autopilot", autopilot, "--scenario", str(scenario), "--out", str(tmp_path / "truth")),
        free_port(),
    )
    assert plan["volume_l"] == pytest.approx(prescribed_l(), rel=0.01)
    assert (upload["ok"], upload["firmware"]) == (True, autopilot)
    # An uploaded mission of PX4 has no home, and the stub puts its own before it.
    assert flight["uploaded_items"] == upload["items"]
    assert (flight["state"], flight["enabled"], flight["speed_m_s"]) == ("landed", True, 5.0)
    metrics = json.loads((tmp_path / "truth" / "truth.json").read_text())["metrics"]
    assert metrics["missed"] == 0
    assert metrics["lag_distance_m"]["count"] == 6 * (len(RATES_L_HA) - 1)
    assert metrics["lag_distance_m"]["mean_abs"] <= 0.2
    assert metrics["off_target_ml"] < 1.0
    assert flight["volume_l"] == pytest.approx(plan["volume_l"], rel=0.1)
