"""What the other tests of the crossings, the prescription and the flow curve let pass.

Each of these fails for a mutation of its own (docs/contributing/testing.md).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely

from companion.core import boom as geometry
from companion.core import crossings
from companion.core.boom import Boom, Pass, Paths, Valve, predict, straight_pass
from companion.core.controller import Memory, step
from companion.core.crossings import Route, find_routes
from companion.core.motion import CRUISE
from companion.core.nozzle import FlowCurve
from companion.core.prescription import Prescription, Zone
from companion.core.types import VehicleState
from tests.builders import flying, setup

NAN = math.nan


def rates(route: Route) -> list[Any]:
    return [(crossing.at_s, crossing.rate_l_ha) for crossing in route]


# ------------------------------------------------------------------------------- crossings


def one_valve(width_m: float = 1.0) -> Boom:
    valve = Valve(name="1", right_m=0.0, forward_m=0.0, width_m=width_m)
    return Boom(width_m=width_m, valves=(valve,))


def routes_of(
    field: Prescription, state: VehicleState, boom: Boom, *, ahead_s: float = 2.0
) -> list[list[Any]]:
    found = find_routes(
        field, state, boom, back_s=0.3, ahead_s=ahead_s, border="inside", border_buffer_m=0.1,
        across="centre",
    )  # fmt: skip
    return [rates(each) for each in found]


@pytest.mark.parametrize("top_m", [8.0, 12.0])
def test_a_path_through_a_corner_of_a_boundary_crosses_once(top_m: float) -> None:
    bend = [(12.0, 0.0), (10.0, 3.0), (top_m, 6.0)]
    zones = [
        Zone(name="w", polygon=shapely.Polygon([(0, 0), *bend, (0, 6)]), rate_l_ha=10.0),
        Zone(name="e", polygon=shapely.Polygon([(20, 0), *bend, (20, 6)]), rate_l_ha=20.0),
    ]
    field = Prescription(zones, boundary=shapely.box(-5, -5, 25, 11))
    for heading_deg in (90.0, 270.0):
        speed_m_s = 5.0 if heading_deg == 90.0 else -5.0
        state = flying(
            10.0, 10.0 - 0.8 * speed_m_s, velocity_east_m_s=speed_m_s, heading_deg=heading_deg
        )
        (found,) = routes_of(field, state, one_valve())
        order = [10.0, 20.0] if speed_m_s > 0.0 else [20.0, 10.0]
        assert found == [(pytest.approx(9.7), order[0]), (pytest.approx(10.8), order[1])]


def test_the_tip_of_a_zone_that_is_only_touched_changes_nothing() -> None:
    tip = shapely.Polygon([(10, 3), (8, 6), (12, 6)])
    rest = shapely.Polygon([(0, 0), (20, 0), (20, 6), (12, 6), (10, 3), (8, 6), (0, 6)])
    zones = [
        Zone(name="all", polygon=rest, rate_l_ha=10.0),
        Zone(name="tip", polygon=tip, rate_l_ha=20.0),
    ]
    field = Prescription(zones, boundary=shapely.box(-5, -5, 25, 11))
    (found,) = routes_of(field, flying(10.0, 6.0, 3.0), one_valve())
    assert [rate for _, rate in found] == [10.0]


def _ways_ahead(heading_deg: float, course_deg: float) -> tuple[Pass, Paths, Boom]:
    """Return a straight pass whose middle flies through the corner at (12, 6), in both forms."""
    valves = tuple(
        Valve(name=str(k), right_m=k - 2.0, forward_m=0.2 * k, width_m=1.0) for k in range(5)
    )
    boom = Boom(width_m=5.0, valves=valves)
    angle = math.radians(course_deg)
    state = flying(
        10.0, 12.0 - 3.0 * math.sin(angle), 6.0 - 3.0 * math.cos(angle), heading_deg=heading_deg,
        velocity_east_m_s=5.0 * math.sin(angle), velocity_north_m_s=5.0 * math.cos(angle),
    )  # fmt: skip
    way = straight_pass(state, boom, back_s=0.3, ahead_s=1.2)
    assert way is not None
    return way, predict(state, boom.right_m, boom.forward_m, back_s=0.3, ahead_s=1.2), boom


@pytest.mark.parametrize("course_deg", [0.0, 45.0, 90.0, 137.0, 180.0, 211.0, 270.0, 359.0])
@pytest.mark.parametrize("off_deg", [0.0, 20.0, 89.0])
def test_a_straight_pass_meets_what_chords_of_any_direction_meet(
    course_deg: float, off_deg: float
) -> None:
    zones = [
        Zone(name=f"{x}-{y}", polygon=shapely.box(4 * x, 2 * y, 4 * x + 4, 2 * y + 2), rate_l_ha=9)
        for x in range(6) for y in range(6)
    ]  # fmt: skip
    field = Prescription(zones)
    way, paths, boom = _ways_ahead(course_deg + off_deg, course_deg)
    ends, owner = field.edges.ends, field.edges.owner
    plain = [(*each, who) for each, who in zip(ends.tolist(), owner.tolist(), strict=True)]
    cuts = crossings._cuts_of_pass(way, plain)
    assert cuts == crossings._cuts(paths, ends, owner)
    assert sum(map(len, cuts)) > 5
    touched = geometry._contacts_of_pass(way, plain, boom, 0.1)
    assert touched
    assert sorted(touched) == sorted(geometry._contacts(paths, 0, ends, boom, 0.1))
    assert way.right == paths.right[0]
    starts = np.array(crossings._starts_of_pass(way))
    assert starts == pytest.approx(np.array(crossings._starts(paths)), abs=1e-9)


def test_what_is_near_a_path_is_what_the_map_has_there_wherever_one_was_before() -> None:
    zones = [
        Zone(name=f"{x}-{y}", polygon=shapely.box(4 * x, 2 * y, 4 * x + 4, 2 * y + 2), rate_l_ha=9)
        for x in range(9) for y in range(9)
    ]  # fmt: skip
    field = Prescription(zones, exclusions=[shapely.Point(15, 9).buffer(2.0)])
    draw = np.random.default_rng(7)
    for _ in range(200):
        # A step on, mostly, as a flight goes; then somewhere else.
        west, south = (float(each) for each in draw.uniform((-6.0, -6.0), (40.0, 22.0)))
        for farther_m in range(4):
            box = (west + farther_m, south, west + farther_m + 3.0, south + 5.0)
            near = field.near(box)
            ends, owner = field.edges_near(*box)
            plain = [(*each, who) for each, who in zip(ends.tolist(), owner.tolist(), strict=True)]
            assert sorted(near.edges_in(box)) == sorted(plain)
            east_m, north_m = draw.uniform(box[:2], box[2:], size=(6, 2)).T
            owners = field.owners_near(near, east_m.tolist(), north_m.tolist())
            assert owners == field.owners_at(east_m, north_m)


@pytest.mark.parametrize("yaw_rate_deg_s", [0.0, 3.5])  # a straight pass; the slowest of turns
def test_a_boom_along_its_own_motion_is_closed_where_its_end_meets_a_border(
    yaw_rate_deg_s: float,
) -> None:
    field = Prescription([Zone(name="a", polygon=shapely.box(0, 0, 48, 6), rate_l_ha=20.0)])
    sideways = flying(10.0, 43.0, 3.0, heading_deg=0.0, yaw_rate_deg_s=yaw_rate_deg_s)
    ((_, before), (at_s, then)) = routes_of(field, sideways, one_valve(6.0))[0]
    assert (before, then) == (20.0, None)
    assert at_s == pytest.approx(10.0 + (48.0 - 0.1 - 46.0) / 5.0, abs=0.03)
    beside = replace(sideways, north_m=5.95)
    assert [rate for _, rate in routes_of(field, beside, one_valve(6.0))[0]] == [None]


@pytest.mark.parametrize("yaw_rate_deg_s", [0.0, 3.5])  # a straight pass; the slowest of turns
@pytest.mark.parametrize(("north_m", "rate"), [(6.45, None), (6.35, 20.0)])
def test_a_strip_beside_the_border_keeps_the_buffer(
    north_m: float, rate: float | None, yaw_rate_deg_s: float
) -> None:
    zone = Zone(name="a", polygon=shapely.box(0, 0, 48, 7), rate_l_ha=20.0)
    state = flying(10.0, 20.0, north_m, yaw_rate_deg_s=yaw_rate_deg_s)
    (found,) = routes_of(Prescription([zone]), state, one_valve())
    assert [value for _, value in found] == [rate]


def test_only_ground_beyond_the_border_is_outside() -> None:
    zones = [
        Zone(name="a", polygon=shapely.box(0, 0, 10, 6), rate_l_ha=20.0),
        Zone(name="none", polygon=shapely.box(10, 0, 12, 6), rate_l_ha=0.0),
        Zone(name="b", polygon=shapely.box(12, 0, 14, 6), rate_l_ha=20.0),
    ]
    (found,) = find_routes(
        Prescription(zones), flying(10.0, 8.0), one_valve(), back_s=0.3, ahead_s=2.0,
        border="inside", border_buffer_m=0.1, across="centre",
    )  # fmt: skip
    assert [(crossing.rate_l_ha, crossing.outside) for crossing in found] == [
        (20.0, False),
        (0.0, False),
        (20.0, False),
        (None, True),
    ]


def test_ground_without_a_zone_is_closed_and_not_outside() -> None:
    zones = [Zone(name="a", polygon=shapely.box(0, 0, 10, 6), rate_l_ha=20.0)]
    (found,) = find_routes(
        Prescription(zones, boundary=shapely.box(0, 0, 12, 6)), flying(10.0, 8.0), one_valve(),
        back_s=0.3, ahead_s=2.0, border="inside", border_buffer_m=0.1, across="centre",
    )  # fmt: skip
    assert [(crossing.rate_l_ha, crossing.outside) for crossing in found] == [
        (20.0, False),
        (None, False),
        (None, True),
    ]


def test_a_braking_aircraft_meets_the_boundary_when_its_motion_takes_it_there() -> None:
    zones = [
        Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=20.0),
        Zone(name="b", polygon=shapely.box(12, 0, 48, 6), rate_l_ha=25.0),
    ]
    state = flying(10.0, 10.0, acceleration_east_m_s2=-2.5)
    (found,) = routes_of(Prescription(zones), state, one_valve(), ahead_s=1.0)
    dt_s = found[1][0] - 10.0
    gained = CRUISE.fade_s * (1.0 - math.exp(-dt_s / CRUISE.fade_s))
    there = 10.0 + 5.0 * dt_s - 2.5 * CRUISE.fade_s * (dt_s - gained)
    assert there == pytest.approx(12.0, abs=1e-5)


def test_the_speed_at_a_boundary_is_that_of_the_motion_there() -> None:
    zones = [
        Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=20.0),
        Zone(name="b", polygon=shapely.box(12, 0, 48, 6), rate_l_ha=25.0),
    ]
    (found,) = find_routes(
        Prescription(zones), flying(10.0, 10.0, acceleration_east_m_s2=-2.5), one_valve(),
        back_s=0.3, ahead_s=1.0, border="volume", border_buffer_m=0.1, across="centre",
    )  # fmt: skip
    gained = CRUISE.fade_s * (1.0 - math.exp(-(found[1].at_s - 10.0) / CRUISE.fade_s))
    assert found[1].speed_m_s == pytest.approx(5.0 - 2.5 * gained, abs=1e-5)


def test_in_a_turn_the_strips_turn_with_the_boom() -> None:
    state = flying(10.0, 10.0, yaw_rate_deg_s=30.0)
    ends = np.array([-3.0, 3.0])
    paths = predict(state, ends, np.zeros(2), back_s=0.3, ahead_s=1.5)
    for chord, (right_east, right_north) in enumerate(paths.right):
        east = paths.east_m[1, chord : chord + 2] - paths.east_m[0, chord : chord + 2]
        north = paths.north_m[1, chord : chord + 2] - paths.north_m[0, chord : chord + 2]
        assert right_east * 6.0 == pytest.approx(east.mean(), abs=0.1)
        assert right_north * 6.0 == pytest.approx(north.mean(), abs=0.1)


# ---------------------------------------------------------------------------- prescription


@pytest.mark.parametrize(
    ("overlap", "rate"), [("error", 10.0), ("min", 10.0), ("max", 30.0), ("mean", 20.0)]
)
def test_where_zones_overlap_the_policy_decides(overlap: str, rate: float) -> None:
    zones = [
        Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=30.0),
        Zone(name="b", polygon=shapely.box(10, 0, 20, 6), rate_l_ha=10.0),
    ]
    field = Prescription(zones, overlap=overlap)  # type: ignore[arg-type]
    assert field.rate_at(11.0, 3.0) == rate


def test_of_two_zones_the_last_lies_on_top() -> None:
    zones = [
        Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=10.0),
        Zone(name="b", polygon=shapely.box(10, 0, 20, 6), rate_l_ha=30.0),
    ]
    assert Prescription(zones, overlap="last").rate_at(11.0, 3.0) == 30.0


def test_an_exclusion_is_no_field() -> None:
    zone = Zone(name="a", polygon=shapely.box(0, 0, 20, 6), rate_l_ha=30.0)
    field = Prescription([zone], exclusions=[shapely.box(8, 2, 10, 4)])
    assert field.rate_at(9.0, 3.0) is None
    assert field.rate_at(7.0, 3.0) == 30.0


# ------------------------------------------------------------------------------ flow curve


@pytest.mark.parametrize(
    ("duty", "flow"),
    [
        ((0.2, 0.5, 0.5), (1.0, 2.0, 3.0)),
        ((0.2, 0.5, 0.9), (1.0, 2.0, 1.9)),
        ((0.2, 0.5, 0.9), (1.0, NAN, 2.0)),
    ],
)
def test_a_curve_that_does_not_rise_is_refused(
    duty: tuple[float, ...], flow: tuple[float, ...]
) -> None:
    with pytest.raises(ValueError, match="strictly increasing"):
        FlowCurve(duty=duty, flow_l_min=flow)


# --------------------------------------------------------------- crossings that are carried on


def second_step(first: VehicleState, second: VehicleState) -> tuple[Memory, Memory]:
    """Return what two steps leave, and what the second one alone would."""
    given = setup()
    _, memory = step(given, first, Memory(), first.time_s)
    _, carried = step(given, second, memory, second.time_s)
    _, anew = step(given, second, Memory(), second.time_s)
    return carried, anew


def times(memory: Memory) -> list[list[float]]:
    return [[crossing.at_s for crossing in each[1:]] for each in memory.routes.routes]


@pytest.mark.parametrize("off_m", [-0.02, 0.0, 0.02])
def test_crossings_carried_on_are_where_the_new_position_has_them(off_m: float) -> None:
    # 0.75 s ahead of the boundary at 12 m.
    carried, anew = second_step(flying(10.0, 8.0), flying(10.05, 8.25 + off_m))
    assert carried.routes.found_from is not None
    assert carried.routes.found_from.time_s == 10.0  # not found anew
    assert [each[0] for each in times(carried)] == pytest.approx([10.05 + (3.75 - off_m) / 5.0] * 6)
    assert [each[0] for each in times(anew)] == pytest.approx([10.05 + (3.75 - off_m) / 5.0] * 6)


def test_crossings_that_are_due_soon_are_found_anew() -> None:
    carried, _ = second_step(flying(10.0, 11.0), flying(10.05, 11.25))
    assert carried.routes.found_from is not None
    assert carried.routes.found_from.time_s == 10.05


def test_in_a_turn_crossings_are_found_anew() -> None:
    turning = {"yaw_rate_deg_s": 3.5}
    carried, _ = second_step(
        flying(10.0, 8.0, **turning), flying(10.01, 8.05, heading_deg=90.035, **turning)
    )
    assert carried.routes.found_from is not None
    assert carried.routes.found_from.time_s == 10.01


def test_a_place_that_outruns_its_velocity_crosses_sooner_and_is_dosed_by_the_velocity() -> None:
    zones = [
        Zone(name="a", polygon=shapely.box(0, 0, 12, 6), rate_l_ha=20.0),
        Zone(name="b", polygon=shapely.box(12, 0, 48, 6), rate_l_ha=25.0),
    ]
    for outrun_m_s in (0.0, 0.5, -0.5):
        state = flying(10.0, 10.0, outrun_east_m_s=outrun_m_s)
        (found,) = find_routes(
            Prescription(zones), state, one_valve(), back_s=0.3, ahead_s=1.0,
            border="volume", border_buffer_m=0.1, across="centre",
        )  # fmt: skip
        assert found[1].at_s == pytest.approx(10.0 + 2.0 / (5.0 + outrun_m_s), abs=1e-6)
        assert found[1].speed_m_s == pytest.approx(5.0)


def test_carried_routes_go_with_the_place_that_outruns_its_velocity() -> None:
    """A step later the vehicle is where it was expected: the crossing keeps its time."""
    made = setup()
    first = flying(10.0, 9.0, outrun_east_m_s=0.4)
    _, memory = step(made, first, Memory(), 10.0)
    later = flying(10.05, 9.0 + 5.4 * 0.05, outrun_east_m_s=0.4)
    again = step(made, later, memory, 10.05)[1].routes
    assert again.found_from is first
    for route, before in zip(again.routes, memory.routes.routes, strict=True):
        assert len(route) == 2
        assert [one.at_s for one in route[1:]] == pytest.approx([one.at_s for one in before[1:]])
