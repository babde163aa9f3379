from __future__ import annotations

from dataclasses import replace

import pytest

from companion.core.types import PwmLimits
from companion.doctor import gpio
from companion.doctor.check import Status
from companion.doctor.gpio import engine_checks, read_engine
from companion.errors import ActuatorError
from companion.output.engine.selftest import SelfTest
from companion.output.engine.wire import EngineSetup, Wiring

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
FOUND = SelfTest(
    outputs=2, wakes=100, median_late_s=1e-4, p99_late_s=9e-4, worst_late_s=3e-3
)  # fmt: skip


@pytest.mark.parametrize(
    ("found", "status", "text"),
    [
        (None, Status.NOT_APPLICABLE, "no GPIO"),
        (FOUND, Status.OK, "0.1 ms (median), 0.9 ms (p99)"),
        (replace(FOUND, p99_late_s=2e-3), Status.WARN, "2.0 ms (p99)"),
        (replace(FOUND, p99_late_s=float("nan")), Status.WARN, "nan"),
        (SelfTest(fault="wakes up 9.0 ms late"), Status.FAIL, "wakes up 9.0 ms late"),
    ],
)
def test_the_latency_is_judged(found: SelfTest | None, status: Status, text: str) -> None:
    (check,) = engine_checks(found)
    assert check.status is status
    assert text in check.text


def test_the_engine_is_started_without_its_lines() -> None:
    setup = EngineSetup(wiring=Wiring(valves=(17, 18)), pwm=PWM, device="/nonexistent/gpiochip9")
    found = read_engine(setup)
    assert found.outputs == 2
    assert found.wakes >= 100


def test_an_engine_that_did_not_start_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    class Lame:
        self_test = None

        def __init__(self, _setup: EngineSetup) -> None:
            made.append("made")

        async def start(self) -> None:
            raise ActuatorError("it did not answer")

        async def stop(self) -> None:
            made.append("stopped")

    monkeypatch.setattr(gpio, "GpioExecutor", Lame)
    assert read_engine(EngineSetup(wiring=Wiring(valves=(17,)), pwm=PWM)).fault
    assert made == ["made", "stopped"]
