"""The doctor's look at the sensors: opened, read, let go of, and judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import pytest

from companion.core.types import FlowReport, Input, PressureReport, TankReport
from companion.doctor.check import Status
from companion.doctor.gpio import Read, read_sensors, sensor_check
from companion.errors import SensorError

PRESSURE = PressureReport(received_s=1.0, pressure_kpa=250.0)
BROKEN = PressureReport(received_s=1.0, pressure_kpa=None, fault="pressure: wire broken (0.1 mA)")


class FakeSensor:
    def __init__(self, *reports: Input, refusal: str = "", is_broken: bool = False) -> None:
        self.reports, self.refusal, self.is_broken = reports, refusal, is_broken
        self.closed = 0

    async def open(self, wake: Callable[[], None]) -> None:
        if self.refusal:
            raise SensorError(self.refusal)

    def read(self, now_s: float) -> Sequence[Input]:
        if self.is_broken:
            raise RuntimeError("broken")
        return self.reports

    async def close(self) -> None:
        self.closed += 1


@pytest.mark.parametrize(
    ("reports", "status", "text"),
    [
        ((FlowReport(received_s=1.0, volume_ml=12.0), PRESSURE), Status.OK, "pressure 250 kPa"),
        ((TankReport(received_s=1.0, level_l=7.0),), Status.OK, "tank 7.0 L"),
        ((BROKEN,), Status.FAIL, "wire broken"),
        ((FlowReport(received_s=1.0, volume_ml=0.0, fault="pulses lost"),), Status.FAIL, "lost"),
        ((), Status.WARN, "no reading"),
    ],
)
async def test_what_they_say(reports: tuple[Input, ...], status: Status, text: str) -> None:
    sensor = FakeSensor(*reports)
    found = sensor_check(1, await read_sensors([sensor], for_s=0.01))
    assert (found.status, text in found.text, sensor.closed) == (status, True, 1)


async def test_one_that_is_not_to_be_had_is_told_and_all_are_let_go() -> None:
    first, second = FakeSensor(PRESSURE), FakeSensor(refusal="line 5: held; see gpioinfo")
    found = sensor_check(2, await read_sensors([first, second], for_s=0.01))
    assert (found.status, found.text, found.fix) == (Status.FAIL, "line 5: held", "see gpioinfo")
    assert (first.closed, second.closed) == (1, 1)


async def test_they_are_let_go_when_reading_fails() -> None:
    sensor = FakeSensor(is_broken=True)
    with pytest.raises(RuntimeError, match="broken"):
        await read_sensors([sensor], for_s=1.0)
    assert sensor.closed == 1


def test_none_is_not_applicable() -> None:
    assert sensor_check(0, Read()).status is Status.NOT_APPLICABLE
