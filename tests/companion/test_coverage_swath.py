"""What counts as treated: by what the valves really did, at the place where they were then."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from companion.core.controller import Memory, expected_coverage, step
from companion.core.options import treated_area
from companion.core.options.coverage import Coverage
from companion.core.options.treated_area import FlowEdge, TreatedArea, follow
from companion.core.prescription import Prescription
from companion.core.setup import Setup
from companion.core.types import FaultKind, Finding, SprayPlan, TimedChange, VehicleState
from tests.builders import LAG, along, boom, flying, plots, setup

SPEED = 5.0
START_M = -10.0


def given(**change: object) -> Setup:
    """A field of 48 x 8 m whose border is a boundary like any other."""
    return setup(**({"record_coverage": True, "border": "volume"} | change))


def flown(
    own: Setup, end_m: float = 60.0, *, enabled_until_m: float = math.inf, north_m: float = 3.0
) -> tuple[Memory, VehicleState, float]:
    memory, hz = Memory(), 20.0
    state, now = flying(10.0, START_M), 10.0
    for i in range(round((end_m - START_M) / SPEED * hz) + 1):
        now = 10.0 + i / hz
        east_m = START_M + SPEED * i / hz
        state = flying(now, east_m, north_m, enabled=east_m < enabled_until_m)
        _, memory = step(own, state, memory, now)
    return memory, state, now


def treated(own: Setup, end_m: float = 60.0, **how: float) -> Coverage:
    memory, _, _ = flown(own, end_m, **how)
    assert memory.watched.area is not None
    return memory.watched.area.coverage


def along_middle(made: Coverage, north_m: float = 3.1) -> tuple[float, float]:
    """Where the treated ground begins and ends, going east."""
    east = np.arange(-20.0, 70.0, 0.02)
    hits = east[made.covered_at(east, np.full(len(east), north_m))]
    assert (np.diff(hits) < 0.05).all()  # in one piece
    return float(hits[0]), float(hits[-1])


def test_without_a_record_nothing_is_kept() -> None:
    memory, _, _ = flown(setup())
    assert memory.watched.area is None


def test_a_pass_treats_from_boundary_to_boundary() -> None:
    made = treated(given())
    assert along_middle(made) == pytest.approx((0.0, 48.0), abs=0.11)
    assert made.area_m2 == pytest.approx(48.0 * 6.0, abs=2.0)


def test_edges_lie_where_the_orders_take_effect_and_not_where_they_were_meant_to() -> None:
    # Valves that open and close half a second later than the schedule believes.
    slow = replace(LAG, on_s=LAG.on_s + 0.5, off_s=LAG.off_s + 0.5, off_end_s=LAG.off_end_s + 0.5)
    own = given()
    slow_setup = replace(own, lag=slow)
    for planned_by in ("timing", "timings"):
        object.__setattr__(slow_setup, planned_by, getattr(own, planned_by))
    assert along_middle(treated(slow_setup)) == pytest.approx((2.5, 50.5), abs=0.15)


def test_disabling_ends_it_where_the_valves_close() -> None:
    made = treated(given(), enabled_until_m=20.0)
    assert along_middle(made)[1] == pytest.approx(20.0 + SPEED * (LAG.off_s + 0.01), abs=0.15)


def test_a_rate_of_zero_is_not_treated() -> None:
    zones = plots([[20.0, 0.0, 15.0, 20.0]])
    made = treated(given(prescription=Prescription(zones)))
    east = np.array([6.0, 18.0, 30.0])
    assert made.covered_at(east, np.full(3, 3.0)).tolist() == [True, False, True]


def test_each_strip_is_its_own() -> None:
    # A slanting border: the strips end one after the other.
    field = shapely.Polygon([(0, -1), (20, -1), (32, 7), (0, 7)])
    made = treated(given(prescription=Prescription(plots([[20.0] * 4]), boundary=field)))
    for north_m in (0.5, 2.5, 5.5):
        ends = along_middle(made, north_m)[1]
        assert ends == pytest.approx(20.0 + 12.0 * (north_m + 1.0) / 8.0, abs=0.2)


def test_a_boom_ahead_of_the_reference_treats_ahead_of_it() -> None:
    made = treated(given(boom=boom(forward_m=1.5)), 20.0)
    assert along_middle(made)[0] == pytest.approx(0.0, abs=0.11)


def test_a_turn_is_swept_as_it_is_flown() -> None:
    own = given(prescription=Prescription([], boundary=shapely.box(-90, -90, 90, 90),
                                          default_rate_l_ha=20.0))  # fmt: skip
    memory, hz, radius = Memory(), 20.0, 20.0
    turn_deg_s = math.degrees(SPEED / radius)
    for i in range(round(90.0 / turn_deg_s * hz)):
        course = turn_deg_s * i / hz
        now = 10.0 + i / hz
        state = flying(
            now,
            -radius * math.cos(math.radians(course)),
            radius * math.sin(math.radians(course)),
            yaw_rate_deg_s=turn_deg_s,
            **along(course),
        )
        _, memory = step(own, state, memory, now)
    assert memory.watched.area is not None
    angles = np.radians(np.arange(20.0, 70.0, 0.5))
    for aside, inside in ((-2.8, True), (0.0, True), (2.8, True), (-3.3, False), (3.3, False)):
        east, north = -(radius + aside) * np.cos(angles), (radius + aside) * np.sin(angles)
        assert (memory.watched.area.coverage.covered_at(east, north) == inside).all(), aside


def test_a_jump_of_the_position_leaves_nothing_between() -> None:
    memory = Memory()
    own = given(
        prescription=Prescription([], boundary=shapely.box(-9, -9, 999, 99), default_rate_l_ha=20.0)
    )
    for i in range(140):
        now = 10.0 + i / 20.0
        _, memory = step(own, flying(now, (300.0 if i >= 40 else 0.0) + 0.25 * i), memory, now)
    assert memory.watched.area is not None
    made = memory.watched.area.coverage
    assert made.covered_at(np.array([5.0, 315.0]), np.full(2, 3.0)).all()
    assert not made.covered_at(np.arange(15.0, 300.0), np.full(285, 3.0)).any()


def test_ground_that_waits_to_be_stamped_is_known_and_does_not_wait_long() -> None:
    own, memory, waited = given(), Memory(), 0
    for i in range(181):
        now = 10.0 + i / 20.0
        _, memory = step(own, flying(now, START_M + 0.25 * i), memory, now)
        area = memory.watched.area
        assert area is not None
        if area.unstamped is None:
            continue
        waited += 1
        until_s = area.older[-1].until_s
        assert now - until_s < treated_area.UNSTAMPED_MAX_S
        stamped = area.settled()
        assert stamped.unstamped is None
        assert stamped.raster == area.coverage == stamped.older[-1].coverage
        assert stamped.raster != area.raster
        # Whoever asks meanwhile is told of it.
        state = flying(now + 1.0, START_M + 0.25 * i + 5.0)
        here = (state.east_m, state.north_m)
        assert area.before(now, here=here, behind_m=1.0) == stamped.raster
    assert waited > 0


def test_in_a_turn_where_no_step_has_time_the_ground_is_stamped_all_the_same() -> None:
    own, memory, waits = given(), Memory(), []
    for i in range(100):
        now = 10.0 + i / 20.0
        state = flying(now, 1.0 + 0.25 * i, yaw_rate_deg_s=10.0)
        _, memory = step(own, state, memory, now)
        area = memory.watched.area
        assert area is not None
        if area.unstamped is not None:
            waits.append(now - area.older[-1].until_s)
    longest_s = treated_area.UNSTAMPED_MAX_S
    assert longest_s - 0.051 < max(waits) < longest_s
    assert area.raster.tiles


# ------------------------------------------------------------------------------ of the liquid


def plan(*, issued_s: float, duty: tuple[float, ...], lease_s: float = 0.3) -> SprayPlan:
    return SprayPlan(
        sequence=1, issued_s=issued_s, duty=duty, changes=(), lease_until_s=issued_s + lease_s
    )


def swept(own: Setup, duty: tuple[float, ...], *findings: Finding) -> Coverage:
    """A flight of five seconds with one duty throughout, whatever the map says."""
    area: TreatedArea | None = None
    for i in range(101):
        now = 10.0 + i / 20.0
        order = plan(issued_s=now - 0.05, duty=duty)
        area = follow(
            own.recording,
            area,
            order,
            flying(now, 0.25 * i),
            findings=findings,
            drift_m=None,
            now_s=now,
        )
    assert area is not None
    return area.coverage


def found(kind: FaultKind, valve: int | None = None) -> Finding:
    return Finding(kind=kind, at_s=9.0, text="", valve=valve)


OPEN, SHUT = (0.5,) * 6, (0.0,) * 6
# North of each valve's middle, flying east: the left valve is the northernmost.
MIDDLES = np.array([5.5, 4.5, 3.5, 2.5, 1.5, 0.5])


def strips(made: Coverage) -> list[bool]:
    return made.covered_at(np.full(6, 10.0), MIDDLES).tolist()


@pytest.mark.parametrize("kind", sorted(treated_area.NO_LIQUID))
def test_nothing_is_treated_where_no_liquid_comes(kind: FaultKind) -> None:
    assert strips(swept(given(), OPEN)) == [True] * 6
    assert not swept(given(), OPEN, found(kind)).tiles


def test_a_valve_that_sticks_closed_leaves_its_strip_bare() -> None:
    made = swept(given(), OPEN, found(FaultKind.STUCK_CLOSED, 1))
    assert strips(made) == [True, False, True, True, True, True]


def test_a_valve_that_sticks_open_treats_whatever_is_ordered() -> None:
    made = swept(given(), SHUT, found(FaultKind.STUCK_OPEN, 4))
    assert strips(made) == [False] * 4 + [True, False]


def test_a_clog_or_a_finding_without_a_valve_changes_nothing() -> None:
    whole = swept(given(), OPEN)
    assert swept(given(), OPEN, found(FaultKind.CLOG, 2), found(FaultKind.STUCK_OPEN)) == whole


def test_a_lease_that_ends_closes() -> None:
    own, area = given(), None
    order = plan(issued_s=10.0, duty=OPEN)
    for i in range(101):
        now = 10.0 + i / 20.0
        area = follow(
            own.recording, area, order, flying(now, 0.25 * i), findings=(), drift_m=None, now_s=now
        )
    assert area is not None
    closes_s = 0.3 + LAG.off_s + LAG.output_s
    assert along_middle(area.coverage)[1] == pytest.approx(SPEED * closes_s, abs=0.11)


def test_a_change_that_overtakes_the_one_before_undoes_it() -> None:
    off = FlowEdge(10.2, 1, opens=False)
    assert treated_area.with_flow_edge((off,), FlowEdge(10.1, 1, opens=True)) == ()
    other = FlowEdge(10.1, 0, opens=True)
    assert treated_area.with_flow_edge((off,), other) == (off, other)


def test_an_opening_of_a_moment_treats_its_moment() -> None:
    changes = (
        TimedChange(at_s=10.0, valve=0, duty=0.5),
        TimedChange(at_s=10.4, valve=0, duty=0.0),
    )
    order = replace(plan(issued_s=10.0, duty=SHUT, lease_s=9.0), changes=changes)
    own = given()
    area: TreatedArea | None = None
    for i in range(101):
        now = 10.0 + i / 20.0
        area = follow(
            own.recording, area, order, flying(now, 0.25 * i), findings=(), drift_m=None, now_s=now
        )
    assert area is not None
    ends = along_middle(area.coverage, 5.5)
    assert ends == pytest.approx((SPEED * 0.11, SPEED * (0.4 + 0.12)), abs=0.11)


# ------------------------------------------------------------------------------ as it will be


def test_what_is_expected_goes_on_to_the_cut_and_closes_there() -> None:
    own = given()
    memory, state, now = flown(own, 20.0)
    at_once = expected_coverage(own, memory, state, now_s=now, cut_s=now)
    later = expected_coverage(own, memory, state, now_s=now, cut_s=now + 0.6)
    lag_m = SPEED * (LAG.off_s + LAG.output_s)
    assert along_middle(at_once)[1] == pytest.approx(20.0 + lag_m, abs=0.11)
    assert along_middle(later)[1] == pytest.approx(20.0 + 0.6 * SPEED + lag_m, abs=0.11)
    assert (at_once.ahead_s, later.ahead_s) == (0.0, pytest.approx(0.6))


def test_what_is_expected_of_an_end_is_what_comes_of_it() -> None:
    own = given()
    memory, state, now = flown(own, 20.0)
    told = expected_coverage(own, memory, state, now_s=now, cut_s=now)
    true = treated(own, enabled_until_m=20.0)
    assert told.area_m2 == pytest.approx(true.area_m2, abs=1.5)


def test_where_nothing_is_open_it_is_what_it_was() -> None:
    own = given()
    memory, state, now = flown(own, 60.0)
    assert memory.watched.area is not None
    assert (
        expected_coverage(own, memory, state, now_s=now, cut_s=now + 1.0)
        is memory.watched.area.coverage
    )
    assert not expected_coverage(own, Memory(), None, now_s=now, cut_s=now).tiles


@pytest.mark.parametrize("speed_m_s", [0.4, 0.7])
def test_whoever_creeps_treats_too(speed_m_s: float) -> None:
    zones = plots([[80.0] * 4])
    limits = replace(setup().limits, speed_min_m_s=0.2)
    own = given(prescription=Prescription(zones), limits=limits)
    memory, now, east_m = Memory(), 10.0, -1.0
    while east_m < 6.0:
        state = flying(now, east_m, 3.0, **along(90.0, speed_m_s))
        _, memory = step(own, state, memory, now)
        now, east_m = now + 0.1, east_m + 0.1 * speed_m_s
    assert memory.watched.area is not None
    # Up to two seconds are not stamped yet.
    assert along_middle(memory.watched.area.coverage) == pytest.approx((0.0, 5.3), abs=0.8)
