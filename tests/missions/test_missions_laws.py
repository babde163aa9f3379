"""Laws of planning on any field: all is covered, nothing leaves, turning it changes nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon
from shapely.affinity import rotate

from missions.corners import Motion
from missions.coverage import patches, reachable
from missions.demand import Uniform, cut, demands
from missions.field import build_field
from missions.free_space import free_space
from missions.layouts import spray_lines
from missions.network import build_network
from missions.open_lines import needed_passes, open_lines
from missions.plan import Settings
from missions.planner import plan_mission
from missions.search import improve
from missions.sorties import Flying, SortieSearch
from missions.spacing import Spacing
from missions.stops import near_pairs, waypoints_of
from missions.strips import (
    border_passes,
    inner_ground,
    inner_lines,
    joined,
    lengths_m,
    reach_inside,
    rectangles,
    united,
)
from missions.tour import by_savings, cost_s
from missions.ways import build_ways
from tests.bench.missions import FRAME, random_field, to_degrees
from tests.mission_fields import blob

pytestmark = pytest.mark.usefixtures("searched_briefly")

WIDTH_M = 7.0
MOTION = Motion(speed_m_s=6.0, acceleration_m_s2=2.5)
SETTINGS = Settings(swath_width_m=WIDTH_M, speed_m_s=6.0, moves=0)
# Of pairs of waypoints that are too near so many may stay, where there is no room.
NEAR_LEFT = 0.1
seeds = st.integers(min_value=0, max_value=5_000)
angles = st.floats(min_value=0.0, max_value=180.0)


def ground_of(seed: int) -> shapely.Polygon | shapely.MultiPolygon:
    """Return a random field that a strip fits on."""
    for number in range(seed, seed + 20):
        ground = random_field(number)[1]
        if not ground.buffer(-WIDTH_M / 2.0 - 0.01).is_empty:
            return ground
    raise AssertionError("no field is wide enough")


@given(seed=seeds, angle_deg=angles)
@settings(max_examples=15)
def test_passes_and_inner_lines_cover_and_stay_inside(seed: int, angle_deg: float) -> None:
    ground = ground_of(seed)
    inner = inner_ground(ground, WIDTH_M)
    lines = joined([border_passes(ground, WIDTH_M), inner_lines(inner, WIDTH_M, angle_deg)])
    covered = united(lines, WIDTH_M)
    assert covered.difference(ground.buffer(1e-4)).area == pytest.approx(0.0, abs=1e-9)
    assert inner.difference(covered).area <= 2e-4 * ground.area + 0.2


@pytest.mark.parametrize("angle_deg", [0.0, 37.0])
def test_a_clipping_that_loses_ground_is_not_believed(
    angle_deg: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = inner_ground(ground_of(3), WIDTH_M)
    by_clipping = inner_lines(inner, WIDTH_M, angle_deg)
    monkeypatch.setattr(shapely, "clip_by_rect", lambda *_: shapely.Polygon())
    assert np.allclose(inner_lines(inner, WIDTH_M, angle_deg), by_clipping, atol=1e-6)


@given(seed=seeds, angle_deg=angles)
@settings(max_examples=15)
def test_lines_from_border_to_border_cover_and_stay_inside(seed: int, angle_deg: float) -> None:
    ground = ground_of(seed)
    straight = open_lines(ground, WIDTH_M, angle_deg)
    passes = border_passes(ground, WIDTH_M)
    lines = joined([straight, needed_passes(straight, passes, ground, WIDTH_M)])
    lines = joined([lines, patches(lines, ground, WIDTH_M)])
    covered = united(lines, WIDTH_M)
    assert covered.difference(ground.buffer(2.1e-3)).area == pytest.approx(0.0, abs=1e-9)
    target = reachable(ground, WIDTH_M)
    assert covered.intersection(target).area >= 0.999 * target.area


@given(angle_deg=angles, wide_m=st.floats(15.0, 80.0), long_m=st.floats(60.0, 300.0))
@settings(max_examples=10)
def test_a_turned_field_has_a_turned_plan(angle_deg: float, wide_m: float, long_m: float) -> None:
    shape = Polygon([(0, 0), (wide_m, 0.0), (wide_m * 1.3, long_m), (0, long_m * 0.9)])
    figures = []
    for turned in (shape, rotate(shape, angle_deg, origin=(0.0, 0.0))):
        field = build_field(to_degrees(turned), swath_width_m=WIDTH_M, frame=FRAME)
        chosen = Settings(swath_width_m=WIDTH_M, speed_m_s=6.0, moves=0)
        plan = plan_mission(field, chosen, Uniform(rate_l_ha=9.0))
        figures.append((plan.coverage.percent, lengths_m(plan.lines).sum(), plan.angle_deg))
    assert figures[0][0] == pytest.approx(figures[1][0], abs=0.1)
    # The coarse search stands on other courses, so that the same field may find a better one.
    assert figures[0][1] == pytest.approx(figures[1][1], rel=0.05)


@given(seed=seeds, tank_l=st.floats(2.0, 30.0))
@settings(max_examples=12)
def test_every_piece_is_flown_once_and_no_tank_runs_dry(seed: int, tank_l: float) -> None:
    ground = ground_of(seed)
    passes = border_passes(ground, WIDTH_M)
    lines = joined([passes, inner_lines(inner_ground(ground, WIDTH_M), WIDTH_M, 30.0)])[:60]
    pieces = cut(lines, demands(lines, Uniform(rate_l_ha=20.0), width_m=WIDTH_M), piece_max_l=1.0)
    assert lengths_m(pieces.ends).sum() == pytest.approx(lengths_m(lines).sum())
    assert pieces.litres.max() <= 1.0 + 1e-9
    home_m = np.hypot(*(pieces.ends.reshape(-1, 2) - lines[0, :2]).T)[None, :]
    network = build_network(pieces, free_space(ground), MOTION, home_m=home_m, refill_s=120.0)
    first = by_savings(network, tank_l)
    better = improve(network, first, tank_l, moves=800)
    for orders in (first, better):
        assert sorted(enter >> 1 for order in orders for enter in order) == list(range(len(pieces)))
        loads = [sum(pieces.litres[enter >> 1] for enter in order) for order in orders]
        assert max(loads) <= tank_l + 1e-6
    assert cost_s(network, better) <= cost_s(network, first) + 1e-6


@given(seed=seeds)
@settings(max_examples=12)
def test_a_way_stays_in_the_free_space_and_is_no_shorter_than_the_line(seed: int) -> None:
    ground = ground_of(seed)
    parts = sorted(shapely.get_parts(ground), key=lambda part: -part.area)
    inside = parts[0].buffer(-0.5)
    if inside.is_empty:
        return
    points = shapely.get_coordinates(max(shapely.get_parts(inside), key=lambda p: p.area).exterior)
    start, end = tuple(points[0].tolist()), tuple(points[len(points) // 2].tolist())
    way = free_space(ground).way(start, end)
    assert way
    line = shapely.LineString(way)
    assert line.difference(ground.buffer(1e-3)).length == pytest.approx(0.0, abs=1e-6)
    assert line.length >= math.dist(start, end) - 1e-6


@given(
    x=st.floats(-1e4, 1e4), y=st.floats(-1e4, 1e4), course=st.floats(0.0, 6.28),
    length_m=st.floats(0.5, 2000.0), width_m=st.floats(0.5, 30.0),
)  # fmt: skip
def test_a_strip_is_as_long_and_wide_as_its_line_says(
    x: float, y: float, course: float, length_m: float, width_m: float
) -> None:
    row = [x, y, x + length_m * math.cos(course), y + length_m * math.sin(course)]
    strip = rectangles(np.array([row]), width_m)[0]
    assert strip.area == pytest.approx(length_m * width_m, rel=1e-6)


@given(seed=seeds)
@settings(max_examples=10)
def test_waypoints_are_apart_and_lines_end_where_they_end(seed: int) -> None:
    field = build_field(to_degrees(ground_of(seed)), swath_width_m=WIDTH_M, frame=FRAME)
    lines = spray_lines(field, SETTINGS, MOTION)[0]
    ways = build_ways(field, lines[:1, :2])
    needs = demands(lines, Uniform(rate_l_ha=9.0), width_m=WIDTH_M)
    search = SortieSearch(
        lines=lines, demand=needs, ways=ways, settings=SETTINGS, flying=Flying(motion=MOTION)
    )
    given_ones = search.in_one() or search.several()[1]
    found_ones = Spacing(ways=ways, settings=SETTINGS).spaced(given_ones)
    for one, found in zip(given_ones, found_ones, strict=True):
        before, after = (len(near_pairs(waypoints_of(each))) for each in (one, found))
        assert after <= before * NEAR_LEFT
        for leg, given_leg in zip(found.legs, one.legs, strict=True):
            if leg.kind == "spray":
                assert leg == given_leg
            assert (leg.points[0], leg.points[-1]) == (given_leg.points[0], given_leg.points[-1])
            if leg.points != given_leg.points and leg.kind == "transit":
                assert ways.inside.space.covers(shapely.LineString(leg.points))


def test_a_strip_reaches_as_far_as_what_of_it_leaves_the_ground() -> None:
    draw = np.random.default_rng(1)
    field = blob(3.0, seed=1).simplify(1.0)
    trees = [shapely.Point(place).buffer(4.0) for place in draw.uniform(-60.0, 60.0, (12, 2))]
    ground = field.difference(shapely.union_all(trees))
    places = draw.uniform(-90.0, 90.0, (400, 2))
    starts = places[shapely.contains_xy(ground.buffer(-3.1), places)]
    course = draw.uniform(0.0, 2.0 * math.pi, len(starts))
    along = np.column_stack([np.cos(course), np.sin(course)])
    wanted_m = draw.uniform(1.0, 120.0, len(starts))
    ends = starts + along * wanted_m[:, None]
    beyond = shapely.difference(
        shapely.buffer(
            shapely.linestrings(np.stack([starts, ends], axis=1)), 3.0, cap_style="flat"
        ),
        ground,
    )
    expected_m = [
        min([most, *((shapely.get_coordinates(each) - start) @ way).tolist()])
        for each, start, way, most in zip(beyond, starts, along, wanted_m.tolist(), strict=True)
    ]
    found_m = reach_inside(starts, along, wanted_m, ground, 6.0)
    assert len(starts) > 100
    assert np.count_nonzero(found_m < wanted_m) > 50
    np.testing.assert_allclose(found_m, expected_m, atol=1e-3)
