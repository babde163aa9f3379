"""Rotary atomisers: a motor's speed makes the droplets, and follows the flow through it.

The median diameter (VMD) falls with the speed and grows with the flow, each by a power:
VMD = um (rpm / rpm0)^-b (flow / flow0)^c, from one measured point. Walton and Prewett (1949, Proc.
Phys. Soc. B 62:341) found b = 1 for discs that throw single drops, whose size the flow does not
touch; of atomiser wheels that throw sheets a feed exponent of 0.2 is reported (GEA Niro's notes on
rotary atomisers). Measure your own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from companion.core.boom import Boom
from companion.core.crossings import Route
from companion.core.nozzle import FlowCurve, flow_for_rate, overridden
from companion.core.options.whole_boom import boom_route
from companion.core.types import DriveChange, DrivePlan

# As of a valve's trims: smaller moves are noise of the speed.
FRACTION_STEP = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class DropletLaw:
    """Size by speed and flow, through one measured point."""

    um: float
    rpm: float
    flow_l_min: float
    rpm_exponent: float = 1.0
    flow_exponent: float = 0.2

    def __post_init__(self) -> None:
        for name in ("um", "rpm", "flow_l_min", "rpm_exponent"):
            if not 0.0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be above 0, got {getattr(self, name)}")
        if not 0.0 <= self.flow_exponent < float("inf"):
            raise ValueError(f"flow_exponent must not be negative, got {self.flow_exponent}")

    def size_um(self, rpm: float, flow_l_min: float) -> float:
        """Return the VMD at a speed and a flow.

        >>> law = DropletLaw(um=200.0, rpm=8000.0, flow_l_min=1.0)
        >>> round(law.size_um(16000.0, 1.0), 6)
        100.0
        """
        by_speed = (rpm / self.rpm) ** -self.rpm_exponent
        return float(self.um * by_speed * (flow_l_min / self.flow_l_min) ** self.flow_exponent)

    def rpm_for(self, size_um: float, flow_l_min: float) -> float:
        """Return the speed that makes droplets of a size at a flow.

        >>> law = DropletLaw(um=200.0, rpm=8000.0, flow_l_min=1.0)
        >>> round(law.size_um(law.rpm_for(150.0, 2.0), 2.0), 9)
        150.0
        """
        by_flow = (flow_l_min / self.flow_l_min) ** self.flow_exponent
        return float(self.rpm * (size_um / (self.um * by_flow)) ** (-1.0 / self.rpm_exponent))


@dataclass(frozen=True, slots=True, kw_only=True)
class Atomiser:
    """One motor: `speed` is its measured rpm by fraction, `share` its part of the boom's flow.

    It spins for `spin_up_s` before the liquid comes and for `run_on_s` after it ended.
    """

    name: str
    speed: FlowCurve  # of rpm: a strictly increasing curve, as a flow is
    law: DropletLaw
    droplet_um: float
    share: float
    spin_up_s: float
    run_on_s: float

    def __post_init__(self) -> None:
        if not 0.0 < self.share <= 1.0:
            raise ValueError(f"share must lie in (0, 1], got {self.share}")
        if not 0.0 < self.droplet_um < float("inf"):
            raise ValueError(f"droplet_um must be above 0, got {self.droplet_um}")
        for name in ("spin_up_s", "run_on_s"):
            if not 0.0 <= getattr(self, name) <= 30.0:
                raise ValueError(f"{name} must lie in [0, 30] s, got {getattr(self, name)}")

    def fraction_for(self, boom_flow_l_min: float) -> float:
        """Return the motor's fraction at a flow of the whole boom, held to what was measured."""
        if not boom_flow_l_min > 0.0:
            return 0.0
        rpm = self.law.rpm_for(self.droplet_um, self.share * boom_flow_l_min)
        low, high = self.speed.flow_l_min[0], self.speed.flow_l_min[-1]
        return self.speed.duty_for(min(max(rpm, low), high))


class Flow(NamedTuple):
    """From `at_s` on the nozzles let out `flow_l_min`."""

    at_s: float
    flow_l_min: float


def flows_ahead(
    boom: Boom, routes: tuple[Route, ...], *, skew: float, percent: float, limit_l_ha: float | None
) -> list[Flow]:
    """Return the boom's flow along its way, as it comes out of the nozzles."""
    width_m = boom.width_m * skew
    return [
        Flow(
            step.at_s,
            flow_for_rate(
                overridden(step.rate_l_ha or 0.0, percent, limit_l_ha),
                step.speed_m_s,
                width_m,
            ),
        )
        for step in boom_route(routes, boom)
    ]


def spinning(
    atomiser: Atomiser,
    flows: Sequence[Flow],
    *,
    in_force: float,
    ran_s: float,
    output_s: float,
    now_s: float,
    until_s: float,
) -> DrivePlan:
    """Return a motor's plan; `flows` begin with the one in force, `ran_s` is when some last was.

    Ahead of a start it has the speed of the flow to come, behind an end that of the flow that was.
    """
    orders = [*_orders(atomiser, flows, output_s)]
    due = [(at_s, fraction) for at_s, fraction in orders if at_s <= now_s]
    wanted = due[-1][1] if due else 0.0
    if wanted == 0.0 and now_s < ran_s + atomiser.run_on_s:
        wanted = in_force
        orders.append((ran_s + atomiser.run_on_s, 0.0))
        orders = _cleared(orders, ran_s + atomiser.run_on_s)
    changes = []
    stands = in_force
    for at_s, fraction in [(now_s, wanted), *(each for each in orders if each[0] > now_s)]:
        is_new = (fraction == 0.0) != (stands == 0.0)
        if at_s < until_s and (is_new or abs(fraction - stands) >= FRACTION_STEP):
            changes.append(DriveChange(at_s=at_s, fraction=fraction))
            stands = fraction
    return DrivePlan(fraction=in_force, changes=tuple(changes))


def _orders(
    atomiser: Atomiser, flows: Sequence[Flow], output_s: float
) -> list[tuple[float, float]]:
    """Return (time, fraction) in order of time; a start that comes before an end cancels it."""
    first = flows[0]
    made = [(float("-inf"), atomiser.fraction_for(first.flow_l_min))]
    for before, after in pairwise(flows):
        fraction = atomiser.fraction_for(after.flow_l_min)
        if fraction == 0.0:
            at_s = after.at_s + atomiser.run_on_s
        elif before.flow_l_min > 0.0:
            at_s = after.at_s - output_s
        else:
            at_s = after.at_s - output_s - atomiser.spin_up_s
            if len(made) > 1 and made[-1][0] >= at_s:
                made.pop()  # it has not run out yet: on with it, once the liquid of before ended
                at_s = max(at_s, before.at_s)
        made.append((max(at_s, made[-1][0]), fraction))
    return made


def _cleared(orders: list[tuple[float, float]], stop_s: float) -> list[tuple[float, float]]:
    """Return the orders without the stop at `stop_s` if a start comes before it."""
    orders.sort(key=lambda order: order[0])
    if any(fraction > 0.0 for at_s, fraction in orders if at_s <= stop_s):
        return [order for order in orders if order != (stop_s, 0.0)]
    return orders
