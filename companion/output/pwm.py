"""From a plan to valve edges: the pulse trains of all valves, as a pure function of time.

The twin's boards and the GPIO engine share it. It knows no clock and no pin: whoever owns those
asks for the edges up to now, or for the time of the next one.
"""

from __future__ import annotations

import math
from collections import deque
from operator import attrgetter
from typing import TYPE_CHECKING

from companion.output.pulse_train import Edge, PulseTrain, stagger
from companion.output.return_valve import ReturnValve

if TYPE_CHECKING:
    from companion.core.types import PwmLimits, SprayPlan, TimedChange

__all__ = ["Edge", "PulseEngine", "needs_restart", "stagger"]


# A duty that moves by at least this much, or to or from closed, restarts the period when it
# comes without a flag of its own (the `duty` of a plan, the pulse width on a driver board).
RESTART_DUTY = 0.02
_AT = attrgetter("at_s")


def needs_restart(old: float, new: float) -> bool:
    """Return whether a change of duty without a flag of its own restarts the period."""
    return (old == 0.0) != (new == 0.0) or abs(new - old) >= RESTART_DUTY


class PulseEngine:
    """Carries plans out: every edge of every valve up to a time, in order of time.

    Each pulse stands in the middle of its period. A change that restarts begins a new period and
    takes the truncated one's debt of on-time with it; a trim waits for the next period. When the
    lease ends, everything closes. `overrun_s` is how much longer a valve delivers than its pulse
    lasts (the intercept of its flow curve), where it is known. With a return valve its edges are
    those of the valve behind the last.
    """

    def __init__(
        self,
        pwm: PwmLimits,
        valve_count: int,
        *,
        start_s: float,
        overrun_s: float = 0.0,
        has_return: bool = False,
    ) -> None:
        if not (valve_count > 0 and math.isfinite(start_s)):
            raise ValueError(f"{valve_count} valves from {start_s} s make no pulse trains")
        if not 0.0 <= overrun_s <= pwm.min_off_s:
            raise ValueError(f"overrun_s must lie in [0, min_off_s], got {overrun_s}")
        self._trains = tuple(
            PulseTrain(
                valve,
                pwm,
                phase_s=start_s + stagger(valve, valve_count) * pwm.period_s,
                overrun_s=overrun_s,
            )
            for valve in range(valve_count)
        )
        # When something happens next in each train: looked at far more often than it changes.
        self._next_s = [math.inf] * valve_count
        self._look_s = [math.inf] * valve_count
        self._now_s = start_s
        self._sequence = -1
        self._lease_s = math.inf
        self._changes: deque[TimedChange] = deque()
        self._out: list[Edge] = []
        self._return = ReturnValve() if has_return else None

    @property
    def duty(self) -> tuple[float, ...]:
        """Return the duty of each valve that is in force or will be with its next period."""
        return tuple(train.ordered for train in self._trains)

    def submit(self, plan: SprayPlan, *, now_s: float) -> bool:
        """Replace the future by `plan`; False for one that is not newer than the last."""
        if len(plan.duty) != len(self._trains):
            raise ValueError(f"plan for {len(plan.duty)} valves, have {len(self._trains)}")
        if not plan.sequence > self._sequence:
            return False
        self._run(now_s)
        if self._return is not None:
            # Before the valves: what closes without notice has its way out first.
            self._tell_return(self._return.submit(plan, self._now_s))
        self._sequence = plan.sequence
        self._changes = deque(plan.changes)
        self._lease_s = plan.lease_until_s
        if not self._now_s < plan.lease_until_s:
            self._close_all(self._now_s)
            return True
        wanted = self._wanted_now(plan)
        for train in self._trains:
            train.restart_s = math.inf
        for change in reversed(self._changes):
            if change.restart:
                self._trains[change.valve].restart_s = change.at_s
                self._trains[change.valve].restart_closes = change.duty == 0.0
        for valve, duty in enumerate(wanted):
            ordered = self._trains[valve].ordered
            if duty != ordered:
                self._order(valve, duty, at_s=self._now_s, restart=needs_restart(ordered, duty))
        return True

    def _wanted_now(self, plan: SprayPlan) -> list[float]:
        """Return the duties that a plan has for now, and leave its changes still to come.

        It may have taken its time: to order the duties of its issue first would undo, for one
        minimum time, what the plan before has done already.
        """
        wanted = list(plan.duty)
        while self._changes and self._changes[0].at_s < self._now_s:
            change = self._changes.popleft()
            wanted[change.valve] = change.duty
        return wanted

    def order(self, valve: int, duty: float, *, at_s: float, restart: bool) -> None:
        """Change one valve at `at_s` without a plan and its lease: for a driver board."""
        if not 0.0 <= duty <= 1.0:
            raise ValueError(f"duty outside [0, 1]: {duty}")
        self._run(at_s)
        self._order(valve, duty, at_s=self._now_s, restart=restart)

    def advance(self, until_s: float) -> list[Edge]:
        """Return the edges since the last call up to and with `until_s`."""
        self._run(until_s)
        out, self._out = self._out, []
        out.sort(key=_AT)
        return out

    def next_event_s(self) -> float:
        """Return when something happens next: an edge, a period, a change, the lease's end."""
        return self._first_of(self._next_s)

    def next_look_s(self) -> float:
        """Return when a timer is to wake next: like `next_event_s`, a period's begin 1 ms later."""
        return self._first_of(self._look_s)

    def _first_of(self, times_s: list[float]) -> float:
        if self._out:
            return self._now_s
        first_s = min(times_s)
        if self._changes:
            first_s = min(first_s, self._changes[0].at_s)
        if self._return is not None:
            return_s = self._return.next_s
            if return_s is not None:
                first_s = min(first_s, return_s)
        return min(first_s, self._lease_s)

    def _run(self, until_s: float) -> None:
        if not math.isfinite(until_s):
            raise ValueError(f"time is not finite: {until_s}")
        until_s = max(until_s, self._now_s)
        changes = self._changes
        while changes and changes[0].at_s <= until_s and changes[0].at_s < self._lease_s:
            change = changes.popleft()
            at_s = max(change.at_s, self._now_s)
            if change.restart:
                train = self._trains[change.valve]
                train.run(at_s, self._out)
                self._plan_restart(train, change.valve)
                self._note_next(change.valve)
            self._order(change.valve, change.duty, at_s=at_s, restart=change.restart)
        if self._lease_s <= until_s:
            self._close_all(max(self._lease_s, self._now_s))
        if self._return is not None:
            self._tell_return(self._return.run(until_s))
        if min(self._next_s) <= until_s:
            after_s = math.nextafter(until_s, math.inf)
            for valve, next_s in enumerate(self._next_s):
                if next_s <= until_s:
                    self._trains[valve].run(after_s, self._out)
                    self._note_next(valve)
        self._now_s = until_s

    def _tell_return(self, moves: list[tuple[float, bool]]) -> None:
        count = len(self._trains)
        for at_s, is_open in moves:
            self._out.append(Edge(at_s, count, is_open, 1.0 if is_open else 0.0))

    def _plan_restart(self, train: PulseTrain, valve: int) -> None:
        """Tell a train of its next restart."""
        train.restart_s = math.inf
        for change in self._changes:
            if change.valve == valve and change.restart:
                train.restart_s, train.restart_closes = change.at_s, change.duty == 0.0
                return

    def _order(self, valve: int, duty: float, *, at_s: float, restart: bool) -> None:
        train = self._trains[valve]
        train.run(at_s, self._out)
        train.order(at_s, duty, restart=restart, out=self._out)
        self._note_next(valve)

    def _note_next(self, valve: int) -> None:
        self._next_s[valve], self._look_s[valve] = self._trains[valve].next_times_s

    def _close_all(self, at_s: float) -> None:
        self._lease_s = math.inf
        self._changes.clear()
        for train in self._trains:
            train.restart_s = math.inf
        for valve in range(len(self._trains)):
            self._order(valve, 0.0, at_s=at_s, restart=True)
