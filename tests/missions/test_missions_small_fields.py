"""Small and narrow fields: lines chosen from many, what may be left, what falls twice."""

from __future__ import annotations

import json
import math
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import settings as tries
from hypothesis import strategies as st
from shapely import Polygon, box

from companion.cli.app import execute
from missions import layouts
from missions.boom import Boom
from missions.corners import Motion
from missions.coverage import measure, reachable
from missions.demand import Uniform
from missions.field import build_field
from missions.open_lines import open_lines
from missions.picture import draw_plan
from missions.plan import Leg, Plan, Settings
from missions.planner import plan_mission
from missions.prices import overlap_warnings, twice_hint
from missions.selection import Aim, _Set, chosen, families
from missions.sheet import sheet
from missions.strips import border_passes, joined, lengths_m, rectangles, united, whole
from missions.worth import Tour, worthwhile
from tests.bench.small_fields import VALVES
from tests.mission_fields import degrees
from tests.small_fields import DITCH_M, KINDS, made_up

WIDTH_M = 6.0
MOTION = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)


def plan_of(ground: Polygon, **changes: Any) -> Plan:
    field = build_field(degrees(ground), swath_width_m=WIDTH_M)  # type: ignore[arg-type]
    settings = Settings(swath_width_m=WIDTH_M, speed_m_s=6.0, **changes)
    return plan_mission(field, settings, Uniform(rate_l_ha=20.0))


def test_strips_side_by_side_are_all_in_their_union() -> None:
    # Without a grid GEOS 3.13 leaves three of these out: 9,564,000 m2 of 9,600,000.
    turn = np.array([[math.cos(0.37), math.sin(0.37)], [-math.sin(0.37), math.cos(0.37)]])
    north = np.arange(800) * WIDTH_M
    start = np.column_stack([np.zeros(800), north]) @ turn
    end = np.column_stack([np.full(800, 2000.0), north]) @ turn
    across = np.column_stack([start[:200] + 3.0, start[:200] + np.array([300.0, 400.0])])
    strips = rectangles(np.vstack([np.column_stack([start, end]), across]), WIDTH_M)
    side_by_side_m2 = float(shapely.area(strips[:800]).sum())
    assert whole(strips).area >= side_by_side_m2 - 0.01


# Sixty passes of 500 m that GEOS 3.13 leaves four of out of a plain union, and one across them.
SLANTED = np.array([math.cos(0.37), math.sin(0.37)])
ACROSS = np.array([-SLANTED[1], SLANTED[0]])


def plan_of_many_passes() -> Plan:
    places = [(number * WIDTH_M * ACROSS, 500.0 * SLANTED) for number in range(60)]
    passes = [(start, start + way) for start, way in places]
    middle = 250.0 * SLANTED + 30.0 * WIDTH_M * ACROSS
    lines = [*passes, (middle, middle + 29.0 * WIDTH_M * ACROSS)]
    corners = [-0.5 * WIDTH_M * ACROSS, 59.5 * WIDTH_M * ACROSS]
    ground = Polygon([corners[0], corners[0] + 500.0 * SLANTED, corners[1] + 500.0 * SLANTED,
                      corners[1]])  # fmt: skip
    legs = tuple(
        Leg(
            kind="spray", points=(tuple(start), tuple(end)), speed_m_s=6.0,
            volume_l=math.dist(start, end) / 100.0,
        )
        for start, end in lines
    )  # fmt: skip
    plan = plan_of(box(0.0, 0.0, 30.0, 20.0), moves=0)
    return replace(
        plan,
        field=replace(plan.field, outline=ground, limit=ground),
        lines=np.array([[*start, *end] for start, end in passes]),
        sorties=(replace(plan.sorties[0], legs=legs),),
    )


def test_litres_of_a_line_across_sixty_passes_fall_twice() -> None:
    # The line begins and ends in the middle of a pass.
    assert sheet(plan_of_many_passes())["overlap_l"] == pytest.approx(1.74, abs=0.001)


def test_no_pass_of_sixty_is_drawn_as_left_unsprayed(tmp_path: Path) -> None:
    draw_plan(plan_of_many_passes(), tmp_path / "m.svg", title="field")
    assert "<!-- left unsprayed" not in (tmp_path / "m.svg").read_text()


@given(kind=st.sampled_from(KINDS), seed=st.integers(0, 500))
@tries(max_examples=4)
def test_lines_chosen_from_many_stay_on_the_field_and_cover_it(kind: str, seed: int) -> None:
    ground = made_up(kind, seed)
    passes = border_passes(ground, WIDTH_M)
    pools = [
        (joined([passes, family]), list(range(len(passes))))
        for family in families(ground, Boom(width_m=WIDTH_M), [10.0, 100.0])
    ]
    target = reachable(ground, WIDTH_M)
    aim = Aim(left_max_m2=0.001 * target.area, doubled_s_m2=0.01)
    found = chosen(pools, ground, Boom(width_m=WIDTH_M), aim=aim, motion=MOTION, moves=500)
    for lines in found:
        covered = united(lines, WIDTH_M)
        assert covered.difference(ground.buffer(0.005)).area == pytest.approx(0.0, abs=1e-3)
        # Patches fill what is left, up to what may be.
        assert covered.intersection(target).area > 0.97 * target.area


def test_a_wedge_takes_no_more_lines_than_it_is_wide() -> None:
    # Passes along one side, along the border of the other and at both ends would be nine.
    plan = plan_of(Polygon([(0, 0), (160, 4), (160, 33), (0, 40)]))
    assert len(plan.lines) <= 8
    assert plan.coverage.reachable_percent >= 99.8
    assert plan.coverage.outside_m2 == 0.0


def test_what_may_be_left_saves_passes_and_no_more_is_left() -> None:
    ground = made_up("quadrangle", 1000)
    whole_plan, less = plan_of(ground), plan_of(ground, leave_max_percent=3.0)
    assert whole_plan.coverage.reachable_percent >= 99.8
    assert less.coverage.reachable_percent >= 97.0
    assert len(less.lines) <= len(whole_plan.lines) - 2
    assert less.flight_s < whole_plan.flight_s


def test_overlap_asked_for_is_kept_where_ground_may_be_left() -> None:
    ground = made_up("quadrangle", 1000)
    plan = plan_of(ground, overlap_max_percent=5.0)
    assert sheet(plan)["overlap_litres_percent"] <= 5.0
    assert plan.coverage.reachable_percent > 95.0
    assert not overlap_warnings(plan, sheet(plan)["overlap_litres_percent"])


@pytest.mark.parametrize(("kind", "seed", "cap"), [("ditch", 1002, 5.0), ("bent ditch", 1000, 5.0)])
def test_overlap_asked_for_counts_lines_that_are_added_last(
    kind: str, seed: int, cap: float
) -> None:
    # A stroke across the end of the ditch: 5.7 and 5.1 % of the litres.
    plan = plan_of(made_up(kind, seed), overlap_max_percent=cap)
    assert sheet(plan)["overlap_litres_percent"] <= cap
    assert plan.settings.overlap_max_percent == cap


@pytest.mark.parametrize("number", [0, 3])
def test_overlap_asked_for_is_kept_by_valves_that_close(number: int) -> None:
    # What they save is known of a whole plan only: the first one has 2.6 and 1.7 %.
    plan = plan_of(
        made_up("L", 1000 + number), overlap_max_percent=1.0, valves=VALVES,
        switch_off_percent=100.0,
    )  # fmt: skip
    assert sheet(plan)["overlap_litres_percent"] <= 1.0
    assert plan.coverage.reachable_percent > 90.0


def test_overlap_above_what_was_asked_for_is_said_with_what_to_do() -> None:
    plan = plan_of(box(0.0, 0.0, 90.0, DITCH_M), overlap_max_percent=5.0, leave_max_percent=1.0)
    found = sheet(plan)["overlap_litres_percent"]
    assert plan.coverage.reachable_percent >= 99.0
    assert "the least found for this field" in overlap_warnings(plan, found)[0]
    assert "--leave-max" in overlap_warnings(plan, found)[0]
    assert "coverage.switch_off_percent" in overlap_warnings(plan, found)[0]


def test_one_valve_is_the_floor_of_overlap_on_a_ditch() -> None:
    ditch = box(0.0, 0.0, 90.0, DITCH_M)
    open_, closing = (
        plan_of(ditch, valves=VALVES, switch_off_percent=percent) for percent in (None, 100.0)
    )
    assert sheet(open_)["overlap_litres_percent"] == pytest.approx(36.7, abs=0.5)
    # Four valves of six are closed on the second pass; 0.4 m of 8 m fall twice.
    assert sheet(closing)["overlap_litres_percent"] == pytest.approx(5.0, abs=0.3)
    assert closing.volume_l == pytest.approx(8.0 * 90.0 * 20.0 / 1e4, rel=0.01)
    assert len(closing.lines) == len(open_.lines) == 2
    # What spares them is said where it is not taken, and where there is something to spare.
    hints = [twice_hint(each, sheet(each)["overlap_litres_percent"]) for each in (open_, closing)]
    assert "coverage.switch_off_percent = 100" in hints[0][0] and not hints[1]
    assert not twice_hint(open_, 4.9)
    # A boom that is one valve has its passes to choose.
    (hint,) = twice_hint(plan_of(ditch), 36.7)
    assert "--choices shows" in hint


@pytest.mark.parametrize(
    ("percent", "option", "is_closing"),
    [("", "", True), ('"never"', "", False), ("", "--sprayer", False), ("100", "", True)],
)
def test_a_plan_counts_on_valves_that_close_unless_they_never_do(
    percent: str,
    option: str,
    is_closing: bool,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    geometry = json.loads(shapely.to_geojson(degrees(box(0.0, 0.0, 90.0, DITCH_M))))
    path = tmp_path / "ditch.geojson"
    path.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": geometry}))
    config = tmp_path / "config.toml"
    text = Path("examples/anyang/config.toml").read_text()
    if percent:
        text += f"\n[coverage]\nswitch_off_percent = {percent}\n"
    config.write_text(text)
    words = ["--rate-l-ha", "20", "--config", str(config), "--out", str(tmp_path / "m.waypoints")]
    words += ["--border-m", "0.1", "--json", *filter(None, [option])]
    assert execute(["plan", "--force", str(path), *words]) == 0
    found = json.loads(capsys.readouterr().out)
    # 7.4 m of it are sprayed by booms of 6 m: 4.6 of 12 m twice, or 0.6 of 8 m.
    twice_m, flown_m = (0.6, 8.0) if is_closing else (4.6, 12.0)
    assert found["overlap_litres_percent"] == pytest.approx(100.0 * twice_m / flown_m, abs=0.6)
    assert found["volume_l"] == pytest.approx(flown_m * 0.1796, rel=0.01)


def test_no_pass_is_flown_for_a_sliver_along_the_border(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    # One of 38 m would add 0.2 m2 of 2,700.
    words = [
        "plan",
        "--force",
        "examples/anyang/boundary.geojson",
        "--out",
        str(tmp_path / "m.plan"),
    ]
    words += ["--config", "examples/anyang/config.toml", "--border-m", "0.3", "--json"]
    assert execute(words) == 0
    assert json.loads(capsys.readouterr().out)["swaths"] == 5


def test_packed_lines_overlap_in_one_place_alone() -> None:
    ground = box(0.0, 0.0, 100.0, 27.5)
    lines = open_lines(ground, WIDTH_M, 90.0, packed=True)
    assert measure(lines, ground, WIDTH_M).percent == pytest.approx(100.0, abs=0.05)
    gaps = np.diff(np.sort(lines[:, 1]))
    assert sorted(gaps.round(6)) == pytest.approx([3.5, 6.0, 6.0, 6.0])
    assert lengths_m(lines) == pytest.approx([100.0] * 5, abs=0.01)


@pytest.mark.parametrize("high_m", [24.1, 25.1, 26.5])
def test_no_two_packed_lines_are_taken_for_one(high_m: float) -> None:
    ground = box(0.0, 0.0, 100.0, high_m)
    lines = open_lines(ground, WIDTH_M, 90.0, packed=True)
    assert measure(lines, ground, WIDTH_M).percent == pytest.approx(100.0, abs=0.05)
    gaps = np.diff(np.sort(lines[:, 1]))
    assert len(gaps) == 4
    assert gaps.min() >= 2.0 - 1e-6


def test_the_course_that_is_asked_for_is_the_only_one_of_the_parallel_lines() -> None:
    plan = plan_of(made_up("quadrangle", 1001), angle_deg=30.0)
    assert plan.angle_deg == 30.0


def test_choices_are_printed_with_their_price(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    geometry = json.loads(shapely.to_geojson(degrees(made_up("quadrangle", 1000))))
    path = tmp_path / "field.geojson"
    path.write_text(json.dumps({"type": "Feature", "properties": {}, "geometry": geometry}))
    words = [
        "plan",
        "--force",
        str(path),
        "--out",
        str(tmp_path / "field.plan"),
        "--leave-max",
        "3",
        "--json",
    ]
    assert execute(words) == 0
    found = json.loads(capsys.readouterr().out)
    (price,) = found["prices"]
    assert price["option"] == "without --leave-max"
    assert price["swaths"] > found["swaths"]
    assert price["left_percent"] < 0.2 < 100.0 - found["reachable_percent"]


def test_lines_that_are_taken_and_dropped_are_counted_as_one_by_one() -> None:
    draw = random.Random(5)
    covers = np.random.default_rng(5).random((30, 333)) < 0.2
    state = _Set(
        covers=covers, each_m2=1.0, cost_s=[0.0] * len(covers),
        aim=Aim(left_max_m2=0.0, doubled_s_m2=1000.0),
    )  # fmt: skip
    taken: set[int] = set()
    for _ in range(400):
        line = draw.randrange(len(covers))
        if line in taken:
            state.drop(line)
        else:
            state.add(line)
        taken ^= {line}
        times = covers[sorted(taken)].sum(axis=0)
        bare, doubled = int((times == 0).sum()), int(np.maximum(times - 1, 0).sum())
        assert state.value_s() == pytest.approx(4.0 * bare + 1000.0 * doubled)
        bared = state._drawn(draw, [])
        assert (bared is None) == (bare == 0)
        if bared is not None:
            assert covers[bared][times == 0].any()


def test_chosen_lines_that_are_clearly_worse_are_not_gone_through_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gone_through: list[Tour] = []

    def counting(tour: Tour, *given: Any, **more: Any) -> Any:
        gone_through.append(tour)
        return worthwhile(tour, *given, **more)

    monkeypatch.setattr(layouts, "worthwhile", counting)
    ground = Polygon([(0.0, 0.0), (75.0, 9.0), (88.0, 66.0), (-6.0, 72.0)])
    best = plan_of(ground)
    every = len(gone_through)
    monkeypatch.setattr(layouts, "WORSE", 0.0)
    without = plan_of(ground)
    # The layouts' alone: none of the chosen ones, of which two were looked at.
    assert len(gone_through) - every < every
    assert best.flight_s <= without.flight_s
    assert without.coverage.reachable_percent >= 99.8
