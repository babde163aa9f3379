"""From plans to the edges that are due: which plans are taken, and what ends them.

Pure: it knows no clock and no line. A plan that is refused changes nothing: the last one goes on
until its own lease ends.
"""

from __future__ import annotations

import math

from companion.core.types import SprayPlan
from companion.output.engine.late import LateEdges
from companion.output.engine.setup import EngineSetup
from companion.output.pulse_train import Edge
from companion.output.pwm import PulseEngine

# Companion and engine read the same clock; a plan of the future means that they do not.
FUTURE_MAX_S = 0.01


class Schedule:
    """The valves' future until the lease ends, on the companion's monotonic clock."""

    def __init__(self, setup: EngineSetup, *, start_s: float) -> None:
        count, has_return = len(setup.wiring.valves), setup.wiring.has_return
        self._setup = setup
        self._count = count
        self._pulses = self._closed(start_s)
        self._late = LateEdges(
            count + has_return,
            count,
            min_on_s=setup.pwm.min_on_s,
            min_off_s=setup.pwm.min_off_s,
        )
        self._since_s = start_s
        self.sequence = -1
        self.lease_until_s = -math.inf
        self.lease_end_count = 0

    def refusal(self, plan: SprayPlan, now_s: float) -> str | None:
        """Return why a plan is not to be taken at `now_s`; None if it is."""
        for is_good, reason in (
            (len(plan.duty) == self._count, "for another number of valves"),
            (plan.sequence > self.sequence, "out of order"),
            (plan.issued_s >= self._since_s, "made before the engine started or was stopped"),
            (plan.issued_s <= now_s + FUTURE_MAX_S, "made in the future"),
            (now_s < plan.lease_until_s, "its lease is over"),
            (plan.lease_until_s <= now_s + self._setup.lease_max_s, "its lease is too long"),
        ):
            if not is_good:
                return reason
        return None

    def submit(self, plan: SprayPlan, now_s: float) -> str | None:
        """Replace the future by `plan`, or return why not."""
        refusal = self.refusal(plan, now_s)
        if refusal is None:
            self.sequence = plan.sequence
            self.lease_until_s = plan.lease_until_s
            self._pulses.submit(plan, now_s=now_s)
        return refusal

    def due(self, now_s: float) -> list[Edge]:
        """Return the edges to write now; the end of the lease is among their causes."""
        if -math.inf < self.lease_until_s <= now_s:
            self.lease_until_s = -math.inf
            self.lease_end_count += 1
        return self._late.pass_on(self._pulses.advance(now_s), now_s)

    @property
    def next_s(self) -> float:
        """Return when something is due next."""
        return min(self._pulses.next_look_s(), self._late.next_s)

    def halt(self, now_s: float) -> None:
        """Forget all plans: whoever calls has closed everything. Only plans made later count."""
        self._pulses = self._closed(now_s)
        self._late.clear(now_s)
        self._since_s = now_s
        self.lease_until_s = -math.inf

    def _closed(self, now_s: float) -> PulseEngine:
        return PulseEngine(
            self._setup.pwm,
            self._count,
            start_s=now_s,
            overrun_s=self._setup.overrun_s,
            has_return=self._setup.wiring.has_return,
        )
