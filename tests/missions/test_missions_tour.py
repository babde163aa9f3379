"""One tour for all lines, and which lines are worth their time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import Polygon, box

from missions.boom import Boom
from missions.corners import Motion
from missions.coverage import measure, reachable
from missions.demand import Pieces, Uniform
from missions.field import build_field
from missions.free_space import free_space
from missions.network import Network, build_network
from missions.plan import Settings
from missions.planner import plan_mission
from missions.strips import Floats, axes, joined, lengths_m, united
from missions.tour import by_savings, cost_s, shortest_tour
from missions.worth import meeting, tour_of, worthwhile
from tests.bench.missions import FRAME, comb, to_degrees

MOTION = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)
WIDTH_M = 7.0
BOOM = Boom(width_m=WIDTH_M)


def network_of(lines: Floats) -> Network:
    """Return the network of lines on open ground, from a depot at the origin."""
    count = len(lines)
    pieces = Pieces(ends=lines, litres=np.zeros(count), line=np.arange(count))
    ends = lines.reshape(-1, 2)
    ground = box(-1000.0, -1000.0, 1000.0, 1000.0)
    return build_network(pieces, free_space(ground), MOTION, home_m=np.hypot(*ends.T)[None, :])


@given(
    rows=st.lists(
        st.tuples(st.floats(-300, 300), st.floats(-300, 300), st.floats(0, 360)),
        min_size=3, max_size=12,
    ),
    seed=st.integers(0, 5),
)  # fmt: skip
def test_a_tour_flies_every_piece_once_and_is_no_longer(
    rows: list[tuple[float, float, float]], seed: int
) -> None:
    lines = np.array([[x, y, *(np.array([x, y]) + 40.0 * axes(turn)[0])] for x, y, turn in rows])
    network = network_of(lines)
    (first,) = by_savings(network, 1.0)
    found = shortest_tour(network, first, kicks=20, seed=seed)
    assert sorted(enter >> 1 for enter in found) == list(range(len(lines)))
    assert cost_s(network, [found]) <= cost_s(network, [first]) + 1e-6


def test_a_comb_of_passes_is_flown_to_and_fro() -> None:
    lines = np.array([[x, 0.0, x, 90.0] for x in np.arange(8.0) * 7.0])
    network = network_of(lines)
    order = shortest_tour(network, list(range(0, 16, 2)), kicks=100)
    ways_s = cost_s(network, [order])
    turns_s = 7.0 * MOTION.between_passes_s(7.0)
    assert ways_s == pytest.approx(turns_s + MOTION.leg_s(49.0), abs=1.0)


def test_no_line_is_lost_where_there_are_too_many_for_every_pair() -> None:
    field = build_field(to_degrees(box(0, 0, 640, 30)), swath_width_m=3.0, frame=FRAME)
    plan = plan_mission(
        field,
        Settings(swath_width_m=3.0, speed_m_s=5.0, tank_l=900.0, moves=0, angle_deg=0.0),
        Uniform(rate_l_ha=20.0),
    )
    assert len(plan.lines) > 210
    assert sum(sortie.lines for sortie in plan.sorties) == len(plan.lines)
    assert plan.length_m("spray") == pytest.approx(float(lengths_m(plan.lines).sum()))


def test_a_line_for_a_sliver_beside_a_hole_is_left_out() -> None:
    ground = box(0.0, 0.0, 210.0, 300.0)
    whole = np.array([[x, 0.0, x, 300.0] for x in np.arange(30.0) * 7.0 + 3.5])
    more = np.array([[104.0, 100.0, 104.0, 140.0]])
    tour = tour_of(joined([whole, more]), free_space(ground), MOTION)
    left = worthwhile(tour, reachable(ground, WIDTH_M), BOOM)
    assert lengths_m(left) == pytest.approx([300.0] * 30)


def test_what_is_left_out_stays_below_a_thousandth() -> None:
    ground = comb()
    plan = plan_mission(
        build_field(to_degrees(ground), swath_width_m=WIDTH_M, frame=FRAME),
        Settings(swath_width_m=WIDTH_M, speed_m_s=6.0, tank_l=1e4),
        Uniform(rate_l_ha=20.0),
    )
    assert plan.coverage.percent > 99.9
    assert plan.coverage.outside_m2 == 0.0
    legs = plan.sorties[0].legs[1:-1]
    # The grid of others takes 36.47 minutes and sprays the holes.
    assert sum(leg.seconds for leg in legs) / 60.0 < 1.04 * 36.47


def test_ends_that_others_cover_are_cut_off_and_borders_that_go_on_are_not() -> None:
    ground = Polygon([(0, 0), (100, 0), (100, 14), (0, 14)])
    lines = np.array([[0.0, 3.5, 100.0, 3.5], [0.0, 10.5, 100.0, 10.5], [96.5, 0.0, 96.5, 14.0]])
    left = worthwhile(tour_of(lines, free_space(ground), MOTION), ground, BOOM)
    assert measure(left, ground, WIDTH_M).percent == pytest.approx(100.0)
    assert len(left) == 2


@pytest.mark.parametrize("past_m", [1.0, -2.0])
def test_passes_around_an_obstacle_meet_in_their_corner(past_m: float) -> None:
    # Flown to their ends, which lie past the corner, the aircraft would turn back between them.
    motion = Settings(swath_width_m=WIDTH_M, speed_m_s=6.0).motion
    along, corner = np.array([math.cos(0.4), math.sin(0.4)]), np.array([60.0, 60.0])
    lines = np.array(
        [
            [10.0, 60.0, 60.0 + past_m, 60.0],
            [*(corner - past_m * along), *(corner + 40.0 * along)],
        ]
    )
    ground = box(0.0, 0.0, 150.0, 150.0)
    tour = tour_of(lines, free_space(ground), motion)
    target = united(lines, WIDTH_M).difference(box(40.0, 40.0, 80.0, 80.0))
    met = meeting(tour, target, ground, BOOM, left_share=0.0, overlap_s_m2=0.01)
    assert met.lines[0, 2:] == pytest.approx(corner) and met.lines[1, :2] == pytest.approx(corner)
    assert met.seconds < tour.seconds - 1.0
    # What only they cover past the corner is not left out; short of it nothing is.
    needed = meeting(tour, united(lines, WIDTH_M), ground, BOOM, left_share=0.0, overlap_s_m2=0.01)
    assert (needed is tour) == (past_m > 0.0)


def test_ways_from_short_passes_and_around_corners_are_priced_as_they_are_flown() -> None:
    # The search took 0.3 s for each of these: plans with trees were 3 % longer for it.
    motion = Settings(swath_width_m=WIDTH_M, speed_m_s=6.0).motion
    lines = np.array([[0.0, 0.0, 4.0, 0.0], [0.0, 12.0, 4.0, 12.0]])
    for gap, between_s in ((box(1.0, 5.0, 8.0, 6.0), 5.8), (box(20.0, 5.0, 21.0, 6.0), 2.6)):
        space = free_space(box(-40.0, -40.0, 60.0, 60.0).difference(gap))
        tour = tour_of(lines, space, motion)
        assert tour.network.between_s[1, 3] == pytest.approx(between_s, abs=0.3)


def test_passes_keep_from_the_border_where_that_leaves_room() -> None:
    wide = to_degrees(box(0.0, 0.0, 60.0, 200.0))
    kept = build_field(wide, swath_width_m=WIDTH_M, frame=FRAME, kept_m=0.3)
    assert kept.spray.bounds == pytest.approx((0.3, 0.3, 59.7, 199.7), abs=0.02)
    assert kept.area_m2 == pytest.approx(12_000.0, rel=1e-3)
    narrow = to_degrees(box(0.0, 0.0, 7.1, 200.0))
    near = build_field(narrow, swath_width_m=WIDTH_M, frame=FRAME, kept_m=0.3)
    assert near.spray.bounds[0] == pytest.approx(0.0, abs=0.02)
