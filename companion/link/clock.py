"""How far the autopilot's clock is from ours, and how long its positions are on the way.

TIMESYNC (mavlink.io/en/services/timesync.html): we send our time, the answer brings it back with
the autopilot's. The exchange with the shortest round trip has the smallest error: at most half of
it, where one direction takes all of the time.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from companion.core.types import ClockReport

_KEPT = 60
# What two crystals may drift apart: an exchange loses that much of its worth with its age.
_DRIFT = 50e-6


class _Exchange(NamedTuple):
    round_trip_s: float
    offset_s: float
    received_s: float


class ClockOffset:
    """Estimates `ours - theirs` [s] from the quickest of the last exchanges."""

    def __init__(self) -> None:
        self._asked_ns: deque[int] = deque(maxlen=8)
        self._exchanges: deque[_Exchange] = deque(maxlen=_KEPT)
        self._is_new = False
        self.position_delay_s: float | None = None

    def ask(self, now_s: float) -> int:
        """Return the number to send, which the answer will bring back."""
        asked_ns = round(now_s * 1e9)
        self._asked_ns.append(asked_ns)
        return asked_ns

    def answer(self, tc1_ns: int, ts1_ns: int, received_s: float) -> None:
        """Take an answer; one to somebody else's question is ignored."""
        if ts1_ns not in self._asked_ns:
            return
        self._asked_ns.remove(ts1_ns)
        asked_s = ts1_ns * 1e-9
        round_trip_s = received_s - asked_s
        if not round_trip_s >= 0.0:
            return
        offset_s = 0.5 * (asked_s + received_s) - tc1_ns * 1e-9
        self._exchanges.append(_Exchange(round_trip_s, offset_s, received_s))
        self._is_new = True

    def take_report(self) -> list[ClockReport]:
        """Return what is known, once after each answer: an input of the core."""
        best = self._best()
        if best is None or not self._is_new:
            return []
        self._is_new = False
        return [
            ClockReport(
                received_s=self._exchanges[-1].received_s,
                offset_s=best.offset_s,
                round_trip_s=best.round_trip_s,
            )
        ]

    @property
    def round_trip_s(self) -> float | None:
        """Return the round trip of the best of the last exchanges."""
        best = self._best()
        return None if best is None else best.round_trip_s

    @property
    def offset_s(self) -> float | None:
        """Return what to add to the autopilot's time since boot to have ours."""
        best = self._best()
        return None if best is None else best.offset_s

    def position(self, boot_s: float, received_s: float) -> None:
        """Take the time stamps of a position; keeps how late it came, slowly averaged."""
        offset_s = self.offset_s
        if offset_s is None:
            return
        delay_s = received_s - (boot_s + offset_s)
        before_s = self.position_delay_s
        self.position_delay_s = (
            delay_s if before_s is None else before_s + (delay_s - before_s) / 20
        )

    def _best(self) -> _Exchange | None:
        """Return the exchange with the smallest possible error, drift with its age included."""
        if not self._exchanges:
            return None
        now_s = self._exchanges[-1].received_s
        return min(
            self._exchanges,
            key=lambda each: 0.5 * each.round_trip_s + _DRIFT * (now_s - each.received_s),
        )
