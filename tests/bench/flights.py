"""Accuracy over many flights: the twin over the example's field, in two processes.

The perfect-knowledge run has the same path and plant without noise, scatter and delays, and no
driver board between core and valves: the strictest that a flight can be compared with.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Literal

from analysis.evaluation import Evaluation, evaluate, limit_ratio
from sitl.demo_field import demo_lags, demo_trajectory
from sitl.flight import FlightOptions, fly
from sitl.profile import PlantProfile, load_profile
from sitl.trajectory import Trajectory
from sitl.wang import LOOK_AHEAD_S, LOOK_AHEAD_STATED_S, WangController
from tests.bench.fields import PROFILE, example

Output = Literal["gpio", "servo", "free-running"]
OUTPUTS: tuple[Output, ...] = ("gpio", "servo", "free-running")
SLOW_M_S = (2.0, 3.0, 4.0, 5.0, 6.0)
FAST_M_S = (8.0, 10.0, 12.0, 15.0)
PAPER_M_S = 5.0
PAPER_METHODS = {"none": 0.0, "look-ahead": LOOK_AHEAD_S, "look-ahead-stated": LOOK_AHEAD_STATED_S}


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What is kept of one flight."""

    speed_m_s: float
    method: str
    output: str
    seed: int
    mean_m: float | None
    mean_abs_m: float | None
    max_abs_m: float | None
    count: int
    apart: int
    missed: int
    settled_mean_m: float | None
    settled_mean_abs_m: float | None
    accuracy_percent: float | None
    settled_accuracy_percent: float | None
    perfect_accuracy_percent: float | None
    misapplied_percent: float | None
    limit_ratio: float | None
    off_target_ml: float
    border_margin_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """All flights of one seed at one speed: they share the path."""

    speed_m_s: float
    seed: int
    outputs: tuple[Output, ...]
    with_paper: bool


def tasks(seeds: Iterable[int], *, is_quick: bool) -> list[Task]:
    """Return what there is to fly, the longest flights first."""
    seeds = list(seeds)
    if is_quick:
        return [
            Task(speed_m_s=PAPER_M_S, seed=seed, outputs=OUTPUTS, with_paper=True) for seed in seeds
        ]
    slow = [
        Task(speed_m_s=speed, seed=seed, outputs=OUTPUTS, with_paper=speed == PAPER_M_S)
        for speed, seed in product(SLOW_M_S, seeds)
    ]
    fast = [
        Task(speed_m_s=speed, seed=seed, outputs=("gpio", "servo"), with_paper=False)
        for speed, seed in product(FAST_M_S, seeds)
    ]
    return slow + fast


def fly_all(
    todo: Sequence[Task], *, processes: int, progress: Callable[[int], None] = lambda _: None
) -> list[Flown]:
    """Fly everything, in `processes` processes where that is more than one."""
    if processes == 1:
        return [flown for task in todo for flown in fly_task(task)]
    results: list[Flown] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        for number, flown in enumerate(pool.map(fly_task, todo)):
            results += flown
            progress(number + 1)
    return results


def fly_task(task: Task) -> list[Flown]:
    """Fly one path with every output, and with the paper's controller where it is asked for."""
    speed_m_s, seed = task.speed_m_s, task.seed
    profile, path = load_profile(PROFILE), demo_trajectory(speed_m_s, seed)
    setup = example(speed_m_s)
    keep = partial(_kept, perfect=_perfect(profile, path, task))
    results = []
    for output in task.outputs:
        mine = example(speed_m_s, "gpio" if output == "gpio" else "servo")
        ours = fly(mine, path, profile, options_of(output, seed), speed_m_s=speed_m_s)
        results.append(keep(evaluate(ours.record), output=output))
    for method, look_ahead_s in PAPER_METHODS.items() if task.with_paper else ():
        theirs = fly(
            setup,
            path,
            profile,
            options_of("gpio", seed),
            speed_m_s=speed_m_s,
            wang=WangController(setup=setup, look_ahead_s=look_ahead_s),
            method=method,
        )
        results.append(keep(evaluate(theirs.record), output="gpio"))
    return results


def options_of(output: Output, seed: int) -> FlightOptions:
    """Return how a flight through an output is simulated."""
    if output == "gpio":
        return FlightOptions(seed=seed, output="gpio")
    board: Literal["restarting", "free-running"]
    board = "free-running" if output == "free-running" else "restarting"
    return FlightOptions(seed=seed, output="servo", board=board)


def _perfect(profile: PlantProfile, path: Trajectory, task: Task) -> Evaluation | None:
    """Fly with perfect knowledge; above the speeds of the paper nothing is held against it."""
    if task.speed_m_s > SLOW_M_S[-1]:
        return None
    known = replace(example(task.speed_m_s), lag=demo_lags(profile, "gpio", perfect=True))
    options = FlightOptions(seed=task.seed, noise=False, scatter=False)
    return evaluate(fly(known, path, profile, options, speed_m_s=task.speed_m_s).record)


def _kept(found: Evaluation, *, output: str, perfect: Evaluation | None) -> Flown:
    lag, settled = found.lag_distance_m, found.settled_lag_distance_m
    return Flown(
        speed_m_s=found.meta.speed_m_s,
        method=found.meta.method,
        output=output,
        seed=found.meta.seed,
        mean_m=lag.mean,
        mean_abs_m=lag.mean_abs,
        max_abs_m=lag.max_abs,
        count=lag.count,
        apart=found.apart,
        missed=found.missed,
        settled_mean_m=settled.mean,
        settled_mean_abs_m=settled.mean_abs,
        accuracy_percent=found.spraying_accuracy_percent,
        settled_accuracy_percent=found.settled_accuracy_percent,
        perfect_accuracy_percent=None if perfect is None else perfect.spraying_accuracy_percent,
        misapplied_percent=found.misapplied_percent,
        limit_ratio=None if perfect is None else limit_ratio(found, perfect),
        off_target_ml=found.off_target_ml,
        border_margin_m=found.border_margin_m.mean,
    )
