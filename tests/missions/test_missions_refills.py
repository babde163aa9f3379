"""Sorties for many tanks: never worse than home when empty, each within its tank and battery."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import LineString, box
from shapely.affinity import rotate

from missions.corners import Motion
from missions.demand import Uniform, demands
from missions.energy import Battery
from missions.field import build_field
from missions.files.write import lines_text
from missions.free_space import free_space
from missions.passes import Part, Passes, Times
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.refill_search import merged, regrouped
from missions.refills import Limits, flown_by, plainly, split
from missions.sheet import sheet
from missions.strips import Floats
from tests.bench.large_fields import compared, depots_of
from tests.mission_fields import degrees
from tests.mission_judge import Drawn
from tests.naive_sorties import Flight, Pass, figures, least_idle_m, legs_of, naive
from tests.naive_sorties import passes_of as passes_in

pytestmark = pytest.mark.usefixtures("searched_briefly", "laid_out_once")

MOTION = Motion(speed_m_s=6.0, acceleration_m_s2=2.5, jerk_m_s3=1.0, corners="ardupilot")
WIDTH_M, RATE_L_HA = 6.0, 20.0
LANDING_S = 100.0


def field_of(area_ha: float) -> Drawn:
    """Return a rectangle of so much ground, askew."""
    side_m = math.sqrt(area_ha * 1e4)
    return Drawn(
        outline=degrees(rotate(box(0.0, 0.0, 1.25 * side_m, side_m / 1.25), 20.0)),
        width_m=WIDTH_M,
    )


@pytest.mark.parametrize("where", ["middle", "corner"])
@pytest.mark.parametrize(("tank_l", "flight_s"), [(8.0, None), (15.0, None), (40.0, 400.0)])
def test_no_plan_is_worse_than_flying_home_when_empty(
    where: str, tank_l: float, flight_s: float | None
) -> None:
    drawn = field_of(14.0)
    found = compared(drawn, depots_of(drawn)[where], tank_l=tank_l, flight_s=flight_s, moves=1_500)
    # Flying home when empty makes stripes of the ground; blocks may take a little longer.
    assert found["ratio"] <= 1.005
    assert found["most_l"] <= tank_l + 1e-5
    assert found["idle_km"] >= found["least_idle_km"]
    assert found["spray_km"] == pytest.approx(found["naive_spray_km"], rel=1e-6)


def passes_of(lines: Floats) -> Passes:
    need = demands(lines, Uniform(rate_l_ha=RATE_L_HA), width_m=WIDTH_M)
    return Passes(
        lines=lines, demand=need, times=Times(MOTION), depots=[(0.0, 0.0)],
        pace_s_m=[1.0 / 6.0] * len(lines), speed_m_s=6.0,
        space=free_space(box(-3000.0, -3000.0, 3000.0, 3000.0)),
    )  # fmt: skip


def limits_of(tank_l: float, wh: float | None = None) -> Limits:
    battery = None if wh is None else Battery(hover_w=3000.0, cruise_w=2600.0, per_kg_w=40.0)
    return Limits(
        usable_l=tank_l, reserve_l=1.0, landing_s=LANDING_S, upright_s=40.0,
        battery=battery, usable_wh=math.inf if wh is None else wh,
    )  # fmt: skip


def serpentine(count: int, length_m: float, east_m: float) -> tuple[Passes, list[Part]]:
    lines = np.array(
        [[east_m + number * WIDTH_M, 10.0, east_m + number * WIDTH_M, 10.0 + length_m]
         for number in range(count)]
    )  # fmt: skip
    passes = passes_of(lines)
    run = [
        (number, 0.0, length_m) if number % 2 == 0 else (number, length_m, 0.0)
        for number in range(count)
    ]
    return passes, run


def seconds_of(passes: Passes, limits: Limits, sorties: list[list[Part]]) -> float:
    return sum(flown_by(passes, limits, sortie).seconds for sortie in sorties)


runs = st.tuples(st.integers(2, 9), st.floats(60.0, 900.0), st.floats(-400.0, 400.0))


@settings(max_examples=25)
@given(shape=runs, tank_l=st.floats(0.9, 12.0), wh=st.none() | st.floats(600.0, 1200.0))
def test_sorties_fly_everything_once_and_are_never_worse_than_plain_ones(
    shape: tuple[int, float, float], tank_l: float, wh: float | None
) -> None:
    passes, run = serpentine(*shape)
    limits = limits_of(tank_l, wh)
    plain, found = plainly(passes, limits, run), split(passes, limits, run)
    assert plain is not None and found is not None
    seconds, sorties = found
    better = regrouped(passes, limits, sorties, (0.0, 1.0), trials=10)
    for some in (plain, sorties, better):
        flown = [flown_by(passes, limits, sortie) for sortie in some]
        assert max(each.litres for each in flown) <= tank_l + 1e-6
        assert max(each.wh for each in flown) <= (wh or math.inf) + 1e-6
        assert merged([part for sortie in some for part in sortie]) == [
            (number, pytest.approx(0.0, abs=1e-6), pytest.approx(shape[1], abs=1e-6))
            for number in range(shape[0])
        ]
    assert seconds == pytest.approx(seconds_of(passes, limits, sorties), abs=0.01)
    assert seconds_of(passes, limits, better) <= seconds + 0.01


class Strips:
    """A rate that changes from strip to strip, and none in some."""

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        return np.array([8.0, 0.0, 30.0, 14.0])[(north_m // 90.0).astype(int) % 4]


@settings(max_examples=25)
@given(shape=runs, tank_l=st.floats(0.9, 12.0), wh=st.none() | st.floats(600.0, 1200.0))
def test_what_is_counted_at_once_is_what_each_sortie_takes(
    shape: tuple[int, float, float], tank_l: float, wh: float | None
) -> None:
    """Rates that change, ways around a lake, ways home that are known from place to place."""
    count, length_m, east_m = shape
    lines = np.array(
        [[east_m + number * WIDTH_M, 10.0, east_m + number * WIDTH_M, 10.0 + length_m]
         for number in range(count)]
    )  # fmt: skip
    lake = box(east_m + 5.0, 12.0 + length_m, east_m + count * WIDTH_M - 8.0, 60.0 + length_m)
    passes = Passes(
        lines=lines, demand=demands(lines, Strips(), width_m=WIDTH_M), times=Times(MOTION),
        depots=[(0.0, 0.0), (100.0, 400.0)], pace_s_m=[1.0 / 6.0 + 0.01 * n for n in range(count)],
        speed_m_s=6.0, space=free_space(box(-3000.0, -3000.0, 3000.0, 3000.0) - lake),
    )  # fmt: skip
    passes.bent_m[count - 1] = [
        [length_m, 1.5 * length_m, 2.0 * length_m], [1.8 * length_m, 1.6 * length_m, length_m],
    ]  # fmt: skip
    passes.bent_m[0] = [[300.0, 200.0], [500.0, 90.0]]
    run = [(n, 0.0, length_m) if n % 3 else (n, length_m, 0.0) for n in range(count)]
    limits = limits_of(tank_l, wh)
    found = split(passes, limits, run)
    assert found is not None
    flown = [flown_by(passes, limits, sortie) for sortie in found[1]]
    assert found[0] == pytest.approx(sum(each.seconds for each in flown), abs=0.01)
    assert max(each.litres for each in flown) <= tank_l + 1e-6
    assert max(each.wh for each in flown) <= (wh or math.inf) + 1e-3


def test_a_sortie_lands_where_it_took_off() -> None:
    """Along one line from depot to depot: the other end is near the other depot, and of no use."""
    lines = np.array([[0.0, 10.0, 0.0, 1010.0]])
    passes = passes_of(lines)
    passes.depots = [(0.0, 0.0), (0.0, 1020.0)]
    limits = limits_of(40.0)
    found = flown_by(passes, limits, [(0, 0.0, 1000.0)])
    ferries_s = MOTION.legs_s(np.array([10.0, 1010.0])).sum()
    spraying_s = float(MOTION.legs_s(np.array([1000.0]))[0])
    assert found.seconds == pytest.approx(LANDING_S + ferries_s + spraying_s, abs=0.5)


def test_a_tank_of_two_passes_is_empty_where_it_began() -> None:
    """Out on one pass and back on the next: only the ways across are ferries."""
    passes, run = serpentine(8, 800.0, 0.0)
    tank_l = 1600.0 * WIDTH_M * RATE_L_HA / 1e4
    found = split(passes, limits_of(tank_l), run)
    assert found is not None
    assert [len(sortie) for sortie in found[1]] == [2, 2, 2, 2]
    for sortie in found[1]:
        assert sortie[0][1] == 0.0
        assert sortie[-1][2] == 0.0


def test_sorties_out_and_back_are_found_where_passes_are_longer_than_a_tank() -> None:
    passes, run = serpentine(12, 1600.0, 0.0)
    tank_l = 1600.0 * WIDTH_M * RATE_L_HA / 1e4
    limits = limits_of(tank_l)
    plain = plainly(passes, limits, run)
    assert plain is not None
    found = regrouped(passes, limits, plain, (0.0, 1.0), trials=1500)
    saved_s = seconds_of(passes, limits, plain) - seconds_of(passes, limits, found)
    # Of every tank's two ferries, 1,600 m on average, a quarter is flown spraying.
    assert saved_s > 12 * 0.15 * 1600.0 / 6.0


def test_the_bound_is_below_what_any_sorties_fly() -> None:
    """Sorties straight out and back meet it, but for the ways across."""
    passes = [
        Pass(start=(number * WIDTH_M, 0.0), end=(number * WIDTH_M, 1200.0), litres=14.4)
        for number in range(-20, 20)
    ]
    flown = [
        passes[number] if number % 2 == 0 else Pass(
            start=passes[number].end, end=passes[number].start, litres=14.4
        )
        for number in range(40)
    ]  # fmt: skip
    for tank_l in (5.0, 10.0, 20.0, 28.8):
        least_m = least_idle_m(passes, [(0.0, 0.0)], usable_l=tank_l)
        found = figures(
            naive(flown, (0.0, 0.0), Flight(), usable_l=tank_l), Flight(), refill_s=60.0
        )
        assert least_m <= found.idle_km * 1e3
    out_and_back = sum(math.dist((0.0, 0.0), each.start) for each in passes) + 20 * WIDTH_M
    assert 0.8 * out_and_back < least_m <= out_and_back


def test_ferries_go_around_where_a_depot_does_not_see_a_pass() -> None:
    """A slit between two halves: what flies across it is no neighbour."""
    drawn = Drawn(
        outline=degrees(
            box(0.0, 0.0, 600.0, 500.0).difference(box(295.0, 60.0, 305.0, 500.0))
        ),
        width_m=WIDTH_M,
    )  # fmt: skip
    plan = planned(drawn, depots_of(drawn)["corner"], tank_l=8.0)
    free = plan.field.fly.buffer(0.01)
    for sortie in plan.sorties:
        for leg in sortie.legs:
            assert len(leg.points) < 2 or free.covers(LineString(leg.points))


def planned(drawn: Drawn, depot: tuple[float, float], **changes: Any) -> Plan:
    field = build_field(drawn.outline, swath_width_m=drawn.width_m)
    given = Settings(
        swath_width_m=drawn.width_m, speed_m_s=6.0, reserve_l=0.0, moves=4_000, **changes
    )
    return plan_mission(field, given, Uniform(rate_l_ha=RATE_L_HA), depots=(depot,))


def test_the_bound_beside_a_plan_is_that_of_the_judge() -> None:
    drawn = field_of(12.0)
    where = depots_of(drawn)["corner"]
    plan = planned(drawn, where, tank_l=6.0)
    said_m = sheet(plan)["least_idle_m"]
    legs = legs_of(drawn, json.loads(lines_text(plan)))
    passes = [each for sortie in legs.values() for each in passes_in(sortie)]
    ((x, y),) = drawn.plane.metres(np.array([[where[1], where[0]]]))
    home = (float(x), float(y))
    assert said_m == pytest.approx(least_idle_m(passes, [home], usable_l=6.0), rel=0.01)
    assert 0.0 < said_m <= plan.length_m("ferry") + plan.length_m("transit")


def test_the_same_seed_gives_the_same_sorties() -> None:
    drawn = field_of(12.0)
    depot = depots_of(drawn)["middle"]
    first, second = (lines_text(planned(drawn, depot, tank_l=6.0)) for _ in range(2))
    assert json.loads(first) == json.loads(second)
