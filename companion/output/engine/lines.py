"""What drives the outputs: one interface for a chip's lines, a shift register, and memory."""

from __future__ import annotations

import os
from typing import Protocol

from companion.errors import ActuatorError
from companion.output.engine.setup import EngineSetup


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
            from companion.output.engine.spi595 import SpiRegister, open_port

            return SpiRegister(
                open_port(setup.device, setup.spi_hz), setup.wiring.lines, levels=safe
            )
        from companion.output.engine.gpiod_lines import GpiodLines, load_gpiod

        return GpiodLines(load_gpiod(), setup.device, setup.wiring.lines, levels=safe)
    except OSError as error:
        raise ActuatorError(
            f"{setup.device}: {error.strerror or error}; is it free, and may this user open it?"
        ) from error
