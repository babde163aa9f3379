"""Laws that hold for every state, every map and every place on earth."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.controller import Memory, step
from companion.core.crossings import find_routes
from companion.core.frame import LocalFrame, look_ahead_point
from companion.core.nozzle import FlowCurve, allowed_duty, flow_for_rate
from companion.core.prescription import Prescription, Zone
from companion.core.types import Fix, PwmLimits, VehicleState
from tests.builders import CURVE, SPRAYING, along, boom, flying, setup

ANY = st.floats(allow_nan=True, allow_infinity=True)
MAYBE = st.one_of(st.none(), ANY)
SETUP = setup()


@st.composite
def near_the_reference(draw: st.DrawFn) -> VehicleState:
    """A state that may spray, with a few fields replaced by anything."""
    fields: dict[str, st.SearchStrategy[object]] = {
        "east_m": ANY,
        "north_m": ANY,
        "velocity_east_m_s": ANY,
        "velocity_north_m_s": ANY,
        "acceleration_east_m_s2": st.floats(-5, 5),
        "heading_deg": MAYBE,
        "yaw_rate_deg_s": st.floats(-90, 90),
        "height_m": ANY,
        "velocity_known": st.booleans(),
        "position_received_s": ANY,
        "position_valid": st.booleans(),
        "checked_speed_m_s": MAYBE,
        "fix": st.one_of(st.none(), st.sampled_from(Fix)),
        "estimator_healthy": st.one_of(st.none(), st.booleans()),
        "heartbeat_received_s": MAYBE,
        "armed": st.booleans(),
        "mode": st.sampled_from(["AUTO", "LOITER", None]),
        "in_air": st.sampled_from([True, False, None]),
        "wind_m_s": MAYBE,
        "output_healthy": st.booleans(),
        "enabled": st.booleans(),
    }
    chosen = draw(st.lists(st.sampled_from(sorted(fields)), max_size=3, unique=True))
    return replace(SPRAYING, **{name: draw(fields[name]) for name in chosen})  # type: ignore[arg-type]


@given(state=st.one_of(st.none(), near_the_reference()), now_s=st.floats(9.9, 11.5))
def test_any_inhibit_closes_every_valve_and_every_plan_expires(
    state: VehicleState | None, now_s: float
) -> None:
    decision, _ = step(SETUP, state, Memory(), now_s)
    if decision.inhibits:
        assert decision.plan.is_off
    assert all(0.0 <= change.duty <= 1.0 for change in decision.plan.changes)
    assert now_s < decision.plan.lease_until_s <= now_s + 0.5
    assert all(now_s <= change.at_s < decision.plan.lease_until_s
               for change in decision.plan.changes)  # fmt: skip


@given(
    flows=st.lists(st.floats(0.5, 50.0), min_size=3, max_size=8, unique=True),
    one=st.floats(0.0, 60.0),
    more=st.floats(0.0, 20.0),
)
def test_duty_never_falls_when_flow_rises(flows: list[float], one: float, more: float) -> None:
    flows = sorted(flows)
    if min(b - a for a, b in itertools.pairwise(flows)) < 1e-3:
        return
    curve = FlowCurve(
        duty=tuple(np.linspace(0.2, 1.0, len(flows)).tolist()), flow_l_min=tuple(flows)
    )
    assert curve.duty_for(one) <= curve.duty_for(one + more) + 1e-12


@given(flow=st.floats(1.476, 6.096))
def test_flow_of_the_duty_of_a_flow_is_that_flow(flow: float) -> None:
    assert CURVE.flow_for(CURVE.duty_for(flow)) == pytest.approx(flow, rel=1e-12)


@given(duty=st.floats(0.0, 1.0))
def test_an_allowed_duty_is_one_that_the_valve_can_follow(duty: float) -> None:
    pwm = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
    held = allowed_duty(duty, pwm)
    assert held == 0.0 or pwm.duty_min <= held <= 1.0
    assert held == duty or abs(held - duty) <= 0.1 + 1e-12
    assert held == duty or not pwm.duty_min <= duty <= 1.0


@given(
    rate=st.floats(1, 300), speed=st.floats(0.5, 15), width=st.floats(0.5, 30), s=st.floats(1, 99)
)
def test_flow_times_time_equals_rate_times_area(
    rate: float, speed: float, width: float, s: float
) -> None:
    litres = flow_for_rate(rate, speed, width) * s / 60.0
    assert litres == pytest.approx(rate * (speed * s * width) / 10_000.0)


@given(
    latitude=st.floats(-75, 75),
    longitude=st.floats(-179, 179),
    east=st.floats(-5000, 5000),
    north=st.floats(-5000, 5000),
)
def test_degrees_to_metres_and_back_is_below_a_millimetre(
    latitude: float, longitude: float, east: float, north: float
) -> None:
    frame = LocalFrame(latitude, longitude)
    again = frame.to_local(*frame.to_geographic(east, north))
    assert again == pytest.approx((east, north), abs=1e-3)


@given(latitude=st.floats(-70, 70), course=st.floats(0, 360), distance=st.floats(0.1, 30))
def test_the_geodesic_look_ahead_is_the_straight_line_of_the_frame(
    latitude: float, course: float, distance: float
) -> None:
    frame = LocalFrame(latitude, 10.0)
    ahead = look_ahead_point(latitude, 10.0, course_deg=course, distance_m=distance)
    east, north = frame.to_local(*ahead)
    # PROJ keeps the frame's origin to 1e-9 degrees, 0.11 mm.
    assert east == pytest.approx(distance * math.sin(math.radians(course)), abs=2.5e-4)
    assert north == pytest.approx(distance * math.cos(math.radians(course)), abs=2.5e-4)


def turned(x: float, y: float, angle_deg: float, shift: tuple[float, float]) -> tuple[float, float]:
    """Turn a point clockwise about the origin, then shift it."""
    angle = math.radians(angle_deg)
    return (
        x * math.cos(angle) + y * math.sin(angle) + shift[0],
        y * math.cos(angle) - x * math.sin(angle) + shift[1],
    )


@settings(max_examples=60)
@given(
    angle=st.floats(0, 360),
    shift=st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)),
    east=st.floats(-3, 51),
    north=st.floats(1.5, 4.5),
    course=st.floats(60, 120),
)
def test_rotating_and_shifting_the_world_changes_no_plan(
    angle: float, shift: tuple[float, float], east: float, north: float, course: float
) -> None:
    here = flying(10.0, east, north, **along(course))  # type: ignore[arg-type]
    there_east, there_north = turned(east, north, angle, shift)
    there = flying(10.0, there_east, there_north, **along(course + angle))  # type: ignore[arg-type]

    def move(polygon: shapely.Polygon) -> shapely.Polygon:
        return shapely.Polygon([turned(x, y, angle, shift) for x, y in polygon.exterior.coords])

    moved = Prescription(
        [replace(zone, polygon=move(zone.polygon)) for zone in SETUP.prescription.zones],  # type: ignore[arg-type]
        boundary=move(SETUP.prescription.field),  # type: ignore[arg-type]
    )
    a, _ = step(SETUP, here, Memory(), 10.0)
    b, _ = step(setup(prescription=moved), there, Memory(), 10.0)
    assert len(a.plan.changes) == len(b.plan.changes)
    for one, other in zip(
        sorted(a.plan.changes, key=lambda c: (c.valve, c.at_s)),
        sorted(b.plan.changes, key=lambda c: (c.valve, c.at_s)),
        strict=True,
    ):
        assert one.valve == other.valve
        assert one.duty == pytest.approx(other.duty, abs=1e-9)
        assert one.at_s == pytest.approx(other.at_s, abs=1e-6)


def random_cells(seed: int, count: int = 40) -> tuple[Prescription, list[Zone]]:
    """A field split into Voronoi cells with a rate each: boundaries at any angle."""
    rng = np.random.default_rng(seed)
    points = shapely.MultiPoint(rng.uniform(0, 60, (count, 2)))
    frame = shapely.box(0, 0, 60, 60)
    cells = shapely.get_parts(shapely.voronoi_polygons(points, extend_to=frame))
    zones = [
        Zone(name=str(i), polygon=shapely.intersection(cell, frame), rate_l_ha=10.0 + i)
        for i, cell in enumerate(cells)
        if shapely.area(shapely.intersection(cell, frame)) > 0.0
    ]
    return Prescription(zones, boundary=shapely.box(-5, -5, 65, 65)), zones


@settings(max_examples=80)
@given(
    seed=st.integers(0, 10_000),
    east=st.floats(5, 55),
    north=st.floats(5, 55),
    course=st.floats(0, 360),
)
def test_crossings_are_those_of_an_independent_intersection(
    seed: int, east: float, north: float, course: float
) -> None:
    field, zones = random_cells(seed)
    state = flying(10.0, east, north, **along(course))  # type: ignore[arg-type]
    routes = find_routes(
        field, state, boom(), back_s=0.3, ahead_s=2.0, border="inside", border_buffer_m=0.1,
        across="centre",
    )  # fmt: skip
    forward = np.array([math.sin(math.radians(course)), math.cos(math.radians(course))])
    right = np.array([forward[1], -forward[0]])
    for valve, route in zip(boom().valves, routes, strict=True):
        start = np.array([east, north]) + right * valve.right_m - forward * 5.0 * 0.3
        line = shapely.LineString([start, start + forward * 5.0 * 2.3])
        expected = []
        shortest = 1.0
        for zone in zones:
            for part in shapely.get_parts(shapely.intersection(line, zone.polygon)):
                if part.length > 0.0:
                    shortest = min(shortest, part.length)
                    begins = line.project(shapely.Point(part.coords[0]))
                    expected.append((begins, zone.rate_l_ha))
        expected.sort()
        merged = [(s, rate) for s, rate in expected if s > 1e-6]
        found = [((c.at_s - 9.7) * 5.0, c.rate_l_ha) for c in route[1:]]
        inside = [pair for pair in found if pair[1] is not None]
        short = any(b - a < 0.05 for (a, _), (b, _) in itertools.pairwise(merged))
        if short or shortest < 0.05:
            continue  # slivers are merged on purpose
        assert len(inside) == len(merged)
        for (s, rate), (want_s, want) in zip(inside, merged, strict=True):
            assert rate == want
            assert s == pytest.approx(want_s, abs=1e-6)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    east=st.floats(-8, 68),
    north=st.floats(-8, 68),
    course=st.floats(0, 360),
)
def test_no_valve_is_prescribed_anything_while_its_strip_touches_the_outside(
    seed: int, east: float, north: float, course: float
) -> None:
    rng = np.random.default_rng(seed)
    hole = shapely.Point(rng.uniform(10, 50, 2)).buffer(rng.uniform(0.3, 8), quad_segs=3)
    ground = shapely.difference(shapely.box(0, 0, 60, 60), hole)
    zone = Zone(name="all", polygon=ground, rate_l_ha=20.0)
    field = Prescription([zone])
    state = flying(10.0, east, north, **along(course))  # type: ignore[arg-type]
    routes = find_routes(
        field, state, boom(), back_s=0.3, ahead_s=1.5, border="inside", border_buffer_m=0.05,
        across="centre",
    )  # fmt: skip
    forward = np.array([math.sin(math.radians(course)), math.cos(math.radians(course))])
    right = np.array([forward[1], -forward[0]])
    for valve, route in zip(boom().valves, routes, strict=True):
        for now_s in np.linspace(9.71, 11.49, 60):
            middle = np.array([east, north]) + right * valve.right_m + forward * 5 * (now_s - 10)
            half = right * (valve.width_m / 2)
            strip = shapely.LineString([middle - half, middle + half])
            rate = [c.rate_l_ha for c in route if c.at_s <= now_s][-1]
            if not ground.contains(strip):
                assert rate is None
            elif shapely.distance(strip, ground.exterior) > 0.2 and (
                shapely.distance(strip, hole) > 0.2
            ):
                assert rate == 20.0


@settings(max_examples=60)
@given(
    seed=st.integers(0, 10_000),
    xs=st.lists(st.floats(0.01, 59.99), min_size=5, max_size=5),
    ys=st.lists(st.floats(0.01, 59.99), min_size=5, max_size=5),
)
def test_every_point_of_the_field_has_exactly_one_rate_and_no_point_outside_any(
    seed: int, xs: list[float], ys: list[float]
) -> None:
    _, zones = random_cells(seed)
    field = Prescription(zones)
    for zones_here in field.zones_at(np.array(xs), np.array(ys)):
        assert len(zones_here) == 1
    outside = field.rates_at(np.array(xs) + 60.0, np.array(ys))
    assert np.isnan(outside).all()
