"""Do the sensors of the liquid answer: each is opened and read for a moment, and judged."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass

from companion.core.types import FlowReport, Input, PressureReport, TankReport
from companion.doctor.check import Check, fail, not_applicable, ok, split_advice, warn
from companion.errors import SensorError
from companion.ports import Sensor

_STEP_S = 0.05
_NAME = "sensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class Read:
    """What the sensors said: why one is not to be had, and the last report of each kind."""

    refused: str | None = None
    reports: tuple[Input, ...] = ()


async def read_sensors(
    sensors: Sequence[Sensor],
    *,
    for_s: float = 1.0,
    clock: Callable[[], float] = time.monotonic,
) -> Read:
    """Open all sensors, read them for a while, and let go of them however it ends."""
    last: dict[type[Input], Input] = {}
    async with AsyncExitStack() as opened:
        for sensor in sensors:
            opened.push_async_callback(sensor.close)
            try:
                await sensor.open(_nothing)
            except SensorError as error:
                return Read(refused=str(error))
        until_s = clock() + for_s
        while (now_s := clock()) < until_s:
            for sensor in sensors:
                last.update((type(item), item) for item in sensor.read(now_s))
            await asyncio.sleep(_STEP_S)
    return Read(reports=tuple(last.values()))


def sensor_check(count: int, found: Read) -> Check:
    """Return how the sensors are; `count` of them are configured on this computer."""
    if not count:
        return not_applicable(_NAME, "none configured on this computer")
    if found.refused is not None:
        return fail(_NAME, *split_advice(found.refused, "see docs/reference/configuration.md"))
    faults = [fault for report in found.reports if (fault := _fault(report))]
    if faults:
        return fail(_NAME, faults[0], "check its wiring and supply, then try again")
    if not found.reports:
        return warn(_NAME, "no reading within a second", "check its wiring and supply")
    return ok(_NAME, ", ".join(_words(report) for report in found.reports))


def _fault(report: Input) -> str:
    return report.fault if isinstance(report, FlowReport | PressureReport | TankReport) else ""


def _words(report: Input) -> str:
    if isinstance(report, FlowReport):
        return f"meter at {report.volume_ml:.0f} mL"
    if isinstance(report, PressureReport) and report.pressure_kpa is not None:
        return f"pressure {report.pressure_kpa:.0f} kPa"
    if isinstance(report, TankReport) and report.level_l is not None:
        return f"tank {report.level_l:.1f} L"
    return "a reading is missing"


def _nothing() -> None:
    """Do nothing: the reading goes on anyway."""
