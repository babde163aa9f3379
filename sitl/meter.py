"""The flow meter read as the flight goes on: each step of the flow is taken once, in passing.

The plant's own `meter_volume_ml` answers for any time and goes over all of the past to do so;
this one goes forward only, so that a meter that reports often costs little.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable


from typing import NamedTuple

# Flows below this are what is left of sums that should be zero [mL/s]; slopes likewise [mL/s2].
ROUNDING = 1e-9
# How many periods' noise is asked for at once.
BLOCK = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class Metering:
    """One meter: when it began to count, its noise's period, its delay, pulses per millilitre.

    `factors` gives reading over truth of the first so many periods.
    """

    start_s: float
    period_s: float
    lag_s: float
    per_ml: float
    factors: Callable[[int], list[float]]


class MeterStream:
    """Counts what all valves together deliver, up to times that do not go back."""

    def __init__(self, metering: Metering) -> None:
        self._start_s, self._period_s = metering.start_s, metering.period_s
        self._lag_s, self._per_ml = metering.lag_s, metering.per_ml
        self._all_factors = metering.factors
        self._factors: list[float] = metering.factors(BLOCK)
        self._bends: list[tuple[float, float]] = []
        self._at_s = metering.start_s
        self._flow_ml_s = 0.0
        self._slope_ml_s2 = 0.0
        self._index = 0
        self._edge_s = metering.start_s + metering.period_s
        self._whole_ml = 0.0  # metered, all whole periods so far
        self._part_ml = 0.0  # true, of the period in progress

    def step(self, at_s: float, change_ml_s: float, ramp_s: float) -> None:
        """Let the flow begin to change at `at_s`, which was not counted yet, within `ramp_s`."""
        slope_ml_s2 = change_ml_s / ramp_s
        heapq.heappush(self._bends, (at_s, slope_ml_s2))
        heapq.heappush(self._bends, (at_s + ramp_s, -slope_ml_s2))

    def count(self, time_s: float) -> int:
        """Return the pulses up to `time_s`; the meter sees the flow its own delay later."""
        seen_s = time_s - self._lag_s
        while self._edge_s <= seen_s:
            self._run(self._edge_s)
            self._whole_ml += self._part_ml * self._factor()
            self._part_ml = 0.0
            self._index += 1
            self._edge_s = self._start_s + self._period_s * (self._index + 1)
        self._run(seen_s)
        volume_ml = self._whole_ml + self._part_ml * self._factor()
        return math.floor(volume_ml * self._per_ml + ROUNDING)

    def _factor(self) -> float:
        if self._index >= len(self._factors):
            self._factors = self._all_factors(len(self._factors) + BLOCK)
        return self._factors[self._index]

    def _run(self, until_s: float) -> None:
        bends = self._bends
        while bends and bends[0][0] <= until_s:
            at_s, slope_ml_s2 = heapq.heappop(bends)
            self._go(at_s)
            self._slope_ml_s2 += slope_ml_s2
            if abs(self._slope_ml_s2) < ROUNDING:
                self._slope_ml_s2 = 0.0
                if abs(self._flow_ml_s) < ROUNDING:
                    self._flow_ml_s = 0.0
        self._go(until_s)

    def _go(self, until_s: float) -> None:
        step_s = until_s - self._at_s
        if step_s > 0.0:
            self._part_ml += step_s * (self._flow_ml_s + 0.5 * self._slope_ml_s2 * step_s)
            self._flow_ml_s += self._slope_ml_s2 * step_s
            self._at_s = until_s


class _Volume(Protocol):
    """A flow that knows its volume at any one time."""

    def volume_at(self, time_s: float) -> float:
        """Return the cumulative volume."""


class VolumeMeter(MeterStream):
    """The meter of a flow that is no chain of ramps: a pump's."""

    def __init__(self, flow: _Volume, metering: Metering) -> None:
        super().__init__(metering)
        self._flow = flow
        self._seen_ml = 0.0

    def _run(self, until_s: float) -> None:
        volume_ml = self._flow.volume_at(until_s)
        self._part_ml += volume_ml - self._seen_ml
        self._seen_ml = volume_ml


# What reaches a valve: electrical edges, from whatever makes them.


class Edge(Protocol):
    """One valve is to be open or closed from `at_s`; `duty` is the one in force.

    An edge that repeats the state of its valve tells of a new duty: an open valve that stays open,
    or one that rests in its gap and is now closed for good (`duty` 0).
    """

    @property
    def at_s(self) -> float: ...  # noqa: D102
    @property
    def valve(self) -> int: ...  # noqa: D102
    @property
    def is_open(self) -> bool: ...  # noqa: D102
    @property
    def duty(self) -> float: ...  # noqa: D102


class BoardEdge(NamedTuple):
    """An edge that the driver board makes."""

    at_s: float
    valve: int
    is_open: bool
    duty: float
