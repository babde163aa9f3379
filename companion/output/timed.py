"""What all executors have in common: which duty a plan has when, and a timer that keeps to it.

The plan itself says when everything closes, so an executor that hears nothing more closes by
itself at the end of the lease.
"""

from __future__ import annotations

import asyncio
import logging
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import chain

from companion.core.types import SprayPlan
from companion.output.return_valve import ReturnValve

# What is told of an order: valve, duty, when a plan wanted it (None: a fault did), when it left.
OnOrder = Callable[[int, float, float | None, float], None]

# Clocks that disagree by less than this agree: a timer may wake early by the loop's resolution.
_EARLY_S = 1e-6
_KEPT = 4096
_logger = logging.getLogger(__name__)


def fractions_at(plan: SprayPlan, now_s: float, count: int) -> tuple[float, ...]:
    """Return what each of `count` drives is to have at `now_s`: all stopped after the lease.

    A plan that says nothing of drives has them stopped.
    """
    if not now_s < plan.lease_until_s or not plan.drives:
        return (0.0,) * count
    return tuple(drive.at(now_s) for drive in plan.drives)


def next_event_s(plan: SprayPlan, now_s: float) -> float | None:
    """Return when the plan next asks for something, the end of its lease included."""
    if not now_s < plan.lease_until_s:
        return None
    ahead = (change.at_s for change in plan.changes if change.at_s > now_s)
    drives = (each.at_s for drive in plan.drives for each in drive.changes if each.at_s > now_s)
    return min(chain(ahead, drives, (plan.lease_until_s,)))


@dataclass(slots=True)
class Lateness:
    """How much later than planned orders were given: the last few thousand, and all in sum."""

    count: int = 0
    worst_s: float = 0.0
    recent_s: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))

    def add(self, late_s: float) -> None:
        """Take one order's lateness."""
        self.count += 1
        self.worst_s = max(self.worst_s, late_s)
        self.recent_s.append(late_s)

    def quantile_s(self, fraction: float) -> float | None:
        """Return the lateness that this fraction of the recent orders does not exceed."""
        if not self.recent_s:
            return None
        ranked = sorted(self.recent_s)
        return ranked[min(len(ranked) - 1, int(fraction * len(ranked)))]


class TimedExecutor:
    """Follows the newest plan by one timer of the event loop; its clock is `time.monotonic`.

    `on_order`, if set, is told of every order that gives a valve another duty, for the record.

    With a return valve there is one output more than there are valves: 1 is open, 0 shut. Drives
    come behind that; a plan's drives are nothing to an executor that has none.
    """

    def __init__(self, valve_count: int, *, has_return: bool = False, drive_count: int = 0) -> None:
        self._count = valve_count
        self._first_drive = valve_count + has_return
        self._drive_count = drive_count
        self._return = ReturnValve() if has_return else None
        self._plan: SprayPlan | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._is_running = False
        self._sequence: int | None = None
        self.on_order: OnOrder | None = None
        self.lateness = Lateness()
        self.lease_end_count = 0
        self.rejected_count = 0

    @property
    def fault(self) -> str | None:
        """Why the outputs cannot be trusted; None while all is well."""
        return None

    @property
    def is_guarded(self) -> bool:
        """Whether something closes when this computer fails."""
        return True

    @property
    def valve_count(self) -> int:
        """Return how many valves it has; 0 where it only drives motors."""
        return self._count

    async def start(self) -> None:
        """Take the outputs and order all of them closed."""
        self._is_running = True
        self._close_all()
        self._arm(asyncio.get_running_loop().time())

    def submit(self, plan: SprayPlan) -> None:
        """Replace what has not happened yet.

        A plan that is older than the last one or whose lease is over is refused whole and counted:
        the last one goes on until its own lease ends. One that only closes is always taken.

        Raises:
            ValueError: a plan for other outputs, which is a mistake of the program.
        """
        if not self._is_running:
            return
        if len(plan.duty) != self._count:
            raise ValueError(f"plan for {len(plan.duty)} valves, executor has {self._count}")
        if self._drive_count and len(plan.drives) not in (0, self._drive_count):
            raise ValueError(
                f"plan for {len(plan.drives)} drives, executor has {self._drive_count}"
            )
        now_s = asyncio.get_running_loop().time()
        is_newer = self._sequence is None or plan.sequence > self._sequence
        if not (plan.is_off or (is_newer and now_s < plan.lease_until_s)):
            self.rejected_count += 1
            if self.rejected_count == 1:
                _logger.warning("refused a plan that came late or out of order; counting from now")
            return
        # A plan of before that closes brings none of its time back.
        self._sequence = plan.sequence if is_newer else self._sequence
        before, self._plan = self._plan, plan
        if self._return is not None:
            self._return.submit(plan, now_s + _EARLY_S)
        self._follow(now_s, replaced=before)
        self._arm(now_s)

    async def stop(self) -> None:
        """Order all outputs closed and let go."""
        self._is_running = False
        self._plan = self._sequence = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._close_all()

    # ------------------------------------------------------------------------------- inside

    @abstractmethod
    def _apply(self, valve: int, duty: float) -> bool:
        """Have `valve` take `duty`; return whether that was news to it."""

    def _flush(self) -> bool:
        """Send what `_apply` has only gathered; return whether there was anything."""
        return False

    def _close_all(self) -> None:
        """Order everything closed; the return valve opens first and stays open."""
        if self._return is not None:
            self._return.submit(None, 0.0)
            self._apply(self._count, 1.0)
        for drive in range(self._drive_count):
            self._apply(self._first_drive + drive, 0.0)
        given = [valve for valve in range(self._count) if self._apply(valve, 0.0)]
        self._flush()
        if self.on_order is not None and given:
            now_s = asyncio.get_running_loop().time()
            for valve in given:
                self.on_order(valve, 0.0, None, now_s)

    def _next_own_s(self) -> float | None:
        """Return when the executor wants to be woken for its own ends."""
        return None

    def _do_own(self, now_s: float) -> None:
        """Do what the executor wanted to be woken for."""

    def _wanted(self, now_s: float) -> tuple[float, ...]:
        """Return the duties to have now; without a plan, and with a fault, closed."""
        if self._plan is None or self.fault is not None:
            return (0.0,) * self._count
        return self._plan.duty_at(now_s + _EARLY_S)

    def _rests_by(self, output: int, now_s: float, until_s: float) -> bool:
        """Return whether an output is planned to shut, stop or (return valve) open by then."""
        plan, drive = self._plan, output - self._first_drive
        if plan is None:
            return False
        if output < self._count:
            ends = [each.at_s for each in plan.changes if each.valve == output and not each.duty]
        elif drive < 0:
            return self._return is not None and self._return.opens_by(until_s)
        else:
            changes = plan.drives[drive].changes if plan.drives else ()
            ends = [each.at_s for each in changes if not each.fraction]
        return any(now_s < at_s <= until_s for at_s in ends)

    def _follow(self, now_s: float, *, replaced: SprayPlan | None = None) -> None:
        """Bring every valve to what it should have now."""
        clock = asyncio.get_running_loop().time
        self._move_return(now_s, opens=True)
        self._drive(now_s, stops=True)
        given = [
            (valve, duty, clock())
            for valve, duty in enumerate(self._wanted(now_s))
            if self._apply(valve, duty)
        ]
        self._drive(now_s, stops=False)
        self._move_return(now_s, opens=False)
        if self._flush():
            sent_s = clock()
            given = [(valve, duty, sent_s) for valve, duty, _ in given]
        # Measuring waits until all orders have left.
        for plan in (self._plan, replaced):
            if plan is not None and given:
                self._measure(plan, given)
        if self.on_order is not None:
            for valve, duty, given_s in given:
                self.on_order(valve, duty, self._planned_s(valve, duty, given_s, replaced), given_s)

    def _drive(self, now_s: float, *, stops: bool) -> None:
        """Stop the drives that are to stand, ahead of the valves; or move the others, behind."""
        for drive, fraction in enumerate(self._fractions(now_s)):
            if (fraction == 0.0) == stops:
                self._apply(self._first_drive + drive, fraction)

    def _fractions(self, now_s: float) -> tuple[float, ...]:
        """Return what the drives are to have now; without a plan, and with a fault, stopped."""
        if self._plan is None or self.fault is not None or not self._drive_count:
            return (0.0,) * self._drive_count
        return fractions_at(self._plan, now_s + _EARLY_S, self._drive_count)

    def _move_return(self, now_s: float, *, opens: bool) -> None:
        """Order the return valve if it is to be open (or shut): opening goes ahead of the rest."""
        if self._return is None:
            return
        self._return.run(now_s + _EARLY_S)
        is_open = self._return.is_open or self._plan is None or self.fault is not None
        if is_open == opens:
            self._apply(self._count, 1.0 if is_open else 0.0)

    def _measure(self, plan: SprayPlan, given: list[tuple[int, float, float]]) -> None:
        """Note how late orders left, where the plan had said when they should."""
        due = {(change.valve, change.duty): change.at_s for change in plan.changes}
        for valve, duty, at_s in given:
            due_s = due.get((valve, duty))
            if due_s is not None and due_s <= at_s:
                self.lateness.add(at_s - due_s)

    def _planned_s(
        self, valve: int, duty: float, given_s: float, replaced: SprayPlan | None
    ) -> float | None:
        """Return when a plan wanted what was ordered; None where none did, but a fault."""
        plan = self._plan
        if plan is None or self.fault is not None:
            return None
        for each in (plan, replaced):
            for change in reversed(() if each is None else each.changes):
                if (change.valve, change.duty) == (valve, duty) and change.at_s <= given_s:
                    return change.at_s
        return plan.issued_s if given_s < plan.lease_until_s else plan.lease_until_s

    def _wake(self) -> None:
        self._timer = None
        now_s = asyncio.get_running_loop().time()
        plan = self._plan
        if plan is not None and not now_s + _EARLY_S < plan.lease_until_s and not plan.is_off:
            self.lease_end_count += 1
        self._follow(now_s)
        self._do_own(now_s)
        self._arm(now_s)

    def _arm(self, now_s: float) -> None:
        """Set the one timer to whatever comes first."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if not self._is_running:
            return
        plan_s = None if self._plan is None else next_event_s(self._plan, now_s + _EARLY_S)
        return_s = None if self._return is None else self._return.next_s
        times = [at_s for at_s in (plan_s, return_s, self._next_own_s()) if at_s is not None]
        if times:
            self._timer = asyncio.get_running_loop().call_at(min(times), self._wake)


# No outputs at all: follows plans in time and only remembers what it would have done.

_DRY_KEPT = 10_000


@dataclass(frozen=True, slots=True, kw_only=True)
class DryChange:
    """A change of duty that an output would have made."""

    at_s: float
    valve: int
    duty: float


class DryRunExecutor(TimedExecutor):
    """For the first flights with the sprayer switched off, and for tests."""

    def __init__(self, valve_count: int, *, has_return: bool = False) -> None:
        super().__init__(valve_count, has_return=has_return)
        self._duty: list[float | None] = [None] * (valve_count + has_return)
        self.changes: deque[DryChange] = deque(maxlen=_DRY_KEPT)

    def _apply(self, valve: int, duty: float) -> bool:
        if self._duty[valve] == duty:
            return False
        self._duty[valve] = duty
        at_s = asyncio.get_running_loop().time()
        self.changes.append(DryChange(at_s=at_s, valve=valve, duty=duty))
        return True

    async def stop(self) -> None:
        """Close what is open; before `start` there is nothing."""
        if self._is_running:
            await super().stop()
