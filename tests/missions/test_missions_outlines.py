"""Outlines as they are recorded and digitised: many corners, rings that cross, no degrees."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon, box
from shapely.affinity import rotate, translate

import missions.planner
from companion.cli.app import execute
from companion.errors import MapError
from missions.demand import Uniform
from missions.errors import PlanError
from missions.fewer_corners import (
    FewerAndFewer,
    around_with_fewer_corners,
    each_inside,
    inside_with_fewer_corners,
    with_corners,
)
from missions.field import Field, build_field
from missions.files.fence import Fences, fence_warnings
from missions.files.items import FENCE_CORNERS_MAX
from missions.files.write import lines_text, plan_text
from missions.free_space import CORNERS_MAX, free_space
from missions.layouts import spray_lines
from missions.maps.local import make_valid
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.reading_outline import outline_of
from missions.strips import Floats
from missions.ways import build_ways, edge_places
from tests.bench.missions import FRAME, to_degrees
from tests.bench.parcels import parcel
from tests.mission_fields import blob, degrees, recorded, trees
from tests.mission_judge import Drawn, judge, judge_fence

pytestmark = pytest.mark.usefixtures("searched_briefly")

SETTINGS = Settings(swath_width_m=6.0, speed_m_s=6.0, moves=500)


def corners(area: shapely.Geometry) -> int:
    return len(shapely.get_coordinates(area))


def field_of(drawn: Drawn) -> Field:
    return build_field(
        drawn.outline, obstacles=list(drawn.obstacles), swath_width_m=drawn.width_m  # type: ignore[arg-type]
    )  # fmt: skip


def shrunk(ground: shapely.Geometry) -> Polygon:
    """Return the ground a planner's margin inside."""
    found = ground.buffer(-0.0025, join_style="mitre")
    assert isinstance(found, Polygon)
    return found


def zigzag(teeth: int) -> Polygon:
    """Return a field with a saw's edge, no tooth of which can be left out."""
    across = np.repeat(np.arange(teeth) * 4.0, 2)
    along = np.tile([0.0, 3.0], teeth)
    edge: Floats = np.column_stack([across + np.tile([0.0, 2.0], teeth), along])
    long_m = float(edge[-1, 0])
    return Polygon([*edge, (long_m, 120.0), (0.0, 120.0)])


SHAPES = {
    "recorded-1": recorded(rotate(box(0.0, 0.0, 134.0, 84.0), 17.0), step_m=1.0),
    "recorded-3": recorded(blob(5.0, seed=3), step_m=3.0),
    "smooth": Drawn(outline=recorded(blob(1.1, seed=2), step_m=1.0, noise_m=0.0).outline),
}


@pytest.mark.parametrize("name", SHAPES)
def test_fewer_corners_stay_inside_and_near(name: str) -> None:
    drawn = SHAPES[name]
    area = drawn.plane.area(drawn.outline)
    assert isinstance(area, Polygon)
    found = inside_with_fewer_corners(area, 0.1)
    assert area.buffer(1e-6).covers(found)
    assert corners(found) < corners(area) * 0.4
    far_m = shapely.distance(found.boundary, shapely.points(shapely.get_coordinates(area)))
    assert far_m.max() <= 0.1 + 1e-3
    assert area.area - found.area <= 0.1 * area.length


@pytest.mark.parametrize("tolerance_m", [0.07, 0.05, 0.03, 0.02])
def test_an_edge_that_touches_the_border_it_stands_for_is_no_reason_to_keep_all(
    tolerance_m: float,
) -> None:
    # Walked every 2 m: a corner of it lay 1e-12 m beyond the new edge, and all 533 were kept.
    made = parcel("obstacles", 6)
    ground = Drawn(outline=made.outline).plane.area(made.outline)
    found = inside_with_fewer_corners(shrunk(ground), tolerance_m)
    assert corners(found) < corners(ground) * 0.85
    assert ground.covers(found)


@pytest.mark.parametrize(
    ("kind", "seed"), [("recorded", 3), ("recorded", 17), ("recorded", 20), ("obstacles", 8)]
)
def test_simpler_borders_leave_enough_of_small_fields(kind: str, seed: int) -> None:
    # 0.17 to 1 ha walked with a receiver, 0.7 ha with seven trees: 99.72 to 99.798 % before.
    made = parcel(kind, seed)
    drawn = Drawn(outline=made.outline, obstacles=made.obstacles)
    plan = plan_mission(field_of(drawn), SETTINGS, Uniform(rate_l_ha=20.0))
    found = judge(drawn, json.loads(lines_text(plan)), speed_m_s=6.0, a_m_s2=2.5)
    assert found["reachable_percent"] >= 99.8
    assert found["off_m2"] == 0.0


def test_a_hole_with_fewer_corners_is_larger_and_a_drawn_corner_stays_where_it_is() -> None:
    hole = shapely.Point(60.0, 40.0).buffer(8.0, quad_segs=24)
    ground = Polygon(
        [(0.0, 0.0), (150.0, 0.0), (150.0, 90.0), (70.0, 130.0), (0.0, 90.0)],
        [hole.exterior.coords],
    )
    found = inside_with_fewer_corners(ground, 0.1)
    assert isinstance(found, Polygon)
    assert corners(found.exterior) == 6
    assert found.exterior.equals(ground.exterior)
    assert Polygon(found.interiors[0]).covers(hole)
    assert corners(found.interiors[0]) < 40


@pytest.mark.parametrize("radius_m", [1.0, 3.0, 7.0])
def test_a_tree_is_drawn_around_with_few_corners(radius_m: float) -> None:
    tree = shapely.Point(3.0, 4.0).buffer(radius_m, quad_segs=32)
    found = around_with_fewer_corners(tree, 0.5)
    assert found.covers(tree)
    assert corners(found) <= 13
    assert found.hausdorff_distance(tree) <= 0.75


def test_many_areas_together_get_the_corners_that_each_gets_by_itself() -> None:
    # More of them than are looked at together, of two counts of corners; one with a hole.
    made = [shapely.Point(20.0 * at, at).buffer(2.0 + at, quad_segs=16 + at % 2) for at in range(9)]
    made.append(made[8].difference(made[8].centroid.buffer(3.0)))
    together = each_inside(made, 0.4)
    assert shapely.to_wkb(together).tolist() == [
        shapely.to_wkb(inside_with_fewer_corners(area, 0.4)) for area in made
    ]
    assert all(area.covers(found) for area, found in zip(made, together, strict=True))


def test_ways_over_ground_with_very_many_corners_are_found() -> None:
    # No tolerance takes a tooth away; a simpler border used to get them back, without end.
    ground = zigzag(CORNERS_MAX + 20)
    space = free_space(ground)
    assert len(space.corners) > CORNERS_MAX
    way = space.way((8.0, 1.0), (1248.0, 1.0))
    assert way
    assert ground.buffer(1e-3).covers(shapely.LineString(way))


def test_an_outline_of_a_point_every_metre_is_planned_like_the_field_that_it_is() -> None:
    drawn = recorded(rotate(box(0.0, 0.0, 134.0, 84.0), 17.0), step_m=1.0)
    found = judged(drawn)
    assert found["lines"] <= 60  # its rectangle needs 15, today's planner 425
    assert found["reachable_percent"] >= 99.7  # 0.17 % are given up for a simpler border
    assert found["off_m2"] == 0.0
    assert found["transit_outside_m"] == 0.0


def test_a_ditch_as_wide_as_a_swath_is_covered_though_margins_make_it_narrower() -> None:
    ditch = box(-20.0, 0.0, 0.1, 6.003)
    drawn = Drawn(outline=degrees(rotate(box(0.0, -20.0, 60.0, 30.0).union(ditch), 12.0)))
    found = judged(drawn)
    assert found["reachable_percent"] >= 99.8
    assert found["off_m2"] == 0.0


@pytest.mark.parametrize("corner_count", [8, 64])
def test_trees_need_a_few_lines_each(corner_count: int) -> None:
    drawn = trees(5, corners=corner_count, area_ha=4.0)
    found = judged(drawn)
    assert found["lines"] <= 95
    assert found["reachable_percent"] >= 99.8
    assert found["off_m2"] == 0.0
    assert found["transit_outside_m"] == 0.0


def judged(drawn: Drawn) -> dict[str, float]:
    return judge(drawn, geojson_of(planned(drawn)), speed_m_s=6.0, a_m_s2=2.5)


def planned(drawn: Drawn) -> Plan:
    return plan_mission(field_of(drawn), SETTINGS, Uniform(rate_l_ha=20.0))


def geojson_of(plan: Plan) -> dict[str, object]:
    found: dict[str, object] = json.loads(lines_text(plan))
    return found


# --- rings that cross, and what is no degrees --------------------------------------------------


def written(path: Path, *rings: list[tuple[float, float]]) -> Path:
    geometry = {"type": "Polygon", "coordinates": [[list(at) for at in ring] for ring in rings]}
    feature = {"type": "Feature", "properties": {}, "geometry": geometry}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


def ring(*points: tuple[float, float]) -> list[tuple[float, float]]:
    found = shapely.get_coordinates(to_degrees(Polygon(points)))
    return [(float(x), float(y)) for x, y in found]


SQUARE = ring((0, 0), (200, 0), (200, 100), (0, 100))


def test_a_hole_outside_of_its_outline_is_no_ground() -> None:
    shell, hole = box(0, 0, 100, 100), box(150, 0, 160, 10)
    drawn = Polygon(shell.exterior.coords, [hole.exterior.coords])
    found = make_valid(drawn)
    assert found is not None
    assert found.equals(shell)
    # One that reaches over its edge takes away what it has of the field.
    crossing = Polygon(shell.exterior.coords, [translate(hole, -55.0, 20.0).exterior.coords])
    found = make_valid(crossing)
    assert found is not None
    assert found.area == pytest.approx(100.0 * 100.0 - 5.0 * 10.0)


@pytest.mark.parametrize(
    "rings",
    [
        (ring((0, 0), (200, 100), (200, 0), (0, 100)),),
        (SQUARE, ring((250, 20), (300, 20), (300, 60), (250, 60))),
        (SQUARE, ring((180, 20), (230, 20), (230, 60), (180, 60))),
    ],
    ids=["bow-tie", "hole outside", "hole over the edge"],
)
def test_an_outline_whose_repair_changes_its_ground_is_refused(
    tmp_path: Path, rings: tuple[list[tuple[float, float]], ...]
) -> None:
    path = written(tmp_path / "f.geojson", *rings)
    with pytest.raises(MapError, match=r"f\.geojson: record 1: rings cross .* repair it"):
        outline_of(path, None, [])


def test_a_walk_that_crosses_its_own_start_is_repaired_and_that_is_said(tmp_path: Path) -> None:
    walk = ring((0, 1.5), (-2, -2), (200, 0), (200, 100), (0, 100), (0, -2), (-3, -1))
    said: list[str] = []
    outline_of(written(tmp_path / "f.geojson", walk), None, said)
    assert len(said) == 1


def test_metres_that_were_read_as_degrees_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "f.geojson", [(0, 0), (0.2, 0), (0.2, 0.1), (0, 0.1), (0, 0)])
    with pytest.raises(PlanError, match="metres from a local origin"):
        outline_of(path, None, [])
    metres = [(0.0, 0.0), (80.0, 0.0), (80.0, 40.0), (0.0, 40.0), (0.0, 0.0)]
    with pytest.raises(MapError, match="metres from a local origin"):
        outline_of(written(path, metres), None, [])


@pytest.mark.parametrize("width_m", [0.05, 1e-6])
def test_a_swath_that_needs_thousands_of_passes_is_refused(width_m: float) -> None:
    with pytest.raises(PlanError, match=r"passes or more.*--swath-m"):
        build_field(to_degrees(box(0, 0, 200, 100)), swath_width_m=width_m, frame=FRAME)


def test_no_depot_is_suggested_at_an_obstacle_inside_the_field() -> None:
    field = build_field(
        to_degrees(box(0, 0, 300, 100)), obstacles=[to_degrees(box(140, -10, 150, 110))],
        swath_width_m=6.0, frame=FRAME,
    )  # fmt: skip
    places = edge_places(field, step_m=5.0, count_max=500)
    edge = field.outline.boundary
    assert max(edge.distance(shapely.Point(place)) for place in places) <= 0.11
    assert math.isfinite(places.sum())


# --- fences ------------------------------------------------------------------------------------


def fence_faults(plan: Plan, drawn: Drawn) -> list[str]:
    fences = Fences(plan)
    return [
        fault
        for sortie in plan.sorties
        for fault in judge_fence(
            drawn, json.loads(plan_text(plan, sortie, fences=fences)),
            corners_max=FENCE_CORNERS_MAX["ardupilot"], outside_max_m=6.0,
        )
    ]  # fmt: skip


def test_a_fence_among_many_trees_fits_and_says_which_found_no_room() -> None:
    drawn = trees(50, corners=8, area_ha=8.0)
    plan = planned(drawn)
    assert not fence_faults(plan, drawn)
    assert "the fence has no room for" in fence_warnings(plan, Fences(plan))[0]


def test_a_fence_around_an_outline_of_a_point_every_metre_is_near_it() -> None:
    drawn = recorded(blob(2.0, seed=3), step_m=1.0)
    plan = planned(drawn)
    assert not fence_faults(plan, drawn)
    assert fence_warnings(plan, Fences(plan)) == ()


def test_two_parts_of_a_field_have_no_fence_around_all_between_them() -> None:
    two = shapely.union_all([box(0, 0, 80, 60), box(400, 0, 480, 60)])
    drawn = Drawn(outline=degrees(two))
    plan = planned(drawn)
    assert not fence_faults(plan, drawn)


def comb(teeth: int) -> shapely.Geometry:
    return shapely.union_all(
        [box(0, 0, 40 * teeth, 20), *(box(40 * k, 0, 40 * k + 8, 60) for k in range(teeth))]
    )


def test_a_fence_without_room_for_the_whole_field_holds_the_ground_beside_the_way() -> None:
    drawn = Drawn(outline=degrees(comb(25)))
    plan = planned(drawn)
    fences = Fences(plan)
    content = json.loads(plan_text(plan, plan.sorties[0], fences=fences))
    room = FENCE_CORNERS_MAX["ardupilot"]
    assert not judge_fence(drawn, content, corners_max=room, outside_max_m=10.0)
    assert "20 m beside the way" in " ".join(fence_warnings(plan, fences))


def test_a_border_for_which_the_autopilot_has_no_room_is_refused() -> None:
    settings = replace(SETTINGS, tank_l=400.0)
    plan = plan_mission(
        field_of(Drawn(outline=degrees(comb(45)))), settings, Uniform(rate_l_ha=20.0)
    )
    assert len(plan.sorties) == 1
    # 560 bytes: 5 for where it begins and ends, 2 for a polygon, and 8 for each of 69 corners.
    said = (
        r"sortie 1: a fence within 10 m .* near 4\d\.\d+, 11\.\d+, .* has room for 69 \(560 bytes"
    )
    with pytest.raises(PlanError, match=said):
        plan_text(plan, plan.sorties[0])


def test_a_sortie_for_whose_fence_there_is_no_room_is_flown_as_several(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    room, drawn = 24, Drawn(outline=degrees(comb(8)))
    monkeypatch.setitem(FENCE_CORNERS_MAX, "ardupilot", room)
    searched = []

    def counted_lines(*asked: Any) -> Any:
        searched.append(asked)
        return spray_lines(*asked)

    monkeypatch.setattr(missions.planner, "spray_lines", counted_lines)
    path = tmp_path / "f.geojson"
    path.write_text(shapely.to_geojson(drawn.outline))
    words = [path, "--rate-l-ha", "20", "--tank-l", "400", "--json", "--out"]
    code = execute(["plan", "--force", *map(str, words), str(tmp_path / "m.plan")])
    found = json.loads(capsys.readouterr().out)
    assert code == 0, found
    assert len(found["sorties"]) > 1
    # Cut as they are: nothing is planned twice.
    assert len(searched) == 1
    assert any(
        "1 sortie would have a fence with more corners" in each for each in found["warnings"]
    )
    for name in found["files"]:
        content = json.loads(Path(name).read_text(encoding="utf-8"))
        assert not judge_fence(drawn, content, corners_max=room, outside_max_m=10.0)
    # A file without a fence has one sortie as before.
    assert execute(["plan", "--force", *map(str, words), str(tmp_path / "m.waypoints")]) == 0
    assert len(json.loads(capsys.readouterr().out)["sorties"]) == 1


def test_a_border_without_room_need_not_keep_near_inside_the_field(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    each = parcel("drawn", 5)
    drawn = Drawn(outline=each.outline)
    plan = planned(drawn)
    monkeypatch.setitem(FENCE_CORNERS_MAX, "ardupilot", 11)
    fences = Fences(plan)
    for sortie in plan.sorties:
        content = json.loads(plan_text(plan, sortie, fences=fences))
        assert not judge_fence(drawn, content, corners_max=11, outside_max_m=10.0)


def test_obstacles_without_room_are_drawn_simpler_before_any_is_left_out() -> None:
    around = np.linspace(0.0, math.tau, 32, endpoint=False)
    pond = Polygon(np.column_stack([22.0 * np.cos(around), 7.0 * np.sin(around)]))
    ponds = [
        rotate(translate(pond, 40.0 + 60.0 * (k % 4), 30.0 + 50.0 * (k // 4)), 20.0 * k)
        for k in range(8)
    ]
    drawn = Drawn(
        outline=degrees(box(0.0, 0.0, 270.0, 110.0)), obstacles=[degrees(each) for each in ponds]
    )
    plan = planned(drawn)
    assert not fence_faults(plan, drawn)
    assert fence_warnings(plan, Fences(plan)) == ()
    content = json.loads(plan_text(plan, plan.sorties[0]))
    assert sum(not each["inclusion"] for each in content["geoFence"]["polygons"]) == 8


@given(seed=st.integers(0, 5_000), most=st.integers(3, 30), far_m=st.floats(0.0, 60.0))
@settings(max_examples=25, deadline=None)
def test_a_border_with_fewer_corners_holds_all_of_it_on_allowed_ground(
    seed: int, most: int, far_m: float
) -> None:
    border = parcel("recorded", seed % 40).outline
    drawn = Drawn(outline=border)
    area = Polygon(shapely.get_parts(drawn.plane.area(border))[0].exterior).simplify(1.0)
    assert isinstance(area, Polygon)
    found = with_corners(area, area.buffer(far_m), most)
    assert found.is_valid
    assert found.buffer(1e-6).covers(area)
    assert area.buffer(far_m + 1e-6).covers(found)
    assert corners(found) <= corners(area)
    if far_m > 0.0 and corners(found) - 1 > max(most, 3):
        again = with_corners(found, area.buffer(far_m), most)
        assert corners(again) == corners(found)
    drawn_once = FewerAndFewer(area, area.buffer(far_m))
    for some in (most + 7, most, most + 3):
        assert drawn_once.with_corners(some).equals(with_corners(area, area.buffer(far_m), some))


def test_ways_among_many_obstacles_are_the_shortest() -> None:
    stones = shapely.union_all(
        [box(20 * x + 7 * (y % 2), 20 * y, 20 * x + 7 * (y % 2) + 8, 20 * y + 8)
         for x in range(12) for y in range(12)]
    )  # fmt: skip
    space = free_space(box(-10, -10, 260, 260).difference(stones))
    assert len(space.corners) == 4 * 144
    way = space.way((-5.0, 4.0), (255.0, 4.0))
    # Beside the first row, the corners of its first and its last stone.
    assert len(way) == 4
    assert shapely.LineString(way).length == pytest.approx(262.0, abs=0.2)
    far = space.way((-5.0, -5.0), (250.0, 243.0))
    assert space.space.covers(shapely.LineString(far))
    assert shapely.LineString(far).length < 1.05 * math.dist((-5.0, -5.0), (250.0, 243.0))


def test_many_ways_at_once_are_what_each_is_alone() -> None:
    stones = shapely.union_all(
        [box(20 * x + 3 * y, 20 * y, 20 * x + 3 * y + 9, 20 * y + 8)
         for x in range(12) for y in range(12)]
    )  # fmt: skip
    space = free_space(rotate(box(-10, -10, 290, 260).difference(stones), 20.0))
    places = np.random.default_rng(1).uniform(-80.0, 380.0, (400, 2))
    starts, ends = places[:200].repeat(5, axis=0), places[200:].repeat(5, axis=0)[::-1]
    seen = space.sees(starts, ends)
    each = [space.sees(starts[[at]], ends[[at]])[0] for at in range(len(starts))]
    assert seen.tolist() == each
    assert 10 < seen.sum() < 500


def test_ways_home_are_the_shortest_over_a_corner_in_sight() -> None:
    stones = [to_degrees(box(x, 40.0 * (x % 50 > 0), x + 12.0, 40.0 * (x % 50 > 0) + 60.0))
              for x in range(25, 300, 25)]  # fmt: skip
    field = build_field(
        to_degrees(box(0.0, 0.0, 320.0, 100.0)), obstacles=stones, obstacle_buffer_m=0.0,
        swath_width_m=6.0, frame=FRAME,
    )  # fmt: skip
    ways = build_ways(field, np.array([[0.0, 50.0], [320.0, 90.0]]))
    ends = np.random.default_rng(2).uniform((1.0, 1.0), (319.0, 99.0), (300, 2))
    ends = ends[shapely.contains_xy(field.fly, ends)]
    found_m = ways.home_ways_m(ends)
    space = ways.inside
    to_ends_m, from_gates_m = (
        space.to_corners_m(each, nearest=None) for each in (ends, ways.gates)
    )
    for depot, gate in enumerate(ways.gates):
        over_m = np.min(from_gates_m[depot][:, None] + space.between_m, axis=0) + to_ends_m
        straight_m = np.hypot(*(ends - gate).T)
        is_seen = space.sees(np.tile(gate, (len(ends), 1)), ends)
        assert not is_seen.all()
        shortest_m = np.where(is_seen, straight_m, over_m.min(axis=1))
        assert np.allclose(found_m[depot], shortest_m, atol=1e-6)


def test_a_low_tree_is_flown_across_without_a_stop_and_a_high_one_around() -> None:
    tree = to_degrees(box(95.0, 20.0, 105.0, 30.0))
    ground = to_degrees(box(0.0, 0.0, 200.0, 48.0))
    low = build_field(ground, no_spray=[tree], swath_width_m=6.0, frame=FRAME)
    high = build_field(
        ground, obstacles=[tree], obstacle_buffer_m=0.0, swath_width_m=6.0, frame=FRAME
    )
    across, around = (
        plan_mission(field, SETTINGS, Uniform(rate_l_ha=20.0)) for field in (low, high)
    )
    middle = box(96.0, 20.5, 104.0, 29.5)
    over = [
        leg for sortie in across.sorties for leg in sortie.legs
        if middle.intersects(shapely.LineString(leg.points))
    ]  # fmt: skip
    assert over
    assert any(leg.kind == "transit" and leg.through for leg in over)
    assert all(leg.kind != "spray" for leg in over)
    assert across.flight_s < around.flight_s
