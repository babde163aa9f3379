"""Why ground got another rate than was prescribed: every square metre is put to one cause.

Ground is off where its dose, a mean over one PWM period, is more than 10 % beside what was
prescribed. Colaco (2014) found 31 % of the points of ground machines so, most of them at changes
of rate or of speed; a flight should know the same of itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.assess.cause_marks import Marks, marks_of
from analysis.assess.cause_rules import (
    as_wished,
    beside_border,
    by_inhibit,
    in_acceleration,
    in_change,
    in_edge,
    in_saturation,
)
from analysis.assess.treated_ground import treated_ground

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.flight_record import FlightRecord
    from analysis.flown.applied_flight import AppliedFlight
    from analysis.lag import Step
    from analysis.strips import Strip
    from analysis.track import Bools

OFF_BY = 0.10
# Ground that got less than this part of its rate was left out.
SKIPPED_BELOW = 0.10


class Cause(StrEnum):
    """Why ground is off; where several would do, the first of them is named."""

    OPERATOR = "operator"  # it got the percentage that the operator asked for in flight
    INHIBIT = "inhibit"  # the safety layer held the valves closed
    EDGE = "edge"  # the border rule: nothing may fall outside
    CHANGE = "change"  # a boundary between two rates is near
    SATURATION = "saturation"  # no nozzle set delivers that rate at that speed
    ACCELERATION = "acceleration"  # the speed was changing
    OVERLAP = "overlap"  # treated again: the ground of the second time
    SKIP = "skip"  # left out, and none of the above: between passes too
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True, slots=True, kw_only=True)
class Causes:
    """Areas in square metres.

    `judged_m2` is the ground that the strips passed where something was prescribed or fell, with
    `skipped_m2` that lies between passes; `off_m2` is the part of it that is off, with what was
    treated again. `untreated_m2` is all ground of the field with a rate that no open strip passed,
    flown over or not: of a job in several flights most of it belongs to the others.
    """

    judged_m2: float
    off_m2: float
    by_cause: Mapping[Cause, float]
    by_inhibit: Mapping[str, float]
    doubled_m2: float
    skipped_m2: float
    untreated_m2: float

    @property
    def within_percent(self) -> float | None:
        """Return the share of the ground that got its rate within 10 %."""
        if not self.judged_m2 > 0.0:
            return None
        return 100.0 * (1.0 - min(self.off_m2 / self.judged_m2, 1.0))

    def as_json(self) -> dict[str, Any]:
        """Return areas, and the shares of the ground that is off."""
        whole = self.off_m2 if self.off_m2 > 0.0 else 1.0
        return {
            "judged_m2": self.judged_m2,
            "off_m2": self.off_m2,
            "within_10_percent": self.within_percent,
            "area_m2": {cause.value: area for cause, area in self.by_cause.items()},
            "share": {cause.value: area / whole for cause, area in self.by_cause.items()},
            "inhibit_m2": dict(self.by_inhibit),
            "doubled_m2": self.doubled_m2,
            "skipped_m2": self.skipped_m2,
            "untreated_m2": self.untreated_m2,
        }


def causes_of(
    flight: AppliedFlight, record: FlightRecord, strips: Sequence[Strip], steps: Sequence[Step]
) -> Causes:
    """Return where the ground that is off comes from."""
    area = dict.fromkeys(Cause, 0.0)
    inhibits: dict[str, float] = {}
    judged_m2 = 0.0
    for strip in strips:
        marks = marks_of(strip, flight.setup)
        judged_m2 += float(marks.area_m2.sum())
        off = _is_off(marks)
        own = [step for step in steps if step.change.valve == strip.track.valve]
        for cause, where in _sorted(flight, marks, off, own):
            area[cause] += float(marks.area_m2[where].sum())
            if cause is Cause.INHIBIT:
                for reason, its in by_inhibit(flight, marks, where).items():
                    inhibits[reason] = inhibits.get(reason, 0.0) + its
    ground = treated_ground(record, strips)
    area[Cause.OVERLAP] = ground.doubled_m2
    area[Cause.SKIP] += ground.between_m2
    return Causes(
        judged_m2=judged_m2 + ground.between_m2,
        off_m2=sum(area.values()),
        by_cause=area,
        by_inhibit=inhibits,
        doubled_m2=ground.doubled_m2,
        skipped_m2=ground.between_m2,
        untreated_m2=ground.untreated_m2,
    )


def _is_off(marks: Marks) -> Bools:
    """Return where the dose is beside the prescribed one; on ground of rate 0 anything is."""
    wrong = np.abs(marks.given_ml_m - marks.asked_ml_m)
    off: Bools = wrong > OFF_BY * np.where(marks.asked_ml_m > 0.0, marks.asked_ml_m, marks.usual)
    return off


def _sorted(
    flight: AppliedFlight, marks: Marks, off: Bools, steps: Sequence[Step]
) -> list[tuple[Cause, Bools]]:
    """Return where each cause is to blame; no mark has two."""
    short = marks.given_ml_m < marks.asked_ml_m
    closed = off & (marks.given_ml_m < SKIPPED_BELOW * marks.asked_ml_m)
    rules = (
        (Cause.OPERATOR, as_wished(flight, marks, OFF_BY)),
        (Cause.INHIBIT, marks.is_inhibited(flight) & short),
        (Cause.EDGE, in_edge(marks, steps) | beside_border(marks, closed)),
        (Cause.CHANGE, in_change(marks, steps)),
        (Cause.SATURATION, in_saturation(marks)),
        (Cause.ACCELERATION, in_acceleration(marks)),
        (Cause.SKIP, closed),
    )
    left, found = off.copy(), []
    for cause, where in rules:
        found.append((cause, left & where))
        left &= ~where
    found.append((Cause.UNEXPLAINED, left))
    return found
