"""Valves tracked in flight: named when one blocks, left alone when none does, and what it is worth.

    python -m tests.bench.valve_tracking [--seeds 8] [--steps]

Each seed is another sprayer whose valves scatter (1 sd: 2 % in flow, 5 % in lag), over spots of 3 m
by the width of a valve, at 2 m/s, once healthy and once with a valve that loses 15 % after a
quarter of the flight. `--steps` measures instead what tracking adds to a step of the core with 24
valves over 22 500 plots, a meter count with each, in processor time.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace
from time import thread_time

import numpy as np
import shapely

from analysis.evaluation import evaluate
from companion.core.controller import Memory, step
from companion.core.options.valve_tracking import TrackMemory, ValveTracking
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from companion.core.types import FlowReport, VehicleState
from sitl.anyang import demo_trajectory
from sitl.flight import FlightResult, fly
from sitl.liquid_faults import LiquidFault, LiquidFaultKind
from sitl.profile import draw_scatter, load_profile
from tests.bench.fields import grid_setup
from tests.bench.figures import collector_as_in_flight
from tests.bench.sprayers import PLANT, options_of, sprayer_setup
from tests.bench.steps import over_grid

SPEED_M_S, RATE_L_HA, SPOT_M, VALVE_M = 2.0, 75.0, 3.0, 1.0
BLOCKED, LOST_SHARE = 2, 0.15


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracked:
    """One flight, what was tracked at its end, and by how much the valves truly differ."""

    result: FlightResult
    track: TrackMemory | None
    true: tuple[float, ...]


def spots(seed: int) -> Setup:
    """Return the example's sprayer over spots, half of which are sprayed."""
    base, rng = sprayer_setup(PLANT, "gpio", SPEED_M_S), np.random.default_rng(seed)
    west, south, east, north = base.prescription.bounds_m
    zones = []
    for column in range(round((east - west) / SPOT_M)):
        for row in range(round((north - south) / VALVE_M)):
            left, low = west + SPOT_M * column, south + VALVE_M * row
            zones.append(
                Zone(
                    name=f"{column}-{row}",
                    polygon=shapely.box(left, low, left + SPOT_M, low + VALVE_M),
                    rate_l_ha=float(rng.choice([0.0, RATE_L_HA])),
                )
            )
    field = Prescription(zones, boundary=shapely.box(west, south, east, north))
    return replace(base, prescription=field)


def tracked(seed: int, *, is_blocked: bool, settings: ValveTracking | None) -> Tracked:
    """Fly once; `settings` None tracks nothing."""
    path, profile = demo_trajectory(SPEED_M_S, seed), load_profile(PLANT)
    begun_s, ended_s = float(path.time_s[0]), float(path.time_s[-1])
    block = LiquidFault(
        kind=LiquidFaultKind.CLOG,
        from_s=begun_s + 0.25 * (ended_s - begun_s),
        share=LOST_SHARE,
        valve=BLOCKED,
    )
    options = replace(
        options_of("gpio", seed), meter_rate_hz=50.0, liquid_faults=(block,) if is_blocked else ()
    )
    last: list[TrackMemory | None] = [None]

    def on_step(memory: Memory, _state: VehicleState | None, _now_s: float) -> None:
        last[0] = memory.watched.track

    setup = replace(spots(seed), valve_tracking=settings)
    result = fly(setup, path, profile, options, speed_m_s=SPEED_M_S, on_step=on_step)
    scale = np.array(draw_scatter(profile, np.random.default_rng(seed)).flow_scale)
    if is_blocked:
        scale[BLOCKED] *= 1.0 - LOST_SHARE
    return Tracked(result=result, track=last[0], true=tuple((scale / scale.mean()).tolist()))


def step_cost_us(settings: ValveTracking | None, *, seed: int = 1) -> list[float]:
    """Return the microseconds of processor time of every step that sprays."""
    setup = replace(grid_setup(150, 150, valve_count=24, seed=seed), valve_tracking=settings)
    memory, volume_ml, before_s, taken = Memory(), 0.0, math.inf, []
    with collector_as_in_flight():
        for moment in over_grid(setup, 900.0, seed=seed):
            plan, now_s = memory.plan, moment.now_s
            if plan is not None:
                flow = setup.nozzle_sets[0].curve.flow_for(sum(plan.duty_at(now_s)) / 24.0)
                volume_ml += flow / 0.06 * max(now_s - before_s, 0.0)
            before_s = now_s
            report = FlowReport(received_s=now_s, volume_ml=volume_ml)
            state = replace(moment.state, flow=report)
            begun = thread_time()
            decision, memory = step(setup, state, memory, now_s)
            if any(rate is not None for rate in decision.rate_l_ha):
                taken.append(1e6 * (thread_time() - begun))
    return taken


def steps() -> None:
    """Print what a step costs without tracking and with it."""
    for name, settings in (("without", None), ("with", ValveTracking())):
        taken = np.array(step_cost_us(settings))
        print(  # noqa: T201
            f"24 valves, {name} tracking: mean {taken.mean():.0f} us, "
            f"99 % {np.quantile(taken, 0.99):.0f} us of processor time, {len(taken)} steps"
        )


def main() -> None:
    """Print a line a flight."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--steps", action="store_true")
    asked = parser.parse_args()
    if asked.steps:
        steps()
        return
    for seed in range(1, asked.seeds + 1):
        for is_blocked in (False, True):
            plain = tracked(seed, is_blocked=is_blocked, settings=None)
            own = tracked(seed, is_blocked=is_blocked, settings=ValveTracking())
            before = evaluate(plain.result.record).misapplied_percent
            after = evaluate(own.result.record).misapplied_percent
            assert own.track is not None
            shares = own.track.nozzles.shares or (1.0,) * len(own.true)
            named = [
                f"valve {(finding.valve or 0) + 1} {finding.text}" for finding in own.track.findings
            ]
            print(  # noqa: T201
                f"seed {seed}, {'valve 3 loses 15 %' if is_blocked else 'healthy'}: misapplied "
                f"{before:.2f} % without, {after:.2f} % with; largest factor error "
                f"{max(abs(a / b - 1.0) for a, b in zip(shares, own.true, strict=True)):.3f}, "
                f"true spread {max(abs(each - 1.0) for each in own.true):.3f}; {named or 'none'}",
                flush=True,
            )


if __name__ == "__main__":
    main()
