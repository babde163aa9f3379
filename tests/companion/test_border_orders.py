"""The border's orders are bounds: cases of those that crossed them, each with what it sprayed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import shapely

from companion.config.model import load
from companion.core.controller import Memory, step
from companion.core.crossings import Crossing, Route
from companion.core.options.lines import Lines
from companion.core.options.pump import PumpOutlet
from companion.core.prescription import Prescription, Zone
from companion.core.schedule import LagModel, Order, Overdrive, Timing, orders, schedule, shut_spans
from companion.core.setup import Setup
from companion.core.types import PwmLimits
from missions.maps.compiling import compiled_setup
from tests.border_flight import Way, flows, orders_of, pump_orders_of, spilled_by_valve, spilled_s
from tests.builders import plots, setup
from tests.pump_flight import PUMP_LAG, pump_setup

PUMP = Path(__file__).resolve().parents[2] / "examples" / "pump" / "config.toml"
EASTWARDS = {"north_m": 3.0, "course_deg": 90.0}


def rows_of(*zones: tuple[float, float]) -> Prescription:
    """Return zones (length, rate) in a row along the east, on ground that is wide enough."""
    made, east_m = [], 0.0
    for length_m, rate in zones:
        box = shapely.box(east_m, 0.0, east_m + length_m, 6.0)
        made.append(Zone(name=str(len(made)), polygon=box, rate_l_ha=rate))
        east_m += length_m
    return Prescription(made, boundary=shapely.box(0.0, -3.0, east_m, 9.0))


def pump_example(**change: object) -> Setup:
    built = compiled_setup(load(PUMP))
    short = rows_of((2.0, 15.0), (12.0, 20.0), (2.0, 15.0))
    return replace(built, **({"prescription": short, "border": "inside"} | change))  # type: ignore[arg-type]


@pytest.mark.parametrize("speed_m_s", [5.0, 6.0])
def test_the_pumps_example_opens_no_sooner_for_the_zone_behind_the_first(speed_m_s: float) -> None:
    # It began 0.77 and 2.05 m outside, over 6 m of boom: for the second zone, with its lead.
    made, way = pump_example(), Way(east_m=-20.0, speed_m_s=speed_m_s, **EASTWARDS)
    seconds = 45.0 / speed_m_s
    assert spilled_by_valve(made, shapely.box(0.0, -3.0, 16.0, 9.0), way, seconds) == []
    lag = made.lag
    (first_s, last_s), *more = flows(
        orders_of(made, way, seconds)[0],
        first_s=lag.output_s + lag.on_start_s, last_s=lag.output_s + lag.off_end_s,
    )  # fmt: skip
    assert more == []
    # And right behind the buffer, to the last metre.
    assert way.at(first_s)[0] == pytest.approx(0.1, abs=0.03)
    assert way.at(last_s)[0] == pytest.approx(15.9, abs=0.03)


def test_by_volume_too_it_opens_for_the_first_zone_only() -> None:
    made = pump_example(border="volume")
    found = orders_of(made, Way(east_m=-20.0, speed_m_s=6.0, **EASTWARDS), 7.0)[0]
    opens_s = next(at_s for at_s, duty in found if duty)
    assert opens_s == pytest.approx(20.0 / 6.0 - made.timing.on_s, abs=1e-3)


# Its first flow comes later than its last one ends.
LATE_LAG = LagModel(
    on_s=0.40, off_s=0.05, up_s=0.1, down_s=0.1, on_start_s=0.35, off_end_s=0.06, output_s=0.01
)
HOLE = shapely.box(20.0, -9.0, 20.5, 15.0)


@pytest.mark.parametrize("buffer_m", [0.0, 0.1])
def test_a_small_exclusion_is_not_sprayed_over_when_opening_takes_longer(buffer_m: float) -> None:
    # The opening behind it would be due before the closing ahead of it: neither was ordered.
    zones = plots([[20.0] * 4])
    ground = shapely.box(0.0, -3.0, 48.0, 9.0)
    made = setup(
        lag=LATE_LAG, border_buffer_m=buffer_m,
        prescription=Prescription(zones, boundary=ground, exclusions=[HOLE]),
    )  # fmt: skip
    way = Way(east_m=-10.0, speed_m_s=5.0, **EASTWARDS)
    assert spilled_by_valve(made, ground.difference(HOLE), way, 13.0) == []
    shut = [at_s for at_s, duty in orders_of(made, way, 13.0)[2] if not duty]
    assert len(shut) == 2


TIMING = Timing(
    on_s=0.41, off_s=0.06, up_s=1.9, down_s=1.4, border_on_s=0.36, border_off_s=0.07,
    dwell_min_s=0.09,
)  # fmt: skip


def dosing(rate_l_ha: float, speed_m_s: float) -> float:
    return rate_l_ha * speed_m_s / 200.0


def test_a_closing_that_is_over_before_it_begins_lasts_as_long_as_a_change() -> None:
    route = (
        Crossing(0.0, 20.0, False, 5.0), Crossing(2.0, None, True, 5.0),
        Crossing(2.1, 20.0, False, 5.0),
    )  # fmt: skip
    assert shut_spans(route, TIMING) == [pytest.approx((2.0 - 0.07, 2.0 - 0.07 + 0.09))]
    assert [order.duty for order in orders(route, TIMING, dosing)] == [0.5, 0.0, 0.5]


def test_ground_that_is_closed_inside_the_field_stays_so_for_a_change_behind_it() -> None:
    # The change from 20 to 30, due 1.9 s ahead of 3.2 s, opened the valve over the rate of 0.
    for closed in (0.0, None):
        route: Route = tuple(
            Crossing(at_s, rate, False, 5.0)
            for at_s, rate in ((0.0, 20.0), (2.0, closed), (3.0, 20.0), (3.2, 30.0))
        )
        found = [(order.at_s, order.duty) for order in orders(route, TIMING, dosing)[1:]]
        assert found == [(pytest.approx(2.0 - 0.06), 0.0), (pytest.approx(3.0 - 0.41), 0.75)]


def test_ground_closed_for_two_reasons_is_closed_for_the_border_whichever_comes_first() -> None:
    timing = replace(TIMING, on_s=0.2, off_s=0.08, border_on_s=0.05, border_off_s=0.3)
    for early_s in (1e-15, 1e-9, 0.05):
        route: Route = (
            Crossing(0.0, 20.0, False, 5.0), Crossing(2.0 - early_s, None, False, 5.0),
            Crossing(2.0, None, True, 5.0), Crossing(4.0, None, False, 5.0),
            Crossing(4.0 + early_s, 20.0, False, 5.0),
        )  # fmt: skip
        shut, opened = orders(route, timing, dosing)[1:]
        assert (shut.at_s, shut.duty) == (pytest.approx(2.0 - 0.3), 0.0)
        assert opened.at_s == pytest.approx(4.0 - 0.05)


@pytest.mark.parametrize("bare_m", [0.05, 0.4])
def test_ground_without_a_rate_does_not_hide_the_border_behind_it(bare_m: float) -> None:
    # By volume the valve would close 0.1 s before the bare ground; its last flow ends after 0.3 s.
    zone = Zone(name="1", polygon=shapely.box(0.0, -3.0, 12.0, 9.0), rate_l_ha=20.0)
    ground = shapely.box(0.0, -3.0, 12.0 + bare_m, 9.0)
    made = setup(
        lag=replace(LATE_LAG, on_start_s=0.1, on_s=0.15, off_s=0.1, off_end_s=0.3),
        border_buffer_m=0.0,
        prescription=Prescription([zone], boundary=ground),
    )
    way = Way(east_m=-10.0, speed_m_s=5.0, **EASTWARDS)
    assert spilled_by_valve(made, ground, way, 6.0) == []


CENTRED = replace(
    TIMING, on_s=0.41, rest_max_s=0.05,
    centred=PwmLimits(
        frequency_hz=10.0, duty_min=0.1, duty_max=0.9, min_on_s=0.01, min_off_s=0.01
    ),
)  # fmt: skip


@pytest.mark.parametrize(
    ("rate", "sooner_s"),
    [(20.0, 0.98 * 0.5 * 0.05), (4.0, 0.98 * 0.5 * 0.09), (0.4, 0.98 * 0.5 * 0.09), (38.0, 0.0)],
)
def test_a_pulse_that_stands_in_its_middle_opens_at_the_border_half_a_gap_sooner(
    rate: float, sooner_s: float
) -> None:
    # Duties of 0.5, 0.1, 0.01 (as long as the shortest pulse), and above the last: no gap at all.
    route = (Crossing(0.0, None, True, 5.0), Crossing(2.0, rate, False, 5.0))
    assert orders(route, CENTRED, dosing)[-1].at_s == pytest.approx(2.0 - 0.36 - sooner_s)
    assert orders(route, TIMING, dosing)[-1].at_s == pytest.approx(2.0 - 0.36)
    held = replace(CENTRED, rest_max_s=0.003)
    assert orders(route, held, dosing)[-1].at_s >= 2.0 - 0.363 - 1e-9


@pytest.mark.parametrize(
    ("after_s", "rate", "outside", "sooner"),
    [(0.2, 30.0, False, False), (0.2, None, True, False), (0.6, 30.0, False, True),
     (0.6, None, True, True)],
)  # fmt: skip
def test_it_opens_no_sooner_where_something_follows_that_makes_its_period_shorter(
    after_s: float, rate: float | None, outside: bool, sooner: bool
) -> None:
    timing = replace(CENTRED, up_s=0.36, border_off_s=0.36)
    route = (
        Crossing(0.0, None, True, 5.0), Crossing(2.0, 20.0, False, 5.0),
        Crossing(2.0 + after_s, rate, outside, 5.0),
    )  # fmt: skip
    opened = orders(route, timing, dosing)[1]
    assert opened.duty == 0.5
    assert (opened.at_s < 2.0 - 0.36 - 1e-9) is sooner


def test_it_opens_no_sooner_than_a_closing_takes() -> None:
    route = (
        Crossing(0.0, 20.0, False, 5.0), Crossing(2.0, None, True, 5.0),
        Crossing(2.1, 20.0, False, 5.0),
    )  # fmt: skip
    shut, opened = orders(route, replace(CENTRED, off_s=0.36, border_off_s=0.36), dosing)[1:]
    assert opened.at_s - shut.at_s == pytest.approx(CENTRED.dwell_min_s)


def test_a_valve_that_opens_at_the_border_is_not_driven_past_its_target() -> None:
    law = Overdrive(
        up_time_s=1.0, down_time_s=1.0, duty_min=0.0, duty_max=1.0, flow_for=lambda duty: duty
    )
    drive = law.between(0.5, 0.75)
    assert drive is not None
    # Between the opening by the volume, 0.41 s ahead of 2 s, and that of the border.
    timing = replace(TIMING, up_s=2.3 - 1.62 + drive.saved_s)
    route = (
        Crossing(0.0, None, True, 5.0), Crossing(2.0, 20.0, False, 5.0),
        Crossing(2.3, 30.0, False, 5.0),
    )  # fmt: skip
    assert orders(route, timing, dosing, law)[1:] == [
        Order(pytest.approx(2.0 - 0.36), 0.75, 30.0, bound=True)
    ]


# -------------------------------------------------------------------------- planned anew each step

OPENING: Route = (Crossing(0.0, None, True, 5.0), Crossing(2.0, 20.0, False, 5.0))


@pytest.mark.parametrize(("ahead_s", "stays"), [(0.015, True), (0.025, False)])
def test_what_opened_at_the_border_is_shut_again_when_it_was_more_than_a_moment_early(
    ahead_s: float, stays: bool
) -> None:
    # Inside the field noise leaves an issued change alone for 0.1 s: at 5 m/s half a metre.
    found = schedule(
        OPENING, valve=0, timing=TIMING, dosing=dosing, in_force=0.5, speed_soon_m_s=5.0,
        now_s=2.0 - 0.36 - ahead_s, until_s=2.0, sticky_border_s=0.02,
    )  # fmt: skip
    assert (found.changes == ()) is stays
    if not stays:
        assert [change.duty for change in found.changes] == [0.0, 0.5]


def test_a_short_closing_that_is_only_just_due_is_not_taken_for_done() -> None:
    route = (
        Crossing(0.0, 20.0, False, 5.0), Crossing(2.0, None, True, 5.0),
        Crossing(2.1, 20.0, False, 5.0),
    )  # fmt: skip
    found = schedule(
        route, valve=0, timing=TIMING, dosing=dosing, in_force=0.5, speed_soon_m_s=5.0,
        now_s=2.0 - 0.07 + 0.001, until_s=2.3, sticky_border_s=0.1,
    )  # fmt: skip
    assert [change.duty for change in found.changes] == [0.0, 0.5]


# ------------------------------------------------------------------------------------ its brothers


@pytest.mark.parametrize("speed_m_s", [3.0, 6.0])
def test_off_the_planned_lines_is_as_far_outside_as_beyond_the_border(speed_m_s: float) -> None:
    # The line begins at the second plot and ends inside the third.
    made = setup(
        lines=Lines(polylines=(((4.0, 3.0), (30.0, 3.0)),)),
        lag=replace(LATE_LAG, up_s=1.9, down_s=1.4),
        prescription=rows_of((5.0, 12.0), (19.0, 25.0), (5.0, 15.0), (9.0, 25.0)),
    )
    way = Way(east_m=-20.0, speed_m_s=speed_m_s, **EASTWARDS)
    memory, opened, now_s = Memory(), [], 0.0
    while way.at(now_s)[0] < 50.0:
        state = replace(way.state(now_s), mode="GUIDED")
        decision, memory = step(replace(made, limits=ANYHOW), state, memory, now_s)
        opened += [c for c in decision.plan.changes if c.at_s <= now_s + 0.05 and c.valve == 0]
        now_s += 0.05
    spans = flows([(c.at_s, c.duty) for c in opened], first_s=0.36, last_s=0.07)
    assert way.at(spans[0][0])[0] >= 4.0 - 1e-6
    assert way.at(spans[-1][1])[0] <= 30.0 + 1e-6
    assert way.at(spans[-1][1])[0] - way.at(spans[0][0])[0] > 24.0


ANYHOW = replace(setup().limits, modes=frozenset({"GUIDED"}))


@pytest.mark.parametrize("pump_way", ["valves", "return", "always"])
@pytest.mark.parametrize("speed_m_s", [4.0, 6.0])
def test_a_pump_with_sections_keeps_to_the_border_behind_short_zones(
    pump_way: PumpOutlet, speed_m_s: float
) -> None:
    # The east end slants: the sections leave one after the other.
    ground = shapely.Polygon([(0.0, -3.0), (16.0, -3.0), (13.0, 9.0), (-2.0, 9.0)])
    rows = rows_of((1.0, 15.0), (2.0, 22.0), (20.0, 15.0))
    assert not spilled_behind_pump(pump_way, rows, ground, speed_m_s)


def test_a_section_is_shut_for_the_border_where_a_rate_of_0_lies_before_it() -> None:
    rows = rows_of((10.0, 15.0), (0.5, 0.0))
    slow = replace(LATE_LAG, on_start_s=0.1, off_end_s=0.3)
    assert not spilled_behind_pump("return", rows, shapely.box(0.0, -3.0, 10.5, 9.0), 5.0, lag=slow)


def spilled_behind_pump(
    pump_way: PumpOutlet,
    rows: Prescription,
    ground: shapely.Polygon,
    speed_m_s: float,
    **lag: object,
) -> list[float]:
    """Return when a pump's flow came out of a strip that was partly outside."""
    made = pump_setup(
        [20.0], pump_way, border="inside", border_buffer_m=0.0,
        prescription=Prescription(rows.zones, boundary=ground), **lag,
    )  # fmt: skip
    way = Way(east_m=-25.0, speed_m_s=speed_m_s, **EASTWARDS)
    seconds = 45.0 / speed_m_s
    first_s, last_s = PUMP_LAG.on_start_s, PUMP_LAG.off_end_s
    pumped = flows(pump_orders_of(made, way, seconds), first_s=first_s, last_s=last_s)
    found: list[float] = []
    for strip, each in zip(made.boom.valves, orders_of(made, way, seconds), strict=True):
        spans = pumped
        if pump_way != "always":
            out_s = made.lag.output_s
            is_open = flows(
                each, first_s=out_s + made.lag.on_start_s, last_s=out_s + made.lag.off_end_s
            )
            spans = [(max(a, c), min(b, d)) for a, b in pumped for c, d in is_open
                     if min(b, d) > max(a, c)]  # fmt: skip
        assert spans
        found += spilled_s(
            ground, way, spans, right_m=strip.right_m, forward_m=strip.forward_m,
            half_m=strip.width_m / 2.0, until_s=seconds,
        )  # fmt: skip
    return found
