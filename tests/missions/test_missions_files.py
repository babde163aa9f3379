"""Mission files: what ground stations read of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pyogrio
import pytest
import shapely
from shapely import Point, Polygon, box

from companion.core.frame import LocalFrame
from missions.demand import Uniform
from missions.errors import PlanError
from missions.field import build_field
from missions.files.write import paths_of, write_plan
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from sitl.stub.mission_items import read_mission
from tests.bench.missions import FRAME, to_degrees


@pytest.fixture(scope="module")
def plan() -> Plan:
    """Return a plan of several sorties around a hole."""
    hole = [(80.0, 60.0), (120.0, 60.0), (120.0, 90.0), (80.0, 90.0)]
    ground = Polygon([(0.0, 0.0), (200.0, 0.0), (200.0, 150.0), (0.0, 150.0)], [hole])
    field = build_field(to_degrees(ground), swath_width_m=6.0, frame=FRAME)
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, tank_l=20.0, reserve_l=0.0, moves=500)
    return plan_mission(field, settings, Uniform(rate_l_ha=20.0))


def test_every_sortie_has_a_file_and_the_first_is_the_one_asked_for(
    plan: Plan, tmp_path: Path
) -> None:
    files = write_plan(plan, tmp_path / "m.plan")
    assert [path.name for path in files] == [
        "m.plan", *(f"m-{number}.plan" for number in range(2, len(plan.sorties) + 1))
    ]  # fmt: skip
    assert len(files) == len(plan.sorties) > 1
    assert all(path.is_file() for path in files)


def test_a_plan_keeps_the_rules_of_its_loader(plan: Plan, tmp_path: Path) -> None:
    for path in write_plan(plan, tmp_path / "m.plan"):
        content = json.loads(path.read_text("utf-8"))
        assert content["fileType"] == "Plan"
        assert content["version"] == 1
        assert isinstance(content["groundStation"], str)
        mission = content["mission"]
        assert len(mission["plannedHomePosition"]) == 3
        for number, item in enumerate(mission["items"], start=1):
            assert item["type"] == "SimpleItem"
            assert item["doJumpId"] == number
            assert len(item["params"]) == 7
            assert isinstance(item["autoContinue"], bool)
            has = {"AltitudeMode", "Altitude", "AMSLAltAboveTerrain"} & set(item)
            assert len(has) in (0, 3)
        assert content["geoFence"]["version"] == 2
        assert content["rallyPoints"]["points"]


def test_the_fence_holds_the_whole_flight(plan: Plan, tmp_path: Path) -> None:
    content = json.loads(write_plan(plan, tmp_path / "m.plan")[0].read_text("utf-8"))
    polygons = content["geoFence"]["polygons"]
    keep_in = [Polygon(each["polygon"]) for each in polygons if each["inclusion"]]
    keep_out = [Polygon(each["polygon"]) for each in polygons if not each["inclusion"]]
    keep_out += [
        Point(each["circle"]["center"]).buffer(each["circle"]["radius"] / 111_200.0)
        for each in content["geoFence"]["circles"]
    ]
    assert len(keep_in) == len(keep_out) == 1
    for item in content["mission"]["items"]:
        if item["command"] == 16:
            place = Polygon(
                [(item["params"][4] + 1e-9 * x, item["params"][5] + 1e-9 * y)
                 for x, y in ((0, 0), (1, 0), (0, 1))]
            )  # fmt: skip
            assert keep_in[0].contains(place)
            assert not keep_out[0].intersects(place)


def test_a_corner_taken_too_far_is_within_the_fence(plan: Plan, tmp_path: Path) -> None:
    """PX4 in simulation is 1.24 m beyond the end of a line before it goes on aside."""
    for path in write_plan(plan, tmp_path / "m.plan"):
        content = json.loads(path.read_text("utf-8"))
        corners = content["geoFence"]["polygons"][0]["polygon"]
        shrunk = math.cos(math.radians(corners[0][0]))
        fence = Polygon([(111_200.0 * lat, 111_200.0 * shrunk * lon) for lat, lon in corners])
        for item in content["mission"]["items"]:
            if item["command"] == 16:
                lat, lon = item["params"][4:6]
                corner = Point(111_200.0 * lat, 111_200.0 * shrunk * lon)
                assert fence.exterior.distance(corner) >= 2.0


def test_plan_and_waypoints_hold_the_same_mission(plan: Plan, tmp_path: Path) -> None:
    one = read_mission(write_plan(plan, tmp_path / "m.plan")[0])
    two = read_mission(write_plan(plan, tmp_path / "m.waypoints")[0])
    assert [(i.command, i.x_e7, i.y_e7, i.z_m) for i in one] == [
        (i.command, i.x_e7, i.y_e7, i.z_m) for i in two
    ]
    assert [item.command for item in one[1:3]] == [22, 178]
    assert one[-1].command == 20


def test_waypoints_are_read_by_pymavlink(plan: Plan, tmp_path: Path) -> None:
    path = write_plan(plan, tmp_path / "m.waypoints")[0]
    # Only here: it compiles and loads every dialect there is.
    from pymavlink import mavwp

    loader = mavwp.MAVWPLoader()
    count = loader.load(str(path))
    lines = path.read_text("ascii").splitlines()
    assert count == len(lines) - 1
    assert all(len(line.split("\t")) == 12 for line in lines[1:])
    home = plan.frame.to_geographic(*plan.depots[0])
    assert (loader.wp(0).x, loader.wp(0).y) == pytest.approx(home, abs=1e-8)


def test_waypoints_lie_on_the_way(plan: Plan, tmp_path: Path) -> None:
    items = read_mission(write_plan(plan, tmp_path / "m.plan")[0])
    flown = [
        plan.frame.to_local(item.x_e7 / 1e7, item.y_e7 / 1e7)
        for item in items
        if item.command == 16
    ][1:]
    ends = [point for leg in plan.sorties[0].legs for point in leg.points]
    assert flown
    assert all(min(math.dist(place, end) for end in ends) < 0.4 for place in flown)


def test_the_sprayer_is_switched_at_every_line_where_asked(plan: Plan, tmp_path: Path) -> None:
    items = read_mission(write_plan(plan, tmp_path / "m.plan", with_sprayer=True)[0])
    switched = [item.param1 for item in items if item.command == 216]
    assert switched == [1.0, 0.0] * plan.sorties[0].lines


def test_geojson_has_a_line_for_each_leg_and_a_point_for_each_depot(
    plan: Plan, tmp_path: Path
) -> None:
    features = json.loads(write_plan(plan, tmp_path / "m.geojson")[0].read_text())["features"]
    lines = [each for each in features if each["geometry"]["type"] == "LineString"]
    assert {each["properties"]["kind"] for each in lines} <= {"spray", "transit", "ferry"}
    assert sum(each["properties"]["volume_l"] for each in lines) == pytest.approx(plan.volume_l)
    for each in lines:
        assert {"sortie", "sequence", "speed_m_s", "volume_l"} <= set(each["properties"])
        if each["properties"]["kind"] == "spray":
            assert len(each["geometry"]["coordinates"]) == 2
    points = [each for each in features if each["geometry"]["type"] == "Point"]
    assert [each["properties"]["kind"] for each in points] == ["depot"] * len(plan.depots)


def test_kml_has_a_folder_for_each_sortie(plan: Plan, tmp_path: Path) -> None:
    root = ElementTree.parse(write_plan(plan, tmp_path / "m.kml")[0]).getroot()
    assert len(root.findall(".//{*}Folder")) == len(plan.sorties)


def test_kml_has_the_heights_that_are_flown(plan: Plan, tmp_path: Path) -> None:
    high = replace(
        plan, sorties=(replace(plan.sorties[0], legs=tuple(
            replace(leg, height_m=20.0) if leg.kind == "ferry" else leg
            for leg in plan.sorties[0].legs)),),
    )  # fmt: skip
    path = write_plan(high, tmp_path / "m.kml")[0]
    (layer,) = (name for name in pyogrio.list_layers(path)[:, 0] if name.startswith("Sortie"))
    _, _, shapes, (kinds,) = pyogrio.raw.read(path, layer=layer, columns=["Name"])
    found = {
        (str(kind), float(height_m))
        for kind, shape in zip(kinds, shapely.from_wkb(shapes), strict=True)
        for height_m in shapely.get_coordinates(shape, include_z=True)[:, 2]
    }
    assert found - {("transit", 3.5)} == {("spray", 3.5), ("ferry", 20.0)}
    modes = {each.text for each in ElementTree.parse(path).iterfind(".//{*}altitudeMode")}
    assert modes == {"relativeToGround"}


def test_an_unknown_suffix_is_refused(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=r"\.txt is not known"):
        write_plan(plan, tmp_path / "m.txt")
    assert not list(tmp_path.iterdir())


def test_a_geojson_has_all_sorties_in_one_file() -> None:
    assert paths_of(Path("m.geojson"), 5) == [Path("m.geojson")]


def test_a_strafing_aircraft_keeps_its_yaw(tmp_path: Path) -> None:
    frame = LocalFrame(latitude_deg=48.0, longitude_deg=11.0)
    field = build_field(to_degrees(box(0, 0, 60, 200)), swath_width_m=6.0, frame=frame)
    settings = Settings(swath_width_m=6.0, speed_m_s=5.0, turn="strafe", angle_deg=30.0, moves=0)
    plan = plan_mission(field, settings, Uniform(rate_l_ha=5.0))
    content = json.loads(write_plan(plan, tmp_path / "m.plan")[0].read_text())
    yaws = {item["params"][3] for item in content["mission"]["items"] if item["command"] == 16}
    assert yaws == {30.0}
