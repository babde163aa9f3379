"""What a link does to messages on their way: delay, loss, repetition, lateness; and TIMESYNC.

Works on the inputs of a flight without sockets, where the autopilot's clock is the twin's own:
the true offset is 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from companion.core.types import ClockReport, Input, Telemetry

TIMESYNC_S = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """A link: `delay_s` for every message on top of the twin's own, shares of positions.

    `late_share` of the positions come `late_s` later than the others, and those behind them wait,
    as on a stream of bytes. `timesync` has the autopilot answer once a second, by `delay_s` and
    up to `round_trip_more_s` there and back, each way its own.
    """

    delay_s: float = 0.0
    lost_share: float = 0.0
    repeated_share: float = 0.0
    late_share: float = 0.0
    late_s: float = 0.0
    timesync: bool = False
    round_trip_more_s: float = 0.004


def sent_over(items: Iterable[Input], way: Way, *, seed: int) -> Iterator[Input]:
    """Yield the inputs in the order in which they arrive over `way`."""
    rng = np.random.default_rng((seed, 33))
    free_s = ask_s = float("-inf")
    for item in items:
        if way.timesync and item.received_s >= ask_s:
            ask_s = item.received_s + TIMESYNC_S
            yield _answer(way, item.received_s, rng)
        lost, repeated, late = rng.random(3).tolist()
        is_position = isinstance(item, Telemetry)
        if is_position and lost < way.lost_share:
            continue
        received_s = item.received_s + way.delay_s
        if is_position and late < way.late_share:
            received_s += way.late_s
        free_s = max(free_s, received_s)
        arrived = replace(item, received_s=free_s)
        yield arrived
        if is_position and repeated < way.repeated_share:
            yield arrived


def _answer(way: Way, now_s: float, rng: np.random.Generator) -> ClockReport:
    """Return what an exchange that ends now says: wrong by half of what the two ways differ."""
    there_s, back_s = (way.delay_s + way.round_trip_more_s * rng.random(2)).tolist()
    return ClockReport(
        received_s=now_s, offset_s=0.5 * (back_s - there_s), round_trip_s=there_s + back_s
    )
