"""What goes out: the future of all valves and drives until a lease ends."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedChange:
    """Valve number `valve` (index from the left) takes `duty` at `at_s`.

    `restart` marks a change of zone: the executor begins a new PWM period there. Without it (a
    trim for the speed) the next period is early enough.
    """

    at_s: float
    valve: int
    duty: float
    restart: bool = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.duty <= 1.0:
            raise ValueError(f"duty outside [0, 1]: {self.duty}")
        if not abs(self.at_s) < float("inf"):
            raise ValueError(f"time of a change is not finite: {self.at_s}")
        if not self.valve >= 0:
            raise ValueError(f"valve index is negative: {self.valve}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveChange:
    """A motor takes `fraction` of its range at `at_s`."""

    at_s: float
    fraction: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"fraction outside [0, 1]: {self.fraction}")
        if not abs(self.at_s) < float("inf"):
            raise ValueError(f"time of a change is not finite: {self.at_s}")


@dataclass(frozen=True, slots=True, kw_only=True)
class DrivePlan:
    """What a motor (a pump, an atomiser) does: 0 is stopped, 1 the end of its range.

    `fraction` holds from the plan's `issued_s`; `changes` follow in order of time.
    """

    fraction: float
    changes: tuple[DriveChange, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 <= self.fraction <= 1.0:
            raise ValueError(f"fraction outside [0, 1]: {self.fraction}")
        if not all(a.at_s <= b.at_s for a, b in pairwise(self.changes)):
            raise ValueError("changes of a drive are not in order of time")

    @property
    def is_off(self) -> bool:
        """Whether it stands still, now and later."""
        return not self.fraction and not any(change.fraction for change in self.changes)

    def at(self, now_s: float) -> float:
        """Return the fraction at `now_s`; the lease is the plan's to mind.

        >>> DrivePlan(fraction=0.0, changes=(DriveChange(at_s=1.0, fraction=0.4),)).at(1.0)
        0.4
        """
        fraction = self.fraction
        for change in self.changes:
            if not change.at_s <= now_s:
                break
            fraction = change.fraction
        return fraction


@dataclass(frozen=True, slots=True, kw_only=True)
class SprayPlan:
    """The whole future of all valves and drives, until the lease ends; closed after that.

    `duty` holds from `issued_s`, one value a valve; `changes` follow in order of time. A newer
    plan (by `sequence`) replaces what has not happened yet. An executor that is given the same
    duty again does nothing. `drives` are the pump, where there is one, and the atomisers in the
    order of their tables; a plan without any has them all stopped.
    """

    sequence: int
    issued_s: float
    duty: tuple[float, ...]
    changes: tuple[TimedChange, ...]
    lease_until_s: float
    drives: tuple[DrivePlan, ...] = ()

    def __post_init__(self) -> None:
        if not all(0.0 <= duty <= 1.0 for duty in self.duty):
            raise ValueError(f"duty outside [0, 1]: {self.duty}")
        if not self.issued_s < self.lease_until_s < float("inf"):
            raise ValueError(f"lease ends at {self.lease_until_s}, issued at {self.issued_s}")
        if any(change.valve >= len(self.duty) for change in self.changes):
            raise ValueError("a change names a valve that the plan does not have")
        if not all(a.at_s <= b.at_s for a, b in pairwise(self.changes)):
            raise ValueError("changes are not in order of time")

    @property
    def is_off(self) -> bool:
        """Whether every valve is closed and every drive stopped, now and later."""
        return not self.opens and all(drive.is_off for drive in self.drives)

    def duty_at(self, at_s: float) -> tuple[float, ...]:
        """Return what the plan has brought about by a time: its changes so far; closed after it.

        >>> off = TimedChange(at_s=0.2, valve=0, duty=0.0)
        >>> plan = SprayPlan(
        ...     sequence=1, issued_s=0.0, duty=(0.5, 0.5), changes=(off,), lease_until_s=0.3)
        >>> plan.duty_at(0.1), plan.duty_at(0.2), plan.duty_at(0.3)
        ((0.5, 0.5), (0.0, 0.5), (0.0, 0.0))
        """
        if not at_s < self.lease_until_s:
            return (0.0,) * len(self.duty)
        changes = self.changes
        if not changes or changes[0].at_s > at_s:
            return self.duty
        duty = list(self.duty)
        for change in changes:
            if change.at_s > at_s:
                break
            duty[change.valve] = change.duty
        return tuple(duty)

    def fraction_at(self, drive: int, at_s: float) -> float:
        """Return what the plan has brought a drive to by a time; 0 after it, or without it."""
        if not at_s < self.lease_until_s or drive >= len(self.drives):
            return 0.0
        return self.drives[drive].at(at_s)

    @property
    def opens(self) -> bool:
        """Whether a valve is open, now or later."""
        return any(self.duty) or any(change.duty for change in self.changes)
