"""Pressure before the valves, from a 4 to 20 mA transmitter."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from companion.core.types import Input, PressureReport
from companion.sensors.gauge import Gauge


class PressureSensor:
    """The mean pressure of the last whole PWM periods, at every step."""

    def __init__(self, gauge: Gauge) -> None:
        self._gauge = gauge

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Find the converter: SensorError where there is none."""
        await self._gauge.open()

    def read(self, now_s: float) -> Sequence[Input]:
        """Return the pressure, or the fault of the sensor."""
        found = self._gauge.value(now_s)
        if found is None:
            return []
        kpa, fault = found
        return [PressureReport(received_s=now_s, pressure_kpa=kpa, fault=fault)]

    async def close(self) -> None:
        """Let go of the converter."""
        await self._gauge.close()
