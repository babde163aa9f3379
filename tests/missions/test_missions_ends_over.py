"""Ends of the boom beyond the border, where valves close: less falls twice, nothing outside."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from shapely import LineString, Polygon, box

from companion.cli.app import execute
from missions.boom import INSIDE_M, Boom, boom_of, side_by_side
from missions.demand import Uniform
from missions.field import Field, build_field
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.sheet import sheet
from tests.bench.small_fields import VALVES
from tests.mission_fields import degrees
from tests.small_fields import DITCH_M, made_up

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

WIDTH_M = 6.0
PLACES = np.array(VALVES)


def field_of(ground: Polygon) -> Field:
    return build_field(degrees(ground), swath_width_m=WIDTH_M)  # type: ignore[arg-type]


def plan_of(field: Field, **changes: Any) -> Plan:
    given: dict[str, Any] = {"valves": VALVES, "border_buffer_m": 0.0, "ends_over": True} | changes
    settings = Settings(swath_width_m=WIDTH_M, speed_m_s=6.0, **given)
    return plan_mission(field, settings, Uniform(rate_l_ha=20.0))


def passes(plan: Plan) -> list[LineString]:
    return [LineString(line.reshape(2, 2)) for line in plan.lines]


def test_strips_are_those_of_the_valves_that_lie_inside() -> None:
    ground = box(0.0, 0.0, 50.0, 30.0)
    boom = Boom(width_m=WIDTH_M, places=PLACES, ground=ground)
    # To the east 1.4 m inside the north border: its outer valve is open to 0.4 m, and not 1.4 m.
    lines = np.array([[5.0, 28.6, 40.0, 28.6], [5.0, 10.0, 40.0, 10.0]])
    over, inside = boom.strips(lines)
    assert over.equals(box(5.0, 25.6, 40.0, 29.6)) or over.symmetric_difference(
        box(5.0, 25.6, 40.0, 29.6)
    ).area == pytest.approx(0.0, abs=1e-3)
    assert inside.area == pytest.approx(35.0 * 6.0)


def test_each_valve_closes_where_its_own_strip_leaves_the_ground() -> None:
    ground = Polygon([(0, 0), (60, 0), (40, 20), (0, 20)])
    boom = Boom(width_m=WIDTH_M, places=PLACES, ground=ground)
    (strip,) = boom.strips(np.array([[10.0, 10.0, 50.0, 10.0]]))
    assert strip.difference(ground.buffer(0.002)).area == pytest.approx(0.0, abs=1e-6)
    # Six steps of a metre along the slanted border: the valve on the far side goes on longest.
    assert strip.bounds[2] == pytest.approx(50.0, abs=0.01)
    assert strip.area == pytest.approx(6.0 * 40.0 - (1.0 + 2.0 + 3.0), abs=0.1)


@pytest.mark.parametrize("across_m", [7.6, 9.0, 13.0, 27.5, 29.9, 35.2])
def test_what_is_too_much_for_whole_swaths_lies_beyond_both_borders(across_m: float) -> None:
    boom = Boom(width_m=WIDTH_M, places=PLACES, ground=box(0.0, 0.0, 1.0, 1.0))
    middles = np.array(side_by_side(0.0, across_m, boom))
    assert middles.min() >= 1.0 and middles.max() <= across_m - 1.0
    assert middles.max() + 3.0 >= across_m - 1e-9 and middles.min() <= 3.0
    twice_m = float((WIDTH_M - np.diff(middles)).sum())
    spare_m = len(middles) * WIDTH_M - across_m
    assert twice_m == pytest.approx(spare_m - min(int(spare_m + 0.01), 4), abs=1e-6)


def test_a_ditch_has_one_valve_of_overlap_without_knowing_treated_ground() -> None:
    field = field_of(box(0.0, 0.0, 90.0, DITCH_M))
    plan = plan_of(field)
    assert len(plan.lines) == 2
    assert plan.coverage.reachable_percent >= 99.8
    assert plan.coverage.outside_m2 == 0.0
    # 4 m each: 0.4 m of 8 m fall twice; with whole booms 4.4 m of 12 m.
    assert sheet(plan)["overlap_litres_percent"] == pytest.approx(5.0, abs=0.3)
    assert plan.volume_l == pytest.approx(8.0 * 90.0 * 20.0 / 1e4, rel=0.01)


@pytest.mark.parametrize(("kind", "seed"), [("L", 1002), ("triangle", 1001)])
def test_nothing_is_sprayed_outside_and_the_aircraft_stays_inside(kind: str, seed: int) -> None:
    field = field_of(made_up(kind, seed))
    plan, other = plan_of(field), plan_of(field, ends_over=False)
    assert plan.coverage.reachable_percent >= 99.8
    assert plan.coverage.outside_m2 == 0.0
    twice, before = (sheet(each)["overlap_litres_percent"] for each in (plan, other))
    assert twice < before - 2.0
    assert plan.flight_s < 1.02 * other.flight_s
    # A pass ends at the border, as those of whole booms do; beside it there is room.
    beside = [each.buffer(INSIDE_M - 0.01, cap_style="flat") for each in passes(plan)]
    assert all(field.outline.covers(each) for each in beside)
    assert any(
        not field.outline.covers(each.buffer(WIDTH_M / 2.0, cap_style="flat"))
        for each in passes(plan)
    )


def test_what_whole_booms_would_spray_off_the_field_is_said() -> None:
    field = field_of(box(0.0, 0.0, 90.0, DITCH_M))
    # Two metres on both sides.
    (warning,) = plan_of(field).warnings
    assert "2 lines" in warning and "360 m2" in warning and "companion" in warning
    assert not plan_of(field, ends_over=False).warnings


def test_no_end_is_beyond_a_border_at_which_no_valve_closes() -> None:
    field = field_of(box(0.0, 0.0, 90.0, 20.5))
    # The companion's map goes on behind the northern border, where nobody asked for spraying.
    open_ = replace(field, closes=field.outline.buffer(8.0, join_style="mitre"))
    plan = plan_of(open_)
    strips = [each.buffer(WIDTH_M / 2.0, cap_style="flat") for each in passes(plan)]
    assert shapely.union_all(strips).difference(field.limit).area < 0.05
    closing = plan_of(replace(field, closes=field.limit))
    assert sheet(closing)["overlap_litres_percent"] < sheet(plan)["overlap_litres_percent"]


def test_its_price_is_offered_where_valves_close_at_the_border(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    anyang = Path("examples/anyang")
    words = ["plan", "--force", str(anyang / "boundary.geojson"),
             "--config", str(anyang / "config.toml"),
             "--border-m", "0.3", "--json", "--choices",
             "--out", str(tmp_path / "m.plan")]  # fmt: skip
    assert execute(words) == 0
    (price,) = [
        each
        for each in json.loads(capsys.readouterr().out)["prices"]
        if each["option"] == "with --ends-over"
    ]
    assert price["overlap_litres_percent"] < 10.0


def test_large_fields_keep_whole_booms() -> None:
    plan = plan_of(field_of(box(0.0, 0.0, 200.0, 81.0)))
    assert not plan.settings.ends_over
    assert not boom_of(plan.settings, plan.field).closes


def test_settings_want_valves_that_close_at_the_border() -> None:
    with pytest.raises(ValueError, match="need valves that close"):
        Settings(swath_width_m=6.0, speed_m_s=6.0, valves=VALVES, ends_over=True)


def test_without_a_configuration_it_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "field.geojson"
    path.write_text(shapely.to_geojson(degrees(box(0.0, 0.0, 90.0, DITCH_M))))
    words = ["plan", "--force", str(path), "--out", str(tmp_path / "m.plan"), "--ends-over"]
    assert execute(words) == 2
    assert 'border = "inside"' in capsys.readouterr().err
    assert execute([*words, "--sprayer"]) == 2
    assert "--sprayer" in capsys.readouterr().err


def test_ends_over_the_border_of_the_configured_map(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    anyang = Path("examples/anyang")
    words = ["plan", "--force", str(anyang / "boundary.geojson"),
             "--config", str(anyang / "config.toml"),
             "--prescription", str(anyang / "prescription.shp"), "--border-m", "0.3", "--json",
             "--png", str(tmp_path / "m.svg")]  # fmt: skip
    found = []
    for more in ([], ["--ends-over"]):
        assert execute([*words, "--out", str(tmp_path / "m.plan"), *more]) == 0
        found.append(json.loads(capsys.readouterr().out))
    whole, over = found
    assert over["outside_m2"] == 0.0
    assert over["reachable_percent"] > whole["reachable_percent"] - 0.2
    assert over["overlap_litres_percent"] < whole["overlap_litres_percent"]
    assert over["volume_l"] < whole["volume_l"]


def test_one_sortie_has_its_longer_ferry_behind_its_last_line() -> None:
    # Of an odd number of passes the last one ends far from where the first one begins: the way
    # back from there is flown with closed valves, and no ferry leads along the first line, where
    # the aircraft would have to turn back.
    for length_m, across_m in ((120.0, 18.0), (100.0, 29.0), (120.0, 28.0)):
        field = field_of(box(0.0, 0.0, length_m, across_m))
        settings = Settings(swath_width_m=WIDTH_M, speed_m_s=6.0)
        (sortie,) = plan_mission(field, settings, Uniform(rate_l_ha=20.0)).sorties
        assert sortie.legs[0].length_m < 30.0 < 90.0 < sortie.legs[-1].length_m
