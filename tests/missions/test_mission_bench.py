"""What judges planned missions: flights by waypoints, made-up parcels, peers."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely

from tests.bench.outlines import CRITERIA, RESERVE_L, failed, on_board_l
from tests.bench.parcels import KINDS, parcel
from tests.bench.peers import PEERS, lines_of, tanks
from tests.mission_fields import degrees
from tests.mission_flight import Way, flown_s, items_of_plan, items_of_waypoints, legs_s
from tests.mission_judge import Drawn, judge_legs
from tests.missions.test_missions_times import FLOWN


@pytest.mark.parametrize("name", FLOWN)
def test_the_judges_flight_takes_as_long_as_arducopters(name: str) -> None:
    places, speed_m_s, arducopter_s = FLOWN[name]
    # The last leg counts as the return: one more leads far away, and is taken off again.
    away = np.array([*places, (places[-1][0] + 500.0, places[-1][1])])

    def takes_s(way: np.ndarray) -> float:
        return flown_s(Way(places=way, speeds_m_s=np.full(len(way) - 1, speed_m_s)))

    home = np.array([(0.0, 0.0), *away])
    whole_s = takes_s(home) - takes_s(away[-2:])
    # The first waypoint is reached midway through its corner.
    to_it_s = takes_s(home[:2])
    spared_s = to_it_s + takes_s(home[1:]) - takes_s(home)
    assert whole_s - to_it_s + spared_s / 2.0 == pytest.approx(arducopter_s, rel=0.03)


def test_a_way_without_corners_takes_its_length_over_its_speed_and_no_less() -> None:
    way = Way(places=np.array([(0.0, 0.0), (600.0, 0.0), (0.0, 0.0)]), speeds_m_s=np.full(2, 6.0))
    # To 6 m/s with 2.5 m/s2 and 1 m/s3: 2.4 s, 2.5 s and 0.3 s; as long to a halt.
    assert flown_s(way) == pytest.approx(2.0 * (100.0 + 5.2), abs=0.05)


def test_items_are_the_same_in_both_files() -> None:
    plan = {
        "mission": {
            "items": [
                {"command": 22, "params": [0, 0, 0, None, 48.0, 11.0, 3.5]},
                {"command": 178, "params": [1, 6.0, -1, 0, 0, 0, 0]},
                {"command": 16, "params": [0, 0, 0, None, 48.001, 11.0, 3.5]},
            ]
        }
    }
    rows = [
        "QGC WPL 110",
        "0\t1\t0\t16\t0\t0\t0\t0\t48.0\t11.0\t0\t1",
        "1\t0\t3\t22\t0\t0\t0\t0\t48.0\t11.0\t3.5\t1",
        "2\t0\t2\t178\t1\t6.0\t-1\t0\t0\t0\t0\t1",
        "3\t0\t3\t16\t0\t0\t0\t0\t48.001\t11.0\t3.5\t1",
    ]
    assert items_of_waypoints("\n".join(rows) + "\n") == items_of_plan(plan)


def test_passes_side_by_side_are_judged_as_sprayed_once() -> None:
    # A plain union of these leaves four of sixty passes out (GEOS 3.13).
    along, across = np.array([np.cos(0.37), np.sin(0.37)]), np.array([-np.sin(0.37), np.cos(0.37)])
    starts = [number * 6.0 * across for number in range(60)]
    legs = [("spray", np.array([start, start + 500.0 * along])) for start in starts]
    drawn = Drawn(outline=degrees(shapely.box(0.0, 0.0, 600.0, 500.0)), width_m=6.0)
    found = judge_legs(drawn, legs, speed_m_s=6.0, a_m_s2=2.5)
    assert found["twice_percent"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_makes_one_parcel_that_a_boom_fits_on(kind: str) -> None:
    for seed in range(1, 16):
        made, again = parcel(kind, seed), parcel(kind, seed)
        assert shapely.equals(made.outline, again.outline)
        drawn = Drawn(outline=made.outline, obstacles=made.obstacles)
        assert made.outline.is_valid
        assert drawn.reachable.area > 0.0
        assert bool(made.obstacles) <= (kind == "obstacles")


def test_a_recorded_parcel_has_a_point_every_one_to_three_metres() -> None:
    for seed in range(1, 8):
        made = parcel("recorded", seed)
        ring = Drawn(outline=made.outline).plane.area(made.outline).exterior
        steps = np.hypot(*np.diff(shapely.get_coordinates(ring), axis=0).T)
        assert 0.9 < np.median(steps) < 3.1


@pytest.mark.parametrize("peer", PEERS)
def test_peers_cover_a_rectangle(peer: str) -> None:
    ground = shapely.box(0.0, 0.0, 120.0, 60.0)
    covered = shapely.union_all(
        [shapely.LineString(row.reshape(2, 2)).buffer(3.0, cap_style="flat")
         for row in lines_of(peer, ground, 6.0)]
    )  # fmt: skip
    missed = ground.difference(covered)
    # Where two passes of a headland meet, a corner is left.
    assert missed.area < (40.0 if peer == "headland" else 1e-6)
    assert covered.difference(ground.buffer(0.01)).area < 1e-6


def test_a_tank_is_emptied_and_its_line_gone_on_with_where_it_was() -> None:
    lines = np.array([(0.0, 0.0, 100.0, 0.0), (100.0, 6.0, 0.0, 6.0)])
    home = np.array([0.0, -10.0])
    sorties = tanks(lines, home, tank_m=80.0, range_s=1e6, speed_m_s=6.0, stop_s=3.0)
    assert [len(each) for each in sorties] == [1, 2, 1]
    flown = np.vstack(sorties)
    assert np.hypot(*(flown[:, 2:] - flown[:, :2]).T).sum() == pytest.approx(200.0)
    assert sorties[1][0][:2].tolist() == sorties[0][0][2:].tolist()
    # With time for 60 m out and back, no line is flown farther.
    short = tanks(lines[:1], home, tank_m=1e6, range_s=30.0, speed_m_s=6.0, stop_s=3.0)
    assert len(short) > 1
    assert np.vstack(short)[-1][2:].tolist() == [100.0, 0.0]


def test_what_is_missed_is_what_a_strip_could_have_reached() -> None:
    drawn = Drawn(outline=shapely.box(11.0, 48.0, 11.001, 48.001))
    west, south, east, north = drawn.plane.area(drawn.outline).bounds
    legs = [("spray", np.array([(west + 3.0, south), (west + 3.0, north)]))]
    found = judge_legs(drawn, legs, speed_m_s=6.0, a_m_s2=2.5)
    assert found["missed_m2"] == pytest.approx((east - west - 6.0) * (north - south), rel=0.01)


def test_every_criterion_can_fail() -> None:
    good = {
        "reachable_percent": 99.9, "off_m2": 0.0, "transit_outside_m": 0.0,
        "worst_time_percent": 1.0, "battery_percent": 90.0, "tank_percent": 100.0, "fence": [],
        "items": 40, "near": 0, "cpu_s": 1.0, "area_ha": 2.0, "peak_mb": 90.0,
    }  # fmt: skip
    assert failed(good) == []
    bad = {
        "reachable_percent": 99.7, "off_m2": 1.0, "transit_outside_m": 1.0,
        "worst_time_percent": -6.0, "battery_percent": 101.0, "tank_percent": 101.0,
        "fence": ["2 items outside of it"], "items": 700, "near": 1, "cpu_s": 6.0, "peak_mb": 301.0,
    }  # fmt: skip
    assert {failed(good | {key: value})[0] for key, value in bad.items()} == set(CRITERIA)
    assert failed({"no answer": "", "cpu_s": 120.0}) == ["no answer"]


def sortie_of(
    places_m: list[tuple[float, float]], litres: list[float]
) -> tuple[dict[str, Any], Way]:
    """Return the legs of a sortie as a plan's file has them, and its way at 6 m/s."""
    metre_deg = 1.0 / 111_320.0
    rows = [[east * metre_deg, north * metre_deg] for east, north in places_m]
    legs = [
        {
            "geometry": {"type": "LineString", "coordinates": [one, other]},
            "properties": {"sortie": 1, "volume_l": volume_l},
        }
        for (one, other), volume_l in zip(pairwise(rows), litres, strict=True)
    ]
    places = np.array(places_m, dtype=np.float64)
    return {"features": legs}, Way(places=places, speeds_m_s=np.full(len(places) - 1, 6.0))


def test_a_load_counts_for_the_time_for_which_it_is_on_board() -> None:
    # Far out with all of it, then short passes that empty the tank, and far back.
    short = [(600.0 + 6.0 * (n // 2 % 2), 6.0 * (n // 2 + n % 2)) for n in range(40)]
    plan, way = sortie_of([(0.0, 0.0), *short, (0.0, 0.0)], [0.0, *[1.0] * 39, 0.0])
    seconds, left_l, carried = legs_s(way), 39.0 + RESERVE_L, 0.0
    for taken_s, used_l in zip(seconds, [0.0, *[1.0] * 39, 0.0], strict=True):
        carried += taken_s * (left_l - used_l / 2.0)
        left_l -= used_l
    assert seconds.sum() == pytest.approx(flown_s(way))
    assert on_board_l(plan, 1, 39.0, way) == pytest.approx(carried / seconds.sum(), rel=1e-3)


def test_a_tank_that_empties_evenly_is_half_full_on_the_whole() -> None:
    plan, way = sortie_of([(0.0, 0.0), (500.0, 0.0)], [39.0])
    assert on_board_l(plan, 1, 39.0, way) == pytest.approx(39.0 / 2.0 + RESERVE_L)
