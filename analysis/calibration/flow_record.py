"""From a journal to what an estimate needs: what was ordered when, and what the meter counted.

The core writes plans, each of which replaces the future of the one before it; an order counts
when no newer plan took it back before its time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from companion.core.types import Decision, FlowReport

if TYPE_CHECKING:
    from companion.core.nozzle import NozzleSet
    from companion.core.schedule import LagModel
    from companion.core.setup import Setup
    from companion.core.types import Input, SprayPlan, TimedChange

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
    """Return whether a reading can be used: one that repeats or that is no number cannot."""
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
