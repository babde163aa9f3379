"""The operator's percentage of the prescribed rate: bounded, and nothing else changes by it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.controller import Memory, step
from companion.core.estimator import Track, observe
from companion.core.nozzle import overridden
from companion.core.setup import Setup
from companion.core.types import Decision, RateOverride
from tests import builders

SETUP = builders.setup()
NAN = float("nan")


def decided(setup: Setup = SETUP, percent: float = 100.0) -> Decision:
    state = replace(builders.SPRAYING, rate_percent=percent)
    decision, _ = step(setup, state, Memory(), 10.0)
    again, _ = step(setup, state, Memory(plan=decision.plan), 10.05)
    return again


@pytest.mark.parametrize("percent", [80.0, 90.0, 110.0])
def test_flow_and_target_are_that_share(percent: float) -> None:
    before, after = decided(), decided(percent=percent)
    share = percent / 100.0
    assert before.target_flow_l_min > 0.0
    assert after.target_flow_l_min == pytest.approx(share * before.target_flow_l_min)
    assert after.flow_l_min == pytest.approx(share * before.flow_l_min, rel=1e-6)
    assert after.rate_l_ha == before.rate_l_ha


def test_nothing_is_put_above_the_label() -> None:
    before = decided(replace(SETUP, rate_max_l_ha=21.0))
    after = decided(replace(SETUP, rate_max_l_ha=21.0), percent=110.0)
    assert max(rate for rate in before.rate_l_ha if rate) == 20.0
    assert after.target_flow_l_min == pytest.approx(1.05 * before.target_flow_l_min)


@pytest.mark.parametrize("percent", [NAN, 79.0, 111.0, 0.0, -100.0, float("inf")])
def test_what_may_not_be_asked_changes_nothing_twice_over(percent: float) -> None:
    track = Track(rate_percent=95.0)
    item = RateOverride(received_s=1.0, percent=percent)
    assert observe(track, item, SETUP).rate_percent == 95.0
    after = decided(percent=percent)
    if math.isfinite(percent):
        assert after.plan == decided().plan
    else:  # no state that holds it is believed
        assert after.plan.duty_at(10.0) == (0.0,) * 6


def test_the_last_one_that_may_be_asked_counts() -> None:
    track = Track()
    for percent in (80.0, NAN, 105.0):
        track = observe(track, RateOverride(received_s=1.0, percent=percent), SETUP)
    assert track.rate_percent == 105.0


@given(rate=st.floats(0.0, 1000.0), percent=st.floats(), limit=st.none() | st.floats(0.0, 1000.0))
def test_never_above_the_bounds_nor_the_label(
    rate: float, percent: float, limit: float | None
) -> None:
    asked = overridden(rate, percent, limit)
    assert 0.0 <= asked <= max(rate * 1.1, rate) * (1.0 + 1e-15)
    if limit is not None and rate <= limit:
        assert asked <= limit
    if rate == 0.0:
        assert asked == 0.0


@given(rate=st.floats(allow_nan=False))
def test_at_a_hundred_percent_not_a_bit_changes(rate: float) -> None:
    assert overridden(rate, 100.0, 0.0) == rate
