"""What other decisions on a flight's inputs would have put on the ground.

Both ways, the recorded and the other, go through one model of the sprayer: the curves and lags of
the recorded set-up, orders at their planned times. So an override changes what is decided, and not
what the sprayer is. The ground cannot react: the aircraft flies as it flew, and the sensors say
what they said.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.dose import zone_volumes
from analysis.evaluation import Distances, Evaluation, evaluate_strips
from analysis.flown.applied_flight import ValveChanges
from analysis.flown.applied_record import EvaluationError, record_of
from analysis.strips import strips_of
from companion.record.valve_rows import Row, ValveRows

if TYPE_CHECKING:
    from analysis.flown.applied_flight import AppliedFlight
    from companion.core.types import Decision

_MICRO = 1e-6
ML_PER_L = 1000.0
L_DIGITS = 6


@dataclass(slots=True)
class Orders:
    """What decisions brought about, collected one by one."""

    valves: ValveRows = field(default_factory=ValveRows)
    rows: list[Row] = field(default_factory=list)
    flow: list[tuple[float, float]] = field(default_factory=list)

    def take(self, decision: Decision) -> None:
        """Take in the next decision."""
        self.rows += self.valves.take_plan(decision.plan)
        self.flow.append((decision.now_s, decision.flow_l_min))

    def carried_out(self, flight: AppliedFlight) -> AppliedFlight:
        """Return the flight as if these had been its orders, each given at its planned time."""
        table = np.array([*self.rows, *self.valves.end()], dtype=np.float64).reshape(-1, 4)
        table = table[np.argsort(table[:, 0], kind="stable")]
        changes = ValveChanges(
            planned_s=table[:, 0] * _MICRO,
            actual_s=np.full(len(table), np.nan),
            valve=table[:, 2].astype(np.int64),
            duty=table[:, 3] / 1000.0,
        )
        at_s, flow = np.array(self.flow, dtype=np.float64).reshape(-1, 2).T
        last = np.searchsorted(at_s, flight.time_s, "right") - 1
        flows = np.where(last >= 0, flow[np.maximum(last, 0)], 0.0) if len(flow) else 0.0
        return replace(flight, changes=changes, flow_l_min=flows + np.zeros(len(flight.time_s)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Sprayed:
    """What one way of deciding put on the ground, by the model; `zones` are litres by zone."""

    volume_l: float
    zones: dict[str, float]
    lag_distance_m: Distances
    border_margin_m: Distances
    misapplied_percent: float | None
    spraying_accuracy_percent: float | None
    off_target_ml: float
    missed: int
    apart: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Moved:
    """By how many metres the changes lie elsewhere, + is later; the border's among them."""

    mean: float | None
    mean_abs: float | None
    max_abs: float | None
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class WhatIf:
    """Both ways beside each other."""

    recorded: Sprayed
    what_if: Sprayed
    moved_m: Moved


def compared(flight: AppliedFlight, recorded: Orders, other: Orders) -> WhatIf | None:
    """Return what both would have sprayed on this flight; None where it had no position."""
    try:
        was, was_found = _sprayed(recorded.carried_out(flight))
        now, now_found = _sprayed(other.carried_out(flight))
    except EvaluationError:
        return None
    places = {
        (step.change.valve, step.change.time_s): step.lag_distance_m for step in was_found.steps
    }
    moves = [
        step.lag_distance_m - before
        for step in now_found.steps
        if (before := places.get((step.change.valve, step.change.time_s))) is not None
        and step.lag_distance_m is not None
    ]
    distances = Distances.of(moves)
    return WhatIf(
        recorded=was,
        what_if=now,
        moved_m=Moved(
            mean=distances.mean,
            mean_abs=distances.mean_abs,
            max_abs=distances.max_abs,
            count=distances.count,
        ),
    )


def _sprayed(flight: AppliedFlight) -> tuple[Sprayed, Evaluation]:
    record = record_of(flight)
    strips = strips_of(record)
    found = evaluate_strips(record, strips)
    zones = zone_volumes(strips, record.prescription)
    sprayed = Sprayed(
        volume_l=found.applied_ml / ML_PER_L,
        zones={
            name or "-": round(zone.given_ml / ML_PER_L, L_DIGITS) for name, zone in zones.items()
        },
        lag_distance_m=found.lag_distance_m,
        border_margin_m=found.border_margin_m,
        misapplied_percent=found.misapplied_percent,
        spraying_accuracy_percent=found.spraying_accuracy_percent,
        off_target_ml=found.off_target_ml,
        missed=found.missed,
        apart=found.apart,
    )
    return sprayed, found
