"""Which time of day it is: by this computer at first, by the autopilot as soon as it says so.

A board without a clock of its own wakes in 1970 or where it was switched off; the autopilot has
the time of the satellites. Pure: times are arguments.
"""

from __future__ import annotations

from companion.core.types import UtcReport
from companion.record.geopackage import time_text

# What differs by more is another time, and not the way of a message.
JUMP_S = 1.0


class FlightClock:
    """Makes a time since 1970 of the companion's monotonic one.

    Of the autopilot's reports the one counts that was shortest on its way: delays only ever make
    its clock look slow.
    """

    def __init__(self, offset_s: float) -> None:
        self.offset_s = offset_s
        self.source = "computer"
        self.known_s: float | None = None

    def take(self, report: UtcReport) -> str | None:
        """Take a report; return what is to be said of it, None where it only agrees."""
        offset_s = report.utc_s - report.received_s
        if not abs(offset_s) < float("inf"):
            return None
        apart_s = offset_s - self.offset_s
        if self.known_s is None:
            self.offset_s, self.source, self.known_s = offset_s, "autopilot", report.received_s
            text = time_text(report.utc_s)
            return f"the autopilot says {text}; this computer's clock was {-apart_s:+.1f} s off"
        if abs(apart_s) > JUMP_S:
            self.offset_s = offset_s
            return f"the autopilot's time of day jumped by {apart_s:+.1f} s"
        self.offset_s = max(self.offset_s, offset_s)
        return None

    def text(self, at_s: float) -> str | None:
        """Return a monotonic time as UTC; None for what is no time."""
        return time_text(at_s + self.offset_s)
