"""A valve that is closed over treated ground was right, and one over bare ground was not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.evaluation import evaluate
from analysis.flight_record import FlightMeta, FlightRecord
from analysis.strips import strips_of
from companion.core.options.coverage import Coverage
from companion.core.options.overlap import OverlapGuard
from companion.core.types import TimedChange
from tests.builders import setup

GUARD = OverlapGuard(switch_off_percent=100.0)
# There over the field at 5 m/s and, 0.05 m aside, back.
TURN_S = 12.0


def record(*, guard: OverlapGuard | None, sprays: tuple[bool, bool]) -> FlightRecord:
    """Return a flight there and back on which each way is sprayed as asked, or closed by order."""
    given = setup()
    time_s = np.arange(0.0, 2.0 * TURN_S, 0.01)
    is_back = time_s >= TURN_S
    east_m = np.where(is_back, -6.0 + 5.0 * (2.0 * TURN_S - time_s), -6.0 + 5.0 * time_s)
    orders = [
        TimedChange(at_s=at_s, valve=valve, duty=0.6 if is_open else 0.0)
        for at_s, is_open in ((0.0, sprays[0]), (TURN_S, sprays[1]))
        for valve in range(len(given.boom.valves))
    ]
    flown = FlightRecord(
        time_s=time_s, east_m=east_m, north_m=np.where(is_back, 3.05, 3.0),
        heading_deg=np.full(len(time_s), 90.0),
        volume_ml=np.zeros((len(time_s), len(given.boom.valves))), boom=given.boom,
        prescription=given.prescription, pwm_period_s=1.0 / 11.0, orders=tuple(orders),
        meta=FlightMeta(speed_m_s=5.0, method="", fidelity="averaged", output="servo", seed=1),
    )  # fmt: skip
    asked = np.column_stack([strip.asked_ml for strip in strips_of(flown)])
    falls = np.diff(asked, axis=0, prepend=0.0) * np.where(is_back, sprays[1], sprays[0])[:, None]
    return replace(flown, volume_ml=np.cumsum(falls, axis=0), guard=guard)


def test_nothing_is_asked_for_where_a_guard_closes_over_treated_ground() -> None:
    with_guard, without = (
        evaluate(record(guard=guard, sprays=(True, False))) for guard in (GUARD, None)
    )
    assert without.missed > 0
    assert without.volume_error_percent == pytest.approx(-50.0, abs=1.0)
    assert with_guard.missed == 0
    assert with_guard.volume_error_percent == pytest.approx(0.0, abs=0.5)
    assert with_guard.off_target_ml == pytest.approx(without.off_target_ml)


def test_a_valve_that_is_closed_where_nothing_fell_has_missed_it() -> None:
    found = evaluate(record(guard=GUARD, sprays=(False, True)))
    assert found.missed > 0
    assert found.volume_error_percent == pytest.approx(-50.0, abs=1.0)


def test_what_is_sprayed_again_is_asked_for_as_ever() -> None:
    found = evaluate(record(guard=GUARD, sprays=(True, True)))
    assert (found.missed, found.volume_error_percent) == (0, pytest.approx(0.0, abs=0.1))


def test_ground_of_flights_before_is_treated() -> None:
    quad = ((-9.0, -9.0), (99.0, -9.0), (99.0, 20.0), (-9.0, 20.0))
    flown = record(guard=GUARD, sprays=(False, False))
    treated = Coverage().stamped([quad])
    strips = strips_of(replace(flown, treated=treated))
    assert max(float(strip.asked_ml[-1]) for strip in strips) == pytest.approx(0.0, abs=1.0)
    assert min(float(strip.asked_ml[-1]) for strip in strips_of(flown)) > 50.0
