"""Evidence of what flows: what the meter counted beside what was ordered, in whole PWM periods.

The table's volume of each valve is taken as late as the sprayer is, at the exact times of the
changes, so that an order whose flow is still on its way is no difference. A bin is a few PWM
periods long: the pulses cancel in it, and a fault shows within a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

from companion.core.flow_window import STALE_S, is_usable
from companion.core.types import FlowReport, PressureReport, SprayPlan

# Whole periods of about this time: short enough to see a fault within a second, long enough that
# 1 % of noise a period and the meter's pulses leave about 1 %.
BIN_S = 0.25
# The ramp of a valve is over within this: a bin that begins later is not bent by it.
EDGE_S = 0.05
# Positions further apart than so many times the usual, and than this: the link, the vehicle or this
# computer stood still. At 20 Hz one may be lost, not two. A count of that time is as old as it may
# be, so no bin ends there: it goes on, for so many times its length. An order of that time was
# carried out as late as the end of the silence: a bin to which that is more than this is none.
SILENT_TIMES = 2.4
SILENT_MIN_S = 0.12
LONGEST_BINS = 4
LATE_SHARE = 0.03
_USUAL_SHARE = 0.1


class Order(NamedTuple):
    """From `at_s` on: what the table says of each valve, and the pressure that goes with it."""

    at_s: float
    flows_ml_s: tuple[float, ...]
    pressure_kpa: float | None


class Bin(NamedTuple):
    """Some whole periods: expected volume of each valve, metered volume, pressure over expected.

    `is_whole` says that the same valves were open all the time, from the count before its begin to
    the one after its end, and that no order of weight was held back: what the lags leave at the
    ends of a pass is no evidence, nor what somebody did too late.
    """

    begin_s: float
    end_s: float
    expected_ml: tuple[float, ...]
    metered_ml: float
    pressure: float | None
    is_whole: bool = True

    @property
    def all_ml(self) -> float:
        """Return the expected volume of all valves."""
        return math.fsum(self.expected_ml)


class Collecting(NamedTuple):
    """The bin that is being filled; `from_s` is None where none is.

    `from_ml` lies between two counts, of which `counted_s` is the time of the first. Of the
    positions it is known of what time the newest is and when it came, how far apart they usually
    come, and when none came for longer than that.
    """

    orders: tuple[Order, ...] = ()
    last: FlowReport | None = None
    from_s: float | None = None
    from_ml: float = 0.0
    counted_s: float = -math.inf
    position_s: float = -math.inf
    heard_s: float = -math.inf
    usual_s: float | None = None
    silences: tuple[tuple[float, float], ...] = ()
    pressure_s: float = -math.inf
    pressure_sum: float = 0.0
    pressure_count: int = 0


def bin_length_s(period_s: float, wanted_s: float = BIN_S) -> float:
    """Return the length of a bin: the whole periods nearest to what is wanted.

    >>> round(bin_length_s(1.0 / 11.0) * 11.0, 6)
    3.0
    """
    return max(round(wanted_s / period_s), 1) * period_s


def duties_of(plan: SprayPlan, until_s: float) -> Iterable[tuple[float, tuple[float, ...]]]:
    """Yield (time, duty of each valve) of what `plan` has brought about by `until_s`."""
    duty = list(plan.duty)
    yield plan.issued_s, tuple(duty)
    for change in plan.changes:
        if change.at_s > until_s or change.at_s >= plan.lease_until_s:
            break
        duty[change.valve] = change.duty
        yield max(change.at_s, plan.issued_s), tuple(duty)
    if plan.lease_until_s <= until_s:
        yield plan.lease_until_s, (0.0,) * len(duty)


def with_orders(
    orders: tuple[Order, ...], new: Iterable[Order], *, keep_from_s: float
) -> tuple[Order, ...]:
    """Return the orders with newer ones, without those over before `keep_from_s`."""
    grown = list(orders)
    for order in new:
        if grown and order.at_s <= grown[-1].at_s:
            order = order._replace(at_s=grown[-1].at_s)
        if not grown or order[1:] != grown[-1][1:]:
            grown.append(order)
    kept = 0
    while kept + 1 < len(grown) and grown[kept + 1].at_s <= keep_from_s:
        kept += 1
    return tuple(grown[kept:])


def expected_ml(orders: tuple[Order, ...], begin_s: float, end_s: float) -> tuple[float, ...]:
    """Return the table's volume of each valve between two times."""
    sums = [0.0] * (len(orders[0].flows_ml_s) if orders else 0)
    for number, order in enumerate(orders):
        until_s = orders[number + 1].at_s if number + 1 < len(orders) else end_s
        length_s = min(until_s, end_s) - max(order.at_s, begin_s)
        if length_s > 0.0:
            for valve, flow_ml_s in enumerate(order.flows_ml_s):
                sums[valve] += flow_ml_s * length_s
    return tuple(sums)


def _is_whole(orders: tuple[Order, ...], begin_s: float, end_s: float) -> bool:
    """Whether the same valves were open from `begin_s` to `end_s`, and a little before."""
    open_now: set[tuple[bool, ...]] = set()
    for number, order in enumerate(orders):
        until_s = orders[number + 1].at_s if number + 1 < len(orders) else end_s
        if order.at_s < end_s and until_s > begin_s - EDGE_S:
            open_now.add(tuple(flow > 0.0 for flow in order.flows_ml_s))
    return len(open_now) <= 1


def heard(state: Collecting, position_s: float, *, keep_from_s: float, now_s: float) -> Collecting:
    """Return the bin in progress after a look at `now_s` for a position that is newer."""
    if not position_s > state.position_s:
        return state
    gap_s = now_s - state.heard_s
    if not math.isfinite(gap_s):
        return state._replace(position_s=position_s, heard_s=now_s)
    usual_s = gap_s if state.usual_s is None else state.usual_s
    silences = tuple(each for each in state.silences if each[1] >= keep_from_s)
    if gap_s > max(SILENT_TIMES * usual_s, SILENT_MIN_S):
        silences = (*silences, (state.heard_s, now_s))
    usual_s += _USUAL_SHARE * (min(gap_s, 2.0 * usual_s) - usual_s)
    return state._replace(position_s=position_s, heard_s=now_s, usual_s=usual_s, silences=silences)


def _is_silent(state: Collecting, begin_s: float, end_s: float) -> bool:
    """Whether nothing was heard for some of this time."""
    return any(from_s < end_s and begin_s < until_s for from_s, until_s in state.silences)


def _late_ml(state: Collecting, begin_s: float, end_s: float) -> float:
    """Return the volume that orders of this time may have missed the table by, by coming late."""
    missed_ml = 0.0
    for from_s, until_s in state.silences:
        for before, order in pairwise(state.orders):
            if max(from_s, begin_s) <= order.at_s < min(until_s, end_s):
                moved_ml_s = math.fsum(order.flows_ml_s) - math.fsum(before.flows_ml_s)
                missed_ml += abs(moved_ml_s) * (until_s - order.at_s)
    return missed_ml


def pressed(
    state: Collecting, report: PressureReport | None, *, delay_s: float, now_s: float
) -> Collecting:
    """Return the bin with a pressure more, over that which goes with the orders of its time."""
    if report is None or report.pressure_kpa is None or not report.received_s > state.pressure_s:
        return state
    if not (0.0 <= now_s - report.received_s <= STALE_S and abs(report.pressure_kpa) < 1e6):
        return state
    state = state._replace(pressure_s=report.received_s)
    then_s = report.received_s - delay_s
    for order in reversed(state.orders):
        if order.at_s <= then_s:
            if order.pressure_kpa is None:
                return state
            return state._replace(
                pressure_sum=state.pressure_sum + report.pressure_kpa / order.pressure_kpa,
                pressure_count=state.pressure_count + 1,
            )
    return state


def collected(
    state: Collecting, report: FlowReport | None, *, bin_s: float, delay_s: float, now_s: float
) -> tuple[Collecting, Bin | None]:
    """Return the bin in progress after a count, and the one that it filled.

    A count that is stale, no number or does not go on from the last one begins anew.
    """
    last = state.last
    if not is_usable(report, last, now_s):
        sound = report is not None and math.isfinite(report.volume_ml)
        return _begun(state, None)._replace(last=report if sound else None), None
    assert report is not None  # is_usable
    if last is None or state.from_s is None:
        is_dated = not _is_silent(state, report.received_s, report.received_s)
        return _begun(state, report if is_dated else None)._replace(last=report), None
    if report.received_s == last.received_s:
        return state, None
    bins = int((report.received_s - state.from_s) / bin_s)
    edge_s = state.from_s + bins * bin_s
    is_dated = bins >= LONGEST_BINS or not _is_silent(state, last.received_s, report.received_s)
    if not (edge_s > last.received_s and bins > 0 and is_dated):
        return state._replace(last=report), None
    if not state.orders or state.orders[0].at_s > state.counted_s - delay_s:
        return _begun(state, report), None  # what was ordered then is not known
    share = _share_by(state.orders, last.received_s, edge_s, report.received_s, delay_s=delay_s)
    edge_ml = last.volume_ml + share * (report.volume_ml - last.volume_ml)
    expected = expected_ml(state.orders, state.from_s - delay_s, edge_s - delay_s)
    count = state.pressure_count
    late_ml = _late_ml(state, state.from_s - delay_s, edge_s - delay_s)
    filled = Bin(
        begin_s=state.from_s,
        end_s=edge_s,
        expected_ml=expected,
        metered_ml=edge_ml - state.from_ml,
        pressure=state.pressure_sum / count if count else None,
        is_whole=_is_whole(state.orders, state.counted_s - delay_s, report.received_s - delay_s)
        and not _is_silent(state, last.received_s, report.received_s)
        and late_ml <= LATE_SHARE * math.fsum(expected),
    )
    begun = _begun(state, report)
    return begun._replace(from_s=edge_s, from_ml=edge_ml, counted_s=last.received_s), filled


def _share_by(
    orders: tuple[Order, ...], last_s: float, edge_s: float, next_s: float, *, delay_s: float
) -> float:
    """Return the share of what came between two counts that had come by `edge_s`.

    As the orders have it, not by the time alone: a rate that changes between two counts of an
    autopilot's meter, 0.2 s apart and more, would else leave a tenth of a bin in its neighbour.
    """
    edge_s = min(max(edge_s, last_s), next_s)
    before_ml = math.fsum(expected_ml(orders, last_s - delay_s, edge_s - delay_s))
    after_ml = math.fsum(expected_ml(orders, edge_s - delay_s, next_s - delay_s))
    if before_ml + after_ml > 0.0:
        return before_ml / (before_ml + after_ml)
    return (edge_s - last_s) / (next_s - last_s)


def _begun(state: Collecting, report: FlowReport | None) -> Collecting:
    return state._replace(
        last=report,
        from_s=None if report is None else report.received_s,
        from_ml=0.0 if report is None else report.volume_ml,
        counted_s=-math.inf if report is None else report.received_s,
        pressure_sum=0.0,
        pressure_count=0,
    )
