"""A quantity that follows its order as an exponential: a motor's speed, a supply's pressure."""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Stretch(NamedTuple):
    """From `at_s` on the value is target + off exp(-t / time), t since then."""

    at_s: float
    target: float
    off: float
    time_s: float

    def value(self, since_s: float) -> float:
        """Return the value."""
        return self.target + self.off * math.exp(-since_s / self.time_s)


class Approach:
    """Stretches in order of time; a later order never acts before an earlier one.

    >>> speed = Approach(up_s=1.0, down_s=0.5, start_s=0.0)
    >>> speed.go(1.0, 100.0)
    >>> [round(float(value), 1) for value in speed.values(np.array([0.5, 2.0, 9.0]))]
    [0.0, 63.2, 100.0]
    """

    def __init__(self, *, up_s: float, down_s: float, start_s: float) -> None:
        self._up_s, self._down_s = up_s, down_s
        self.stretches = [Stretch(start_s, 0.0, 0.0, up_s)]

    @property
    def target(self) -> float:
        """Return where it goes to."""
        return self.stretches[-1].target

    def go(self, at_s: float, target: float) -> None:
        """Let it go to a target from `at_s` on."""
        last = self.stretches[-1]
        if target == last.target:
            return
        at_s = max(at_s, last.at_s)
        value = last.value(at_s - last.at_s)
        time_s = self._up_s if target > value else self._down_s
        self.stretches.append(Stretch(at_s, target, value - target, time_s))

    def values(self, times_s: Floats) -> Floats:
        """Return the value at times that were not forgotten."""
        at_s, target, off, time_s = self.rows(times_s).T
        result: Floats = target + off * np.exp(-(times_s - at_s) / time_s)
        return result

    def rows(self, times_s: Floats) -> Floats:
        """Return (n, 4): the stretch that each time lies in."""
        table = np.array(self.stretches)
        i = np.maximum(np.searchsorted(table[:, 0], times_s, side="right") - 1, 0)
        found: Floats = table[i]
        # Before the first of all nothing has moved.
        found[:, 0] = np.minimum(found[:, 0], times_s)
        return found

    def place(self, time_s: float) -> int:
        """Return the number of the stretch that a time lies in."""
        return max(bisect_right(self.stretches, time_s, key=lambda each: each.at_s) - 1, 0)

    def forget(self, before_s: float) -> None:
        """Drop the stretches that end before `before_s`."""
        del self.stretches[: self.place(before_s)]
