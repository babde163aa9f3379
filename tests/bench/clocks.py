"""The autopilot's clock is slow, fast or set: how far that shifts where the vehicle is taken to be.

Messages only: positions at 20 a second over a link with jitter, with and without TIMESYNC, through
the estimator. What is asked for is the largest error of the place at 5 m/s while a valve may open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from companion.core.estimator import Track, estimate, observe
from companion.core.safety import Consent
from companion.core.types import ClockReport, VehicleState
from tests import builders
from tests.bench.figures import Figure
from tests.builders import setup

SECTION = "A clock of another rate"
SETUP = setup()
ONE = builders.position(0.0, 0.0, 3.0)
SPEED_M_S = 5.0
UP_S = 300.0
# A change at 5 m/s must not shift by more than this once all is settled.
SHIFT_MAX_M = 0.02
SETTLED_S = 5.0
RATES = (-0.02, -0.01, -0.001, 0.0, 0.001, 0.01, 0.02)
STEPS_S = (-5.0, -0.45, -0.1, 0.1, 0.45, 5.0)
STEP_AT_S = 20.0


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """Flies eastwards at 5 m/s from time 0, with a clock of its own behind a link of its own."""

    rate: float = 0.0  # how much faster its clock is
    steps: tuple[tuple[float, float], ...] = ()  # when it is set, and by how much
    way_s: float = 0.004
    jitter_s: float = 0.003
    hz: float = 20.0
    has_timesync: bool = True
    held_up_s: float = 0.0  # how far its clock is behind when it answers, now and then
    asks_s: float = 1.0  # how often it is asked for its time
    seed: int = 1

    def boot_s(self, now_s: float) -> float:
        ahead_s = sum(by_s for at_s, by_s in self.steps if now_s >= at_s)
        if 0.5001 < now_s % 5.0 < 0.530:
            ahead_s -= self.held_up_s
        return UP_S + now_s * (1.0 + self.rate) + ahead_s

    def flown(self, end_s: float, *, enabled: bool = True) -> Iterator[tuple[float, VehicleState]]:
        """Yield our time and the state at every position."""
        for received_s, _, track in self.tracked(end_s, enabled=enabled):
            state = estimate(track, received_s)
            assert state is not None
            yield received_s, state

    def tracked(
        self, end_s: float, *, enabled: bool = True
    ) -> Iterator[tuple[float, float, Track]]:
        """Yield when every position came, how far its time is off, and what is known then."""
        rng = np.random.default_rng(self.seed)
        track, ask_s = Track(consent=Consent(enabled=enabled)), 0.5
        for i in range(round(end_s * self.hz)):
            sent_s = i / self.hz
            late_s, there_s, back_s = (self.way_s + self.jitter_s * rng.random(3)).tolist()
            if self.has_timesync and sent_s >= ask_s:
                track = observe(track, self.exchange(ask_s, there_s, back_s), SETUP)
                ask_s += self.asks_s
            latitude, longitude = SETUP.frame.to_geographic(SPEED_M_S * sent_s, 3.0)
            item = replace(
                ONE,
                received_s=sent_s + late_s,
                boot_s=round(self.boot_s(sent_s), 3),
                latitude_deg=latitude,
                longitude_deg=longitude,
            )
            track = observe(track, item, SETUP)
            assert track.clock is not None
            yield item.received_s, item.boot_s + track.clock.sent_offset_s - sent_s, track

    def exchange(self, asked_s: float, there_s: float, back_s: float) -> ClockReport:
        answered_s = asked_s + there_s + back_s
        offset_s = 0.5 * (asked_s + answered_s) - self.boot_s(asked_s + there_s)
        return ClockReport(received_s=answered_s, offset_s=offset_s, round_trip_s=there_s + back_s)


def is_trusted(state: VehicleState, now_s: float) -> bool:
    young = -0.1 <= now_s - state.position_received_s <= 0.8
    return state.position_valid and state.clock_agrees and young


def shifts_m(vehicle: Vehicle, end_s: float = 60.0) -> tuple[list[float], list[float]]:
    """Return when the place was trusted, and how far it was off then."""
    way_s = 0.0 if vehicle.has_timesync else vehicle.way_s + 0.5 * vehicle.jitter_s
    times, off = [], []
    for now_s, state in vehicle.flown(end_s):
        if is_trusted(state, now_s):
            times.append(now_s)
            off.append(state.east_m - SPEED_M_S * (now_s - way_s))
    return times, off


def clock_figures(*, seed: int, count: int) -> list[Figure]:
    """Measure every rate and step, with and without TIMESYNC, over some seeds."""
    return [
        *(_rate(rate, has, seed, count) for has in (True, False) for rate in RATES),
        *(_step(by_s, has, seed, count) for has in (True, False) for by_s in STEPS_S),
    ]


def _way(has_timesync: bool) -> str:
    return "timesync" if has_timesync else "arrivals"


def _rate(rate: float, has_timesync: bool, seed: int, count: int) -> Figure:
    worst = []
    for number in range(seed, seed + count):
        times, off = shifts_m(Vehicle(rate=rate, has_timesync=has_timesync, seed=number))
        settled = np.array(times) > SETTLED_S
        worst.append(float(np.abs(np.array(off)[settled]).max(initial=0.0)))
    way = _way(has_timesync)
    return Figure(
        key=f"clock_rate_{way}_{100.0 * rate:+.1f}",
        what=f"largest shift by a clock {100.0 * rate:+.1f} % fast, by {way}",
        value=max(worst),
        unit="m",
        n=count,
        target=SHIFT_MAX_M if abs(rate) <= 0.01 else None,
        section=SECTION,
        row=f"clock of another rate, by {way}",
    )


def _step(by_s: float, has_timesync: bool, seed: int, count: int) -> Figure:
    """Measure for how long the place was wrong and trusted after a step, and how long closed."""
    wrong_s, closed_s = [], []
    for number in range(seed, seed + count):
        steps = ((STEP_AT_S, by_s),)
        vehicle = Vehicle(steps=steps, has_timesync=has_timesync, seed=number)
        times, off = shifts_m(vehicle)
        wrong_s.append(sum(abs(off_m) > 3.0 * SHIFT_MAX_M for off_m in off) / vehicle.hz)
        closed_s.append(60.0 - len(times) / vehicle.hz)
    way = _way(has_timesync)
    return Figure(
        key=f"clock_step_{way}_{by_s:+.2f}",
        what=f"time trusted and wrong by more than 6 cm, clock set by {by_s:+.2f} s, by {way}",
        value=max(wrong_s),
        unit="s",
        n=count,
        details={"closed_s": max(closed_s)},
        section=SECTION,
        row=f"clock that is set, by {way}",
    )
