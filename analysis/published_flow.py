"""What P1 published of its valves' flow: a measured table and a law, which do not agree.

P1: see `published`. Table 2 is of one nozzle; Eq. 2 gives the duty that its controller orders.
Between the rows of the table flows are on straight lines.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from companion.core.nozzle import FLOW_LAWS, FlowLaw

# Beyond this share of the flow, law and table are said to disagree.
DISAGREE_FROM = 0.03
SET_NAME = "wang-2024"


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedSet:
    """One nozzle set of P1: its column of Table 2 and its branch of Eq. 2."""

    law: FlowLaw
    duty: tuple[float, ...]
    nozzle_flow_l_min: tuple[float, ...]

    @property
    def nozzles(self) -> int:
        """Return how many nozzles spray."""
        return self.law.nozzles

    def law_flow_l_min(self, duty: float) -> float:
        """Return the flow for which Eq. 2 orders a duty."""
        return (100.0 * duty - self.law.offset) / self.law.slope

    def table_flow_l_min(self, duty: float) -> float | None:
        """Return the flow of all nozzles at a duty by Table 2; None outside the table."""
        if not self.duty[0] <= duty <= self.duty[-1]:
            return None
        i = min(bisect_right(self.duty, duty), len(self.duty) - 1)
        share = (duty - self.duty[i - 1]) / (self.duty[i] - self.duty[i - 1])
        low, high = self.nozzle_flow_l_min[i - 1], self.nozzle_flow_l_min[i]
        return self.nozzles * (low + share * (high - low))


@dataclass(frozen=True, slots=True, kw_only=True)
class Disagreement:
    """What Table 2 says comes out when Eq. 2 is asked for a flow."""

    nozzles: int
    asked_l_min: float
    duty: float
    table_l_min: float
    excess_percent: float


_EQ_2 = {law.nozzles: law for law in FLOW_LAWS["wang-2024-eq2"]}
EIGHT = PublishedSet(
    law=_EQ_2[8],
    duty=(0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0),
    nozzle_flow_l_min=(0.128, 0.234, 0.277, 0.393, 0.435, 0.521, 0.534),
)
TWELVE = PublishedSet(
    law=_EQ_2[12],
    duty=(0.2, 0.4, 0.5, 0.7, 0.8, 0.9, 1.0),
    nozzle_flow_l_min=(0.123, 0.252, 0.273, 0.385, 0.421, 0.496, 0.508),
)
SETS = (EIGHT, TWELVE)


def excess_percent(published: PublishedSet, flow_l_min: float) -> float | None:
    """Return how much more than asked Table 2 delivers at Eq. 2's duty; None outside the table.

    >>> round(excess_percent(EIGHT, 2.0), 1)
    22.4
    """
    found = published.table_flow_l_min(published.law.duty(flow_l_min))
    return None if found is None else 100.0 * (found / flow_l_min - 1.0)


def disagreements(published: PublishedSet) -> list[Disagreement]:
    """Return where law and table disagree: at the law's ends and at every row of the table.

    Between these the excess has no extreme: there it is (a + b flow) / flow.
    """
    law = published.law
    flows = {law.flow_min_l_min, law.flow_max_l_min}
    flows |= {published.law_flow_l_min(duty) for duty in published.duty}
    rows = []
    for flow in sorted(flows):
        if not law.flow_min_l_min <= flow <= law.flow_max_l_min:
            continue
        excess = excess_percent(published, flow)
        if excess is None or not abs(excess) > 100.0 * DISAGREE_FROM:
            continue
        rows.append(
            Disagreement(
                nozzles=published.nozzles,
                asked_l_min=flow,
                duty=law.duty(flow),
                table_l_min=flow * (1.0 + excess / 100.0),
                excess_percent=excess,
            )
        )
    return rows


def nearest_set(duty: float, flow_l_min: float) -> PublishedSet:
    """Return the set of P1 whose flow at a duty comes nearest to a measured one."""

    def distance(published: PublishedSet) -> float:
        held = min(max(duty, published.duty[0]), published.duty[-1])
        return abs((published.table_flow_l_min(held) or 0.0) - flow_l_min)

    return min(SETS, key=distance)
