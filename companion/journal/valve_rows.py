"""Changes of the valves: as planned, and as ordered where an output tells when it gave the order.

Pure. A row is integers only (microseconds, thousandths), so that a trim ten times a second of each
valve costs 25 bytes and not a hundred.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.core.types import SprayPlan

# No duty: whatever comes next differs.
_UNTOLD = -1

Row = tuple[int | None, int | None, int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class ValveOrder:
    """An order that an output gave: `planned_s` is None where no plan asked for it (a fault)."""

    valve: int
    duty: float
    planned_s: float | None
    given_s: float


def micros(at_s: float | None) -> int | None:
    """Return whole microseconds; None for what is no time.

    >>> micros(1.25), micros(float("nan"))
    (1250000, None)
    """
    return None if at_s is None or not math.isfinite(at_s) else round(at_s * 1e6)


class ValveRows:
    """Rows (planned_us, actual_us, valve, duty_permille), from plans or from orders.

    Of plans: a change counts when its time has come and no newer plan has replaced it; a lease
    that ends closes. With `from_orders` plans are not looked at: what was ordered happened.
    """

    def __init__(self, *, from_orders: bool = False) -> None:
        self.from_orders = from_orders
        self._plan: SprayPlan | None = None
        self._permille: dict[int, int] = {}

    def take_order(self, order: ValveOrder) -> list[Row]:
        """Return the row of an order; none where it changes nothing."""
        return self._changed(
            micros(order.planned_s), micros(order.given_s), order.valve, order.duty
        )

    def take_plan(self, plan: SprayPlan) -> list[Row]:
        """Return what came about of the plan before, and what this one changes at once."""
        if self.from_orders:
            return []
        before, self._plan = self._plan, plan
        rows = [] if before is None else self._came_about(before, plan.issued_s)
        for valve, duty in enumerate(plan.duty):
            rows += self._changed(micros(plan.issued_s), None, valve, duty)
        return rows

    def forget(self) -> None:
        """Take nothing for told: rows were lost, and each valve's next duty is a change."""
        self._permille = dict.fromkeys(self._permille, _UNTOLD)

    def end(self) -> list[Row]:
        """Return what the last plan brings about by itself: its lease ends."""
        before, self._plan = self._plan, None
        return [] if before is None else self._came_about(before, math.inf)

    def _came_about(self, plan: SprayPlan, until_s: float) -> list[Row]:
        rows: list[Row] = []
        last_s = min(plan.lease_until_s, until_s)
        for change in plan.changes:
            if not change.at_s <= last_s:
                break
            rows += self._changed(micros(change.at_s), None, change.valve, change.duty)
        if plan.lease_until_s < until_s:
            for valve in range(len(plan.duty)):
                rows += self._changed(micros(plan.lease_until_s), None, valve, 0.0)
        return rows

    def _changed(
        self, planned_us: int | None, actual_us: int | None, valve: int, duty: float
    ) -> list[Row]:
        permille = round(1000.0 * duty)
        if self._permille.get(valve, 0) == permille:
            return []
        self._permille[valve] = permille
        return [(planned_us, actual_us, valve, permille)]
