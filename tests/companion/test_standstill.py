"""A companion that stood still: what waited meanwhile is not taken for news."""

from __future__ import annotations

import time
from collections.abc import Sequence

import pytest

from companion.core.types import (
    Decision,
    EstimatorReport,
    EstopReport,
    Fix,
    GnssReport,
    HeartbeatReport,
    Input,
    LandedReport,
    OperatorCommand,
    SpeedReport,
    SprayPlan,
    StandstillReport,
)
from companion.runtime import DEAF_S, STANDSTILL_S, ControlLoop, NoRecorder, boot_time_s
from tests.builders import position, setup


class Bench:
    """Link, executor, recorder and clocks of a control loop, all by hand."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.asleep_s = 0.0
        self.waiting: list[Input] = []
        self.plans: list[SprayPlan] = []
        self.texts: list[str] = []
        self.inputs: list[Input] = []
        self.fault: str | None = None
        recorder = NoRecorder()
        recorder.record_input = self.inputs.append  # type: ignore[method-assign]
        self.loop = ControlLoop(
            setup(),
            link=self,
            executor=self,
            recorder=recorder,
            clock=lambda: self.now_s,
            boot_clock=lambda: self.now_s + self.asleep_s,
        )

    async def open(self, wake: object) -> None:
        """Nothing to open."""

    async def start(self) -> None:
        """Nothing to take."""

    async def stop(self) -> None:
        """Nothing to close."""

    async def close(self) -> None:
        """Nothing to let go of."""

    def receive(self) -> Sequence[Input]:
        came, self.waiting = self.waiting, []
        return came

    def tell(self, decision: Decision | None, now_s: float) -> None:
        """Nobody listens."""

    def tell_fault(self, text: str) -> None:
        self.texts.append(text)

    is_guarded = True

    def submit(self, plan: SprayPlan) -> None:
        self.plans.append(plan)

    def messages(self, east_m: float, boot_s: float | None = None) -> list[Input]:
        now_s = self.now_s
        beat = HeartbeatReport(received_s=now_s, autopilot="a", armed=True, mode="AUTO")
        return [
            position(now_s, east_m, 3.0, boot_s=now_s if boot_s is None else boot_s),
            beat,
            SpeedReport(received_s=now_s, ground_speed_m_s=5.0),
            GnssReport(received_s=now_s, fix=Fix.RTK_FIXED),
            EstimatorReport(received_s=now_s, healthy=True),
            LandedReport(received_s=now_s, in_air=True),
        ]

    def fly(self, seconds: float, east_m: float) -> float:
        """Fly on from a place, 20 messages a second, and return where it ends."""
        for _ in range(round(seconds / 0.05)):
            self.now_s += 0.05
            east_m += 0.25
            self.waiting += self.messages(east_m)
            self.loop.turn()
        return east_m

    def enable(self) -> None:
        self.waiting.append(OperatorCommand(received_s=self.now_s, enable=True, source="command"))

    @property
    def is_open(self) -> bool:
        return not self.plans[-1].is_off


def flying() -> tuple[Bench, float]:
    bench = Bench()
    east_m = bench.fly(1.5, 2.0)
    bench.enable()
    east_m = bench.fly(1.0, east_m)
    assert bench.is_open
    return bench, east_m


@pytest.mark.parametrize("gap_s", [0.6, 1.5, 3.0, 4.9, 10.0])
@pytest.mark.parametrize("by_sleep", [False, True])
def test_positions_that_waited_open_nothing(gap_s: float, by_sleep: bool) -> None:
    bench, east_m = flying()
    began_s = bench.now_s
    if by_sleep:
        bench.asleep_s += gap_s  # the monotonic clock stands meanwhile
    else:
        bench.now_s += gap_s
    queued = round(gap_s / 0.05)
    for count in range(queued):
        bench.now_s += 0.001
        bench.waiting += bench.messages(east_m + 0.25 * count, began_s + 0.05 * count)
        bench.loop.turn()
        assert not bench.is_open
    assert f"companion paused for {gap_s:.1f} s" in bench.texts


def test_it_goes_on_by_itself_after_a_short_one_and_asks_after_a_long_one() -> None:
    for gap_s, goes_on in ((1.0, True), (3.0, False)):
        bench, _ = flying()
        bench.now_s += gap_s
        bench.fly(DEAF_S - 0.1, 10.0)
        assert not bench.is_open
        bench.fly(1.5, 14.0)
        assert bench.is_open == goes_on


def test_what_closes_is_heard_though_it_waited() -> None:
    bench, _ = flying()
    bench.now_s += 1.0
    stop = EstopReport(received_s=bench.now_s, pressed=True, source="command")
    off = OperatorCommand(received_s=bench.now_s, enable=False, source="command")
    on = OperatorCommand(received_s=bench.now_s, enable=True, source="command")
    bench.waiting += [stop, off, on, *bench.messages(20.0)]
    bench.inputs.clear()
    bench.loop.turn()
    kinds = [type(item) for item in bench.inputs]
    assert kinds == [StandstillReport, EstopReport, OperatorCommand, HeartbeatReport]
    assert not bench.is_open


def test_a_short_delay_is_no_standstill() -> None:
    bench, east_m = flying()
    bench.now_s += STANDSTILL_S - 0.05
    bench.fly(0.05, east_m)
    assert not bench.texts


def test_the_computers_sleep_is_time_too(monkeypatch: pytest.MonkeyPatch) -> None:
    # On a computer that has not slept both clocks say the same.
    clocks = {time.CLOCK_BOOTTIME: 107.0, time.CLOCK_MONOTONIC: 7.0}
    monkeypatch.setattr(time, "clock_gettime", clocks.__getitem__)
    monkeypatch.setattr(time, "monotonic", lambda: 7.0)
    assert boot_time_s() == 107.0
