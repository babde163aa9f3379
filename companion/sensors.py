"""What measures the liquid: flow meter, pressure, tank. A sensor that fails says so, never zero.

Edges come through `EdgeSource`: from the kernel's GPIO (`cli/sensor_parts.py`) or from a list.

The kernel's driver (ti-ads1015, `dtoverlay=ads1115`) shows each channel as two files under
/sys/bus/iio/devices: a number, and the millivolts that one step of it is worth.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple, Protocol

from companion.core.types import FlowReport, Input
from companion.errors import SensorError
from companion.wording import missing

# --------------------------------------------------------------------------------------------- flow


class EdgeSource(Protocol):
    """Rising edges of one line, in their order."""

    def open(self) -> None:
        """Take the line."""

    def read(self) -> Sequence[Edge]:
        """Return what came since the last call; never waits. OSError where the line is gone."""

    def close(self) -> None:
        """Let go of the line; may be called twice and before `open`."""


class FlowMeter:
    """Counts while it is open; read at every step."""

    def __init__(self, meter: Meter, source: EdgeSource) -> None:
        self.counter = PulseCounter(meter)
        self._source = source

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Take the line: SensorError where that cannot be had."""
        self._source.open()

    def read(self, now_s: float) -> Sequence[Input]:
        """Return the count, or why there is none."""
        try:
            edges = self._source.read()
        except OSError as error:
            text = f"flow meter: its line cannot be read: {error.strerror or error}"
            return [FlowReport(received_s=now_s, volume_ml=math.nan, fault=text)]
        for edge in edges:
            self.counter.take(edge)
        return [self.counter.report(now_s)]

    def volume_ml(self) -> float:
        """Return what has been counted since the start."""
        return self.counter.volume_ml

    async def close(self) -> None:
        """Let go of the line."""
        self._source.close()


# Counting the pulses of a flow meter by the times that the kernel gave to their edges.
#
# A late reader loses nothing: the count is known at the time of its last edge, exactly. The kernel
# numbers the edges of a line, so that edges which its buffer dropped are known too.

# A mean over whole PWM periods of about this time; edges are kept for twice of it.
WINDOW_S = 1.0
KEPT_S = 2.0 * WINDOW_S
# A pulse that follows the last one sooner than half the shortest period is an echo of its edge.
ECHO_SHARE = 0.5
ECHOES_MAX, ECHOES_KEPT = 0.05, 4096
# A meter that has lost or added pulses is not believed for this long after the last of them.
FAULT_S = 1.0


class Edge(NamedTuple):
    """One rising edge: when, on the monotonic clock, and its number on the line, from 1."""

    at_s: float
    number: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Meter:
    """What is known of the meter: its factor, and the largest flow that can be."""

    pulses_per_l: float
    flow_max_l_min: float
    pwm_period_s: float

    def __post_init__(self) -> None:
        for name in ("pulses_per_l", "flow_max_l_min", "pwm_period_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")

    @property
    def period_min_s(self) -> float:
        """Return the time between two pulses at the largest flow.

        >>> Meter(pulses_per_l=6000.0, flow_max_l_min=10.0, pwm_period_s=0.1).period_min_s
        0.001
        """
        return 60.0 / (self.pulses_per_l * self.flow_max_l_min)

    @property
    def window_s(self) -> float:
        """Return whole PWM periods: in their mean the pulses of the valves cancel."""
        return max(round(WINDOW_S / self.pwm_period_s), 1) * self.pwm_period_s


class PulseCounter:
    """Edges in, counts out; pure, it knows no clock but that of the edges."""

    def __init__(self, meter: Meter) -> None:
        self.meter = meter
        self.count = 0
        self.lost_count = 0
        self._edges: deque[tuple[float, int]] = deque()  # time, count with it
        self._echoes: deque[float] = deque(maxlen=ECHOES_KEPT)
        self._number: int | None = None
        self._lost_s = -math.inf
        self._is_loss_told = True
        self._reported_s = -math.inf

    def take(self, edge: Edge) -> None:
        """Count an edge; those that its number shows to be lost are counted with it."""
        at_s = edge.at_s
        if not math.isfinite(at_s):
            return
        lost = 0 if self._number is None else edge.number - self._number - 1
        self._number = edge.number
        if lost > 0:
            self.count += lost
            self.lost_count += lost
            self._lost_s = at_s
            self._is_loss_told = False
        if self._edges and not at_s - self._edges[-1][0] >= ECHO_SHARE * self.meter.period_min_s:
            self._echoes.append(at_s)
            return
        self.count += 1
        self._edges.append((at_s, self.count))
        while self._edges[0][0] < at_s - KEPT_S:
            self._edges.popleft()
        while self._echoes and self._echoes[0] < at_s - KEPT_S:
            self._echoes.popleft()

    @property
    def volume_ml(self) -> float:
        """Return what has been counted since the start."""
        return self.count * 1000.0 / self.meter.pulses_per_l

    def fault(self, now_s: float) -> str:
        """Return in words why the count cannot be believed; empty while it can."""
        if not self._is_loss_told:
            # What a full buffer drops are its oldest edges: at the first look the loss is as old
            # as all that the buffer holds.
            self._lost_s, self._is_loss_told = max(self._lost_s, now_s), True
        if not now_s - self._lost_s > FAULT_S:
            return f"flow meter: {self.lost_count} pulses lost"
        echoes = sum(1 for at_s in self._echoes if now_s - at_s <= FAULT_S)
        if echoes > ECHOES_MAX * max(len(self._edges), 20):
            return "flow meter: pulses come twice; shield its wire, check its pull-up"
        flow_l_min = self.flow_l_min(now_s)
        if not flow_l_min <= 1.1 * self.meter.flow_max_l_min:
            return (
                f"flow meter: {flow_l_min:.1f} L/min, more than flow_meter.flow_max_l_min = "
                f"{self.meter.flow_max_l_min:g}"
            )
        return ""

    def flow_l_min(self, now_s: float) -> float:
        """Return the mean flow of the last whole PWM periods; 0 where nothing came in them."""
        if not self._edges or not now_s - self._edges[-1][0] < self.meter.window_s:
            return 0.0
        last_s, last = self._edges[-1]
        from_s = last_s - self.meter.window_s
        before: tuple[float, int] | None = None
        for at_s, count in self._edges:
            if at_s > from_s:
                then = float(count - 1)
                if before is not None:
                    share = (from_s - before[0]) / (at_s - before[0])
                    then = before[1] + share * (count - before[1])
                pulses = last - then
                break
            before = (at_s, count)
        return pulses / self.meter.window_s * 60.0 / self.meter.pulses_per_l

    def report(self, now_s: float) -> FlowReport:
        """Return the count, at the time of its last edge where that is news, else now."""
        fault = self.fault(now_s)
        at_s = now_s
        if self._edges and self._reported_s < self._edges[-1][0] <= now_s:
            at_s = self._edges[-1][0]
        self._reported_s = at_s
        if fault:
            return FlowReport(received_s=at_s, volume_ml=math.nan, fault=fault)
        return FlowReport(received_s=at_s, volume_ml=self.volume_ml)


# -------------------------------------------------------------------------------- pressure and tank

IIO = Path("/sys/bus/iio/devices")
DRIVERS = ("ads1115", "ads1015", "ads1115@48")
# Single shot, 860 samples a second, no comparator; range of +-4.096 V, 125 uV a step.
_CONFIG, _CONVERSION = 0x01, 0x00
_SINGLE_SHOT = 0x8000 | 0x0200 | 0x0100 | 0x00E0 | 0x0003
_STEP_V = 4.096 / 32768.0
_CONVERSION_S = 0.0015


class VoltageSource(Protocol):
    """One channel of a converter."""

    def open(self) -> None:
        """Find it: SensorError where there is none."""

    def read_v(self) -> float:
        """Return volts; OSError where the converter does not answer. May take milliseconds."""

    def close(self) -> None:
        """Let go of it."""


class IioVoltage:
    """A channel of the kernel's industrial I/O; `device` is its folder, or a driver's name."""

    def __init__(self, device: str, channel: int, *, root: Path = IIO) -> None:
        self._device = device
        self._channel = channel
        self._root = root
        self._raw: Path | None = None
        self._volts_a_step = 0.0

    def open(self) -> None:
        """Find device and channel by their names."""
        folder = self._folder()
        raw = folder / f"in_voltage{self._channel}_raw"
        scale = folder / f"in_voltage{self._channel}_scale"
        if not scale.exists():
            scale = folder / "in_voltage_scale"
        try:
            self._volts_a_step = float(scale.read_text()) / 1000.0
            int(raw.read_text())
        except (OSError, ValueError) as error:
            raise SensorError(f"{raw}: channel {self._channel} cannot be read: {error}") from error
        self._raw = raw

    def _folder(self) -> Path:
        if "/" in self._device:
            return Path(self._device)
        wanted = (self._device,) if self._device else DRIVERS
        names = {}
        for folder in sorted(self._root.glob("iio:device*")):
            try:
                names[folder] = (folder / "name").read_text().strip()
            except OSError:
                continue
        for folder, name in names.items():
            if name in wanted:
                return folder
        there = ", ".join(sorted(names.values())) or "none"
        raise SensorError(
            f"no converter {' or '.join(wanted)} under {self._root} (there: {there}); add "
            "dtoverlay=ads1115 to config.txt and check the wiring with `i2cdetect -y 1`"
        )

    def read_v(self) -> float:
        """Return volts."""
        if self._raw is None:
            raise OSError("not open")
        try:
            return int(self._raw.read_text()) * self._volts_a_step
        except ValueError as error:
            raise OSError(str(error)) from error

    def close(self) -> None:
        """Forget the files."""
        self._raw = None


class I2cVoltage:
    """A channel of an ADS1115 on an I2C bus that no kernel driver holds."""

    def __init__(self, bus: int, address: int, channel: int) -> None:
        self._where = (bus, address)
        self._multiplexer = (4 + channel) << 12
        self._bus: Any = None

    def open(self) -> None:
        """Open the bus and read once."""
        try:
            # It need not be there, and where it is the ignore is not used.
            import smbus2  # type: ignore[import-not-found, unused-ignore]
        except ImportError as error:
            raise SensorError(f'source = "i2c": {missing("smbus2", "vehicle")}') from error
        bus, address = self._where
        try:
            self._bus = smbus2.SMBus(bus)
            self.read_v()
        except OSError as error:
            self.close()
            raise SensorError(
                f"no ADS1115 at address 0x{address:02x} of /dev/i2c-{bus}: {error}; check with "
                f"`i2cdetect -y {bus}`"
            ) from error

    def read_v(self) -> float:
        """Start a conversion, wait for it, return volts."""
        if self._bus is None:
            raise OSError("not open")
        _, address = self._where
        word = _SINGLE_SHOT | self._multiplexer
        self._bus.write_i2c_block_data(address, _CONFIG, [word >> 8, word & 0xFF])
        time.sleep(_CONVERSION_S)
        high, low = self._bus.read_i2c_block_data(address, _CONVERSION, 2)
        return int.from_bytes(bytes((high, low)), "big", signed=True) * _STEP_V

    def close(self) -> None:
        """Close the bus."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()


# A 4 to 20 mA transmitter that is sampled beside the event loop; its mean over whole periods.
#
# A conversion takes a millisecond or two in the kernel, and on a bus that hangs ten seconds: a
# thread of its own waits for it, so that neither a valve nor the end of the process does. What
# has not answered for a while is a fault.

_logger = logging.getLogger(__name__)

SILENT_S = 0.5
# A bus that hangs is waited for so long: at the start, and at the end, where the valves are closed.
OPEN_MAX_S = 3.0
CLOSE_MAX_S = 0.5


class Gauge:
    """Samples of one transmitter, by a task of its own."""

    def __init__(
        self,
        loop: CurrentLoop,
        source: VoltageSource,
        *,
        rate_hz: float,
        window_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._loop = loop
        self._source = source
        self._rate_hz = rate_hz
        self._window_s = window_s
        self._clock = clock
        self._samples: deque[tuple[float, float]] = deque(maxlen=1000)
        self._begun_s = math.inf
        self._error = ""
        self._ending = threading.Event()
        self._ended: asyncio.Event | None = None

    async def open(self) -> None:
        """Find the converter: SensorError where there is none, or no answer; then sample."""
        opened: asyncio.Future[SensorError | None] = asyncio.get_running_loop().create_future()
        self._ending, self._ended = threading.Event(), asyncio.Event()
        # The interpreter waits for other threads at its end, and for those of a pool: not for this.
        threading.Thread(
            target=self._work,
            args=(asyncio.get_running_loop(), opened, self._ended, self._ending),
            name=f"gauge {self._loop.name}",
            daemon=True,
        ).start()
        try:
            error = await asyncio.wait_for(opened, OPEN_MAX_S)
        except TimeoutError:
            error = SensorError(
                f"{self._loop.name}: converter does not answer within {OPEN_MAX_S:g} s; check the "
                "wiring of its bus"
            )
        if error is not None:
            self._ended = None
            self._ending.set()
            raise error
        self._begun_s = self._clock()

    def _work(
        self,
        loop: asyncio.AbstractEventLoop,
        opened: asyncio.Future[SensorError | None],
        ended: asyncio.Event,
        ending: threading.Event,
    ) -> None:
        """Open, sample until the end, let go; all that may hang happens in this thread."""

        def post(call: Callable[..., object], *args: object) -> None:
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                loop.call_soon_threadsafe(call, *args)

        try:
            self._source.open()
        except SensorError as error:
            post(_settle, opened, error)
            return
        post(_settle, opened, None)
        while not ending.is_set():
            try:
                volts = self._source.read_v()
            except OSError as error:
                post(self._failed, str(error))
            else:
                post(self.take, self._clock(), volts)
            ending.wait(1.0 / self._rate_hz)
        self._source.close()
        post(ended.set)

    def _failed(self, text: str) -> None:
        self._error = f"{self._loop.name}: converter does not answer: {text}"

    def take(self, at_s: float, volts: float) -> None:
        """Take one sample."""
        self._error = ""
        self._samples.append((at_s, volts))

    def value(self, now_s: float) -> tuple[float | None, str] | None:
        """Return the mean of the last whole periods, or None and a fault; None before the first."""
        if self._error:
            return None, self._error
        while self._samples and not now_s - self._samples[0][0] <= max(self._window_s, SILENT_S):
            self._samples.popleft()
        if not self._samples:
            if not now_s - self._begun_s > SILENT_S:
                return None
            return None, f"{self._loop.name}: no reading for {SILENT_S:g} s"
        newest_s = self._samples[-1][0]
        recent = [volts for at_s, volts in self._samples if newest_s - at_s <= self._window_s]
        return self._loop.value(fmean(recent))

    async def close(self) -> None:
        """Stop sampling and let go of the converter; may be called twice and before `open`.

        One that hangs is left to its thread, which ends with the process.
        """
        ended, self._ended = self._ended, None
        if ended is None:
            return
        self._ending.set()
        try:
            await asyncio.wait_for(ended.wait(), CLOSE_MAX_S)
        except TimeoutError:
            _logger.warning("%s: converter hangs, left alone", self._loop.name)


def _settle(opened: asyncio.Future[SensorError | None], error: SensorError | None) -> None:
    """Say how the opening went, if somebody still waits for it."""
    if not opened.done():
        opened.set_result(error)


# A 4 to 20 mA transmitter read over a shunt: a broken wire is a fault, and never a zero.
#
# Below 3.6 mA and above 21 mA is no measurement: the limits of NAMUR NE 43, by which transmitters
# signal their own failure, and where a broken wire or a short ends up.

BROKEN_MA = 3.6
FAILED_MA = 21.0
LOW_MA, HIGH_MA = 4.0, 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentLoop:
    """What 4 and 20 mA stand for, and the shunt that turns them into volts."""

    name: str
    shunt_ohm: float
    at_4_ma: float
    at_20_ma: float

    def __post_init__(self) -> None:
        if not 1.0 <= self.shunt_ohm <= 1000.0:
            raise ValueError(f"shunt_ohm must lie in [1, 1000], got {self.shunt_ohm}")
        if not math.isfinite(self.at_20_ma - self.at_4_ma) or self.at_20_ma == self.at_4_ma:
            raise ValueError("4 and 20 mA must stand for two values")

    def value(self, volts: float) -> tuple[float | None, str]:
        """Return what is measured, or None and the fault in words.

        >>> loop = CurrentLoop(name="pressure", shunt_ohm=100.0, at_4_ma=0.0, at_20_ma=1000.0)
        >>> loop.value(1.2)
        (500.0, '')
        >>> loop.value(0.0)
        (None, 'pressure: 0.0 mA: wire broken, or no supply')
        """
        current_ma = 1000.0 * volts / self.shunt_ohm
        if not math.isfinite(current_ma):
            return None, f"{self.name}: no reading"
        if not current_ma >= BROKEN_MA:
            return None, f"{self.name}: {current_ma:.1f} mA: wire broken, or no supply"
        if not current_ma <= FAILED_MA:
            return None, f"{self.name}: {current_ma:.1f} mA: short circuit, or transmitter failed"
        share = (current_ma - LOW_MA) / (HIGH_MA - LOW_MA)
        return self.at_4_ma + share * (self.at_20_ma - self.at_4_ma), ""
