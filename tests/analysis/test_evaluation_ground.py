"""What fell where: borders, off target, gaps and overlaps, misapplied volume, zones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from shapely import Polygon, box

from analysis.border import BorderCrossing, margin_bound_m
from analysis.evaluation import evaluate, limit_ratio
from analysis.flight_record import FlightRecord
from companion.core.prescription import Prescription
from companion.core.types import TimedChange
from tests.analysis.test_evaluation_flights import PERIOD_S, SWATH_M, Flight, field_of, record_of

FIELD = Flight(rates=[[20.0, 26.0, 20.0, 14.0], [20.0, 14.0, 26.0, 18.0]], valves=6)
STRIP_M = SWATH_M / 6


def test_a_perfect_flight_misapplies_nothing_and_leaves_no_gap() -> None:
    evaluation = evaluate(record_of(FIELD)[0])
    assert evaluation.misapplied_percent == pytest.approx(0.0, abs=1e-3)
    assert evaluation.gap_m2 == pytest.approx(0.0, abs=1e-3)
    assert evaluation.overlap_m2 == pytest.approx(0.0, abs=1e-3)
    assert evaluation.volume_error_percent == pytest.approx(0.0, abs=1e-3)


def test_a_lag_misapplies_its_length_times_the_steps() -> None:
    flight = Flight(rates=[[20.0, 26.0, 20.0, 26.0]], valves=2, lag_m=lambda _: 1.5)
    # Longer than the averaging of one period: three steps of 6 L/ha over 1.5 m of 4 x 12 m.
    expected = 100.0 * 3 * 6.0 * 1.5 / (2 * (20.0 + 26.0) * 12.0)
    assert evaluate(record_of(flight)[0]).misapplied_percent == pytest.approx(expected, rel=0.01)


def test_too_much_everywhere_is_misapplied_and_is_the_volume_error() -> None:
    evaluation = evaluate(record_of(replace(FIELD, scale=1.03))[0])
    assert evaluation.misapplied_percent == pytest.approx(3.0, abs=0.01)
    assert evaluation.volume_error_percent == pytest.approx(3.0, abs=0.01)
    assert evaluation.lag_distance_m.mean_abs < 0.002


def test_the_volume_error_of_a_zone_tells_which_zone_got_too_little() -> None:
    flight = Flight(rates=[[20.0, 26.0, 20.0]], valves=2, lag_m=lambda n: 1.2 if n == 0 else 0.0)
    evaluation = evaluate(record_of(flight)[0])
    errors = evaluation.zone_volume_error_percent
    assert set(errors) == {"0-0", "0-1", "0-2"}
    assert errors["0-1"] == pytest.approx(-100.0 * 1.2 * 6.0 / (12.0 * 26.0), abs=0.02)
    assert errors["0-0"] == pytest.approx(0.0, abs=0.02)


def test_volume_in_a_zone_without_a_rate_is_misapplied() -> None:
    flight = Flight(rates=[[20.0, 0.0, 20.0]], valves=1, lag_m=lambda n: 2.0 if n == 0 else 0.0)
    evaluation = evaluate(record_of(flight)[0])
    assert evaluation.misapplied_percent == pytest.approx(100.0 * 2.0 / 24.0, rel=0.02)
    assert evaluation.overlap_m2 == pytest.approx(2.0 * SWATH_M, rel=0.01)


def test_the_limit_ratio_compares_two_flights() -> None:
    late = evaluate(record_of(replace(FIELD, scale=1.03))[0])
    perfect = evaluate(record_of(replace(FIELD, scale=1.01))[0])
    assert limit_ratio(late, perfect) == pytest.approx(3.0, rel=0.01)


@pytest.mark.parametrize("border_m", [0.25, 1.0])
def test_spray_that_keeps_off_the_border_shows_its_margin(border_m: float) -> None:
    evaluation = evaluate(record_of(replace(FIELD, border_m=border_m))[0])
    assert evaluation.border_margin_m.count == 6 * 2 * 2
    assert evaluation.border_margin_m.min == pytest.approx(border_m, abs=0.011)
    assert evaluation.off_target_ml == 0.0
    assert evaluation.gap_m2 == pytest.approx(4 * SWATH_M * border_m, rel=0.01)


def crossing(kind: str, delay_s: float | None, valve: int = 0) -> BorderCrossing:
    return BorderCrossing(
        valve=valve,
        kind=kind,  # type: ignore[arg-type]
        time_s=0.0,
        margin_m=0.2,
        speed_m_s=5.0,
        delay_s=delay_s,
    )


def test_the_bound_of_the_margin_is_what_the_slowest_closing_and_quickest_opening_ask_for() -> None:
    closing = [crossing("closing", delay_s) for delay_s in (0.10, 0.12, 0.14)]
    # The slowest decides: 5 m/s times (0.04, 0.02, 0) s.
    assert margin_bound_m(closing, position_sd_m=0.0) == pytest.approx(0.1)
    opening = [crossing("opening", delay_s) for delay_s in (0.10, 0.10, 0.16)]
    assert margin_bound_m(opening, position_sd_m=0.0) == pytest.approx(0.1)
    # Valves that differ are known to differ; what scatters is each by itself.
    steady = [crossing("closing", 0.1 + 0.05 * valve, valve) for valve in (0, 1) for _ in range(3)]
    assert margin_bound_m(steady, position_sd_m=0.0) == 0.0
    assert margin_bound_m(steady, position_sd_m=0.02) == pytest.approx(0.0466)
    assert margin_bound_m(closing, position_sd_m=0.02) == pytest.approx(math.hypot(0.1, 0.0466))
    assert margin_bound_m(closing[:2], position_sd_m=0.02) is None
    assert margin_bound_m([crossing("closing", None)] * 3, position_sd_m=0.02) is None


def test_delays_are_from_the_order_to_the_flow() -> None:
    record, _ = record_of(replace(FIELD, border_m=0.25))
    flown = evaluate(replace(record, orders=()))
    assert flown.border_bound_m is None
    orders = []
    for each in flown.crossings:
        duty = 0.5 if each.kind == "opening" else 0.0
        orders.append(TimedChange(at_s=flow_s(each, record) - 0.1, valve=each.valve, duty=duty))
    orders.sort(key=lambda order: order.at_s)
    found = evaluate(replace(record, orders=tuple(orders)))
    assert [each.delay_s for each in found.crossings] == pytest.approx(
        [0.1] * len(found.crossings), abs=0.005
    )
    entry = found.as_json()["border_margin_m"]
    assert isinstance(entry, dict)
    assert entry["bound"] == found.border_bound_m


def flow_s(each: BorderCrossing, record: FlightRecord) -> float:
    """Return when the flow of a crossing begins or ends."""
    flows = np.diff(record.volume_ml[:, each.valve]) > 1e-9
    edges = np.flatnonzero(np.diff(flows.astype(int))) + 1
    times_s = record.time_s[edges]
    return float(times_s[np.argmin(np.abs(times_s - each.time_s))])


def test_spray_beyond_the_border_is_off_target_to_the_millilitre() -> None:
    evaluation = evaluate(record_of(replace(FIELD, border_m=-0.5))[0])
    dose_ml_m = sum((20.0, 14.0, 18.0, 20.0)) * SWATH_M * 0.1
    assert evaluation.off_target_ml == pytest.approx(0.5 * dose_ml_m, rel=0.01)
    assert evaluation.border_margin_m.mean == pytest.approx(-0.5, abs=0.011)
    assert evaluation.overlap_m2 == pytest.approx(4 * SWATH_M * 0.5, rel=0.01)


def test_a_hole_counts_as_border_to_its_exact_edge() -> None:
    flight = Flight(rates=[[20.0, 20.0, 20.0]], valves=6)
    record, _ = record_of(flight)
    hole = box(14.0, 1.2, 18.0, 2.45)
    zones = field_of(flight.rates).zones
    holed = replace(record, prescription=Prescription(zones, exclusions=[hole]))
    # Sprayed straight across: the hole's area, elements being 0.1 m wide (1.2 to 2.5 across).
    elements_m = 1.2, 2.5
    expected = 20.0 * 0.1 * (elements_m[1] - elements_m[0]) * 4.0
    assert evaluate(holed).off_target_ml == pytest.approx(expected, rel=0.01)
    assert evaluate(record).off_target_ml == pytest.approx(0.0, abs=0.2)


def test_the_margin_is_measured_from_the_first_contact_at_an_oblique_border() -> None:
    flight = Flight(rates=[[20.0, 20.0, 20.0]], valves=2, border_m=6.0)
    record, _ = record_of(flight)
    # The east border runs from (36, 0) to (30, 6): half a strip is 1.5 m across, 1.5 m along.
    boundary = Polygon([(0, 0), (36, 0), (30, 6), (0, 6)])
    prescription = Prescription(field_of(flight.rates).zones, boundary=boundary)
    closings = {
        crossing.valve: crossing.margin_m
        for crossing in evaluate(replace(record, prescription=prescription)).crossings
        if crossing.kind == "closing"
    }
    # Valve 0 is the left one, north: its strip from 3 to 6 m first touches at (30, 6).
    assert closings[0] == pytest.approx(0.0, abs=0.02)
    assert closings[1] == pytest.approx(3.0, abs=0.02)


def test_flying_along_a_border_is_no_crossing() -> None:
    record, _ = record_of(Flight(rates=[[20.0, 20.0, 20.0]], valves=6, border_m=0.2))
    drift_m = 0.08 * np.sin(record.time_s * 3.0)
    evaluation = evaluate(replace(record, north_m=record.north_m + drift_m))
    assert evaluation.border_margin_m.count == 12
    assert evaluation.border_margin_m.min == pytest.approx(0.2, abs=0.03)
    # An outermost element of 0.1 m is over the border whenever its middle is.
    assert 0.0 < evaluation.off_target_ml < 0.02 * evaluation.applied_ml


def test_a_switch_that_never_came_leaves_its_whole_stretch_out() -> None:
    flight = Flight(rates=[[20.0, 0.0, 26.0]], valves=3, ignore=frozenset({1}))
    evaluation = evaluate(record_of(flight)[0])
    middle = [switch for switch in evaluation.switches if switch.valve == 1]
    assert sum(switch.gap_m2 for switch in middle) >= 12.0 * SWATH_M / 3
    # On and off again; the outer strips touch the border and may have been held closed for it.
    assert evaluation.missed == 2


def test_spraying_accuracy_of_a_constant_error_is_that_error() -> None:
    evaluation = evaluate(record_of(replace(FIELD, rates=[[20.0] * 4] * 2, scale=0.95))[0])
    # The ends of each pass lie within half a period of the borders.
    assert evaluation.settled_accuracy_percent == pytest.approx(95.0, abs=0.2)
    assert evaluation.spraying_accuracy_percent == pytest.approx(95.0, abs=0.5)


def test_accuracy_follows_the_actual_speed() -> None:
    flight = replace(FIELD, rates=[[20.0] * 4] * 2, ripple_m_s=0.4)
    assert evaluate(record_of(flight)[0]).settled_accuracy_percent == pytest.approx(100.0, abs=0.1)


def test_short_zones_have_no_settled_accuracy() -> None:
    assert evaluate(record_of(FIELD)[0]).settled_accuracy_percent is None


def test_a_late_start_shows_in_the_starting_accuracy_most() -> None:
    flight = Flight(rates=[[20.0] * 6], valves=2, border_m=1.5)
    evaluation = evaluate(record_of(flight)[0])
    # 1.5 m of 15 m at no flow.
    assert evaluation.starting_accuracy_percent == pytest.approx(90.0, abs=0.5)
    assert evaluation.spraying_accuracy_percent > evaluation.starting_accuracy_percent


def test_p1s_lag_distance_is_where_the_flow_settles() -> None:
    flight = Flight(rates=[[20.0, 26.0, 20.0, 26.0]], valves=2, rise_m=2.0, lag_m=lambda _: 1.0)
    settled = evaluate(record_of(flight)[0]).settled_lag_distance_m
    # The ramp ends at 2 m; the last 10 % of the step are its last 0.2 m.
    assert settled.mean == pytest.approx(1.8, abs=0.05)
    assert settled.count == 3


def test_p1s_lag_distance_forgives_a_flow_that_settles_beside_its_target() -> None:
    flight = Flight(rates=[[20.0, 26.0, 20.0, 26.0]], valves=2, lag_m=lambda _: 1.0, scale=1.04)
    evaluation = evaluate(record_of(flight)[0])
    # One period's mean reaches 90 % of a sharp step 0.4 periods later.
    expected_m = 1.0 + 0.4 * PERIOD_S * 5.0
    assert evaluation.settled_lag_distance_m.mean == pytest.approx(expected_m, abs=0.02)


def test_p1s_lag_distance_counts_what_never_settles() -> None:
    flight = Flight(rates=[[20.0, 26.0, 20.0]], valves=2)
    record, _ = record_of(flight)
    wobble = 1.0 + 0.2 * np.sin(record.time_s * 20.0)
    volume_ml = np.cumsum(np.diff(record.volume_ml, axis=0, prepend=0.0) * wobble[:, None], axis=0)
    evaluation = evaluate(replace(record, volume_ml=volume_ml))
    assert evaluation.settled_lag_distance_m.count == 0
    assert evaluation.settled_missed == 2


def test_a_boom_askew_to_the_motion_covers_less_and_is_asked_for_less() -> None:
    record, _ = record_of(Flight(rates=[[20.0, 26.0, 20.0]], valves=1, scale=0.5))
    askew = evaluate(replace(record, heading_deg=record.heading_deg + 60.0))
    assert askew.volume_error_percent == pytest.approx(0.0, abs=0.01)
    assert evaluate(record).volume_error_percent == pytest.approx(-50.0, abs=0.01)
