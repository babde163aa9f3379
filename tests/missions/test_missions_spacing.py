"""Waypoints that are far enough apart, whatever the lines and obstacles between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from shapely import LineString, Point, box

from missions.boom import Boom
from missions.demand import Uniform
from missions.field import build_field
from missions.paced import Paced
from missions.plan import Leg, Place, Plan, Settings, Sortie
from missions.planner import plan_mission
from missions.spacing import Spacing
from missions.stops import NEAR_M, near_pairs, near_warnings, timed, waypoints_of
from missions.strips import rectangles
from missions.ways import build_ways
from missions.worth import Crowded, without_stubs
from tests.bench.missions import FRAME, to_degrees
from tests.mission_fields import trees
from tests.mission_flight import Way, flown_s

pytestmark = pytest.mark.usefixtures("searched_briefly")

SETTINGS = Settings(swath_width_m=6.0, speed_m_s=6.0, moves=500)
Line = tuple[Place, Place]


def sortie_of(*lines: Line, corners: tuple[Place, ...] = ()) -> Sortie:
    """Return a sortie over some lines; the first way between two has these corners."""
    home = (0.0, 0.0)
    legs = [Leg(kind="ferry", points=(home, lines[0][0]), speed_m_s=6.0)]
    for number, (before, after) in enumerate(pairwise(lines)):
        bends = () if number else corners
        legs.append(Leg(kind="spray", points=before, speed_m_s=6.0))
        legs.append(Leg(kind="transit", points=(before[1], *bends, after[0]), speed_m_s=6.0))
    legs.append(Leg(kind="spray", points=lines[-1], speed_m_s=6.0))
    legs.append(Leg(kind="ferry", points=(lines[-1][1], home), speed_m_s=6.0))
    return Sortie(number=1, depot=0, legs=tuple(legs))


def spacing_of(
    ground: shapely.Geometry, *, settings: Settings = SETTINGS, apart: bool = False
) -> Spacing:
    field = build_field(
        to_degrees(ground), swath_width_m=min(6.0, settings.swath_width_m), frame=FRAME,
        over_holes=True,
    )  # fmt: skip
    return Spacing(
        ways=build_ways(field, np.array([[0.0, 0.0]])), settings=settings, apart=apart
    )  # fmt: skip


def checked(spacing: Spacing, sortie: Sortie) -> Sortie:
    """Return the sortie spaced, after a look at what may not change."""
    (found,) = spacing.spaced([sortie])
    assert [leg for leg in found.legs if leg.kind == "spray"] == [
        leg for leg in sortie.legs if leg.kind == "spray"
    ]
    for leg, given in zip(found.legs, sortie.legs, strict=True):
        assert (leg.points[0], leg.points[-1]) == (given.points[0], given.points[-1])
        if leg.kind == "transit":
            assert spacing.ways.inside.space.covers(LineString(leg.points))
    return found


FIELD = box(-20.0, -20.0, 120.0, 120.0)


@pytest.mark.parametrize(
    "following",
    [
        # The two lines meet beyond their ends, before, or beyond one of them only.
        ((41.2, 11.2), (42.0, 40.0)),
        ((39.4, 9.4), (60.0, -15.0)),
        ((40.0, 11.5), (70.0, 30.0)),
        ((39.5, 8.6), (60.0, 18.0)),
        # Back beside it, and on beside it.
        ((39.0, 11.2), (10.0, 11.6)),
        ((41.2, 11.0), (90.0, 11.5)),
    ],
)
def test_ends_of_two_lines_that_are_near_are_flown_as_waypoints_apart(following: Line) -> None:
    sortie = sortie_of(((0.0, 10.0), (40.0, 10.0)), following)
    assert near_pairs(waypoints_of(sortie))
    found = checked(spacing_of(FIELD), sortie)
    stops = waypoints_of(found)
    assert not near_pairs(stops)
    # Both lines are flown from end to end, but for what two ends that are one waypoint lie aside.
    way = LineString([stop.place for stop in stops])
    for line in (sortie.legs[1], sortie.legs[3]):
        assert max(way.distance(shapely.Point(place)) for place in line.points) < 0.3


@pytest.mark.parametrize(
    "ends",
    [
        # Beside trees of the bench: which end is passed aside there depends on the whole row.
        [(-2.57, 2.82, -0.61, 0.99), (-0.59, 0.87, 0, 0), (0.42, -0.94, 0.73, -2.12),
         (-3.25, 0.41, 19.85, 8.87)],
        [(4.26, -1.41, 1.51, -0.74), (0.99, -0.52, 0, 0), (-2.27, 2.49, -2.82, 3.68),
         (-5.43, 1.93, -15, 1.9)],
        [(-4.29, 0.34, -1.47, 0.34), (-1.47, 0.28, 0, 0), (1.08, -0.44, 2.57, -1.41),
         (9.46, 10.35, 10.41, 7.5)],
    ],
)  # fmt: skip
def test_rows_of_short_lines_are_flown_as_waypoints_apart(
    ends: list[tuple[float, float, float, float]],
) -> None:
    lines = [((50 + a, 50 + b), (50 + c, 50 + d)) for a, b, c, d in ends]
    found = checked(spacing_of(FIELD), sortie_of(*lines))
    assert not near_pairs(waypoints_of(found), within_m=NEAR_M + 0.016)


def test_a_line_between_two_walls_that_no_way_makes_longer_is_left_out_where_it_may_be() -> None:
    # The nook at the lower right is 1.5 m deep; the other short line has room beyond its ends.
    ground = box(0.0, 0.0, 60.0, 12.0).union(box(60.0, 0.0, 66.0, 1.5))
    lines = np.array([[0.0, 3.0, 60.0, 3.0], [30.0, 8.0, 30.0, 9.5], [63.0, 0.0, 63.0, 1.5]])
    covered = shapely.union_all(Boom(width_m=6.0).strips(lines))
    for target, left_share, kept in (
        (box(0.0, 0.0, 60.0, 6.0), 0.0, lines[:2]),
        (covered, 0.0, lines),
        (covered, 10.0 / covered.area, lines[:2]),
    ):
        found = without_stubs(
            lines, ground, target, Boom(width_m=6.0), left_share=left_share
        )  # fmt: skip
        assert found.tolist() == kept.tolist()


@pytest.mark.parametrize("gap_m", [3.0, 12.0, 20.0])
def test_a_short_gap_between_short_lines_on_one_course_keeps_one_waypoint(gap_m: float) -> None:
    # Without one the leg over both goes so far beyond the first line that it counts as a ferry.
    first = ((0.0, 10.0), (15.0, 10.0))
    second = ((15.0 + gap_m, 10.0), (30.0 + gap_m, 10.0))
    stops = [stop.place for stop in waypoints_of(sortie_of(first, second))]
    kept = [place for place in stops if place in (first[1], second[0])]
    assert len(kept) == 1


@pytest.mark.parametrize(("first_m", "gap_m"), [(10.0, 40.0), (20.0, 28.0), (60.0, 28.0)])
def test_no_line_before_or_behind_a_long_gap_is_taken_for_a_ferry(
    first_m: float, gap_m: float
) -> None:
    lines = [
        ((0.0, 10.0), (first_m, 10.0)),
        ((first_m + gap_m, 10.0), (first_m + gap_m + 10.0, 10.0)),
    ]
    for some in (lines, [(end, start) for start, end in reversed(lines)]):
        x = [stop.place[0] for stop in waypoints_of(sortie_of(*some))]
        for line in some:
            low, high = sorted(place[0] for place in line)
            # The companion has a leg begin and end 30 m beyond its line at most.
            assert any(
                low - 30.0 <= min(leg) <= low and high <= max(leg) <= high + 30.0
                for leg in pairwise(x)
            )


@pytest.mark.parametrize("length_m", [4.0, 10.0, 24.0])
def test_small_bends_of_a_long_row_of_lines_do_not_add_up(length_m: float) -> None:
    # A border of 100 km radius: each line ends less than 6 mm beside the straight of the last two.
    x_m = length_m * np.arange(61)
    places = [(float(x), 30.0 + float(x**2 / 200_000.0)) for x in x_m]
    stops = waypoints_of(sortie_of(*pairwise(places)))
    way = LineString([stop.place for stop in stops[1:]])
    assert max(way.distance(Point(place)) for place in places[:-1]) < 0.05
    assert len(stops) < len(places) / 2


def test_a_row_of_short_lines_is_timed_as_it_is_flown() -> None:
    # Along an outline walked with a receiver: lines of 2 to 9 m, each a little off the last one.
    x, lines = 0.0, []
    for number in range(16):
        length_m, y = 2.0 + 7.0 * (number % 3) / 2.0, 10.0 + 0.02 * (number % 2)
        lines.append(((x, y), (x + length_m, y)))
        x += length_m + 0.05
    sortie = sortie_of(*lines)
    (found,) = timed([sortie], SETTINGS)
    places = np.array([*(stop.place for stop in waypoints_of(sortie)), (0.0, 0.0)])
    flown = flown_s(Way(places=places, speeds_m_s=np.full(len(places) - 1, SETTINGS.speed_m_s)))
    assert sum(leg.seconds for leg in found.legs) == pytest.approx(flown, rel=0.03)


def test_a_line_shorter_than_a_leg_may_be_is_flown_longer() -> None:
    lines = (((0.0, 10.0), (40.0, 10.0)), ((60.0, 30.0), (60.0, 31.2)), ((0.0, 50.0), (40.0, 50.0)))
    sortie = sortie_of(*lines)
    assert near_pairs(waypoints_of(sortie))
    found = checked(spacing_of(FIELD), sortie)
    assert not near_pairs(waypoints_of(found))
    way = LineString([stop.place for stop in waypoints_of(found)])
    assert all(way.distance(shapely.Point(place)) < 1e-6 for line in lines for place in line)


def test_corners_move_away_from_what_they_lead_around() -> None:
    # A post at the middle of the way: its corners are 0.9 m apart, and near the second line.
    post = box(49.7, 14.4, 50.3, 15.0)
    corners = ((49.4, 14.0), (50.6, 14.0))
    lines = (((40.0, 60.0), (40.0, 15.0)), ((51.4, 15.0), (51.4, 60.0)))
    sortie = sortie_of(*lines, corners=corners)
    assert len(near_pairs(waypoints_of(sortie))) == 2
    found = checked(spacing_of(FIELD.difference(post)), sortie)
    assert not near_pairs(waypoints_of(found))


def test_where_there_is_no_room_it_is_counted_and_said() -> None:
    # A nook shorter than a leg may be, with lines to its very walls.
    nook = box(0.0, 0.0, 1.8, 1.7)
    lines = (((0.1, 0.4), (1.7, 0.4)), ((1.7, 1.2), (0.1, 1.2)))
    sortie = sortie_of(*lines)
    settings = Settings(swath_width_m=1.0, speed_m_s=6.0)
    found = checked(spacing_of(nook, settings=settings), sortie)
    assert len(near_pairs(waypoints_of(found))) == 3
    (said,) = near_warnings([found], FRAME)
    assert "3 waypoints less than 2 m from the one before, the nearest 0.8 m near" in said


# A corridor of 1.8 m with lines across its ends: the second one stands 1.4 m behind the first.
ROOM = box(0.0, 0.0, 1.8, 40.0)
SHORT = ((1.5, 20.0), (0.3, 20.0))
LONG = (((0.9, 1.0), (0.9, 19.0)), ((0.9, 21.0), (0.9, 39.0)))


def crowded_of(lines: list[Line], *, left_share: float) -> Crowded:
    rows = np.array([[*start, *end] for start, end in lines])
    target = rectangles(rows, 1.0)
    return Crowded(
        rows, shapely.union_all(target), Boom(width_m=1.0), left_share=left_share, apart=False
    )  # fmt: skip


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_line_of_a_metre_among_waypoints_too_near_is_left_out_where_it_may_be(
    number: int,
) -> None:
    lines: list[Line] = [*LONG]
    lines.insert(number, SHORT)
    sortie = sortie_of(*lines)
    spacing = spacing_of(ROOM, settings=replace(SETTINGS, swath_width_m=1.0))

    def pace(sorties: Sequence[Sortie]) -> Paced:
        return Paced(sorties=spacing.spaced(sorties), misses=())

    assert near_pairs(waypoints_of(pace([sortie]).sorties[0]))
    crowded = crowded_of(lines, left_share=0.05)
    found = crowded.paced([sortie], pace, spacing.ways, share=1.0)
    assert not near_pairs(waypoints_of(found.sorties[0]))
    assert found.sorties[0].lines == 2
    assert len(crowded.flown(found.sorties)) == 2
    ways = [leg.points for leg in found.sorties[0].legs]
    assert all(math.dist(one[-1], other[0]) < 1e-6 for one, other in pairwise(ways))
    # Where its ground may not be left, or that is the share of other lines, it is flown.
    for left_share, share in ((0.01, 1.0), (0.05, 0.1)):
        crowded = crowded_of(lines, left_share=left_share)
        kept = crowded.paced([sortie], pace, spacing.ways, share=share)
        assert kept == pace([sortie])
        assert len(crowded.flown(kept.sorties)) == 3


@pytest.mark.parametrize("words", ["plain", "ferry height", "px4"])
def test_no_waypoint_of_a_field_of_trees_is_near_the_one_before(words: str) -> None:
    plan = planned(
        Settings(
            swath_width_m=6.0, speed_m_s=6.0, moves=500,
            ferry_height_m=15.0 if words == "ferry height" else None,
            autopilot="px4" if words == "px4" else "ardupilot",
        )
    )  # fmt: skip
    for sortie in plan.sorties:
        for one, other in pairwise(waypoints_of(sortie)[1:]):
            upright = one.height_m != other.height_m
            assert math.dist(one.place, other.place) >= NEAR_M or upright
    assert not near_warnings(plan.sorties, plan.field.frame)
    inside = plan.field.fly.buffer(1e-5)
    legs = [leg for sortie in plan.sorties for leg in sortie.legs if leg.kind == "transit"]
    assert all(inside.covers(LineString(leg.points)) for leg in legs)


def test_with_orders_at_their_ends_lines_keep_waypoints_there() -> None:
    sortie = sortie_of(((0.0, 10.0), (40.0, 10.0)), ((40.0, 11.5), (70.0, 30.0)))
    found = checked(spacing_of(FIELD, apart=True), sortie)
    stops = waypoints_of(found, apart=True)
    assert not near_pairs(stops)
    assert [stop.opens for stop in stops if stop.opens is not None] == [True, False] * 2


def planned(settings: Settings) -> Plan:
    drawn = trees(15, corners=64, area_ha=6.0)
    field = build_field(
        drawn.outline, obstacles=list(drawn.obstacles), swath_width_m=6.0  # type: ignore[arg-type]
    )  # fmt: skip
    return plan_mission(field, settings, Uniform(rate_l_ha=20.0))
