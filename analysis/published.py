"""What the paper that this project started from has published, for the tables beside ours.

P1: Wang et al., a variable-rate spray system with lag compensation on a six-rotor UAV, Journal of
Agricultural Engineering 2024, LV:1547.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import asdict, dataclass

from companion.core.nozzle import FLOW_LAWS, FlowLaw

P1_SOURCE = "Journal of Agricultural Engineering 2024, LV:1547"


@dataclass(frozen=True, slots=True, kw_only=True)
class P1LagDistance:
    """P1's lag distance [m] at one speed; None where only the mean is given."""

    speed_m_s: float
    mean: float
    min: float | None
    max: float | None
    where: str


# P1 gives the mean at 6 m/s as "4.2 m s-1"; metres must be meant.
P1_LAG_DISTANCE_M: dict[str, tuple[P1LagDistance, ...]] = {
    "none": (
        P1LagDistance(speed_m_s=5.0, mean=3.87, min=3.5, max=4.3, where="Figure 8a and text"),
        P1LagDistance(speed_m_s=6.0, mean=4.2, min=None, max=None, where="text on Figure 8b"),
    ),
    "look-ahead": (
        P1LagDistance(speed_m_s=5.0, mean=0.32, min=-0.27, max=0.78, where="Figure 8a and text"),
    ),
}

# Table 5: spraying accuracy [%] by flight speed [m/s] and rate [L/ha], with lag compensation.
P1_RATES_L_HA = (14.5, 15.4, 16.6, 17.7, 19.4, 20.5, 22.7, 23.8, 25.5, 27.8)
P1_SPRAYING_ACCURACY_PERCENT: dict[float, tuple[float, ...]] = {
    4.0: (91.56, 92.63, 93.26, 93.55, 94.62, 94.34, 95.28, 95.33, 95.88, 96.48),
    5.0: (93.73, 93.28, 93.43, 94.58, 95.46, 94.69, 94.74, 95.67, 96.27, 96.09),
    6.0: (93.66, 93.84, 94.23, 94.66, 95.85, 95.16, 95.81, 95.61, 96.31, 97.32),
}
P1_MEAN_ACCURACY_PERCENT = 94.77

# Everything of the above in a form that JSON takes.
P1_RESULTS: dict[str, object] = {
    "source": P1_SOURCE,
    "lag_distance_m": {
        method: [asdict(row) for row in rows] for method, rows in P1_LAG_DISTANCE_M.items()
    },
    "spraying_accuracy_percent": {
        "where": "Table 5; mean and range in the text",
        "mean": P1_MEAN_ACCURACY_PERCENT,
        "min": 91.56,
        "max": 97.32,
        "rates_l_ha": list(P1_RATES_L_HA),
        "by_speed_m_s": {
            f"{speed:g}": list(row) for speed, row in P1_SPRAYING_ACCURACY_PERCENT.items()
        },
    },
}


def p1_accuracy_percent(speed_m_s: float) -> float | None:
    """Return the mean of Table 5 at one speed; None where P1 did not fly.

    >>> p1_accuracy_percent(5.0)
    94.794
    """
    row = P1_SPRAYING_ACCURACY_PERCENT.get(speed_m_s)
    return None if row is None else round(sum(row) / len(row), 3)


def p1_lag_distance_m(method: str, speed_m_s: float) -> P1LagDistance | None:
    """Return P1's lag distance; None where P1 has none.

    >>> p1_lag_distance_m("look-ahead", 5.0).mean
    0.32
    """
    rows = P1_LAG_DISTANCE_M.get(method, ())
    return next((row for row in rows if row.speed_m_s == speed_m_s), None)


# What P1 published of its valves' flow: a measured table and a law, which do not agree.
#
# P1: see `published`. Table 2 is of one nozzle; Eq. 2 gives the duty that its controller orders.
# Between the rows of the table flows are on straight lines.

# Beyond this share of the flow, law and table are said to disagree.
DISAGREE_FROM = 0.03


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
