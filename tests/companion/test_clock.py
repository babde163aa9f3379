"""The autopilot's clock: slow, fast, set, and told of by somebody else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from companion.core.estimator import Track, estimate, observe
from companion.core.safety import Consent
from companion.core.types import ClockReport
from tests.bench.clocks import (
    ONE,
    RATES,
    SETUP,
    SHIFT_MAX_M,
    SPEED_M_S,
    STEPS_S,
    UP_S,
    Vehicle,
    is_trusted,
    shifts_m,
)


@pytest.mark.parametrize("has_timesync", [True, False])
@pytest.mark.parametrize("rate", RATES)
def test_a_clock_of_another_rate_shifts_nothing(rate: float, has_timesync: bool) -> None:
    times, off = shifts_m(Vehicle(rate=rate, has_timesync=has_timesync))
    assert len(times) > 0.97 * 60.0 * 20.0
    settled = np.array(off)[np.array(times) > 5.0]
    limit_m = SHIFT_MAX_M * max(abs(rate) / 0.01, 1.0)
    assert np.abs(settled).max() <= limit_m
    # Before that too it is never far off, and no step is more than noise.
    assert np.abs(off).max() <= 3.0 * limit_m
    assert np.abs(np.diff(off)).max() <= SHIFT_MAX_M


@pytest.mark.parametrize("has_timesync", [True, False])
@pytest.mark.parametrize("by_s", STEPS_S)
def test_a_clock_that_is_set_closes_until_it_is_known_again(
    by_s: float, has_timesync: bool
) -> None:
    vehicle = Vehicle(steps=((20.0, by_s),), has_timesync=has_timesync)
    times, off = shifts_m(vehicle)
    wrong_s = [
        now_s for now_s, off_m in zip(times, off, strict=True) if abs(off_m) > 3.0 * SHIFT_MAX_M
    ]
    # Nobody can know at once that all that comes is late, and not just a message or two.
    assert all(20.0 <= now_s <= 20.4 + max(-by_s, 0.0) for now_s in wrong_s)
    assert max(times) < 21.0 or np.diff(times).max() >= 0.25
    if has_timesync or by_s > -1.0:
        assert max(times) > 59.0
        assert np.diff(times).max() <= 10.0


def test_a_rate_that_wanders_is_followed() -> None:
    # A simulation that is 1 % slow for twenty seconds, and then in time again.
    slow = tuple((20.0 + i / 50, -0.0002) for i in range(1000))
    vehicle = Vehicle(steps=slow)
    # Asked once a second: by 3.5 s after the rate changed the time is 0.0307 s off, 0.154 m at
    # 5 m/s, and two answers that do not go with it close. Asked five times a second, as where
    # it answers within 50 ms, 0.07 m (below).
    times, late_s = [], []
    for now_s, off_s, track in vehicle.tracked(60.0):
        state = estimate(track, now_s)
        assert state is not None
        if is_trusted(state, now_s):
            times.append(now_s)
            late_s.append(off_s)
            # The place adds nothing to that: a filter that was slow to follow hid a fifth of it.
            assert abs(state.east_m - SPEED_M_S * (now_s - off_s)) <= 0.005
    assert np.abs(late_s).max() <= 0.031
    assert len(times) > 0.75 * 60.0 * 20.0


@pytest.mark.parametrize("rate", [-0.05, 0.05, 0.2])
def test_what_runs_like_no_clock_closes(rate: float) -> None:
    for has_timesync in (True, False):
        times, _ = shifts_m(Vehicle(rate=rate, has_timesync=has_timesync), 30.0)
        assert not [now_s for now_s in times if now_s > 5.0]


@pytest.mark.parametrize("ahead_s", [-0.45, -0.2, 0.2, 0.45, 100.0, -1.7e9])
def test_answers_that_do_not_go_with_the_positions_close(ahead_s: float) -> None:
    track = Track(consent=Consent(enabled=True))
    for i in range(100):
        now_s = i / 10
        latitude, longitude = SETUP.frame.to_geographic(SPEED_M_S * now_s, 3.0)
        item = replace(
            ONE,
            received_s=now_s + 0.005,
            boot_s=now_s + UP_S,
            latitude_deg=latitude,
            longitude_deg=longitude,
        )
        if i % 10 == 5:
            lie_s = 0.0 if i < 50 else ahead_s
            report = ClockReport(received_s=now_s, offset_s=-UP_S - lie_s, round_trip_s=0.01)
            track = observe(track, report, SETUP)
        track = observe(track, item, SETUP)
        state = estimate(track, item.received_s)
        assert state is not None
        assert state.clock_agrees == (i < 55)


@pytest.mark.parametrize("jitter_s", [0.02, 0.1])
def test_a_link_with_jitter_is_no_clock_that_is_set(jitter_s: float) -> None:
    times, off = shifts_m(Vehicle(jitter_s=jitter_s, way_s=0.02))
    assert len(times) > 0.97 * 60.0 * 20.0
    settled = np.array(off)[np.array(times) > 5.0]
    assert np.abs(settled).max() <= 0.5 * SPEED_M_S * jitter_s


@pytest.mark.parametrize("held_up_s", [0.009, 0.036])
def test_an_autopilot_that_was_held_up_as_it_answered_closes_nothing(held_up_s: float) -> None:
    # A short way, as on one computer: nothing of the hold-up hides in the round trip.
    times, off = shifts_m(Vehicle(held_up_s=held_up_s, way_s=0.0003, jitter_s=0.0005))
    assert len([now_s for now_s in times if now_s > 5.0]) == 55 * 20
    assert np.abs(np.array(off)[np.array(times) > 5.0]).max() <= SHIFT_MAX_M


# Beside a real ArduCopter in simulation, on a busy computer: asked five times a second, over a way
# of a millisecond, it is held up for 6 to 57 ms as it answers, in up to three exchanges in turn.
BUSY = Vehicle(asks_s=0.2, way_s=0.001, jitter_s=0.002)


def closed_s(times: list[float], *, from_s: float = 5.0, hz: float = 20.0) -> float:
    """Return for how long the clock was not trusted."""
    return (60.0 - from_s) - len([now_s for now_s in times if now_s > from_s]) / hz


@pytest.mark.parametrize("seed", range(5))
def test_answers_of_a_busy_autopilot_close_nothing(seed: int) -> None:
    times, off = shifts_m(BusyVehicle(seed=seed))
    assert closed_s(times) == pytest.approx(0.0, abs=0.01)
    assert np.abs(np.array(off)[np.array(times) > 5.0]).max() <= SHIFT_MAX_M


@dataclass(frozen=True, kw_only=True)
class BusyVehicle(Vehicle):
    """Held up as it answers, once or up to three times in turn, by the same or by another time."""

    asks_s: float = 0.2
    way_s: float = 0.001
    jitter_s: float = 0.002

    def exchange(self, asked_s: float, there_s: float, back_s: float) -> ClockReport:
        report = super().exchange(asked_s, there_s, back_s)
        late_ms = HELD_UP_MS[(round(asked_s / self.asks_s) + 3 * self.seed) % len(HELD_UP_MS)]
        return replace(report, offset_s=report.offset_s + late_ms / 1000.0)


HELD_UP_MS = (0, 0, 25, 0, 0, 9, 36, 0, 0, 57, 23, 0, 0, 24, 24, 26, 0, 7, 7, 7, 0, 27, 0, 0, 0)


@pytest.mark.parametrize("by_s", [-0.045, -0.025, 0.025])
def test_a_simulation_that_stood_still_goes_on_by_its_new_clock(by_s: float) -> None:
    # It lost 25 ms for good: both the positions and the answers are late by it from then on.
    times, off = shifts_m(replace(BUSY, steps=((20.0, by_s),)))
    assert closed_s(times) == pytest.approx(0.0, abs=0.01)
    assert np.abs(off).max() <= SPEED_M_S * abs(by_s) + SHIFT_MAX_M
    for at_s, shift_max_m in ((21.0, 0.25 * SPEED_M_S * abs(by_s)), (22.0, SHIFT_MAX_M)):
        assert np.abs(np.array(off)[np.array(times) > at_s]).max() <= shift_max_m


@pytest.mark.parametrize("by_s", [-0.45, -0.1, 0.1, 0.45])
def test_a_clock_that_is_set_is_known_again_within_a_second(by_s: float) -> None:
    times, off = shifts_m(replace(BUSY, steps=((20.0, by_s),)))
    wrong_s = [at_s for at_s, off_m in zip(times, off, strict=True) if abs(off_m) > 0.06]
    assert len(wrong_s) <= 6
    assert 0.1 <= closed_s(times) <= 1.2 + max(-by_s, 0.0)


def test_answers_that_go_on_to_be_impossible_close() -> None:
    # 40 ms behind the positions for good: neither of the two can be believed.
    track, agrees = Track(consent=Consent(enabled=True)), []
    for i in range(200):
        now_s = i / 20
        item = replace(ONE, received_s=now_s + 0.005, boot_s=now_s + UP_S)
        if i % 4 == 2:
            lie_s = 0.0 if i < 100 else 0.04
            report = ClockReport(received_s=now_s, offset_s=lie_s - UP_S, round_trip_s=0.004)
            track = observe(track, report, SETUP)
        latitude, longitude = SETUP.frame.to_geographic(SPEED_M_S * now_s, 3.0)
        track = observe(track, replace(item, latitude_deg=latitude, longitude_deg=longitude), SETUP)
        state = estimate(track, item.received_s)
        assert state is not None
        agrees.append(state.clock_agrees)
    # Beside a simulation that is so for three answers in turn, 0.6 s, every minute.
    assert all(agrees[:118])
    assert not any(agrees[132:])


def test_a_rate_that_wanders_is_followed_by_frequent_exchanges() -> None:
    slow = tuple((20.0 + i / 50, -0.0002) for i in range(1000))
    times, off = shifts_m(replace(BUSY, steps=slow))
    assert np.abs(off).max() <= 0.08
    assert closed_s(times) <= 0.5
