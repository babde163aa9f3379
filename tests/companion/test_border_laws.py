"""Nothing falls outside: no order crosses those of the border, whatever lags, map and way."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import shapely
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from shapely import Polygon

from companion.core.crossings import Crossing, Route
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.prescription import Prescription, Zone
from companion.core.schedule import LagModel, Overdrive, Timing, orders
from companion.core.setup import Setup
from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.pwm import PulseEngine
from tests.border_flight import Ground, Way, flows, spilled_by_valve
from tests.builders import CURVE, boom, setup

FLIGHTS = 3000 if os.environ.get("HYPOTHESIS_PROFILE") == "thorough" else 12
LENGTH_M = 30.0
FULL = FlowCurve(duty=CURVE.duty, flow_l_min=tuple(2.0 * flow for flow in CURVE.flow_l_min))
SHORT_LAG = LagModel(
    on_s=0.15, off_s=0.09, up_s=0.12, down_s=0.12, on_start_s=0.04, off_end_s=0.22, output_s=0.01
)


@st.composite
def lags(draw: st.DrawFn) -> LagModel:
    """Any lags: of valves, of a pump that is driven, and first flows far later than last ones."""
    short, long = st.floats(0.0, 0.3), st.floats(0.0, 2.0)
    on_start_s, off_s = draw(short), draw(short)
    up_s, down_s = draw(long), draw(long)
    is_slow = draw(st.booleans())
    return LagModel(
        on_s=on_start_s + draw(short), off_s=off_s, up_s=up_s, down_s=down_s,
        on_start_s=on_start_s, off_end_s=off_s + draw(short), output_s=draw(st.floats(0.0, 0.05)),
        up_time_s=0.7 * up_s * is_slow, down_time_s=0.7 * down_s * is_slow,
    )  # fmt: skip


# However they lean, nothing as narrow as what counts as a gap of the digitising, 2 cm.
WIDTHS_M = st.sampled_from([0.1, 0.1, 0.5, 1.0, 2.0, 5.0, 12.0])
RATES = st.sampled_from([None, 0.0, 2.0, 15.0, 20.0, 25.0, 40.0])


@st.composite
def grounds(draw: st.DrawFn) -> Ground:
    """Strips side by side, some of them missing, with holes and slivers cut out of them."""
    zones: list[tuple[Polygon, float]] = []
    east_m = 0.0
    south_m, north_m = draw(st.floats(-8.0, -1.0)), draw(st.floats(1.0, 8.0))
    lean_m = draw(st.floats(-6.0, 6.0))
    for width_m, rate in draw(st.lists(st.tuples(WIDTHS_M, RATES), min_size=1, max_size=4)):
        if rate is not None:
            south = [(east_m, south_m), (east_m + width_m, south_m)]
            north = [(east_m + width_m + lean_m, north_m), (east_m + lean_m, north_m)]
            zones.append((Polygon(south + north), rate))
        east_m += width_m
    if not zones:
        zones.append((shapely.box(0.0, south_m, 6.0, north_m), 20.0))
    place = st.tuples(st.floats(-2.0, 20.0), st.floats(-6.0, 6.0))
    holes = [
        shapely.Point(x, y).buffer(draw(st.sampled_from([0.05, 0.3, 1.5])), quad_segs=2)
        for x, y in draw(st.lists(place, max_size=2))
    ]
    for x, y in draw(st.lists(place, max_size=2)):
        wide_m = draw(st.sampled_from([0.01, 0.05, 0.3]))
        holes.append(shapely.box(x, y - 3.0, x + wide_m, y + 3.0))
    around_m = draw(st.sampled_from([None, None, 0.0, 0.03, 0.2, 1.0]))
    boundary = None
    if around_m is not None:
        boundary = shapely.union_all([polygon for polygon, _ in zones]).convex_hull
        boundary = boundary.buffer(around_m, join_style="mitre")
    return Ground(zones, holes, boundary)


@st.composite
def ways(draw: st.DrawFn, *, turn_deg_s: float = 0.0, gain: bool = False) -> Way:
    """Across the ground from the west, its nose anywhere that a boom still covers a strip."""
    course_deg = draw(st.one_of(st.just(90.0), st.floats(60.0, 120.0)))
    crab_deg = draw(st.one_of(st.just(0.0), st.floats(-60.0, 60.0)))
    if draw(st.booleans()):
        crab_deg += 180.0  # backwards
    speed_m_s = draw(st.floats(3.0, 8.0))
    if turn_deg_s:
        turn_deg_s = draw(st.floats(4.0, turn_deg_s)) * draw(st.sampled_from([-1, 1]))
    gain_m_s2 = draw(st.floats(-0.5, 1.0)) * speed_m_s**2 / LENGTH_M / 2.0 if gain else 0.0
    return Way(
        east_m=-6.0, north_m=draw(st.one_of(st.just(0.0), st.floats(-5.0, 5.0))),
        course_deg=course_deg, speed_m_s=speed_m_s, crab_deg=crab_deg,
        turn_deg_s=turn_deg_s, gain_m_s2=gain_m_s2,
    )  # fmt: skip


def made_of(ground: Ground, lag: LagModel, *, valves: int, **change: object) -> Setup:
    zones = [Zone(name=str(n), polygon=polygon, rate_l_ha=rate)
             for n, (polygon, rate) in enumerate(ground.zones)]  # fmt: skip
    every = tuple(range(valves))
    sets = (NozzleSet(valves=every, curve=CURVE),)
    if valves == 3:  # the outer one is closed where the rate is small
        sets = (NozzleSet(valves=every[:2], curve=CURVE), NozzleSet(valves=every, curve=FULL))
    given: dict[str, object] = {
        "prescription": Prescription(zones, boundary=ground.boundary, exclusions=ground.exclusions),
        "boom": boom(valves, width_m=0.9 * valves, forward_m=-0.4),
        "nozzle_sets": sets,
        "lag": lag,
    }
    return setup(**(given | change))


def spilled(ground: Ground, way: Way, angle_deg: float, made: Callable[[Ground], Setup]) -> object:
    """Return when something fell outside; way and ground are turned alike.

    So that edges are no round numbers, and meet by rounding.
    """
    here = ground.turned(angle_deg)
    return spilled_by_valve(
        made(here), here.allowed(), way.turned(angle_deg), LENGTH_M / way.speed_m_s
    )


@st.composite
def routes(draw: st.DrawFn) -> Route:
    """Any zones, closed ground and ground outside, in any order and however short."""
    at_s, made = 0.0, []
    for wait_s in draw(st.lists(st.floats(0.001, 1.5), min_size=1, max_size=10)):
        rate = draw(st.sampled_from([None, None, 0.0, 1.0, 15.0, 20.0, 30.0]))
        made.append(Crossing(at_s, rate, rate is None and draw(st.booleans()), 5.0))
        at_s += wait_s
    return tuple(made)


LEADS = st.floats(0.0, 2.5)
TIMINGS = st.builds(
    Timing, on_s=LEADS, off_s=LEADS, up_s=LEADS, down_s=LEADS, border_on_s=LEADS,
    border_off_s=LEADS, dwell_min_s=st.floats(0.02, 0.5),
)  # fmt: skip
DRIVES = st.one_of(
    st.none(),
    st.builds(
        Overdrive, up_time_s=LEADS, down_time_s=LEADS, duty_min=st.just(0.1),
        duty_max=st.just(1.0), flow_for=st.just(lambda duty: 10.0 * duty),
    ),
)  # fmt: skip


def dosing(rate_l_ha: float, speed_m_s: float) -> float:
    return rate_l_ha * speed_m_s / 200.0 if rate_l_ha >= 10.0 else 0.0


@given(route=routes(), timing=TIMINGS, overdrive=DRIVES)
def test_no_order_crosses_those_of_the_border_whatever_the_leads(
    route: Route, timing: Timing, overdrive: Overdrive | None
) -> None:
    made = orders(route, timing, dosing, overdrive)
    assert all(a.at_s < b.at_s for a, b in pairwise(made))
    spans = flows(made, first_s=timing.border_on_s, last_s=timing.border_off_s)
    ends = [*(crossing.at_s for crossing in route[1:]), math.inf]
    for number, (crossing, end_s) in enumerate(zip(route, ends, strict=True)):
        since_s = crossing.at_s if number else -math.inf
        for first_s, last_s in spans if crossing.outside else ():
            assert last_s <= since_s + 1e-9 or first_s >= end_s - 1e-9


PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)


@given(route=routes(), timing=TIMINGS, rest_max_s=st.floats(0.0, 0.1), phase=st.floats(0.0, 1.0))
def test_no_pulse_of_our_own_engine_reaches_over_the_border_that_opened_it_sooner(
    route: Route, timing: Timing, rest_max_s: float, phase: float
) -> None:
    timing = replace(timing, centred=PWM, rest_max_s=rest_max_s)
    first, *made = orders(route, timing, dosing)
    begin_s = min([0.0, *(order.at_s for order in made)]) - 1.0
    engine = PulseEngine(PWM, 1, start_s=begin_s - phase * PWM.period_s)
    changes = tuple(TimedChange(at_s=each.at_s, valve=0, duty=each.duty) for each in made)
    end_s = max([0.0, *(change.at_s for change in changes)]) + 1.0
    plan = SprayPlan(
        sequence=1, issued_s=begin_s, duty=(first.duty,), changes=changes, lease_until_s=end_s
    )
    engine.submit(plan, now_s=begin_s)
    edges = [(edge.at_s, edge.is_open) for edge in engine.advance(end_s + 1.0)]
    pulses = [(a, b) for (a, is_open), (b, _) in pairwise(edges) if is_open]
    ends = [*(crossing.at_s for crossing in route[1:]), math.inf]
    for number, (crossing, until_s) in enumerate(zip(route, ends, strict=True)):
        since_s = crossing.at_s if number else -math.inf
        for opened_s, closed_s in pulses if crossing.outside else ():
            is_before = closed_s + timing.border_off_s <= since_s + 1e-9
            assert is_before or opened_s + timing.border_on_s >= until_s - 1e-9


@given(route=routes(), timing=TIMINGS, overdrive=DRIVES)
def test_no_change_of_rate_opens_a_valve_over_ground_that_is_closed_inside_the_field(
    route: Route, timing: Timing, overdrive: Overdrive | None
) -> None:
    made = orders(route, timing, dosing, overdrive)
    ends = [*(crossing.at_s for crossing in route[1:]), math.inf]
    for number, (crossing, end_s) in enumerate(zip(route, ends, strict=True)):
        if crossing.rate_l_ha is None or not dosing(crossing.rate_l_ha, crossing.speed_m_s):
            begin_s = crossing.at_s - timing.off_s if number else -math.inf
            for order in made:
                if order.duty > 0.0:
                    assert not begin_s <= order.at_s < end_s - timing.on_s - 1e-9


# Smaller examples would take minutes to find, and tell no more.
FLOWN = settings(max_examples=FLIGHTS, phases=[Phase.explicit, Phase.generate])


@FLOWN
@given(
    ground=grounds(), way=ways(), lag=st.one_of(st.just(SHORT_LAG), lags()),
    valves=st.integers(1, 3), buffer_m=st.sampled_from([0.0, 0.0, 0.1]),
    angle_deg=st.floats(0.0, 360.0),
)  # fmt: skip
def test_nothing_falls_outside_on_any_straight_way_with_any_lags(
    ground: Ground, way: Way, lag: LagModel, valves: int, buffer_m: float, angle_deg: float
) -> None:
    assert not spilled(
        ground, way, angle_deg,
        lambda here: made_of(here, lag, valves=valves, border_buffer_m=buffer_m),
    )  # fmt: skip


@FLOWN
@given(ground=grounds(), way=ways(turn_deg_s=25.0), valves=st.integers(1, 3))
def test_nothing_falls_outside_in_a_turn(ground: Ground, way: Way, valves: int) -> None:
    # The buffer is for what a turn makes of a path that is foretold in chords.
    assert not spilled(
        ground, way, 0.0, lambda here: made_of(here, SHORT_LAG, valves=valves, border_buffer_m=0.3)
    )


@FLOWN
@given(ground=grounds(), way=ways(gain=True), valves=st.integers(1, 3), lag=lags())
def test_nothing_falls_outside_while_the_speed_changes(
    ground: Ground, way: Way, valves: int, lag: LagModel
) -> None:
    assert not spilled(
        ground, way, 0.0, lambda here: made_of(here, lag, valves=valves, border_buffer_m=0.1)
    )
