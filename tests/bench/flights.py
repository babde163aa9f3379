"""Accuracy over many flights: the twin over the example's field or a hard one, two processes.

The perfect-knowledge run has the same path and the same scattered sprayer, the true position and
each valve's own lag and flow, and no driver board between core and valves: the strictest that a
flight can be compared with.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

from analysis.evaluation import Evaluation, evaluate, limit_ratio, whole_boom
from sitl.demo_field import demo_trajectory
from sitl.flight import FlightOptions, fly
from sitl.own_method import load_controller
from sitl.profile import load_profile
from sitl.wang import LOOK_AHEAD_S, LOOK_AHEAD_STATED_S, WangController, table_2_sets
from sitl.workers import do_all
from tests.bench.conditions import CONDITIONS, condition_of, laid_out
from tests.bench.sprayers import (
    BOTH,
    OUTPUTS,
    PLANT,
    PLANTS,
    Output,
    known_setup,
    options_of,
    sprayer_setup,
)

if TYPE_CHECKING:
    from companion.core.setup import Setup
    from sitl.profile import PlantProfile
    from sitl.trajectory import Trajectory

SLOW_M_S = (2.0, 3.0, 4.0, 5.0, 6.0)
FAST_M_S = (8.0, 10.0, 12.0, 15.0)
PINPOINT_M_S = (3.0, 5.0, 6.0, 8.0, 15.0)
PAPER_M_S = 5.0
# The time of a whole run is what these spare: a board that is only reported, and every second
# sprayer of the other make in the hard conditions.
FREE_RUNNING_M_S = (3.0, 5.0)
PINPOINT_SHARE = 2
PAPER_METHODS = {"none": 0.0, "look-ahead": LOOK_AHEAD_S, "look-ahead-stated": LOOK_AHEAD_STATED_S}
FIELD = "field"
NOMINAL, IDENTIFIED = "nominal", "identified"


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What is kept of one flight; `lags` says where the controller had them from."""

    plant: str = PLANT
    condition: str = FIELD
    lags: str = NOMINAL
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
    perfect_mean_abs_m: float | None = None
    perfect_max_abs_m: float | None = None
    misapplied_percent: float | None
    limit_ratio: float | None
    off_target_ml: float
    border_margin_m: float | None
    border_bound_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """All flights of one seed at one speed: they share the path."""

    plant: str = PLANT
    condition: str = FIELD
    speed_m_s: float = PAPER_M_S
    seed: int
    outputs: tuple[Output, ...]
    with_paper: bool = False
    # One's own method, `module:Class`, flown instead of all others.
    controller: str | None = None


def tasks(seeds: Iterable[int], *, is_quick: bool) -> list[Task]:
    """Return what there is to fly over the example with P1's sprayer, the longest flights first."""
    seeds = list(seeds)
    speeds = (PAPER_M_S,) if is_quick else SLOW_M_S
    slow = [
        Task(
            speed_m_s=speed,
            seed=seed,
            outputs=OUTPUTS if speed in FREE_RUNNING_M_S else BOTH,
            with_paper=speed == PAPER_M_S,
        )
        for speed, seed in product(speeds, seeds)
    ]
    fast = [
        Task(speed_m_s=speed, seed=seed, outputs=BOTH) for speed, seed in product(FAST_M_S, seeds)
    ]
    return slow if is_quick else slow + fast


def pinpoint_tasks(seeds: Iterable[int], *, is_quick: bool) -> list[Task]:
    """Return what there is to fly over the example with valves at the nozzles."""
    speeds = (PAPER_M_S,) if is_quick else PINPOINT_M_S
    return [
        Task(plant="pinpoint", speed_m_s=speed, seed=seed, outputs=BOTH)
        for speed, seed in product(speeds, seeds)
    ]


def condition_tasks(name: str, seeds: Iterable[int]) -> list[Task]:
    """Return what there is to fly in one hard condition."""
    speed_m_s = condition_of(name).speed_m_s
    seeds = list(seeds)
    return [
        Task(plant=plant, condition=name, speed_m_s=speed_m_s, seed=seed, outputs=BOTH)
        for plant in PLANTS
        for seed in (seeds if plant == PLANT else seeds[::PINPOINT_SHARE])
    ]


def condition_names() -> list[str]:
    """Return the names of all hard conditions."""
    return [condition.name for condition in CONDITIONS]


def fly_all(
    todo: Sequence[Task], *, processes: int, progress: Callable[[], None] = lambda: None
) -> list[Flown]:
    """Fly everything, in `processes` processes where that is more than one."""
    found = do_all(fly_task, todo, processes=processes, on_done=progress)
    return [flown for several in found for flown in several]


def fly_task(task: Task) -> list[Flown]:
    """Fly one path with every output, and with the paper's controller where it is asked for.

    With a method of one's own that flies instead, as often as ours.
    """
    profile, seed = load_profile(task.plant), task.seed
    keep = partial(kept, task=task, perfect=perfect(task))
    own = None if task.controller is None else load_controller(task.controller)
    results = []
    for output in task.outputs:
        setup, path = place(task, output)
        options = options_of(output, seed)
        ours = fly(setup, path, profile, options, speed_m_s=task.speed_m_s, own=own)
        results.append(keep(evaluate(ours.record), output=output))
    setup, path = place(task, "gpio")
    for method, look_ahead_s in PAPER_METHODS.items() if task.with_paper else ():
        theirs = fly(
            replace(setup, nozzle_sets=table_2_sets()),
            path,
            profile,
            options_of("gpio", seed),
            speed_m_s=task.speed_m_s,
            wang=WangController(setup=setup, look_ahead_s=look_ahead_s),
            method=method,
        )
        results.append(keep(evaluate(whole_boom(theirs.record)), output="gpio"))
    return results


def place(task: Task, output: Output) -> tuple[Setup, Trajectory]:
    """Return the controller's set-up with nominal lags, and the path."""
    if task.condition == FIELD:
        setup = sprayer_setup(task.plant, output, task.speed_m_s)
        return setup, demo_trajectory(task.speed_m_s, task.seed)
    return laid_out(condition_of(task.condition), task.seed, sprayer_setup(task.plant, output))


def perfect(task: Task, profile: PlantProfile | None = None) -> Evaluation | None:
    """Fly with perfect knowledge; above the speeds of the paper nothing is held against it."""
    if task.speed_m_s > SLOW_M_S[-1]:
        return None
    profile = profile or load_profile(task.plant)
    setup, path = place(task, "gpio")
    known = known_setup(setup, profile, "gpio", task.seed)
    options = FlightOptions(seed=task.seed, knows=True)
    return evaluate(fly(known, path, profile, options, speed_m_s=task.speed_m_s).record)


def kept(
    found: Evaluation,
    *,
    task: Task,
    output: str,
    perfect: Evaluation | None,
    lags: str = NOMINAL,
) -> Flown:
    """Return what is kept of a flight, beside that with perfect knowledge."""
    lag, settled = found.lag_distance_m, found.settled_lag_distance_m
    best = None if perfect is None else perfect.lag_distance_m
    return Flown(
        plant=task.plant,
        condition=task.condition,
        lags=lags,
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
        perfect_mean_abs_m=None if best is None else best.mean_abs,
        perfect_max_abs_m=None if best is None else best.max_abs,
        misapplied_percent=found.misapplied_percent,
        limit_ratio=None if perfect is None else limit_ratio(found, perfect),
        off_target_ml=found.off_target_ml,
        border_margin_m=found.border_margin_m.mean,
        border_bound_m=found.border_bound_m,
    )
