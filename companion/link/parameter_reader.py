"""Reads parameters of the autopilot one by one: paced, asked again, given up in the end.

Pure but for what it remembers; time is an argument. Single reads and no list: a list slows all
streams of ArduPilot down to a quarter while it runs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

_PAUSE_S = 0.04
_AGAIN_S = 0.7
# An unknown parameter gets no answer, so the number of questions decides.
_TRIES = 4


@dataclass(slots=True)
class _Asked:
    """A parameter that is not known yet."""

    tries: int = 0
    at_s: float = float("-inf")


class ParameterReader:
    """Says which parameter to ask for next, and gives all once the last has come or is given up."""

    def __init__(self) -> None:
        self._open: dict[str, _Asked] = {}
        self._known: dict[str, float | None] = {}
        self._asked_s = float("-inf")

    def want(self, names: Iterable[str]) -> None:
        """Begin to read parameters; what was being read before is read to its end."""
        for name in names:
            self._known.pop(name, None)
            self._open.setdefault(name, _Asked())

    def clear(self) -> None:
        """Forget everything."""
        self._open.clear()
        self._known.clear()

    def next_name(self, now_s: float) -> str | None:
        """Return the parameter to ask for now; None while none is due."""
        if now_s - self._asked_s < _PAUSE_S:
            return None
        for name, asked in list(self._open.items()):
            if now_s - asked.at_s < _AGAIN_S:
                continue
            if asked.tries >= _TRIES:
                del self._open[name]
                self._known[name] = None
                continue
            asked.tries += 1
            asked.at_s = self._asked_s = now_s
            return name
        return None

    def take(self, name: str, value: float) -> None:
        """Take the value of a parameter; those that nobody asked for are ignored."""
        if self._open.pop(name, None) is not None:
            self._known[name] = value

    def finished(self) -> dict[str, float | None] | None:
        """Return once what is known of all that was wanted; None where that did not answer."""
        if self._open or not self._known:
            return None
        known, self._known = self._known, {}
        return known
