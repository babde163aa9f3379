"""Evidence of what flows: what the meter counted beside what was ordered, in whole PWM periods.

The table's volume of each valve is taken as late as the sprayer is, at the exact times of the
changes, so that an order whose flow is still on its way is no difference. A bin is a few PWM
periods long: the pulses cancel in it, and a fault shows within a second.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

from companion.core.options.flow_meter import (
    STALE_S,
    UNSTEADY_SHARE,
    Order,
    is_usable,
)
from companion.core.types import FaultKind, FlowReport, PressureReport

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


# What a wrong flow is, and of which valve: names for what `liquid_faults.py` has noticed.
#
# Nozzles and valves obey flow = conductance x sqrt(pressure). What is wrong behind the pressure
# sensor moves flow and pressure in opposite directions and changes the conductance; what is wrong
# before it moves both the same way and leaves the conductance as it was.

# A conductance that moves by less than this share of the flow's move is healthy.
SUPPLY_SHARE = 0.5
# A loss of this much of one valve's flow is that valve shut; the pressure that rises for the
# others hides an eighth of it (14.6 of 16.7 % on the twin of wang-2024).
SHUT_SHARE = (0.70, 1.20)
OPEN_SHARE = (0.75, 1.25)
# One valve is told from the next best by this many squared standard deviations: 1 in 2 000.
TOLD_APART = 12.0
# Of a bin: meter, its pulses, and what the lags leave at a change.
NOISE_SHARE = 0.02
NOISE_ML = 0.5
# One standard deviation of a meter's own gain, before anything is learnt of it.
GAIN_SPREAD = 0.03
# Pressures over expected: shut nozzles raise it by a third, a stopped pump leaves little.
PRESSURE_SHUT = 1.15
PRESSURE_LOST = 0.75


class Evidence(NamedTuple):
    """The bins since a fault began, means of flow and pressure over expected; and the sprayer.

    `known` are all bins that are kept, those from before the fault too; `likely_gain` is what the
    meter's gain would be taken for without them.
    """

    bins: tuple[Bin, ...]
    known: tuple[Bin, ...]
    gain: float
    likely_gain: float
    flow: float
    pressure: float | None
    open_ml_s: float
    unsteady_share: float = UNSTEADY_SHARE

    @classmethod
    def of(
        cls,
        known: Sequence[Bin],
        count: int,
        *,
        gain: float,
        likely_gain: float,
        pressure_gain: float,
        open_ml_s: float,
        unsteady_share: float = UNSTEADY_SHARE,
    ) -> Evidence:
        """Return the evidence of the last `count` bins; the first may lie before the fault."""
        bins = tuple(known[-count:])
        sure = bins[1:] or bins
        expected_ml = gain * math.fsum(each.all_ml for each in sure)
        pressures = [each.pressure for each in sure if each.pressure is not None]
        return cls(
            bins=sure,
            known=tuple(known),
            gain=gain,
            likely_gain=likely_gain,
            flow=math.fsum(each.metered_ml for each in sure) / expected_ml,
            pressure=_mean(pressures) / pressure_gain if pressures else None,
            open_ml_s=open_ml_s,
            unsteady_share=unsteady_share,
        )

    @property
    def is_unsteady(self) -> bool:
        """Whether the flow jumps from bin to bin, as no liquid does."""
        flows = [each.metered_ml / (self.gain * each.all_ml) for each in self.bins]
        moves = [abs(b - a) for a, b in pairwise(flows)]
        return len(moves) >= 2 and _mean(moves) > self.unsteady_share

    @property
    def is_supply(self) -> bool:
        """Whether flow and pressure agree with each other: the nozzles are as they were."""
        if self.pressure is None or not self.pressure > 0.0:
            return False
        conductance = self.flow / math.sqrt(self.pressure)
        return abs(conductance - 1.0) < SUPPLY_SHARE * abs(self.flow - 1.0)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)


def name_of_no_flow(evidence: Evidence, *, is_air_before: bool, is_tank_low: bool) -> FaultKind:
    """Return why nothing of what is ordered is metered."""
    pressure = evidence.pressure
    if pressure is None:
        return FaultKind.TANK_EMPTY if is_tank_low or is_air_before else FaultKind.NO_FLOW
    if pressure < PRESSURE_LOST:
        return FaultKind.TANK_EMPTY if is_tank_low or is_air_before else FaultKind.PUMP_OFF
    return FaultKind.NO_FLOW if pressure > PRESSURE_SHUT else FaultKind.DEAD_METER


def name_of(evidence: Evidence) -> FaultKind:
    """Return what is wrong with a flow that is too small or too large."""
    if evidence.is_unsteady:
        return FaultKind.AIR
    if evidence.is_supply:
        return FaultKind.SUPPLY
    if evidence.flow < 1.0:
        share = _share(evidence, is_open=False)
        return FaultKind.STUCK_CLOSED if _within(share, SHUT_SHARE) else FaultKind.CLOG
    share = _share(evidence, is_open=True)
    return FaultKind.STUCK_OPEN if _within(share, OPEN_SHARE) else FaultKind.LEAK


def _within(share: float, bounds: tuple[float, float]) -> bool:
    return bounds[0] <= share <= bounds[1]


def _share(evidence: Evidence, *, is_open: bool) -> float:
    """Return the wrong flow over that of one whole valve, the mean one of those in use.

    The meter's gain, the share and the bin with which the fault began are those that fit all bins
    best, by least squares. The sums of evidence may have begun before the fault, and the gain that
    is learnt may hold a part of it: both would make a stuck valve look like a smaller leak.
    """
    certain = 1.0 / GAIN_SPREAD**2
    gain_gain, gain_metered = certain, certain * evidence.likely_gain
    rows = []
    for each in evidence.known:
        weight = _weight(each, evidence.gain)
        rows.append((weight, each, _of_one_valve(each, evidence.open_ml_s, is_open=is_open)))
        gain_gain += weight * each.all_ml**2
        gain_metered += weight * each.all_ml * each.metered_ml
    best, found = -math.inf, 0.0
    gain_wrong = wrong_wrong = wrong_metered = 0.0
    for weight, each, wrong_ml in reversed(rows):
        gain_wrong += weight * each.all_ml * wrong_ml
        wrong_wrong += weight * wrong_ml**2
        wrong_metered += weight * wrong_ml * each.metered_ml
        determinant = gain_gain * wrong_wrong - gain_wrong**2
        if not determinant > 0.0:
            continue
        gain = (wrong_wrong * gain_metered - gain_wrong * wrong_metered) / determinant
        wrong = (gain_gain * wrong_metered - gain_wrong * gain_metered) / determinant
        # What the squares fall by: the more, the better the fit.
        fitted = gain * gain_metered + wrong * wrong_metered
        if fitted > best and gain > 0.0:
            best, found = fitted, wrong / gain
    return max(found, 0.0)


def _of_one_valve(each: Bin, open_ml_s: float, *, is_open: bool) -> float:
    """Return what one valve, the mean one in use, adds when it is stuck open or takes away shut."""
    used = [volume for volume in each.expected_ml if volume > 0.0]
    if not used:
        return 0.0
    return open_ml_s * (each.end_s - each.begin_s) - _mean(used) if is_open else -_mean(used)


def _weight(each: Bin, gain: float) -> float:
    return 1.0 / (NOISE_ML + NOISE_SHARE * gain * each.all_ml) ** 2


def valve_of(bins: Sequence[Bin], *, gain: float, open_ml_s: float, is_open: bool) -> int | None:
    """Return the valve whose orders explain the wrong flow; None where several do as well.

    Valves that always have the same duty cannot be told apart; the border, sets of nozzles,
    plots beside each other and clicks of single valves tell.
    """
    if not bins or len(bins[0].expected_ml) < 2:
        return None
    misfits = []
    for valve in range(len(bins[0].expected_ml)):
        shapes = []
        for each in bins:
            ordered_ml = gain * each.expected_ml[valve]
            open_ml = gain * open_ml_s * (each.end_s - each.begin_s)
            shapes.append(open_ml - ordered_ml if is_open else -ordered_ml)
        misfits.append((_misfit(bins, shapes, gain), valve))
    misfits.sort()
    return misfits[0][1] if misfits[1][0] - misfits[0][0] > TOLD_APART else None


def _misfit(bins: Sequence[Bin], shapes: Sequence[float], gain: float) -> float:
    """Return the weighted squares that the best share, 0 to 1.2, of `shapes` leaves over."""
    weights, wrong = [], []
    for each in bins:
        wrong.append(each.metered_ml - gain * each.all_ml)
        weights.append(_weight(each, gain))
    rows = list(zip(weights, shapes, wrong, strict=True))
    square = math.fsum(w * s * s for w, s, _ in rows)
    share = math.fsum(w * s * r for w, s, r in rows) / square if square > 0.0 else 0.0
    share = min(max(share, 0.0), 1.2)
    return math.fsum(w * (r - share * s) ** 2 for w, s, r in rows)
