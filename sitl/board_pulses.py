"""The pulses of one valve as a driver board makes them: rules 1 to 8 of docs/driver-board.md.

Written from that page and from nothing else, so that a board in the twin can be wrong, or right,
on its own. An account of on-time is kept: what a valve was due so far, less what it delivered.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from sitl.edges import BoardEdge

if TYPE_CHECKING:
    from sitl.profile import Pulsing

# Rule 6: a period is this much longer or shorter, at most, until its valve is in its phase.
BACK_TO_PHASE = 0.02
# Rule 3: a move by this share of the span, or to or from closed, begins a new period.
CHANGE = 0.02
SAME = 1e-9


def phase_of(valve: int, count: int) -> float:
    """Return rule 2: the place of a valve's periods in the common one, 0 to 1.

    >>> [round(4 * phase_of(valve, 4)) for valve in range(4)]
    [0, 2, 1, 3]
    """
    row, is_second = divmod(valve, 2)
    return (row + (math.ceil(count / 2) if is_second else 0)) / count


def is_change(old: float, new: float) -> bool:
    """Return whether a move of the duty is a change (rule 3) and no trim (rule 5)."""
    return (old > 0.0) != (new > 0.0) or abs(new - old) >= CHANGE


class ValvePulses:
    """Makes the edges of one valve; time only goes on."""

    def __init__(self, valve: int, pwm: Pulsing, *, phase_s: float, overrun_s: float) -> None:
        self._valve, self._pwm, self._period_s = valve, pwm, pwm.period_s
        self._phase_s, self._overrun_s = phase_s, overrun_s
        # The last duty that leaves a gap.
        self._last = min(pwm.duty_max, 1.0 - pwm.min_off_s / pwm.period_s)
        self.duty = 0.0
        self._trim: float | None = None
        self._is_open, self._since_s, self._said = False, -math.inf, 0.0
        self._plan: list[tuple[float, bool]] = []
        self._begin_s = self._pulse_half_s = 0.0
        self._end_s = math.inf
        # The account of the period: as it was at its begin, and delivered since then.
        self._owed_s = self._delivered_s = 0.0
        self._counts_from_s = 0.0

    @property
    def ordered(self) -> float:
        """Return the duty in force, or the one that the next period will have."""
        return self.duty if self._trim is None else self._trim

    @property
    def next_s(self) -> float:
        """Return when something happens without a new order."""
        return self._plan[0][0] if self._plan else self._end_s

    def advance(self, until_s: float, out: list[BoardEdge]) -> None:
        """Do what is due up to and with `until_s`."""
        while self.next_s <= until_s:
            if self._plan:
                at_s, is_open = self._plan.pop(0)
                self._move(at_s, is_open, out)
            else:
                self._next_period(out)

    def order(self, at_s: float, duty: float, *, is_new_period: bool, out: list[BoardEdge]) -> None:
        """Take a duty: with a period of its own now, or with the next one."""
        if duty == self.duty:
            self._trim = None
        elif not is_new_period:
            self._trim = duty
            if self.duty == 0.0:
                # Nothing runs: the next period of its phase is the first.
                self._end_s = at_s + self._period_s - (at_s - self._phase_s) % self._period_s
            return
        else:
            owed_s = self._held(self._balance_s(at_s)) if self.duty > 0.0 else 0.0
            # Its second half of a pulse ends with the old period, its first half goes on.
            is_young = self._is_open and self.duty < 1.0 and at_s < self._pulse_half_s
            self.duty, self._trim = duty, None
            self._start_period(at_s, owed_s, goes_on=is_young, out=out)
            return
        if duty == 0.0:
            self._end_s = math.inf

    def _move(self, at_s: float, is_open: bool, out: list[BoardEdge]) -> None:
        if self._is_open and not is_open:
            self._delivered_s += at_s - self._counts_from_s + self._overrun_s
        self._counts_from_s = self._since_s = at_s
        self._is_open, self._said = is_open, self.duty
        out.append(BoardEdge(at_s, self._valve, is_open, self.duty))

    def _due_share(self) -> float:
        """Return the share of the time in which the valve is to deliver (rules 7 and 8)."""
        extra = self._overrun_s / self._period_s
        if not self._last < self.duty < 1.0:
            return min(self.duty + extra, 1.0)
        at_last = min(self._last + extra, 1.0)
        return at_last + (1.0 - at_last) * (self.duty - self._last) / (1.0 - self._last)

    def _balance_s(self, at_s: float) -> float:
        """Return rule 4: the on-time that the valve is owed at a time."""
        running_s = at_s - self._counts_from_s if self._is_open else 0.0
        due_s = self._due_share() * (at_s - self._begin_s)
        return self._owed_s + due_s - self._delivered_s - running_s

    def _held(self, owed_s: float) -> float:
        return math.copysign(min(abs(owed_s), self._period_s), owed_s)

    def _next_period(self, out: list[BoardEdge]) -> None:
        at_s = self._end_s
        owed_s = self._held(self._balance_s(at_s)) if self.duty > 0.0 else 0.0
        if self._trim is not None:
            self.duty, self._trim = self._trim, None
        self._start_period(at_s, owed_s, goes_on=False, out=out)

    def _start_period(
        self, at_s: float, owed_s: float, *, goes_on: bool, out: list[BoardEdge]
    ) -> None:
        self._plan = []
        if self.duty == 0.0:
            self._end_s, self._owed_s = math.inf, 0.0
            self._move(at_s, False, out)
            return
        self._begin_s = self._counts_from_s = at_s
        self._delivered_s = 0.0
        length_s = self._length_s(at_s)
        self._end_s = at_s + length_s
        # Fully open nothing can be paid back that is owed.
        self._owed_s = owed_s if self.duty < 1.0 else min(owed_s, 0.0)
        on_s = self._on_time_s(length_s)
        lead_s = 0.0 if self.duty > self._last else 0.5 * (length_s - on_s)
        if self._is_open:
            self._from_open(at_s, lead_s, on_s, goes_on=goes_on, out=out)
        else:
            opens_s = max(at_s + lead_s, self._since_s + self._pwm.min_off_s)
            self._pulse(opens_s, opens_s + on_s)

    def _length_s(self, at_s: float) -> float:
        whole_s = self._period_s
        # How far behind its phase the period begins, half a period either way.
        behind_s = math.remainder(at_s - self._phase_s, whole_s)
        length_s = whole_s - max(-BACK_TO_PHASE * whole_s, min(behind_s, BACK_TO_PHASE * whole_s))
        if length_s < whole_s and self.duty < 1.0:
            for share, least_s in (
                (self.duty, self._pwm.min_on_s),
                (1.0 - self.duty, self._pwm.min_off_s),
            ):
                length_s = max(length_s, min(least_s / share, whole_s))
        return length_s

    def _on_time_s(self, length_s: float) -> float:
        """Return the on-time of a period as far as the valve can follow (rule 7)."""
        due_s = self._due_share() * length_s + self._owed_s
        if due_s < length_s:
            due_s -= self._overrun_s
        gap_s, least_gap_s = length_s - due_s, self._pwm.min_off_s
        if self.duty > self._last:
            # The gap of the last duty, or none: whichever is nearer.
            least_gap_s = (1.0 - self._last) * length_s
            if gap_s < 1.5 * least_gap_s:
                return length_s - (least_gap_s if gap_s >= 0.5 * least_gap_s else 0.0)
        if due_s <= 0.0 or due_s < self._pwm.min_on_s:
            return self._pwm.min_on_s if due_s > 0.5 * self._pwm.min_on_s else 0.0
        if gap_s <= 0.0 or gap_s < least_gap_s * (1.0 - SAME):
            return length_s - (least_gap_s if gap_s >= 0.5 * least_gap_s > 0.0 else 0.0)
        return due_s

    def _from_open(
        self, at_s: float, lead_s: float, on_s: float, *, goes_on: bool, out: list[BoardEdge]
    ) -> None:
        may_close_s = max(at_s, self._since_s + self._pwm.min_on_s)
        gap_s = at_s + lead_s - may_close_s
        if on_s > 0.0 and (goes_on or gap_s < self._pwm.min_off_s):
            closes_s = max(at_s + on_s, may_close_s)
            self._pulse_half_s = 0.5 * (at_s + closes_s)
            self._plan = [(closes_s, False)] if closes_s < self._end_s else []
            if self._said != self.duty:
                self._said = self.duty
                out.append(BoardEdge(at_s, self._valve, True, self.duty))
            return
        self._pulse(at_s + lead_s, at_s + lead_s + on_s - (may_close_s - at_s))
        self._plan.insert(0, (may_close_s, False))

    def _pulse(self, opens_s: float, closes_s: float) -> None:
        closes_s = min(closes_s, self._end_s)
        self._pulse_half_s = 0.5 * (opens_s + closes_s)
        if closes_s - opens_s > 0.0 and closes_s - opens_s >= self._pwm.min_on_s - SAME:
            self._plan = [(opens_s, True)]
            if closes_s < self._end_s:
                self._plan.append((closes_s, False))
