"""Questions of the time and their answers: how far the autopilot's clock is from ours.

TIMESYNC (mavlink.io/en/services/timesync.html): we send our time, the answer brings it back with
the autopilot's. An exchange is wrong by at most half of its round trip, where one direction takes
all of the time. What follows from many of them is the core's to say (`companion/core/clock.py`).
"""

from __future__ import annotations

from collections import deque

from companion.core.types import ClockReport

_KEPT = 60


class ClockExchanges:
    """Matches answers with questions, and keeps how quick the last ones were."""

    def __init__(self) -> None:
        self._asked_ns: deque[int] = deque(maxlen=8)
        self._round_trips_s: deque[float] = deque(maxlen=_KEPT)
        self._news: list[ClockReport] = []

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
        self._round_trips_s.append(round_trip_s)
        self._news.append(
            ClockReport(received_s=received_s, offset_s=offset_s, round_trip_s=round_trip_s)
        )

    def take_reports(self) -> list[ClockReport]:
        """Return every exchange once: inputs of the core."""
        news, self._news = self._news, []
        return news

    @property
    def is_known(self) -> bool:
        """Whether the autopilot has answered at all."""
        return bool(self._round_trips_s)

    @property
    def round_trip_s(self) -> float | None:
        """Return the quickest round trip of late."""
        return min(self._round_trips_s, default=None)
