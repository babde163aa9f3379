"""`vrspray config new`: what it writes, `config check` accepts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.cli.app import app, execute
from companion.cli.new_config import Answers, nozzle_flow, text_of
from companion.config import load
from companion.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
MAP = ROOT / "examples" / "anyang" / "prescription.shp"

Captured = pytest.CaptureFixture[str]


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
@pytest.mark.parametrize("output", ["servo", "gpio"])
@pytest.mark.parametrize("valves", ["1", "5", "16"])
def test_what_is_written_passes_the_check(
    autopilot: str, output: str, valves: str, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "field.toml"
    words = ["--autopilot", autopilot, "--output", output, "--valves", valves]
    assert execute(["config", "new", "--yes", "--out", str(out), *words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["ok"], said["problems"]) == (True, [])
    assert any("bucket" in line or "flow" in line for line in said["measure"])
    assert execute(["config", "check", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["problems"] == []
    assert load(out).safety.modes == ("MISSION" if autopilot == "px4" else "AUTO",)


def test_six_questions_are_asked_and_answered(tmp_path: Path) -> None:
    out = tmp_path / "field.toml"
    said = f"px4 udpin:0.0.0.0:14550\ngpio 5\n4 0.5\n03 at 3 bar\n{MAP}\n\n"
    done = CliRunner().invoke(app, ["config", "new", "--out", str(out)], input=said)
    assert done.exit_code == 0, done.output
    assert [f"{number}. " in done.output for number in (1, 2, 3, 4, 5, 6, 7)] == [True] * 6 + [
        False
    ]
    config = load(out)
    assert config.link.url == "udpin:0.0.0.0:14550"
    assert [valve.channel for valve in config.valve] == [5, 6, 7, 8]
    assert [valve.right_m for valve in config.valve] == [-0.75, -0.25, 0.25, 0.75]
    # ISO 03 at 3 bar: 1.18 L/min, four valves.
    assert config.nozzle_sets()[0].flow_max_l_min == pytest.approx(4.737, abs=0.01)
    assert config.prescription is not None
    assert config.resolve(config.prescription.file).resolve() == MAP


@pytest.mark.parametrize(
    "name", sorted(path.stem for path in (ROOT / "examples/profiles").iterdir())
)
def test_every_profile_becomes_a_configuration(name: str, tmp_path: Path, capsys: Captured) -> None:
    out = tmp_path / "field.toml"
    words = ["config", "new", "--yes", "--profile", name, "--out", str(out)]
    assert execute([*words, "--map", str(MAP)]) == 0
    assert load(out).prescription is not None
    assert execute(words) == 2
    assert "is there already" in capsys.readouterr().err
    assert execute([*words, "--force"]) == 0
    assert load(out).prescription is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--autopilot", "betaflight"], "no autopilot; write ardupilot or px4"),
        (["--link", "COM3"], "link.url"),
        (["--output", "relay"], "no output; write servo 9, or gpio 5"),
        (["--valves", "0"], "number of valves"),
        (["--nozzle", "blue"], "flow of one valve"),
        (["--profile", "none"], "not known; write a .toml file, or one of"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line_and_leaves_no_file(
    words: list[str], said: str, tmp_path: Path, capsys: Captured
) -> None:
    assert execute(["config", "new", "--yes", "--out", str(tmp_path / "f.toml"), *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_flow_of_a_valve_is_a_figure_or_an_iso_size() -> None:
    assert nozzle_flow("1.5") == 1.5
    assert nozzle_flow("02 at 2.758 bar") == pytest.approx(0.757, abs=0.001)
    for wrong in ("", "-1", "nan", "ISO", "03 at 0 bar"):
        with pytest.raises(ConfigError):
            nozzle_flow(wrong)


def test_guesses_are_marked() -> None:
    text = text_of(Answers())
    assert text.count("# MEASURE") == 2
    assert "[prescription]" not in text
