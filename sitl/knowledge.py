"""The one way from the truth to the controller: what can be known of a simulated sprayer.

Everything else of the twin keeps to itself. What a person would measure (the points of a bucket
test, the nominal lags) makes a configuration of the same sprayer; with perfect knowledge a flight
has the true law of the flow, and each valve's own lag and flow on the very sprayer that is flown.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from companion.core.boom import Boom, Valve
from companion.core.nozzle import FlowCurve, NozzleSet
from companion.core.schedule import LagModel
from companion.core.types import PwmLimits
from sitl.plant import BoardEdge
from sitl.profile import draw_scatter, flow_table

if TYPE_CHECKING:
    from collections.abc import Iterable

    from companion.core.setup import Setup
    from companion.core.types import SprayPlan, TimedChange
    from sitl.outputs import Output, TakesDuties, TakesEdges
    from sitl.plant import Edge
    from sitl.profile import PlantProfile, Pump, Scatter

# Points by which a controller is told a law: straight between them it errs by less than 1e-4.
LAW_POINTS = 161


def pwm_limits(profile: PlantProfile) -> PwmLimits:
    """Return what the valves can follow, as a configuration has it."""
    pwm = profile.pwm
    return PwmLimits(
        frequency_hz=pwm.frequency_hz,
        duty_min=pwm.duty_min,
        duty_max=pwm.duty_max,
        min_on_s=pwm.min_on_s,
        min_off_s=pwm.min_off_s,
    )


def measured_sets(profile: PlantProfile) -> tuple[NozzleSet, ...]:
    """Return the nozzle sets as a configuration has them: the points that were measured."""
    return tuple(
        NozzleSet(valves=each.valves, curve=FlowCurve(duty=each.duty, flow_l_min=each.flow_l_min))
        for each in profile.nozzle_sets
    )


def with_sprayer(setup: Setup, profile: PlantProfile) -> Setup:
    """Return a set-up that knows another sprayer's curve and PWM; the boom is the same."""
    return replace(setup, nozzle_sets=measured_sets(profile), pwm=pwm_limits(profile))


def true_sets(profile: PlantProfile) -> tuple[NozzleSet, ...]:
    """Return the nozzle sets as nobody can measure them: the law itself, in many points."""
    found = []
    for each in profile.nozzle_sets:
        duty = np.unique(
            np.concatenate((np.linspace(each.duty[0], each.duty[-1], LAW_POINTS), each.duty))
        )
        flow = each.flows_l_min(profile.flow_law, duty)
        rises = np.concatenate(([True], flow[1:] > np.maximum.accumulate(flow)[:-1] + 1e-9))
        curve = FlowCurve(duty=tuple(duty[rises].tolist()), flow_l_min=tuple(flow[rises].tolist()))
        found.append(NozzleSet(valves=each.valves, curve=curve))
    return tuple(found)


def boom(profile: PlantProfile, *, height_m: float = 3.5, forward_m: float = 0.0) -> Boom:
    """Return the boom with its strips side by side, valve 0 at the left."""
    strips = profile.strips
    valves = tuple(
        Valve(
            name=str(number + 1),
            right_m=strip.right_m,
            forward_m=forward_m,
            width_m=strip.width_m,
            channel=9 + number,
        )
        for number, strip in enumerate(strips)
    )
    return Boom(width_m=profile.boom_width_m, valves=valves, height_m=height_m)


def lags(profile: PlantProfile, shift_s: float = 0.0) -> LagModel:
    """Return the true lags of a valve that is `shift_s` later than the nominal one, no output."""
    if profile.makes_flow is not None:
        return _pump_lags(profile, profile.makes_flow)
    lag_s = profile.mean_lag_s + shift_s
    return LagModel(
        on_s=lag_s,
        off_s=lag_s,
        up_s=lag_s,
        down_s=lag_s,
        on_start_s=profile.dead_open_s + shift_s,
        off_end_s=profile.dead_close_s + profile.closing_s + shift_s,
        output_s=0.0,
    )


def _pump_lags(profile: PlantProfile, pump: Pump) -> LagModel:
    """Return the lags of a pump: dead time and time constant, for steps of any size.

    An exponential is below 2 % after ln(50) time constants.
    """
    up_s, down_s = pump.dead_s + pump.up_s, pump.dead_s + pump.down_s
    if not pump.shut_off:
        return LagModel(
            on_s=up_s,
            off_s=down_s,
            up_s=up_s,
            down_s=down_s,
            on_start_s=pump.dead_s,
            off_end_s=pump.dead_s + math.log(50.0) * pump.down_s,
            output_s=0.0,
        )
    return LagModel(
        on_s=profile.dead_open_s + 0.5 * profile.ramp_s,
        off_s=profile.dead_close_s + 0.5 * profile.closing_s,
        up_s=up_s,
        down_s=down_s,
        on_start_s=profile.dead_open_s,
        off_end_s=profile.dead_close_s + profile.closing_s,
        output_s=0.0,
    )


def perfect_setup(setup: Setup, profile: PlantProfile, *, seed: int, output_s: float) -> Setup:
    """Return a set-up that knows this very sprayer, for a flight with `FlightOptions.knows`.

    Its lags are those of the latest valve; `KnowingOutput` has the others wait for it, which is
    the same as each valve ordered by its own. What is judged is the flow at the nozzle: so it makes
    no offset for the wind.
    """
    latest_s = max(_scatter(profile, seed).shift_s) if profile.makes_flow is None else 0.0
    known = {frozenset(each.valves): each for each in true_sets(profile)}
    return replace(
        setup,
        lag=replace(lags(profile, latest_s), output_s=output_s),
        nozzle_sets=tuple(known.get(frozenset(each.valves), each) for each in setup.nozzle_sets),
        pwm=pwm_limits(profile),
        drift=None,
    )


def _scatter(profile: PlantProfile, seed: int) -> Scatter:
    """Return how the valves of the sprayer of a seed differ: what the plant itself draws first."""
    return draw_scatter(profile, np.random.default_rng(seed))


class KnowingOutput:
    """An output path to a sprayer of which each valve's own flow is known."""

    def __init__(self, output: Output, plant: Waiting, *, seed: int) -> None:
        self._output = output
        self._plant = plant
        self._scale = _scatter(plant.profile, seed).flow_scale
        self._flows = flow_table(plant.profile)

    @property
    def orders(self) -> list[TimedChange]:
        """Return the changes carried out so far."""
        return self._output.orders

    def submit(self, plan: SprayPlan, *, now_s: float) -> None:
        """Give each valve the duty at which it delivers what the nominal one would."""
        duty = list(plan.duty)
        first = tuple(self._own(valve, duty) for valve in range(len(duty)))
        changes = []
        for change in plan.changes:
            duty[change.valve] = change.duty
            changes.append(replace(change, duty=self._own(change.valve, duty)))
        self._output.submit(replace(plan, duty=first, changes=tuple(changes)), now_s=now_s)

    def finish(self, end_s: float) -> None:
        """Carry out all until `end_s`."""
        self._output.finish(end_s)
        self._plant.flush()

    def _own(self, valve: int, duty: list[float]) -> float:
        wanted = duty[valve]
        if not wanted > 0.0:
            return 0.0
        active = sum(each > 0.0 for each in duty)
        flow_ml_s = self._flows.mean_ml_s(wanted, active) / self._scale[valve]
        return self._flows.duty_for(flow_ml_s, active)


class Waiting:
    """A plant each valve of which is as late as the latest one."""

    def __init__(self, profile: PlantProfile, *, seed: int) -> None:
        self.profile = profile
        shift_s = _scatter(profile, seed).shift_s
        self._wait_s = [max(shift_s) - each for each in shift_s]
        self._count = 0

    def flush(self) -> None:
        """Hand on all that waits: no more will come."""
        self._hand_on(math.inf)

    def _hand_on(self, until_s: float) -> None:
        raise NotImplementedError


class WaitingForEdges(Waiting):
    """Takes edges and hands them on in order of time, each valve's later by its own wait."""

    def __init__(self, plant: TakesEdges, *, seed: int) -> None:
        super().__init__(plant.profile, seed=seed)
        self._plant = plant
        self._due: list[tuple[float, int, Edge]] = []

    def record(self, edges: Iterable[Edge]) -> None:
        """Take down edges; what may still be overtaken waits."""
        until_s = -math.inf
        for edge in edges:
            until_s, at_s = edge.at_s, edge.at_s + self._wait_s[edge.valve]
            self._count += 1
            heapq.heappush(
                self._due, (at_s, self._count, BoardEdge(at_s, edge.valve, edge.is_open, edge.duty))
            )
        self._hand_on(until_s)

    def _hand_on(self, until_s: float) -> None:
        while self._due and self._due[0][0] <= until_s:
            self._plant.record((heapq.heappop(self._due)[2],))


class WaitingForDuties(Waiting):
    """Takes changes of duty and hands them on in order of time, likewise."""

    def __init__(self, plant: TakesDuties, *, seed: int) -> None:
        super().__init__(plant.profile, seed=seed)
        self._plant = plant
        self._due: list[tuple[float, int, int, float]] = []

    def record_change(self, at_s: float, valve: int, duty: float) -> None:
        """Take down a change."""
        self._count += 1
        heapq.heappush(self._due, (at_s + self._wait_s[valve], self._count, valve, duty))
        self._hand_on(at_s)

    def _hand_on(self, until_s: float) -> None:
        while self._due and self._due[0][0] <= until_s:
            at_s, _, valve, duty = heapq.heappop(self._due)
            self._plant.record_change(at_s, valve, duty)
