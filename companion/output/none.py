"""No outputs at all: follows plans in time and only remembers what it would have done."""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import dataclass

from companion.output.timed import TimedExecutor

_KEPT = 10_000


@dataclass(frozen=True, slots=True, kw_only=True)
class DryChange:
    """A change of duty that an output would have made."""

    at_s: float
    valve: int
    duty: float


class DryRunExecutor(TimedExecutor):
    """For the first flights with the sprayer switched off, and for tests."""

    def __init__(self, valve_count: int, *, has_return: bool = False) -> None:
        super().__init__(valve_count, has_return=has_return)
        self._duty: list[float | None] = [None] * (valve_count + has_return)
        self.changes: deque[DryChange] = deque(maxlen=_KEPT)

    def _apply(self, valve: int, duty: float) -> bool:
        if self._duty[valve] == duty:
            return False
        self._duty[valve] = duty
        at_s = asyncio.get_running_loop().time()
        self.changes.append(DryChange(at_s=at_s, valve=valve, duty=duty))
        return True

    async def stop(self) -> None:
        """Close what is open; before `start` there is nothing."""
        if self._is_running:
            await super().stop()
