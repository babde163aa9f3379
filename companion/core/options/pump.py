"""A pump on a motor's output: it makes the flow, or it supplies valves that do.

A pump that makes the flow (`modulates`) is one more valve to the laws of the schedule: its route is
that of the whole boom, its duty the motor's fraction, its lags are its own. The valves, where
there are any, are on-off sections then. Whatever the laws say, the last word has
`behind_path`: the pump never runs while there is no way out for what it pumps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from companion.core.boom import Boom
from companion.core.crossings import Crossing, Route, rate_at
from companion.core.nozzle import FlowCurve, NozzleSet, dosing_of, overdrive_of, speed_soon
from companion.core.options.whole_boom import boom_route, bridged
from companion.core.schedule import LagModel, Timing, resolve, schedule, sticky_border_s
from companion.core.types import (
    DriveChange,
    DrivePlan,
    Method,
    PwmLimits,
    SprayPlan,
    TimedChange,
    VehicleState,
)

Control = Literal["modulates", "constant"]
# What lets out what is pumped: the valves alone, a return valve beside them, or nozzles that
# nothing shuts.
PumpOutlet = Literal["valves", "return", "always"]

# An ESC takes a pulse each 20 ms.
FRAME_HZ = 50.0
# A first-order flow stands within 2 % after so many time constants.
SETTLED_TIMES = 4.0
# Steps of the sections nearer to each other than this part of the time constant are one step.
MERGE_SHARE = 0.25
MERGE_MIN_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Pump:
    """What is measured of a pump; fractions are of its range, from stop (0) to its end (1).

    `curve` is its flow by fraction, for one that modulates. `run_fraction` is where a constant
    one runs. In `lag`, `on_start_s` is from stop to first flow, `off_end_s` from the order to
    stop until nothing comes any more.
    """

    control: Control
    outlet: PumpOutlet
    lag: LagModel
    curve: FlowCurve | None = None
    fraction_min: float = 0.0
    run_fraction: float = 0.0

    def __post_init__(self) -> None:
        if (self.control == "modulates") != (self.curve is not None):
            raise ValueError("a pump that modulates has a curve, and no other")
        if not 0.0 <= self.fraction_min < 1.0:
            raise ValueError(f"fraction_min must lie in [0, 1), got {self.fraction_min}")
        if self.control == "constant" and not 0.0 < self.run_fraction <= 1.0:
            raise ValueError(f"run_fraction must lie in (0, 1], got {self.run_fraction}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Pumping:
    """A modulating pump as the laws of dosing see it: a set-up with one valve, the motor."""

    pump: Pump
    boom: Boom
    nozzle_sets: tuple[NozzleSet, ...]
    pwm: PwmLimits
    lag: LagModel
    method: Method
    timing: Timing
    valve_timing: Timing
    rate_max_l_ha: float | None

    @classmethod
    def of(
        cls,
        pump: Pump,
        boom: Boom,
        *,
        method: Method,
        look_ahead_s: float,
        valve_timing: Timing,
        rate_max_l_ha: float | None,
    ) -> Pumping | None:
        """Return how the flow is made; None where the pump only supplies it."""
        if pump.curve is None:
            return None
        pwm = PwmLimits(
            frequency_hz=FRAME_HZ,
            duty_min=pump.fraction_min,
            duty_max=1.0,
            min_on_s=0.0,
            min_off_s=0.0,
        )
        timing = Timing.of(method, pump.lag, look_ahead_s=look_ahead_s, period_s=pwm.period_s)
        if method is Method.SCHEDULED:
            timing = _by_outlet(pump, timing, valve_timing)
        return cls(
            pump=pump,
            boom=boom,
            nozzle_sets=(NozzleSet(valves=(0,), curve=pump.curve),),
            pwm=pwm,
            lag=pump.lag,
            method=method,
            timing=timing,
            valve_timing=valve_timing,
            rate_max_l_ha=rate_max_l_ha,
        )

    @property
    def early_s(self) -> float:
        """Return how much sooner than by its own lag a valve opens for the pump's start."""
        if self.pump.outlet != "valves" or self.method is not Method.SCHEDULED:
            return 0.0
        return max(self.timing.on_s - self.valve_timing.on_s, 0.0)

    @property
    def early_border_s(self) -> float:
        """Return the same at the border."""
        if self.pump.outlet != "valves" or self.method is not Method.SCHEDULED:
            return 0.0
        return max(self.timing.border_on_s - self.valve_timing.border_on_s, 0.0)


def _by_outlet(pump: Pump, own: Timing, valve: Timing) -> Timing:
    """Return the pump's leads where valves make the edges of what is sprayed.

    It stops with the last valve. With a return valve it stands at its flow before the first one
    opens; without one it starts as that valve opens.
    """
    if pump.outlet == "always":
        return own
    shut = replace(own, off_s=valve.off_s, border_off_s=valve.border_off_s)
    if pump.outlet == "valves":
        return shut
    lag = pump.lag
    rise_s = SETTLED_TIMES * lag.up_time_s or 2.0 * (lag.on_s - lag.on_start_s)
    ready_s = lag.on_start_s + rise_s + lag.output_s + max(valve.on_s, valve.border_on_s)
    return replace(shut, on_s=ready_s, border_on_s=ready_s)


def sections(
    pumping: Pumping, routes: tuple[Route, ...], *, ran_s: float, was_early: bool, now_s: float
) -> tuple[tuple[Route, ...], bool]:
    """Return the routes of on-off valves, and whether the first one opens ahead of the flow.

    Without a return valve the pump can only start behind an open valve. The first valve to open
    does so early enough for the pump's first flow to be in time, if the pump has stood still for
    long enough that nothing comes out before: `ran_s` is when something was last to flow, by the
    orders. `was_early` says that a valve is open ahead of it already.
    """
    dwell_s = pumping.valve_timing.dwell_min_s
    shut = tuple(_on_off(route, dwell_s) for route in routes)
    is_open = any(_is_open_at(route, now_s) for route in shut)
    is_dry = now_s - ran_s >= pumping.lag.off_end_s
    is_early = not is_open and (was_early or is_dry) and pumping.early_s > 0.0
    if not is_early:
        return shut, False
    starts = [_start_s(route, now_s) for route in shut]
    first_s = min(starts)
    return tuple(
        _opened_early(route, now_s, pumping) if start_s <= first_s else route
        for route, start_s in zip(shut, starts, strict=True)
    ), True


def _on_off(route: Route, dwell_s: float) -> Route:
    """Return where a valve is open and where it is shut, without stays too short for it."""
    made: list[Crossing] = []
    for step in route:
        is_open = bool(step.rate_l_ha)
        if (
            not made
            or (made[-1].rate_l_ha is not None) != is_open
            or made[-1].outside != step.outside
        ):
            made.append(step if is_open else step._replace(rate_l_ha=None))
    return resolve(tuple(made), dwell_s)[0]


def _is_open_at(route: Route, now_s: float) -> bool:
    is_open = route[0].rate_l_ha is not None
    for step in route[1:]:
        if step.at_s <= now_s:
            is_open = step.rate_l_ha is not None
    return is_open


def _start_s(route: Route, now_s: float) -> float:
    ahead = (step.at_s for step in route[1:] if step.rate_l_ha is not None and step.at_s > now_s)
    return next(ahead, float("inf"))


def _opened_early(route: Route, now_s: float, pumping: Pumping) -> Route:
    """Return the route with its next opening sooner: what lies ahead of it is shut anyway.

    Outside too: what comes out is the pump's, and its start is bound to the border.
    """
    for i, step in enumerate(route):
        if i and step.rate_l_ha is not None and step.at_s > now_s:
            first = i - 1
            while first > 0 and route[first - 1].rate_l_ha is None:
                first -= 1
            by_s = pumping.early_border_s if route[i - 1].outside else pumping.early_s
            at_s = max(step.at_s - by_s, route[first].at_s)
            shut = (each for each in route[first + 1 : i] if each.at_s < at_s)
            return (*route[: first + 1], *shut, step._replace(at_s=at_s), *route[i + 1 :])
    return route


def on_off(rate_l_ha: float, speed_m_s: float) -> float:  # noqa: ARG001
    """Return the duty of an on-off valve."""
    return 1.0 if rate_l_ha > 0.0 else 0.0


def pump_route(pumping: Pumping, routes: tuple[Route, ...]) -> Route:
    """Return the pump's route: the whole boom's, of what the valves really do."""
    lag, timing = pumping.lag, pumping.timing
    dwell_s = pumping.valve_timing.dwell_min_s
    merge_s = max(MERGE_SHARE * max(lag.up_time_s, lag.down_time_s), MERGE_MIN_S)
    sprayed = tuple(_where_open(route, _on_off(route, dwell_s)) for route in routes)
    if pumping.pump.outlet == "always":  # nothing shuts the one nozzle that is outside
        return boom_route(sprayed, pumping.boom, merge_s=merge_s, shuts_outside=True)
    whole = boom_route(sprayed, pumping.boom, merge_s=merge_s)
    return bridged(whole, timing.on_s)


def _where_open(route: Route, on: Route) -> Route:
    """Return the rates of a route where its on-off route is open, and nothing elsewhere."""
    steps = {step.at_s: step for step in (*route, *on)}
    made: list[Crossing] = []
    for at_s in sorted(steps):
        rate = (rate_at(route, at_s) or None) if _is_open_at(on, at_s) else None
        here = steps[at_s]._replace(rate_l_ha=rate)
        if not (made and here.is_as(made[-1])):
            made.append(here)
    return tuple(made)


# Plans of motors: what is in force, where a pump may run, what of it comes out of the nozzles.

# A move of the motor by less is a trim, as on a valve's driver board.
RESTART_FRACTION = 0.02


def as_drive(fraction: float, changes: Sequence[TimedChange]) -> DrivePlan:
    """Return a motor's plan from the changes of duty that the schedule made for it."""
    return DrivePlan(
        fraction=fraction,
        changes=tuple(DriveChange(at_s=each.at_s, fraction=each.duty) for each in changes),
    )


def behind_path(plan: SprayPlan, drive: DrivePlan) -> DrivePlan:
    """Return the drive stopped wherever no valve of the plan is open: no way out, no pump.

    >>> off = TimedChange(at_s=0.2, valve=0, duty=0.0)
    >>> plan = SprayPlan(sequence=1, issued_s=0.0, duty=(1.0,), changes=(off,), lease_until_s=0.3)
    >>> [change.at_s for change in behind_path(plan, DrivePlan(fraction=0.5)).changes]
    [0.2]
    """
    # At one moment the valves go first: an opening one is open for the pump that starts with it.
    times = {change.at_s for change in plan.changes} | {change.at_s for change in drive.changes}
    duty = list(plan.duty)
    start = drive.fraction if any(duty) else 0.0
    made: list[DriveChange] = []
    stands = start
    valves = iter(plan.changes)
    ahead = next(valves, None)
    for at_s in sorted(times):  # up to the lease and beyond: its end is the executor's to mind
        while ahead is not None and ahead.at_s <= at_s:
            duty[ahead.valve] = ahead.duty
            ahead = next(valves, None)
        wanted = drive.at(at_s) if any(duty) else 0.0
        if wanted != stands:
            made.append(DriveChange(at_s=at_s, fraction=wanted))
            stands = wanted
    return DrivePlan(fraction=start, changes=tuple(made))


def constant_drive(pump: Pump, plan: SprayPlan) -> DrivePlan:
    """Return the plan of a pump that supplies valves: it runs wherever it may."""
    drive = DrivePlan(fraction=pump.run_fraction)
    return drive if pump.outlet == "return" else behind_path(plan, drive)


def liquid_plan(plan: SprayPlan | None, outlet: PumpOutlet) -> SprayPlan | None:
    """Return the plan of one valve that is the pump: what of its flow comes out of the nozzles."""
    if plan is None:
        return None
    drive = plan.drives[0] if plan.drives else DrivePlan(fraction=0.0)
    if outlet == "return":
        drive = behind_path(plan, drive)
    changes = []
    before = drive.fraction
    for change in drive.changes:
        moved = abs(change.fraction - before)
        is_new = (before == 0.0) != (change.fraction == 0.0) or moved >= RESTART_FRACTION
        changes.append(TimedChange(at_s=change.at_s, valve=0, duty=change.fraction, restart=is_new))
        before = change.fraction
    return SprayPlan(
        sequence=plan.sequence,
        issued_s=plan.issued_s,
        duty=(drive.fraction,),
        changes=tuple(changes),
        lease_until_s=plan.lease_until_s,
    )


# What the motors do: the pump by the laws of the valves, the atomisers by the flow to come.


def modulated(
    pumping: Pumping,
    state: VehicleState,
    plan: SprayPlan,
    routes: tuple[Route, ...],
    *,
    in_force: float,
    speed_m_s: float,
    skew: float,
    border_buffer_m: float,
) -> DrivePlan:
    """Return the plan of a pump that makes the flow, behind the valves' `plan`."""
    found = schedule(
        pump_route(pumping, routes),
        valve=0,
        timing=pumping.timing,
        dosing=dosing_of(pumping, 0, skew, state.rate_percent),
        in_force=in_force,
        speed_soon_m_s=speed_soon(pumping, state, speed_m_s),
        now_s=plan.issued_s,
        until_s=plan.lease_until_s,
        overdrive=overdrive_of(pumping, 0),
        sticky_border_s=sticky_border_s(border_buffer_m, speed_m_s),
    )
    drive = as_drive(in_force, found.changes)
    return behind_path(plan, drive) if pumping.pump.outlet == "valves" else drive


def liquid_of(pumping: Pumping | None, plan: SprayPlan | None) -> SprayPlan | None:
    """Return the plan that the meter's flow follows: the valves', or that of the pump."""
    return plan if pumping is None else liquid_plan(plan, pumping.pump.outlet)
