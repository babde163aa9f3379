"""PX4, byte by byte on virtual time: the companion orders its actuators and hits the boundaries.

Over real sockets `test_mission_chain.py` and `test_clients_mavsdk.py` fly beside it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from analysis.journals.content import read_journal
from companion.cli.record_parts import follow
from companion.config import load
from companion.journal.journal import Journal
from missions.maps.compiling import compiled_setup
from sitl.serve import ServeOptions
from tests.bench.wire import RTK, example
from tests.bench.wire_clock import fly as fly_by_clock
from tests.companion.realtime.test_wire_flight import check_pass, write_field, write_mission
from tests.virtual_time import START_S

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


def kept_flight(
    config: Path, scenario: str = ""
) -> tuple[dict[str, Any], list[tuple[str, str]], list[str]]:
    """Fly with a journal; return what the stub says, the journal's events, and the faults."""
    setup, options = compiled_setup(load(config)), {}
    if scenario:
        options["scenario"] = config.parent / "scenario.toml"
        options["scenario"].write_text(scenario, encoding="utf-8")
    with Journal.create(
        config.parent / "flights", setup=setup, started_s=START_S, waits=True, training="no"
    ) as journal:
        result, fault = fly_by_clock(
            config,
            ServeOptions(
                autopilot="px4",
                field_config=config,
                mission=config.parent / "short.waypoints",
                seed=5,
                out=config.parent / "truth",
                **options,
            ),
            recorder=journal,
            setup=setup,
            wired=lambda link, executor: follow(journal, link, executor),
        )
    events = [(event.kind, event.text) for event in read_journal(journal.path).events]
    return result, events, [] if fault is None else [fault]


def test_px4_is_found_out_and_each_change_falls_on_its_boundary(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # Real bytes on a clock of their own: what is asked for here must not hang on a busy computer.
    # As measured, PX4's position without corrections is 0.1 m off: more than is asked for here.
    result, events, faults = kept_flight(short_field(tmp_path / "field", 14550), RTK)
    assert result["state"] == "landed"
    check_pass(result)
    assert faults == []
    # The stub's disarmed values are PX4's own: named, and no reason to stay closed.
    warning = "PWM_MAIN_DIS9 is 900: set it to 1000 (and 5 more)"
    assert warning in caplog.text
    assert ("outputs", warning) in events


def test_an_actuator_that_no_output_shows_keeps_all_closed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = short_field(tmp_path / "field", 14550)
    result, events, faults = kept_flight(config, "[parameters]\nPWM_MAIN_FUNC11 = 0\n")
    said = "no output for channel 3: set its PWM_MAIN_FUNCn or PWM_AUX_FUNCn to 303"
    assert said in caplog.text
    assert any(said in text for _, text in events)
    assert said in " ".join(faults)
    truth = json.loads((config.parent / "truth" / "truth.json").read_text(encoding="utf-8"))
    assert truth["state"] == result["state"] == "landed"
    assert truth["volume_l"] == 0.0
