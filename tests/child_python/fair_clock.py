"""A clock that stands while this computer keeps one of a flight's processes from a processor.

On a vehicle the companion has its processor; beside other tests it waits for one, and a wait of a
tenth of a second moves a change by half a metre. `tests/fair_time.py` sees such a wait in the
kernel and has the clock stand, the same for all Python processes of a test: each asks it where it
would ask the computer's monotonic one. What a process is late by itself (it computes, blocks,
sleeps, waits for a disk) goes by as ever.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from contextlib import suppress
from pathlib import Path

# Written by one process and read by others, a field at a time: between two equal numbers all that
# is read belongs together. Where it was then, when that was, and how far it goes on from there.
NUMBER, BODY = struct.Struct("=q"), struct.Struct("=ddd")
BODY_AT, LAST_AT = NUMBER.size, NUMBER.size + BODY.size
SIZE = LAST_AT + NUMBER.size
CLOCK, FOLDER_VARIABLE = "clock", "VRSPRAY_FAIR_CLOCK"

computer_s, _sleep_by_computer, _clock_of_computer = time.monotonic, time.sleep, time.clock_gettime


class FairClock:
    """What all processes of a test read; the one that made it moves it."""

    def __init__(self, folder: Path, *, is_ours: bool = False) -> None:
        if is_ours:
            (folder / CLOCK).write_bytes(bytes(SIZE))
        with (folder / CLOCK).open("r+b") as file:
            self._shared = mmap.mmap(file.fileno(), SIZE)
        self._folder = folder
        self._number = 0
        if is_ours:
            now_s = computer_s()
            self.move(now_s, now_s, float("inf"))

    def move(self, fair_s: float, at_s: float, most_s: float) -> None:
        """Have it be `fair_s` at the computer's `at_s`, and go on from there, but no further."""
        self._number += 1
        NUMBER.pack_into(self._shared, 0, self._number)
        BODY.pack_into(self._shared, BODY_AT, fair_s, at_s, most_s)
        NUMBER.pack_into(self._shared, LAST_AT, self._number)

    def now_s(self) -> float:
        """Return the time in seconds; it never goes back."""
        shared = self._shared
        while True:
            number = NUMBER.unpack_from(shared, LAST_AT)
            fair_s, at_s, most_s = BODY.unpack_from(shared, BODY_AT)
            gone_s = computer_s() - at_s
            if NUMBER.unpack_from(shared, 0) == number:
                return fair_s + min(max(gone_s, 0.0), most_s)
            _sleep_by_computer(0.0)

    def clock_gettime(self, clock: int) -> float:
        """Return a clock of the computer; that since it was switched on stands like this one."""
        if clock == time.CLOCK_MONOTONIC:
            return self.now_s()
        stood_s = computer_s() - self.now_s() if clock == time.CLOCK_BOOTTIME else 0.0
        return _clock_of_computer(clock) - stood_s

    def sleep(self, for_s: float) -> None:
        """Sleep by this clock."""
        until_s = self.now_s() + for_s
        _sleep_by_computer(for_s)
        while (left_s := until_s - self.now_s()) > 0.0:
            _sleep_by_computer(max(left_s, 0.001))

    def rule(self) -> None:
        """Have this process, and those that it forks, go by it, before anything asks for time."""

        def monotonic() -> float:
            return self.now_s()

        def sleep(for_s: float, /) -> None:
            self.sleep(for_s)

        def clock_gettime(clock: int, /) -> float:
            return self.clock_gettime(clock)

        for each in (monotonic, sleep, clock_gettime):
            # Handed to another process, each is what that has under this name.
            each.__module__, each.__qualname__ = "time", each.__name__
            setattr(time, each.__name__, each)
        self.take_part()
        os.register_at_fork(after_in_child=self.take_part)

    def take_part(self) -> None:
        """Have it stand while this process waits for a processor."""
        with suppress(OSError):  # the flight is over
            (self._folder / str(os.getpid())).touch()
