"""The last rule at the border needs no path: by the present state alone it only ever closes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core import controller
from companion.core.controller import Memory, step
from companion.core.crossings import Crossing, Route
from companion.core.options.pump import PumpOutlet
from companion.core.prescription import Prescription, Zone
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.core.standing import Flowing, standing
from companion.core.types import DrivePlan, SprayPlan
from tests.border_flight import STEP_S, Way, flows, orders_of, spilled_s
from tests.builders import boom, flying, setup
from tests.pump_flight import pump_setup

FIELD = shapely.box(0.0, -20.0, 30.0, 20.0).difference(shapely.Point(15.0, 0.0).buffer(2.0))
LAG = LagModel(
    on_s=0.15, off_s=0.09, up_s=3.0, down_s=3.0, on_start_s=0.04, off_end_s=0.12, output_s=0.01
)
FIRST_S, LAST_S = 0.05, 0.13


def made(**change: Any) -> Setup:
    zone = Zone(name="a", polygon=shapely.box(-5.0, -30.0, 35.0, 30.0), rate_l_ha=20.0)
    given_: dict[str, Any] = {"lag": LAG, "border_buffer_m": 0.0}
    return setup(prescription=Prescription([zone], boundary=FIELD), **(given_ | change))


def blind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have every path say that all of the way lies inside."""

    def inside(_: Prescription, state: Any, over: Any, **__: Any) -> tuple[Route, ...]:
        return ((Crossing(state.time_s - 0.2, 20.0, False, 5.0),),) * len(over.valves)

    monkeypatch.setattr(controller, "find_routes", inside)
    monkeypatch.setattr(controller, "carried_on", lambda *_, **__: None)


@pytest.mark.parametrize("border", ["inside", "volume"])
@pytest.mark.parametrize("turn_deg_s", [0.0, 20.0])
def test_where_the_path_is_wrong_a_strip_outside_is_closed_and_none_opens_there(
    border: str, turn_deg_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    over = made(border=border)
    way = Way(
        east_m=-10.0, north_m=0.3, course_deg=90.0, speed_m_s=5.0, turn_deg_s=turn_deg_s,
        crab_deg=15.0,
    )  # fmt: skip
    blind(monkeypatch)
    hole = shapely.box(-100.0, -100.0, 100.0, 100.0).difference(
        shapely.Point(15.0, 0.0).buffer(2.0)
    )
    ground = FIELD if border == "inside" else hole
    opened = 0
    for strip, orders in zip(over.boom.valves, orders_of(over, way, 10.0), strict=True):
        opened += len(orders)
        # A step's time is what a closing may be late.
        spans = flows(orders, first_s=FIRST_S, last_s=LAST_S - STEP_S)
        assert not spilled_s(
            ground, way, spans, right_m=strip.right_m, forward_m=strip.forward_m,
            half_m=strip.width_m / 2.0, until_s=10.0,
        )  # fmt: skip
    assert opened >= 6


def duties(over: Setup, plan: SprayPlan | None, **state: Any) -> tuple[float, ...]:
    """Return what is ordered now, with all valves open or shut before."""
    memory = Memory() if plan is None else Memory(plan=plan)
    at = flying(10.0, **({"east_m": 5.0, "north_m": 0.0} | state))
    decision, _ = step(over, at, memory, 10.0)
    assert not decision.inhibits
    return decision.plan.duty_at(10.0)


OPEN = SprayPlan(sequence=1, issued_s=9.9, duty=(0.5,) * 6, changes=(), lease_until_s=10.2)


def test_a_strip_that_is_outside_now_is_closed_now(monkeypatch: pytest.MonkeyPatch) -> None:
    blind(monkeypatch)
    # Out of the north of the field by half a metre: the left strips alone.
    assert [duty > 0.0 for duty in duties(made(), OPEN, north_m=17.5)] == [False] + [True] * 5


@pytest.mark.parametrize(("most_m_s2", "opens"), [(0.1, True), (4.0, False)])
def test_nothing_opens_that_any_acceleration_would_put_outside(
    most_m_s2: float, opens: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind(monkeypatch)
    slow = replace(LAG, on_s=0.4, on_start_s=0.3)
    # Its first flow would fall 0.1 m inside: 0.31 s from now, when 4 m/s2 make 0.19 m.
    over = made(lag=slow, most_m_s2=most_m_s2)
    found = duties(over, None, east_m=0.1 - 5.0 * 0.31)
    assert {duty > 0.0 for duty in found} == {opens}


def test_what_would_be_outside_by_its_last_flow_is_closed_now(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    blind(monkeypatch)
    for gain, stays in ((0.0, True), (4.0, False)):
        # 5.4 m before the border, with a second to go.
        over = made(lag=replace(LAG, off_s=0.5, off_end_s=0.99))
        found = duties(over, OPEN, east_m=24.6, north_m=10.0, acceleration_east_m_s2=gain)
        assert {duty > 0.0 for duty in found} == {stays}


def test_what_opens_over_a_strip_that_comes_inside_is_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    blind(monkeypatch)
    # Outside by 5 cm now, inside when the flow comes.
    assert all(duties(made(), OPEN, east_m=-0.05))


def test_by_volume_the_border_is_left_to_the_volume(monkeypatch: pytest.MonkeyPatch) -> None:
    blind(monkeypatch)
    assert all(duties(made(border="volume"), OPEN, east_m=30.5, north_m=10.0))
    assert not any(duties(made(border="volume"), OPEN, east_m=15.0)[2:4])


@settings(max_examples=60)
@given(
    east_m=st.floats(-4.0, 34.0), north_m=st.floats(-24.0, 24.0), nose_deg=st.floats(0.0, 360.0),
    course_deg=st.floats(0.0, 360.0), yaw=st.floats(-120.0, 120.0), wait_s=st.floats(0.0, 0.3),
    most_m_s2=st.floats(0.1, 5.0),
)  # fmt: skip
def test_what_is_kept_is_inside_by_shapely(
    east_m: float, north_m: float, nose_deg: float, course_deg: float, yaw: float,
    wait_s: float, most_m_s2: float,
) -> None:  # fmt: skip
    course = math.radians(course_deg)
    state = flying(
        10.0, east_m, north_m, heading_deg=nose_deg, yaw_rate_deg_s=yaw,
        velocity_east_m_s=4.0 * math.sin(course), velocity_north_m_s=4.0 * math.cos(course),
    )  # fmt: skip
    over = boom(4)
    shut = [Flowing((k,), False, [(10.0 + wait_s, 0.5)], 0.1, 0.1) for k in range(4)]
    stands = standing(
        made().prescription, state, over, most_m_s2=most_m_s2, drift_m=None, within_s=0.6
    )
    found = stands.kept(shut)
    by_s = wait_s + 0.1
    nose = math.radians(nose_deg + yaw * by_s)
    for strip, count in zip(over.valves, found, strict=True):
        ends = [
            (east_m + 4.0 * by_s * math.sin(course) + side_m * math.cos(nose),
             north_m + 4.0 * by_s * math.cos(course) - side_m * math.sin(nose))
            for side_m in (strip.right_m - strip.width_m / 2, strip.right_m + strip.width_m / 2)
        ]  # fmt: skip
        reached = shapely.linestrings(ends).buffer(0.5 * most_m_s2 * by_s**2)
        if not FIELD.covers(reached):
            assert count == 0
        elif FIELD.covers(shapely.linestrings(ends).buffer(0.75 * most_m_s2 * by_s**2 + 1e-6)):
            assert count is None


@pytest.mark.parametrize("outlet", ["always", "valves"])
def test_a_pump_that_makes_the_edges_stops_and_starts_by_the_same_rule(
    outlet: PumpOutlet, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind(monkeypatch)
    over = pump_setup([20.0], outlet, border="inside", border_buffer_m=0.0)
    running = DrivePlan(fraction=0.5)
    for east_m, was, runs in (
        (15.0, running, True),
        (-3.0, running, False),
        (15.0, None, True),
        (-2.0, None, False),
    ):
        drives = (DrivePlan(fraction=0.0) if was is None else was,)
        before = SprayPlan(
            sequence=1, issued_s=9.9, duty=(1.0,) * 3, changes=(), lease_until_s=10.2,
            drives=drives,
        )  # fmt: skip
        decision, _ = step(over, flying(10.0, east_m), Memory(plan=before), 10.0)
        (drive,) = decision.plan.drives
        assert (drive.at(10.01) > 0.0) is runs, (east_m, was)


def test_a_change_of_rate_is_no_opening() -> None:
    assert Flowing((0,), True, [(1.0, 0.5), (2.0, 0.7)], 0.1, 0.1).opening() is None
    assert Flowing((0,), True, [(1.0, 0.0), (2.0, 0.7)], 0.1, 0.1).opening() == (1, 2.0)
    assert Flowing((0,), False, [(1.0, 0.5)], 0.1, 0.1).opening() == (0, 1.0)
