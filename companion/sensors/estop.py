"""An emergency stop on a line: a contact that opens to stop, so that a broken wire stops too.

This is the program's own ear for it. The stop itself is wired into the relay of pump and master
valve, and works without any program.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Protocol

from companion.core.types import EstopReport, Input


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
