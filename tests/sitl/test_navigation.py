from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.core.frame import LocalFrame
from companion.core.types import SpeedReport, Telemetry
from sitl.earth import Earth
from sitl.navigation import Navigation
from sitl.vehicle import Truth

FRAME = LocalFrame(latitude_deg=35.996089, longitude_deg=114.543487)


@dataclass(frozen=True)
class Straight:
    """A source that flies north-east at 5 m/s for ever."""

    def truth_at(self, time_s: float) -> Truth:
        return Truth(
            time_s=time_s,
            east_m=3.0 * time_s,
            north_m=4.0 * time_s,
            height_m=3.5,
            velocity_east_m_s=3.0,
            velocity_north_m_s=4.0,
            heading_deg=359.999,
        )


def positions(navigation: Navigation, until_s: float) -> list[Telemetry]:
    return [item for item in navigation.advance(until_s) if isinstance(item, Telemetry)]


def errors_m(found: list[Telemetry], lag_s: float) -> NDArray[np.float64]:
    local = np.array([FRAME.to_local(item.latitude_deg, item.longitude_deg) for item in found])
    sent_s = np.array([item.boot_s for item in found])
    errors: NDArray[np.float64] = local - np.outer(sent_s - lag_s, (3.0, 4.0))
    return errors


def test_the_position_is_that_of_the_estimators_lag_ago() -> None:
    found = positions(
        Navigation(Straight(), FRAME, seed=1, noise=False, estimator_lag_s=0.031), 20.0
    )
    # What is left is the quantisation of the wire: 1e-7 degrees are 11 mm.
    assert np.abs(errors_m(found, 0.031)).max() < 0.012


def test_the_position_has_the_noise_of_rtk() -> None:
    left = []
    for seed in range(40):
        found = positions(Navigation(Straight(), FRAME, seed=seed), 60.0)
        left.append(errors_m(found, 0.031))
    assert np.std(np.concatenate(left)) == pytest.approx(0.020, abs=0.003)
    wander = np.array([one.mean(axis=0) for one in left])
    assert np.std(wander) == pytest.approx(0.009, abs=0.004)


def test_the_velocity_has_its_noise_and_comes_in_cm_s() -> None:
    found = positions(Navigation(Straight(), FRAME, seed=1), 100.0)
    east = np.array([item.velocity_east_m_s for item in found])
    assert np.std(east) == pytest.approx(0.03, abs=0.004)
    assert np.abs(east * 100.0 - np.round(east * 100.0)).max() < 1e-9


def test_fields_are_quantised_as_on_the_wire() -> None:
    item = positions(Navigation(Straight(), FRAME, seed=1), 3.0)[-1]
    for value in (item.latitude_deg * 1e7, item.longitude_deg * 1e7, item.boot_s * 1e3):
        assert value == pytest.approx(round(value), abs=1e-4)
    assert item.heading_deg == 0.0


def test_messages_arrive_late_with_jitter_and_in_order() -> None:
    navigation = Navigation(
        Straight(), FRAME, seed=1, position_rate_hz=200.0, message_delay_s=0.02, jitter_s=0.003
    )
    found = navigation.advance(20.0)
    received_s = [item.received_s for item in found]
    assert received_s == sorted(received_s)
    late_s = np.array([i.received_s - i.boot_s for i in found if isinstance(i, Telemetry)])
    assert late_s.min() >= 0.0
    assert np.mean(late_s) == pytest.approx(0.02, abs=0.002)
    assert np.std(late_s) == pytest.approx(0.003, abs=0.001)


def test_nothing_arrives_before_its_time() -> None:
    navigation = Navigation(Straight(), FRAME, seed=1, message_delay_s=0.5)
    assert navigation.advance(0.45) == []
    assert all(item.received_s <= 3.0 for item in navigation.advance(3.0))


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 20.0])
def test_the_rates_are_as_asked(rate_hz: float) -> None:
    found = Navigation(Straight(), FRAME, seed=1, position_rate_hz=rate_hz).advance(60.0)
    assert sum(isinstance(i, Telemetry) for i in found) == pytest.approx(60 * rate_hz, abs=2)
    assert sum(isinstance(i, SpeedReport) for i in found) == pytest.approx(600, abs=2)


def test_the_speed_report_agrees_with_the_velocity() -> None:
    found = Navigation(Straight(), FRAME, seed=1).advance(60.0)
    speeds = [item.ground_speed_m_s for item in found if isinstance(item, SpeedReport)]
    assert np.mean(speeds) == pytest.approx(5.0, abs=0.01)


def test_asking_in_pieces_changes_no_message() -> None:
    whole = Navigation(Straight(), FRAME, seed=4).advance(10.0)
    navigation = Navigation(Straight(), FRAME, seed=4)
    pieces = [item for i in range(1, 201) for item in navigation.advance(0.05 * i)]
    assert pieces == whole


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="rate"):
        Navigation(Straight(), FRAME, seed=1, position_rate_hz=float("nan"))


@pytest.mark.parametrize("latitude_deg", [-52.0, 0.0, 36.0, 65.0])
def test_the_twins_earth_is_the_programs_to_a_millimetre(latitude_deg: float) -> None:
    """Two ways to lay the ellipsoid flat, written apart."""
    earth, frame = Earth(latitude_deg, 114.5), LocalFrame(latitude_deg, 114.5)
    east_m, north_m = np.random.default_rng(1).uniform(-10_000.0, 10_000.0, (2, 300))
    theirs = frame.to_local_all(*earth.to_geographic_all(east_m, north_m))
    assert np.abs(np.array(theirs) - (east_m, north_m)).max() < 0.001
    back = earth.to_local_all(*frame.to_geographic_all(east_m.tolist(), north_m.tolist()))
    assert np.abs(np.array(back) - (east_m, north_m)).max() < 0.001
