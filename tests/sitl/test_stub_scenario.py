"""Scenario files: what they can set, and how they are refused."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest

from companion.cli.app import execute
from companion.errors import ConfigError
from sitl.scenario_file import load_scenario
from sitl.serve import ServeOptions, serve
from sitl.stub.faults import FaultKind
from sitl.stub.scenario import Scenario
from sitl.stub.server import StubOptions, build_autopilot, firmware_of, noise_of
from tests.sitl.stub_bench import HOME

EVERYTHING = """
[firmware]
version = "1.14.1"
commands_per_s = 20
[parameters]
PWM_MAIN_FUNC9 = 0
[position]
lag_s = 0.04
white_m = 0.0
velocity_drift_m_s = 0.2
[clock]
drift_ppm = -50.0
uptime_s = 4294900.0
[wind]
speed_m_s = 4.0
from_deg = 270.0
[box]
closed_s = 2.0
[signing]
key = "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f"
[[fault]]
kind = "ack-lost"
command = 187
fraction = 0.5
"""
SCENARIOS = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "scenarios"


def written(folder: Path, text: str) -> Path:
    path = folder / "scenario.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_everything_that_can_be_set_is_set(tmp_path: Path) -> None:
    scenario = load_scenario(written(tmp_path, EVERYTHING))
    assert (scenario.version, scenario.commands_per_s) == ((1, 14, 1), 20.0)
    assert scenario.parameters == {"PWM_MAIN_FUNC9": 0.0}
    assert scenario.wind_towards_m_s == (pytest.approx(4.0), pytest.approx(0.0))
    assert (scenario.box_closed_s, scenario.signing_key) == (2.0, bytes(range(32)))
    assert [fault.kind for fault in scenario.faults] == [FaultKind.ACK_LOST]
    options = StubOptions(home=HOME, autopilot="px4", scenario=scenario)
    assert (noise_of(options).lag_s, noise_of(options).drift_m) == (0.04, 0.1)
    assert noise_of(options).velocity_drift_m_s == 0.2
    stub = build_autopilot(options, start_s=0.0)
    assert stub.firmware.commands_per_s == 20.0
    assert stub.parameters["PWM_MAIN_FUNC9"] == 0.0
    assert stub.boot_ms(10.0) == round((4294900.0 + 10.0) * 1000 * (1 - 50e-6))


def test_an_empty_scenario_is_the_firmware_as_it_is(tmp_path: Path) -> None:
    assert load_scenario(written(tmp_path, "")) == Scenario()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[vehicle]\nmass = 3\n",
            "vehicle = .*: unknown key; .* can have: fault, parameters, firmware",
        ),
        ("[firmware]\nname = 'px5'\n", "firmware.name = .*: unknown key; .* can have: version"),
        ("[firmware]\nversion = '1.16'\n", 'such as "1.16.0"'),
        ("[firmware]\nversion = 1.16\n", 'such as "1.16.0"'),
        ("[firmware]\nversion = '1.16.256'\n", "version = .*: not in the right form"),
        ("[firmware]\ncommands_per_s = 0\n", "write a number from 1 to 1000"),
        ("[position]\nlag_s = nan\n", "position.lag_s = NaN: not finite"),
        (
            "[position]\nlag_s = -0.1\n",
            "position.lag_s = -0.1: out of range; write a number from 0 to 2",
        ),
        (
            "[position]\ndrift_time_s = 0.0\n",
            "drift_time_s = 0.0: out of range; write a number from 1 to",
        ),
        ("[parameters]\nSERVO9_FUNCTION = 'none'\n", "write a number"),
        ("[parameters]\nSERVO9_FUNCTION = true\n", "write a number"),
        ("[box]\nclosed_s = 100\n", "write a number from 0 to 60"),
        ("[signing]\nkey = 'abc'\n", "64 hexadecimal digits"),
        ("[signing]\n", "64 hexadecimal digits"),
        ("clock = 3\n", r"clock = 3: not a table; write a table \[clock\]"),
        ("[[wind]]\nspeed_m_s = 1\n", r"not a table; write a table \[wind\]"),
        (
            "[[fault]]\nkind = 'gremlins'\n",
            r'fault\[0\].kind = "gremlins": not known; write one of "ack-',
        ),
        ("[[fault]]\nkind = [3]\n", r'kind = \[3\]: not known; write one of "ack-lost"'),
        ("[[fault]]\nat_s = 3\n", r'fault\[0\].kind: missing; write one of "ack-lost"'),
        (
            "[[fault]]\nkind = 'rc'\nfraction = 2\n",
            r"fault\[0\].fraction = 2: out of range; write a number from 0 to 1",
        ),
        ("fault = [3]\n", r"fault\[0\] = 3: not a table"),
    ],
)
def test_a_wrong_scenario_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        load_scenario(written(tmp_path, text))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("autopilot", "scenario", "said"),
    [
        ("px4", Scenario(version=(1, 13, 0)), "from 1.14.0 on"),
        ("ardupilot", Scenario(version=(1, 16, 0)), "known from 4.0.0 on"),
        ("ardupilot", Scenario(commands_per_s=30.0), "no queue"),
        ("betaflight", Scenario(), "choose one of ardupilot, px4"),
    ],
)
def test_what_the_firmware_is_not_is_refused(autopilot: str, scenario: Scenario, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        firmware_of(autopilot, scenario)


@pytest.mark.parametrize(
    ("autopilot", "text", "said"),
    [
        ("ardupilot", "[firmware]\nversion = '1.14.1'\n", "4.0.0 on; .* give --autopilot px4"),
        ("ardupilot", "[firmware]\ncommands_per_s = 30\n", "no queue .* give --autopilot px4"),
        ("px4", "[firmware]\nversion = '4.5.0'\n", "1.14.0 on; .* give --autopilot ardupilot"),
        ("px4", "[firmware]\nversion = '3.6.0'\n", "from 1.14.0 on$"),
        ("px5", "[firmware]\nversion = '1.14.1'\n", "ardupilot, px4$"),
    ],
)
def test_a_scenario_of_the_other_autopilot_names_the_option(
    tmp_path: Path, autopilot: str, text: str, said: str
) -> None:
    options = ServeOptions(autopilot=autopilot, scenario=written(tmp_path, text))
    with pytest.raises(ConfigError, match=said):
        asyncio.run(serve(options, lambda _text: None))


def test_a_scenario_that_is_not_there_is_told_in_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert execute(["sitl", "serve", "--json", "--scenario", "nope.toml"]) == 2
    error = "--scenario nope.toml: no such file or directory; give the .toml file of a scenario"
    said = capsys.readouterr()
    assert said.err == f"error: {error}\n"
    assert json.loads(said.out) == {"error": error}


def test_a_parameter_of_the_other_firmware_is_refused() -> None:
    scenario = Scenario(parameters={"PWM_MAIN_FUNC9": 301.0})
    options = StubOptions(home=HOME, scenario=scenario)
    with pytest.raises(ConfigError, match="stub of ardupilot has no such parameter"):
        build_autopilot(options, start_s=0.0)


@pytest.mark.parametrize("path", sorted(SCENARIOS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_ready_scenario_makes_a_stub(path: Path) -> None:
    scenario = load_scenario(path)
    autopilot = "px4" if path.stem.startswith("px4-") else "ardupilot"
    options = StubOptions(home=HOME, autopilot=autopilot, scenario=scenario)
    stub = build_autopilot(options, start_s=0.0)
    stub.tick(1.0)
    assert scenario != Scenario()
    assert stub.firmware.name == autopilot


def test_there_are_ready_scenarios_for_both() -> None:
    names = {path.stem for path in SCENARIOS.glob("*.toml")}
    assert any(name.startswith("px4-") for name in names)
    assert any(not name.startswith("px4-") for name in names)
