"""PX4 over a real socket: the companion orders its actuators and hits the boundaries."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.record.reader import read_journal
from sitl.serve import ServeOptions
from tests.bench.wire import RTK, example, fly
from tests.bench.wire_clock import fly as fly_by_clock
from tests.sitl.test_wire_flight import check_pass, write_field, write_mission
from tests.sitl.wire_peer import free_port

pytestmark = pytest.mark.sitl


def short_field(folder: Path, port: int) -> Path:
    """Return the configuration of one row of plots under a PX4."""
    config = example(folder, autopilot="px4", port=port)
    write_field(folder)
    write_mission(folder / "short.waypoints")
    text = config.read_text(encoding="utf-8")
    text = text.replace('rate_field = "rate"', 'rate_field = "rate"\nunit = "L/ha"')
    config.write_text(text, encoding="utf-8")
    return config


def test_each_change_falls_on_its_boundary_under_px4(tmp_path: Path) -> None:
    # Real bytes on a clock of their own: what is asked for here must not hang on a busy computer.
    config = short_field(tmp_path / "field", 14550)
    # As measured, PX4's position without corrections is 0.1 m off: more than is asked for here.
    scenario = tmp_path / "rtk.toml"
    scenario.write_text(RTK, encoding="utf-8")
    result, fault = fly_by_clock(
        config,
        ServeOptions(
            autopilot="px4",
            field_config=config,
            mission=config.parent / "short.waypoints",
            scenario=scenario,
            seed=5,
            out=config.parent / "truth",
        ),
    )
    assert fault is None
    check_pass(result)


async def test_px4_is_found_out_and_sprays_over_a_real_socket(tmp_path: Path) -> None:
    port = free_port()
    config = short_field(tmp_path / "field", port)
    result, said = await fly(
        config,
        port,
        *("--autopilot", "px4", "--seed", "5"),
        *("--mission", str(config.parent / "short.waypoints")),
        within_s=100.0,
    )
    assert result["state"] == "landed"
    # A third of it at least: how exactly it falls is the other test's matter.
    assert result["volume_l"] > 0.2
    # The stub's disarmed values are PX4's own: named, and no reason to stay closed.
    warning = "PWM_MAIN_DIS9 is 900: set it to 1000 (and 5 more)"
    assert warning in said
    (journal,) = (config.parent / "flights").glob("*.gpkg")
    events = [(event.kind, event.text) for event in read_journal(journal).events]
    assert ("outputs", warning) in events


async def test_an_actuator_that_no_output_shows_keeps_all_closed(tmp_path: Path) -> None:
    port = free_port()
    config = short_field(tmp_path / "field", port)
    scenario = tmp_path / "wrong.toml"
    scenario.write_text("[parameters]\nPWM_MAIN_FUNC11 = 0\n", encoding="utf-8")
    result, said = await fly(
        config,
        port,
        *("--autopilot", "px4", "--scenario", str(scenario)),
        *("--mission", str(config.parent / "short.waypoints")),
        within_s=100.0,
    )
    assert "no output for channel 3: set its PWM_MAIN_FUNCn or PWM_AUX_FUNCn to 303" in said
    truth = json.loads((config.parent / "truth" / "truth.json").read_text(encoding="utf-8"))
    assert truth["state"] == result["state"] == "landed"
    assert truth["volume_l"] == 0.0
