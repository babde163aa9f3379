"""Laws of the metrics: where the world lies, how it is cut and what a lag is worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from analysis.evaluation import FlightRecord, evaluate
from companion.core.prescription import Prescription, Zone
from tests.analysis.test_evaluation_flights import Flight, record_of

RATES = st.lists(st.sampled_from([14.0, 17.0, 20.0, 24.0, 29.0]), min_size=3, max_size=5)


def moved(record: FlightRecord, turn_deg: float, east_m: float, north_m: float) -> FlightRecord:
    """Return the flight with the whole world turned clockwise about the origin and shifted."""
    angle = np.radians(turn_deg)
    east = record.east_m * np.cos(angle) + record.north_m * np.sin(angle) + east_m
    north = -record.east_m * np.sin(angle) + record.north_m * np.cos(angle) + north_m
    zones = [
        Zone(
            name=zone.name,
            rate_l_ha=zone.rate_l_ha,
            polygon=affinity.translate(
                affinity.rotate(zone.polygon, -turn_deg, origin=(0, 0)), east_m, north_m
            ),
        )
        for zone in record.prescription.zones
    ]
    return replace(
        record,
        east_m=east,
        north_m=north,
        heading_deg=record.heading_deg + turn_deg,
        prescription=Prescription(zones),
    )


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    rates=RATES,
    turn_deg=st.floats(0.0, 360.0),
    east_m=st.floats(-2000.0, 2000.0),
    north_m=st.floats(-2000.0, 2000.0),
)
def test_turning_and_shifting_the_world_changes_no_figure(
    rates: list[float], turn_deg: float, east_m: float, north_m: float
) -> None:
    flight = Flight(rates=[rates], valves=2, lag_m=lambda n: 0.3 - 0.2 * n, border_m=0.1)
    record, _ = record_of(replace(flight, step_s=0.005))
    here = evaluate(record)
    there = evaluate(moved(record, turn_deg, east_m, north_m))
    assert (here.missed, here.apart) == (there.missed, there.apart)
    assert here.lag_distance_m.count == there.lag_distance_m.count
    # At the field's ends the marks, 0.1 m apart, fall differently.
    assert there.misapplied_percent == pytest.approx(here.misapplied_percent, abs=0.06)
    for name in ("spraying_accuracy_percent", "gap_m2", "overlap_m2"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), abs=0.06, rel=2e-3)
    if here.lag_distance_m.count:
        assert there.lag_distance_m.mean == pytest.approx(here.lag_distance_m.mean, abs=1e-3)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    rates=RATES,
    lag_m=st.floats(-1.5, 4.0),
    ripple_m_s=st.floats(0.0, 0.4),
    scale=st.floats(0.9, 1.1),
)
def test_a_flow_shifted_by_any_lag_is_measured_as_that_lag(
    rates: list[float], lag_m: float, ripple_m_s: float, scale: float
) -> None:
    flight = Flight(
        rates=[rates], valves=1, lag_m=lambda _: lag_m, ripple_m_s=ripple_m_s, scale=scale
    )
    record, true_m = record_of(replace(flight, step_s=0.005))
    evaluation = evaluate(record)
    assert (evaluation.missed, evaluation.lag_distance_m.count) == (0, len(true_m))
    if true_m:
        assert evaluation.lag_distance_m.max == pytest.approx(lag_m, abs=0.005)
        assert evaluation.lag_distance_m.min == pytest.approx(lag_m, abs=0.005)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    rates=st.lists(st.sampled_from([14.0, 18.0, 24.0]), min_size=3, max_size=4),
    lag_m=st.floats(-1.0, 1.0),
    seed=st.integers(0, 1000),
)
def test_pulses_of_any_phase_are_measured_to_15_mm(
    rates: list[float], lag_m: float, seed: int
) -> None:
    flight = Flight(rates=[rates], valves=1, lag_m=lambda _: lag_m, pulsed=True, seed=seed)
    record, true_m = record_of(replace(flight, ripple_m_s=0.15))
    distances = evaluate(record).lag_distance_m
    assert distances.count == len(true_m)
    if true_m:
        assert distances.max == pytest.approx(lag_m, abs=0.015)
        assert distances.min == pytest.approx(lag_m, abs=0.015)


@settings(max_examples=10, deadline=None, derandomize=True)
@given(late_m=st.floats(0.2, 3.0), more_m=st.floats(0.1, 1.0))
def test_a_later_flow_misapplies_more(late_m: float, more_m: float) -> None:
    flight = Flight(rates=[[14.0, 20.0, 29.0, 20.0]], valves=1, step_s=0.01)
    misapplied = [
        evaluate(record_of(replace(flight, lag_m=lambda _, by_m=by_m: by_m))[0]).misapplied_percent
        for by_m in (late_m, late_m + more_m)
    ]
    assert misapplied[1] > misapplied[0] > 0.0


@settings(max_examples=10, deadline=None, derandomize=True)
@given(valves=st.integers(1, 8))
def test_cutting_the_boom_into_more_valves_changes_no_total(valves: int) -> None:
    flight = Flight(rates=[[14.0, 20.0, 29.0]], valves=valves, border_m=-0.4, step_s=0.005)
    evaluation = evaluate(record_of(flight)[0])
    assert evaluation.off_target_ml == pytest.approx((14.0 + 29.0) * 0.4 * 6.0 * 0.1, rel=0.02)
    assert evaluation.overlap_m2 == pytest.approx(0.8 * 6.0, rel=0.02)
