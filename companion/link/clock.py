"""How far the autopilot's clock is from ours, and how long its positions are on the way.

TIMESYNC (mavlink.io/en/services/timesync.html): we send our time, the answer brings it back with
the autopilot's. The exchange with the shortest round trip has the smallest error.
"""

from __future__ import annotations

from collections import deque

_KEPT = 60


class ClockOffset:
    """Estimates `ours - theirs` [s] from the quickest of the last exchanges."""

    def __init__(self) -> None:
        self._asked_ns: deque[int] = deque(maxlen=8)
        self._exchanges: deque[tuple[float, float]] = deque(maxlen=_KEPT)
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
        offset_s = 0.5 * (asked_s + received_s) - tc1_ns * 1e-9
        self._exchanges.append((round_trip_s, offset_s))

    @property
    def round_trip_s(self) -> float | None:
        """Return the shortest round trip of the last exchanges."""
        return min(self._exchanges)[0] if self._exchanges else None

    @property
    def offset_s(self) -> float | None:
        """Return what to add to the autopilot's time since boot to have ours."""
        return min(self._exchanges)[1] if self._exchanges else None

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
