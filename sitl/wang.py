"""The controller of Wang et al. 2024 (P1), emulated: what the twin is validated against.

P1 polls the position at 5 Hz, needs T2 = 0.42 s for its program, looks the rate up at one point
ahead of the aircraft by a linear scan, and its valves take a new duty with their next PWM period.
Here polling and waiting are kept; the look-up uses our tree, which gives the same rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from companion.core.frame import course_deg, look_ahead_point
from companion.core.nozzle import allowed_duty
from companion.core.rate import flow_for_rate
from companion.core.types import SprayPlan, Telemetry, TimedChange

if TYPE_CHECKING:
    from companion.core.controller import Setup

POLL_S = 0.2  # 5 Hz
PROGRAM_S = 0.42  # T2, P1's "program execution time"
# Compensation took away 3.55 m of lag distance at 5 m/s: 0.71 s. P1 states T1 + T2 + T3 = 0.97 s.
LOOK_AHEAD_S = 0.71
LOOK_AHEAD_STATED_S = 0.97
LEASE_S = 10.0  # P1 has none


@dataclass(slots=True, kw_only=True)
class WangController:
    """One poll at a time; `plans` come out when the program has run through."""

    setup: Setup
    look_ahead_s: float
    last: Telemetry | None = None
    sequence: int = 0
    duty: float = 0.0

    def hear(self, item: Telemetry) -> None:
        """Keep the newest position; nothing happens before the next poll."""
        self.last = item

    def poll(self, now_s: float) -> SprayPlan | None:
        """Return the order that follows from the position at `now_s`, due after the program."""
        if self.last is None:
            return None
        duty = self._duty(self.last)
        at_s = now_s + PROGRAM_S
        self.sequence += 1
        count = len(self.setup.boom.valves)
        before, self.duty = self.duty, duty
        return SprayPlan(
            sequence=self.sequence,
            issued_s=at_s,
            duty=(before,) * count,
            changes=tuple(
                TimedChange(at_s=at_s, valve=valve, duty=duty, restart=False)
                for valve in range(count)
            ),
            lease_until_s=at_s + LEASE_S,
        )

    def _duty(self, item: Telemetry) -> float:
        """P1 Eqs. 1 to 3: look-ahead point, rate, flow, duty of all valves."""
        east, north = item.velocity_east_m_s or 0.0, item.velocity_north_m_s or 0.0
        speed_m_s = math.hypot(east, north)
        latitude_deg, longitude_deg = look_ahead_point(
            item.latitude_deg,
            item.longitude_deg,
            course_deg=course_deg(east, north),
            distance_m=speed_m_s * self.look_ahead_s,
        )
        place = self.setup.frame.to_local(latitude_deg, longitude_deg)
        rate = self.setup.prescription.rate_at(*place)
        if rate is None:
            return 0.0
        nozzles = self.setup.nozzle_sets[-1]
        flow = flow_for_rate(rate, speed_m_s, self.setup.boom.width_m)
        return allowed_duty(nozzles.curve.duty_for(flow), self.setup.pwm)
