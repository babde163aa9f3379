"""Every reason not to spray, alone, closes every valve."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.core.controller import Memory, step
from companion.core.interlock import Limits
from companion.core.types import Decision, Fix, Inhibit, VehicleState
from tests.builders import SPRAYING, setup

NAN = math.nan
CASES: dict[Inhibit, list[dict[str, object] | None]] = {
    Inhibit.NOT_ENABLED: [{"enabled": False}],
    Inhibit.NO_POSITION: [None],
    Inhibit.STALE_POSITION: [
        {"position_received_s": 9.19},
        {"position_received_s": NAN},
        {"position_received_s": 10.2},
    ],
    Inhibit.INVALID_POSITION: [{"position_valid": False}],
    Inhibit.FAR_FROM_FIELD: [
        {"east_m": 20_049.0},
        {"north_m": NAN},
        {"east_m": -math.inf},
    ],
    Inhibit.NO_HEARTBEAT: [{"heartbeat_received_s": None}],
    Inhibit.STALE_HEARTBEAT: [{"heartbeat_received_s": 7.49}, {"heartbeat_received_s": NAN}],
    Inhibit.NOT_ARMED: [{"armed": False}],
    Inhibit.WRONG_MODE: [{"mode": "LOITER"}, {"mode": None}],
    Inhibit.NOT_IN_AIR: [{"in_air": False}, {"in_air": None}],
    Inhibit.FIX_TOO_LOW: [{"fix": Fix.DGPS}, {"fix": None}],
    Inhibit.ESTIMATOR_UNHEALTHY: [{"estimator_healthy": False}, {"estimator_healthy": None}],
    Inhibit.HEADING_UNKNOWN: [{"heading_deg": None}, {"heading_deg": NAN}],
    Inhibit.SPEED_UNKNOWN: [{"velocity_known": False}],
    Inhibit.SPEED_BELOW_MIN: [{"velocity_east_m_s": 0.99, "checked_speed_m_s": None}],
    Inhibit.SPEED_ABOVE_MAX: [{"velocity_east_m_s": 12.01, "checked_speed_m_s": None}],
    Inhibit.SPEED_DISAGREES: [{"checked_speed_m_s": 6.01}, {"checked_speed_m_s": NAN}],
    Inhibit.HEIGHT_BELOW_MIN: [{"height_m": 0.99}],
    Inhibit.HEIGHT_ABOVE_MAX: [{"height_m": 10.01}],
    Inhibit.WIND_ABOVE_MAX: [{"wind_m_s": 6.01}, {"wind_m_s": NAN}],
    Inhibit.OUTPUT_FAULT: [{"output_healthy": False}],
}


def decide(change: dict[str, object] | None, limits: Limits | None = None) -> Decision:
    state: VehicleState | None = None
    if change is not None:
        state = replace(SPRAYING, **change)  # type: ignore[arg-type]
    given = setup() if limits is None else setup(limits=limits)
    return step(given, state, Memory(), 10.0)[0]


def test_nothing_inhibits_the_reference_step() -> None:
    decision = decide({})
    assert not decision.inhibits
    assert not decision.plan.is_off


def test_every_inhibit_has_a_case() -> None:
    assert set(CASES) == set(Inhibit)


@pytest.mark.parametrize(
    ("inhibit", "change"),
    [(inhibit, change) for inhibit, changes in CASES.items() for change in changes],
)
def test_inhibit_alone_closes_every_valve(
    inhibit: Inhibit, change: dict[str, object] | None
) -> None:
    decision = decide(change)
    assert decision.inhibits == {inhibit}
    assert decision.plan.is_off


@pytest.mark.parametrize("name", ["velocity_east_m_s", "velocity_north_m_s", "height_m"])
@pytest.mark.parametrize("value", [NAN, math.inf, -math.inf])
def test_what_is_no_number_closes_every_valve(name: str, value: float) -> None:
    decision = decide({name: value})
    assert decision.inhibits
    assert decision.plan.is_off


def test_wind_that_is_required_and_not_known_inhibits() -> None:
    assert decide({}, Limits(wind_required=True)).inhibits == {Inhibit.WIND_ABOVE_MAX}


def test_values_just_inside_the_limits_do_not_inhibit() -> None:
    decision = decide(
        {"position_received_s": 9.21, "heartbeat_received_s": 7.51, "checked_speed_m_s": 5.99}
    )
    assert not decision.inhibits


def test_an_inhibit_closes_a_valve_that_was_open() -> None:
    given = setup()
    first, memory = step(given, SPRAYING, Memory(), 10.0)
    assert any(change.duty > 0.0 for change in first.plan.changes)
    second, _ = step(given, replace(SPRAYING, armed=False), memory, 10.05)
    assert second.plan.is_off
    assert second.plan.sequence == first.plan.sequence + 1
