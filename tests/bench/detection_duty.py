"""How soon each fault of the liquid is found at each duty, while the valves hold it."""

from __future__ import annotations

from dataclasses import replace

from companion.core.types import SprayPlan, VehicleState
from sitl.liquid_faults import LiquidFault, LiquidFaultKind
from tests.bench.liquid_flights import Fidelity, Flight, found_over, moved_by, ordered

# For the table by duty: a duty is held, a fault begins, later all is closed.
HELD_DUTIES = (0.25, 0.4, 0.6, 0.8, 0.95)
HELD_S, AFTER_S, CLOSED_S, HELD_STEP_S = 8.0, 6.0, 4.0, 0.05
EXAMPLES = (
    (LiquidFaultKind.STUCK_CLOSED, 0.0, 3),
    (LiquidFaultKind.CLOG, 0.5, 3),
    (LiquidFaultKind.CLOG, 0.08, None),
    (LiquidFaultKind.CLOG, 0.05, None),
    (LiquidFaultKind.STUCK_OPEN, 0.0, 3),
    (LiquidFaultKind.LEAK, 0.10, None),
    (LiquidFaultKind.LEAK, 0.03, None),
    (LiquidFaultKind.SUPPLY, 0.10, None),
    (LiquidFaultKind.NO_FLOW, 0.0, None),
    (LiquidFaultKind.DEAD_METER, 0.0, None),
)


def by_duty(fidelity: Fidelity, *, seeds: int, pressure: bool) -> list[dict[str, object]]:
    """Return how soon each fault is found while all valves hold a duty, and then are closed."""
    told = next(d.state for d in ordered(5.0, 1) if d.state is not None and d.flow_l_min > 0.0)
    rows = []
    for kind, share, valve in EXAMPLES:
        row: dict[str, object] = {"kind": kind.value, "share": share, "valve": valve}
        for duty in HELD_DUTIES:
            times, moved = [], 0.0
            for seed in range(1, seeds + 1):
                flight = Flight(
                    speed_m_s=5.0, path=1, seed=seed, fidelity=fidelity, pressure=pressure
                )
                fault = LiquidFault(kind=kind, from_s=HELD_S, share=share, valve=valve)
                moved = moved_by(fault, duty)
                changes = found_over(_held(duty, told), flight, (fault,))
                times.append(changes[0][0] - HELD_S if changes else None)
            row[f"{duty:g}"] = {"moved": moved, "found_s": times}
        rows.append(row)
    return rows


def _held(duty: float, told: VehicleState) -> list[tuple[float, SprayPlan, VehicleState]]:
    """Return the steps of a duty that is held, then closed."""
    steps = []
    for number in range(1, round((HELD_S + AFTER_S + CLOSED_S) / HELD_STEP_S)):
        now_s = number * HELD_STEP_S
        each = duty if now_s < HELD_S + AFTER_S else 0.0
        plan = SprayPlan(
            sequence=number, issued_s=now_s, duty=(each,) * 6, changes=(),
            lease_until_s=now_s + 0.3,
        )  # fmt: skip
        steps.append((now_s, plan, replace(told, time_s=now_s)))
    return steps
