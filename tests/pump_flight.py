"""A sprayer with a pump over plots in a row, flown without a twin: the core's plans, and a plant.

The plant is a pump of first order with a dead time, behind valves that open and shut after
theirs. Eastwards at a constant speed, positions exact: what is wrong here is the schedule's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import shapely

from companion.core.controller import Memory, step
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.options.pump import Pump, PumpOutlet
from companion.core.prescription import Prescription
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.core.types import Decision, SprayPlan
from tests.builders import boom, flying, plots, setup

STEP_S = 0.05
# Below this it stands still, and has to spin up again.
STANDS_L_MIN = 0.05
CURVE = FlowCurve(duty=(0.15, 0.3, 0.45, 0.6, 0.8, 1.0), flow_l_min=(0.6, 1.5, 2.6, 3.8, 5.4, 7.0))
DEAD_S, SPIN_UP_S, UP_S, DOWN_S = 0.10, 0.30, 0.50, 0.35
PUMP_LAG = LagModel(
    on_s=SPIN_UP_S + UP_S, off_s=DEAD_S + DOWN_S, up_s=DEAD_S + UP_S, down_s=DEAD_S + DOWN_S,
    on_start_s=SPIN_UP_S, off_end_s=DEAD_S + 4.0 * DOWN_S, output_s=0.0,
    up_time_s=UP_S, down_time_s=DOWN_S,
)  # fmt: skip
# Sections that open and shut at once after 20 ms.
VALVE_S = 0.02
VALVE_LAG = LagModel(
    on_s=VALVE_S, off_s=VALVE_S, up_s=VALVE_S, down_s=VALVE_S, on_start_s=VALVE_S,
    off_end_s=VALVE_S, output_s=0.0,
)  # fmt: skip


def pump(way: PumpOutlet, lag: LagModel = PUMP_LAG) -> Pump:
    """Return a pump that makes the flow."""
    return Pump(control="modulates", outlet=way, lag=lag, curve=CURVE, fraction_min=0.1)


def pump_setup(
    rates: Sequence[float],
    way: PumpOutlet,
    *,
    length_m: float = 30.0,
    valves: int = 3,
    **change: object,
) -> Setup:
    """Return a set-up over plots in a row, of which a rate of 0 is not sprayed."""
    zones = plots([rates], length_m=length_m)
    given: dict[str, object] = {
        "prescription": Prescription(
            zones, boundary=shapely.box(0.0, -1.0, length_m * len(rates), 7.0)
        ),
        "boom": boom(valves),
        "nozzle_sets": (NozzleSet(valves=tuple(range(valves)), curve=CURVE),),
        "lag": VALVE_LAG,
        "pump": pump(way),
        "border": "volume",
    }
    return setup(**(given | change))


@dataclass
class Flown:
    """The decisions of a flight, and the plant: volume per second, by time."""

    decisions: list[Decision] = field(default_factory=list)
    flow_ml: list[tuple[float, float]] = field(default_factory=list)

    def volume_ml(self, from_s: float, to_s: float) -> float:
        """Return what came out of the nozzles between two times."""
        return sum(ml for at_s, ml in self.flow_ml if from_s <= at_s < to_s)


class Plant:
    """Follows plans by small steps of time."""

    tick_s = 0.005

    def __init__(self, way: PumpOutlet) -> None:
        self.way = way
        self.flow = 0.0  # of the pump, L/min
        self.orders: list[tuple[float, float]] = [(-math.inf, 0.0)]
        self.opens: list[tuple[float, bool]] = [(-math.inf, False)]
        self.spun_s = math.inf

    def run(self, plan: SprayPlan, from_s: float, to_s: float) -> list[tuple[float, float]]:
        """Carry a plan out from one time to another; return the volumes of the ticks."""
        out = []
        ticks = round((to_s - from_s) / self.tick_s)
        for tick in range(ticks):
            at_s = from_s + tick * self.tick_s
            fraction = plan.drives[0].at(at_s) if plan.drives else 0.0
            self._order(self.orders, at_s, fraction)
            self._order(self.opens, at_s, is_open(plan, at_s))
            self._move(at_s)
            is_out = self.way == "always" or bool(_then(self.opens, at_s - VALVE_S))
            out.append((at_s, self.flow * self.tick_s * 1000.0 / 60.0 if is_out else 0.0))
        return out

    def _order(self, orders: list[tuple[float, float]], at_s: float, value: float) -> None:
        if orders[-1][1] != value:
            orders.append((at_s, value))

    def _move(self, at_s: float) -> None:
        target = CURVE.flow_for(_then(self.orders, at_s - DEAD_S))
        if target == 0.0 and self.flow < STANDS_L_MIN:
            self.spun_s = math.inf
        elif self.spun_s == math.inf:
            self.spun_s = at_s + SPIN_UP_S - DEAD_S
        if at_s < self.spun_s:
            target = 0.0
        time_s = UP_S if target > self.flow else DOWN_S
        self.flow += (target - self.flow) * -math.expm1(-self.tick_s / time_s)


def _then(orders: Sequence[tuple[float, float]], at_s: float) -> float:
    return next(value for since_s, value in reversed(orders) if since_s <= at_s)


def is_open(plan: SprayPlan, at_s: float) -> bool:
    """Return whether a plan has any valve open at a time."""
    duty = list(plan.duty)
    for change in plan.changes:
        if change.at_s <= at_s:
            duty[change.valve] = change.duty
    return any(duty)


def fly(
    made: Setup, *, from_m: float, to_m: float, speed_m_s: float = 5.0, **state: object
) -> Flown:
    """Return a flight along the middle of the plots."""
    flown, memory = Flown(), Memory()
    assert made.pump is not None
    plant = Plant(made.pump.outlet)
    steps = math.ceil((to_m - from_m) / speed_m_s / STEP_S)
    for number in range(steps):
        now_s = number * STEP_S
        at = flying(
            now_s, from_m + now_s * speed_m_s,
            velocity_east_m_s=speed_m_s, checked_speed_m_s=speed_m_s,
        )  # fmt: skip
        decision, memory = step(made, replace(at, **state), memory, now_s)  # type: ignore[arg-type]
        flown.decisions.append(decision)
        flown.flow_ml += plant.run(decision.plan, now_s, now_s + STEP_S)
    return flown


def prescribed_ml(rates: Sequence[float], length_m: float = 30.0, width_m: float = 6.0) -> float:
    """Return the volume that the plots are prescribed."""
    return sum(rate * length_m * width_m / 10_000.0 * 1000.0 for rate in rates)
