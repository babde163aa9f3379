"""A field planned, uploaded, flown, sprayed and judged by four commands, each a process."""

from __future__ import annotations

import asyncio
import json
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.bench.wire import RTK, start
from tests.sitl import client_bench
from tests.sitl.wire_peer import free_port
from tests.unit.stub_bench import HOME

pytest.importorskip("mavsdk.asyncio")
pytestmark = pytest.mark.sitl

# Beside the field: the way home then crosses it at an angle.
DEPOT = "{:.7f},{:.7f}".format(*HOME.to_geographic(12.0, 0.0))
RATES_L_HA, PLOT_M, FIRST_M = (15.0, 25.0), 8.0, 9.0
# One pass of 6 m: strips lie wholly in the field, 2.5 mm from its border.
WIDTH_M = 6.006


def write_field(folder: Path, autopilot: Literal["ardupilot", "px4"]) -> Path:
    """Write two plots, a pass wide, with a configuration for them; return that."""
    config = client_bench.write_field(folder, autopilot)
    ends_m = [FIRST_M + number * PLOT_M for number in range(len(RATES_L_HA) + 1)]
    plots = [
        (client_bench._ring(south, north, 0.5 * WIDTH_M), {"rate": rate})
        for (south, north), rate in zip(pairwise(ends_m), RATES_L_HA, strict=True)
    ]
    # Wider than the field: the border rule shall not cost the outer valves their plots.
    outline = client_bench._ring(ends_m[0], ends_m[-1], 0.5 * WIDTH_M + 0.6)
    (folder / "field.geojson").write_text(client_bench._features(*plots))
    (folder / "boundary.geojson").write_text(client_bench._features((outline, {})))
    # No buffer, as in the plan: the field is as wide as the boom.
    text = config.read_text().replace('"inside"', '"inside"\nborder_buffer_m = 0.0')
    config.write_text(text)
    return config


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


# PX4 tells of its mission every ten seconds only, and is armed before: the companion asks for it.
@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
async def test_what_was_planned_is_uploaded_flown_and_sprayed_on_its_lines(
    tmp_path: Path, autopilot: Literal["ardupilot", "px4"]
) -> None:
    config = write_field(tmp_path, autopilot)
    scenario = tmp_path / "rtk.toml"
    scenario.write_text(RTK)
    plan, upload, flight = await flown(
        config,
        ("--autopilot", autopilot, "--scenario", str(scenario), "--out", str(tmp_path / "truth")),
        free_port(),
    )
    asked_l = sum(RATES_L_HA) * PLOT_M * WIDTH_M / 10_000.0
    assert plan["volume_l"] == pytest.approx(asked_l, rel=0.02)
    assert (upload["ok"], upload["firmware"]) == (True, autopilot)
    assert flight["uploaded_items"] == upload["items"]
    assert (flight["state"], flight["enabled"], flight["speed_m_s"]) == ("landed", True, 5.0)
    metrics = json.loads((tmp_path / "truth" / "truth.json").read_text())["metrics"]
    assert metrics["missed"] == 0
    # Flown from the far end, where it starts from a stop, an outer valve is barely open before it
    # changes: that one counts apart.
    assert metrics["apart"] <= 1
    assert metrics["lag_distance_m"]["count"] == 6 * (len(RATES_L_HA) - 1) - metrics["apart"]
    assert metrics["lag_distance_m"]["mean_abs"] <= 0.2
    assert metrics["off_target_ml"] < 1.0
    assert flight["volume_l"] == pytest.approx(plan["volume_l"], rel=0.1)
