"""What the orders stand for so far: litres, the rate on the ground, and when it changes next.

For people who watch a flight: figures of orders, not of what came out of the nozzles.
"""

from __future__ import annotations

import math

from companion.core.types import Decision

# Slower than this a rate in L/ha says nothing: a hovering aircraft sprays on one spot.
SPEED_MIN_M_S = 0.5
# Decisions come every 0.06 s at least; after a longer gap nobody knows what was given.
GAP_MAX_S = 1.0


class Tally:
    """Adds up decisions, one after the other."""

    def __init__(self, width_m: float | None) -> None:
        self._width_m = width_m
        self._at_s: float | None = None
        self._flow_l_min = 0.0
        self.volume_l = 0.0

    def take(self, decision: Decision) -> None:
        """Add what the orders in force since the last decision stand for."""
        if self._at_s is not None and 0.0 < decision.now_s - self._at_s <= GAP_MAX_S:
            self.volume_l += self._flow_l_min * (decision.now_s - self._at_s) / 60.0
        self._at_s = decision.now_s
        flow_l_min = decision.flow_l_min
        self._flow_l_min = flow_l_min if math.isfinite(flow_l_min) else 0.0

    def given_l_ha(self, decision: Decision) -> float | None:
        """Return the rate that the flow in force is on the strips that are to get any."""
        rates = decision.rate_l_ha
        wanted = sum(rate is not None and rate > 0.0 for rate in rates)
        speed_m_s = speed_of(decision)
        if self._width_m is None or speed_m_s is None or not speed_m_s >= SPEED_MIN_M_S:
            return None
        if not wanted:
            return None
        width_m = self._width_m * wanted / len(rates)
        return decision.flow_l_min / 60.0 / (width_m * speed_m_s) * 10_000.0


def wanted_l_ha(decision: Decision) -> float:
    """Return the mean of the rates that are prescribed below the boom; 0 where there is none."""
    rates = [rate for rate in decision.rate_l_ha if rate is not None]
    return sum(rates) / len(rates) if rates else 0.0


def speed_of(decision: Decision) -> float | None:
    """Return the speed over ground; None where nothing is known of it."""
    state = decision.state
    if state is None or not state.velocity_known:
        return None
    return math.hypot(state.velocity_east_m_s, state.velocity_north_m_s)


def next_change_s(decision: Decision) -> float | None:
    """Return how long it is to the next change of rate that is planned; None: none in sight."""
    ahead_s = [
        change.at_s - decision.now_s
        for change in decision.plan.changes
        if change.restart and change.at_s >= decision.now_s
    ]
    return min(ahead_s, default=None)
