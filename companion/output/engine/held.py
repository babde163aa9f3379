"""Lines of an engine that is gone: driven to their safe levels from here, and held there."""

from __future__ import annotations

import logging
from contextlib import suppress

from companion.errors import ActuatorError
from companion.output.engine.lines import Lines, open_lines
from companion.output.engine.setup import EngineSetup

_logger = logging.getLogger(__name__)

# Somebody else may still hold them: tried soon, and later not more often than this.
FIRST_S, MOST_S = 0.05, 1.0


class HeldLines:
    """Takes the lines as soon as they can be had; `take` is called again and again."""

    def __init__(self, setup: EngineSetup) -> None:
        self._setup = setup
        self._lines: Lines | None = None
        self._next_s, self._wait_s = float("-inf"), FIRST_S
        self._told = ""

    def take(self, now_s: float) -> None:
        """Have them at their safe levels; what prevents it is logged once."""
        if self._lines is not None or now_s < self._next_s:
            return
        try:
            self._lines = open_lines(self._setup)
        except ActuatorError as error:
            if self._told != str(error):
                self._told = str(error)
                _logger.error("lines cannot be taken over: %s", error)
            self._next_s, self._wait_s = now_s + self._wait_s, min(2.0 * self._wait_s, MOST_S)

    def release(self) -> None:
        """Let go of them."""
        if self._lines is not None:
            with suppress(OSError):
                self._lines.release()
            self._lines = None
