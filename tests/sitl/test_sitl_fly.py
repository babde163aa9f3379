from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.replay import replay
from companion.cli.app import execute
from companion.core.frame import LocalFrame
from companion.errors import ConfigError
from sitl.anyang import anyang_items, anyang_route
from sitl.calibration_mission import write_mission
from sitl.fly import FlyOptions, fly_mission, prepare
from sitl.fly_files import fly_lines
from sitl.routes import read_route
from sitl.stub.mission_items import landing, read_mission

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ANYANG = EXAMPLES / "anyang"
ORCHARD = EXAMPLES / "orchard"
PUMP = EXAMPLES / "pump"
KEYS = {
    "speed_m_s", "method", "lag_distance_m", "settled_lag_distance_m", "misapplied_percent",
    "spraying_accuracy_percent", "limit_ratio", "settled_accuracy_percent", "border_margin_m",
    "off_target_ml", "missed", "apart", "fidelity", "output", "seed",
}  # fmt: skip


@pytest.fixture(scope="module")
def short_mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pass over the example field."""
    folder = tmp_path_factory.mktemp("mission")
    items = anyang_items(5.0)
    end = landing(items[3].latitude_deg, items[3].longitude_deg)
    write_mission((*items[:4], end), folder)
    return folder / "mission.waypoints"


@pytest.fixture
def options(short_mission: Path) -> FlyOptions:
    return FlyOptions(config=ANYANG / "config.toml", mission=short_mission)


def silent(_: str) -> None:
    pass


def command(mission: Path, *more: str, config: Path = ANYANG / "config.toml") -> list[str]:
    return ["sitl", "fly", "--config", str(config), "--mission", str(mission), *more]


def test_one_flight_comes_out_as_one_json_object(
    short_mission: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(command(short_mission, "--json")) == 0
    said = capsys.readouterr()
    result: dict[str, Any] = json.loads(said.out)
    (flight,) = result["flights"]
    assert set(flight) >= KEYS
    assert flight["missed"] == 0
    assert flight["off_target_ml"] == 0.0
    assert flight["limit_ratio"] >= 1.0
    assert result["warnings"] == []
    assert result["notes"] == []
    assert result["times_real_time"] == result["simulated_s"] / result["wall_s"]
    assert "plant wang-2024" in said.err


def test_out_keeps_truth_result_picture_and_a_journal_that_replays(
    short_mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert execute(command(short_mission, "--out", str(out))) == 0
    assert "times real time" in capsys.readouterr().out
    with np.load(out / "truth.npz") as truth:
        assert truth["volume_ml"].shape == (len(truth["time_s"]), 6)
        applied_ml = float(truth["volume_ml"][-1].sum())
    kept = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert kept["flights"][0]["applied_ml"] == pytest.approx(applied_ml)
    found = replay(out / "flight-0001.gpkg")
    assert (found.training, found.coverage_differs) == ("simulated", 0)
    assert found.decisions == kept["flights"][0]["steps"]
    assert found.differences == 0
    assert (out / "flight.png").stat().st_size > 10_000


def test_the_same_seed_gives_the_same_flight(options: FlyOptions, not_compared: None) -> None:
    first, second = (fly_mission(options, silent).result.record for _ in range(2))
    assert np.array_equal(first.volume_ml, second.volume_ml)


def test_the_missions_of_the_example_are_the_flight_of_the_demo() -> None:
    items = anyang_items(5.0)
    for name in ("mission.waypoints", "mission.plan"):
        assert read_mission(ANYANG / name)[1:] == items[1:]


def test_a_mission_file_gives_the_route_in_the_frame_of_the_map() -> None:
    frame = LocalFrame(35.9966, 114.5439)
    route = read_route(ANYANG / "mission.waypoints", frame, speed_m_s=None, default_speed_m_s=9.0)
    wanted = anyang_route(5.0, frame)
    assert route.height_m == wanted.height_m
    assert [leg.speed_m_s for leg in route.legs] == [5.0] * 7
    for leg, other in zip(route.legs, wanted.legs, strict=True):
        assert leg.east_m == pytest.approx(other.east_m, abs=0.02)
        assert leg.north_m == pytest.approx(other.north_m, abs=0.02)


def test_a_speed_on_the_command_line_goes_before_that_of_the_mission(options: FlyOptions) -> None:
    task = prepare(replace(options, speed_m_s=4.0))
    assert {leg.speed_m_s for leg in task.route.legs} == {4.0}
    assert task.speed_m_s == 4.0


def test_the_plant_is_the_one_that_delivers_as_much_as_the_configured_sets() -> None:
    options = FlyOptions(config=ORCHARD / "config.toml", mission=ORCHARD / "mission.plan")
    task = prepare(options)
    assert task.profile.name == "orchard-180"
    assert not task.warnings


def test_rates_above_what_the_sets_deliver_are_a_warning(
    options: FlyOptions, tmp_path: Path
) -> None:
    config = with_map(tmp_path, rate_l_ha=150.0)
    (warning,) = prepare(replace(options, config=config)).warnings
    assert warning.code == "rate-too-high"
    assert "150 L/ha at 5 m/s need 27.00 L/min" in warning.text


def test_a_map_of_which_nothing_can_be_delivered_is_refused(
    short_mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = with_map(tmp_path, rate_l_ha=1.0)
    assert execute(command(short_mission, config=config)) == 2
    assert "nothing of the map can be delivered: 1 L/ha at 5 m/s" in capsys.readouterr().err


def with_map(folder: Path, *, rate_l_ha: float) -> Path:
    """Write the example's configuration with the same field at one rate."""
    outline = json.loads((ANYANG / "boundary.geojson").read_text(encoding="utf-8"))
    outline["features"][0]["properties"] = {"rate": rate_l_ha, "unit": "L/ha"}
    (folder / "map.geojson").write_text(json.dumps(outline), encoding="utf-8")
    text = (ANYANG / "config.toml").read_text(encoding="utf-8")
    text = text.replace("prescription.shp", "map.geojson")
    text = text.replace('boundary = "boundary.geojson"\n', "")
    (folder / "config.toml").write_text(text, encoding="utf-8")
    return folder / "config.toml"


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"config": ORCHARD / "config.toml"}, "does not come over the map"),
        ({"speed_m_s": 40.0}, "--speed 40: give 0.5 to 20 m/s"),
        ({"seed": -1}, "--seed -1"),
        ({"plant": "no-such"}, "no sprayer profile 'no-such'"),
        ({"mission": Path("missing.plan")}, "missing.plan"),
        ({"overrides": ("output.kind=none",)}, "moves no valve; give --output gpio or servo"),
    ],
)
def test_what_does_not_go_together_is_refused(
    options: FlyOptions, change: dict[str, Any], text: str
) -> None:
    with pytest.raises(ConfigError, match=text):
        prepare(replace(options, **change))


def tiny_mission(folder: Path) -> Path:
    """The first two fifths of a pass over the example field."""
    items = anyang_items(5.0)
    first, last = items[1], items[3]
    near = replace(
        last,
        x_e7=round(first.x_e7 + 0.4 * (last.x_e7 - first.x_e7)),
        y_e7=round(first.y_e7 + 0.4 * (last.y_e7 - first.y_e7)),
    )
    end = landing(near.latitude_deg, near.longitude_deg)
    write_mission((*items[:3], near, end), folder)
    return folder / "mission.waypoints"


def test_a_pump_has_no_least_possible_and_is_warned_of_short_zones(tmp_path: Path) -> None:
    options = FlyOptions(config=PUMP / "config.toml", mission=tiny_mission(tmp_path), plant="pump")
    flown = fly_mission(options, silent)
    result = flown.as_json()
    assert flown.perfect is None
    assert result["flights"][0]["limit_ratio"] is None
    text = "\n".join(fly_lines(result))
    assert "misapplied" in text
    assert "least possible" not in text
    (warning,) = result["warnings"]
    assert warning["code"] == "zones-too-short"
    assert "3.8 s that the pump's flow takes" in warning["text"]
    assert "19 m and more" in warning["fix"]


@pytest.mark.parametrize(("speed_m_s", "warns"), [(5.0, True), (2.0, False)])
def test_zones_are_too_short_for_a_pump_by_their_time(
    short_mission: Path, speed_m_s: float, warns: bool
) -> None:
    config = PUMP / "config.toml"
    options = FlyOptions(config=config, mission=short_mission, plant="pump", speed_m_s=speed_m_s)
    assert ("zones-too-short" in {problem.code for problem in prepare(options).warnings}) is warns


def with_drift(folder: Path, table: str) -> Path:
    """Write the example's configuration with an offset for the wind."""
    text = (ANYANG / "config.toml").read_text(encoding="utf-8")
    for name in ("prescription.shp", "boundary.geojson"):
        text = text.replace(f'"{name}"', f'"{(ANYANG / name).as_posix()}"')
    path = folder / "drift.toml"
    path.write_text(f"{text}\n[drift]\nenabled = true\n{table}\n", encoding="utf-8")
    return path


def test_an_offset_for_the_wind_is_told_and_the_least_possible_has_none(
    options: FlyOptions, tmp_path: Path
) -> None:
    windy = with_drift(tmp_path, "droplet_um = 250.0\nwind = [2.0, 270.0]")
    mission = tiny_mission(tmp_path)
    flown = fly_mission(replace(options, config=windy, mission=mission), silent)
    calm = fly_mission(replace(options, mission=mission), silent)
    assert flown.perfect == calm.perfect
    assert flown.evaluation != calm.evaluation
    notes = [line for line in fly_lines(flown.as_json()) if line.startswith("note: ")]
    assert len(notes) == 1
    assert "judged at the nozzle" in notes[0]


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ("", "no wind is told; give drift.wind"),
        ("wind = [20.0, 270.0]", "above safety.wind_max_m_s"),
    ],
)
def test_an_offset_that_moves_nothing_says_why(
    options: FlyOptions, tmp_path: Path, table: str, text: str
) -> None:
    config = with_drift(tmp_path, f"droplet_um = 250.0\n{table}")
    flown = fly_mission(replace(options, config=config, mission=tiny_mission(tmp_path)), silent)
    (note,) = flown.as_json()["notes"]
    assert text in note


def scenario(folder: Path, kind: str) -> Path:
    path = folder / "scenario.toml"
    path.write_text(
        f'[[fault]]\nkind = "{kind}"\nat_s = 10.0\nduration_s = 5.0\n', encoding="utf-8"
    )
    return path


@pytest.mark.parametrize(
    ("kind", "inhibit"),
    [
        ("no-position", "stale-position"),
        ("stale-position", "estimator-unhealthy"),
        ("zero-position", "invalid-position"),
        ("heading-unknown", "heading-unknown"),
        ("gps-drop", "fix-too-low"),
        ("mode", "wrong-mode"),
        ("silence", "stale-heartbeat"),
    ],
)
def test_a_fault_of_the_scenario_closes_the_valves(
    options: FlyOptions, tmp_path: Path, kind: str, inhibit: str, not_compared: None
) -> None:
    flown = fly_mission(replace(options, scenario=scenario(tmp_path, kind)), silent)
    assert inhibit in flown.result.inhibits
    record = flown.result.record
    volume_ml = record.volume_ml.sum(axis=1)
    under_fault = (record.time_s > 13.0) & (record.time_s < 14.9)
    assert np.ptp(volume_ml[under_fault]) == 0.0
    assert volume_ml[-1] > 0.0


def test_a_scenario_that_is_not_there_is_named_with_its_option(
    short_mission: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(command(short_mission, "--scenario", "nope.toml")) == 2
    error = "--scenario nope.toml: no such file or directory; give the .toml file of a scenario"
    assert capsys.readouterr().err == f"error: {error}\n"


def test_an_unknown_kind_of_fault_is_refused_with_the_known_ones(
    options: FlyOptions, tmp_path: Path
) -> None:
    with pytest.raises(
        ConfigError, match='"gremlins": not known; write one of "ack-lost", "ack-late"'
    ):
        prepare(replace(options, scenario=scenario(tmp_path, "gremlins")))


def test_a_fault_of_the_wire_is_refused(options: FlyOptions, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'ack-lost' needs a wire"):
        prepare(replace(options, scenario=scenario(tmp_path, "ack-lost")))
