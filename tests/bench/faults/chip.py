"""A GPIO chip without hardware: who owns the lines, and a log of every level that was written.

As with the kernel's, only one process owns the lines (a lock on the chip's file, which the kernel
lets go of when its holder dies). A chip that is gone refuses every write, and its outputs stay as
they are: an expander whose bus has failed. What happens to released lines is the judge's affair.
"""

from __future__ import annotations

import fcntl
import os
import struct
import time
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from errno import ENODEV
from pathlib import Path
from typing import NamedTuple

_ROW = struct.Struct("<dQIB")


class Act(IntEnum):
    """What was done to the lines."""

    TAKEN = 0
    WRITTEN = 1
    RELEASED = 2


class Row(NamedTuple):
    """One line of the log; times are those of the monotonic clock, which all processes share."""

    at_s: float
    levels: int
    pid: int
    act: Act


@dataclass(frozen=True, slots=True)
class Chip:
    """The files of a chip."""

    folder: Path

    @property
    def log(self) -> Path:
        """Return where the levels are written down."""
        return self.folder / "levels.log"

    @property
    def gone(self) -> Path:
        """Return the file whose presence means that the chip does not answer."""
        return self.folder / "gone"

    def rows(self) -> list[Row]:
        """Return the log so far."""
        data = self.log.read_bytes() if self.log.exists() else b""
        whole = data[: len(data) - len(data) % _ROW.size]
        return [Row(at, levels, pid, Act(act)) for at, levels, pid, act in _ROW.iter_unpack(whole)]


class ChipLines:
    """All lines of a chip, as `companion.output.engine.lines.Lines` wants them."""

    def __init__(self, chip: Chip, *, levels: int) -> None:
        self._gone = str(chip.gone)
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        self._file = os.open(chip.log, flags, 0o600)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._levels = levels
            self._log(Act.TAKEN)
        except OSError:
            os.close(self._file)
            raise

    def write(self, levels: int) -> None:
        """Drive all lines."""
        before, self._levels = self._levels, levels
        try:
            self._log(Act.WRITTEN)
        except OSError:
            self._levels = before
            raise

    def read(self) -> int | None:
        """Return the levels."""
        self._answer()
        return self._levels

    def release(self) -> None:
        """Let go of the lines; those of a chip that is gone do not notice."""
        with suppress(OSError):
            self._log(Act.RELEASED)
        os.close(self._file)

    def _answer(self) -> None:
        if os.access(self._gone, os.F_OK):
            raise OSError(ENODEV, os.strerror(ENODEV))

    def _log(self, act: Act) -> None:
        """One call, so that a process that is stopped or killed has written all of it or nothing.

        The time is from before the call: a process stopped between the two writes late what it
        says to have written before, which the gap in its own log would show.
        """
        self._answer()
        os.write(self._file, _ROW.pack(time.monotonic(), self._levels, os.getpid(), act))
