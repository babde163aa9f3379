"""Depots that are suggested: chosen together, as many as pay, by times near to the planned."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from shapely import Polygon, box

from missions.demand import Uniform
from missions.depots import DepotChoice, exchanged, points_of
from missions.energy import Battery
from missions.free_space import free_space
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.strips import Floats, lengths_m
from tests.missions.test_missions_plan import FRAME, field_of

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

SETTINGS = Settings(
    swath_width_m=6.0, speed_m_s=6.0, reserve_l=1.0, tank_l=40.0, moves=400,
    battery=Battery(hover_w=3000.0, cruise_w=2600.0, per_kg_w=40.0, capacity_wh=1000.0),
)  # fmt: skip


def choice_of(ground: Polygon, lines: Floats, **changes: object) -> DepotChoice:
    """Return the choice of depots for lines that need 20 L/ha."""
    field = field_of(ground)
    return DepotChoice(
        field=field, lines=lines, litres=0.012 * lengths_m(lines), inside=free_space(field.fly),
        settings=replace(SETTINGS, **changes),  # type: ignore[arg-type]
    )  # fmt: skip


def passes(width_m: float, length_m: float) -> Floats:
    """Return passes to the north and back, side by side."""
    east = np.arange(3.0, width_m, 6.0)
    none = np.zeros(len(east))
    return np.stack([east, none, east, none + length_m], axis=1)


@pytest.mark.parametrize("seed", range(20))
def test_depots_are_the_best_ones_together(seed: int) -> None:
    random = np.random.default_rng(seed)
    places, points = random.random((18, 2)), random.random((60, 2))
    cost = np.hypot(*(places[:, None] - points).transpose(2, 0, 1)) ** 2
    chosen: list[int] = []
    for count in (1, 2, 3):
        chosen = exchanged(cost, chosen)
        assert len(set(chosen)) == count
        least = min(
            float(cost[list(some)].min(axis=0).sum()) for some in combinations(range(18), count)
        )
        assert float(cost[chosen].min(axis=0).sum()) < 1.05 * least


def test_two_depots_are_not_the_best_one_and_another() -> None:
    cost = np.array([[2.0, 2.0, 2.0, 2.0], [0.0, 1.0, 9.0, 9.0], [9.0, 9.0, 1.0, 0.0]])
    assert exchanged(cost, []) == [0]
    assert sorted(exchanged(cost, [0])) == [1, 2]


@pytest.mark.parametrize("count", [50, 75, 150, 300, 450, 900])
def test_the_points_of_lines_lie_on_both_sides_however_many_lines_there_are(count: int) -> None:
    """Each third or second line, always in its first third, once stood for all: 1.4 km aside."""
    lines = passes(6.0 * count, 900.0)
    points, _, _ = points_of(lines, lengths_m(lines))
    assert points[:, 1].mean() == pytest.approx(450.0, abs=25.0)
    assert points[:, 0].mean() == pytest.approx(3.0 * count, rel=0.02)
    assert np.histogram(points[:, 1], bins=3, range=(0.0, 900.0))[0].min() > len(points) / 4


def test_lines_without_litres_ask_for_no_depot() -> None:
    lines = passes(600.0, 300.0)
    litres = np.where(lines[:, 0] < 300.0, 0.0, 1.0)
    points, line, _ = points_of(lines, litres)
    assert points[:, 0].min() > 300.0
    assert litres[line].all()


def planned(ground: Polygon, *depots: tuple[float, float], **changes: object) -> Plan:
    settings = replace(SETTINGS, **changes)  # type: ignore[arg-type]
    return plan_mission(
        field_of(ground), settings, Uniform(rate_l_ha=20.0),
        depots=tuple(FRAME.to_geographic(*depot) for depot in depots),
    )  # fmt: skip


def minutes(plan: Plan) -> float:
    ground_s = sum(map(plan.airborne_s, plan.sorties))
    return (ground_s + len(plan.sorties) * plan.settings.refill_s) / 60.0


# An L with arms of 1.5 km, 60 ha.
ANGLE = box(0.0, 0.0, 200.0, 1500.0) | box(0.0, 0.0, 1500.0, 230.0)


def test_what_depots_are_compared_by_is_near_what_is_planned() -> None:
    """The estimate of the time, beside the plan from one, two and three depots."""
    plan = planned(ANGLE)
    choice = choice_of(ANGLE, plan.lines)
    for count in (1, 2, 3):
        places = choice.from_best(count).depots.tolist()
        found = minutes(planned(ANGLE, *[(x, y) for x, y in places]))
        assert found == pytest.approx(choice.seconds(count) / 60.0, rel=0.08), count


def test_a_depot_more_is_suggested_where_it_saves_an_hour_and_a_twentieth() -> None:
    near, far = box(0.0, 0.0, 600.0, 400.0), box(0.0, 0.0, 4000.0, 240.0)
    assert len(choice_of(near, passes(600.0, 400.0)).ways().depots) == 1
    choice = choice_of(far, passes(4000.0, 240.0), battery=None)
    count = len(choice.ways().depots)
    assert count == 2
    saved_s = [choice.seconds(each) - choice.seconds(each + 1) for each in (1, 2)]
    assert saved_s[0] > max(3600.0, choice.seconds(1) / 20.0)
    assert not saved_s[1] > max(3600.0, choice.seconds(2) / 20.0)
    assert len(choice.ways(3).depots) == 3


def test_a_share_of_several_aircraft_has_as_many_depots_as_its_battery_needs() -> None:
    """One of them was to fly 1.6 km from its only depot, and no plan was found."""
    plan = planned(
        box(0.0, 0.0, 48.0, 1600.0), aircraft=2, angle_deg=0.0, tank_l=20.0, aircraft_gap_m=10.0,
        battery=Battery(hover_w=4000.0, cruise_w=3500.0, per_kg_w=60.0, capacity_wh=300.0),
    )  # fmt: skip
    used = {(sortie.aircraft, sortie.depot) for sortie in plan.sorties}
    assert all(sum(each == aircraft for each, _ in used) > 1 for aircraft in (1, 2))
    assert {depot for _, depot in used} == set(range(len(plan.depots)))
    worst = max(plan.energy_wh(sortie) or math.nan for sortie in plan.sorties)
    assert worst <= 240.0
