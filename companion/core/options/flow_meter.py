"""Metered flow beside what the table says, over the same whole PWM periods.

The table's volume is known from the duties ordered; it is taken at the time of the order whose
flow the meter sees, so that an order whose flow is still on its way is no difference.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.core.types import FlowReport

ML_S_PER_L_MIN = 1000.0 / 60.0
# A count older than this, or a gap of this between two, is no evidence of the flow now.
STALE_S = 0.5


class Ordered(NamedTuple):
    """What the table says: a volume up to `at_s`, and the flow from then on."""

    at_s: float
    volume_ml: float
    flow_ml_s: float


class Sample(NamedTuple):
    """A count of the meter beside the volume that the table says had come by then."""

    at_s: float
    metered_ml: float
    expected_ml: float


class Flows(NamedTuple):
    """Metered and expected flow over the same whole periods."""

    metered_ml_s: float
    expected_ml_s: float


def is_usable(report: FlowReport | None, last: FlowReport | None, now_s: float) -> bool:
    """Tell whether the count is young, a number, and goes on from the last one."""
    if report is None or not 0.0 <= now_s - report.received_s <= STALE_S:
        return False
    if last is None:
        return math.isfinite(report.volume_ml)
    if report.received_s == last.received_s:
        return report.volume_ml == last.volume_ml
    gap_s = report.received_s - last.received_s
    return 0.0 < gap_s <= STALE_S and last.volume_ml <= report.volume_ml < math.inf


def with_order(
    past: tuple[Ordered, ...], *, flow_l_min: float, now_s: float, keep_s: float
) -> tuple[Ordered, ...]:
    """Return the table's volume with its flow from `now_s` on; older than `keep_s` is dropped."""
    flow_ml_s = flow_l_min * ML_S_PER_L_MIN
    if not past:
        return (Ordered(now_s, 0.0, flow_ml_s),)
    last = past[-1]
    if last.flow_ml_s == flow_ml_s:
        return past
    volume_ml = last.volume_ml + last.flow_ml_s * (now_s - last.at_s)
    kept = 0
    while kept + 1 < len(past) and past[kept + 1].at_s <= now_s - keep_s:
        kept += 1
    return (*past[kept:], Ordered(now_s, volume_ml, flow_ml_s))


def with_count(
    samples: tuple[Sample, ...],
    report: FlowReport,
    past: tuple[Ordered, ...],
    *,
    delay_s: float,
    window_s: float,
) -> tuple[Sample, ...]:
    """Return the samples of the window with the newest count; none where no order is that old."""
    then_s = report.received_s - delay_s
    for order in reversed(past):
        if order.at_s <= then_s:
            expected_ml = order.volume_ml + order.flow_ml_s * (then_s - order.at_s)
            break
    else:
        return ()
    kept, from_s = 0, report.received_s - window_s
    while kept + 1 < len(samples) and samples[kept + 1].at_s <= from_s:
        kept += 1
    return (*samples[kept:], Sample(report.received_s, report.volume_ml, expected_ml))


def flows_over(samples: tuple[Sample, ...], window_s: float) -> Flows | None:
    """Return the flows over the window that ends with the last sample; None before it is full."""
    if len(samples) < 2:
        return None
    first, second, last = samples[0], samples[1], samples[-1]
    from_s = last.at_s - window_s
    if not first.at_s <= from_s < second.at_s:
        return None
    share = (from_s - first.at_s) / (second.at_s - first.at_s)
    metered_ml = first.metered_ml + share * (second.metered_ml - first.metered_ml)
    expected_ml = first.expected_ml + share * (second.expected_ml - first.expected_ml)
    return Flows(
        (last.metered_ml - metered_ml) / window_s, (last.expected_ml - expected_ml) / window_s
    )
