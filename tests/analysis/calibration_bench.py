"""A flight's record made by hand: steps of known lags, metered exactly or as a turbine does."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from analysis.calibration.steps import Floats, FlowRecord, Order
from companion.core.schedule import LagModel

PERIOD_S = 1.0 / 11.0
ML_S = 80.0  # of a fully open sprayer; flow is in proportion to the duty
LAG = LagModel(
    on_s=0.10, off_s=0.11, up_s=0.09, down_s=0.12, on_start_s=0.085, off_end_s=0.14, output_s=0.0
)
TRUE_S = {"on": 0.103, "off": 0.112, "up": 0.094, "down": 0.117}
CYCLE = (0.4, 0.9, 0.4, 0.0, 0.9, 0.4, 0.9, 0.0)
RAMP_S = 0.03


def kind_of(before: float, after: float) -> str:
    if before == 0.0:
        return "on"
    if after == 0.0:
        return "off"
    return "up" if after > before else "down"


@dataclass(frozen=True, kw_only=True)
class Bench:
    """What is ordered of all valves at once, and how it is metered."""

    dwell_s: float = 2.0
    cycles: int = 6
    start_s: float = 10.0
    valves: int = 2
    spread_s: float = 0.0  # from the first valve's order to the last one's
    rate_hz: float = 50.0
    gain: float = 1.0
    offset_ml: float = 0.0
    pulse_ml: float | None = None
    meter_lag_s: float = 0.001
    lag_s: dict[str, float] = field(default_factory=lambda: dict(TRUE_S))
    trims: tuple[tuple[float, float], ...] = ()  # (after each order, share of the duty)

    def duties(self) -> list[tuple[float, float, float]]:
        """Return (time, before, after) of all changes of all valves together."""
        changes, duty, at_s = [], 0.0, self.start_s + 3.0
        for after in CYCLE * self.cycles:
            changes.append((at_s, duty, after))
            duty = after
            for later_s, share in self.trims:
                if duty > 0.0:
                    changes.append((at_s + later_s, duty, duty * (1.0 + share)))
                    duty *= 1.0 + share
            at_s += self.dwell_s
        return changes

    def record(self) -> FlowRecord:
        changes = self.duties()
        times_s: Floats = self.start_s + np.arange(
            round((changes[-1][0] + 3.0 - self.start_s) * self.rate_hz)
        ) / float(self.rate_hz)
        volume_ml: Floats = np.zeros(len(times_s))
        orders = []
        share = ML_S / self.valves
        for at_s, before, after in changes:
            lag_s = self.lag_s[kind_of(before, after)]
            for valve in range(self.valves):
                order_s = at_s + self.spread_s * valve / max(self.valves - 1, 1)
                orders.append(
                    Order(
                        at_s=order_s,
                        valve=valve,
                        before=before,
                        after=after,
                        before_ml_s=share * before,
                        after_ml_s=share * after,
                    )
                )
                since_s = times_s - self.meter_lag_s - (order_s + lag_s - 0.5 * RAMP_S)
                ramp = np.clip(since_s, 0.0, RAMP_S)
                volume_ml += (
                    share
                    * (after - before)
                    * (0.5 * ramp**2 / RAMP_S + np.maximum(since_s - RAMP_S, 0.0))
                )
        volume_ml = self.gain * volume_ml + self.offset_ml
        if self.pulse_ml is not None:
            volume_ml = np.floor(volume_ml / self.pulse_ml + 1e-9) * self.pulse_ml
        orders.sort(key=lambda order: order.at_s)
        return FlowRecord(
            orders=tuple(orders), time_s=times_s, volume_ml=volume_ml, period_s=PERIOD_S, lag=LAG
        )


def metered(record: FlowRecord, volume_ml: Floats) -> FlowRecord:
    """Return the record with other readings."""
    return replace(record, volume_ml=volume_ml)
