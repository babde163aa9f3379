"""What lies between a plan and the plant in a simulated flight: the output path, board included.

The board of docs/reference/driver-board.md: widths here (rules 9 to 11), its pulses below.

`servo` is a pulse width on an autopilot's output, delayed by its frame and turned into pulses by a
driver board; in averaged fidelity a change of duty acts as it is. (`gpio` is the product's own
pulse engine, and stands in `flight.py`.) All of them keep the changes that were carried out.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from companion.core.types import TimedChange
from sitl.plant import BoardEdge

if TYPE_CHECKING:
    from collections.abc import Iterable

    from companion.core.types import SprayPlan
    from sitl.plant import Edge
    from sitl.profile import PlantProfile, Pulsing

# ----------------------------------------------------------------------------------- the servo path

# A servo output repeats its pulse at 50 Hz: an order waits for the next frame.
SERVO_FRAME_S = 0.020
# Narrower than this is not a valid servo pulse. After this long without one the board closes.
PULSE_MIN_US = 900.0
PULSE_ABSENT_S = 0.100
# With the alive check an open valve closes when its width has not moved for this long.
STANDSTILL_S = 0.300
# A width this near to closed is closed: the board must not pulse on a timer's jitter.
CLOSED_DUTY = 0.01

# Widths are never negative; these stand for a look at the clock.
_LOOK_ABSENT = -1.0
_LOOK_STANDSTILL = -2.0


class DriverBoard:
    """The servo outputs and the board behind them that makes valve pulses of servo pulses.

    `restarting` boards begin a new period when the width moves by 2 % of its span or to or from
    closed, and carry the debt of the old one; `free-running` boards never do: every change waits
    for the next period. Before the first order there are no pulses, and all valves are closed.

    With `dither_us` above 0 the board checks that an open valve's order is alive: a width that has
    moved by less than half of that for `STANDSTILL_S` closes the valve until it moves again. Half,
    so that a capture's jitter of a microsecond neither feigns life nor hides it.
    """

    def __init__(
        self,
        pwm: Pulsing,
        valve_count: int,
        *,
        seed: int,
        start_s: float,
        kind: Literal["restarting", "free-running"] = "restarting",
        closed_us: float = 1000.0,
        full_us: float = 2000.0,
        frame_s: float = SERVO_FRAME_S,
        overrun_s: float = 0.0,
        dither_us: float = 0.0,
    ) -> None:
        if not 0.0 <= dither_us <= 50.0:
            raise ValueError(f"dither_us must lie in [0, 50], got {dither_us}")
        if not closed_us < full_us:
            raise ValueError(f"closed_us must be below full_us, got {closed_us}, {full_us}")
        if not (valve_count > 0 and math.isfinite(start_s)):
            raise ValueError(f"no board for {valve_count} valves from {start_s} s")
        if not 0.0 <= overrun_s <= pwm.min_off_s:
            raise ValueError(f"overrun_s must lie in [0, min_off_s], got {overrun_s}")
        self._pulses = tuple(
            ValvePulses(
                valve,
                pwm,
                phase_s=start_s + phase_of(valve, valve_count) * pwm.period_s,
                overrun_s=overrun_s,
            )
            for valve in range(valve_count)
        )
        self._made: list[BoardEdge] = []
        self._restarts = kind == "restarting"
        self._closed_us, self._span_us = closed_us, full_us - closed_us
        self._frame_s = frame_s
        self._rng = np.random.default_rng(seed)
        self._alive_us = 0.5 * dither_us
        # (time, order of arrival, valve, width or look).
        self._due: list[tuple[float, int, int, float]] = []
        self._count = 0
        self._last_s = [-math.inf] * valve_count
        self._width_us = [0.0] * valve_count
        self._absent_since_s = [-math.inf] * valve_count
        # Where and when the width last moved far enough to be a sign of life.
        self._moved_us = [-math.inf] * valve_count
        self._moved_s = [-math.inf] * valve_count

    @property
    def width_us(self) -> tuple[float, ...]:
        """Return the pulse width at each input of the board; 0 is no pulse."""
        return tuple(self._width_us)

    @property
    def duty(self) -> tuple[float, ...]:
        """Return the duty of each valve that is in force or will be with its next period."""
        return tuple(pulses.ordered for pulses in self._pulses)

    def order(self, at_s: float, valve: int, pulse_us: float) -> None:
        """Take an order of the autopilot; it shows at the board with the next servo frame."""
        if not (math.isfinite(at_s) and 0.0 <= pulse_us <= 65535.0):
            raise ValueError(f"no pulse width and time: {pulse_us} us at {at_s} s")
        arrives_s = at_s + float(self._rng.uniform(0.0, self._frame_s))
        self._last_s[valve] = arrives_s = max(arrives_s, self._last_s[valve])
        self._push(arrives_s, valve, pulse_us)

    def _push(self, at_s: float, valve: int, pulse_us: float) -> None:
        self._count += 1
        heapq.heappush(self._due, (at_s, self._count, valve, pulse_us))

    def advance(self, until_s: float) -> list[BoardEdge]:
        """Return the edges at the valves since the last call up to `until_s`."""
        while self._due and self._due[0][0] <= until_s:
            at_s, _, valve, pulse_us = heapq.heappop(self._due)
            if pulse_us == _LOOK_ABSENT:
                self._look_absent(at_s, valve)
            elif pulse_us == _LOOK_STANDSTILL:
                self._look_standstill(at_s, valve)
            else:
                self._see(at_s, valve, pulse_us)
        for pulses in self._pulses:
            pulses.advance(until_s, self._made)
        made, self._made = self._made, []
        made.sort(key=lambda edge: edge.at_s)
        return made

    def _see(self, at_s: float, valve: int, pulse_us: float) -> None:
        was_valid = self._width_us[valve] >= PULSE_MIN_US
        self._width_us[valve] = pulse_us
        if pulse_us >= PULSE_MIN_US:
            if self._is_alive(at_s, valve, pulse_us):
                self._take(at_s, valve, self._duty(pulse_us))
        elif was_valid:
            self._absent_since_s[valve] = at_s
            self._push(at_s + PULSE_ABSENT_S, valve, _LOOK_ABSENT)

    def _duty(self, pulse_us: float) -> float:
        duty = min(max((pulse_us - self._closed_us) / self._span_us, 0.0), 1.0)
        return duty if duty >= CLOSED_DUTY else 0.0

    def _is_alive(self, at_s: float, valve: int, pulse_us: float) -> bool:
        """Return whether a width may act: it moved, or moved lately, or closes."""
        if not self._alive_us:
            return True
        if abs(pulse_us - self._moved_us[valve]) >= self._alive_us:
            self._moved_us[valve], self._moved_s[valve] = pulse_us, at_s
            self._push(at_s + STANDSTILL_S, valve, _LOOK_STANDSTILL)
            return True
        return self._duty(pulse_us) == 0.0 or not self._stands_still(at_s, valve)

    def _stands_still(self, at_s: float, valve: int) -> bool:
        return not at_s - self._moved_s[valve] < STANDSTILL_S - 1e-9

    def _look_standstill(self, at_s: float, valve: int) -> None:
        if self._stands_still(at_s, valve):
            self._take(at_s, valve, 0.0)

    def _look_absent(self, at_s: float, valve: int) -> None:
        absent = self._width_us[valve] < PULSE_MIN_US
        if absent and at_s - self._absent_since_s[valve] >= PULSE_ABSENT_S - 1e-9:
            self._take(at_s, valve, 0.0)

    def _take(self, at_s: float, valve: int, duty: float) -> None:
        pulses = self._pulses[valve]
        pulses.advance(at_s, self._made)
        old = pulses.ordered
        if duty != old:
            is_new = self._restarts and is_change(old, duty)
            pulses.order(at_s, duty, is_new_period=is_new, out=self._made)


# The pulses of one valve as a driver board makes them: rules 1 to 8 of
# docs/reference/driver-board.md.
#
# Written from that page and from nothing else, so that a board in the twin can be wrong, or right,
# on its own. An account of on-time is kept: what a valve was due so far, less what it delivered.

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


# ---------------------------------------------------------------------------------- any output path

# An order is on its way to the autopilot this long: 44 bytes over a telemetry port.
WIRE_S = 0.002


class TakesDuties(Protocol):
    """A plant that is fed with changes of duty."""

    profile: PlantProfile

    def record_change(self, at_s: float, valve: int, duty: float) -> None:
        """Take down that `valve` has `duty` from `at_s` on."""


class TakesEdges(Protocol):
    """A plant that is fed with edges."""

    profile: PlantProfile

    def record(self, edges: Iterable[Edge]) -> None:
        """Take down edges."""


class Output(Protocol):
    """Takes plans, drives the plant, keeps what was carried out."""

    @property
    def orders(self) -> list[TimedChange]:
        """Return the changes of duty carried out so far, in order of time."""

    def submit(self, plan: SprayPlan, *, now_s: float) -> None:
        """Carry out what was due before `now_s`, then replace the future."""

    def finish(self, end_s: float) -> None:
        """Carry out all until `end_s`; the lease closes what is left open."""


@dataclass(slots=True)
class PlanFollower:
    """The changes of plans, each at its time, until the lease ends: what every executor does."""

    valve_count: int
    orders: list[TimedChange] = field(default_factory=list)
    duty: list[float] = field(init=False)
    _changes: tuple[TimedChange, ...] = ()
    _done: int = 0
    _lease_until_s: float = math.inf

    def __post_init__(self) -> None:
        self.duty = [0.0] * self.valve_count

    def submit(self, plan: SprayPlan, *, now_s: float) -> list[TimedChange]:
        """Return the changes that happened before `now_s`, and take the new plan."""
        done = self.advance(now_s)
        for valve, duty in enumerate(plan.duty):
            if duty != self.duty[valve]:
                done.append(self._take(TimedChange(at_s=now_s, valve=valve, duty=duty)))
        self._changes, self._done, self._lease_until_s = plan.changes, 0, plan.lease_until_s
        return done + self.advance(now_s)

    def advance(self, until_s: float) -> list[TimedChange]:
        """Return the changes up to `until_s` that were not returned yet."""
        changes, lease_until_s, i = self._changes, self._lease_until_s, self._done
        done = []
        while i < len(changes):
            change = changes[i]
            if change.at_s > until_s or change.at_s >= lease_until_s:
                break
            i += 1
            if change.duty != self.duty[change.valve]:
                done.append(self._take(change))
        self._done = i
        if lease_until_s <= until_s:
            self._changes, self._done, self._lease_until_s = (), 0, math.inf
            done += [
                self._take(TimedChange(at_s=lease_until_s, valve=valve, duty=0.0))
                for valve, duty in enumerate(self.duty)
                if duty != 0.0
            ]
        return done

    def _take(self, change: TimedChange) -> TimedChange:
        self.duty[change.valve] = change.duty
        self.orders.append(change)
        return change


class AveragedOutput:
    """Duties act as they are, after the mean delay of the output path."""

    def __init__(self, plant: TakesDuties, *, delay_s: float = 0.0) -> None:
        self._plant = plant
        self._delay_s = delay_s
        self._follower = PlanFollower(plant.profile.valve_count)

    @property
    def orders(self) -> list[TimedChange]:
        """Return the changes carried out so far."""
        return self._follower.orders

    def submit(self, plan: SprayPlan, *, now_s: float) -> None:
        """Carry out what was due, then replace the future."""
        self._act(self._follower.submit(plan, now_s=now_s))

    def finish(self, end_s: float) -> None:
        """Carry out all until `end_s`."""
        self._act(self._follower.advance(end_s))

    def _act(self, changes: list[TimedChange]) -> None:
        for change in changes:
            self._plant.record_change(change.at_s + self._delay_s, change.valve, change.duty)


class ServoOutput:
    """Orders of pulse widths to the autopilot, its servo frame, and a driver board."""

    def __init__(
        self,
        plant: TakesEdges,
        board: DriverBoard,
        *,
        wire_s: float = WIRE_S,
        closed_us: float = 1000.0,
        full_us: float = 2000.0,
    ) -> None:
        self._plant = plant
        self._board = board
        self._wire_s = wire_s
        self._closed_us, self._span_us = closed_us, full_us - closed_us
        self._follower = PlanFollower(plant.profile.valve_count)

    @property
    def orders(self) -> list[TimedChange]:
        """Return the changes carried out so far."""
        return self._follower.orders

    def submit(self, plan: SprayPlan, *, now_s: float) -> None:
        """Carry out what was due, then replace the future."""
        self._order(self._follower.submit(plan, now_s=now_s))
        self._plant.record(self._board.advance(now_s))

    def finish(self, end_s: float) -> None:
        """Carry out all until `end_s`."""
        self._order(self._follower.advance(end_s))
        self._plant.record(self._board.advance(end_s))

    def _order(self, changes: list[TimedChange]) -> None:
        for change in changes:
            # Whole microseconds go over the wire, a few milliseconds after the planned time.
            pulse_us = round(self._closed_us + change.duty * self._span_us)
            self._board.order(change.at_s + self._wire_s, change.valve, pulse_us)
