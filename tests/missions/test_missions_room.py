"""Sorties that fit into the autopilot's memory, and what is said of far depots."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from shapely import box

from missions.demand import Uniform
from missions.errors import PlanError
from missions.field import build_field
from missions.files.items import ITEMS_MAX, count_of, items_of, stops_of
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.sheet import sheet, sortie_lines
from tests.bench.missions import FRAME, to_degrees

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")


def planned(*, tank_l: float = 400.0, depot_m: tuple[float, float] | None = None) -> Plan:
    field = build_field(to_degrees(box(0, 0, 120, 240)), swath_width_m=6.0, frame=FRAME)
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, tank_l=tank_l, moves=500)
    depots = () if depot_m is None else (FRAME.to_geographic(*depot_m),)
    return plan_mission(field, settings, Uniform(rate_l_ha=20.0), depots=depots)


def test_a_sortie_with_more_items_than_room_is_flown_as_several(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = planned()
    assert [len(items_of(whole, each)) for each in whole.sorties] == [43]
    monkeypatch.setitem(ITEMS_MAX, "ardupilot", 20)
    cut = planned()
    assert len(cut.sorties) > 2
    for number, each in enumerate(cut.sorties, start=1):
        assert each.number == number
        assert len(items_of(cut, each)) <= 20
        ends = (each.legs[0].points[0], each.legs[-1].points[-1])
        assert all(math.dist(place, cut.depots[each.depot]) < 0.01 for place in ends)
        for before, after in pairwise(each.legs):
            assert math.dist(before.points[-1], after.points[0]) < 0.01
    assert cut.volume_l == pytest.approx(whole.volume_l)
    assert cut.length_m("spray") == pytest.approx(whole.length_m("spray"))
    rows = sheet(cut)
    assert rows["items_max"] == 20
    assert "the autopilot holds 20" in sortie_lines(cut, rows)[0]


def test_one_line_with_more_items_than_room_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ITEMS_MAX, "ardupilot", 4)
    with pytest.raises(PlanError, match="alone has more items than the 4"):
        planned()


@pytest.mark.parametrize("with_sprayer", [False, True])
def test_items_are_counted_as_they_are_written(with_sprayer: bool) -> None:
    plan = planned(tank_l=40.0)
    for each in plan.sorties:
        home = plan.depots[each.depot]
        stops = stops_of(each, plan.settings, None, home=home, with_sprayer=with_sprayer)
        count = count_of(stops, plan.settings, with_sprayer=with_sprayer)
        assert count == len(items_of(plan, each, with_sprayer=with_sprayer))


def test_a_depot_far_from_the_field_is_said_with_what_it_costs() -> None:
    near = planned(tank_l=40.0, depot_m=(0.0, -400.0))
    assert not near.warnings
    far = planned(tank_l=40.0, depot_m=(0.0, -11_000.0))
    assert "depot 1 lies 11.0 km from the field" in far.warnings[0]
    # 11 km at 6 m/s there and back, and from line to line.
    assert " 62 min of each of its 2 sorties" in far.warnings[0]
    assert "mission.battery_wh" in far.warnings[0]
