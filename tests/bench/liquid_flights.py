"""Plans of the controller, sprayed by sprayers whose liquid goes wrong, and watched."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from companion.core.options.flow_meter import Detection, Watching
from companion.core.options.flow_trim import FlowTrim
from companion.core.options.liquid_faults import WatchMemory, follow
from companion.core.setup import Setup
from companion.core.types import Decision, FlowReport, PressureReport, SprayPlan, VehicleState
from sitl.anyang import demo_lags, demo_setup, demo_trajectory
from sitl.flight import FlightOptions, fly, sprayer
from sitl.liquid_faults import LiquidFault, LiquidFaultKind, LiquidSensors, healthy_kpa
from sitl.profile import load_profile

Fidelity = Literal["averaged", "pulsed"]
PLANT = "wang-2024"
METER_RATE_HZ, PRESSURE_RATE_HZ = 50.0, 20.0
FORGET_STEPS = 200
DUTIES = (0.0, 0.2, 0.5, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """The plans that are sprayed, and the sprayer that sprays them."""

    speed_m_s: float
    path: int
    seed: int
    fidelity: Fidelity
    pressure: bool


@cache
def watched_setup(speed_m_s: float) -> Setup:
    """Return the example with the trim on."""
    lag = demo_lags("gpio")
    return replace(demo_setup(speed_m_s), lag=lag, flow_trim=FlowTrim())


def law(*, pressure: bool) -> Detection:
    """Return what is known of the healthy sprayer."""
    return Detection(
        pressure_duty=DUTIES if pressure else (),
        pressure_kpa=tuple(map(healthy_kpa, DUTIES)) if pressure else (),
    )


@cache
def ordered(speed_m_s: float, path: int) -> tuple[Decision, ...]:
    """Return the decisions of a healthy flight, with the trim of its own meter."""
    seen: list[Decision] = []
    fly(
        watched_setup(speed_m_s),
        demo_trajectory(speed_m_s, path),
        load_profile(PLANT),
        FlightOptions(seed=path, fidelity="averaged", meter_rate_hz=METER_RATE_HZ),
        speed_m_s=speed_m_s,
        observer=seen.append,
    )
    return tuple(seen)


def found_in(
    flight: Flight, faults: tuple[LiquidFault, ...] = (), *, until_s: float = math.inf
) -> list[tuple[float, WatchMemory]]:
    """Return (time, memory) of each step of a flight whose findings are not what they were."""
    decisions = ordered(flight.speed_m_s, flight.path)
    steps = [
        (decision.now_s, decision.plan, decision.state)
        for decision in decisions
        if decision.state is not None and decision.now_s <= until_s
    ]
    return found_over(steps, flight, faults)


def found_over(
    steps: Sequence[tuple[float, SprayPlan, VehicleState]],
    flight: Flight,
    faults: tuple[LiquidFault, ...],
) -> list[tuple[float, WatchMemory]]:
    """Spray plans by one sprayer; return (time, memory) whenever there is a new finding."""
    setup = watched_setup(flight.speed_m_s)
    watching = Watching.of(law(pressure=flight.pressure), setup.nozzle_sets, setup.lag, setup.pwm)
    start_s = steps[0][0]
    options = FlightOptions(seed=flight.seed, fidelity=flight.fidelity)
    plant, output = sprayer(load_profile(PLANT), options, start_s)
    sensors = LiquidSensors(
        plant,
        meter_rate_hz=METER_RATE_HZ,
        pressure_rate_hz=PRESSURE_RATE_HZ,
        start_s=start_s,
        faults=faults,
        seed=flight.seed,
    )
    memory, changes = WatchMemory(), []
    before_plan: SprayPlan | None = None
    flow: FlowReport | None = None
    pressure: PressureReport | None = None
    for number, (now_s, plan, told) in enumerate(steps):
        before = memory.findings
        state = replace(told, flow=flow, pressure=pressure)
        memory = follow(watching, memory, before_plan, state, index=0, now_s=now_s)
        if memory.findings != before:
            changes.append((now_s, memory))
        before_plan = plan
        output.submit(plan, now_s=now_s)
        for report in sensors.read(now_s):
            if isinstance(report, FlowReport):
                flow = report
            elif isinstance(report, PressureReport):
                pressure = report
        if number % FORGET_STEPS == 0:
            plant.forget(now_s - 1.0)
    return changes


def moved_by(fault: LiquidFault, duty: float) -> float:
    """Return by which share of the ordered flow a fault moves the total at a duty."""
    measured = load_profile(PLANT).nozzle_sets[-1]
    flow = float(np.interp(duty, measured.duty, measured.flow_l_min))
    full = measured.flow_max_l_min
    if fault.kind is LiquidFaultKind.LEAK:
        return fault.share * full / flow
    if fault.kind is LiquidFaultKind.STUCK_OPEN:
        return (full - flow) / 6.0 / flow
    if fault.kind is LiquidFaultKind.STUCK_CLOSED:
        return 0.146
    if fault.kind in (LiquidFaultKind.CLOG, LiquidFaultKind.SUPPLY):
        return fault.share / (1.0 if fault.valve is None else 6.0)
    return 1.0
