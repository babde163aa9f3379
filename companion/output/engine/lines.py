"""What drives the outputs: one interface for a chip's lines, a shift register, and memory.

A chip's lines go through `gpiod` 2: one request, one call for all of them at an edge. A chain of
74HC595 (or TPIC6B595) registers hangs on an SPI device: 24 outputs on three wires. Data and clock
are the bus's; its chip select is the latch, whose rise shows all outputs at once. Output 0 is the
first of the register nearest to the computer. A chain holds its last byte for ever: its
output-enable belongs to the ALIVE monostable.
"""

from __future__ import annotations

import ctypes
import fcntl
import importlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

from companion.errors import ActuatorError, VrsprayError
from companion.output.engine.wire import EngineSetup
from companion.wording import install_command, missing


class Lines(Protocol):
    """All outputs at once; the levels are the bits of one integer, bit 0 for output 0.

    Any method may raise OSError: the device is gone, or refuses.
    """

    def write(self, levels: int) -> None:
        """Drive all outputs, in one call to the kernel."""

    def read(self) -> int | None:
        """Return the levels as the hardware has them; None where it cannot tell."""

    def release(self) -> None:
        """Let go of the device; its outputs do then what the kernel does with them."""


class MemoryLines:
    """No hardware: for tests, for the twin, and for measuring the engine itself.

    Faults are fields: `broken` refuses writes, `stuck` are outputs that keep their level.
    """

    def __init__(self, levels: int = 0) -> None:
        self.levels = levels
        self.writes = 0
        self.broken = False
        self.stuck = 0
        self.is_released = False

    def write(self, levels: int) -> None:
        """Take the levels."""
        if self.broken:
            raise OSError("the device is gone")
        self.levels = (levels & ~self.stuck) | (self.levels & self.stuck)
        self.writes += 1

    def read(self) -> int | None:
        """Return the levels."""
        if self.broken:
            raise OSError("the device is gone")
        return self.levels

    def release(self) -> None:
        """Note that it was released."""
        self.is_released = True


class FileLines:
    """No hardware either: the levels stand in a file, which outlives the process and can be read.

    As with a kernel that keeps the levels of released lines.
    """

    def __init__(self, path: str, *, levels: int) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            self.write(levels)
        except OSError:
            os.close(self._file)
            raise

    def write(self, levels: int) -> None:
        """Put the levels into the file."""
        os.pwrite(self._file, levels.to_bytes(8, "little"), 0)

    def read(self) -> int | None:
        """Return the levels in the file."""
        return int.from_bytes(os.pread(self._file, 8, 0), "little")

    def release(self) -> None:
        """Close the file."""
        os.close(self._file)


def open_lines(setup: EngineSetup) -> Lines:
    """Return the outputs of a set-up, driven to their safe levels from the first moment.

    Raises:
        ActuatorError: they cannot be had; the text says why, and what to do.
    """
    safe = setup.wiring.safe_levels
    if setup.backend == "memory":
        return MemoryLines(safe)
    try:
        if setup.backend == "file":
            return FileLines(setup.device, levels=safe)
        if setup.backend == "spi595":
            # Imported when needed: each of the two wants its own part of the system.

            return SpiRegister(
                open_port(setup.device, setup.spi_hz), setup.wiring.lines, levels=safe
            )

        return GpiodLines(load_gpiod(), setup.device, setup.wiring.lines, levels=safe)
    except OSError as error:
        raise ActuatorError(
            f"{setup.device}: {error.strerror or error}; is it free, and may this user open it?"
        ) from error


DEV = Path("/dev")
CONSUMER = "vrspray"
# Whether Raspberry Pi's kernels leave a released line at its last level ("Y") or make it an input.
PERSIST = Path("/sys/module/pinctrl_bcm2835/parameters/persist_gpio_outputs")


def load_gpiod(error_type: type[VrsprayError] = ActuatorError) -> Any:
    """Return the module `gpiod`; an error where there is none, or version 1 of it."""
    try:
        gpiod = importlib.import_module("gpiod")
    except ImportError as error:
        raise error_type(missing("gpiod", "vehicle")) from error
    version = str(getattr(gpiod, "__version__", "1"))
    if not version.partition(".")[0].isdigit() or int(version.partition(".")[0]) < 2:
        # Debian 12's own package is version 1 under the same name, with another interface.
        raise error_type(f"gpiod {version} is too old; add it: {install_command('vehicle')}")
    return gpiod


def find_chip(
    gpiod: Any,
    name: str,
    error_type: type[VrsprayError] = ActuatorError,
    *,
    folder: Path | None = None,
) -> str:
    """Return the path of a chip by its name, path or label.

    A label (`pinctrl-bcm2711`, `pinctrl-rp1`) is the safest: the number of a Raspberry Pi 5's
    chip has changed with its kernels.
    """
    folder = folder or DEV
    path = folder / name
    if path.exists():
        return str(path)
    labels = []
    for other in sorted(folder.glob("gpiochip*")):
        with gpiod.Chip(str(other)) as chip:
            label = chip.get_info().label
        if label == name:
            return str(other)
        labels.append(f"{other.name} ({label})")
    raise error_type(f"no GPIO chip {name}; there are: " + (", ".join(labels) or "none"))


def keeps_levels(path: Path = PERSIST) -> bool | None:
    """Return whether a released line keeps its level; None where the kernel does not say."""
    try:
        return path.read_text().strip().upper() in ("Y", "1")
    except OSError:
        return None


class GpiodLines:
    """The outputs of one request; levels are physical, polarity is the wiring's affair."""

    def __init__(self, gpiod: Any, chip: str, lines: Iterable[int], *, levels: int) -> None:
        self._lines = tuple(lines)
        self._value = gpiod.line.Value
        settings = gpiod.LineSettings(direction=gpiod.line.Direction.OUTPUT)
        # With the request itself: there is no moment between direction and level.
        try:
            with gpiod.Chip(find_chip(gpiod, chip)) as device:
                self._request = device.request_lines(
                    {self._lines: settings},
                    consumer=CONSUMER,
                    output_values=self._values(levels),
                )
        except ValueError as error:
            raise ActuatorError(f"{chip}: lines {self._lines}: {error}") from error

    def _values(self, levels: int) -> dict[int, Any]:
        active, inactive = self._value.ACTIVE, self._value.INACTIVE
        return {
            line: active if levels >> output & 1 else inactive
            for output, line in enumerate(self._lines)
        }

    def write(self, levels: int) -> None:
        """Drive all lines in one call."""
        self._request.set_values(self._values(levels))

    def read(self) -> int | None:
        """Return the levels of the lines."""
        values = self._request.get_values(list(self._lines))
        return sum(1 << n for n, value in enumerate(values) if value == self._value.ACTIVE)

    def release(self) -> None:
        """Release the request."""
        self._request.release()


# linux/spi/spidev.h: SPI_IOC_WR_MAX_SPEED_HZ, SPI_IOC_MESSAGE(1).
_SPEED = 0x40046B04
_MESSAGE = 0x40206B00


class SpiPort(Protocol):
    """A full-duplex transfer."""

    def transfer(self, data: bytes) -> bytes:
        """Shift bytes out; return those that came in."""

    def close(self) -> None:
        """Close the device."""


class _Transfer(ctypes.Structure):
    _fields_ = (
        ("tx_buf", ctypes.c_uint64),
        ("rx_buf", ctypes.c_uint64),
        ("len", ctypes.c_uint32),
        ("speed_hz", ctypes.c_uint32),
        ("delay_usecs", ctypes.c_uint16),
        ("bits_per_word", ctypes.c_uint8),
        ("cs_change", ctypes.c_uint8),
        ("tx_nbits", ctypes.c_uint8),
        ("rx_nbits", ctypes.c_uint8),
        ("word_delay_usecs", ctypes.c_uint8),
        ("pad", ctypes.c_uint8),
    )


class SpiDevice:
    """`/dev/spidevB.C` in mode 0."""

    def __init__(self, path: str, speed_hz: int) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        self._speed_hz = speed_hz
        try:
            fcntl.ioctl(self._file, _SPEED, speed_hz.to_bytes(4, "little"))
        except OSError:
            os.close(self._file)
            raise

    def transfer(self, data: bytes) -> bytes:
        """Shift bytes out; return those that came in."""
        out = ctypes.create_string_buffer(data, len(data))
        back = ctypes.create_string_buffer(len(data))
        what = _Transfer(
            tx_buf=ctypes.addressof(out),
            rx_buf=ctypes.addressof(back),
            len=len(data),
            speed_hz=self._speed_hz,
            bits_per_word=8,
        )
        fcntl.ioctl(self._file, _MESSAGE, what)
        return back.raw

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


def open_port(path: str, speed_hz: int) -> SpiPort:
    """Return the SPI device."""
    return SpiDevice(path if path.startswith("/") else f"/dev/{path}", speed_hz)


class SpiRegister:
    """The outputs of the chain. What the wiring does not use stays low."""

    def __init__(self, port: SpiPort, outputs: Iterable[int], *, levels: int) -> None:
        self._port = port
        self._outputs = tuple(outputs)
        self._bytes = max(self._outputs) // 8 + 1
        self.write(levels)

    def _shifted(self, levels: int) -> bytes:
        """Return the bytes: the farthest register's first, each from its highest output."""
        word = 0
        for number, output in enumerate(self._outputs):
            word |= (levels >> number & 1) << output
        return word.to_bytes(self._bytes, "big")

    def write(self, levels: int) -> None:
        """Shift all outputs out; they change together when the latch rises."""
        self._port.transfer(self._shifted(levels))

    def read(self) -> int | None:
        """Return nothing: a chain without a way back cannot tell."""
        return None

    def release(self) -> None:
        """Close the device; the chain keeps its last outputs."""
        self._port.close()
