"""What a healthy sprayer does, for `detection.py`: its spread, its pressure, its tables by duty."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from companion.core.flow_window import ML_S_PER_L_MIN
from companion.core.liquid_bins import BIN_S, Order, bin_length_s
from companion.core.liquid_naming import RESTLESS_SHARE
from companion.core.nozzle import NozzleSet, PwmLimits
from companion.core.schedule import LagModel
from companion.core.types import BatteryReport, FlowReport, TankReport

# A sprayer that follows more slowly than this is judged only when it has settled.
SLOW_S = 0.5
CURVE_STEPS = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotLiquid:
    """Which of the autopilot's battery monitors are flow meter and tank; None: neither."""

    flow_battery: int | None = None
    tank_battery: int | None = None
    tank_l: float = 0.0

    def flow(self, item: BatteryReport) -> FlowReport | None:
        """Return the count of the flow meter; no number where the autopilot knows none."""
        if item.battery != self.flow_battery:
            return None
        consumed_ml = item.consumed
        if consumed_ml is None:
            text = "flow meter: the autopilot has no count of it"
            return FlowReport(received_s=item.received_s, volume_ml=math.nan, fault=text)
        return FlowReport(received_s=item.received_s, volume_ml=consumed_ml)

    def tank(self, item: BatteryReport) -> TankReport | None:
        """Return what is left in the tank."""
        if item.battery != self.tank_battery:
            return None
        percent = item.remaining_percent
        if percent is None:
            text = "tank: the autopilot has no level of it"
            return TankReport(received_s=item.received_s, level_l=None, fault=text)
        return TankReport(received_s=item.received_s, level_l=percent / 100.0 * self.tank_l)


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """What is known of the healthy sprayer; `pressure_kpa` at `pressure_duty`, increasing.

    `spread` is one standard deviation of metered over expected flow, `closed_share` of the full
    flow may be metered while all is closed; without `closed_check` that is not looked at, for a
    meter that also counts what returns to the tank. A flow is compared over `bin_s`; one that
    moves by more than `restless_share` from bin to bin is no liquid.
    """

    spread: float = 0.0125
    closed_share: float = 0.02
    meter_minimum_l_min: float = 0.5
    pressure_duty: tuple[float, ...] = ()
    pressure_kpa: tuple[float, ...] = ()
    reserve_l: float | None = None
    meter_required: bool = False
    closed_check: bool = True
    bin_s: float = BIN_S
    restless_share: float = RESTLESS_SHARE

    def __post_init__(self) -> None:
        if not 0.001 <= self.spread <= 0.05:
            raise ValueError(f"spread must lie in [0.001, 0.05], got {self.spread}")
        if not 0.001 <= self.closed_share <= 0.5:
            raise ValueError(f"closed_share must lie in [0.001, 0.5], got {self.closed_share}")
        if not 0.05 <= self.bin_s <= 5.0:
            raise ValueError(f"bin_s must lie in [0.05, 5], got {self.bin_s}")
        if not 0.01 <= self.restless_share <= 1.0:
            raise ValueError(f"restless_share must lie in [0.01, 1], got {self.restless_share}")
        if not 0.0 <= self.meter_minimum_l_min <= 1e4:
            raise ValueError("meter_minimum_l_min must lie in [0, 1e4]")
        if len(self.pressure_duty) != len(self.pressure_kpa) or len(self.pressure_duty) == 1:
            raise ValueError("pressure_duty and pressure_kpa need as many points, 2 or more")
        duties = self.pressure_duty
        if not all(a < b for a, b in pairwise(duties)):
            raise ValueError(f"pressure_duty must increase, got {duties}")
        if not all(0.0 < kpa < 1e5 for kpa in self.pressure_kpa):
            raise ValueError("pressure_kpa must be positive")

    def pressure_at(self, duty: float) -> float | None:
        """Return the healthy pressure at a duty, a straight line between the points."""
        duties, kpa = self.pressure_duty, self.pressure_kpa
        if not duties:
            return None
        for i in range(1, len(duties) - 1):
            if duty < duties[i]:
                break
        else:
            i = len(duties) - 1
        share = min(max((duty - duties[i - 1]) / (duties[i] - duties[i - 1]), 0.0), 1.0)
        return kpa[i - 1] + share * (kpa[i] - kpa[i - 1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Watching:
    """The law with what a sprayer makes of it: times, and the table of each set by duty."""

    law: Detection
    delay_s: float
    bin_s: float
    closed_after_s: float
    settle_s: float
    full_ml_s: float
    open_ml_s: float
    valves: tuple[tuple[int, ...], ...]
    tables: tuple[tuple[float, ...], ...]

    @classmethod
    def of(
        cls, law: Detection, sets: tuple[NozzleSet, ...], lag: LagModel, pwm: PwmLimits
    ) -> Watching:
        """Return the watching of a sprayer."""
        lags = (lag.on_s, lag.off_s, lag.up_s, lag.down_s)
        largest = sets[-1]
        full_ml_s = largest.flow_max_l_min * ML_S_PER_L_MIN
        steps = [step / CURVE_STEPS for step in range(CURVE_STEPS + 1)]
        return cls(
            law=law,
            delay_s=sum(lags) / len(lags) + lag.output_s,
            bin_s=bin_length_s(pwm.period_s, law.bin_s),
            closed_after_s=max(lag.off_end_s, *lags) + lag.output_s + 0.5,
            settle_s=3.0 * max(lags) if max(lags) > SLOW_S else 0.0,
            full_ml_s=full_ml_s,
            open_ml_s=full_ml_s / len(largest.valves),
            valves=tuple(nozzles.valves for nozzles in sets),
            tables=tuple(
                tuple(
                    nozzles.curve.flow_for(duty) * ML_S_PER_L_MIN / len(nozzles.valves)
                    for duty in steps
                )
                for nozzles in sets
            ),
        )

    def order(self, at_s: float, duties: tuple[float, ...], index: int) -> Order:
        """Return what duties stand for, by the table of a nozzle set."""
        table, flows, known = self.tables[index], [0.0] * len(duties), dict[float, float]()
        total = 0.0
        for valve in self.valves[index]:
            duty = duties[valve]
            if duty > 0.0:
                flow = known.get(duty)
                if flow is None:
                    i = min(int(duty * CURVE_STEPS), CURVE_STEPS - 1)
                    part = duty * CURVE_STEPS - i
                    flow = known[duty] = table[i] + (table[i + 1] - table[i]) * part
                flows[valve] = flow
                total += duty
        used = sum(1 for flow in flows if flow > 0.0)
        pressure = self.law.pressure_at(total / used) if used else None
        return Order(at_s, tuple(flows), pressure)
