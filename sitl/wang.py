"""The controller of Wang et al. 2024 (P1), emulated: what the twin is validated against.

P1 polls the position at 5 Hz, needs T2 = 0.42 s for its program, looks the rate up at one point
ahead of the aircraft by a linear scan, and its valves take a new duty with their next PWM period.
Here polling and waiting are kept; the look-up uses our tree, which gives the same rate. Duties are
those of P1's Eq. 2, with its change of nozzles: below 4 L/min valves 5 and 6 are closed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from analysis.published import SETS
from companion.core.frame import course_deg, look_ahead_point
from companion.core.nozzle import FLOW_LAWS, FlowCurve, NozzleSet, allowed_duty, flow_for_rate
from companion.core.types import SprayPlan, Telemetry, TimedChange

if TYPE_CHECKING:
    from companion.core.setup import Setup

POLL_S = 0.2  # 5 Hz
PROGRAM_S = 0.42  # T2, P1's "program execution time"
# Compensation took away 3.55 m of lag distance at 5 m/s: 0.71 s. P1 states T1 + T2 + T3 = 0.97 s.
LOOK_AHEAD_S = 0.71
LOOK_AHEAD_STATED_S = 0.97
LEASE_S = 10.0  # P1 has none
EIGHT, TWELVE = FLOW_LAWS["wang-2024-eq2"]
VALVES = 6
SMALL_SET_VALVES = 4  # P1: valves 5 and 6 are closed where eight nozzles suffice
STAYS_OPEN_ABOVE = 0.9  # P1: "exceeds 90 % ... in a normally open state"


def table_2_sets() -> tuple[NozzleSet, ...]:
    """Return P1's two nozzle sets as it measured them: what flow a duty of its orders meant."""
    return tuple(
        NozzleSet(
            valves=tuple(range(count)),
            curve=FlowCurve(
                duty=published.duty,
                flow_l_min=tuple(published.nozzles * each for each in published.nozzle_flow_l_min),
            ),
        )
        for published, count in zip(SETS, (SMALL_SET_VALVES, VALVES), strict=True)
    )


def eq_2_duties(flow_l_min: float) -> tuple[float, ...]:
    """Return the duty of each of P1's six valves for a flow: Eq. 2 as it stands.

    P1 states no hysteresis between its branches, and nothing outside 2 to 6 L/min: held there.

    >>> [round(duty, 3) for duty in eq_2_duties(3.0)]
    [0.737, 0.737, 0.737, 0.737, 0.0, 0.0]
    >>> [eq_2_duties(flow)[5] for flow in (3.99, 5.7)]
    [0.0, 1.0]
    """
    law = EIGHT if flow_l_min < EIGHT.flow_max_l_min else TWELVE
    duty = law.duty(min(max(flow_l_min, EIGHT.flow_min_l_min), TWELVE.flow_max_l_min))
    if duty > STAYS_OPEN_ABOVE:
        duty = 1.0
    open_count = SMALL_SET_VALVES if law is EIGHT else VALVES
    return (duty,) * open_count + (0.0,) * (VALVES - open_count)


def curve_duties(setup: Setup) -> Callable[[float], tuple[float, ...]]:
    """Return the same controller's dosing for a sprayer that Eq. 2 is not of: by its curve."""
    curve, count = setup.nozzle_sets[-1].curve, len(setup.boom.valves)
    return lambda flow_l_min: (allowed_duty(curve.duty_for(flow_l_min), setup.pwm),) * count


@dataclass(slots=True, kw_only=True)
class WangController:
    """One poll at a time; `plans` come out when the program has run through."""

    setup: Setup
    look_ahead_s: float
    dose: Callable[[float], tuple[float, ...]] = eq_2_duties
    last: Telemetry | None = None
    sequence: int = 0
    duty: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.duty = (0.0,) * len(self.setup.boom.valves)

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
        before, self.duty = self.duty, duty
        return SprayPlan(
            sequence=self.sequence,
            issued_s=at_s,
            duty=before,
            changes=tuple(
                TimedChange(at_s=at_s, valve=valve, duty=each, restart=False)
                for valve, each in enumerate(duty)
            ),
            lease_until_s=at_s + LEASE_S,
        )

    def _duty(self, item: Telemetry) -> tuple[float, ...]:
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
            return (0.0,) * len(self.duty)
        return self.dose(flow_for_rate(rate, speed_m_s, self.setup.boom.width_m))
