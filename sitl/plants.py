"""Which plant simulates a profile: by what makes its flow, and by how finely it is looked at."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sitl.drives import Approach
from sitl.meter import Metering, MeterStream
from sitl.plant import AveragedPlant, Floats, Plant, PulsedPlant
from sitl.pump_plant import PumpPlant
from sitl.section_plant import SectionPlant

if TYPE_CHECKING:
    from collections.abc import Callable

    from sitl.plant import Ramps
    from sitl.profile import PlantProfile
    from sitl.supply import Supply


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

    def __init__(
        self, profile: PlantProfile, *, seed: int, perfect: bool = False, start_s: float = 0.0
    ) -> None:
        if profile.supply is None or profile.supply.control != "constant":
            raise ValueError(f"the sprayer {profile.name} has no constant pump")
        super().__init__(profile, seed=seed, perfect=perfect, start_s=start_s)
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
