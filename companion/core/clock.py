"""When a position was sent, on our clock: by TIMESYNC where it is answered, else by the arrivals.

The mean of the arrivals has the mean delay of the way in it (5 ms and more at 57 600 baud); what
TIMESYNC says has not. The difference is kept as `delay_s`, so that a TIMESYNC that falls silent
leaves the last known delay and makes no jump, and one that comes back moves the time slowly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from companion.core.types import ClockReport, Telemetry

# Arrivals later than this against the mean are late messages; the mean is not moved by more. One
# that much earlier says that the mean rests on late ones: it begins anew.
CLOCK_STEP_S = 0.02
CLOCK_RESET_S = 1.0
# An exchange that took longer than this could be wrong by half of it and is no measurement.
ROUND_TRIP_MAX_S = 0.25
# Answers come once a second; after five that failed the arrivals alone count.
REPORT_AGE_MAX_S = 5.0
# Later than this in the mean is no link's delay but another clock (an answer in UTC, a reboot).
DELAY_MAX_S = 0.5
# No position arrives before it was sent; the autopilot's time has whole milliseconds.
EARLY_MAX_S = 0.005
# How fast the time may be moved while spraying, in seconds a second: at 5 m/s 2.5 cm in a second
# and 2.5 mm between two positions at 10 Hz.
SLEW = 0.005


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Mean of arrival time minus the autopilot's time, and how much of it is the way here.

    `received_s` and `boot_s` are both times of the newest arrival.
    """

    offset_s: float
    count: int
    delay_s: float = 0.0
    received_s: float = 0.0
    boot_s: float = 0.0

    @property
    def sent_offset_s(self) -> float:
        """Return what to add to the autopilot's time to have ours."""
        return self.offset_s - self.delay_s


def is_believed(report: ClockReport | None, clock: Clock, now_s: float) -> bool:
    """Whether an answer is young, quick, and agrees with when the positions arrive."""
    if report is None:
        return False
    late_s = clock.offset_s - report.offset_s
    return (
        0.0 <= report.round_trip_s <= ROUND_TRIP_MAX_S
        and abs(now_s - report.received_s) <= REPORT_AGE_MAX_S
        and -EARLY_MAX_S - 0.5 * report.round_trip_s <= late_s <= DELAY_MAX_S
    )


class Ticked(NamedTuple):
    """The clock after an arrival, whether it rests on TIMESYNC, and how far it was put right.

    What `moved_s` says is a better knowledge of the clock and no motion: known times move with it.
    """

    clock: Clock
    is_synced: bool
    moved_s: float


def tick(
    before: Clock | None, item: Telemetry, report: ClockReport | None, *, at_once: bool
) -> Ticked:
    """Return the clock with one more arrival; a late message hardly moves the mean.

    `at_once`: nothing is sprayed that a jump could harm.
    """
    clock = _arrived(before, item, report)
    now_s = item.received_s
    if report is None or not is_believed(report, clock, now_s):
        anew = before is not None and clock.count == 1
        moved_s = clock.offset_s - before.offset_s if before is not None and anew else 0.0
        return Ticked(clock, False, moved_s if abs(moved_s) < CLOCK_RESET_S else 0.0)
    wanted_s = min(report.offset_s, clock.offset_s)
    used_s = wanted_s
    if before is not None and not at_once:
        reach_s = SLEW * min(max(now_s - before.received_s, 0.0), 1.0)
        step_s = wanted_s - before.sent_offset_s
        used_s = before.sent_offset_s + min(max(step_s, -reach_s), reach_s)
    moved_s = 0.0 if before is None else used_s - before.sent_offset_s
    return Ticked(replace(clock, delay_s=clock.offset_s - used_s), True, moved_s)


def _arrived(clock: Clock | None, item: Telemetry, report: ClockReport | None) -> Clock:
    seen_s = item.received_s - item.boot_s
    if clock is None:
        return Clock(offset_s=seen_s, count=1, received_s=item.received_s, boot_s=item.boot_s)
    near = -CLOCK_STEP_S <= seen_s - clock.offset_s < CLOCK_RESET_S
    if not near and not (seen_s > clock.offset_s and is_believed(report, clock, item.received_s)):
        return replace(
            clock, offset_s=seen_s, count=1, received_s=item.received_s, boot_s=item.boot_s
        )
    step_s = min(max(seen_s - clock.offset_s, -CLOCK_STEP_S), CLOCK_STEP_S)
    count = min(clock.count + 1, 100)
    return Clock(
        offset_s=clock.offset_s + step_s / count,
        count=count,
        delay_s=clock.delay_s,
        received_s=item.received_s,
        boot_s=item.boot_s,
    )


def on_time_s(received_s: float, before: Clock | None, after: Clock) -> float:
    """Return when a message without a time of its own had come, were the link as ever.

    It came between two positions, the newest arrivals of `before` and `after`, and was sent
    between them. A link or a computer that stood still for half a second would else make two
    counts of a meter a tenth of the flow, and the next two ten times the flow. Never later than
    `received_s`.

    >>> calm = Clock(offset_s=100.0, count=9, received_s=110.0, boot_s=10.0)
    >>> late = Clock(offset_s=100.0, count=9, received_s=110.7, boot_s=10.1)
    >>> round(on_time_s(110.69, calm, late), 3), round(on_time_s(110.05, None, calm), 3)
    (110.099, 110.0)
    """
    until_s = after.boot_s + after.offset_s
    if before is None or not after.boot_s > before.boot_s:
        return min(received_s, until_s)
    waited_s = after.received_s - before.received_s
    share = (received_s - before.received_s) / waited_s if waited_s > 0.0 else 1.0
    from_s = before.boot_s + after.offset_s
    return min(received_s, from_s + min(max(share, 0.0), 1.0) * (until_s - from_s))
