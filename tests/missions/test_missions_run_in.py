"""Run-in and run-out: passes at speed from their first metre, where there is room for it."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from shapely import Polygon, box

from companion.core.frame import LocalFrame
from missions.demand import Uniform
from missions.field import Field, build_field
from missions.files.write import write_plan
from missions.plan import Leg, Plan, Settings
from missions.planner import plan_mission
from missions.stops import RUN_M, waypoints_of
from missions.surroundings import NOTHING_AROUND, RunIn, Surroundings
from tests.bench.missions import FRAME, to_degrees
from tests.missions.test_missions_cli import ANYANG, run, written
from tests.missions.test_missions_wind import config_with

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

GROUND = box(0, 0, 60, 200)
# A jerk of 1 m/s3 up and down again, 0.3 s of its own coming and going; half of 6 m/s meanwhile.
NEEDED_M = (2.0 * math.sqrt(6.0) + 0.3) * 6.0 / 2.0


def field_of(ground: Polygon = GROUND, **more: Any) -> Field:
    return build_field(to_degrees(ground), swath_width_m=6.0, frame=FRAME, **more)


def plan_of(field: Field, run_in: RunIn | None) -> Plan:
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, moves=0, angle_deg=0.0)
    around = NOTHING_AROUND if run_in is None else Surroundings(run_in=run_in)
    return plan_mission(
        field, settings, Uniform(rate_l_ha=5.0), depots=(FRAME.to_geographic(0.0, 0.0),),
        around=around,
    )  # fmt: skip


def starts(plan: Plan) -> list[tuple[Leg, Leg]]:
    return [
        (before, after)
        for sortie in plan.sorties
        for before, after in pairwise(sortie.legs)
        if after.kind == "spray"
    ]


def test_a_pass_has_its_way_from_rest_to_speed_before_and_behind_it() -> None:
    field = field_of()
    outside = field.outline.buffer(50.0)
    plan = plan_of(field, RunIn(ground=outside))
    assert not plan.warnings
    assert len(starts(plan)) == 10
    for before, line in starts(plan):
        entry, start, end = (np.array(p) for p in (before.points[-2], line.points[0],
                                                   line.points[-1]))  # fmt: skip
        along = (end - start) / np.hypot(*(end - start))
        assert start - entry == pytest.approx(along * NEEDED_M, abs=1e-6)


def test_a_run_in_and_its_line_are_one_way_of_the_mission() -> None:
    field = field_of()
    longer = plan_of(field, RunIn(ground=field.outline.buffer(50.0)))
    plain = plan_of(field, None)
    assert longer.volume_l == plain.volume_l
    assert longer.coverage == plain.coverage
    assert longer.turns == 9
    # Both runs of 15.6 m at full speed, and nothing more: a waypoint where a line begins would
    # have an autopilot that plans from rest to rest creep over it.
    runs_s = 10 * 2.0 * NEEDED_M / 6.0
    assert runs_s - 4.0 < longer.flight_s - plain.flight_s < runs_s + 4.0
    lines = [leg for leg in longer.sorties[0].legs if leg.kind == "spray"]
    items = waypoints_of(longer.sorties[0])
    assert not {line.points[0] for line in lines} & {stop.place for stop in items}


def test_without_room_a_pass_begins_slower_and_that_is_said() -> None:
    field = field_of()
    plan = plan_of(field, RunIn())
    assert len(plan.warnings) == 1
    assert "10 of 10 passes begin below their speed" in plan.warnings[0]
    assert "mission.overrun" in plan.warnings[0]
    inside = field.outline.buffer(0.01)
    assert all(inside.covers(shapely.LineString(leg.points))
               for sortie in plan.sorties for leg in sortie.legs)  # fmt: skip


def test_half_of_the_room_gives_its_speed() -> None:
    field = field_of()
    room_m = 3.0
    plan = plan_of(field, RunIn(ground=field.outline.buffer(room_m, join_style="mitre")))
    # 1.94 m/s is reached in 2 sqrt(1.94) + 0.3 s, with half of it on average.
    assert 1.94 * (2.0 * math.sqrt(1.94) + 0.3) / 2.0 == pytest.approx(room_m, rel=0.01)
    assert "the slowest at 1.9 instead of 6 m/s" in plan.warnings[0]


def test_a_polygon_on_one_side_gives_room_there_only() -> None:
    field = field_of()
    north = box(-20.0, 199.0, 80.0, 230.0)
    plan = plan_of(field, RunIn(ground=shapely.union_all([field.fly, north])))
    assert "5 of 10 passes" in plan.warnings[0] or "6 of 10 passes" in plan.warnings[0]
    for sortie in plan.sorties:
        for leg in sortie.legs:
            outside = shapely.LineString(leg.points).difference(field.outline.buffer(0.01))
            assert outside.is_empty or north.covers(outside)


def test_runs_never_cross_an_obstacle() -> None:
    mast = box(-5.0, 203.0, 65.0, 206.0)
    field = field_of(obstacles=[to_degrees(mast)], obstacle_buffer_m=1.0)
    ground = field.outline.buffer(50.0).difference(field.blocked)
    plan = plan_of(field, RunIn(ground=ground))
    for sortie in plan.sorties:
        for leg in sortie.legs:
            assert not shapely.LineString(leg.points).intersects(mast.buffer(0.9))
    assert plan.warnings


def test_a_shorter_run_than_speed_needs_is_what_was_asked_for() -> None:
    course = Settings(swath_width_m=6.0, speed_m_s=6.0).motion.at(6.0)
    assert RunIn(run_m=50.0).wanted_m(course) == pytest.approx(NEEDED_M)
    # A longer one would be a waypoint of its own.
    quick = Settings(swath_width_m=6.0, speed_m_s=12.0).motion.at(12.0)
    assert RunIn().wanted_m(quick) == RUN_M
    field = field_of()
    plan = plan_of(field, RunIn(run_m=2.0, ground=field.outline.buffer(50.0)))
    before, line = starts(plan)[3]
    assert math.dist(before.points[-2], line.points[0]) == pytest.approx(2.0)


def test_the_fence_holds_run_ins_outside_the_field(tmp_path: Path) -> None:
    field = field_of()
    plan = plan_of(field, RunIn(ground=field.outline.buffer(50.0)))
    content = json.loads(write_plan(plan, tmp_path / "m.plan")[0].read_text())
    inside = [each for each in content["geoFence"]["polygons"] if each["inclusion"]]
    fence = Polygon([FRAME.to_local(*corner) for corner in inside[0]["polygon"]])
    for leg in plan.sorties[0].legs:
        assert fence.covers(shapely.LineString(leg.points))


@pytest.mark.parametrize(
    ("more", "code", "warned"),
    [(["--run-in-m", "auto"], 0, True), (["--run-in-m", "0"], 0, False),
     (["--run-in-m", "far"], 2, False), (["--run-in-m", "nan"], 2, False)],
)  # fmt: skip
def test_the_command_takes_metres_or_auto(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, more: list[str], code: int, warned: bool
) -> None:
    found_code, found, _ = run(
        capsys, ANYANG / "boundary.geojson", "--config", ANYANG / "config.toml", *more,
        "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert found_code == code
    if code == 2:
        assert "--run-in-m" in found["error"]
    else:
        assert any("for want of room" in each for each in found["warnings"]) == warned


@pytest.mark.parametrize(
    ("keys", "slow"),
    [('overrun = "allowed"', False), ('overrun_areas = ["verge.geojson"]', False), ("", True)],
)
def test_the_configuration_says_where_run_ins_may_lie(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, keys: str, slow: bool
) -> None:
    config = config_with(tmp_path, f'run_in_m = "auto"\n{keys}')
    frame = LocalFrame(latitude_deg=48.0, longitude_deg=11.0)
    field = written(GROUND, tmp_path / "f.geojson")
    verge = GROUND.buffer(20.0, join_style="mitre").difference(GROUND)
    path = tmp_path / "verge.geojson"
    geometry = json.loads(shapely.to_geojson(to_degrees(verge, frame)))
    features = [{"type": "Feature", "properties": {}, "geometry": geometry}]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    code, found, _ = run(
        capsys, field, "--config", config, "--rate-l-ha", "20", "--angle-deg", "0",
        "--out", tmp_path / "m.plan",
    )  # fmt: skip
    assert code == 0
    assert any("for want of room" in each for each in found["warnings"]) == slow
