"""From a plan to valve edges: periods, pulses in their middle, stagger; pure functions of time.

The twin's boards and the GPIO engine share it. It knows no clock and no pin: whoever owns those
asks for the edges up to now, or for the time of the next one.
"""

from __future__ import annotations

import math
from collections import deque
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

from companion.output.return_valve import ReturnValve

if TYPE_CHECKING:
    from companion.core.types import PwmLimits, SprayPlan, TimedChange

# ---------------------------------------------------------------------------------------- one valve

# After a restart a period is stretched or shortened by at most this fraction, until the valve
# is back in the stagger of the phases.
STRETCH_MAX = 0.02
# How much later the begin of a period may be looked at; valves come about this often.
LOOK_LATER_S = 0.001
# Times that differ by less are the same, rounded.
SAME_S = 1e-6


class Edge(NamedTuple):
    """One valve is to be open or closed from `at_s`; `duty` is the one in force.

    An edge that repeats the state of its valve tells of a new duty: an open valve that stays
    open, or one that rests in its gap and is now closed for good (`duty` 0). A tuple, because
    a flight makes tens of thousands of them.
    """

    at_s: float
    valve: int
    is_open: bool
    duty: float


def stagger(valve: int, valve_count: int) -> float:
    """Return where in the common period the period of `valve` starts, 0 to 1.

    Neighbours lie about half a period apart, so that the boom's flow ripples least.

    >>> [round(6 * stagger(valve, 6)) for valve in range(6)]
    [0, 3, 1, 4, 2, 5]
    """
    half = (valve_count + 1) // 2
    return (valve // 2 + (valve % 2) * half) / valve_count


def carried_debt(debt_s: float, period_s: float) -> float:
    """Return the on-time that a truncated period owes to the next, held to one period.

    Without the debt a restart misplaces the change by up to half an off-time; without the
    limit a debt that cannot be paid comes back long after its zone.
    """
    return min(max(debt_s, -period_s), period_s)


class PulseTrain:
    """The pulses of one valve. A period is planned when it begins and settled when it ends."""

    __slots__ = (
        "_carry_s", "_closures", "_edges", "_end_s", "_is_open", "_last_duty", "_last_s",
        "_middle_s", "_on_s", "_opened_s", "_overrun_s", "_pending", "_period_s", "_phase_s",
        "_pwm", "_start_s", "_told", "_valve", "duty", "restart_closes", "restart_s",
    )  # fmt: skip

    def __init__(self, valve: int, pwm: PwmLimits, *, phase_s: float, overrun_s: float) -> None:
        self._valve = valve
        self._pwm = pwm
        self._period_s = pwm.period_s
        self._phase_s = phase_s
        self._overrun_s = overrun_s
        # Above this the gap is too short for the valve to close.
        self._last_duty = min(pwm.duty_max, 1.0 - pwm.min_off_s / pwm.period_s)
        self.duty = 0.0
        self.restart_s = math.inf
        self.restart_closes = False
        self._pending: float | None = None
        self._start_s = self._middle_s = self._opened_s = 0.0
        self._end_s = math.inf
        self._edges: deque[tuple[float, bool]] = deque()
        self._is_open = False
        self._last_s = -math.inf
        self._told = 0.0
        self._carry_s = self._on_s = 0.0
        self._closures = 0

    @property
    def ordered(self) -> float:
        """Return the duty that is in force or will be with the next period."""
        return self.duty if self._pending is None else self._pending

    @property
    def next_times_s(self) -> tuple[float, float]:
        """Return when something happens next, and when one who is woken by a timer is to look.

        The begin of a period moves nothing while half a gap lies before its pulse; looked at a
        little later, together with another valve's edge, it costs no wake-up of its own.
        """
        if self._edges:
            next_s = self._edges[0][0]
            return next_s, next_s
        rests = not self._is_open and self._pending is None and self.duty <= self._last_duty
        return self._end_s, self._end_s + LOOK_LATER_S if rests else self._end_s

    def run(self, before_s: float, out: list[Edge]) -> None:
        """Let everything happen that is due before `before_s`."""
        while True:
            if self._edges:
                at_s, is_open = self._edges[0]
                if at_s >= before_s:
                    return
                self._edges.popleft()
                self._switch(at_s, is_open=is_open, out=out)
            elif self._end_s < before_s:
                self._next_period(out)
            else:
                return

    def order(self, at_s: float, duty: float, *, restart: bool, out: list[Edge]) -> None:
        """Take a new duty: now, or with the next period."""
        if duty == self.duty:
            self._pending = None
            if duty == 0.0:
                self._end_s = math.inf
        elif restart:
            debt_s = self._debt_at(at_s) if self.duty > 0.0 else 0.0
            young = self._is_open and self.duty < 1.0 and at_s < self._middle_s
            self._pending = None
            self.duty = duty
            # A pulse less than half done goes on into the new period, one more than half done
            # ends: so the number of closings, each of which costs the valve's overrun, is
            # right on average.
            self._begin(at_s, carried_debt(debt_s, self._period_s), keep=young, out=out)
        else:
            self._pending = duty
            if self.duty == 0.0:
                late_s = (at_s - self._phase_s) % self._period_s
                self._start_s, self._end_s = at_s, at_s + (self._period_s - late_s)

    def _switch(self, at_s: float, *, is_open: bool, out: list[Edge]) -> None:
        if is_open:
            self._opened_s = at_s
        else:
            self._on_s += at_s - self._opened_s
            self._closures += 1
        self._is_open = is_open
        self._last_s = at_s
        self._told = self.duty
        out.append(Edge(at_s, self._valve, is_open, self.duty))

    def _share(self) -> float:
        """Return the fraction of the time in which a valve at this duty delivers.

        Above the last duty it lies between that one's and 1. No single period can have it; the
        debt, which stays below half a minimum off time, has shorter and open periods take turns.
        """
        last, over = self._last_duty, self._overrun_s / self._period_s
        if last < self.duty < 1.0:
            low = min(last + over, 1.0)
            return low + (self.duty - last) / (1.0 - last) * (1.0 - low)
        return min(self.duty + over, 1.0)

    def _debt_at(self, at_s: float) -> float:
        """Return the on-time owed at `at_s`: carried over, due since, less what was delivered."""
        delivered_s = self._on_s + self._overrun_s * self._closures
        if self._is_open:
            delivered_s += at_s - self._opened_s
        return self._carry_s + self._share() * (at_s - self._start_s) - delivered_s

    def _next_period(self, out: list[Edge]) -> None:
        at_s, debt_s = self._end_s, 0.0
        if self.duty > 0.0:
            debt_s = self._debt_at(at_s)
        if self._pending is not None:
            self.duty, self._pending = self._pending, None
        self._begin(at_s, carried_debt(debt_s, self._period_s), keep=False, out=out)

    def _begin(self, at_s: float, carry_s: float, *, keep: bool, out: list[Edge]) -> None:
        """Begin a period at `at_s` and plan its pulse; a duty of 0 ends the train at once."""
        self._edges.clear()
        self._start_s, self._on_s, self._closures = at_s, 0.0, 0
        self._opened_s = at_s
        if self.duty == 0.0:
            self._carry_s, self._end_s = 0.0, math.inf
            self._switch(at_s, is_open=False, out=out)
            return
        length_s = self._length_s(at_s)
        self._end_s = at_s + length_s
        # A valve that is to stay open can never pay what it owes.
        self._carry_s = carry_s if self.duty < 1.0 else min(carry_s, 0.0)
        wanted_s = self._share() * length_s + self._carry_s
        if wanted_s < length_s:
            wanted_s -= self._overrun_s
        on_s = self._reachable_s(wanted_s, length_s)
        if self._is_open:
            self._plan_from_open(at_s, on_s, length_s, keep=keep, out=out)
        else:
            opens_s = max(at_s + self._wait_s(on_s, length_s), self._last_s + self._pwm.min_off_s)
            self._plan_pulse(opens_s, opens_s + on_s)

    def _plan_from_open(
        self, at_s: float, on_s: float, length_s: float, *, keep: bool, out: list[Edge]
    ) -> None:
        free_s = max(at_s, self._last_s + self._pwm.min_on_s)
        opens_s = at_s + self._wait_s(on_s, length_s)
        if on_s > 0.0 and (keep or opens_s - free_s < self._pwm.min_off_s):
            closes_s = max(at_s + on_s, free_s)
            self._middle_s = 0.5 * (at_s + closes_s)
            if closes_s < self._end_s:
                self._edges.append((closes_s, False))
            if self._told != self.duty:
                self._told = self.duty
                out.append(Edge(at_s, self._valve, True, self.duty))
            return
        self._edges.append((free_s, False))
        self._plan_pulse(opens_s, opens_s + on_s - (free_s - at_s))

    def _plan_pulse(self, opens_s: float, closes_s: float) -> None:
        closes_s = min(closes_s, self._end_s)
        self._middle_s = 0.5 * (opens_s + closes_s)
        if closes_s - opens_s <= 0.0 or closes_s - opens_s < self._pwm.min_on_s - 1e-9:
            return
        self._edges.append((opens_s, True))
        if closes_s < self._end_s:
            self._edges.append((closes_s, False))

    def _length_s(self, at_s: float) -> float:
        """Return the length of the period that begins at `at_s`.

        One that ends at the next restart, or that leads back to the stagger.
        """
        period_s = self._period_s
        left_s = self.restart_s - at_s
        if 0.5 * period_s <= left_s < 2.5 * period_s:
            # Whole periods up to a restart that is already planned: nothing is truncated, so
            # that closing, which can pay no debt, comes after a full measure.
            return left_s if left_s < 1.5 * period_s else 0.5 * left_s
        late_s = (at_s - self._phase_s + 0.5 * period_s) % period_s - 0.5 * period_s
        most_s = STRETCH_MAX * period_s
        length_s = period_s - min(max(late_s, -most_s), most_s)
        duty = self.duty
        if length_s < period_s and duty < 1.0:
            # Not so short that pulse or gap fall below what the valve can follow.
            need_s = max(self._pwm.min_off_s / (1.0 - duty), self._pwm.min_on_s / duty)
            length_s = max(length_s, min(need_s, period_s))
        return length_s

    def _wait_s(self, on_s: float, length_s: float) -> float:
        """Return how long after its period's begin a pulse begins: it stands in the middle.

        Above the last duty it begins at once: between open periods half a gap would close nothing.
        The last pulse before a closing that is planned already ends with it: the same volume, and
        no half gap of dry ground ahead of a border.
        """
        if self.restart_closes and abs(self._end_s - self.restart_s) < SAME_S:
            return length_s - on_s
        if self.duty > self._last_duty:
            return 0.0
        return 0.5 * (length_s - on_s)

    def _reachable_s(self, wanted_s: float, length_s: float) -> float:
        """Return the nearest on-time that the valve can follow; the rest becomes debt."""
        on_s, off_s = self._pwm.min_on_s, self._pwm.min_off_s
        if self.duty > self._last_duty:
            # Nothing between the last duty and open: what is near to either becomes debt.
            off_s = (1.0 - self._last_duty) * length_s
            gap_s = length_s - wanted_s
            if gap_s < 1.5 * off_s:
                return length_s if gap_s < 0.5 * off_s else length_s - off_s
        if wanted_s < on_s or wanted_s <= 0.0:
            return on_s if wanted_s > 0.5 * on_s else 0.0
        gap_s = length_s - wanted_s
        if gap_s < off_s * (1.0 - 1e-9) or gap_s <= 0.0:
            return length_s - off_s if gap_s >= 0.5 * off_s and gap_s > 0.0 else length_s
        return wanted_s


# --------------------------------------------------------------------------------------- all valves

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
