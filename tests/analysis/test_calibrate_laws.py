"""What must hold for lags identified from any flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.calibrate_cli import settings as to_paste
from analysis.calibration.identify import Meter, identify
from analysis.calibration.steps import FlowRecord
from companion.core.schedule import LagModel
from tests.analysis.calibration_bench import PERIOD_S, Bench, metered

LAGS = st.fixed_dictionaries({kind: st.floats(0.03, 0.16) for kind in ("on", "off", "up", "down")})
RECORD = Bench().record()


def lags(record: FlowRecord) -> dict[str, float]:
    return {kind.value: estimate.value for kind, estimate in identify(record).lags.items()}


KNOWN = lags(RECORD)


@settings(max_examples=8)
@given(lag_s=LAGS)
def test_whatever_the_lags_are_they_are_found(lag_s: dict[str, float]) -> None:
    assert lags(Bench(lag_s=lag_s).record()) == pytest.approx(lag_s, abs=2e-4)


@settings(max_examples=8)
@given(gain=st.floats(0.5, 2.0), offset_ml=st.floats(0.0, 1e5))
def test_neither_gain_nor_start_of_the_count_matter(gain: float, offset_ml: float) -> None:
    moved = metered(RECORD, gain * RECORD.volume_ml + offset_ml)
    assert lags(moved) == pytest.approx(KNOWN, abs=1e-6)


@settings(max_examples=8)
@given(shift_s=st.floats(-5.0, 1e5))
def test_the_hour_does_not_matter(shift_s: float) -> None:
    orders = tuple(replace(order, at_s=order.at_s + shift_s) for order in RECORD.orders)
    moved = replace(RECORD, orders=orders, time_s=RECORD.time_s + shift_s)
    assert lags(moved) == pytest.approx(KNOWN, abs=1e-6)


@settings(max_examples=8)
@given(late_s=st.floats(0.0, 0.05))
def test_a_later_meter_is_a_longer_lag_by_as_much(late_s: float) -> None:
    moved = replace(RECORD, time_s=RECORD.time_s + late_s)
    expected = {kind: value + late_s for kind, value in KNOWN.items()}
    assert lags(moved) == pytest.approx(expected, abs=1e-4)


@settings(max_examples=8)
@given(lag_s=LAGS, pulse_ml=st.floats(0.05, 0.5), rate_hz=st.floats(20.0, 200.0))
def test_what_is_to_be_pasted_is_always_usable_and_on_the_safe_side(
    lag_s: dict[str, float], pulse_ml: float, rate_hz: float
) -> None:
    record = Bench(lag_s=lag_s, pulse_ml=pulse_ml, rate_hz=rate_hz).record()
    found = identify(record)
    assert not found.missing
    model = LagModel(**to_paste(found))
    assert model.on_start_s <= max(lag_s["on"] - 0.015, 0.0) + 1e-4
    assert model.off_end_s >= lag_s["off"] + 0.015 - 2e-3


@settings(max_examples=25)
@given(duty=st.floats(0.1, 0.9), phase=st.floats(0.0, 1.0), at=st.floats(2.0, 8.0))
def test_the_mean_over_a_period_does_not_see_the_pulses(
    duty: float, phase: float, at: float
) -> None:
    time_s = np.arange(0.0, 10.0, 0.001)
    whole, part = np.divmod(time_s / PERIOD_S + phase, 1.0)
    volume_ml = 80.0 * PERIOD_S * (whole + np.minimum(part / duty, 1.0))
    meter = Meter(time_s, volume_ml, lag_s=0.0, period_s=PERIOD_S)
    ends = meter.mean_at(np.array([at - 5.0 * PERIOD_S / 2.0, at + 5.0 * PERIOD_S / 2.0]))
    assert (ends[1] - ends[0]) / (5.0 * PERIOD_S) == pytest.approx(80.0, rel=1e-4)
