"""`vrspray plan`: files, figures and refusals, as they are typed."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Transformer
from shapely import Polygon, box

import missions.cli
import missions.files.write
from companion.cli.app import INTERRUPTED, execute
from missions.upload.transfer import sorties_from
from sitl.stub.mission_items import read_mission
from tests.bench.missions import to_degrees

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

ANYANG = Path(__file__).parents[2] / "examples" / "anyang"


def written(ground: Polygon, path: Path) -> Path:
    """Write an outline as GeoJSON and return its path."""
    geometry = json.loads(shapely.to_geojson(to_degrees(ground)))
    feature = {"type": "Feature", "properties": {}, "geometry": geometry}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict[str, Any], str]:
    """Return exit code, the JSON object and stderr."""
    force = () if "--no-force" in words else ("--force",)
    given = [str(word) for word in words if word != "--no-force"]
    code = execute(["plan", *force, *given, "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out), err


def test_the_papers_field_is_planned_with_its_map(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "field.plan"
    code, found, _ = run(
        capsys, ANYANG / "boundary.geojson", "--config", ANYANG / "config.toml", "--out", out
    )
    assert code == 0
    assert {
        "coverage_percent", "overlap_percent", "outside_m2", "swaths", "turns", "spray_m",
        "total_m", "flight_s", "planning_s", "volume_l", "sorties", "treated_percent", "bare_m2",
        "twice_m2", "treated_l",
    } <= set(found)  # fmt: skip
    # Outer valves stay open 0.2 m from the border.
    assert found["coverage_percent"] > 99.6
    assert 90.0 < found["treated_percent"] < found["coverage_percent"]
    assert found["outside_m2"] == 0.0
    assert found["swaths"] == 5
    assert found["files"] == [str(out)]
    assert read_mission(out)[-1].command == 20
    # 120 m by 25 m at a mean of some 22 L/ha, without the valves that the border closes.
    assert 5.5 < found["volume_l"] < 6.5


def test_a_prescription_stands_for_its_own_field(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = ANYANG / "prescription.shp"
    code, found, _ = run(
        capsys, file, "--prescription", file, "--swath-m", "3", "--out", tmp_path / "m.geojson"
    )
    assert code == 0
    assert found["coverage_percent"] > 99.8


def test_without_a_map_one_rate_holds(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    field = written(box(0, 0, 120, 240), tmp_path / "f.geojson")
    code, found, _ = run(capsys, field, "--rate-l-ha", "10", "--out", tmp_path / "m.kml")
    assert code == 0
    assert found["volume_l"] == pytest.approx(found["spray_m"] * 6.0 / 1000.0)


# The litres count on what valves that know the lines keep dry.
NAMED = ("--set", 'mission.lines="m.lines.geojson"')


def test_lines_are_flown_no_faster_than_the_sprayer_keeps_up(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, found, _ = run(
        capsys, ANYANG / "boundary.geojson", "--config", ANYANG / "config.toml",
        "--speed-m-s", "11", *NAMED, "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert code == 0
    assert found["warnings"] == []
    low, high = found["sorties"][0]["speeds_m_s"]
    assert 4.0 < low < high < 11.0
    ordered = {item.param2 for item in read_mission(tmp_path / "m.plan") if item.command == 178}
    assert {low, high, 11.0} <= ordered


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (["--swath-m", "9"], "--swath-m 9: more than 2 % from boom.width_m = 6"),
        (["--swath-m", "5.5"], "--swath-m 5.5: more than 2 % from boom.width_m = 6"),
        (["--speed-m-s", "13"], "--speed-m-s 13: nothing is sprayed but from"),
        (["--speed-m-s", "0.6"], "--speed-m-s 0.6: nothing is sprayed but from"),
    ],
)
def test_what_config_check_refuses_is_not_planned(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, more: list[str], text: str
) -> None:
    code, found, _ = run(
        capsys, ANYANG / "boundary.geojson", "--config", ANYANG / "config.toml", *more, *NAMED,
        "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert code == 2
    assert text in found["error"]
    assert not list(tmp_path.iterdir())


def test_a_configuration_that_config_check_refuses_is_not_planned(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    shutil.copytree(ANYANG, tmp_path / "anyang")
    path = tmp_path / "anyang" / "config.toml"
    path.write_text(path.read_text().replace("speed_max_m_s = 12.0", "speed_max_m_s = 4.0"))
    assert execute(["config", "check", str(path)]) != 0
    assert "mission.speed_m_s" in capsys.readouterr().out
    given = [tmp_path / "anyang" / "boundary.geojson", "--config", path, *NAMED]
    code, found, _ = run(capsys, *given, "--out", tmp_path / "m.plan")
    assert (code, "config.toml: mission.speed_m_s: nothing is" in found["error"]) == (2, True)


def test_rates_beyond_the_sprayer_are_warned_of_with_a_place(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, found, err = run(
        capsys, ANYANG / "boundary.geojson", "--config", ANYANG / "config.toml",
        "--rate-l-ha", "300", *NAMED, "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert code == 0
    assert len(found["warnings"]) == 1
    assert "300 L/ha at 1 m/s takes" in found["warnings"][0]
    assert "sortie 1 near 35.99" in found["warnings"][0]
    assert "warning: " in err


def test_too_low_a_rate_is_flown_faster_only_where_that_is_allowed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = [ANYANG / "boundary.geojson", "--config", ANYANG / "config.toml", "--speed-m-s", "2",
             "--rate-l-ha", "5", "--border-m", "0", *NAMED,
             "--out", tmp_path / "m.plan"]  # fmt: skip
    _, found, _ = run(capsys, *words)
    assert "(--speed-max-m-s)" in found["warnings"][0]
    assert found["sorties"][0]["speeds_m_s"] == [2.0, 2.0]
    _, found, _ = run(capsys, *words, "--speed-max-m-s", "10")
    assert found["warnings"] == []
    assert 2.0 < found["sorties"][0]["speeds_m_s"][0] <= 10.0
    code, found, _ = run(capsys, *words, "--speed-max-m-s", "40")
    assert (code, "safety.speed_max_m_s" in found["error"]) == (2, True)


BOW_TIE = Polygon([(0, 0), (100, 100), (100, 0), (0, 100)])


@pytest.mark.parametrize(
    ("ground", "more", "says"),
    [
        (box(0, 0, 4, 100), [], "nowhere as wide as the swath of 6 m"),
        (box(0, 0, 100, 100), ["--tank-l", "0.5"], "a reserve of 1.0 L"),
        (box(0, 0, 100, 100), ["--tank-l", "1.01"], "mission.tank_l"),
        (box(0, 0, 100, 100), ["--depot", "-48,11"], "latitude is of the wrong hemisphere"),
        (box(0, 0, 100, 100), ["--depot", "48,-11"], "longitude is of the wrong hemisphere"),
        (box(0, 0, 100, 100), ["--depot", "11,48"], "swapped"),
        (box(0, 0, 100, 100), ["--prescription", str(ANYANG / "prescription.shp")], "km from"),
        (box(0, 0, 100, 100), ["--obstacle", str(ANYANG / "boundary.geojson")], "km from"),
        (box(0, 0, 100, 100), ["--no-spray", str(ANYANG / "boundary.geojson")], "km from"),
        (box(0, 0, 5, 5), [], "nowhere as wide as the swath of 6 m"),
        (box(0, 0, 100, 100), ["--autopilot", "px4", "--sprayer"], "PX4 takes no DO_SPRAYER"),
        (box(0, 0, 100, 100), ["--depot", "north"], "--depot"),
        (box(0, 0, 100, 100), ["--rate-l-ha", "0"], "rate above zero"),
        (box(0, 0, 100, 100), ["--rate-l-ha", "nan"], "--rate-l-ha"),
        (box(0, 0, 100, 100), ["--rate-l-ha", "20,5"], "write a number, with a point for decimals"),
        (
            box(0, 0, 100, 100),
            ["--holes", "through"],
            "'--holes': 'through' is not one of 'around', 'over'",
        ),
        (box(0, 0, 100, 100), ["--aircraft", "two"], "'--aircraft': write a whole number"),
        (box(0, 0, 100, 100), ["--depot", "11"], "write LAT,LON in degrees, the latitude first ("),
        (box(0, 0, 100, 100), ["--swath-m", "-6"], "--swath-m -6: write a number greater than"),
        (box(0, 0, 20, 20), ["--swath-m", "0.05"], "write a number greater than or equal to 0.3"),
        (box(0, 0, 900, 900), ["--swath-m", "0.5"], "passes or more, and a plan has 1000 at most"),
        (box(0, 0, 100, 100), ["--swath-m", "1e9"], "--swath-m 1e+09: write a number less than or"),
        (box(0, 0, 100, 100), ["--speed-m-s", "nan"], "--speed-m-s nan: write a number"),
        (box(0, 0, 100, 100), ["--speed-m-s", "1e-9"], "greater than or equal to 0.5"),
        (box(0, 0, 100, 100), ["--speed-max-m-s", "nan"], "at least the speed of the passes, 6"),
        (box(0, 0, 100, 100), ["--speed-max-m-s", "1e-9"], "and at most 50 m/s"),
        (box(0, 0, 100, 100), ["--tank-l", "inf"], "--tank-l inf: write a number less than or"),
        (box(0, 0, 100, 100), ["--angle-deg", "1000"], "less than or equal to 360"),
        (box(0, 0, 100, 100), ["--rate-l-ha", "-1"], "--rate-l-ha -1: write a number"),
        (box(0, 0, 100, 100), ["--obstacle", "none.shp"], "none.shp"),
        (box(0, 0, 100, 100), ["--prescription", "none.shp"], "none.shp"),
        (box(0, 0, 60_000, 100), [], "the field spans 60 km"),
    ],
)
def test_a_refusal_is_one_line_and_no_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, ground: Polygon, more: list[str], says: str
) -> None:
    field = written(ground, tmp_path / "f.geojson")
    code, found, err = run(capsys, field, *more, "--out", tmp_path / "m.plan")
    assert code == 2
    assert says in found["error"]
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "m.plan").exists()


def shapefile(ground: Polygon, path: Path, *, rate: float | None = None) -> Path:
    """Write a polygon in metres of UTM's zone 32 without its .prj, by an independent writer."""
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    moved = shapely.transform(
        to_degrees(ground), lambda points: np.column_stack(to_utm.transform(*points.T))
    )
    pyogrio.raw.write(
        str(path),
        np.array([shapely.to_wkb(moved)], dtype=object),
        [] if rate is None else [np.array([rate])],
        [] if rate is None else ["value"],
        crs="EPSG:32632",
        geometry_type="Polygon",
        driver="ESRI Shapefile",
    )
    path.with_suffix(".prj").unlink()
    return path


def test_what_files_leave_open_is_told_by_the_options_that_the_refusals_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    ground = box(0, 0, 120, 120)
    field = written(ground, tmp_path / "f.geojson")
    rates = shapefile(ground, tmp_path / "r.shp", rate=20.0)
    tree = shapefile(box(50, 50, 55, 55), tmp_path / "t.shp")
    words: list[object] = [field, "--obstacle", tree, "--out", tmp_path / "m.kml"]
    code, found, _ = run(capsys, *words)
    assert (code, "t.shp" in found["error"], "--crs" in found["error"]) == (2, True, True)
    # The field says its own CRS, and keeps it.
    words += ["--crs", "EPSG:32632"]
    code, plain, _ = run(capsys, *words)
    assert code == 0
    words += ["--prescription", rates]
    code, found, _ = run(capsys, *words)
    assert (code, "--unit" in found["error"]) == (2, True)
    code, found, _ = run(capsys, *words, "--unit", "kg/ha")
    assert (code, "--density-kg-l" in found["error"]) == (2, True)
    code, light, _ = run(capsys, *words, "--unit", "kg/ha", "--density-kg-l", "0.8")
    assert code == 0
    code, found, _ = run(capsys, *words, "--unit", "L/ha", "--rate-field", "value")
    assert code == 0
    assert found["volume_l"] == pytest.approx(plain["volume_l"], rel=0.02)
    assert light["volume_l"] == pytest.approx(found["volume_l"] / 0.8)


def test_answers_on_the_command_line_hold_for_the_configurations_map_too(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    ground = box(0, 0, 120, 120)
    field = written(ground, tmp_path / "f.geojson")
    shapefile(ground, tmp_path / "r.shp", rate=20.0)
    text = (ANYANG / "config.toml").read_text()
    text = re.sub(r"(?ms)^\[prescription\].*?(?=^\[)", '[prescription]\nfile = "r.shp"\n\n', text)
    (tmp_path / "c.toml").write_text(text)
    words = [field, "--config", tmp_path / "c.toml", "--out", tmp_path / "m.kml"]
    code, found, _ = run(capsys, *words)
    assert (code, "prescription.file" in found["error"]) == (2, True)
    code, found, _ = run(capsys, *words, "--crs", "EPSG:32632", "--unit", "L/ha")
    assert code == 0
    assert found["volume_l"] > 20.0


def test_one_of_anything_is_singular(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    field = written(box(0, 0, 120, 120), tmp_path / "f.geojson")
    assert execute(["plan", "--force", str(field), "--out", str(tmp_path / "m.kml")]) == 0
    out, _ = capsys.readouterr()
    assert "1 sortie," in out
    assert not re.search(r"\b1 (sorties|lines|items|passes)\b", out)


@pytest.mark.parametrize("size", [0.3, 40.0, 300.0])
def test_metres_from_a_local_origin_are_not_planned_at_0_0(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, size: float
) -> None:
    ring = [[0, 0], [size, 0], [size, size], [0, size], [0, 0]]
    path = tmp_path / "f.geojson"
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    code, found, _ = run(capsys, path, "--out", tmp_path / "m.kml")
    assert (code, "metres" in found["error"]) == (2, True)


def test_an_outline_that_crosses_itself_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(BOW_TIE, tmp_path / "f.geojson")
    code, found, _ = run(capsys, field, "--out", tmp_path / "m.plan")
    assert code == 2
    assert "rings cross themselves" in found["error"]
    assert not (tmp_path / "m.plan").exists()


def test_a_walk_that_crosses_its_own_start_is_repaired_and_that_is_said(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    walk = [(0, 1.5), (-2, -2), (200, 0), (200, 100), (0, 100), (0, -2), (-3, -1)]
    field = written(Polygon(walk), tmp_path / "f.geojson")
    code, found, err = run(capsys, field, "--out", tmp_path / "m.plan")
    assert code == 0
    assert found["area_ha"] == pytest.approx(2.02, abs=0.01)
    assert "rings cross themselves" in found["warnings"][0]
    assert "f.geojson" in found["warnings"][0]
    assert "warning: " in err


def test_what_must_not_be_sprayed_is_not_repaired(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0, 0, 200, 200), tmp_path / "f.geojson")
    garden = written(BOW_TIE, tmp_path / "g.geojson")
    for option in ("--no-spray", "--obstacle"):
        code, found, _ = run(capsys, field, option, garden, "--out", tmp_path / "m.plan")
        assert (code, "g.geojson" in found["error"]) == (2, True)
        assert not (tmp_path / "m.plan").exists()


def test_a_ring_that_is_not_closed_is_closed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0, 0, 120, 120), tmp_path / "f.geojson")
    content = json.loads(field.read_text())
    ring = content["features"][0]["geometry"]["coordinates"][0]
    del ring[-1]
    field.write_text(json.dumps(content))
    code, found, _ = run(capsys, field, "--out", tmp_path / "m.plan")
    assert code == 0
    assert found["area_ha"] == pytest.approx(1.44, abs=0.01)
    content["features"][0]["geometry"] = {"type": "LineString", "coordinates": ring}
    field.write_text(json.dumps(content))
    code, found, _ = run(capsys, field, "--out", tmp_path / "n.plan")
    assert (code, "no polygon" in found["error"]) == (2, True)


def test_an_obstacle_across_the_field_leaves_two_parts_and_both_are_planned(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0, 0, 200, 100), tmp_path / "f.geojson")
    ditch = written(box(90, -10, 110, 110), tmp_path / "o.geojson")
    code, found, _ = run(capsys, field, "--obstacle", ditch, "--out", tmp_path / "m.geojson")
    assert code == 0
    assert found["coverage_percent"] > 99.9
    lines = [each["geometry"]["coordinates"]
             for each in json.loads((tmp_path / "m.geojson").read_text())["features"]
             if each["properties"]["kind"] == "spray"]  # fmt: skip
    west = [line for line in lines if line[0][0] < 11.00134]
    assert 0 < len(west) < len(lines)


def test_an_unknown_format_is_refused_before_any_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    code, found, _ = run(capsys, tmp_path / "none.shp", "--out", tmp_path / "m.pdf")
    assert code == 2
    assert ".pdf is not known" in found["error"]


def test_an_obstacle_keeps_its_buffer(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    field = written(box(0, 0, 120, 120), tmp_path / "f.geojson")
    mast = written(box(55, 55, 65, 65), tmp_path / "o.geojson")
    code, found, _ = run(capsys, field, "--obstacle", mast, "--out", tmp_path / "m.geojson")
    assert code == 0
    features = json.loads((tmp_path / "m.geojson").read_text())["features"]
    around = to_degrees(box(53.1, 53.1, 66.9, 66.9))
    ways = [shapely.LineString(each["geometry"]["coordinates"])
            for each in features if each["geometry"]["type"] == "LineString"]  # fmt: skip
    assert ways
    assert not any(way.intersects(around) for way in ways)
    assert found["coverage_percent"] > 99.8


@pytest.mark.parametrize("option", ["--out", "--png", "--sheet"])
def test_a_folder_that_is_not_there_is_said_before_planning(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    option: str,
) -> None:
    def planned(*_: object, **__: object) -> None:
        raise AssertionError("planned")

    monkeypatch.setattr(missions.cli, "plan_mission", planned)
    suffix = {"--out": ".plan", "--png": ".png", "--sheet": ".html"}[option]
    words = {"--out": tmp_path / "m.plan"} | {option: tmp_path / "no" / f"m{suffix}"}
    code, found, _ = run(
        capsys, ANYANG / "boundary.geojson", "--config", ANYANG / "config.toml",
        *(word for pair in words.items() for word in pair),
    )  # fmt: skip
    assert code == 2
    assert re.search(r"no folder .*no.*make the folder first", found["error"])


def test_a_plan_that_is_there_is_replaced_with_force_alone_and_as_a_whole(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0.0, 0.0, 200.0, 100.0), tmp_path / "field.geojson")
    given = ["--swath-m", 6, "--speed-m-s", 6, "--rate-l-ha", 20, "--out", tmp_path / "m.plan"]
    _, three, _ = run(capsys, field, *given, "--tank-l", 16)
    assert len(three["files"]) > 2
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    code, refused, _ = run(capsys, field, *given, "--tank-l", 60, "--no-force")
    assert code == 2
    assert "m.plan, m-2.plan, m-3.plan" in refused["error"]
    assert "--force" in refused["error"]
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    (tmp_path / "m.plan").unlink()
    code, refused, _ = run(capsys, field, *given, "--tank-l", 60, "--no-force")
    assert code == 2
    code, one, err = run(capsys, field, *given, "--tank-l", 60)
    assert code == 0
    assert len(one["files"]) == 1
    assert sorted(path.name for path in tmp_path.glob("m*.plan")) == ["m.plan"]
    assert "m-2.plan, m-3.plan" in err


def test_lines_of_another_plan_are_replaced_with_force_alone(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    field = written(box(0.0, 0.0, 100.0, 60.0), tmp_path / "field.geojson")
    run(capsys, field, "--out", "q.plan")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    turned = [field, "--angle-deg", 20, "--out", "q.waypoints"]
    code, refused, _ = run(capsys, *turned, "--no-force")
    assert code == 2
    assert refused["error"].startswith("q.lines.geojson is there already; give another --out, or")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    code, found, _ = run(capsys, *turned)
    assert code == 0
    assert any(warning.startswith("q.plan: of an earlier plan") for warning in found["warnings"])
    _, again, _ = run(capsys, field, "--angle-deg", 20, "--out", "q.plan")
    assert not any("earlier plan" in warning for warning in again["warnings"])


@pytest.mark.parametrize(("option", "name"), [("--png", "p.png"), ("--sheet", "p.txt")])
def test_what_is_beside_a_plan_is_replaced_with_force_alone(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, option: str, name: str
) -> None:
    field = written(box(0.0, 0.0, 100.0, 60.0), tmp_path / "field.geojson")
    (tmp_path / name).write_text("mine")
    words = [field, "--out", tmp_path / "m.plan", option, tmp_path / name]
    code, refused, _ = run(capsys, *words, "--no-force")
    assert (code, (tmp_path / name).read_text()) == (2, "mine")
    assert f"{name} is there already in {tmp_path}" in refused["error"]
    assert not (tmp_path / "m.plan").exists()


@pytest.mark.parametrize(
    ("zones", "says"),
    [
        ([box(190, 90, 300, 190)], "99.5 % of the outline lies beyond the map, and 99.1 % of"),
        ([box(0, 0, 100, 100)], "50 % of the outline lies beyond the map, and 0 % of"),
        ([box(15, 0, 215, 100)], "7.5 % of the outline lies beyond the map, and 7.5 % of"),
        ([box(0, 0, 200, 600)], "0 % of the outline lies beyond the map, and 83.3 % of"),
        ([box(10, 10, 190, 90)], None),  # a headland without a rate
        ([box(5, 5, 15, 15), box(180, 5, 195, 15), box(5, 85, 195, 95)], None),  # spots
        ([box(-20, -20, 220, 120)], None),
    ],
)
def test_a_map_that_is_not_of_the_field_is_warned_of(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, zones: list[Polygon], says: str | None
) -> None:
    field = written(box(0.0, 0.0, 200.0, 100.0), tmp_path / "field.geojson")
    features = [
        {"type": "Feature", "properties": {"rate_l_ha": 20.0},
         "geometry": json.loads(shapely.to_geojson(to_degrees(zone)))}
        for zone in zones
    ]  # fmt: skip
    rates = tmp_path / "rates.geojson"
    rates.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    code, found, _ = run(capsys, field, "--prescription", rates, "--out", tmp_path / "m.plan")
    assert code == 0
    warned = [warning for warning in found["warnings"] if "of the outline lies" in warning]
    assert len(warned) == (says is not None)
    if says is not None:
        assert warned[0].startswith(says)


def test_a_raster_that_is_not_of_the_field_is_warned_of(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0.0, 0.0, 200.0, 100.0), tmp_path / "field.geojson")
    west, south, east, north = to_degrees(box(100.0, 0.0, 300.0, 100.0)).bounds
    rows = [
        f"{south + (north - south) * (0.5 + j) / 25},{west + (east - west) * (0.5 + i) / 50},20"
        for i in range(50)
        for j in range(25)
    ]
    cells = tmp_path / "cells.csv"
    cells.write_text("\n".join(["latitude,longitude,rate_l_ha", *rows]) + "\n")
    _, found, _ = run(capsys, field, "--prescription", cells, "--out", tmp_path / "m.plan")
    assert any(
        warning.startswith("50 % of the outline lies beyond the map, and 50 % of the map")
        for warning in found["warnings"]
    )


def test_choices_that_change_nothing_are_said_to_be_none(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0.0, 0.0, 80.0, 60.0), tmp_path / "field.geojson")
    for ground, says in (
        (60.0, "choice    none: no option saves"),
        (300.0, "choice    none: --ch"),
    ):
        field = written(box(0.0, 0.0, 80.0, ground), tmp_path / "field.geojson")
        words = ["plan", str(field), "--choices", "--force", "--out", str(tmp_path / "m.plan")]
        assert execute([*words, "--tank-l", "100"]) == 0
        assert says in capsys.readouterr().out


@pytest.mark.parametrize(("autopilot", "count"), [("px4", 1), ("ardupilot", 0)])
def test_waypoints_for_px4_are_warned_of(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, autopilot: str, count: int
) -> None:
    field = written(box(0.0, 0.0, 100.0, 60.0), tmp_path / "field.geojson")
    out = tmp_path / "m.waypoints"
    _, found, _ = run(capsys, field, "--autopilot", autopilot, "--out", out)
    assert sum("pointed north" in warning for warning in found["warnings"]) == count


def test_two_aircraft_that_take_longer_than_one_are_warned_of(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0.0, 0.0, 80.0, 60.0), tmp_path / "field.geojson")
    (tmp_path / "m.lines.geojson").write_text("of an earlier plan")
    two = ["plan", str(field), "--aircraft", "2", "--out", str(tmp_path / "m.plan"), "--force"]
    assert execute(two) == 0
    out, err = capsys.readouterr()
    assert f"{tmp_path / 'm-a1.lines.geojson'}, {tmp_path / 'm-a2.lines.geojson'}: name" in out
    assert not (tmp_path / "m.lines.geojson").exists()
    assert "warning: 2 aircraft wait for each other and take 6." in err
    _, one, _ = run(capsys, field, "--out", tmp_path / "m.plan")
    reckoned = re.search(r"one alone would take about ([\d.]+) min", err)
    assert reckoned is not None
    assert float(reckoned[1]) * 60.0 == pytest.approx(one["total_s"], rel=0.2)
    large = written(box(0.0, 0.0, 300.0, 300.0), tmp_path / "large.geojson")
    _, found, _ = run(capsys, large, "--aircraft", 2, "--out", tmp_path / "l.plan")
    assert not any("wait for each other" in warning for warning in found["warnings"])


def test_a_prescription_given_as_the_field_has_the_rates_too(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = ANYANG / "prescription.shp"
    _, own, err = run(capsys, field, "--swath-m", 6, "--out", tmp_path / "a.plan")
    _, named, _ = run(
        capsys, field, "--prescription", field, "--swath-m", 6, "--out", tmp_path / "b.plan"
    )
    assert own["volume_l"] == pytest.approx(named["volume_l"])
    assert "it is a prescription too" in err
    _, flat, _ = run(capsys, field, "--rate-l-ha", 90, "--swath-m", 6, "--out", tmp_path / "c.plan")
    assert flat["volume_l"] > 3.0 * own["volume_l"]


def test_what_was_assumed_is_said(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    field = written(box(0.0, 0.0, 100.0, 60.0), tmp_path / "f.geojson")
    _, found, err = run(capsys, field, "--speed-m-s", 5, "--out", tmp_path / "m.plan")
    assert set(found["assumed"]) == {
        "swath_width_m", "height_m", "tank_l", "reserve_l", "rate_l_ha",
    }  # fmt: skip
    assert "swath 6 m" in err
    assert "rate 20 L/ha" in err
    config = ANYANG / "config.toml"
    _, found, err = run(
        capsys, ANYANG / "boundary.geojson", "--config", config, "--out", tmp_path / "n.plan"
    )
    assert set(found["assumed"]) == {"tank_l", "reserve_l"}
    assert "tank 40 L" in err


def test_ctrl_c_while_files_are_written_leaves_all_of_one_plan(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = missions.files.write.write_whole

    def pressed(path: Path, content: bytes) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        write(path, content)

    monkeypatch.setattr(missions.files.write, "write_whole", pressed)
    field = written(box(0.0, 0.0, 200.0, 100.0), tmp_path / "field.geojson")
    given = ["--swath-m", 6, "--speed-m-s", 6, "--rate-l-ha", 20, "--out", tmp_path / "m.plan"]
    code = execute(["plan", "--force", str(field), *map(str, given), "--tank-l", "16"])
    assert code == INTERRUPTED
    sorties = sorties_from(tmp_path / "m.plan")
    assert len(sorties) > 2
    assert sorted(tmp_path.glob("m*.plan")) == sorted(sorties)


def test_no_plan_needs_matplotlib() -> None:
    """It is half a second of each plan, and an extra that may be missing."""
    done = subprocess.run(
        [sys.executable, "-c", "import sys; sys.modules['matplotlib'] = None; import missions.cli"],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
