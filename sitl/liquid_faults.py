"""What goes wrong with the liquid in flight, and the sensors that see it: meter and pressure.

Faults act on the plant at their time. The pressure obeys the same laws as `detection.py` is built
on, with figures of its own: nozzles pass flow as the square root of the pressure, and the pump
gives more pressure at less flow. With one of six valves shut the twin's flow falls by 14.6 %, not
by 16.7 %, so that the pressure rises by 5 %: a rise of 0.343 of the share of the flow that is lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from companion.core.types import FlowReport, Input, PressureReport
from sitl.profile import ML_S_PER_L_MIN

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from sitl.plant import Plant

# P1: 290 kPa fully open, 227 kPa at half duty; a straight line between and beyond.
FULL_KPA, HALF_KPA = 290.0, 227.0
CLOSED_KPA = 300.0
PUMP_RISE = 0.343
PRESSURE_GAIN_SPREAD = 0.01
PRESSURE_NOISE = 0.01
# Air comes in shares of the flow that change each period; a pump that is off runs down.
AIR_SUPPLY = (0.25, 0.95)
AIR_BEFORE_EMPTY_S = 2.0
RUN_DOWN = ((0.0, 0.5), (0.2, 0.15), (0.4, 0.0))


class LiquidFaultKind(StrEnum):
    """What can go wrong."""

    CLOG = "clog"
    STUCK_CLOSED = "stuck-closed"
    STUCK_OPEN = "stuck-open"
    LEAK = "leak"
    SUPPLY = "supply"
    AIR = "air"
    PUMP_OFF = "pump-off"
    TANK_EMPTY = "tank-empty"
    NO_FLOW = "no-flow"
    DEAD_METER = "dead-meter"


@dataclass(frozen=True, slots=True, kw_only=True)
class LiquidFault:
    """One fault from `from_s` on.

    `share` is how much of the flow is lost (clog, supply) or of the full flow leaks; `valve` is
    the one that sticks, or whose nozzles clog (all, where it is None).
    """

    kind: LiquidFaultKind
    from_s: float
    share: float = 0.0
    valve: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.share <= 1.0:
            raise ValueError(f"share must lie in [0, 1], got {self.share}")
        sticks = self.kind in (LiquidFaultKind.STUCK_CLOSED, LiquidFaultKind.STUCK_OPEN)
        if sticks and self.valve is None:
            raise ValueError(f"{self.kind} needs a valve")


def healthy_kpa(duty: float) -> float:
    """Return the pressure of a healthy sprayer.

    >>> healthy_kpa(0.5)
    227.0
    """
    return HALF_KPA + (FULL_KPA - HALF_KPA) * (duty - 0.5) / 0.5


class LiquidSensors:
    """Meter and pressure sensor of a plant, and the faults; read in order of time."""

    def __init__(
        self,
        plant: Plant,
        *,
        meter_rate_hz: float,
        pressure_rate_hz: float = 0.0,
        start_s: float,
        faults: Sequence[LiquidFault] = (),
        also: Sequence[Plant] = (),
        seed: int = 0,
    ) -> None:
        """Put sensors on `plant`; faults act on it and, all the same, on the plants of `also`."""
        self._plant = plant
        self._plants = (plant, *also)
        self._start_s = start_s
        self._rates_hz = (meter_rate_hz, pressure_rate_hz)
        self._read = [0, 0]
        self._per_ml = plant.profile.meter.pulses_per_l / 1000.0
        self._count = plant.meter_counter() if meter_rate_hz > 0.0 else None
        self._faults = sorted(faults, key=lambda fault: fault.from_s)
        self._rng = np.random.default_rng([seed, 7])
        self._gain = 1.0 + float(self._rng.uniform(-PRESSURE_GAIN_SPREAD, PRESSURE_GAIN_SPREAD))
        self._dead_count: int | None = None
        self._openings = [1.0] * plant.profile.valve_count
        self._supply = 1.0
        self._begun: set[int] = set()
        self._air_s = -math.inf
        self._begin: dict[LiquidFaultKind, Callable[[LiquidFault, float], None]] = {
            LiquidFaultKind.CLOG: self._clogged,
            LiquidFaultKind.STUCK_CLOSED: self._stuck,
            LiquidFaultKind.STUCK_OPEN: self._stuck,
            LiquidFaultKind.NO_FLOW: self._all_shut,
            LiquidFaultKind.LEAK: self._leaking,
            LiquidFaultKind.SUPPLY: self._weakened,
            LiquidFaultKind.DEAD_METER: self._died,
        }
        if faults and plant.profile.pump is not None:
            raise ValueError("faults of the liquid act on sprayers with valves")

    def add(self, fault: LiquidFault) -> None:
        """Take a fault more, whose time was not known before."""
        self._faults.append(fault)

    def act(self, now_s: float) -> None:
        """Let the faults act that are due."""
        for number, fault in enumerate(self._faults):
            if fault.from_s <= now_s:
                self._act(number, fault, now_s)

    def counted_ml(self, now_s: float) -> float:
        """Return what the meter has counted; asked for in order of time."""
        return self._pulses(now_s) / self._per_ml

    def pressure_kpa(self) -> float:
        """Return one sample of the pressure sensor."""
        return self._pressure_kpa()

    def read(self, now_s: float) -> list[Input]:
        """Return what was measured since the last call, after the faults that were due."""
        self.act(now_s)
        reports: list[Input] = [
            FlowReport(received_s=at_s, volume_ml=self.counted_ml(at_s))
            for at_s in self._due(0, now_s)
        ]
        reports += [
            PressureReport(received_s=at_s, pressure_kpa=self._pressure_kpa())
            for at_s in self._due(1, now_s)
        ]
        return reports

    def _due(self, which: int, now_s: float) -> list[float]:
        rate_hz = self._rates_hz[which]
        if not rate_hz > 0.0:
            return []
        first, last = self._read[which] + 1, math.floor((now_s - self._start_s) * rate_hz)
        self._read[which] = max(last, self._read[which])
        return [self._start_s + number / rate_hz for number in range(first, last + 1)]

    def _pulses(self, at_s: float) -> int:
        assert self._count is not None
        count = self._count(at_s)
        return count if self._dead_count is None else self._dead_count

    def _pressure_kpa(self) -> float:
        flow, supply, duty = self._plant.flow_and_order()
        kpa = CLOSED_KPA if duty == 0.0 else healthy_kpa(duty) * (1.0 + PUMP_RISE * (1.0 - flow))
        noise = 1.0 + PRESSURE_NOISE * float(self._rng.standard_normal())
        return max(kpa, 0.0) * supply**2 * self._gain * noise

    def _act(self, number: int, fault: LiquidFault, now_s: float) -> None:
        if number not in self._begun:
            self._begun.add(number)
            begin = self._begin.get(fault.kind)
            if begin is not None:
                begin(fault, now_s)
        since_s = now_s - fault.from_s
        if fault.kind is LiquidFaultKind.AIR:
            self._bubble(now_s)
        elif fault.kind is LiquidFaultKind.TANK_EMPTY:
            if since_s < AIR_BEFORE_EMPTY_S:
                self._bubble(now_s)
            else:
                self._run_down(since_s - AIR_BEFORE_EMPTY_S, now_s)
        elif fault.kind is LiquidFaultKind.PUMP_OFF:
            self._run_down(since_s, now_s)

    def _bubble(self, now_s: float) -> None:
        if now_s - self._air_s >= 2.0 * self._plant.profile.pwm.period_s:
            self._air_s = now_s
            self._supplied(float(self._rng.uniform(*AIR_SUPPLY)), now_s)

    def _run_down(self, since_s: float, now_s: float) -> None:
        self._supplied([supply for from_s, supply in RUN_DOWN if from_s <= since_s][-1], now_s)

    def _supplied(self, supply: float, now_s: float) -> None:
        if supply != self._supply:
            self._supply = supply
            self._restrict(now_s)

    def _restrict(self, now_s: float) -> None:
        for plant in self._plants:
            plant.restrict(now_s, openings=self._openings, supply=self._supply)

    def _clogged(self, fault: LiquidFault, now_s: float) -> None:
        for valve in range(len(self._openings)):
            if fault.valve is None or valve == fault.valve:
                self._openings[valve] = 1.0 - fault.share
        self._restrict(now_s)

    def _stuck(self, fault: LiquidFault, now_s: float) -> None:
        assert fault.valve is not None  # __post_init__
        is_open = fault.kind is LiquidFaultKind.STUCK_OPEN
        self._stick(now_s, fault.valve, is_open=is_open)

    def _stick(self, now_s: float, valve: int, *, is_open: bool) -> None:
        for plant in self._plants:
            plant.stick(now_s, valve, is_open=is_open)

    def _all_shut(self, _fault: LiquidFault, now_s: float) -> None:
        for valve in range(len(self._openings)):
            self._stick(now_s, valve, is_open=False)

    def _leaking(self, fault: LiquidFault, now_s: float) -> None:
        full_l_min = self._plant.profile.nozzle_sets[-1].flow_max_l_min
        for plant in self._plants:
            plant.leak(now_s, fault.share * full_l_min * ML_S_PER_L_MIN)

    def _weakened(self, fault: LiquidFault, now_s: float) -> None:
        self._supplied(1.0 - fault.share, now_s)

    def _died(self, _fault: LiquidFault, now_s: float) -> None:
        assert self._count is not None
        self._dead_count = self._count(now_s)
