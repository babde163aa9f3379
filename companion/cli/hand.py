"""The operator's hand on ground work: the space bar of a terminal, or lines of a script.

Whatever else comes (another key, a signal, the end of the terminal) ends the work: a piece of
software that cannot hear the hand any more must not take it for held.
"""

from __future__ import annotations

import asyncio
import os
import select
import signal
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from companion.ground.work import HOLD_S, Hold

KEY, ENDED, INTERRUPTED = "another-key", "stdin-ended", "interrupted"
# Ctrl-Z and Ctrl-\\ too: a process that stands still or dies orders nothing closed. SIGHUP is a
# terminal that went away.
_SIGNALS = {
    signal.SIGINT: INTERRUPTED,
    signal.SIGTERM: "terminated",
    signal.SIGHUP: "terminal-gone",
    signal.SIGQUIT: INTERRUPTED,
    signal.SIGTSTP: KEY,
}
# So often a wait for a line looks for signals: Ctrl-C is answered at once to a person.
_SIGNALS_EVERY_S = 0.1
# A line that is longer is no line.
_LINE_MAX = 4096
_INPUT_FLAGS, _LOCAL_FLAGS, _CHARACTERS = 0, 3, 6


class Hand:
    """Implements `ground.HandHold` on a file descriptor: a terminal's keys, or lines."""

    def __init__(
        self, descriptor: int, *, is_lines: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._file = descriptor
        self._is_lines = is_lines
        self._clock = clock
        self._before: list[Any] | None = None
        self._listens = False
        self._line = b""
        self.hold = Hold()
        self.stopped: str | None = None

    @property
    def invitation(self) -> str:
        """Return what the operator, or the script, is told to do now."""
        if self._is_lines:
            return (
                f"Lines hold, one at least every {HOLD_S:g} s; stop, or the end of stdin, closes."
            )
        return "Hold the space bar; any other key closes."

    @contextmanager
    def attending(self) -> Iterator[None]:
        """Have signals end the work; give the terminal back at the end."""
        loop = asyncio.get_running_loop()
        for number, reason in _SIGNALS.items():
            loop.add_signal_handler(number, self._stop, reason)
        try:
            yield
        finally:
            if self._listens:
                loop.remove_reader(self._file)
            for number in _SIGNALS:
                loop.remove_signal_handler(number)
            if self._before is not None:
                # What was still pressed is no command of the shell.
                with suppress(termios.error, OSError):
                    termios.tcsetattr(self._file, termios.TCSAFLUSH, self._before)

    def begin(self) -> None:
        """Begin to listen; what was pressed before does not count."""
        if not self._is_lines:
            self._take_terminal()
        asyncio.get_running_loop().add_reader(self._file, self._read)
        self._listens = True

    def _take_terminal(self) -> None:
        """Have keys come one by one and unseen; Ctrl-S stops no output, as it would stop us."""
        self._before = termios.tcgetattr(self._file)
        now = termios.tcgetattr(self._file)
        now[_INPUT_FLAGS] &= ~termios.IXON
        now[_LOCAL_FLAGS] &= ~(termios.ICANON | termios.ECHO)
        now[_CHARACTERS][termios.VMIN], now[_CHARACTERS][termios.VTIME] = 1, 0
        termios.tcsetattr(self._file, termios.TCSAFLUSH, now)

    def _read(self) -> None:
        try:
            data = os.read(self._file, 4096)
        except OSError:
            data = b""  # the terminal is gone
        if not data:
            self._stop(ENDED)
        elif self._is_lines:
            self._take_lines(data)
        elif data.strip(b" "):
            self._stop(KEY)
        else:
            self.hold = self.hold.renewed(self._clock())

    def _take_lines(self, data: bytes) -> None:
        """Take whole lines, however they come in; the word to stop counts before its line ends."""
        text = self._line + data
        _, found, self._line = text.rpartition(b"\n")
        if b"stop" in text or len(self._line) > _LINE_MAX:
            self._stop(KEY)
        elif found:
            self.hold = self.hold.renewed(self._clock())

    def _stop(self, reason: str) -> None:
        """End the work; the first reason counts."""
        self.stopped = self.stopped or reason
        if self._listens:
            self._listens = False
            asyncio.get_running_loop().remove_reader(self._file)


def read_line(descriptor: int) -> str | None:
    """Return the next line without what stands around it; what follows stays to be read.

    None: the terminal, or the script, has ended without one.
    """
    line = b""
    while not line.endswith(b"\n"):
        # A signal that comes just before the call that waits does not end it: Python would look
        # for it after the next key only.
        while not select.select([descriptor], [], [], _SIGNALS_EVERY_S)[0]:
            pass
        try:
            byte = os.read(descriptor, 1)
        except OSError:
            byte = b""  # the terminal is gone
        if not byte:
            break
        line += byte
    return line.decode(errors="replace").strip() if line else None
