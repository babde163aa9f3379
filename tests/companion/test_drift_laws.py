"""What holds for every offset by wind: it is bounded, and it never opens ground at a border."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.crossings import Route, find_routes
from companion.core.frame import Offset
from companion.core.options.drift import Drift, landed, offset
from companion.core.prescription import Prescription, Zone
from companion.core.types import VehicleState, WindReport
from tests.builders import SPRAYING, along, boom, flying

ANY = st.floats(allow_nan=True, allow_infinity=True)
MAYBE = st.one_of(st.none(), ANY)
METRES = st.floats(-1.4, 1.4)
BACK_S, AHEAD_S = 0.3, 1.2

# A field with a bend, a ditch narrower than an offset and a pole narrower than a strip.
GROUND = shapely.Polygon(
    [(0, 0), (30, 0), (30, 18), (18, 18), (15, 9), (12, 18), (0, 18)],
    holes=[[(5, 5), (5.3, 5), (5.3, 16), (5, 16)], [(22, 6), (22.4, 6), (22.4, 6.4), (22, 6.4)]],
)
FIELD = Prescription(
    [
        Zone(name="w", polygon=shapely.box(0, 0, 16, 18), rate_l_ha=20.0),
        Zone(name="e", polygon=shapely.box(16, 0, 30, 18), rate_l_ha=25.0),
    ],
    boundary=GROUND,
)
BOOM = boom()


def routes(state: VehicleState, drift_m: Offset | None, buffer_m: float = 0.0) -> tuple[Route, ...]:
    if drift_m is not None:
        state = landed(state, drift_m)
    return find_routes(
        FIELD, state, BOOM, back_s=BACK_S, ahead_s=AHEAD_S, border="inside",
        border_buffer_m=buffer_m, across="centre", drift_m=drift_m,
    )  # fmt: skip


@st.composite
def flights(draw: st.DrawFn) -> VehicleState:
    course = draw(st.floats(0.0, 360.0))
    state = flying(10.0, draw(st.floats(-2.0, 32.0)), draw(st.floats(-2.0, 20.0)), **along(course))
    crab = draw(st.floats(-40.0, 40.0))
    return replace(
        state,
        heading_deg=(course + crab) % 360.0,
        yaw_rate_deg_s=draw(st.sampled_from([0.0, 0.0, 20.0, -35.0])),
    )


@given(
    wind=st.tuples(ANY, MAYBE, MAYBE, ANY),
    velocity=st.tuples(ANY, ANY),
    limit_m=st.floats(0.0, 3.0),
    now_s=ANY,
)
def test_no_offset_is_longer_than_its_limit(
    wind: tuple[float, float | None, float | None, float],
    velocity: tuple[float, float],
    limit_m: float,
    now_s: float,
) -> None:
    law = Drift(fall_s=0.8, limit_m=limit_m)
    speed, east, north, at_s = wind
    report = WindReport(received_s=at_s, speed_m_s=speed, east_m_s=east, north_m_s=north)
    state = replace(
        SPRAYING, wind=report, velocity_east_m_s=velocity[0], velocity_north_m_s=velocity[1]
    )
    found = offset(law, state, now_s)
    assert found is None or math.hypot(*found) <= limit_m * (1.0 + 1e-9)


@given(
    wind=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    course_deg=st.floats(0.0, 360.0),
    turned_deg=st.floats(0.0, 360.0),
)
def test_turning_the_world_turns_the_offset(
    wind: tuple[float, float], course_deg: float, turned_deg: float
) -> None:
    def offset_at(by_deg: float) -> complex:
        angle = math.radians(by_deg)
        east = wind[0] * math.cos(angle) + wind[1] * math.sin(angle)
        north = wind[1] * math.cos(angle) - wind[0] * math.sin(angle)
        report = WindReport(received_s=10.0, speed_m_s=1.0, east_m_s=east, north_m_s=north)
        state = flying(10.0, 6.0, wind=report, **along(course_deg + by_deg))
        found = offset(Drift(fall_s=0.8), state, 10.0)
        assert found is not None
        return complex(*found) * complex(math.cos(angle), math.sin(angle))

    assert abs(offset_at(turned_deg) - offset_at(0.0)) < 1e-9


def rate_at(route: Route, at_s: float) -> float | None:
    rate = route[0].rate_l_ha
    for crossing in route:
        if crossing.at_s <= at_s:
            rate = crossing.rate_l_ha
    return rate


def predicted(state: VehicleState, at_s: float) -> tuple[float, float, float]:
    """Return the reference's place on its chord; only for straight flights."""
    dt_s = at_s - state.time_s
    return (
        state.east_m + state.velocity_east_m_s * dt_s,
        state.north_m + state.velocity_north_m_s * dt_s,
        math.radians(state.heading_deg or 0.0),
    )


@settings(max_examples=80)
@given(state=flights(), drift_m=st.tuples(METRES, METRES))
def test_an_open_valve_has_no_outside_ground_between_nozzle_and_landing(
    state: VehicleState, drift_m: Offset
) -> None:
    state = replace(state, yaw_rate_deg_s=0.0)
    found = routes(state, drift_m)
    inner = GROUND.buffer(1e-6)
    for at_s in np.linspace(10.0 - BACK_S, 10.0 + AHEAD_S, 13).tolist():
        east_m, north_m, angle = predicted(state, at_s)
        for valve, route in zip(BOOM.valves, found, strict=True):
            if rate_at(route, at_s) is None:
                continue
            ends = [
                (
                    east_m + (valve.right_m + side) * math.cos(angle) + share * drift_m[0],
                    north_m - (valve.right_m + side) * math.sin(angle) + share * drift_m[1],
                )
                for side, share in ((-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0))
            ]
            assert shapely.MultiPoint(ends).convex_hull.within(inner)


@settings(max_examples=50)
@given(state=flights(), drift_m=st.tuples(METRES, METRES))
def test_the_offset_opens_nothing_that_would_be_closed_without_it(
    state: VehicleState, drift_m: Offset
) -> None:
    plain, moved = routes(state, None, 0.1), routes(state, drift_m, 0.1)
    for at_s in np.linspace(10.0 - BACK_S, 10.0 + AHEAD_S, 40).tolist():
        for one, other in zip(plain, moved, strict=True):
            if rate_at(one, at_s) is None:
                assert rate_at(other, at_s) is None


@settings(max_examples=50)
@given(state=flights())
def test_an_offset_of_nothing_changes_nothing(state: VehicleState) -> None:
    for one, other in zip(routes(state, None, 0.1), routes(state, (0.0, 0.0), 0.1), strict=True):
        assert [crossing.rate_l_ha for crossing in one] == [c.rate_l_ha for c in other]
        for mine, its in zip(one, other, strict=True):
            assert mine.outside == its.outside
            assert abs(mine.at_s - its.at_s) < 1e-9


@settings(max_examples=50)
@given(state=flights(), drift_m=st.tuples(METRES, METRES))
def test_an_open_valve_has_the_rate_of_where_its_liquid_lands(
    state: VehicleState, drift_m: Offset
) -> None:
    elsewhere = replace(state, east_m=state.east_m + drift_m[0], north_m=state.north_m + drift_m[1])
    for one, other in zip(routes(elsewhere, None), routes(state, drift_m), strict=True):
        for at_s in np.linspace(10.0, 10.0 + AHEAD_S, 20).tolist():
            rate = rate_at(other, at_s)
            assert rate is None or rate == rate_at(one, at_s)
