"""From a journal to what an estimate needs: orders, counts, and the steps they make.

The core writes plans, each of which replaces the future of the one before it; an order counts
when no newer plan took it back before its time.

A step is one kind of change (on, off, up, down) of several valves at nearly one time. Small
changes in between are trims for the speed: their volume is known well enough to be taken out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from companion.core.types import Decision, FlowReport

if TYPE_CHECKING:
    from companion.core.nozzle import NozzleSet
    from companion.core.schedule import LagModel
    from companion.core.setup import Setup
    from companion.core.types import Input, SprayPlan, TimedChange

# --------------------------------------------------------------------------------------- the record

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """One change of one valve's duty, carried out; flows are what its curve says [mL/s]."""

    at_s: float
    valve: int
    before: float
    after: float
    before_ml_s: float
    after_ml_s: float

    @property
    def change_ml_s(self) -> float:
        """Return by how much the flow should change."""
        return self.after_ml_s - self.before_ml_s


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowRecord:
    """All orders of a flight and all readings of its meter, both in order of time."""

    orders: tuple[Order, ...]
    time_s: Floats
    volume_ml: Floats
    period_s: float
    lag: LagModel


def record_of(items: Iterable[Input | Decision], setup: Setup) -> FlowRecord:
    """Return the record in a journal's inputs and decisions."""
    plans = CarriedOut(valve_count=len(setup.boom.valves))
    times_s: list[float] = []
    volumes_ml: list[float] = []
    for item in items:
        if isinstance(item, Decision):
            plans.take(item.plan, item.now_s)
        elif isinstance(item, FlowReport) and _is_newer(item, times_s):
            times_s.append(item.received_s)
            volumes_ml.append(item.volume_ml)
    plans.finish()
    return FlowRecord(
        orders=orders_of(plans, setup.nozzle_sets[-1]),
        time_s=np.array(times_s, dtype=np.float64),
        volume_ml=np.array(volumes_ml, dtype=np.float64),
        period_s=setup.pwm.period_s,
        lag=setup.lag,
    )


def _is_newer(report: FlowReport, times_s: list[float]) -> bool:
    """Return whether a reading can be used: one that repeats or that is not a number cannot."""
    if not math.isfinite(report.volume_ml):
        return False
    return not times_s or report.received_s > times_s[-1]


def orders_of(plans: CarriedOut, largest: NozzleSet) -> tuple[Order, ...]:
    """Return the orders with the flow of the largest set's curve, which all steps are judged by."""
    share_ml_s = 1000.0 / 60.0 / len(largest.valves)
    duty = [0.0] * plans.valve_count
    made = []
    for at_s, valve, after in plans.done:
        before, duty[valve] = duty[valve], after
        made.append(
            Order(
                at_s=at_s,
                valve=valve,
                before=before,
                after=after,
                before_ml_s=largest.curve.flow_for(before) * share_ml_s,
                after_ml_s=largest.curve.flow_for(after) * share_ml_s,
            )
        )
    return tuple(made)


class CarriedOut:
    """Carries plans out as every executor does: each change at its time, until the lease ends."""

    def __init__(self, *, valve_count: int) -> None:
        self.valve_count = valve_count
        self.done: list[tuple[float, int, float]] = []
        self._duty = [0.0] * valve_count
        self._changes: tuple[TimedChange, ...] = ()
        self._lease_s = math.inf

    def take(self, plan: SprayPlan, now_s: float) -> None:
        """Carry out what was due before `now_s`, then replace the future."""
        self._run(now_s)
        for valve, duty in enumerate(plan.duty):
            self._set(now_s, valve, duty)
        self._changes, self._lease_s = plan.changes, plan.lease_until_s
        self._run(now_s)

    def finish(self) -> None:
        """Carry out the last plan to its end, where everything closes."""
        self._run(math.inf)

    def _run(self, until_s: float) -> None:
        begun = 0
        for change in self._changes:
            if change.at_s > until_s or change.at_s >= self._lease_s:
                break
            self._set(change.at_s, change.valve, change.duty)
            begun += 1
        self._changes = self._changes[begun:]
        if self._lease_s <= until_s and self._lease_s < math.inf:
            for valve in range(len(self._duty)):
                self._set(self._lease_s, valve, 0.0)
            self._changes, self._lease_s = (), math.inf

    def _set(self, at_s: float, valve: int, duty: float) -> None:
        if duty != self._duty[valve]:
            self._duty[valve] = duty
            self.done.append((at_s, valve, duty))


# ---------------------------------------------------------------------------------------- its steps

# Below this share of the valve's flow a change between two open duties is a trim.
TRIM_SHARE = 0.08
# Smaller steps than this share of the larger flow say more of the meter than of the valves.
SMALLEST_STEP = 0.10
# Orders this near are one step: a boom that is 2 degrees off crosses an edge within 35 ms at 5 m/s.
TOGETHER_S = 0.15
# The flow is taken to be steady this many lags after an order: lags off by half still are.
SETTLE_LAGS = 2.5
SETTLE_MIN_S = 0.3
# Whole PWM periods of steady flow that a line needs, and what it uses at most.
PERIODS_MIN = 6
PERIODS_MAX = 24
# Trims around a step may move the flow by this share of it; correction leaves far less of that.
TRIMMED_MAX = 0.25


class Kind(StrEnum):
    """The four kinds of change, each with a lag of its own."""

    ON = "on"
    OFF = "off"
    UP = "up"
    DOWN = "down"


class Reject(StrEnum):
    """Why a step is not used."""

    MIXED = "valves changed in different ways"
    SMALL = "step too small"
    NEAR = "too near to another step"
    TRIMMED = "trimmed too much"
    NO_METER = "meter missing, late or restarted"
    UNSTEADY = "flow not steady"
    NOT_FOLLOWED = "flow did not follow the order"
    ODD = "far from the other steps"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Orders of one kind at nearly one time, and the windows of steady flow around them."""

    kind: Kind
    orders: tuple[Order, ...]
    trims: tuple[Order, ...]
    before_s: tuple[float, float]
    after_s: tuple[float, float]

    @property
    def change_ml_s(self) -> float:
        """Return by how much the flow of all valves should change."""
        return math.fsum(order.change_ml_s for order in self.orders)

    @property
    def at_s(self) -> float:
        """Return when it was ordered: the mean over the valves, by their share of the change."""
        first_s = self.orders[0].at_s
        moment = math.fsum(order.change_ml_s * (order.at_s - first_s) for order in self.orders)
        return first_s + moment / self.change_ml_s


def settle_s(lag: LagModel) -> float:
    """Return how long after an order the flow is taken to be still on its way."""
    longest_s = max(lag.on_s, lag.off_s, lag.up_s, lag.down_s, lag.off_end_s)
    return max(SETTLE_LAGS * (longest_s + lag.output_s), SETTLE_MIN_S)


def is_trim(order: Order) -> bool:
    """Return whether an order only follows the speed."""
    larger_ml_s = max(order.before_ml_s, order.after_ml_s)
    is_open = order.before > 0.0 and order.after > 0.0
    return is_open and abs(order.change_ml_s) < TRIM_SHARE * larger_ml_s


def find_steps(
    record: FlowRecord, *, smallest: float = SMALLEST_STEP
) -> tuple[list[Step], Counter[Reject]]:
    """Return all steps whose surroundings allow an estimate, and why the others do not.

    `smallest` is the least share of the larger flow that a step may be.
    """
    groups = _groups(record.orders)
    trims = [order for order in record.orders if is_trim(order)]
    rejected: Counter[Reject] = Counter()
    steps = []
    for number in range(len(groups)):
        step = _step(record, groups, number, trims, smallest)
        if isinstance(step, Reject):
            rejected[step] += 1
        else:
            steps.append(step)
    return steps, rejected


def _groups(orders: Sequence[Order]) -> list[tuple[Order, ...]]:
    """Return the orders that are no trims, those near each other together."""
    groups: list[list[Order]] = []
    for order in orders:
        if is_trim(order):
            continue
        if groups and order.at_s - groups[-1][0].at_s <= TOGETHER_S:
            groups[-1].append(order)
        else:
            groups.append([order])
    return [tuple(group) for group in groups]


def _kind(group: Sequence[Order]) -> Kind | None:
    kinds = {_kind_of(order) for order in group}
    valves = {order.valve for order in group}
    return kinds.pop() if len(kinds) == 1 and len(valves) == len(group) else None


def _kind_of(order: Order) -> Kind:
    if order.before == 0.0:
        return Kind.ON
    if order.after == 0.0:
        return Kind.OFF
    return Kind.UP if order.after > order.before else Kind.DOWN


def _step(
    record: FlowRecord,
    groups: Sequence[tuple[Order, ...]],
    number: int,
    trims: Sequence[Order],
    smallest: float,
) -> Step | Reject:
    """Return one step, or why it cannot be used."""
    group = groups[number]
    kind = _kind(group)
    if kind is None:
        return Reject.MIXED
    # What all valves give: steps of a few valves only are small beside the flow of the others.
    larger_ml_s = max(_flow_ml_s(record.orders, group, is_after=a) for a in (False, True))
    change_ml_s = math.fsum(order.change_ml_s for order in group)
    if not abs(change_ml_s) >= smallest * larger_ml_s:
        return Reject.SMALL
    settle = settle_s(record.lag)
    most_s = PERIODS_MAX * record.period_s
    first_s, last_s = group[0].at_s, group[-1].at_s
    begin_s, end_s = first_s - most_s, last_s + settle + most_s
    if number > 0:
        begin_s = max(begin_s, groups[number - 1][-1].at_s + settle)
    if number + 1 < len(groups):
        end_s = min(end_s, groups[number + 1][0].at_s)
    before_s, after_s = (begin_s, first_s), (last_s + settle, end_s)
    # The meter may start late and end early.
    if len(record.time_s):
        before_s = (max(begin_s, float(record.time_s[0])), first_s)
        after_s = (last_s + settle, min(end_s, float(record.time_s[-1])))
    if not all(b - a >= PERIODS_MIN * record.period_s for a, b in (before_s, after_s)):
        return Reject.NEAR
    near = tuple(trim for trim in trims if before_s[0] - settle < trim.at_s < after_s[1])
    if not _range_ml_s(near) <= TRIMMED_MAX * abs(change_ml_s):
        return Reject.TRIMMED
    return Step(kind=kind, orders=group, trims=near, before_s=before_s, after_s=after_s)


def _range_ml_s(trims: Sequence[Order]) -> float:
    """Return between how far apart flows the trims took all valves together."""
    sums = [0.0, *accumulate(trim.change_ml_s for trim in trims)]
    return max(sums) - min(sums)


def _flow_ml_s(orders: Sequence[Order], group: Sequence[Order], *, is_after: bool) -> float:
    """Return what all valves should give before or after a group of orders."""
    flows: dict[int, float] = {}
    for order in orders:
        if order.at_s >= group[0].at_s:
            break
        flows[order.valve] = order.after_ml_s
    if is_after:
        flows.update((order.valve, order.after_ml_s) for order in group)
    return math.fsum(flows.values())
