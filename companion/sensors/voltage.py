"""Volts from an ADS1115: by the kernel's own driver, or over I2C where that is not loaded.

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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Protocol

from companion.errors import SensorError
from companion.wording import install_command

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
            raise SensorError(
                f'source = "i2c" needs the module smbus2: {install_command("vehicle")}'
            ) from error
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
