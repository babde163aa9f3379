"""Plans: what is covered, where is flown, and how much is in the tank."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from shapely import Polygon, box

from companion.core.prescription import Prescription, Zone
from missions.corners import Motion
from missions.coverage import measure
from missions.demand import Rates, Uniform, cut, demands
from missions.errors import PlanError
from missions.field import Field, build_field
from missions.free_space import free_space
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.reading import MapRates
from missions.strips import lengths_m, rectangles
from missions.ways import build_ways, edge_places
from tests.bench.missions import FRAME, comb, outside_m2, to_degrees, transit_outside_m

pytestmark = pytest.mark.usefixtures("searched_briefly")

WIDTH_M = 6.0


def field_of(ground: Polygon, **more: object) -> Field:
    return build_field(to_degrees(ground), swath_width_m=WIDTH_M, frame=FRAME, **more)  # type: ignore[arg-type]


def plan_of(
    ground: Polygon, *, rates: Rates | None = None, depots: tuple[tuple[float, float], ...] = (),
    **changes: float,
) -> Plan:  # fmt: skip
    settings = Settings(
        swath_width_m=WIDTH_M,
        speed_m_s=6.0,
        reserve_l=0.0,
        **{"moves": 500, **changes},  # type: ignore[arg-type]
    )
    places = tuple(FRAME.to_geographic(*depot) for depot in depots)
    return plan_mission(field_of(ground), settings, rates or Uniform(rate_l_ha=20.0), depots=places)


def test_a_rectangle_is_covered_by_lines_that_fit_it() -> None:
    plan = plan_of(box(0.0, 0.0, 30.01, 200.0))
    assert len(plan.lines) == 5
    assert plan.coverage.percent > 99.9
    assert plan.coverage.overlap_percent < 0.1
    assert plan.angle_deg % 180.0 == pytest.approx(0.0, abs=0.2)


def test_the_comb_is_covered_and_nothing_outside() -> None:
    plan = plan_of(comb())
    assert plan.coverage.percent >= 99.9
    assert plan.coverage.outside_m2 == pytest.approx(0.0, abs=1e-6)
    assert outside_m2(plan, comb()) == pytest.approx(0.0, abs=1e-6)
    assert transit_outside_m(plan) == 0.0


def test_the_summary_adds_up() -> None:
    plan = plan_of(comb(), tank_l=20.0)
    found = plan.summary()
    sorties = found["sorties"]
    assert isinstance(sorties, list)
    for key in ("volume_l", "spray_m", "transit_m", "ferry_m", "total_m", "flight_s"):
        assert sum(each[key] for each in sorties) == pytest.approx(found[key])
    assert found["spray_m"] == pytest.approx(lengths_m(plan.lines).sum())


def test_no_sortie_takes_more_than_the_tank() -> None:
    plan = plan_of(comb(), tank_l=9.0)
    assert max(sortie.volume_l for sortie in plan.sorties) <= 9.0 + 1e-6
    needed_l = lengths_m(plan.lines).sum() * WIDTH_M / 10_000.0 * 20.0
    assert plan.volume_l == pytest.approx(needed_l)
    assert len(plan.sorties) >= math.ceil(needed_l / 9.0)


def test_the_reserve_stays_in_the_tank() -> None:
    field = field_of(box(0.0, 0.0, 100.0, 200.0))
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, tank_l=12.0, reserve_l=2.0, moves=0)
    plan = plan_mission(field, settings, Uniform(rate_l_ha=20.0))
    assert max(sortie.volume_l for sortie in plan.sorties) <= 10.0 + 1e-6


def test_the_demand_is_the_integral_of_the_map() -> None:
    west = Zone(name="w", polygon=box(0, 0, 50, 100), rate_l_ha=10.0)
    east = Zone(name="e", polygon=box(50, 0, 100, 100), rate_l_ha=30.0)
    line = np.array([[20.0, 50.0, 90.0, 50.0]])
    need = demands(line, Prescription([west, east]), width_m=6.0)[0]
    exact_l = (30.0 * 10.0 + 40.0 * 30.0) * 6.0 / 10_000.0
    assert need.total_l == pytest.approx(exact_l, rel=1e-9)
    pieces = cut(line, [need], piece_max_l=exact_l / 3.0)
    assert pieces.litres == pytest.approx([exact_l / 3.0] * 3)
    assert lengths_m(pieces.ends).sum() == pytest.approx(70.0)
    assert lengths_m(pieces.ends)[0] > lengths_m(pieces.ends)[-1]


def test_the_rates_of_many_places_are_those_of_the_prescription() -> None:
    zones = [
        Zone(name="w", polygon=box(0, 0, 60, 100), rate_l_ha=10.0),
        Zone(name="e", polygon=box(50, 0, 90, 100), rate_l_ha=30.0),
        Zone(name="hole", polygon=box(10, 10, 20, 20), rate_l_ha=0.0),
    ]
    draw = np.random.default_rng(1)
    east_m, north_m = draw.uniform(0.0, 100.0, 500), draw.uniform(0.0, 100.0, 500)
    for default in (None, 5.0):
        made = Prescription(
            zones, boundary=box(0, 0, 100, 100), overlap="max", default_rate_l_ha=default
        )
        found = MapRates(made).rates_at(east_m, north_m)
        assert found == pytest.approx(made.rates_at(east_m, north_m), nan_ok=True)
        assert len(np.unique(found[~np.isnan(found)])) == (2 if default is None else 3)


def test_every_valve_reads_the_rate_of_its_own_strip() -> None:
    zones = [
        Zone(name="s", polygon=box(0, 0, 100, 50), rate_l_ha=10.0),
        Zone(name="n", polygon=box(0, 50, 100, 100), rate_l_ha=40.0),
    ]
    line = np.array([[10.0, 50.0, 60.0, 50.0]])
    valves = ((-1.5, 3.0), (1.5, 3.0))
    need = demands(line, Prescription(zones), width_m=6.0, valves=valves)[0]
    assert need.total_l == pytest.approx(50.0 * (3.0 * 10.0 + 3.0 * 40.0) / 10_000.0)


def test_the_way_between_two_teeth_leads_around_the_gap() -> None:
    space = free_space(comb())
    way = space.way((150.0, 300.0), (260.0, 300.0))
    assert len(way) > 2
    assert shapely.LineString(way).difference(comb().buffer(1e-6)).length == pytest.approx(0.0)
    assert way[0] == (150.0, 300.0)
    assert way[-1] == (260.0, 300.0)


def test_a_field_that_an_obstacle_cuts_in_two_is_planned_whole() -> None:
    wall = to_degrees(box(90.0, -10.0, 110.0, 110.0))
    field = field_of(box(0.0, 0.0, 200.0, 100.0), obstacles=[wall], obstacle_buffer_m=1.0)
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0, moves=500)
    plan = plan_mission(field, settings, Uniform(rate_l_ha=20.0))
    assert plan.coverage.reachable_percent > 99.9
    for sortie in plan.sorties:
        for leg in sortie.legs:
            assert not shapely.LineString(leg.points).intersects(box(90.0, -10.0, 110.0, 110.0))


def test_no_spray_ground_is_flown_over_but_not_sprayed() -> None:
    garden = box(90.0, 40.0, 110.0, 60.0)
    field = field_of(
        box(0.0, 0.0, 200.0, 100.0), no_spray=[to_degrees(garden)], no_spray_buffer_m=3.0
    )
    plan = plan_mission(field, Settings(swath_width_m=6.0, speed_m_s=6.0), Uniform(rate_l_ha=9.0))
    covered = shapely.union_all(rectangles(plan.lines, WIDTH_M))
    assert covered.intersection(garden.buffer(2.99)).area == pytest.approx(0.0, abs=1e-6)
    assert plan.coverage.percent > 99.5


def test_a_depot_outside_is_reached_by_the_shortest_way_in() -> None:
    # No line begins less than 2 m from where it enters the field: that would be one waypoint.
    plan = plan_of(box(0.0, 0.0, 200.0, 100.0), depots=((-50.0, 54.0),))
    first = plan.sorties[0].legs[0]
    assert first.kind == "ferry"
    assert first.points[0] == pytest.approx((-50.0, 54.0), abs=1e-3)
    assert first.points[1] == pytest.approx((0.0, 54.0), abs=0.05)
    near = plan_of(box(0.0, 0.0, 200.0, 100.0), depots=((-50.0, 50.0),)).sorties[0].legs[0]
    assert near.points[1] == pytest.approx((0.0, 50.0), abs=0.06)
    assert len(near.points) == 2


def test_every_sortie_starts_at_the_depot_that_is_nearest() -> None:
    plan = plan_of(
        box(0.0, 0.0, 600.0, 100.0), tank_l=10.0, angle_deg=0.0,
        depots=((0.0, 50.0), (600.0, 50.0)),
    )  # fmt: skip
    assert {sortie.depot for sortie in plan.sorties} == {0, 1}


def test_the_same_field_gives_the_same_plan() -> None:
    one, two = plan_of(comb(), tank_l=9.0), plan_of(comb(), tank_l=9.0)
    assert one.sorties == two.sorties


def test_a_longer_search_is_no_worse() -> None:
    none, long = plan_of(comb(), tank_l=9.0, moves=0), plan_of(comb(), tank_l=9.0, moves=5_000)
    assert long.flight_s <= none.flight_s + 60.0 * (len(none.sorties) - len(long.sorties)) + 1e-6


def test_a_users_own_course_is_flown() -> None:
    plan = plan_of(box(0.0, 0.0, 100.0, 200.0), angle_deg=90.0)
    assert plan.angle_deg == 90.0
    along = plan.lines[:, 2:] - plan.lines[:, :2]
    assert (np.abs(along[:, 0]) > np.abs(along[:, 1])).mean() > 0.8


def test_a_leg_from_rest_to_rest() -> None:
    motion = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)
    assert motion.leg_s(14.4) == pytest.approx(2.0 * 6.0 / 2.5)
    assert motion.leg_s(7.0) == pytest.approx(3.3466, abs=1e-3)
    assert motion.leg_s(600.0) == pytest.approx(102.4)


def test_overlap_and_outside_are_measured() -> None:
    lines = np.array([[0.0, 3.0, 100.0, 3.0], [0.0, 6.0, 110.0, 6.0]])
    found = measure(lines, box(0.0, 0.0, 100.0, 12.0), 6.0)
    assert found.percent == pytest.approx(75.0)
    assert found.overlap_percent == pytest.approx(25.0)
    assert found.outside_m2 == pytest.approx(60.0)
    assert found.largest_skip_m2 == pytest.approx(300.0)


@pytest.mark.parametrize(
    ("ground", "tank_l", "says"),
    [
        (box(0, 0, 5, 100), 40.0, "nowhere as wide as the swath"),
        (box(0, 0, 100, 100), 0.1, "mission.tank_l"),
    ],
)
def test_what_cannot_be_planned_is_refused(ground: Polygon, tank_l: float, says: str) -> None:
    with pytest.raises(PlanError, match=says):
        plan_of(ground, tank_l=tank_l)


def test_a_depot_in_an_obstacle_is_refused() -> None:
    field = field_of(box(0, 0, 200, 100), obstacles=[to_degrees(box(90, 40, 110, 60))])
    settings = Settings(swath_width_m=6.0, speed_m_s=6.0)
    with pytest.raises(PlanError, match=r"depot 1 at 48\.\d+, 11\.\d+ lies in an obstacle"):
        plan_mission(
            field, settings, Uniform(rate_l_ha=9.0), depots=(FRAME.to_geographic(100.0, 50.0),)
        )


def test_a_depot_in_the_wrong_hemisphere_is_refused() -> None:
    field = field_of(box(0, 0, 200, 100))
    with pytest.raises(PlanError, match=r"depot 1 .*(km from the field|no place near)"):
        plan_mission(
            field, Settings(swath_width_m=6.0, speed_m_s=6.0), Uniform(rate_l_ha=9.0),
            depots=((-48.0, 11.0),),
        )  # fmt: skip


def test_a_map_of_nothing_but_zero_is_refused() -> None:
    with pytest.raises(PlanError, match="rate above zero"):
        plan_of(box(0, 0, 100, 100), rates=Uniform(rate_l_ha=0.0))


def test_the_suggested_depot_is_near_as_it_is_flown_around_a_bay() -> None:
    """Two arms of 800 m that only meet at their northern ends: from there, not from one of them."""
    ground = box(0.0, 0.0, 300.0, 860.0) - box(60.0, -1.0, 240.0, 800.0)
    field = field_of(ground)
    plan = plan_of(ground, tank_l=8.0)
    assert len(plan.sorties) > 4
    lines, litres = plan.lines, lengths_m(plan.lines)
    places = edge_places(field, step_m=20.0, count_max=200)
    home_m = build_ways(field, places).home_ways_m((lines[:, :2] + lines[:, 2:]) / 2.0) @ litres
    suggested = build_ways(field, np.array(plan.depots))
    found_m = suggested.home_ways_m((lines[:, :2] + lines[:, 2:]) / 2.0) @ litres
    assert float(found_m[0]) < 1.05 * home_m.min()
    assert home_m.max() > 1.5 * home_m.min()


def test_a_pilot_is_told_how_much_is_narrower_than_the_swath_and_where() -> None:
    broad, ditch = box(0.0, 0.0, 60.0, 60.0), box(60.0, 0.0, 260.0, 5.0)
    plan = plan_of(Polygon([(0, 0), (260, 0), (260, 5), (60, 5), (60, 60), (0, 60)]))
    (told,) = [text for text in plan.warnings if "narrower" in text]
    assert told.startswith("22 % of the field is narrower than the swath of 6 m")
    east_m, north_m = plan.coverage.largest_skip_at or (0.0, 0.0)
    assert ditch.buffer(1.0).contains(shapely.Point(east_m, north_m))
    assert "{:.6f}, {:.6f}".format(*FRAME.to_geographic(east_m, north_m)) in told
    assert not [text for text in plan_of(broad).warnings if "narrower" in text]
