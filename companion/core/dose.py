"""From a rate and a speed to a duty: the boom's skew, the set's curve, the speed to come."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Protocol

from companion.core.boom import Boom
from companion.core.braking import speed_after
from companion.core.crossings import Route
from companion.core.nozzle import (
    NozzleSet,
    PwmLimits,
    allowed_duty,
    choose_set,
    flow_for_rate,
    overridden,
)
from companion.core.schedule import Dosing, LagModel, Overdrive, Timing
from companion.core.types import Method, VehicleState

# Below this share of its width across the motion, a boom that flies askew is dosed as at it: the
# flow that the law asks for would fall towards nothing while the strip is a blur.
SKEW_MIN = 0.3
# A trim stands until the next one, 50 ms later: on average it is half of that old.
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
    """Return the function from rate and speed to the duty of a valve of the set in use.

    A valve that delivers less than the mean of its set is dosed as if the boom were wider: `skew`
    over its share.
    """
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


# Which nozzle set sprays which zone: a change of set lies on the boundary, never inside a zone.

# Which set sprays which rate [L/ha], for the zones in view.
SetOfRate = tuple[tuple[float, int], ...]

# A set is kept while the flow stays within this of what was measured.
BELOW_MIN, ABOVE_MAX = 1.0 / 1.1, 1.02


def sets_ahead(
    sets: tuple[NozzleSet, ...],
    route: Route,
    *,
    in_use: int,
    before: SetOfRate,
    flow_of: Callable[[float], float],
    now_s: float,
) -> tuple[int, SetOfRate]:
    """Return the set in use, and the set of each rate on a route: chosen as it comes into view.

    Chosen once, so that the noise of the speed does not change what is ordered already; given up
    only where it can no longer deliver. `flow_of` is the boom's flow [L/min] for a rate.
    """
    if len(sets) == 1:
        return 0, ()
    known, found = dict(before), dict[float, int]()
    last = in_use
    for crossing in route:
        rate = crossing.rate_l_ha
        if not rate:
            continue
        if rate not in found:
            flow_l_min, kept = flow_of(rate), known.get(rate)
            if kept is None or not _delivers(sets[kept], flow_l_min):
                kept = choose_set(sets, flow_l_min, current=last)
            found[rate] = kept
        last = found[rate]
        # The first zone in view is entered with its own set, however far ahead it still is.
        if crossing.at_s <= now_s or len(found) == 1:
            in_use = last
    return in_use, tuple(found.items())


def _delivers(nozzles: NozzleSet, flow_l_min: float) -> bool:
    low, high = nozzles.flow_min_l_min * BELOW_MIN, nozzles.flow_max_l_min * ABOVE_MAX
    return low <= flow_l_min <= high


def dosing_by_valve(
    sets: tuple[NozzleSet, ...],
    in_use: int,
    of_rate: SetOfRate,
    dose: Callable[[int, float], Dosing],
) -> Callable[[int], Dosing]:
    """Return each valve's dosing: by the set of its rate, closed where that set lacks the valve.

    `dose` makes the dosing of a set and of a valve's share. A rate that only the sides of the boom
    meet is sprayed with the set in use: the boom's middle decides.
    """
    chosen = dict(of_rate)
    is_one = len({in_use, *chosen.values()}) == 1
    if is_one and not sets[in_use].shares:
        members, one = sets[in_use].valves, dose(in_use, 1.0)
        return lambda valve: one if valve in members else _shut
    known: dict[tuple[int, float], Dosing] = {}

    def member(number: int, valve: int) -> Dosing:
        if valve not in sets[number].valves:
            return _shut
        key = (number, sets[number].share(valve))
        if key not in known:
            known[key] = dose(*key)
        return known[key]

    if is_one:
        return partial(member, in_use)

    def of_valve(valve: int) -> Dosing:
        def duty(rate_l_ha: float, speed_m_s: float) -> float:
            return member(chosen.get(rate_l_ha, in_use), valve)(rate_l_ha, speed_m_s)

        return duty

    return of_valve


def _shut(rate_l_ha: float, speed_m_s: float) -> float:  # noqa: ARG001
    """Return the duty of a valve that the set in use does not have."""
    return 0.0
