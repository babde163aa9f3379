"""How long one step of the core takes, and how that grows with the map."""

from __future__ import annotations

import math
from time import perf_counter, thread_time

import numpy as np
import shapely
from shapely import STRtree

from companion.core.controller import Memory, step
from companion.core.setup import Setup
from sitl.anyang import demo_route
from tests.bench.fields import (
    PLOT_LENGTH_M,
    Moment,
    example,
    grid_setup,
    moments,
    straight_route,
)
from tests.bench.figures import Figure, collector_as_in_flight, spread

SPEED_M_S = 5.0
WARM_UP = 100


def step_times_us(setup: Setup, flown: list[Moment], *, repeats: int) -> list[list[float]]:
    """Return, for each repeat, the microseconds of every step over the field."""
    runs = []
    with collector_as_in_flight():
        _one_flight(setup, flown[:WARM_UP])
        for _ in range(repeats):
            runs.append(_one_flight(setup, flown))
    return runs


def _one_flight(setup: Setup, flown: list[Moment]) -> list[float]:
    memory, times = Memory(), []
    for moment in flown:
        state, now_s = moment.state, moment.now_s
        begin = perf_counter()
        decision, memory = step(setup, state, memory, now_s)
        took = perf_counter() - begin
        if any(rate is not None for rate in decision.rate_l_ha):
            times.append(took * 1e6)
    return times


def small_field(*, seed: int, repeats: int = 3) -> Figure:
    """Measure a step with six valves on the example's field."""
    setup = example(SPEED_M_S)
    flown = moments(setup, demo_route(SPEED_M_S), seed=seed)
    runs = step_times_us(setup, flown, repeats=repeats)
    times = [took for run in runs for took in run]
    everything = spread(times)
    with collector_as_in_flight():
        begin = thread_time()
        _one_flight(setup, flown)
        cpu = (thread_time() - begin) / len(flown)
    return Figure(
        key="step_6_valves",
        what="one core step, 6 valves, 40 plots: mean",
        value=everything["mean"],
        unit="us",
        n=len(times),
        target=100.0,
        alternative={"shapely intersections": _intersections_us(setup, flown[:400])["mean"]},
        details={
            **everything,
            "quietest_mean": min(float(np.mean(run)) for run in runs),
            "cpu_mean": cpu * 1e6,
        },
    )


def large_field(*, seed: int, side: int = 150, length_m: float = 900.0) -> Figure:
    """Measure a step with 24 valves on a grid of `side` x `side` plots."""
    setup = grid_setup(side, side, valve_count=24, seed=seed)
    flown = over_grid(setup, length_m, seed=seed)
    times = step_times_us(setup, flown, repeats=1)[0]
    everything = spread(times)
    other = _intersections_us(setup, flown[:400])
    return Figure(
        key="step_24_valves",
        what=f"one core step, 24 valves, {side * side} polygons: p99",
        value=everything["p99"],
        unit="us",
        n=len(times),
        target=500.0,
        alternative={"shapely intersections": other["p99"]},
        details=everything,
    )


def growth(*, seed: int, zones: tuple[int, ...] = (100, 1_000, 10_000, 100_000)) -> Figure:
    """Measure a step with 24 valves on more and more plots."""
    means: dict[str, float] = {}
    count = 0
    for wanted in zones:
        rows = max(round(math.sqrt(wanted)), 2)
        columns = max(round(wanted / rows), 2)
        setup = grid_setup(rows, columns, valve_count=24, seed=seed)
        flown = over_grid(setup, min(columns, 10) * PLOT_LENGTH_M, seed=seed)
        runs = step_times_us(setup, flown, repeats=3)
        # The least of three: what else the machine does has nothing to do with the map.
        means[str(wanted)] = min(float(np.median(run)) for run in runs)
        count += sum(len(run) for run in runs)
    first, last = str(zones[0]), str(zones[-1])
    return Figure(
        key="step_growth",
        what=f"one core step, 24 valves, {last} zones over {first}",
        value=means[last] / means[first],
        unit="x",
        n=count,
        target=2.0,
        alternative={"linear in the zones": zones[-1] / zones[0]},
        details={"median_us": means},
    )


def over_grid(setup: Setup, length_m: float, *, seed: int) -> list[Moment]:
    """Fly one pass in the middle of the grid, along a line between the plots' middles."""
    west, south, east, north = setup.prescription.bounds_m
    begin = max(0.5 * (west + east - length_m), west)
    middle = 0.5 * (south + north) + 1.3
    route = straight_route(begin, min(length_m, east - begin), middle, SPEED_M_S)
    return moments(setup, route, seed=seed)


def _intersections_us(setup: Setup, flown: list[Moment]) -> dict[str, float]:
    """Return the microseconds of the crossings alone by a tree of polygons and shapely's cut."""
    polygons = np.array([zone.polygon for zone in setup.prescription.zones], dtype=object)
    tree = STRtree(polygons)
    right, forward = setup.boom.right_m, setup.boom.forward_m
    times = []
    for moment in flown:
        state = moment.state
        begin = perf_counter()
        angle = math.radians(state.heading_deg or 0.0)
        sin, cos = math.sin(angle), math.cos(angle)
        east = state.east_m + right * cos + forward * sin
        north = state.north_m - right * sin + forward * cos
        more_e = state.velocity_east_m_s * setup.ahead_s
        more_n = state.velocity_north_m_s * setup.ahead_s
        ends = np.stack([east, north, east + more_e, north + more_n], axis=1)
        paths = np.asarray(shapely.linestrings(ends.reshape(-1, 2, 2)))
        lines, hits = tree.query(paths)
        shapely.intersection(paths[lines], polygons[hits])
        times.append((perf_counter() - begin) * 1e6)
    return spread(times)
