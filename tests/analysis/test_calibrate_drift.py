"""`calibrate drift`: a valve that leaves the others is named, and noise names none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.calibrate_drift import (
    Windows,
    as_shape,
    drifted,
    lines,
    verdict_of,
    windows_of,
)
from analysis.calibration.identify import Estimate
from analysis.calibration.steps import FlowRecord, Order
from companion.cli.app import execute
from companion.config import load
from companion.core.setup import Setup
from missions.maps.compiling import compiled_setup

ANYANG = Path(__file__).resolve().parents[2] / "examples" / "anyang" / "config.toml"
VALVES = 6
NAMES = [str(number + 1) for number in range(VALVES)]


@pytest.fixture(scope="module")
def setup() -> Setup:
    return compiled_setup(load(ANYANG))


def flight(
    setup: Setup, factors: list[float], *, gain: float = 1.0, noise_ml: float = 0.1, seed: int = 1
) -> FlowRecord:
    """Return a flight with 60 skew borders, each valve ordered 0.2 s after its neighbour."""
    rng = np.random.default_rng(seed)
    period_s, lag, flow_ml_s = setup.pwm.period_s, setup.lag, 6.0
    orders, time_s = [], np.arange(0.0, 245.0, 0.02)
    volume_ml = np.zeros(len(time_s))
    for number in range(30):
        for valve in range(VALVES):
            place = valve if number % 2 else VALVES - 1 - valve
            for at_s, before, after in ((8.0 * number, 0.0, 1.0), (8.0 * number + 4.0, 1.0, 0.0)):
                begin_s = at_s + 0.2 * place
                change = (after - before) * flow_ml_s
                lag_s = (lag.on_s if after else lag.off_s) + lag.output_s + 0.001
                volume_ml += change * factors[valve] * np.maximum(time_s - begin_s - lag_s, 0.0)
                orders.append(
                    Order(
                        at_s=begin_s, valve=valve, before=before, after=after,
                        before_ml_s=before * flow_ml_s, after_ml_s=after * flow_ml_s,
                    )
                )  # fmt: skip
    volume_ml = gain * volume_ml + rng.normal(0.0, noise_ml, len(time_s))
    orders.sort(key=lambda order: order.at_s)
    return FlowRecord(
        orders=tuple(orders),
        time_s=time_s,
        volume_ml=np.maximum.accumulate(volume_ml),
        period_s=period_s,
        lag=lag,
    )


def found_in(setup: Setup, *records: FlowRecord) -> tuple[Estimate, ...]:
    found = drifted([windows_of(record, setup, meter_lag_s=0.001) for record in records])
    assert found is not None
    return found.factors


def test_a_drifted_valve_is_named_whatever_the_meters_gain(setup: Setup) -> None:
    truth = [1.0, 1.0, 0.8, 1.0, 1.0, 1.0]
    for gain in (0.97, 1.03):
        records = [flight(setup, truth, gain=gain, seed=seed) for seed in (1, 2)]
        factors = found_in(setup, *records)
        verdicts = [verdict_of(own) for own in factors]
        assert [name for name, v in zip(NAMES, verdicts, strict=True) if v != "none"] == ["3"]
        assert np.mean([own.value for own in factors]) == pytest.approx(1.0, abs=1e-9)
        assert factors[2].value == pytest.approx(0.8 / np.mean(truth), abs=0.03)


def test_noise_names_no_valve_and_intervals_hold_the_truth(setup: Setup) -> None:
    held = []
    for seed in range(8):
        noise_ml = 0.3 if seed % 2 else 0.1
        record = flight(setup, [1.0] * VALVES, gain=1.03, seed=seed, noise_ml=noise_ml)
        factors = found_in(setup, record)
        assert {verdict_of(own) for own in factors} == {"none"}
        held += [own.low <= 1.0 <= own.high for own in factors]
    assert np.mean(held) >= 0.9


def test_the_ordinary_scatter_of_valves_names_none(setup: Setup) -> None:
    truth = [0.98, 1.02, 1.0, 1.03, 0.97, 1.0]
    factors = found_in(setup, flight(setup, truth))
    assert {verdict_of(own) for own in factors} == {"none"}


def test_a_flight_whose_valves_do_the_same_tells_nothing(setup: Setup) -> None:
    apart = windows_of(flight(setup, [1.0] * VALVES), setup, meter_lag_s=0.001)
    mean_ml = apart.valves_ml.mean(axis=1, keepdims=True)
    assert drifted([replace(apart, valves_ml=np.repeat(mean_ml, VALVES, axis=1))]) is None


def test_windows_without_counts_are_left_out(setup: Setup) -> None:
    whole = flight(setup, [1.0] * VALVES)
    heard = (whole.time_s < 60.0) | (whole.time_s > 120.0)
    silent = replace(whole, time_s=whole.time_s[heard], volume_ml=whole.volume_ml[heard])
    before = windows_of(whole, setup, meter_lag_s=0.001)
    after = windows_of(silent, setup, meter_lag_s=0.001)
    assert 0.6 < len(after.metered_ml) / len(before.metered_ml) < 0.85
    assert {verdict_of(own) for own in found_in(setup, silent)} == {"none"}


def test_a_dead_meter_tells_nothing(setup: Setup) -> None:
    record = flight(setup, [1.0] * VALVES)
    few = replace(record, time_s=record.time_s[:5], volume_ml=record.volume_ml[:5])
    found: Windows = windows_of(few, setup, meter_lag_s=0.001)
    assert drifted([found]) is None


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [(0.84, 0.94, "early"), (0.80, 0.89, "replace"), (0.90, 0.96, "none"), (1.06, 1.2, "early")],
)
def test_a_verdict_needs_the_whole_interval(low: float, high: float, verdict: str) -> None:
    assert verdict_of(Estimate(value=0.5 * (low + high), low=low, high=high, count=1)) == verdict


def test_the_answer_names_the_valve_and_what_to_do(setup: Setup) -> None:
    truth = [1.0, 1.0, 0.75, 1.0, 1.0, 1.0]
    found = drifted(
        [windows_of(flight(setup, truth, seed=seed), setup, meter_lag_s=0.001) for seed in (1, 2)]
    )
    assert found is not None
    text = "\n".join(lines(as_shape(found, NAMES)))
    assert "valve 3: -2" in text
    assert "clean it" in text


def test_a_file_that_is_no_journal_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(["calibrate", "drift", str(tmp_path / "none.gpkg")]) == 2
    assert "none.gpkg" in capsys.readouterr().err
