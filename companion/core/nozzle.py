"""From rate to flow to duty: what the nozzle sets deliver, the boom's skew, the speed to come.

The curve is measured, not assumed: flow against duty is not a straight line (P1 Table 2), and
P1's Eq. 2 contradicts its own table by up to 22 % of flow. It is here as a preset, `FLOW_LAWS`.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

from companion.core.boom import Boom
from companion.core.braking import speed_after
from companion.core.crossings import Route
from companion.core.schedule import Dosing, LagModel, Overdrive, Timing
from companion.core.types import Method, PwmLimits, VehicleState

# A flow as far outside the measured range as a bucket test errs is taken as inside.
RANGE_SLACK = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowCurve:
    """Measured flow of a whole nozzle set against duty: straight lines between the points.

    Strictly increasing, or refused. Nothing is known between two points, and a smooth curve
    through the scatter of a bucket test makes up bends (on P1's Table 2 a slope of 0 at the first
    point, which cost 13 % of the flow at 1.8 L/min); smoothing belongs to `calibrate flow`.

    >>> curve = FlowCurve(duty=(0.2, 0.5, 1.0), flow_l_min=(1.0, 2.0, 4.0))
    >>> round(curve.duty_for(2.0), 6)
    0.5
    """

    duty: tuple[float, ...]
    flow_l_min: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.duty) != len(self.flow_l_min) or len(self.duty) < 2:
            raise ValueError("a flow curve needs at least two (duty, flow) points")
        for name, values in (("duty", self.duty), ("flow_l_min", self.flow_l_min)):
            if not all(a < b for a, b in pairwise(values)):
                raise ValueError(f"{name} must be strictly increasing, got {list(values)}")
        if not all(0.0 <= duty <= 1.0 for duty in self.duty):
            raise ValueError(f"duty must lie in [0, 1], got {list(self.duty)}")
        if not self.flow_l_min[0] >= 0.0 or not self.flow_l_min[-1] < 1e6:
            raise ValueError(f"flow_l_min must be finite and not negative: {self.flow_l_min}")

    def duty_for(self, flow_l_min: float) -> float:
        """Return the duty that gives `flow_l_min`, held to the measured range.

        A demand below half of the smallest measured flow closes the valve; the curve says
        nothing there, and zero is nearer to it than the smallest flow.
        """
        flows = self.flow_l_min
        if not flow_l_min >= flows[0] / 2 or flow_l_min <= 0.0:
            return 0.0
        if flow_l_min <= flows[0]:
            return self.duty[0]
        if flow_l_min >= flows[-1]:
            return self.duty[-1]
        i = bisect_right(flows, flow_l_min) - 1
        share = (flow_l_min - flows[i]) / (flows[i + 1] - flows[i])
        return self.duty[i] + (self.duty[i + 1] - self.duty[i]) * share

    def delivers(self, flow_l_min: float) -> bool:
        """Return whether a flow lies in the measured range, give or take 2 %; 0 is closed.

        >>> curve = FlowCurve(duty=(0.2, 0.5, 1.0), flow_l_min=(1.0, 2.0, 4.0))
        >>> [curve.delivers(flow) for flow in (0.0, 0.9, 0.99, 4.05, 4.1)]
        [True, False, True, True, False]
        """
        low, high = (1.0 - RANGE_SLACK) * self.flow_l_min[0], self.flow_l_min[-1]
        return flow_l_min == 0.0 or low <= flow_l_min <= (1.0 + RANGE_SLACK) * high

    def flow_for(self, duty: float) -> float:
        """Return the flow at `duty`: the exact inverse of `duty_for`.

        Below the first measured duty the flow falls in proportion to zero.

        >>> curve = FlowCurve(duty=(0.2, 0.5, 1.0), flow_l_min=(1.0, 2.0, 4.0))
        >>> round(curve.flow_for(curve.duty_for(1.7)), 6)
        1.7
        """
        if not duty > 0.0:
            return 0.0
        if duty <= self.duty[0]:
            return self.flow_l_min[0] * duty / self.duty[0] if self.duty[0] > 0.0 else 0.0
        if duty >= self.duty[-1]:
            return self.flow_l_min[-1]
        flows = self.flow_l_min
        i = bisect_right(self.duty, duty) - 1
        share = (duty - self.duty[i]) / (self.duty[i + 1] - self.duty[i])
        return flows[i] + (flows[i + 1] - flows[i]) * share


@dataclass(frozen=True, slots=True, kw_only=True)
class NozzleSet:
    """Valves (indices from the left) that spray together, and their measured curve.

    `shares` are what each delivers at a duty over the mean of the set; empty: all the same.
    """

    valves: tuple[int, ...]
    curve: FlowCurve
    shares: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.valves or len(set(self.valves)) != len(self.valves):
            raise ValueError(f"a nozzle set needs valves, each once, got {self.valves}")
        if self.shares and len(self.shares) != len(self.valves):
            raise ValueError("a nozzle set needs a share of each of its valves, or none")
        if not all(0.2 <= share <= 5.0 for share in self.shares):
            raise ValueError(f"shares of a nozzle set must lie in [0.2, 5], got {self.shares}")

    @classmethod
    def with_factors(
        cls, valves: tuple[int, ...], curve: FlowCurve, factors: Sequence[float]
    ) -> NozzleSet:
        """Return a set whose valves differ; `factors` are of all valves of the boom.

        The curve is of the set's whole flow, so that only ratios within the set count.

        >>> curve = FlowCurve(duty=(0.0, 1.0), flow_l_min=(0.0, 2.0))
        >>> NozzleSet.with_factors((0, 2), curve, (0.9, 7.0, 1.1)).shares
        (0.9, 1.1)
        """
        own = [factors[valve] for valve in valves]
        if all(factor == own[0] for factor in own):
            return cls(valves=valves, curve=curve)
        mean = sum(own) / len(own)
        return cls(valves=valves, curve=curve, shares=tuple(factor / mean for factor in own))

    def share(self, valve: int) -> float:
        """Return what a valve of the set delivers over the mean of the set."""
        return self.shares[self.valves.index(valve)] if self.shares else 1.0

    @property
    def flow_min_l_min(self) -> float:
        """Return the smallest measured flow."""
        return self.curve.flow_l_min[0]

    @property
    def flow_max_l_min(self) -> float:
        """Return the largest measured flow."""
        return self.curve.flow_l_min[-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlowLaw:
    """A published straight line from the flow of a set of so many nozzles to its duty.

    duty [%] = `slope` * flow [L/min] + `offset`, stated from `flow_min_l_min` to `flow_max_l_min`;
    `curve_l_min` is what a controller uses of it.
    """

    nozzles: int
    slope: float
    offset: float
    flow_min_l_min: float
    flow_max_l_min: float
    curve_l_min: tuple[float, float]

    def duty(self, flow_l_min: float) -> float:
        """Return the duty, 0 to 1, that the law has for a flow.

        >>> round(FLOW_LAWS["wang-2024-eq2"][1].duty(5.0), 5)
        0.78476
        """
        return (self.slope * flow_l_min + self.offset) / 100.0

    @property
    def curve(self) -> FlowCurve:
        """Return the law as a curve of two points: exact between them, held beyond them."""
        low, high = self.curve_l_min
        return FlowCurve(duty=(self.duty(low), self.duty(high)), flow_l_min=(low, high))


# P1 Eq. 2: twelve nozzles from 4 to 6 L/min, eight (valves 5 and 6 closed) from 2 to below 4. Where
# they meet each goes on as far as the hysteresis of `choose_set` needs it: 3.7 down, 4.1 up.
FLOW_LAWS = {
    "wang-2024-eq2": (
        FlowLaw(
            nozzles=8,
            slope=18.73,
            offset=17.557,
            flow_min_l_min=2.0,
            flow_max_l_min=4.0,
            curve_l_min=(2.0, 4.1),
        ),
        FlowLaw(
            nozzles=12,
            slope=17.67,
            offset=-9.874,
            flow_min_l_min=4.0,
            flow_max_l_min=6.0,
            curve_l_min=(3.7, 6.0),
        ),
    )
}


# P1: eight nozzles below 4 L/min, twelve above; the hysteresis keeps a flow near 4 from
# switching sets back and forth: 3.7 L/min down, 4.1 up for P1's sets, the smaller of which
# delivers 4.272 L/min when open (P1 Table 2).
SET_DOWN_FRACTION = 3.7 / 4.0
SET_UP_FRACTION = 4.1 / 4.0
SET_CHANGE_SHARE = 4.0 / 4.272


def choose_set(sets: tuple[NozzleSet, ...], flow_l_min: float, *, current: int) -> int:
    """Return the index of the set to use for `flow_l_min`, with hysteresis around `current`.

    Sets are ordered from the smallest to the largest flow. The smaller of two neighbours is used
    as far as it reaches: fewer valves at a higher duty spray more evenly.
    """
    index = min(max(current, 0), len(sets) - 1)
    while index + 1 < len(sets):
        if not flow_l_min > set_change_l_min(sets[index], sets[index + 1]) * SET_UP_FRACTION:
            break
        index += 1
    while index > 0:
        if not flow_l_min < set_change_l_min(sets[index - 1], sets[index]) * SET_DOWN_FRACTION:
            break
        index -= 1
    return index


def set_change_l_min(small: NozzleSet, large: NozzleSet) -> float:
    """Return the flow around which two sets change: not below what the larger one can deliver."""
    reached_l_min = SET_CHANGE_SHARE * small.flow_max_l_min
    return max(reached_l_min, large.flow_min_l_min / SET_DOWN_FRACTION)


def allowed_duty(duty: float, limits: PwmLimits) -> float:
    """Return the nearest duty that can be delivered: closed, the PWM window, or above it.

    Between `duty_max` and open no single period can be had; whole periods of the one and the
    other by turns (`PulseTrain`) have the mean that is wanted.

    >>> pwm = PwmLimits(frequency_hz=11, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
    >>> [allowed_duty(d, pwm) for d in (0.05, 0.15, 0.5, 0.93, 1.0)]
    [0.0, 0.2, 0.5, 0.93, 1.0]
    """
    if not duty >= limits.duty_min / 2 or duty <= 0.0:
        return 0.0
    return min(max(duty, limits.duty_min), 1.0)


# From application rate to flow: the speed-and-width law of every rate controller.

# 1 L/ha over 1 m of width at 1 m/s is 1e-4 L/s. In the trade's own form this is
# flow [L/min] = rate [L/ha] * speed [km/h] * width [m] / 600.
L_MIN_PER_L_HA_M2_S = 60.0 / 10_000.0


def flow_for_rate(rate_l_ha: float, speed_m_s: float, width_m: float) -> float:
    """Return the flow in L/min that puts `rate_l_ha` on a strip `width_m` wide (P1 Eq. 1).

    >>> round(flow_for_rate(rate_l_ha=15.0, speed_m_s=6.0, width_m=5.0), 3)
    2.7
    """
    return rate_l_ha * speed_m_s * width_m * L_MIN_PER_L_HA_M2_S


def rate_for_flow(flow_l_min: float, speed_m_s: float, width_m: float) -> float:
    """Return the rate in L/ha that `flow_l_min` puts down; the inverse of `flow_for_rate`.

    >>> round(rate_for_flow(flow_l_min=2.7, speed_m_s=6.0, width_m=5.0), 6)
    15.0
    """
    return flow_l_min / (speed_m_s * width_m * L_MIN_PER_L_HA_M2_S)


# Beyond these it is another prescription, not a correction by the operator in the field.
OVERRIDE_MIN_PERCENT, OVERRIDE_MAX_PERCENT = 80.0, 110.0


def is_override(percent: float) -> bool:
    """Whether the operator may ask for this percentage of what is prescribed."""
    return OVERRIDE_MIN_PERCENT <= percent <= OVERRIDE_MAX_PERCENT


def overridden(rate_l_ha: float, percent: float, limit_l_ha: float | None = None) -> float:
    """Return the rate to spray: a percentage of the prescribed one, at most what the label allows.

    At 100 %, and at what is no percentage that may be asked for, it is the prescribed one.

    >>> overridden(20.0, 110.0), overridden(38.0, 110.0, 40.0), overridden(20.0, float("nan"))
    (22.0, 40.0, 20.0)
    """
    if percent == 100.0 or not is_override(percent):
        return rate_l_ha
    rate = rate_l_ha * percent / 100.0
    return rate if limit_l_ha is None else min(rate, max(limit_l_ha, 0.0))


# ----------------------------------------------------------------------------------------- the dose

# A trim stands until the next one, 50 ms later: on average it is half of that old. A velocity is
# told late, too, and an acceleration fades in what is foretold: on logs of flown ArduCopters the
# flow came 20 to 40 ms late while they sped up and braked. 40 to 70 ms serve alike there.
TRIM_AGE_S = 0.045


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
    return abs(along) / speed_m_s


def dosing_of(setup: Sprayer, index: int, skew: float, percent: float) -> Dosing:
    """Return the function from rate and speed to the duty of a valve of the set in use.

    A valve that delivers less than the mean of its set is dosed as if the boom were wider: `skew`
    over its share.
    """
    width_m = setup.boom.width_m * skew
    duty_for, pwm, limit_l_ha = (
        setup.nozzle_sets[index].curve.duty_for,
        setup.pwm,
        setup.rate_max_l_ha,
    )
    known: dict[tuple[float, float], float] = {}  # neighbours ask for the same

    def duty(rate_l_ha: float, speed_m_s: float) -> float:
        key = (rate_l_ha, speed_m_s)
        found = known.get(key)
        if found is None:
            asked = overridden(rate_l_ha, percent, limit_l_ha)
            flow = flow_for_rate(asked, speed_m_s, width_m)
            found = known[key] = allowed_duty(duty_for(flow), pwm)
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
    braked_m_s = speed_after(
        state.stop_ahead, speed_m_s, along, state.acceleration_fade_s, acts_after_s(setup)
    )
    return min(soon_m_s, braked_m_s)


def acts_after_s(setup: Sprayer) -> float:
    """Return when what is ordered now acts, in the mean: until then a valve follows its arc."""
    return setup.timing.down_s + 0.5 * setup.pwm.period_s + TRIM_AGE_S


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
    *,
    count: int,
) -> list[Dosing]:
    """Return each valve's dosing: by the set of its rate, closed where that set lacks the valve.

    `dose` makes the dosing of a set and of a valve's share. A rate that only the sides of the boom
    meet is sprayed with the set in use: the boom's middle decides.
    """
    is_one = all(number == in_use for _, number in of_rate)
    if is_one and not sets[in_use].shares:
        members, one = sets[in_use].valves, dose(in_use, 1.0)
        if len(members) == count:
            return [one] * count
        return [one if valve in members else _shut for valve in range(count)]
    chosen = dict(of_rate)
    known: dict[tuple[int, float], Dosing] = {}

    def member(number: int, valve: int) -> Dosing:
        if valve not in sets[number].valves:
            return _shut
        key = (number, sets[number].share(valve))
        if key not in known:
            known[key] = dose(*key)
        return known[key]

    if is_one:
        return [member(in_use, valve) for valve in range(count)]

    def of_valve(valve: int) -> Dosing:
        def duty(rate_l_ha: float, speed_m_s: float) -> float:
            return member(chosen.get(rate_l_ha, in_use), valve)(rate_l_ha, speed_m_s)

        return duty

    return [of_valve(valve) for valve in range(count)]


def _shut(rate_l_ha: float, speed_m_s: float) -> float:  # noqa: ARG001
    """Return the duty of a valve that the set in use does not have."""
    return 0.0
