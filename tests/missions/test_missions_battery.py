"""Batteries: what a sortie draws, and where it ends because of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import Polygon, box

from companion.config.tables import MissionTable
from missions.demand import Uniform
from missions.energy import Battery, Vertical
from missions.errors import PlanError
from missions.plan import Leg, Plan, Settings, Sortie, sortie_wh
from missions.planner import plan_mission
from missions.reading_fleet import battery_of
from missions.ways import build_ways
from tests.missions.test_missions_plan import field_of, plan_of

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

DRAWN = Battery(hover_w=4000.0, cruise_w=3500.0, per_kg_w=60.0)


def with_battery(capacity_wh: float | None, **changes: float) -> Plan:
    settings = Settings(
        swath_width_m=6.0, speed_m_s=6.0, reserve_l=0.0,
        battery=replace(DRAWN, capacity_wh=capacity_wh),
        **{"moves": 800, "tank_l": 20.0, **changes},  # type: ignore[arg-type]
    )  # fmt: skip
    return plan_mission(field_of(box(0.0, 0.0, 200.0, 300.0)), settings, Uniform(rate_l_ha=20.0))


def drawn_wh(plan: Plan) -> list[float]:
    return [plan.energy_wh(sortie) or math.nan for sortie in plan.sorties]


def test_a_sortie_draws_power_for_its_time_and_its_load() -> None:
    line = Leg(kind="spray", points=((0.0, 0.0), (0.0, 600.0)), speed_m_s=6.0, seconds=102.4,
               volume_l=10.0)  # fmt: skip
    sortie = Sortie(number=1, depot=0, legs=(line,))
    vertical = Vertical(
        ready_s=1.0, climb_m_s=2.5, rise_m_s=2.5, descent_m_s=1.5, acceleration_m_s2=1e9,
        settled_s=0.5, return_height_m=10.0, loiter_s=3.0, slow_m=2.0, land_m_s=0.5, down_s=1.5,
    )  # fmt: skip
    found = sortie_wh(
        sortie, DRAWN, vertical=vertical, height_m=5.0, reserve_l=2.0, nose_turn_s=4.0
    )
    joules = 100.0 * 3500.0 + 2.4 * 4000.0 + 102.4 * 60.0 * 7.0  # along the line: 7 L on average
    joules += (1.0 + 2.0) * (4000.0 + 60.0 * 12.0)
    back_s = 0.5 + 5.0 / 2.5 + 3.0 + 8.0 / 1.5 + 2.0 / 0.5 + 1.5
    joules += back_s * (4000.0 + 60.0 * 2.0)
    joules += 4.0 * (4000.0 + 60.0 * 7.0)
    assert found == pytest.approx(joules / 3600.0)


def test_no_sortie_draws_more_than_the_battery_has_above_its_reserve() -> None:
    whole = with_battery(None)
    small = with_battery(300.0)
    assert max(drawn_wh(whole)) > 240.0
    assert max(drawn_wh(small)) <= 240.0
    assert len(small.sorties) > len(whole.sorties)
    assert small.volume_l == pytest.approx(whole.volume_l)
    assert small.length_m("spray") == pytest.approx(whole.length_m("spray"))


def test_a_battery_that_lasts_changes_nothing() -> None:
    assert with_battery(None).sorties == plan_of(
        box(0.0, 0.0, 200.0, 300.0), moves=800, tank_l=20.0
    ).sorties  # fmt: skip
    large = with_battery(100_000.0)
    assert [each.legs for each in large.sorties] == [
        each.legs for each in with_battery(None).sorties
    ]


def test_one_tank_is_cut_inside_a_line_where_the_battery_ends() -> None:
    plan = with_battery(230.0, tank_l=40.0)
    ends = {leg.points[-1] for sortie in plan.sorties for leg in sortie.legs if leg.kind == "spray"}
    inside = [north_m for _, north_m in ends if 20.0 < north_m < 280.0]
    assert inside
    assert max(drawn_wh(plan)) <= 184.0


def test_turning_the_nose_takes_time_and_energy_unless_the_aircraft_strafes() -> None:
    quick, slow = with_battery(None), with_battery(None, nose_rate_deg_s=30.0)
    sortie = slow.sorties[0]
    assert slow.airborne_s(sortie) > quick.airborne_s(quick.sorties[0]) + 180.0 / 30.0
    assert drawn_wh(slow)[0] > drawn_wh(quick)[0]
    strafing = replace(slow, settings=replace(slow.settings, turn="strafe"))
    assert strafing.nose_s(sortie) == 0.0


def test_a_fresh_battery_is_put_in_only_where_the_old_one_does_not_last() -> None:
    none, some, each = with_battery(10_000.0), with_battery(900.0), with_battery(300.0)
    assert not any(sortie.swaps for sortie in none.sorties)
    assert len({sortie.swaps for sortie in some.sorties[1:]}) == 2
    left_wh = 720.0
    for sortie, used_wh in zip(some.sorties, drawn_wh(some), strict=True):
        assert sortie.swaps == (used_wh > left_wh)
        left_wh = (720.0 if sortie.swaps else left_wh) - used_wh
    assert all(sortie.swaps for sortie in each.sorties[1:])
    later = [b.start_s - (a.start_s + each.airborne_s(a))
             for a, b in zip(each.sorties, each.sorties[1:], strict=False)]  # fmt: skip
    assert later == pytest.approx([120.0] * len(later))


def test_a_battery_that_does_not_reach_the_field_is_refused_with_the_place() -> None:
    with pytest.raises(PlanError, match=r"48\.\d+, 11\.\d+ is \d+ m .* mission\.battery_wh"):
        with_battery(20.0)


@pytest.mark.parametrize("missing", [{"battery_wh": 500.0}, {"power_cruise_w": 500.0}])
def test_a_battery_needs_the_power(missing: dict[str, float]) -> None:
    table = MissionTable.model_validate({"swath_width_m": 6.0, "speed_m_s": 6.0} | missing)
    with pytest.raises(PlanError, match="power_hover_w is missing"):
        battery_of(table)


def test_without_a_power_in_cruise_that_of_hovering_holds() -> None:
    table = MissionTable.model_validate(
        {"swath_width_m": 6.0, "speed_m_s": 6.0, "power_hover_w": 3000.0}
    )
    assert battery_of(table) == Battery(hover_w=3000.0, cruise_w=3000.0)


@given(
    seconds=st.floats(0.0, 1e4), cruise=st.floats(0.0, 1.0), litres=st.floats(0.0, 100.0),
    more=st.floats(0.0, 50.0),
)  # fmt: skip
def test_more_load_never_draws_less(
    seconds: float, cruise: float, litres: float, more: float
) -> None:
    split = {"cruise_s": seconds * cruise, "other_s": seconds * (1.0 - cruise)}
    assert DRAWN.wh(**split, litres=litres) <= DRAWN.wh(**split, litres=litres + more)


# A bay in the middle of the southern edge.
BAY = Polygon(
    [(0.0, 0.0), (250.0, 0.0), (250.0, 300.0), (350.0, 300.0), (350.0, 0.0), (600.0, 0.0),
     (600.0, 400.0), (0.0, 400.0)]
)  # fmt: skip


def test_the_way_to_a_depot_outside_is_as_long_as_it_is_drawn() -> None:
    field = field_of(BAY)
    depots = np.array([[300.0, 100.0], [-80.0, 200.0], [300.0, 450.0], [0.0, 0.0], [260.0, -40.0]])
    ways = build_ways(field, depots)
    ends = np.array([[20.0, 10.0], [240.0, 150.0], [360.0, 20.0], [590.0, 390.0], [300.0, 350.0]])
    drawn = [[ways.home(depot, (x, y)) for x, y in ends.tolist()] for depot in range(len(depots))]
    drawn_m = [[sum(map(math.dist, way, way[1:])) for way in row] for row in drawn]
    assert ways.home_ways_m(ends) == pytest.approx(np.array(drawn_m), abs=0.01)
    assert not ways.are_straight


def test_where_the_battery_does_not_reach_everything_more_depots_are_suggested() -> None:
    settings = Settings(
        swath_width_m=6.0, speed_m_s=6.0, reserve_l=0.0, tank_l=20.0, moves=400,
        battery=replace(DRAWN, capacity_wh=300.0),
    )  # fmt: skip
    field = field_of(box(0.0, 0.0, 24.0, 1600.0))
    plan = plan_mission(field, settings, Uniform(rate_l_ha=20.0))
    assert len(plan.depots) > 1
    assert plan.suggested_depot
    assert max(drawn_wh(plan)) <= 240.0
    one = (field.frame.to_geographic(*plan.depots[0]),)
    with pytest.raises(PlanError, match=r"from the nearest depot .* as often as needed"):
        plan_mission(field, settings, Uniform(rate_l_ha=20.0), depots=one)
