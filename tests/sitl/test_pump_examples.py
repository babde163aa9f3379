"""The examples with motors, each flown over a part of its field; sprayers that do not fit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute
from companion.core.frame import LocalFrame
from companion.errors import ConfigError
from sitl.calibration_mission import write_mission
from sitl.fly import FlyOptions, prepare
from sitl.stub.mission_items import speed, waypoint
from sitl.stub.protocol import dialect

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
FIELD = EXAMPLES / "pump-sections"
# Keys of a result that the twin of a sprayer with motors adds.
DROPS = {
    "atomiser", "wanted_um", "droplet_class", "in_class_percent", "near_percent", "mean_vmd_um",
}  # fmt: skip


@pytest.fixture(scope="module")
def two_zones(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Out of the last zone but one over the slanted end, along the first pass."""
    folder = tmp_path_factory.mktemp("mission")
    plan = json.loads((FIELD / "mission.plan").read_text(encoding="utf-8"))["mission"]["items"]
    first, last = (plan[n]["params"][4:6] for n in (0, 2))
    frame = LocalFrame(*first)
    east_m, north_m = frame.to_local(*last)
    length_m = (east_m**2 + north_m**2) ** 0.5
    share = 1.0 - 140.0 / length_m
    start = frame.to_geographic(share * east_m, share * north_m)
    go, hop = dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_TAKEOFF
    items = (
        waypoint(go, *start, height_m=0.0),
        waypoint(hop, *start, height_m=3.5),
        speed(5.0),
        waypoint(go, *last, height_m=3.5),
    )
    write_mission(items, folder)
    return folder / "mission.waypoints"


def flown(
    example: str, mission: Path, capsys: pytest.CaptureFixture[str], *more: str
) -> dict[str, Any]:
    config = EXAMPLES / example / "config.toml"
    arguments = ["sitl", "fly", "--config", str(config), "--mission", str(mission), "--json"]
    assert execute([*arguments, *more]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_a_pump_with_sections_follows_its_zones_and_stays_inside(
    two_zones: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = flown("pump-sections", two_zones, capsys)
    (flight,) = result["flights"]
    assert flight["plant"] == "pump-sections"
    assert flight["lag_distance_m"]["count"] == 6
    assert flight["lag_distance_m"]["max_abs"] < 1.5
    assert flight["off_target_ml"] == 0.0
    # Each section shuts by itself at the slanted end.
    assert 0.0 < flight["border_margin_m"]["min"] < flight["border_margin_m"]["max"] < 0.5
    assert flight["applied_ml"] > 700.0
    assert flight["limit_ratio"] is None
    assert flight["droplets"] == []
    assert set(flight["section_volume_error_percent"]) == {"1", "2", "3", "4", "5", "6"}


def test_atomisers_keep_the_wanted_droplets(
    two_zones: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = flown("atomiser", two_zones, capsys)
    (flight,) = result["flights"]
    assert flight["off_target_ml"] == 0.0
    assert flight["lag_distance_m"]["max_abs"] < 0.6
    assert [drops["atomiser"] for drops in flight["droplets"]] == ["left", "right"]
    for drops in flight["droplets"]:
        assert set(drops) == DROPS
        assert drops["droplet_class"] == "fine"
        assert drops["in_class_percent"] > 99.0
        assert drops["near_percent"] > 95.0
        assert drops["mean_vmd_um"] == pytest.approx(180.0, rel=0.05)


def test_a_sprayer_with_other_motors_does_not_fit(two_zones: Path) -> None:
    def options(example: str, plant: str) -> FlyOptions:
        config = EXAMPLES / example / "config.toml"
        return FlyOptions(config=config, mission=two_zones, plant=plant)

    with pytest.raises(ConfigError, match="no pump of its own and 0 atomisers, the configuration"):
        prepare(options("pump-sections", "wang-2024"))
    with pytest.raises(ConfigError, match="a constant pump and 0 atomisers"):
        prepare(options("pump-sections", "pwm-pump"))


def test_the_paper_s_configuration_still_flies_the_paper_s_sprayer() -> None:
    """Profiles with motors are as large, and must not take its place."""
    anyang = EXAMPLES / "anyang"
    task = prepare(FlyOptions(config=anyang / "config.toml", mission=anyang / "mission.waypoints"))
    assert task.profile.name == "wang-2024"


def test_zones_too_short_for_a_pump_are_named(tmp_path: Path) -> None:
    text = (FIELD / "config.toml").read_text(encoding="utf-8")
    anyang = (EXAMPLES / "anyang").as_posix()
    text = text.replace(
        '"prescription.geojson"', f'"{anyang}/prescription.shp"\nrate_field = "rate"'
    )
    text = text.replace('"boundary.geojson"', f'"{anyang}/boundary.geojson"')
    config = tmp_path / "config.toml"
    config.write_text(text, encoding="utf-8")
    task = prepare(FlyOptions(config=config, mission=EXAMPLES / "anyang" / "mission.waypoints"))
    assert "zones-too-short" in {problem.code for problem in task.warnings}


def test_the_files_of_the_field_are_what_their_program_makes(tmp_path: Path) -> None:
    space: dict[str, Any] = {"__name__": "made", "__file__": str(FIELD / "make.py")}
    exec(compile((FIELD / "make.py").read_text(encoding="utf-8"), "make.py", "exec"), space)
    space["main"](tmp_path)
    for name in ("prescription.geojson", "boundary.geojson", "mission.waypoints", "mission.plan"):
        made = (tmp_path / name).read_text(encoding="utf-8")
        assert made == (FIELD / name).read_text(encoding="utf-8"), name
