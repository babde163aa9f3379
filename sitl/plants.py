"""Which plant simulates a profile: by what makes its flow, and by how finely it is looked at.

A sprayer whose pump makes the flow: slow, up slower than down, with or without a valve. An order is
the pump's speed. After its dead time the flow goes to the new level as an exponential whose time
constant depends on the direction. With a shut-off valve an order of 0 shuts the boom at once and
leaves the pump at its speed, the flow going back to the tank; the next order opens it. Exponential
times ramp is integrated in closed form, piece by piece, so volume is conserved.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sitl.drives import Approach
from sitl.plant import (
    AveragedPlant,
    Floats,
    Metering,
    MeterStream,
    Plant,
    PulsedPlant,
    VolumeMeter,
)
from sitl.section_plant import SectionPlant

if TYPE_CHECKING:
    from collections.abc import Callable

    from sitl.plant import Ramps
    from sitl.profile import PlantProfile, Pump
    from sitl.supply import Supply

# What is left below this of a distance to the pump's level [mL/s] or of a slope is rounding.
STILL = 1e-9
_AT = attrgetter("at_s")


class _Piece(NamedTuple):
    """From `at_s` on: flow = (target + off exp(-t / time)) (opening + slope t), t since then."""

    at_s: float
    volume_ml: float
    target_ml_s: float
    off_ml_s: float
    time_s: float
    opening: float
    slope: float

    def flow_ml_s(self, since_s: float) -> float:
        """Return what the pump gives, whether the valve lets it through or not."""
        return self.target_ml_s + self.off_ml_s * math.exp(-since_s / self.time_s)

    def opening_at(self, since_s: float) -> float:
        """Return how far the valve is open, 0 to 1."""
        return min(max(self.opening + self.slope * since_s, 0.0), 1.0)

    def volume_at(self, since_s: float) -> float:
        """Return the cumulative volume."""
        rest = -math.expm1(-since_s / self.time_s)
        steady = self.opening * since_s + 0.5 * self.slope * since_s**2
        fading = self.opening * self.time_s * rest
        fading += self.slope * self.time_s * (self.time_s * rest - since_s * (1.0 - rest))
        return self.volume_ml + self.target_ml_s * steady + self.off_ml_s * fading


class _Event(NamedTuple):
    """The pump gets a new level (or keeps it, None), the valve's slope changes."""

    at_s: float
    target_ml_s: float | None
    slope: float


class PumpFlow:
    """The flow behind a pump as a chain of pieces; events may come in any order of time."""

    def __init__(self, *, up_s: float, down_s: float, start_s: float, has_valve: bool) -> None:
        self._up_s, self._down_s = up_s, down_s
        opening = 0.0 if has_valve else 1.0
        self._events: list[_Event] = []
        # One more than there are events, once all are built.
        self._pieces = [_Piece(start_s, 0.0, 0.0, 0.0, up_s, opening, 0.0)]

    def pump(self, at_s: float, target_ml_s: float) -> None:
        """Let the pump go to a level from `at_s` on."""
        self._add(_Event(at_s, target_ml_s, 0.0))

    def valve(self, at_s: float, ramp_s: float, *, is_open: bool) -> None:
        """Let the valve open or shut within `ramp_s` from `at_s` on."""
        slope = (1.0 if is_open else -1.0) / ramp_s
        self._add(_Event(at_s, None, slope))
        self._add(_Event(at_s + ramp_s, None, -slope))

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return the cumulative volume at times that were not forgotten."""
        pieces = np.array(self._build())
        i = np.maximum(np.searchsorted(pieces[:, 0], times_s, side="right") - 1, 0)
        at_s, volume_ml, target, off, time_s, opening, slope = pieces[i].T
        since_s = np.maximum(times_s - at_s, 0.0)
        rest = -np.expm1(-since_s / time_s)
        fading = opening * time_s * rest
        fading += slope * time_s * (time_s * rest - since_s * (1.0 - rest))
        result: Floats = volume_ml + off * fading
        result += target * since_s * (opening + 0.5 * slope * since_s)
        return result

    def volume_at(self, time_s: float) -> float:
        """Return the cumulative volume at one time, at little cost."""
        pieces = self._build()
        piece = pieces[max(bisect_right(pieces, time_s, key=_AT) - 1, 0)]
        return piece.volume_at(max(time_s - piece.at_s, 0.0))

    def forget(self, before_s: float) -> None:
        """Drop the pieces that end before `before_s`."""
        pieces = self._build()
        last = max(bisect_right(pieces, before_s, key=_AT) - 1, 0)
        del pieces[:last], self._events[:last]

    def _add(self, event: _Event) -> None:
        place = bisect_right(self._events, event.at_s, key=_AT)
        self._events.insert(place, event)
        del self._pieces[place + 1 :]

    def _build(self) -> list[_Piece]:
        pieces = self._pieces
        for event in self._events[len(pieces) - 1 :]:
            pieces.append(self._after(pieces[-1], event))
        return pieces

    def _after(self, before: _Piece, event: _Event) -> _Piece:
        since_s = max(event.at_s - before.at_s, 0.0)
        flow_ml_s = before.flow_ml_s(since_s)
        time_s, target = before.time_s, before.target_ml_s
        if event.target_ml_s is not None:
            target = event.target_ml_s
            time_s = self._up_s if target > flow_ml_s else self._down_s
        off = flow_ml_s - target
        slope = before.slope + event.slope
        return _Piece(
            at_s=before.at_s + since_s,
            volume_ml=before.volume_at(since_s),
            target_ml_s=target,
            off_ml_s=off if abs(off) > STILL else 0.0,
            time_s=time_s,
            opening=before.opening_at(since_s),
            slope=slope if abs(slope) > STILL else 0.0,
        )


class PumpPlant(Plant):
    """One channel for the whole boom: the pump's speed, and the shut-off valve where there is one.

    Fed with changes of duty, which is the pump's command; there are no pulses.
    """

    def __init__(
        self,
        profile: PlantProfile,
        *,
        seed: int,
        start_s: float = 0.0,
    ) -> None:
        if profile.pump is None:
            raise ValueError(f"the sprayer {profile.name} has no pump that makes the flow")
        super().__init__(profile, seed=seed, start_s=start_s)
        self._pump: Pump = profile.pump
        # This very pump is slower or quicker as a whole than the nominal one.
        scale = 1.0 + self._scatter.shift_s[0] / max(profile.mean_lag_s, 1e-9)
        self._dead_pump_s = self._pump.dead_s * scale
        self._flow = PumpFlow(
            up_s=self._pump.up_s * scale,
            down_s=self._pump.down_s * scale,
            start_s=start_s,
            has_valve=self._pump.shut_off,
        )
        self._flows = (self._flow,)

    def _check_kind(self) -> None:
        """Refuse nothing more: the constructor has seen that there is a pump."""

    def meter_stream(self) -> MeterStream:
        """Return the meter to be read in passing."""
        return VolumeMeter(self._flow, self._metering())

    def record_change(self, at_s: float, valve: int, duty: float) -> None:
        """Take down that the pump is ordered to `duty` from `at_s` on; 0 shuts the boom."""
        if not 0.0 <= duty <= 1.0:
            raise ValueError(f"duty outside [0, 1]: {duty}")
        before = self._duty[valve]
        if duty == before:
            return
        self._duty[valve] = duty
        if duty > 0.0 or not self._pump.shut_off:
            self._flow.pump(at_s + self._dead_pump_s, self._table.mean_ml_s(duty, 1))
        if self._pump.shut_off and (duty > 0.0) != (before > 0.0):
            dead_s = self.profile.dead_open_s
            self._flow.valve(at_s + dead_s, self.profile.ramp_s, is_open=duty > 0.0)


DutyPlant = AveragedPlant | PumpPlant | SectionPlant
EdgePlant = PulsedPlant | SectionPlant


def duty_plant(profile: PlantProfile, *, seed: int, start_s: float) -> DutyPlant:
    """Return the plant of the mean flow: it takes changes of duty."""
    if profile.pump is not None:
        return PumpPlant(profile, seed=seed, start_s=start_s)
    if profile.has_sections:
        return SectionPlant(profile, seed=seed, start_s=start_s)
    if profile.supply is not None:
        return SuppliedAveraged(profile, seed=seed, start_s=start_s)
    return AveragedPlant(profile, seed=seed, start_s=start_s)


def edge_plant(profile: PlantProfile, *, seed: int, start_s: float) -> EdgePlant:
    """Return the plant that takes edges."""
    if profile.has_sections:
        return SectionPlant(profile, seed=seed, start_s=start_s)
    if profile.supply is not None:
        return SuppliedPulsed(profile, seed=seed, start_s=start_s)
    return PulsedPlant(profile, seed=seed, start_s=start_s)


# PWM valves behind a constant pump: their flow is the pressure's share of what it would be.
#
# Once the pump has spun up the share is 1, and everything is as without it. Ramps of the valves
# times the exponential of the pressure are integrated in closed form, so volume is conserved.


def product_ml(
    gap_s: Floats, flow: Floats, slope: Floats, target: Floats, off: Floats, time_s: Floats
) -> Floats:
    """Return the integral of (flow + slope t) (target + off exp(-t / time)) over the gaps.

    >>> half = product_ml(np.array([2.0]), np.array([3.0]), np.array([0.0]), np.array([0.5]),
    ...                   np.array([0.0]), np.array([1.0]))
    >>> float(half[0])
    3.0
    """
    rest = -np.expm1(-gap_s / time_s)
    fading = flow * time_s * rest
    fading += slope * time_s * (time_s * rest - gap_s * (1.0 - rest))
    result: Floats = target * gap_s * (flow + 0.5 * slope * gap_s) + off * fading
    return result


class SuppliedFlow:
    """One valve's volume under a pressure that comes and goes."""

    def __init__(self, ramps: Ramps, pressure: Approach, start_s: float) -> None:
        self._ramps, self._pressure = ramps, pressure
        self._from_s, self._from_ml = start_s, 0.0

    def volume_ml(self, times_s: Floats) -> Floats:
        """Return the cumulative volume at times that were not forgotten."""
        flow_s, flow, slope = self._ramps.lines()
        pressed_s = np.array([each.at_s for each in self._pressure.stretches])
        knots_s = np.unique(np.concatenate(([self._from_s], flow_s, pressed_s)))
        knots_s = knots_s[knots_s >= self._from_s]

        def over(begins_s: Floats, gaps_s: Floats) -> Floats:
            i = np.searchsorted(flow_s, begins_s, side="right") - 1
            now = flow[i] + slope[i] * (begins_s - flow_s[i])
            at_s, target, off, time_s = self._pressure.rows(begins_s).T
            off = off * np.exp(-(begins_s - at_s) / time_s)
            return product_ml(gaps_s, now, slope[i], target, off, time_s)

        whole_ml = over(knots_s[:-1], np.diff(knots_s))
        knots_ml = self._from_ml + np.concatenate(([0.0], np.cumsum(whole_ml)))
        i = np.maximum(np.searchsorted(knots_s, times_s, side="right") - 1, 0)
        result: Floats = knots_ml[i] + over(knots_s[i], np.maximum(times_s - knots_s[i], 0.0))
        return result

    def forget(self, before_s: float) -> None:
        """Fold what is over before `before_s`; the pressure is forgotten by the plant."""
        self._from_ml = float(self.volume_ml(np.array([before_s]))[0])
        self._from_s = before_s
        self._ramps.forget(before_s)


class _SuppliedMeter(MeterStream):
    """The meter of all valves under one pressure."""

    def __init__(self, pressure: Approach, metering: Metering) -> None:
        super().__init__(metering)
        self._pressure = pressure

    def _go(self, until_s: float) -> None:
        pressure = self._pressure
        while self._at_s < until_s:
            number = pressure.place(self._at_s)
            stretch = pressure.stretches[number]
            end_s = until_s
            if number + 1 < len(pressure.stretches):
                end_s = min(until_s, pressure.stretches[number + 1].at_s)
            gap_s = end_s - self._at_s
            off = stretch.value(max(self._at_s - stretch.at_s, 0.0)) - stretch.target
            one = np.ones(1)
            self._part_ml += float(
                product_ml(
                    gap_s * one,
                    self._flow_ml_s * one,
                    self._slope_ml_s2 * one,
                    stretch.target * one,
                    off * one,
                    stretch.time_s * one,
                )[0]
            )
            self._flow_ml_s += self._slope_ml_s2 * gap_s
            self._at_s = end_s


class _Supplied(Plant):
    """What both fidelities share: the pump's pressure."""

    def __init__(self, profile: PlantProfile, *, seed: int, start_s: float = 0.0) -> None:
        if profile.supply is None or profile.supply.control != "constant":
            raise ValueError(f"the sprayer {profile.name} has no constant pump")
        super().__init__(profile, seed=seed, start_s=start_s)
        self._pump: Supply = profile.supply
        self.pressure = Approach(
            up_s=profile.supply.up_s, down_s=profile.supply.down_s, start_s=start_s
        )
        self._flows = [SuppliedFlow(ramps, self.pressure, start_s) for ramps in self._ramps]

    def _check_kind(self) -> None:
        """Refuse nothing more: the constructor has seen that there is a constant pump."""

    def record_pump(self, at_s: float, pulse_us: float) -> None:
        """Take down that the pump is ordered so from `at_s` on: it runs or it stands."""
        runs = self._pump.fraction(pulse_us) > 0.0
        if runs != (self.pressure.target > 0.0):
            dead_s = self._pump.spin_up_s if runs else self._pump.dead_s
            self.pressure.go(at_s + dead_s, 1.0 if runs else 0.0)

    def meter_counter(self) -> Callable[[float], int]:
        """Return the meter to be read in passing: the same counts, in order of time only."""
        stream = self._stream = _SuppliedMeter(self.pressure, self._metering())
        for ramps in self._ramps:
            for step in ramps.steps:
                stream.step(*step)
        return stream.count

    def forget(self, before_s: float) -> None:
        """Drop what is only needed for times before `before_s`."""
        super().forget(before_s)
        self.pressure.forget(self._forgotten_s)


class SuppliedAveraged(_Supplied, AveragedPlant):
    """The mean of the pulses, under the pump's pressure."""


class SuppliedPulsed(_Supplied, PulsedPlant):
    """Every pulse as it is, under the pump's pressure."""
