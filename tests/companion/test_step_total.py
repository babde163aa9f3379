"""`step` raises for no state and no time, and closes where one is no number."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.controller import Memory, step
from companion.core.types import Decision, Inhibit, StopAhead, VehicleState
from tests import builders
from tests.pump_flight import pump_setup

NUMBERS = (0.0, -0.0, math.nan, math.inf, -math.inf, 5e-324, 1e18, -1e18, 1.8e308, -1.7e308)
SETUPS = {
    "valves": builders.setup(),
    "pump": pump_setup([20.0, 25.0], "valves", valves=6),
}
# In a turn, braking for the mission's stop: every number is in use.
TURNING = replace(
    builders.SPRAYING,
    yaw_rate_deg_s=20.0,
    yaw_gain_deg_s2=5.0,
    acceleration_east_m_s2=1.0,
    outrun_east_m_s=0.1,
    stop_ahead=StopAhead(distance_m=20.0, braking_m_s2=2.0),
)
# Ages and limits that nobody asked for: without one they close nothing.
UNASKED = {"horizontal_accuracy_m", "utc_offset_s", "wind_received_s"}


def spots(state: Any, way: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """Return the way to every number that a state holds, those of its parts too."""
    found = []
    for field in fields(state):
        value, here = getattr(state, field.name), (*way, field.name)
        if is_dataclass(value):
            found += spots(value, here)
        elif "float" in str(field.type):
            found.append(here)
    return found


def put(state: Any, way: tuple[str, ...], value: float) -> Any:
    name, *rest = way
    return replace(
        state, **{name: put(getattr(state, name), tuple(rest), value) if rest else value}
    )


def stepped(name: str, state: VehicleState | None, now_s: float, *, fresh: bool) -> Decision:
    """Return the second decision of a flight that sprays, or its first."""
    setup, memory = SETUPS[name], Memory()
    if not fresh:
        first, memory = step(setup, TURNING, memory, 10.0)
        assert not first.plan.is_off
    decision, after = step(setup, state, memory, now_s)
    # And it goes on from there.
    again, _ = step(setup, TURNING, after, 10.1)
    assert again.plan.sequence > decision.plan.sequence
    return decision


@pytest.mark.parametrize("fresh", [True, False])
@pytest.mark.parametrize("name", SETUPS)
@pytest.mark.parametrize("way", spots(TURNING), ids=".".join)
def test_any_number_of_a_state_may_be_none(way: tuple[str, ...], name: str, fresh: bool) -> None:
    for value in NUMBERS:
        decision = stepped(name, put(TURNING, way, value), 10.05, fresh=fresh)
        if not math.isfinite(value) and way[0] not in UNASKED:
            assert decision.plan.is_off, value


@pytest.mark.parametrize("fresh", [True, False])
@pytest.mark.parametrize("name", SETUPS)
@pytest.mark.parametrize("now_s", NUMBERS)
def test_a_clock_that_is_no_number_closes(name: str, now_s: float, fresh: bool) -> None:
    decision = stepped(name, TURNING, now_s, fresh=fresh)
    assert decision.plan.is_off
    assert math.isfinite(decision.now_s)
    stepped(name, None, now_s, fresh=fresh)


def test_an_acceleration_that_does_not_last_closes_and_is_told() -> None:
    for state in (
        replace(TURNING, acceleration_fade_s=0.0),
        replace(TURNING, yaw_gain_deg_s2=math.inf),
        replace(TURNING, stop_ahead=StopAhead(distance_m=20.0, braking_m_s2=0.0)),
    ):
        decision = stepped("valves", state, 10.05, fresh=False)
        assert decision.inhibits == {Inhibit.INVALID_POSITION}


@settings(deadline=None, max_examples=300)
@given(
    values=st.dictionaries(
        st.sampled_from(spots(TURNING)), st.floats() | st.sampled_from(NUMBERS), max_size=6
    ),
    now_s=st.sampled_from((10.05, *NUMBERS)) | st.floats(),
    fresh=st.booleans(),
    name=st.sampled_from(sorted(SETUPS)),
)
def test_no_numbers_at_all_make_it_raise(
    values: dict[tuple[str, ...], float], now_s: float, fresh: bool, name: str
) -> None:
    state = TURNING
    for way, value in values.items():
        state = put(state, way, value)
    stepped(name, state, now_s, fresh=fresh)
