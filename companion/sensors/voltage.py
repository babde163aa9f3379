"""Volts from an ADS1115: by the kernel's own driver, or over I2C where that is not loaded.

The kernel's driver (ti-ads1015, `dtoverlay=ads1115`) shows each channel as two files under
/sys/bus/iio/devices: a number, and the millivolts that one step of it is worth.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Protocol

from companion.errors import SensorError

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
                'source = "i2c" needs the module smbus2: pip install smbus2'
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
