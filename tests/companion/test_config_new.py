"""`vrspray config new`: what it writes, `config check` accepts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.cli.app import app, execute
from companion.cli.new_config import Answers, _with_swath, _with_valves, nozzle_flow, text_of
from companion.config import load
from companion.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
MAP = ROOT / "examples" / "anyang" / "prescription.shp"

Captured = pytest.CaptureFixture[str]

pytestmark = pytest.mark.usefixtures("compiles_here")


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
@pytest.mark.parametrize("output", ["servo", "gpio"])
@pytest.mark.parametrize("valves", ["1", "5", "16"])
def test_what_is_written_passes_the_check(
    autopilot: str, output: str, valves: str, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "field.toml"
    if (autopilot, output, valves) == ("px4", "servo", "16"):
        pytest.skip("PX4 has six")
    words = ["--autopilot", autopilot, "--output", output, "--valves", valves]
    assert execute(["config", "new", "--yes", "--out", str(out), *words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["ok"], said["problems"]) == (True, [])
    assert any("bucket" in line or "flow" in line for line in said["measure"])
    assert execute(["config", "check", str(out), "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert checked["problems"] == []
    assert [note for note in checked["notes"] if "there is no map yet" in note]
    assert checked["notes"] == said["notes"]
    assert load(out).safety.modes == ("MISSION" if autopilot == "px4" else "AUTO",)


@pytest.mark.parametrize(
    ("autopilot", "output", "dither_us", "guard", "said"),
    [
        ("ardupilot", "servo", 0, "auto", "watchdog script is seen"),
        ("ardupilot", "servo 9 board", 8, "auto", "driver board closes"),
        ("ardupilot", "servo none", 0, "none-on-power-loss", "nothing closes"),
        ("px4", "servo", 0, "auto", "nothing will be sprayed"),
        ("PX4", "servo 1 board", 8, "auto", "driver board closes"),
        ("px4", "servo 1 none", 0, "none-on-power-loss", "nothing closes"),
        ("px4", "gpio 5", 0, "auto", ""),
    ],
)
def test_what_closes_without_power_is_written_and_said(
    autopilot: str,
    output: str,
    dither_us: int,
    guard: str,
    said: str,
    tmp_path: Path,
    capsys: Captured,
) -> None:
    out = tmp_path / "field.toml"
    words = ["--autopilot", autopilot, "--output", output]
    assert execute(["config", "new", "--yes", "--out", str(out), *words]) == 0
    written = load(out).output
    assert (written.dither_us, written.guard) == (dither_us, guard)
    # In the file, by its own line; and wherever the configuration is looked at.
    assert (f'guard = "{guard}"' in out.read_text()) is bool(said)
    assert said in capsys.readouterr().out
    assert execute(["config", "check", "--config", str(out)]) == 0
    assert said in capsys.readouterr().out
    assert execute(["doctor", "--config", str(out), "--no-link"]) in (0, 1)
    (line,) = [each for each in capsys.readouterr().out.splitlines() if "output-guard" in each]
    assert said in line
    # Whether a script is on the vehicle, its link tells.
    level = "ok" if "board" in said else "warn" if "nothing" in said else "-"
    assert line.split()[0] == level


def test_px4_without_a_board_is_said_to_spray_nothing(tmp_path: Path, capsys: Captured) -> None:
    out = tmp_path / "field.toml"
    assert execute(["config", "new", "--yes", "--out", str(out), "--autopilot", "px4"]) == 0
    given = ["--config", str(out), "--set", "output.dither_us=0"]
    capsys.readouterr()
    assert execute(["config", "check", *given]) == 0
    assert "nothing will be sprayed" in capsys.readouterr().out
    assert execute(["doctor", "--no-link", *given]) in (0, 1)
    assert "warn  output-guard: PX4 has no watchdog script" in capsys.readouterr().out


PX4 = ("--autopilot", "px4")


@pytest.mark.parametrize(
    ("made", "changes", "key"),
    [
        ((*PX4,), ("output.return_channel=7",), "valve"),
        ((*PX4, "--valves", "5"), ("output.return_channel=7",), "output.return_channel"),
        ((*PX4, "--valves", "4"), ("valve[3].channel=9",), "valve[3].channel"),
        ((*PX4,), ('safety.modes=["AUTO"]',), "safety.modes"),
        ((), ('safety.modes=["MISSION"]',), "safety.modes"),
    ],
)
def test_what_its_autopilot_cannot_do_is_refused_before_it_is_built(
    made: tuple[str, ...], changes: tuple[str, ...], key: str, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "field.toml"
    assert execute(["config", "new", "--yes", "--out", str(out), *made]) == 0
    given = [word for change in changes for word in ("--set", change)]
    assert execute(["config", "check", str(out)]) == 0
    capsys.readouterr()
    assert execute(["config", "check", str(out), *given, "--json"]) == 2
    (found,) = [
        each for each in json.loads(capsys.readouterr().out)["problems"]
        if each["severity"] == "error"
    ]  # fmt: skip
    assert found["where"] == key
    assert execute(["doctor", "--config", str(out), "--no-link", *given]) == 1
    assert f"fail  configuration: {key}: " in capsys.readouterr().out


def test_px4_takes_no_eight_valves(tmp_path: Path, capsys: Captured) -> None:
    out = tmp_path / "field.toml"
    words = ["config", "new", "--yes", "--out", str(out), "--valves", "8"]
    assert execute([*words, *PX4]) == 2
    assert "PX4 takes orders for 6" in capsys.readouterr().err
    assert not out.exists()
    # Nothing is known of an autopilot that is not named; lines of this computer are as many.
    assert execute([*words, *PX4, "--output", "gpio"]) == 0
    assert execute([*words, "--force"]) == 0
    text = out.read_text().replace('autopilot = "ardupilot"\n', "")
    out.write_text(text)
    assert execute(["config", "check", str(out), "--set", 'safety.modes=["MISSION"]']) == 0


@pytest.mark.parametrize("command", ["check", "show"])
def test_a_configuration_is_named_as_doctor_and_run_name_it(command: str, capsys: Captured) -> None:
    path = str(ROOT / "examples" / "anyang" / "config.toml")
    assert execute(["config", command, path]) == 0
    plain = capsys.readouterr().out
    assert execute(["config", command, "--config", path]) == 0
    assert capsys.readouterr().out == plain
    assert execute(["config", command]) == 2
    assert "name the configuration" in capsys.readouterr().err


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


def test_what_cannot_be_is_asked_again(tmp_path: Path) -> None:
    out = tmp_path / "field.toml"
    said = f"rover\npx4\nrelay\nservo\n6\n6 1\nnone.csv\nblue\n1.5\nno-map.shp\n{MAP}\nwide\n6\n"
    done = CliRunner().invoke(app, ["config", "new", "--out", str(out)], input=said)
    assert done.exit_code == 0, done.output
    assert [done.output.count(f"{number}. ") for number in range(1, 7)] == [2, 2, 2, 3, 2, 2]
    assert "none.csv: there is no such file" in done.output
    assert load(out).boom_table.width_m == 6.0


def test_an_answer_that_the_configuration_refuses_is_asked_again_at_once(tmp_path: Path) -> None:
    """The sixth question is too late for a link that is none, or for valves that PX4 has not."""
    out = tmp_path / "field.toml"
    said = "px4 somewhere\npx4\nservo 7\nservo 2\n6 1\n5 1,0\n03\n0,8\n\n12\n5\n"
    done = CliRunner().invoke(app, ["config", "new", "--out", str(out)], input=said)
    assert done.exit_code == 0, done.output
    assert [done.output.count(f"{number}. ") for number in range(1, 7)] == [2, 2, 2, 2, 1, 2]
    assert "/tmp" not in done.output.partition("written:")[0]
    assert "PX4 numbers its actuators from 1 to 6" in done.output
    assert "5 valves 1 m apart cover 5 m" in done.output
    config = load(out)
    assert [valve.channel for valve in config.valve] == [2, 3, 4, 5, 6]
    assert config.nozzle_sets()[0].flow_max_l_min == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("text", "flow_l_min"),
    [
        ("0.8", 0.8), ("0,8", 0.8), ("3", 3.0), ("0.8 L/min", 0.8),
        ("03 at 3 bar", 1.184), ("ISO 03 at 3,0 bar", 1.184), ("03 at 40 psi", 1.136),
        ("03 @ 300 kPa", 1.184), ("03 at 3bar", 1.184),
        # The size of ISO 10625 has its point behind the second digit.
        ("015 at 40 psi", 0.568), ("0067 at 40 psi", 0.254), ("10 at 40 psi", 3.787),
        ("1.5 at 40 psi", 0.568),
    ],
)  # fmt: skip
def test_a_flow_is_understood_as_people_write_it(text: str, flow_l_min: float) -> None:
    assert nozzle_flow(text) == pytest.approx(flow_l_min, abs=0.002)


@pytest.mark.parametrize("text", ["03", "015", "ISO 03", "iso 3", "blue", "", "nan", "03 at 3"])
def test_a_size_without_its_pressure_is_no_flow_and_the_forms_are_told(text: str) -> None:
    with pytest.raises(ConfigError, match="03 at 3 bar, at 40 psi, at 300 kPa") as refused:
        nozzle_flow(text)
    assert "\n" not in str(refused.value)


def test_a_swath_that_is_not_that_of_the_valves_is_refused(
    tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "field.toml"
    words = ["config", "new", "--yes", "--out", str(out), "--valves", "4", "--spacing-m", "0.5"]
    assert execute([*words, "--swath-m", "6"]) == 2
    assert "4 valves 0.5 m apart cover 2 m" in capsys.readouterr().err
    assert not out.exists()
    assert execute([*words, "--swath-m", "2"]) == 0
    assert [valve.right_m for valve in load(out).valve] == [-0.75, -0.25, 0.25, 0.75]
    assert execute([*words[:5], "--valves", "1", "--swath-m", "3", "--force"]) == 0


BUCKET = """duty,seconds,millilitres,set
0.2,60,1481,1-6
0.4,60,2672,1-6
0.6,60,3790,1-6
0.8,60,5021,1-6
1.0,60,6090,1-6
"""


@pytest.mark.parametrize("is_asked", [False, True])
def test_a_bucket_test_gives_the_flows_instead_of_a_guess(is_asked: bool, tmp_path: Path) -> None:
    out, table = tmp_path / "field.toml", tmp_path / "bucket.csv"
    table.write_text(BUCKET)
    words = ["config", "new", "--out", str(out)]
    words += [] if is_asked else ["--yes", "--nozzle", str(table), "--json"]
    done = CliRunner().invoke(app, words, input=f"\n\n\n{table}\n\n\n" if is_asked else None)
    assert done.exit_code == 0, done.output
    (curve,) = load(out).nozzle_set
    assert curve.valves == ("1", "2", "3", "4", "5", "6")
    assert curve.flow_l_min == pytest.approx((1.481, 2.672, 3.790, 5.021, 6.090), rel=0.03)
    assert "MEASURE: flow" not in out.read_text()
    if not is_asked:
        assert "flow" not in " ".join(json.loads(done.stdout)["measure"])


def test_a_bucket_test_of_other_valves_is_refused(tmp_path: Path, capsys: Captured) -> None:
    out, table = tmp_path / "field.toml", tmp_path / "bucket.csv"
    table.write_text(BUCKET)
    words = ["config", "new", "--yes", "--valves", "4", "--out", str(out), "--nozzle", str(table)]
    assert execute(words) == 2
    assert "nozzle_set" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize("profile", [[], ["--profile", "wang-2024-normally-closed"]])
def test_a_map_without_a_unit_needs_one(
    profile: list[str], tmp_path: Path, capsys: Captured
) -> None:
    zone = tmp_path / "zone.geojson"
    corners = [[114.0, 36.0], [114.01, 36.0], [114.01, 36.01], [114.0, 36.0]]
    geometry = {"type": "Polygon", "coordinates": [corners]}
    feature = {"type": "Feature", "properties": {"rate": 18}, "geometry": geometry}
    zone.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    out = tmp_path / "field.toml"
    words = ["config", "new", "--yes", "--out", str(out), "--map", str(zone), "--force", *profile]
    assert execute(words) == 2
    said = capsys.readouterr()
    assert "no unit is given" in said.err
    assert f"{out} is not written" in said.err
    assert {path.name for path in tmp_path.iterdir()} <= {zone.name, "state"}  # maps kept
    assert execute([*words, "--unit", "L/ha"]) == 0
    assert load(out).prescription.unit == "L/ha"  # type: ignore[union-attr]
    assert execute([*words, "--unit", "furlongs"]) == 2
    assert "write one of L/ha" in capsys.readouterr().err
    blank = tmp_path / "my zone.geojson"
    zone.rename(blank)
    told = f"\n\n\n\n{blank}\n{blank} L/ha\n\n"
    asking = ["config", "new", "--out", str(out), "--force"]
    done = CliRunner().invoke(app, asking, input=told)
    assert (done.exit_code, done.output.count("does not say the unit")) == (0, 1)
    assert load(out).prescription.unit == "L/ha"  # type: ignore[union-attr]


@pytest.mark.parametrize("text", ["8 0.5", "8 0,5", "8, 0.5", "8,0.5", "8;0,5 m", "8 x 0,5m"])
def test_valves_and_spacing_are_understood_as_people_write_them(text: str) -> None:
    found = _with_swath(_with_valves(Answers(), text), "4,0 m")
    assert (found.valves, found.spacing_m, found.swath_m) == (8, 0.5, 4.0)


@pytest.mark.parametrize("text", ["8", "8.5 1", "eight 1", "8 1 2", "-8 1", "8 nan"])
def test_a_refusal_of_valves_repeats_the_forms(text: str) -> None:
    with pytest.raises(ConfigError, match=r"such as 6 1\.0 or 8 0,5"):
        _with_valves(Answers(), text)


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
        (["--autopilot", "betaflight"], "not an autopilot; write ardupilot or px4"),
        (["--link", "COM3"], "link.url"),
        (["--output", "relay"], "not an output; write servo 9, or gpio 5"),
        (["--autopilot", "px4", "--output", "servo 1 script"], "PX4 has no watchdog script"),
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


def test_a_file_from_a_profile_says_that_it_is_of_another_sprayer(tmp_path: Path) -> None:
    out = tmp_path / "field.toml"
    words = ["config", "new", "--yes", "--profile", "wang-2024-normally-open", "--out", str(out)]
    assert execute(words) == 0
    first, *rest = out.read_text().splitlines()
    assert "from a profile" in first
    assert "a relay that cuts the pump" in " ".join(rest)


@pytest.mark.parametrize("broken", ["not a map", '{"type": "FeatureCollection", "features": []}'])
def test_a_map_that_cannot_be_flown_is_refused_before_anything_is_written(
    broken: str, tmp_path: Path, capsys: Captured
) -> None:
    out, field = tmp_path / "field.toml", tmp_path / "field.geojson"
    field.write_text(broken)
    assert execute(["config", "new", "--yes", "--out", str(out), "--map", str(field)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "field.geojson" in line
    assert {path.name for path in tmp_path.iterdir()} <= {field.name, "state"}  # maps kept
