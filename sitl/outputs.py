"""What lies between a plan and the plant in a simulated flight: the output path.

`servo` is a pulse width on an autopilot's output, delayed by its frame and turned into pulses by a
driver board; in averaged fidelity a change of duty acts as it is. (`gpio` is the product's own
pulse engine, and stands in `flight.py`.) All of them keep the changes that were carried out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from companion.core.types import TimedChange

if TYPE_CHECKING:
    from collections.abc import Iterable

    from companion.core.types import SprayPlan
    from sitl.board import DriverBoard
    from sitl.meter import Edge
    from sitl.profile import PlantProfile

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
