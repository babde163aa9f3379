"""Whether a wind that the autopilot tells is an estimate; one that never moves is none.

ArduCopter sends WIND with exactly 0 while it estimates no wind, whatever blows, and an estimator
that has stopped goes on telling its last number. A real estimate changes with every message.
"""

from __future__ import annotations

import math
from dataclasses import replace

from companion.core.types import Input, LandedReport, WindReport

# Asked for twice a second; a link that is slowed to a quarter still shows five reports in this.
STILL_MAX_S = 10.0


class WindWatch:
    """Looks at all inputs; hands on each wind, as not known where it cannot be an estimate."""

    def __init__(self) -> None:
        self._in_air = False
        self._last: tuple[float | None, float | None, float | None] | None = None
        self._moved_s = -math.inf

    def take(self, item: Input) -> Input:
        """Return the input; a wind that is no estimate without its numbers."""
        if isinstance(item, LandedReport):
            self._in_air = item.in_air is True
        if not isinstance(item, WindReport) or item.speed_m_s is None:
            return item
        told = (item.speed_m_s, item.east_m_s, item.north_m_s)
        if told != self._last:
            self._last, self._moved_s = told, item.received_s
        stands_still = self._in_air and not item.received_s - self._moved_s <= STILL_MAX_S
        if item.speed_m_s == 0.0 or stands_still:
            return replace(item, speed_m_s=None, east_m_s=None, north_m_s=None)
        return item
