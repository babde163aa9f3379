"""Ferries at a height of their own: in items, times, fences, and over obstacles that are low."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import shapely
from shapely import LineString, Point, Polygon, box

from companion.cli.app import execute
from missions.plan import Settings
from sitl.stub.mission_items import read_mission
from tests.missions.test_missions_cli import written
from tests.missions.test_missions_obstacles import degrees, ways_m
from tests.missions.test_missions_terrain import tile

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

FIELD = box(0, 0, 60, 200)
# 60 m south of the field's middle.
DEPOT = (30.0, -60.0)
LINE_M, FERRY_M = 3.5, 20.0


def planned(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    out: Path,
    *words: object,
    ground: Polygon = FIELD,
    depot: tuple[float, float] = DEPOT,
) -> dict[str, Any]:
    field = written(ground, tmp_path / "f.geojson")
    lon, lat = shapely.get_coordinates(degrees(Point(*depot)))[0]
    own = ["--depot", f"{lat},{lon}", "--rate-l-ha", "20", "--out", out]
    own += ["--tank-l", "12"] if ground is FIELD else []
    code = execute(["plan", "--force", *map(str, [field, *own, *words]), "--json"])
    found = dict(json.loads(capsys.readouterr().out))
    assert code == 0, found
    return found


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_it_climbs_where_a_line_ends_and_descends_where_one_begins(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, autopilot: str
) -> None:
    out = tmp_path / "m.plan"
    found = planned(capsys, tmp_path, out, "--ferry-height-m", FERRY_M, "--autopilot", autopilot)
    assert len(found["sorties"]) > 1
    for name in found["files"]:
        places = [each for each in read_mission(Path(name)) if each.command in (16, 22)][1:]
        assert (places[0].command, places[0].z_m) == (22, FERRY_M)
        heights = [each.z_m for each in places]
        assert set(heights) == {LINE_M, FERRY_M}
        # Up, down once, and up again: no line is left for a ferry in between.
        changes = [(a, b) for a, b in pairwise(places) if a.z_m != b.z_m]
        assert [b.z_m for _, b in changes] == [LINE_M, FERRY_M]
        for a, b in changes:
            assert (a.latitude_deg, a.longitude_deg) == (b.latitude_deg, b.longitude_deg)
        assert heights[-1] == FERRY_M


def test_lines_are_at_their_own_height_and_ferries_at_theirs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "m.geojson"
    planned(capsys, tmp_path, out, "--ferry-height-m", FERRY_M)
    heights = {
        each["properties"]["kind"]: each["properties"]["height_m"]
        for each in json.loads(out.read_text())["features"]
        if each["properties"]["kind"] != "depot"
    }
    assert heights == {"spray": LINE_M, "transit": LINE_M, "ferry": FERRY_M}


def test_the_climbs_are_in_the_times_as_arducopter_flew_them(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    # Take-off to disarmed with ArduCopter 4.7, its speed set to 6 m/s, on this field.
    flown_s = {None: 273.0, 20.0: 320.0}
    took_s, drawn_wh = {}, {}
    for height_m in flown_s:
        more = [] if height_m is None else ["--ferry-height-m", height_m]
        (sortie,) = planned(
            capsys, tmp_path, tmp_path / "m.kml", "--config", config_of(tmp_path), *more,
            ground=box(0, 0, 40, 120), depot=(60.0, -50.0),
        )["sorties"]  # fmt: skip
        took_s[height_m], drawn_wh[height_m] = sortie["airborne_s"], sortie["energy_wh"]
    for height_m, flown in flown_s.items():
        assert -0.02 * flown <= took_s[height_m] - flown <= 0.05 * flown
    # Climbing and descending draw what hovering does.
    more_s = took_s[20.0] - took_s[None]
    assert drawn_wh[20.0] - drawn_wh[None] == pytest.approx(more_s * 3600.0 / 3600.0, rel=0.15)


def test_a_run_in_is_flown_low_and_the_descent_is_before_it(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "m.geojson"
    words = ["--run-in-m", "auto", "--config", config_of(tmp_path)]
    planned(capsys, tmp_path, out, "--ferry-height-m", FERRY_M, *words)
    legs = [each["properties"] for each in json.loads(out.read_text())["features"]]
    kinds = [(each["kind"], each["height_m"]) for each in legs if each.get("sortie") == 1]
    assert kinds[:3] == [("ferry", FERRY_M), ("transit", LINE_M), ("spray", LINE_M)]
    assert kinds[-3:] == [("spray", LINE_M), ("transit", LINE_M), ("ferry", FERRY_M)]


def config_of(tmp_path: Path, more: str = "") -> Path:
    """Return a configuration whose run-ins may lie outside the field."""
    text = (Path(__file__).parents[2] / "examples/anyang/config.toml").read_text()
    for table in ("mission", "prescription"):
        before, _, after = text.partition(f"[{table}]")
        text = before + (after[after.index("\n[") :] if "\n[" in after else "")
    text += (
        "\n[mission]\nswath_width_m = 6.0\nspeed_m_s = 6.0\n"
        + 'overrun = "allowed"\npower_hover_w = 3600.0\n'
        + more
    )
    path = tmp_path / "config.toml"
    path.write_text(text)
    return path


def trees(tmp_path: Path, **about: float) -> Path:
    """Return a file with one tree midway between depot and field."""
    lon, lat = shapely.get_coordinates(degrees(Point(30.0, -25.0)))[0]
    feature = {"type": "Feature", "properties": {"radius_m": 8.0} | about,
               "geometry": {"type": "Point", "coordinates": [lon, lat]}}  # fmt: skip
    path = tmp_path / "trees.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


@pytest.mark.parametrize(
    ("about", "ferry_m", "is_crossed"),
    [
        ({"height_m": 15.0}, 20.0, True),
        ({"height_m": 15.1}, 20.0, False),  # 5 m of clearance
        ({}, 20.0, False),  # nobody knows how high
        ({"height_m": 2.0}, None, False),  # lines and ferries alike at 3.5 m
    ],
)
def test_ferries_cross_obstacles_that_are_known_to_be_low(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    about: dict[str, float],
    ferry_m: float | None,
    is_crossed: bool,
) -> None:
    out = tmp_path / "m.geojson"
    more = [] if ferry_m is None else ["--ferry-height-m", ferry_m]
    planned(capsys, tmp_path, out, "--obstacle", trees(tmp_path, **about), *more)
    far_m = ways_m(out).distance(Point(30.0, -25.0))
    assert (far_m < 8.0) is is_crossed
    if not is_crossed:
        assert far_m >= 10.0 - 0.01


def test_lines_and_short_transits_never_cross_a_low_obstacle(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    lon, lat = shapely.get_coordinates(degrees(Point(30.0, 100.0)))[0]
    path = tmp_path / "trees.geojson"
    feature = {"type": "Feature", "properties": {"radius_m": 5.0, "height_m": 2.0},
               "geometry": {"type": "Point", "coordinates": [lon, lat]}}  # fmt: skip
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    out = tmp_path / "m.geojson"
    planned(capsys, tmp_path, out, "--ferry-height-m", FERRY_M, "--obstacle", path)
    features = json.loads(out.read_text())["features"]
    low = {
        "type": "FeatureCollection",
        "features": [each for each in features if each["properties"].get("height_m") == LINE_M],
    }
    (tmp_path / "low.geojson").write_text(json.dumps(low))
    assert ways_m(tmp_path / "low.geojson").distance(Point(30.0, 100.0)) >= 7.0 - 0.01


def test_the_fence_leaves_out_what_ferries_cross_and_says_so(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "m.plan"
    low = trees(tmp_path, height_m=10.0)
    found = planned(capsys, tmp_path, out, "--ferry-height-m", FERRY_M, "--obstacle", low)
    assert any("leaves out 1 obstacle that ferries cross at 20 m" in w for w in found["warnings"])
    for name in found["files"]:
        content = json.loads(Path(name).read_text())["geoFence"]
        shapes = [each["polygon"] for each in content["polygons"] if not each["inclusion"]]
        assert not shapes and not content["circles"]
    tall = planned(
        capsys, tmp_path, tmp_path / "t.plan", "--ferry-height-m", FERRY_M,
        "--obstacle", trees(tmp_path, height_m=30.0),
    )  # fmt: skip
    assert not any("ferries cross" in text for text in tall["warnings"])


def test_over_hills_ferries_keep_their_height_above_the_ground(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    model = tile(tmp_path / "N48E011.hgt", lambda lat, lon: 5000.0 * (lat - 48.0), posts=3601)

    def over(name: str, autopilot: str) -> dict[str, Any]:
        return planned(
            capsys, tmp_path, tmp_path / name, "--ferry-height-m", FERRY_M, "--terrain", model,
            "--autopilot", autopilot, ground=box(20, 20, 80, 220), depot=(50.0, 280.0),
        )  # fmt: skip

    found, flat = over("m.plan", "px4"), over("g.plan", "ardupilot")
    first = [each for each in read_mission(Path(flat["files"][0])) if each.command == 16][1:]
    assert {each.frame for each in first} == {10}
    assert {each.z_m for each in first} == {LINE_M, FERRY_M}
    file = [each for each in read_mission(Path(found["files"][0])) if each.command == 16][1:]
    jumps = [
        abs(a.z_m - b.z_m)
        for a, b in pairwise(file)
        if (a.latitude_deg, a.longitude_deg) == (b.latitude_deg, b.longitude_deg)
    ]
    assert jumps == pytest.approx([FERRY_M - LINE_M] * 2)


@pytest.mark.parametrize("height_m", [3.5, 2.0, math.nan, 600.0])
def test_a_ferry_height_that_is_none_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, height_m: float
) -> None:
    field = written(FIELD, tmp_path / "f.geojson")
    out = tmp_path / "m.plan"
    words = [str(field), "--ferry-height-m", str(height_m), "--out", str(out)]
    assert execute(["plan", "--force", *words]) == 2
    error = capsys.readouterr().err
    assert "ferry height" in error or "--ferry-height-m" in error
    assert not out.exists()


def test_the_configuration_refuses_it_too_and_otherwise_sets_it(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    wrong = config_of(tmp_path, "height_m = 4.0\nferry_height_m = 4.0\n")
    assert execute(["config", "check", str(wrong)]) == 2
    assert "mission.ferry_height_m" in capsys.readouterr().out
    right = config_of(tmp_path, "ferry_height_m = 12.0\n")
    out = tmp_path / "m.plan"
    planned(capsys, tmp_path, out, "--config", right)
    assert read_mission(out)[1].z_m == 12.0


def test_a_depot_on_the_end_of_a_line_needs_no_ferry_height() -> None:
    from missions.plan import Leg, Sortie, at_ferry_height

    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, ferry_height_m=20.0)
    spray = Leg(kind="spray", points=((0.0, 0.2), (0.0, 90.0)), speed_m_s=6.0)
    out = Leg(kind="ferry", points=((0.0, 0.0), (0.0, 0.2)), speed_m_s=6.0)
    home = Leg(kind="ferry", points=((0.0, 90.0), (0.0, 0.0)), speed_m_s=6.0)
    (sortie,) = at_ferry_height([Sortie(number=1, depot=0, legs=(out, spray, home))], settings)
    assert [leg.height_m for leg in sortie.legs] == [None, None, 20.0]
    assert LineString(sortie.legs[1].points).length > 0.0


def test_the_twin_flies_such_a_mission_on_its_lines_at_their_height(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    from companion.core.frame import LocalFrame
    from sitl.routes import read_route

    routes = []
    for name, more in (("low", []), ("high", ["--ferry-height-m", FERRY_M])):
        planned(capsys, tmp_path, tmp_path / f"{name}.plan", *more)
        frame = LocalFrame(latitude_deg=48.0, longitude_deg=11.0)
        routes.append(
            read_route(tmp_path / f"{name}.plan", frame, speed_m_s=None, default_speed_m_s=5.0)
        )
    assert [route.height_m for route in routes] == [LINE_M, LINE_M]
    assert len(routes[0].legs) <= len(routes[1].legs)
    assert all(
        math.dist((a.east_m, a.north_m), (b.east_m, b.north_m)) > 0.1
        for a, b in pairwise(routes[1].legs)
    )
