"""The motors of a simulated sprayer: from plans to pulses, and what truly came of them.

Drive 0 is the pump, where the profile has a `[supply]`; the atomisers follow in their order. A
fraction of a plan is a share of the way from the motor's stop to its full pulse.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from companion.core.types import DriveChange, DrivePlan
from sitl.profile import ML_S_PER_L_MIN

if TYPE_CHECKING:
    from companion.core.types import SprayPlan, TimedChange
    from sitl.outputs import Output
    from sitl.plant import Floats
    from sitl.profile import PlantProfile
    from sitl.supply import Atomiser

# A quantity that follows its order as an exponential: a motor's speed, a supply's pressure.


class Stretch(NamedTuple):
    """From `at_s` on the value is target + off exp(-t / time), t since then."""

    at_s: float
    target: float
    off: float
    time_s: float

    def value(self, since_s: float) -> float:
        """Return the value."""
        return self.target + self.off * math.exp(-since_s / self.time_s)


class Approach:
    """Stretches in order of time; a later order never acts before an earlier one.

    >>> speed = Approach(up_s=1.0, down_s=0.5, start_s=0.0)
    >>> speed.go(1.0, 100.0)
    >>> [round(float(value), 1) for value in speed.values(np.array([0.5, 2.0, 9.0]))]
    [0.0, 63.2, 100.0]
    """

    def __init__(self, *, up_s: float, down_s: float, start_s: float) -> None:
        self._up_s, self._down_s = up_s, down_s
        self.stretches = [Stretch(start_s, 0.0, 0.0, up_s)]

    @property
    def target(self) -> float:
        """Return where it goes to."""
        return self.stretches[-1].target

    def go(self, at_s: float, target: float) -> None:
        """Let it go to a target from `at_s` on."""
        last = self.stretches[-1]
        if target == last.target:
            return
        at_s = max(at_s, last.at_s)
        value = last.value(at_s - last.at_s)
        time_s = self._up_s if target > value else self._down_s
        self.stretches.append(Stretch(at_s, target, value - target, time_s))

    def values(self, times_s: Floats) -> Floats:
        """Return the value at times that were not forgotten."""
        at_s, target, off, time_s = self.rows(times_s).T
        result: Floats = target + off * np.exp(-(times_s - at_s) / time_s)
        return result

    def rows(self, times_s: Floats) -> Floats:
        """Return (n, 4): the stretch that each time lies in."""
        table = np.array(self.stretches)
        i = np.maximum(np.searchsorted(table[:, 0], times_s, side="right") - 1, 0)
        found: Floats = table[i]
        # Before the first of all nothing has moved.
        found[:, 0] = np.minimum(found[:, 0], times_s)
        return found

    def place(self, time_s: float) -> int:
        """Return the number of the stretch that a time lies in."""
        return max(bisect_right(self.stretches, time_s, key=lambda each: each.at_s) - 1, 0)

    def forget(self, before_s: float) -> None:
        """Drop the stretches that end before `before_s`."""
        del self.stretches[: self.place(before_s)]


# Flow and speed of a droplet figure are means of this: a pulse of a PWM valve makes no other drops.
MEAN_S = 0.2


Ranges = tuple[tuple[float, float], ...]


class PumpOrders(Protocol):
    """A plant that takes orders of its pump."""

    def record_pump(self, at_s: float, pulse_us: float) -> None:
        """Take down that the pump is ordered so from `at_s` on."""


class DriveOrder(NamedTuple):
    """A pulse that a motor was given."""

    at_s: float
    drive: int
    pulse_us: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveTruth:
    """What the motors did: their orders, and speed and droplets of each atomiser (n, atomisers).

    `vmd_um` is NaN where an atomiser gets no liquid.
    """

    orders: tuple[DriveOrder, ...]
    atomisers: tuple[Atomiser, ...]
    time_s: Floats
    rpm: Floats
    vmd_um: Floats
    volume_ml: Floats


class Motors:
    """Takes pulses of all drives, in order of time for each; the pump's go on to the plant."""

    def __init__(
        self,
        profile: PlantProfile,
        plant: object,
        *,
        start_s: float,
        ranges_us: Ranges = (),
    ) -> None:
        """Make them stand; `ranges_us` is the program's belief of stop and full of each."""
        self._profile = profile
        self._pump: PumpOrders | None = None
        if profile.supply is not None:
            assert hasattr(plant, "record_pump")
            self._pump = plant
        self.orders: list[DriveOrder] = []
        self._speeds = [
            Approach(up_s=each.up_s, down_s=each.down_s, start_s=start_s)
            for each in profile.atomisers
        ]
        motors = (*((profile.supply,) if profile.supply is not None else ()), *profile.atomisers)
        own_us = tuple((each.stop_us, each.max_us) for each in motors)
        self._ranges_us = ranges_us or own_us
        if len(self._ranges_us) != len(own_us):
            raise ValueError(f"{len(own_us)} motors, the program has {len(self._ranges_us)}")

    @property
    def count(self) -> int:
        """Return how many there are."""
        return len(self._ranges_us)

    def order(self, at_s: float, drive: int, pulse_us: float) -> None:
        """Take a pulse that a motor is given from `at_s` on; too short to be one is a stop."""
        self.orders.append(DriveOrder(at_s, drive, pulse_us))
        if drive == 0 and self._pump is not None:
            self._pump.record_pump(at_s, pulse_us)
            return
        number = drive - (self._pump is not None)
        self._speeds[number].go(at_s, self._profile.atomisers[number].speed_rpm(pulse_us))

    def order_fraction(self, at_s: float, drive: int, fraction: float) -> None:
        """Take a share of a motor's range, in whole microseconds as a wire has them."""
        stop_us, max_us = self._ranges_us[drive]
        self.order(at_s, drive, round(stop_us + fraction * (max_us - stop_us)))

    def truth(self, times_s: Floats, volume_ml: Floats) -> DriveTruth:
        """Return what came of it; `volume_ml` is each valve's cumulative volume at the times."""
        atomisers = self._profile.atomisers
        rpm = np.zeros((len(times_s), len(atomisers)))
        fed_ml = np.zeros((len(times_s), len(atomisers)))
        sharing = np.zeros(volume_ml.shape[1])
        for atomiser in atomisers:
            sharing[list(atomiser.valves)] += 1.0
        for number, (atomiser, speed) in enumerate(zip(atomisers, self._speeds, strict=True)):
            rpm[:, number] = speed.values(times_s)
            valves = list(atomiser.valves)
            fed_ml[:, number] = (volume_ml[:, valves] / sharing[valves]).sum(axis=1)
        return DriveTruth(
            orders=tuple(self.orders),
            atomisers=atomisers,
            time_s=times_s,
            rpm=rpm,
            vmd_um=droplets_um(atomisers, times_s, rpm, fed_ml),
            volume_ml=fed_ml,
        )


def droplets_um(
    atomisers: tuple[Atomiser, ...], times_s: Floats, rpm: Floats, fed_ml: Floats
) -> Floats:
    """Return the volume median diameter over the time; NaN where nothing flows or turns."""
    half = max(round(0.5 * MEAN_S / float(times_s[1] - times_s[0])), 1)
    index = np.arange(len(times_s))
    low, high = np.maximum(index - half, 0), np.minimum(index + half, len(times_s) - 1)
    span_s = (times_s[high] - times_s[low])[:, None]
    flow_l_min = (fed_ml[high] - fed_ml[low]) / span_s / ML_S_PER_L_MIN
    vmd_um: Floats = np.full(rpm.shape, np.nan)
    for number, law in enumerate(atomisers):
        wet = (flow_l_min[:, number] > 1e-3) & (rpm[:, number] > 1.0)
        speed, flow = rpm[wet, number], flow_l_min[wet, number]
        vmd_um[wet, number] = law.law_um * speed**-law.law_speed * flow**law.law_flow
    return vmd_um


@dataclass(slots=True)
class DriveFollower:
    """The changes of one motor's plans, each at its time, until the lease ends."""

    fraction: float = 0.0
    _changes: tuple[DriveChange, ...] = ()
    _done: int = 0
    _lease_until_s: float = field(default=math.inf)

    def submit(self, plan: DrivePlan, *, now_s: float, lease_until_s: float) -> list[DriveChange]:
        """Return the changes that happened before `now_s`, and take the new plan."""
        made = self.advance(now_s)
        if plan.fraction != self.fraction:
            made.append(self._take(now_s, plan.fraction))
        self._changes, self._done, self._lease_until_s = plan.changes, 0, lease_until_s
        return made + self.advance(now_s)

    def advance(self, until_s: float) -> list[DriveChange]:
        """Return the changes up to `until_s` that were not returned yet."""
        made = []
        while self._done < len(self._changes):
            change = self._changes[self._done]
            if change.at_s > until_s or change.at_s >= self._lease_until_s:
                break
            self._done += 1
            if change.fraction != self.fraction:
                made.append(self._take(change.at_s, change.fraction))
        if self._lease_until_s <= until_s:
            if self.fraction != 0.0:
                made.append(self._take(self._lease_until_s, 0.0))
            self._changes, self._done, self._lease_until_s = (), 0, math.inf
        return made

    def _take(self, at_s: float, fraction: float) -> DriveChange:
        self.fraction = fraction
        return DriveChange(at_s=at_s, fraction=fraction)


class DrivenOutput:
    """An output path with the motors beside the valves."""

    def __init__(self, valves: Output, motors: Motors, *, delay_s: float) -> None:
        self._valves = valves
        self.motors = motors
        self._delay_s = delay_s
        self._followers = [DriveFollower() for _ in range(motors.count)]

    @property
    def orders(self) -> list[TimedChange]:
        """Return the valves' changes carried out so far."""
        return self._valves.orders

    def submit(self, plan: SprayPlan, *, now_s: float) -> None:
        """Carry out what was due before `now_s`, then replace the future."""
        self._valves.submit(plan, now_s=now_s)
        for number, follower in enumerate(self._followers):
            # A plan that names no motor wants it stopped.
            drive = plan.drives[number] if number < len(plan.drives) else DrivePlan(fraction=0.0)
            made = follower.submit(drive, now_s=now_s, lease_until_s=plan.lease_until_s)
            self._act(number, made)

    def finish(self, end_s: float) -> None:
        """Carry out all until `end_s`; the lease stops what still runs."""
        self._valves.finish(end_s)
        for number, follower in enumerate(self._followers):
            self._act(number, follower.advance(end_s))

    def _act(self, number: int, made: list[DriveChange]) -> None:
        for change in made:
            self.motors.order_fraction(change.at_s + self._delay_s, number, change.fraction)
