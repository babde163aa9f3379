"""Measures a sprayer's lags on the twin, beforehand, as rig and marked flights would.

    python -m tools.studies.measure_lags examples/anyang/config.toml [--output servo]

prints the `[lag]` table to paste. On the rig each valve goes on, up, down and off many times at
any phase of its period; what was ordered is compared with the volume that came. What no rig sees,
the age of the position (`position_s`), follows from flights at two speeds over known boundaries:
the part of the lag distance that grows with the speed. The seeds are not those of demo and
benchmarks: it is another sprayer of the same make, whose valves scatter differently.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation import evaluate
from companion.config import load
from companion.core.schedule import LagModel
from companion.core.setup import Setup
from companion.core.types import SprayPlan, TimedChange
from missions.maps.compiling import compiled_setup
from sitl.anyang import anyang_route
from sitl.flight import FlightOptions, fly, sprayer
from sitl.profile import PlantProfile, load_profile
from sitl.vehicle import Vehicle

Floats = NDArray[np.float64]

SEEDS = (9001, 9002, 9003, 9004)
SPEEDS_M_S = (4.0, 6.0)
KINDS = ("on", "up", "down", "off")
# The duties of one cycle; each change stands for its kind. First and last flow are those of a
# valve that goes fully open and shuts from there: no gap of a period is in their way.
CYCLE = {"on": 0.6, "up": 0.8, "down": 0.5, "off": 0.0, "open": 1.0, "shut": 0.0}
CYCLES = 12
DWELL_S = 2.0
AHEAD_S = 0.4
SETTLED_S = 0.4
DRY = 0.02


def rig(profile: PlantProfile, options: FlightOptions) -> dict[str, list[float]]:
    """Return the lags seen by kind, and first and last flow, in seconds after the order."""
    seen: dict[str, list[float]] = {kind: [] for kind in (*CYCLE, "first", "last")}
    rng = np.random.default_rng(options.seed)
    plant, output = sprayer(profile, options, 0.0)
    duty, sequence, orders = 0.0, 0, []
    for cycle in range(CYCLES):
        for place, kind in enumerate(CYCLE):
            at_s = 1.0 + DWELL_S * (len(CYCLE) * cycle + place) + float(rng.uniform(0.0, 0.1))
            sequence += 1
            output.submit(_plan(profile, sequence, at_s, duty, CYCLE[kind]), now_s=at_s - AHEAD_S)
            duty = CYCLE[kind]
            orders.append((kind, at_s))
    output.finish(orders[-1][1] + DWELL_S)
    for kind, at_s in orders[len(CYCLE) :]:
        for valve in range(profile.valve_count):
            _look(plant.volume_ml, kind, at_s, valve, profile.pwm.period_s, seen)
    return seen


def _plan(
    profile: PlantProfile, sequence: int, at_s: float, before: float, after: float
) -> SprayPlan:
    count = profile.valve_count
    return SprayPlan(
        sequence=sequence,
        issued_s=at_s - AHEAD_S,
        duty=(before,) * count,
        changes=tuple(TimedChange(at_s=at_s, valve=valve, duty=after) for valve in range(count)),
        lease_until_s=at_s + 2.0 * DWELL_S,
    )


def _look(
    volume_ml: Callable[[Floats], Floats],
    kind: str,
    at_s: float,
    valve: int,
    period_s: float,
    seen: dict[str, list[float]],
) -> None:
    """Add what one change of one valve showed to `seen`."""
    times: Floats = at_s + np.arange(-1.2, 1.4, 0.0005)
    volume: Floats = volume_ml(times)[:, valve]
    before = _line(times, volume, at_s - 6.0 * period_s, period_s)
    after = _line(times, volume, at_s + SETTLED_S, period_s)
    seen[kind].append((before[1] - after[1]) / (after[0] - before[0]) - at_s)
    flow = np.diff(volume) / 0.0005
    wet = np.flatnonzero((flow > DRY * max(before[0], after[0])) & (times[:-1] >= at_s))
    if kind == "open":
        seen["first"].append(float(times[wet[0]]) - at_s)
    if kind == "shut":
        seen["last"].append(float(times[wet[-1]]) + 0.0005 - at_s)


def _line(times: Floats, volume: Floats, from_s: float, period_s: float) -> tuple[float, float]:
    """Return slope and intercept of the volume over whole periods, pulses averaged out."""
    width = round(period_s / 0.0005)
    first = int(np.searchsorted(times, from_s))
    slope = fmean(volume[first + 3 * width : first + 4 * width] - volume[first : first + width])
    slope /= 3.0 * width * 0.0005
    rest = volume[first : first + 4 * width] - slope * times[first : first + 4 * width]
    return float(slope), float(rest.mean())


def position_age_s(setup: Setup, profile: PlantProfile, options: FlightOptions) -> float:
    """Return how much too late everything falls: lag distance over speed, in flight."""
    late = []
    for speed_m_s in SPEEDS_M_S:
        for seed in SEEDS:
            route = anyang_route(speed_m_s, setup.frame)
            trajectory = Vehicle(route, start_s=100.0, seed=seed).fly_to_end()
            flown = replace(options, seed=seed)
            result = fly(setup, trajectory, profile, flown, speed_m_s=speed_m_s)
            mean = evaluate(result.record).lag_distance_m.mean
            late.append((mean or 0.0) / speed_m_s)
    return fmean(late)


def measure(setup: Setup, profile: PlantProfile, options: FlightOptions) -> LagModel:
    """Return the lags of this make of sprayer behind this output."""
    seen: dict[str, list[float]] = {}
    for seed in SEEDS:
        for kind, lags in rig(profile, replace(options, seed=seed)).items():
            seen.setdefault(kind, []).extend(lags)
    path_s = setup.lag.output_s
    mean = {kind: fmean(seen[kind]) - path_s for kind in KINDS}
    lag = LagModel(
        on_s=mean["on"],
        off_s=mean["off"],
        up_s=mean["up"],
        down_s=mean["down"],
        on_start_s=max(min(seen["first"]) - path_s, 0.0),
        off_end_s=max(seen["last"]) - path_s,
        output_s=path_s,
    )
    for _ in range(2):
        late_s = position_age_s(replace(setup, lag=lag), profile, options)
        lag = replace(lag, position_s=lag.position_s + late_s)
    return lag


def main(arguments: Sequence[str]) -> int:
    """Print the `[lag]` table of a configuration's sprayer."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.studies.measure_lags", description=__doc__
    )
    parser.add_argument("config", type=Path)
    parser.add_argument("--plant", default="wang-2024")
    parser.add_argument("--output", choices=("gpio", "servo"), default="gpio")
    given = parser.parse_args(arguments)
    setup, profile = compiled_setup(load(given.config)), load_profile(given.plant)
    # The path to the valves is stated, not measured: nothing on GPIO; on a servo output the wire
    # and half a frame of 20 ms.
    path_s = 0.012 if given.output == "servo" else 0.0
    setup = replace(setup, lag=replace(setup.lag, output_s=path_s))
    lag = measure(setup, profile, FlightOptions(output=given.output))
    sys.stdout.write(
        f"# {given.plant}, {given.output}: `python -m tools.studies.measure_lags {given.config} "
        f"--plant {given.plant} --output {given.output}`\n"
    )
    names = ("on_s", "off_s", "up_s", "down_s", "on_start_s", "off_end_s", "output_s")
    lines = [f"{name} = {getattr(lag, name):.4f}" for name in (*names, "position_s")]
    sys.stdout.write("\n".join(["[lag]", *lines, ""]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
