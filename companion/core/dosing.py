"""From a rate and a speed to a duty: the boom's skew, the set's curve, the speed to come."""

from __future__ import annotations

import math
from typing import Protocol

from companion.core.boom import Boom
from companion.core.leg import speed_after
from companion.core.nozzle import NozzleSet, PwmLimits, allowed_duty
from companion.core.overdrive import Overdrive
from companion.core.rate import flow_for_rate, overridden
from companion.core.schedule import Dosing, LagModel, Timing
from companion.core.types import Method, VehicleState

# Below this share of its width across the motion, a boom that flies askew is dosed as at it: the
# flow that the law asks for would fall towards nothing while the strip is a blur.
SKEW_MIN = 0.3
# A trim stands until the next one, 50 ms later: in the mean it is half of that old.
TRIM_AGE_S = 0.025


class Sprayer(Protocol):
    """What doses: the valves of a set-up, or a pump that makes the flow of all of them."""

    @property
    def boom(self) -> Boom: ...  # noqa: D102
    @property
    def nozzle_sets(self) -> tuple[NozzleSet, ...]: ...  # noqa: D102
    @property
    def pwm(self) -> PwmLimits: ...  # noqa: D102
    @property
    def lag(self) -> LagModel: ...  # noqa: D102
    @property
    def method(self) -> Method: ...  # noqa: D102
    @property
    def timing(self) -> Timing: ...  # noqa: D102
    @property
    def rate_max_l_ha(self) -> float | None: ...  # noqa: D102


def skew_of(state: VehicleState, speed_m_s: float) -> float:
    """Return the boom's width across the motion over its width: |cos(heading - course)|."""
    if state.heading_deg is None or not speed_m_s > 0.0:
        return 1.0
    heading = math.radians(state.heading_deg)
    along = state.velocity_north_m_s * math.cos(heading)
    along += state.velocity_east_m_s * math.sin(heading)
    return max(abs(along) / speed_m_s, SKEW_MIN)


def dosing_of(setup: Sprayer, index: int, skew: float, percent: float) -> Dosing:
    """Return the function from rate and speed to the duty of a valve of the set in use."""
    width_m = setup.boom.width_m * skew
    curve, pwm = setup.nozzle_sets[index].curve, setup.pwm
    known: dict[tuple[float, float], float] = {}  # neighbours ask for the same

    def duty(rate_l_ha: float, speed_m_s: float) -> float:
        key = (rate_l_ha, speed_m_s)
        found = known.get(key)
        if found is None:
            asked = overridden(rate_l_ha, percent, setup.rate_max_l_ha)
            flow = flow_for_rate(asked, speed_m_s, width_m)
            found = known[key] = allowed_duty(curve.duty_for(flow), pwm)
        return found

    return duty


def overdrive_of(setup: Sprayer, index: int) -> Overdrive | None:
    """Return how a slow flow's changes are driven; None for one that is not slow."""
    lag, pwm = setup.lag, setup.pwm
    is_slow = max(lag.up_time_s, lag.down_time_s) > 0.0 and lag.reference == "volume"
    if setup.method is not Method.SCHEDULED or not is_slow:
        return None
    return Overdrive(
        up_time_s=lag.up_time_s,
        down_time_s=lag.down_time_s,
        duty_min=pwm.duty_min,
        duty_max=pwm.duty_max,
        flow_for=setup.nozzle_sets[index].curve.flow_for,
    )


def speed_soon(setup: Sprayer, state: VehicleState, speed_m_s: float) -> float:
    """Return the speed that a trim ordered now should ask for.

    It acts after its dead time, with the next period, and stands until the next trim. A flow that
    follows as an exponential (a pump's) keeps up with the speed if its order is ahead of it by
    the time constant, each direction by its own.
    """
    along = (
        state.velocity_east_m_s * state.acceleration_east_m_s2
        + state.velocity_north_m_s * state.acceleration_north_m_s2
    ) / speed_m_s
    timing, lag = setup.timing, setup.lag
    lead_s = timing.up_s if along > 0.0 else timing.down_s
    constant_s = min(lag.up_time_s if along > 0.0 else lag.down_time_s, lead_s)
    acts_s = lead_s - constant_s + 0.5 * setup.pwm.period_s + TRIM_AGE_S
    left = math.exp(-acts_s / state.acceleration_fade_s)
    gained_s = state.acceleration_fade_s * (1.0 - left)
    soon_m_s = max(speed_m_s + along * (gained_s + constant_s * left), 0.0)
    if state.stop_ahead is None:
        return soon_m_s
    acts_s = timing.down_s + 0.5 * setup.pwm.period_s + TRIM_AGE_S
    braked_m_s = speed_after(state.stop_ahead, speed_m_s, along, state.acceleration_fade_s, acts_s)
    return min(soon_m_s, braked_m_s)
