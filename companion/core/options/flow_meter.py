"""Metered flow beside what the table says, over the same whole PWM periods.

The table's volume is known from the duties ordered; it is taken at the time of the order whose
flow the meter sees, so that an order whose flow is still on its way is no difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from companion.core.nozzle import NozzleSet
from companion.core.schedule import LagModel
from companion.core.types import FlowReport, PwmLimits

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


# What a healthy sprayer does, for `liquid_faults.py`: its spread, its pressure, its tables by duty.

# Whole periods of about this time: short enough to see a fault within a second, long enough that
# 1 % of noise a period and the meter's pulses leave about 1 %.
BIN_S = 0.25
# Bins that differ by more than this from one to the next are no liquid: healthy ones differ by 1 %.
UNSTEADY_SHARE = 0.06
# A sprayer that follows more slowly than this is judged only when it has settled.
SLOW_S = 0.5
CURVE_STEPS = 400


def bin_length_s(period_s: float, wanted_s: float = BIN_S) -> float:
    """Return the length of a bin: the whole periods nearest to what is wanted.

    >>> round(bin_length_s(1.0 / 11.0) * 11.0, 6)
    3.0
    """
    return max(round(wanted_s / period_s), 1) * period_s


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """What is known of the healthy sprayer; `pressure_kpa` at `pressure_duty`, increasing.

    `spread` is one standard deviation of metered over expected flow, `closed_share` of the full
    flow may be metered while all is closed; without `closed_check` that is not looked at, for a
    meter that also counts what returns to the tank. A flow is compared over `bin_s`; one that
    moves by more than `unsteady_share` from bin to bin is no liquid.
    """

    spread: float = 0.0125
    closed_share: float = 0.02
    meter_minimum_l_min: float = 0.5
    pressure_duty: tuple[float, ...] = ()
    pressure_kpa: tuple[float, ...] = ()
    reserve_l: float | None = None
    meter_required: bool = False
    closed_check: bool = True
    bin_s: float = BIN_S
    unsteady_share: float = UNSTEADY_SHARE

    def __post_init__(self) -> None:
        if not 0.001 <= self.spread <= 0.05:
            raise ValueError(f"spread must lie in [0.001, 0.05], got {self.spread}")
        if not 0.001 <= self.closed_share <= 0.5:
            raise ValueError(f"closed_share must lie in [0.001, 0.5], got {self.closed_share}")
        if not 0.05 <= self.bin_s <= 5.0:
            raise ValueError(f"bin_s must lie in [0.05, 5], got {self.bin_s}")
        if not 0.01 <= self.unsteady_share <= 1.0:
            raise ValueError(f"unsteady_share must lie in [0.01, 1], got {self.unsteady_share}")
        if not 0.0 <= self.meter_minimum_l_min <= 1e4:
            raise ValueError("meter_minimum_l_min must lie in [0, 1e4]")
        if len(self.pressure_duty) != len(self.pressure_kpa) or len(self.pressure_duty) == 1:
            raise ValueError("pressure_duty and pressure_kpa need as many points, 2 or more")
        duties = self.pressure_duty
        if not all(a < b for a, b in pairwise(duties)):
            raise ValueError(f"pressure_duty must increase, got {duties}")
        if not all(0.0 < kpa < 1e5 for kpa in self.pressure_kpa):
            raise ValueError("pressure_kpa must be positive")

    def pressure_at(self, duty: float) -> float | None:
        """Return the healthy pressure at a duty, a straight line between the points."""
        duties, kpa = self.pressure_duty, self.pressure_kpa
        if not duties:
            return None
        for i in range(1, len(duties) - 1):
            if duty < duties[i]:
                break
        else:
            i = len(duties) - 1
        share = min(max((duty - duties[i - 1]) / (duties[i] - duties[i - 1]), 0.0), 1.0)
        return kpa[i - 1] + share * (kpa[i] - kpa[i - 1])


class Order(NamedTuple):
    """From `at_s` on: what the table says of each valve, and the pressure that goes with it."""

    at_s: float
    flows_ml_s: tuple[float, ...]
    pressure_kpa: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Watching:
    """The law with what a sprayer makes of it: times, and the table of each set by duty."""

    settings: Detection
    delay_s: float
    bin_s: float
    closed_after_s: float
    settle_s: float
    full_ml_s: float
    open_ml_s: float
    valves: tuple[tuple[int, ...], ...]
    shares: tuple[tuple[float, ...], ...]
    tables: tuple[tuple[float, ...], ...]

    @classmethod
    def of(
        cls, settings: Detection, sets: tuple[NozzleSet, ...], lag: LagModel, pwm: PwmLimits
    ) -> Watching:
        """Return the watching of a sprayer."""
        lags = (lag.on_s, lag.off_s, lag.up_s, lag.down_s)
        largest = sets[-1]
        full_ml_s = largest.flow_max_l_min * ML_S_PER_L_MIN
        steps = [step / CURVE_STEPS for step in range(CURVE_STEPS + 1)]
        return cls(
            settings=settings,
            delay_s=sum(lags) / len(lags) + lag.output_s,
            bin_s=bin_length_s(pwm.period_s, settings.bin_s),
            closed_after_s=max(lag.off_end_s, *lags) + lag.output_s + 0.5,
            settle_s=3.0 * max(lags) if max(lags) > SLOW_S else 0.0,
            full_ml_s=full_ml_s,
            open_ml_s=full_ml_s / len(largest.valves),
            valves=tuple(nozzles.valves for nozzles in sets),
            shares=tuple(tuple(map(nozzles.share, nozzles.valves)) for nozzles in sets),
            tables=tuple(
                tuple(
                    nozzles.curve.flow_for(duty) * ML_S_PER_L_MIN / len(nozzles.valves)
                    for duty in steps
                )
                for nozzles in sets
            ),
        )

    def order(self, at_s: float, duties: tuple[float, ...], index: int) -> Order:
        """Return what duties stand for, by the table of a nozzle set."""
        table, flows, known = self.tables[index], [0.0] * len(duties), dict[float, float]()
        shares = self.shares[index]
        total = 0.0
        for valve, share in zip(self.valves[index], shares, strict=True):
            duty = duties[valve]
            if duty > 0.0:
                flow = known.get(duty)
                if flow is None:
                    i = min(int(duty * CURVE_STEPS), CURVE_STEPS - 1)
                    part = duty * CURVE_STEPS - i
                    flow = known[duty] = table[i] + (table[i + 1] - table[i]) * part
                flows[valve] = flow * share
                total += duty
        used = sum(1 for flow in flows if flow > 0.0)
        pressure = self.settings.pressure_at(total / used) if used else None
        return Order(at_s, tuple(flows), pressure)
