"""The sensors of a run: what the configuration names, not yet open; and the stop on a line.

This is the program's own ear for it. The stop itself is wired into the relay of pump and master
valve, and works without any program.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from datetime import timedelta
from typing import Any, Protocol

from companion.config import Config
from companion.config.rules import tank_capacity_l
from companion.config.sprayer_tables import ConverterTable
from companion.core.types import EstopReport, Input, PressureReport, TankReport
from companion.errors import SensorError
from companion.link.vehicle_link import VehicleLink
from companion.output.engine.lines import find_chip, load_gpiod
from companion.ports import Sensor
from companion.sensors import (
    CurrentLoop,
    Edge,
    EdgeSource,
    FlowMeter,
    Gauge,
    I2cVoltage,
    IioVoltage,
    Meter,
    VoltageSource,
)

# ----------------------------------------------------------------------------------------- the stop


class LevelSource(Protocol):
    """The level of one input line."""

    def open(self) -> None:
        """Take the line, or raise `SensorError`."""

    def is_high(self) -> bool:
        """Return whether it is high or has been since the last look; OSError where unknown."""

    def fileno(self) -> int | None:
        """Return a file that becomes readable when the level changes; None where there is none."""

    def close(self) -> None:
        """Let go of the line; may be called twice and before `open`."""


class EstopSwitch:
    """A `ports.Sensor`: tells when the switch is pressed and when it is released.

    The closed contact pulls the line down; high, or no level at all, is pressed.
    """

    def __init__(self, source: LevelSource) -> None:
        self._source = source
        self._told: bool | None = None
        self._file: int | None = None

    async def open(self, wake: Callable[[], None]) -> None:
        """Take the line; `wake` is called as soon as its level changes."""
        self._source.open()
        self._file = self._source.fileno()
        if self._file is not None:
            asyncio.get_running_loop().add_reader(self._file, wake)

    def read(self, now_s: float) -> Sequence[Input]:
        """Return the switch's state where it is news."""
        try:
            pressed = self._source.is_high()
        except OSError:
            pressed = True
        if pressed == self._told:
            return ()
        self._told = pressed
        return (EstopReport(received_s=now_s, pressed=pressed, source="line"),)

    async def close(self) -> None:
        """Let go of the line; may be called twice and before `open`."""
        file, self._file = self._file, None
        if file is not None:
            asyncio.get_running_loop().remove_reader(file)
        self._source.close()


# --------------------------------------------------------------------- what the configuration names

# The nozzle sets' largest flow is measured; a burst hose gives more, a broken wire far more.
FLOW_MAX_FACTOR = 2.0
LEVEL_HZ = 5.0
PRESSURE_PERIODS = 3


def build_sensors(config: Config) -> list[Sensor]:
    """Return the sensors that this computer reads, in the order in which they are read."""
    sensors: list[Sensor] = []
    if config.safety.estop_line is not None:
        line = GpiodLevel(config.output.chip, config.safety.estop_line, key="safety.estop_line")
        sensors.append(EstopSwitch(line))
    parts = pulse_meter(config)
    meter = None if parts is None else FlowMeter(*parts)
    if meter is not None:
        sensors.append(meter)
    pressure = _pressure(config)
    if pressure is not None:
        sensors.append(pressure)
    tank = _tank(config, meter)
    if tank is not None:
        sensors.append(tank)
    return sensors


def follow_refills(sensors: Sequence[Sensor], link: VehicleLink) -> None:
    """Have the tank's sensor learn of what the operator fills in."""
    for sensor in sensors:
        if isinstance(sensor, TankSensor):
            link.on_refilled(sensor.refilled)


def pulse_meter(config: Config) -> tuple[Meter, EdgeSource] | None:
    """Return what is known of the flow meter that this computer reads, and its pulses."""
    table = config.flow_meter
    if not table.is_read_here or table.line is None or table.pulses_per_l is None:
        return None
    largest_l_min = max(nozzles.flow_max_l_min for nozzles in config.nozzle_sets())
    meter = Meter(
        pulses_per_l=table.pulses_per_l,
        flow_max_l_min=table.flow_max_l_min or FLOW_MAX_FACTOR * largest_l_min,
        pwm_period_s=config.pwm_limits().period_s,
    )
    return meter, GpiodEdges(table.chip, table.line, pull=table.pull)


def _voltage(table: ConverterTable, source: str) -> VoltageSource:
    if source == "i2c":
        return I2cVoltage(table.i2c_bus, table.i2c_address, table.channel)
    return IioVoltage(table.device, table.channel)


def _pressure(config: Config) -> PressureSensor | None:
    table = config.pressure
    if not table.is_read_here:
        return None
    loop = CurrentLoop(
        name="pressure",
        shunt_ohm=table.shunt_ohm,
        at_4_ma=table.at_4_ma_kpa,
        at_20_ma=table.at_20_ma_kpa,
    )
    window_s = PRESSURE_PERIODS * config.pwm_limits().period_s
    voltage = _voltage(table, table.source)
    return PressureSensor(Gauge(loop, voltage, rate_hz=table.rate_hz, window_s=window_s))


def _tank(config: Config, meter: FlowMeter | None) -> TankSensor | None:
    table, capacity_l = config.tank, tank_capacity_l(config)
    if not table.is_read_here or capacity_l is None:
        return None
    gauge = None
    if table.source in ("iio", "i2c"):
        loop = CurrentLoop(
            name="tank",
            shunt_ohm=table.shunt_ohm,
            at_4_ma=table.at_4_ma_l,
            at_20_ma=table.at_20_ma_l,
        )
        voltage = _voltage(table, table.source)
        gauge = Gauge(loop, voltage, rate_hz=LEVEL_HZ, window_s=1.0)
    return TankSensor(
        meter,
        gauge,
        capacity_l=capacity_l,
        filled_l=table.filled_l,
        tolerance_l=table.tolerance_l,
    )


# Edges of a GPIO line by libgpiod 2, each with the kernel's own time.

# A second of pulses at 1 kHz; the kernel drops and numbers what does not fit.
BUFFER_SIZE = 1024
NANOSECONDS = 1e9
_NO_WAIT = timedelta(0)


class GpiodEdges:
    """The rising edges of one line; the module is only needed where a line is."""

    def __init__(self, chip: str, line: int, *, pull: str = "as-is") -> None:
        self._chip = chip
        self._line = line
        self._pull = pull
        self._request: Any = None

    def open(self) -> None:
        """Take the line: SensorError where the module, the chip or the line is not to be had."""
        gpiod = load_gpiod(SensorError)
        bias = {
            "up": gpiod.line.Bias.PULL_UP,
            "down": gpiod.line.Bias.PULL_DOWN,
            "as-is": gpiod.line.Bias.AS_IS,
        }[self._pull]
        settings = gpiod.LineSettings(
            direction=gpiod.line.Direction.INPUT,
            edge_detection=gpiod.line.Edge.RISING,
            event_clock=gpiod.line.Clock.MONOTONIC,
            bias=bias,
        )
        try:
            self._request = gpiod.request_lines(
                find_chip(gpiod, self._chip, SensorError),
                consumer="vrspray flow meter",
                config={self._line: settings},
                event_buffer_size=BUFFER_SIZE,
            )
        except (OSError, ValueError) as error:
            raise SensorError(
                f"flow_meter.line = {self._line} on {self._chip}: {error}; see `gpioinfo` for "
                "the chip, and for who holds the line"
            ) from error

    def read(self) -> Sequence[Edge]:
        """Return the edges that the kernel has kept, once: a wire that hums never ends."""
        if self._request is None or not self._request.wait_edge_events(_NO_WAIT):
            return []
        return [
            Edge(event.timestamp_ns / NANOSECONDS, event.line_seqno)
            for event in self._request.read_edge_events()
        ]

    def close(self) -> None:
        """Release the line."""
        request, self._request = self._request, None
        if request is not None:
            request.release()


# The level of one GPIO line by libgpiod 2, with its own pull-up.


class GpiodLevel:
    """An input line; the module is only needed where a line is."""

    def __init__(self, chip: str, line: int, *, key: str) -> None:
        self._chip, self._line, self._key = chip, line, key
        self._request: Any = None
        self._high: Any = None
        self._rising: Any = None

    def open(self) -> None:
        """Take the line: SensorError where the module, the chip or the line is not to be had."""
        gpiod = load_gpiod(SensorError)
        settings = gpiod.LineSettings(
            direction=gpiod.line.Direction.INPUT,
            edge_detection=gpiod.line.Edge.BOTH,
            bias=gpiod.line.Bias.PULL_UP,
        )
        self._high = gpiod.line.Value.ACTIVE
        self._rising = gpiod.EdgeEvent.Type.RISING_EDGE
        try:
            self._request = gpiod.request_lines(
                find_chip(gpiod, self._chip, SensorError),
                consumer="vrspray",
                config={self._line: settings},
            )
        except (OSError, ValueError) as error:
            raise SensorError(
                f"{self._key} = {self._line} on {self._chip}: {error}; see `gpioinfo` for the "
                "chip, and for who holds the line"
            ) from error

    def is_high(self) -> bool:
        """Return whether the level is high or has been since the last look; OSError if unknown."""
        if self._request is None:
            raise OSError("the line is not open")
        # All that the kernel keeps comes at once; a contact that chatters never ends.
        is_news = self._request.wait_edge_events(_NO_WAIT)
        events = self._request.read_edge_events() if is_news else ()
        has_risen = any(event.event_type == self._rising for event in events)
        return has_risen or bool(self._request.get_value(self._line) == self._high)

    def fileno(self) -> int | None:
        """Return the request's file, readable when the level has changed."""
        return None if self._request is None else int(self._request.fd)

    def close(self) -> None:
        """Release the line."""
        request, self._request = self._request, None
        if request is not None:
            request.release()


# Pressure before the valves, from a 4 to 20 mA transmitter.


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


# What is left in the tank: counted down by the flow meter, checked by a level where there is one.
#
# The count is exact over a sortie and knows nothing of what was filled in; a level in a tank that
# tilts and sloshes is the opposite. So the level says where the count begins, and when the two have
# come apart.

# A level is the mean of this time, and not known before: sloshing is faster.
LEVEL_S = 10.0
REPORT_S = 1.0


class Counter(Protocol):
    """What counts the flow."""

    def volume_ml(self) -> float:
        """Return what has been metered since the start; NaN where that is not known."""


class LevelGauge(Protocol):
    """What measures the level, in litres."""

    async def open(self) -> None:
        """Begin."""

    def value(self, now_s: float) -> tuple[float | None, str] | None:
        """Return litres, or None and a fault; None before the first reading."""

    async def close(self) -> None:
        """End."""


class TankSensor:
    """The tank as a sensor: once a second."""

    def __init__(
        self,
        counter: Counter | None,
        gauge: LevelGauge | None,
        *,
        capacity_l: float,
        filled_l: float | None = None,
        tolerance_l: float = 2.0,
    ) -> None:
        if not 0.0 < capacity_l < math.inf:
            raise ValueError(f"capacity_l must be positive, got {capacity_l}")
        self._counter = counter
        self._gauge = gauge
        self._capacity_l = capacity_l
        self._tolerance_l = tolerance_l
        self._full_l = filled_l
        self._at_ml = 0.0
        self._mean_l: float | None = None
        self._begun_s = self._seen_s = -math.inf
        self._reported_s = -math.inf

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Begin."""
        if self._gauge is not None:
            await self._gauge.open()

    def filled(self, litres: float) -> None:
        """Take the operator's word for what is in the tank now; the level follows by itself."""
        if not 0.0 <= litres <= self._capacity_l:
            raise ValueError(f"litres must lie in [0, {self._capacity_l:g}], got {litres}")
        counted_ml = self._counted_ml()
        self._full_l, self._at_ml = litres, 0.0 if counted_ml is None else counted_ml

    def refilled(self, litres: float) -> bool:
        """Take a filling that the operator tells of; whether it goes into the tank.

        A level begins its mean anew, as what it saw before is not in the tank any more, and the
        next report is made at once.
        """
        if not 0.0 <= litres <= self._capacity_l:
            return False
        self.filled(litres)
        self._mean_l, self._reported_s = None, -math.inf
        return True

    def read(self, now_s: float) -> Sequence[Input]:
        """Return what is left, once a second."""
        level_l, fault = self._level(now_s)
        if not now_s - self._reported_s >= REPORT_S:
            return []
        self._reported_s = now_s
        counted_l = self._counted_l()
        if counted_l is None and level_l is not None and not fault:
            # Nobody has said what was filled in: the level is where the count begins.
            self.filled(min(max(level_l, 0.0), self._capacity_l))
        elif counted_l is not None and level_l is not None:
            if not abs(level_l - counted_l) <= self._tolerance_l:
                fault = fault or (
                    f"tank: {level_l:.1f} L by its level, {counted_l:.1f} L by the flow meter"
                )
            # The lesser is the safe one: the pump must not run dry.
            level_l = min(level_l, counted_l)
        elif counted_l is not None:
            level_l = counted_l
        return [TankReport(received_s=now_s, level_l=level_l, fault=fault)]

    def _counted_ml(self) -> float | None:
        volume_ml = math.nan if self._counter is None else self._counter.volume_ml()
        return volume_ml if math.isfinite(volume_ml) else None

    def _counted_l(self) -> float | None:
        counted_ml = self._counted_ml()
        if counted_ml is None or self._full_l is None:
            return None
        return max(self._full_l - (counted_ml - self._at_ml) / 1000.0, 0.0)

    def _level(self, now_s: float) -> tuple[float | None, str]:
        """Return the mean level, and the fault of its gauge."""
        found = None if self._gauge is None else self._gauge.value(now_s)
        if found is None:
            return None, ""
        level_l, fault = found
        if level_l is None:
            self._mean_l = None
            return None, fault
        if self._mean_l is None:
            self._mean_l, self._begun_s = level_l, now_s
        elif now_s > self._seen_s:
            # The mean of all so far, then of the last seconds.
            since_s = min(now_s - self._begun_s, LEVEL_S)
            share = min((now_s - self._seen_s) / since_s, 1.0)
            self._mean_l += share * (level_l - self._mean_l)
        self._seen_s = now_s
        return self._mean_l if now_s - self._begun_s >= LEVEL_S else None, fault

    async def close(self) -> None:
        """End."""
        if self._gauge is not None:
            await self._gauge.close()
