"""Everything of one call: intervals, tables, cells, causes, balance, durations."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import shapely
import shapely.affinity
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.assess.assessment import Assessment, _no_less_than_0, assess, balance_of
from analysis.assess.breakdowns import speed_bin
from analysis.assess.causes import Cause
from analysis.assess.cell_maps import cell_maps
from analysis.assess.ground import ground_of, treated_of
from analysis.flown.applied_flight import Series
from analysis.flown.applied_record import record_of
from analysis.strips import strips_of
from analysis.student import (
    NOTHING,
    Interval,
    crossings_of,
    mean_interval,
    ratio_interval,
    t_factor,
)
from companion.core.cells import CellGrid, Warp
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.journal.writer import Event
from tests.analysis.applied_flights import SPEED_M_S, changes_of, eastwards
from tests.builders import plots, setup

WIDE = shapely.box(-30.0, -30.0, 90.0, 40.0)


@pytest.fixture(scope="module")
def good() -> Assessment:
    return assess(eastwards())


def rows_of_plots(rows: int, **change: object) -> Setup:
    """Return the set-up with so many rows of the same plots, and a field that ends with them."""
    zones = plots([[20.0, 25.0, 15.0, 20.0]] * rows)
    field = shapely.box(0.0, -0.5, 48.0, 6.0 * rows + 0.5)
    return setup(prescription=Prescription(zones, boundary=field), **change)


# ----------------------------------------------------------------------------------- intervals


def test_an_interval_is_that_of_the_cluster_means_where_clusters_are_alike() -> None:
    values = np.array([1.0, 2.0, 4.0, 5.0])
    found = mean_interval(values, np.arange(4))
    half = t_factor(3) * float(values.std(ddof=1)) / math.sqrt(4)
    assert found.mean == 3.0
    assert (found.high or 0.0) - 3.0 == pytest.approx(half)
    assert 3.0 - (found.low or 0.0) == pytest.approx(half)


@given(st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=20), st.integers(2, 6))
def test_valves_that_say_the_same_make_no_interval_narrower(
    values: list[float], valves: int
) -> None:
    each = np.array(values)
    one = mean_interval(each, np.arange(len(each)))
    all_valves = mean_interval(np.repeat(each, valves), np.repeat(np.arange(len(each)), valves))
    assert all_valves.count == valves * one.count
    assert all_valves.clusters == one.clusters
    assert all_valves.low == pytest.approx(one.low, abs=1e-9)
    assert all_valves.high == pytest.approx(one.high, abs=1e-9)


def test_one_cluster_has_a_mean_and_no_interval_and_nothing_has_neither() -> None:
    one = mean_interval(np.array([1.0, 3.0]), np.array([7, 7]))
    assert (one.mean, one.low, one.high, one.count, one.clusters) == (2.0, None, None, 2, 1)
    assert mean_interval(np.zeros(0), np.zeros(0, dtype=np.int64)).mean is None
    assert ratio_interval(np.ones(2), np.zeros(2), np.arange(2)).mean is None


def test_intervals_hold_the_truth_nineteen_times_in_twenty() -> None:
    chance = np.random.default_rng(3)
    held = 0
    for _ in range(400):
        shared = chance.normal(0.0, 1.0, 12)
        values = np.repeat(shared, 6) + chance.normal(0.0, 0.3, 72)
        found = mean_interval(values, np.repeat(np.arange(12), 6))
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 0.0 <= found.high
    assert 0.92 <= held / 400 <= 0.98


def test_a_crossing_ends_after_a_pause_and_after_a_second() -> None:
    assert crossings_of(np.array([0.0, 0.2, 0.4, 0.7])).tolist() == [0, 0, 0, 1]
    chain = crossings_of(np.arange(0.0, 3.0, 0.2))
    assert chain.max() >= 2


def test_six_valves_over_three_boundaries_are_three_clusters(good: Assessment) -> None:
    lag = good.intervals["lag_distance_m"]
    assert (lag.count, lag.clusters) == (18, 3)
    assert lag.mean == good.evaluation.lag_distance_m.mean
    assert good.intervals["spraying_accuracy_percent"].mean == pytest.approx(
        good.evaluation.spraying_accuracy_percent
    )
    assert good.intervals["misapplied_percent"].mean == pytest.approx(
        good.evaluation.misapplied_percent
    )


# -------------------------------------------------------------------------------------- tables


def test_tables_split_the_changes_and_lose_none(good: Assessment) -> None:
    tables = good.breakdowns
    for rows in (tables.by_kind, tables.by_step, tables.by_rate, tables.by_speed):
        assert sum(row.lag_distance_m.count for row in rows) == 18
    kinds = {row.name: row.lag_distance_m.count for row in tables.by_kind}
    assert kinds == {"on": 0, "off": 0, "up": 12, "down": 6}
    assert {row.low for row in tables.by_rate} == {15.0, 20.0, 25.0}
    assert [(row.low, row.high) for row in tables.by_speed] == [(4.75, 5.25)]


def test_accuracy_by_speed_and_rate_adds_up_to_that_of_the_flight(good: Assessment) -> None:
    for rows in (good.breakdowns.accuracy, good.breakdowns.accuracy_by_rate):
        weights = [row.percent.count for row in rows]
        percents = [row.percent.mean or 0.0 for row in rows]
        mean = float(np.average(percents, weights=weights))
        assert mean == pytest.approx(good.evaluation.spraying_accuracy_percent)
    assert good.breakdowns.undefined_samples == 0


def test_samples_with_nothing_prescribed_are_counted_apart() -> None:
    given_setup = setup(prescription=Prescription(plots([[20.0, 0.0, 15.0, 20.0]]), boundary=WIDE))
    found = assess(eastwards(given=given_setup, shut_m=(12.0, 24.0)))
    assert found.breakdowns.undefined_samples > 12.0 / SPEED_M_S / 0.01


def test_a_speed_lies_in_the_bin_around_it() -> None:
    assert speed_bin(5.0) == (4.75, 5.25)
    assert speed_bin(5.25) == (5.25, 5.75)


# --------------------------------------------------------------------------------------- cells


def test_cells_hold_all_that_was_sprayed(good: Assessment) -> None:
    cells = good.cells
    assert cells is not None
    applied_ml = float(np.nansum(cells.measured_l_ha * cells.ground_m2)) / 10.0
    assert applied_ml == pytest.approx(good.evaluation.applied_ml, rel=0.01)
    assert cells.corner_east_m.shape == tuple(n + 1 for n in cells.commanded_l_ha.shape)


def test_five_percent_too_much_is_five_percent_in_every_cell() -> None:
    cells = assess(eastwards(scale=1.05), cell_m=2.0).cells
    assert cells is not None
    inside = (cells.corner_east_m[:-1, :-1] > 1.0) & (cells.corner_east_m[:-1, :-1] < 9.0)
    error = cells.relative_error_percent[inside & np.isfinite(cells.commanded_l_ha)]
    assert error == pytest.approx(5.0, abs=0.2)
    assert cells.histogram_l_ha is not None
    assert cells.histogram_l_ha.mean == pytest.approx(0.05 * 20.0, rel=0.1)
    assert cells.histogram_l_ha.counts.sum() == cells.histogram_l_ha.cells
    assert cells.histogram_l_min is not None
    per_rate = 6.0 * SPEED_M_S * 60.0 / 10_000.0
    assert cells.histogram_l_min.mean == pytest.approx(
        cells.histogram_l_ha.mean * per_rate, rel=0.01
    )


def test_the_duty_map_has_the_duty_of_each_plot(good: Assessment) -> None:
    cells = good.cells
    assert cells is not None
    west = cells.corner_east_m[:-1, :-1]
    second = cells.duty[(west > 14.0) & (west < 21.0) & np.isfinite(cells.duty)]
    flow_l_min = 25.0 * SPEED_M_S * 6.0 * 60.0 / 10_000.0
    expected = eastwards().setup.nozzle_sets[0].curve.duty_for(flow_l_min)
    assert second == pytest.approx(expected)


@settings(max_examples=8)
@given(
    rate_l_ha=st.floats(5.0, 60.0),
    turned_deg=st.floats(-20.0, 20.0),
    hole_m=st.floats(0.3, 4.0),
    cell_m=st.floats(0.6, 3.0),
)
def test_one_rate_over_a_field_is_the_rate_of_each_of_its_cells(
    rate_l_ha: float, turned_deg: float, hole_m: float, cell_m: float
) -> None:
    field = shapely.affinity.rotate(shapely.box(2.0, -4.0, 40.0, 9.0), turned_deg)
    zones = [Zone(name="all", polygon=field, rate_l_ha=rate_l_ha)]
    hole = shapely.Point(20.0, 3.0).buffer(hole_m)
    flight = eastwards(given=setup(prescription=Prescription(zones, exclusions=[hole])))
    record = record_of(flight)
    strips = strips_of(record)
    duties = [np.zeros(len(record.time_s)) for _ in strips]
    cells = cell_maps(record, strips, duties, cell_m=cell_m)
    assert cells is not None
    given_l_ha = cells.commanded_l_ha[np.isfinite(cells.commanded_l_ha)]
    in_field = given_l_ha > 0.0
    assert in_field.sum() > 20
    assert given_l_ha[in_field] == pytest.approx(rate_l_ha, rel=1e-6)
    # Without a rate are only those cells that lie outside: there the flight sprayed all the same.
    west_m, south_m = (
        each[:-1, :-1][np.isfinite(cells.commanded_l_ha)][~in_field]
        for each in (cells.corner_east_m, cells.corner_north_m)
    )
    middles = shapely.points(west_m + 0.5 * cell_m, south_m + 0.5 * cell_m)
    assert not shapely.contains(field.difference(hole).buffer(-cell_m), middles).any()


@settings(max_examples=6)
@given(cell_m=st.floats(0.6, 2.0), north_m=st.floats(0.0, 6.0))
def test_a_cell_in_one_zone_is_to_get_the_rate_of_that_zone(cell_m: float, north_m: float) -> None:
    flight = eastwards(given=rows_of_plots(1), passes_north_m=(north_m,))
    record = record_of(flight)
    strips = strips_of(record)
    duties = [np.zeros(len(record.time_s)) for _ in strips]
    cells = cell_maps(record, strips, duties, cell_m=cell_m)
    assert cells is not None
    passed = np.isfinite(cells.commanded_l_ha)
    west_m, south_m = (
        each[:-1, :-1][passed] for each in (cells.corner_east_m, cells.corner_north_m)
    )
    squares = shapely.box(west_m, south_m, west_m + cell_m, south_m + cell_m)
    for zone in flight.setup.prescription.zones:
        within = shapely.contains_properly(zone.polygon, squares)
        assert within.any()
        assert cells.commanded_l_ha[passed][within] == pytest.approx(zone.rate_l_ha, rel=1e-6)


def test_a_valve_that_spares_treated_ground_leaves_every_cell_its_dose() -> None:
    record = record_of(eastwards())
    strips = strips_of(record)
    duties = [np.zeros(len(record.time_s)) for _ in strips]
    once = cell_maps(record, strips, duties)
    again = [
        replace(
            each,
            track=replace(each.track, volume_ml=np.zeros_like(each.track.volume_ml)),
            spared=np.ones_like(each.spared),
        )
        for each in strips
    ]
    both = cell_maps(record, [*strips, *again], duties * 2)
    assert once is not None
    assert both is not None
    assert np.nanmax(once.measured_l_ha) > 10.0
    np.testing.assert_allclose(both.measured_l_ha, once.measured_l_ha)
    np.testing.assert_allclose(both.commanded_l_ha, once.commanded_l_ha)


def test_a_dose_is_the_sum_of_two_passes() -> None:
    once, twice = (
        assess(eastwards(passes_north_m=passes)).cells for passes in ((3.0,), (3.0, 3.0))
    )
    assert once is not None
    assert twice is not None
    # The second pass begins at another part of a step.
    np.testing.assert_allclose(twice.measured_l_ha, 2.0 * once.measured_l_ha, rtol=0.1, atol=1.0)
    np.testing.assert_allclose(twice.commanded_l_ha, once.commanded_l_ha, rtol=1e-5)
    assert twice.judged_m2 == pytest.approx(once.judged_m2)


def test_litres_are_asked_of_the_ground_that_was_treated() -> None:
    found = assess(eastwards(given=rows_of_plots(3), shut_m=(24.0, 36.0)))
    # Of four plots by one row, the third stayed bare: 20, 25 and 20 L/ha on 72 m2 each.
    assert found.ground.treated_m2 == pytest.approx(3 * 72.0, rel=0.02)
    assert found.balance.prescribed_l == pytest.approx(65.0 * 72.0 / 1e4, rel=0.02)
    assert found.ground.missed_m2 == pytest.approx(72.0, rel=0.06)
    assert found.ground.untreated_m2 == pytest.approx(9 * 72.0, rel=0.02)


# -------------------------------------------------------------------------------------- causes


@pytest.mark.parametrize(("text", "is_wish"), [("rate override 80 %", True), ("tank 80 L", False)])
def test_what_the_operator_wished_is_the_operators(text: str, is_wish: bool) -> None:
    flown = eastwards(scale=0.8)
    event = Event(at_s=flown.time_s[0], kind="command", text=text)
    causes = assess(replace(flown, events=(event,))).causes
    assert causes.by_cause[Cause.OPERATOR] == pytest.approx(
        causes.off_m2 if is_wish else 0.0, rel=0.05
    )
    assert causes.off_m2 > 0.9 * causes.passed_m2
    assert math.fsum(causes.by_cause.values()) == pytest.approx(causes.off_m2)


def test_before_the_wish_and_at_another_dose_it_is_not() -> None:
    flown = eastwards(scale=0.8)
    middle_s = float(flown.time_s.mean())
    late = Event(at_s=middle_s, kind="command", text="rate override 80 %")
    causes = assess(replace(flown, events=(late,))).causes
    assert causes.by_cause[Cause.OPERATOR] == pytest.approx(0.5 * causes.off_m2, rel=0.1)
    other = Event(at_s=flown.time_s[0], kind="command", text="rate override 60 %")
    assert assess(replace(flown, events=(other,))).causes.by_cause[Cause.OPERATOR] == 0.0


def shares(found: Assessment) -> dict[Cause, float]:
    whole = sum(found.causes.by_cause.values())
    assert whole == pytest.approx(found.causes.off_m2)
    return {cause: area / whole for cause, area in found.causes.by_cause.items() if area > 0.0}


def test_a_perfect_pass_is_off_at_the_border_only(good: Assessment) -> None:
    assert good.cells is not None
    assert good.cells.within_percent is not None
    assert good.cells.within_percent > 95.0
    assert set(shares(good)) <= {Cause.EDGE, Cause.CHANGE}


def test_late_changes_are_to_blame_for_the_ground_behind_boundaries() -> None:
    found = assess(eastwards(late_s=0.3))
    behind_m2 = 3 * 0.3 * SPEED_M_S * 6.0
    assert found.causes.by_cause[Cause.CHANGE] == pytest.approx(behind_m2, rel=0.35)
    assert found.causes.by_cause[Cause.UNEXPLAINED] < 1.0


def test_ground_behind_a_short_hold_is_named_by_its_reason_too() -> None:
    """Lag and period outlast the hold: what fell short then had no reason of its own."""
    found = assess(eastwards(shut_m=(30.0, 30.2), inhibit="wrong-mode"))
    assert set(found.causes.by_inhibit) == {"wrong-mode"}


def test_what_an_inhibit_closes_is_named_by_its_reason() -> None:
    found = assess(eastwards(shut_m=(27.0, 33.0), inhibit="wrong-mode"))
    assert found.causes.by_cause[Cause.INHIBIT] == pytest.approx(36.0, rel=0.1)
    assert max(found.causes.by_inhibit, key=found.causes.by_inhibit.__getitem__) == "wrong-mode"
    assert sum(found.causes.by_inhibit.values()) == pytest.approx(
        found.causes.by_cause[Cause.INHIBIT]
    )
    assert found.durations.by_inhibit_s["wrong-mode"] == pytest.approx(6.0 / SPEED_M_S, abs=0.11)


def test_the_same_without_a_reason_is_left_out() -> None:
    found = assess(eastwards(shut_m=(27.0, 33.0)))
    assert found.causes.by_cause[Cause.SKIP] == pytest.approx(36.0, rel=0.1)
    assert found.causes.by_cause[Cause.INHIBIT] == 0.0


def test_a_wrong_flow_without_any_reason_stays_unexplained() -> None:
    found = assess(eastwards(scale=1.15))
    assert shares(found)[Cause.UNEXPLAINED] > 0.8


def test_a_rate_beyond_the_nozzles_is_saturation() -> None:
    found = assess(eastwards(speed_m_s=10.0))
    # The rest is near borders and changes, which are named first.
    assert shares(found)[Cause.SATURATION] > 0.6


def test_ground_treated_twice_counts_once_as_overlap() -> None:
    used = setup(prescription=Prescription(plots([[20.0, 25.0, 15.0, 20.0]]), boundary=WIDE))
    found = assess(eastwards(given=used, passes_north_m=(3.0, 3.0)))
    assert found.causes.by_cause[Cause.OVERLAP] == pytest.approx(48.0 * 6.0, rel=0.03)
    assert found.causes.untreated_m2 == pytest.approx(0.0, abs=3.0)


def test_a_gap_between_two_passes_is_left_out() -> None:
    used = rows_of_plots(3)
    found = assess(eastwards(given=used, passes_north_m=(3.0, 11.0)))
    # 2 m between the passes, and 4 m beyond them that no later pass came to.
    assert found.causes.skipped_m2 == pytest.approx(48.0 * 2.0, rel=0.06)
    assert found.causes.untreated_m2 == pytest.approx(48.0 * 6.0, rel=0.06)
    assert found.causes.doubled_m2 == 0.0


# ------------------------------------------------------------------------- balance, durations


def test_the_balance_knows_refills_and_meter() -> None:
    flight = eastwards()
    record = record_of(flight)
    applied_l = float(record.volume_ml[-1].sum()) / 1000.0
    asked_l = ground_of(flight, record, strips_of(record), treated_of(flight)).asked_l
    level = np.array([10.0, 9.5, 14.5, 14.0, 14.0 - applied_l])
    count_ml = np.linspace(0.0, 1000.0 * applied_l * 1.02, 5)
    times = np.linspace(record.time_s[0], record.time_s[-1], 5)
    filled = replace(
        flight,
        tank_l=Series(time_s=times, value=level),
        meter_ml=Series(time_s=times, value=count_ml),
    )
    found = balance_of(filled, 1000.0 * applied_l, asked_l)
    assert found.refilled_l == pytest.approx(5.0)
    assert found.tank_l == pytest.approx(1.0 + applied_l)
    assert found.meter_to_model_percent == pytest.approx(2.0)
    assert found.model_to_prescribed_percent == pytest.approx(0.0, abs=1.5)
    assert balance_of(flight, 0.0, asked_l).meter_l is None


def test_a_gap_in_the_journal_is_no_spraying() -> None:
    flight = eastwards(passes_north_m=(3.0, 3.0))
    late = np.where(flight.time_s > 130.0, 100.0, 0.0)
    found = assess(replace(flight, time_s=flight.time_s + late))
    assert found.durations.unknown_s == pytest.approx(100.3, abs=0.31)
    assert found.durations.recorded_s == pytest.approx(2 * 78.0 / SPEED_M_S + 30.0, abs=0.7)


def test_everything_is_json_without_nan(good: Assessment) -> None:
    text = json.dumps(good.as_json(), allow_nan=False)
    found = json.loads(text)
    for key in ("lag_distance_m", "intervals", "breakdowns", "cells", "causes", "balance"):
        assert found[key] is not None
    assert found["lag_distance_m"]["count"] == 18
    assert set(found["intervals"]["lag_distance_m"]) == {"mean", "low", "high", "count", "clusters"}
    shares = sum(found["causes"]["share"].values())
    assert shares == pytest.approx(1.0 if found["causes"]["off_m2"] > 0.0 else 0.0)


def test_an_interval_of_distances_without_sign_does_not_reach_below_0() -> None:
    few = Interval(mean=0.02, low=-0.005, high=0.046, count=9, clusters=3)
    assert _no_less_than_0(few) == replace(few, low=0.0)
    assert _no_less_than_0(replace(few, low=0.01)).low == 0.01
    assert _no_less_than_0(NOTHING) == NOTHING


def test_a_flight_that_never_sprayed_has_figures_of_nothing() -> None:
    flight = eastwards(passes_north_m=(200.0,))
    dry = replace(flight, changes=changes_of([]), flow_l_min=np.zeros(len(flight.time_s)))
    found = assess(dry)
    assert found.evaluation.applied_ml == 0.0
    assert found.cells is None
    assert found.intervals["lag_distance_m"].count == 0
    assert found.balance.model_to_prescribed_percent is None
    assert found.durations.spraying_s == 0.0
    json.dumps(found.as_json(), allow_nan=False)


def test_a_flight_that_missed_its_field_with_open_valves_is_off_target() -> None:
    found = assess(eastwards(passes_north_m=(200.0,)))
    assert found.evaluation.off_target_ml == pytest.approx(found.evaluation.applied_ml)
    assert found.causes.untreated_m2 == pytest.approx(48.0 * 6.0, rel=0.05)
    json.dumps(found.as_json(), allow_nan=False)


def test_a_map_in_cells_is_compared_on_its_own_cells() -> None:
    def linear(a: float, d: float) -> Warp:
        return Warp(x0=0.0, y0=0.0, scale=1.0, terms=((0.0, 0.0), (0.0, d), (a, 0.0)))

    classes = np.array([[0, 1, 2, 0]] * 2, dtype=np.int32)
    grid = CellGrid(classes, [20.0, 25.0, 15.0], linear(12.0, 3.0), linear(1 / 12.0, 1 / 3.0))
    used = setup(prescription=Prescription((), cells=grid))
    found = assess(eastwards(given=used))
    assert found.evaluation.lag_distance_m.count == 18
    cells = found.cells
    assert cells is not None
    assert cells.source == "map"
    assert cells.commanded_l_ha.shape == (2, 4)
    assert cells.commanded_l_ha[0] == pytest.approx([20.0, 25.0, 15.0, 20.0], rel=0.01)
    assert cells.measured_l_ha[0] == pytest.approx([20.0, 25.0, 15.0, 20.0], rel=0.02)
    assert cells.passes == pytest.approx(1.0, rel=0.02)
    assert (cells.corner_east_m[0, -1], cells.corner_north_m[-1, 0]) == (48.0, 6.0)
