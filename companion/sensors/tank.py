"""What is left in the tank: counted down by the flow meter, checked by a level where there is one.

The count is exact over a sortie and knows nothing of what was filled in; a level in a tank that
tilts and sloshes is the opposite. So the level says where the count begins, and when the two have
come apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

from companion.core.types import Input, TankReport

# A level is the mean of this time, and not known before: sloshing is faster.
LEVEL_S = 10.0
REPORT_S = 1.0


class Counter(Protocol):
    """What counts the flow."""

    def volume_ml(self) -> float:
        """Return what has been metered since the start; NaN where that is not known."""


class LevelGauge(Protocol):
    """What measures the level, in litres."""

    async def open(self) -> None:
        """Begin."""

    def value(self, now_s: float) -> tuple[float | None, str] | None:
        """Return litres, or None and a fault; None before the first reading."""

    async def close(self) -> None:
        """End."""


class TankSensor:
    """The tank as a sensor: once a second."""

    def __init__(
        self,
        counter: Counter | None,
        gauge: LevelGauge | None,
        *,
        capacity_l: float,
        filled_l: float | None = None,
        tolerance_l: float = 2.0,
    ) -> None:
        if not 0.0 < capacity_l < math.inf:
            raise ValueError(f"capacity_l must be positive, got {capacity_l}")
        self._counter = counter
        self._gauge = gauge
        self._capacity_l = capacity_l
        self._tolerance_l = tolerance_l
        self._full_l = filled_l
        self._at_ml = 0.0
        self._mean_l: float | None = None
        self._begun_s = self._seen_s = -math.inf
        self._reported_s = -math.inf

    async def open(self, wake: Callable[[], None]) -> None:  # noqa: ARG002 - steps come anyway
        """Begin."""
        if self._gauge is not None:
            await self._gauge.open()

    def filled(self, litres: float) -> None:
        """Take the operator's word for what is in the tank now; the level follows by itself."""
        if not 0.0 <= litres <= self._capacity_l:
            raise ValueError(f"litres must lie in [0, {self._capacity_l:g}], got {litres}")
        counted_ml = self._counted_ml()
        self._full_l, self._at_ml = litres, 0.0 if counted_ml is None else counted_ml

    def refilled(self, litres: float) -> bool:
        """Take a filling that the operator tells of; whether it goes into the tank.

        A level begins its mean anew, as what it saw before is not in the tank any more, and the
        next report is made at once.
        """
        if not 0.0 <= litres <= self._capacity_l:
            return False
        self.filled(litres)
        self._mean_l, self._reported_s = None, -math.inf
        return True

    def read(self, now_s: float) -> Sequence[Input]:
        """Return what is left, once a second."""
        level_l, fault = self._level(now_s)
        if not now_s - self._reported_s >= REPORT_S:
            return []
        self._reported_s = now_s
        counted_l = self._counted_l()
        if counted_l is None and level_l is not None and not fault:
            # Nobody has said what was filled in: the level is where the count begins.
            self.filled(min(max(level_l, 0.0), self._capacity_l))
        elif counted_l is not None and level_l is not None:
            if not abs(level_l - counted_l) <= self._tolerance_l:
                fault = fault or (
                    f"tank: {level_l:.1f} L by its level, {counted_l:.1f} L by the flow meter"
                )
            # The lesser is the safe one: the pump must not run dry.
            level_l = min(level_l, counted_l)
        elif counted_l is not None:
            level_l = counted_l
        return [TankReport(received_s=now_s, level_l=level_l, fault=fault)]

    def _counted_ml(self) -> float | None:
        volume_ml = math.nan if self._counter is None else self._counter.volume_ml()
        return volume_ml if math.isfinite(volume_ml) else None

    def _counted_l(self) -> float | None:
        counted_ml = self._counted_ml()
        if counted_ml is None or self._full_l is None:
            return None
        return max(self._full_l - (counted_ml - self._at_ml) / 1000.0, 0.0)

    def _level(self, now_s: float) -> tuple[float | None, str]:
        """Return the mean level, and the fault of its gauge."""
        found = None if self._gauge is None else self._gauge.value(now_s)
        if found is None:
            return None, ""
        level_l, fault = found
        if level_l is None:
            self._mean_l = None
            return None, fault
        if self._mean_l is None:
            self._mean_l, self._begun_s = level_l, now_s
        elif now_s > self._seen_s:
            # The mean of all so far, then of the last seconds.
            since_s = min(now_s - self._begun_s, LEVEL_S)
            share = min((now_s - self._seen_s) / since_s, 1.0)
            self._mean_l += share * (level_l - self._mean_l)
        self._seen_s = now_s
        return self._mean_l if now_s - self._begun_s >= LEVEL_S else None, fault

    async def close(self) -> None:
        """End."""
        if self._gauge is not None:
            await self._gauge.close()
