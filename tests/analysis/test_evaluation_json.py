"""The results have the keys that others rely on, and cost less than the flight."""

from __future__ import annotations

import json
import time

import numpy as np

from analysis.evaluation import P1_RESULTS, evaluate
from tests.analysis.test_evaluation_flights import Flight, record_of

DISTANCES = {"mean", "mean_abs", "max_abs", "count"}


def test_an_entry_has_every_key_of_the_contract() -> None:
    evaluation = evaluate(record_of(Flight(rates=[[20.0, 26.0, 20.0]], valves=2))[0])
    entry = json.loads(json.dumps(evaluation.as_json(limit_ratio=1.02), allow_nan=False))
    assert {
        "speed_m_s",
        "method",
        "lag_distance_m",
        "settled_lag_distance_m",
        "spraying_accuracy_percent",
        "misapplied_percent",
        "limit_ratio",
        "settled_accuracy_percent",
        "starting_accuracy_percent",
        "border_margin_m",
        "off_target_ml",
        "missed",
        "apart",
        "gap_m2",
        "overlap_m2",
        "volume_error_percent",
        "fidelity",
        "output",
        "seed",
    } <= set(entry)
    assert set(entry["lag_distance_m"]) >= DISTANCES
    assert set(entry["settled_lag_distance_m"]) >= DISTANCES
    assert {"min", "mean"} <= set(entry["border_margin_m"])
    assert entry["limit_ratio"] == 1.02


def test_a_flight_beside_the_field_has_no_figures_and_no_fault() -> None:
    record, _ = record_of(Flight(rates=[[20.0, 26.0, 20.0]], valves=2))
    away = evaluate(_shifted(record, 500.0))
    entry = json.loads(json.dumps(away.as_json(), allow_nan=False))
    assert entry["spraying_accuracy_percent"] is None
    assert entry["misapplied_percent"] is None
    assert entry["lag_distance_m"]["count"] == entry["missed"] == 0
    assert np.isclose(entry["off_target_ml"], entry["applied_ml"])


def _shifted(record, north_m):  # type: ignore[no-untyped-def]
    from dataclasses import replace

    return replace(record, north_m=record.north_m + north_m)


def test_two_and_a_half_minutes_at_500_hz_are_evaluated_in_a_second_of_processor_time() -> None:
    rng = np.random.default_rng(1)
    rates = [rng.permutation(np.linspace(14.0, 28.0, 10)).tolist() for _ in range(5)]
    record, _ = record_of(Flight(rates=rates, pulsed=True, ripple_m_s=0.15))
    assert record.time_s[-1] > 150.0
    begin_s = time.process_time()
    evaluate(record)
    # Measured 0.3 s; the bound leaves room for slower machines.
    assert time.process_time() - begin_s < 1.5


def test_p1s_table_is_complete() -> None:
    accuracy = P1_RESULTS["spraying_accuracy_percent"]
    assert isinstance(accuracy, dict)
    rows = accuracy["by_speed_m_s"]
    assert sorted(rows) == ["4", "5", "6"]
    assert all(len(row) == len(accuracy["rates_l_ha"]) == 10 for row in rows.values())
    every = [value for row in rows.values() for value in row]
    # P1's own mean, minimum and maximum, from its text.
    assert round(float(np.mean(every)), 2) in (94.77, 94.78)
    assert (min(every), max(every)) == (accuracy["min"], accuracy["max"])
    json.dumps(P1_RESULTS)
