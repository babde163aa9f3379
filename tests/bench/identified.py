"""Flights with lags from the flight before: the same sprayer, its own calibration mission.

Position and sprayer are drawn by the same seed as in the flights with nominal lags. `unknown`
begins with a controller that is wrong in all: lags by half, up or down, flow by 8 %.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

from analysis.calibrate_cli import settings
from analysis.evaluation import Evaluation, evaluate
from companion.core.options.flow_trim import FlowTrim
from sitl.flight import fly
from sitl.profile import load_profile
from tests.bench import identification
from tests.bench.flights import IDENTIFIED, PAPER_M_S, Flown, kept, perfect, place
from tests.bench.flights import Task as FlightTask
from tests.bench.identification import METER_RATE_HZ, compared, fly_once
from tests.bench.identification_figures import Compared
from tests.bench.sprayers import (
    BOTH,
    PLANT,
    Output,
    nominal_lag,
    options_of,
    scaled_flow,
    scaled_lag,
)

if TYPE_CHECKING:
    from companion.core.setup import Setup

UNKNOWN, RECOVERED = "wrong", "recovered"
TOO_LONG, TOO_SHORT = 1.5, 0.5
TOO_MUCH, TOO_LITTLE = 1.08, 0.92
PINPOINT_SEEDS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """All flights of one sprayer: calibration and field, by every output."""

    plant: str
    seed: int
    is_unknown: bool = False

    @property
    def lags(self) -> float:
        """Return by what the controller's lags are wrong at first: too long, too short, in turn."""
        if not self.is_unknown:
            return 1.0
        return TOO_LONG if self.seed % 2 else TOO_SHORT

    @property
    def gain(self) -> float:
        """Return what the sprayer delivers over what the controller's table says."""
        if not self.is_unknown:
            return 1.0
        return TOO_MUCH if self.seed % 4 < 2 else TOO_LITTLE  # with either of the lags


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """What came of one sprayer."""

    plant: str
    flown: tuple[Flown, ...]
    compared: dict[str, tuple[Compared, ...]]


def tasks(seeds: Sequence[int], *, is_quick: bool) -> list[Task]:
    """Return all sprayers of one make, and the first few of the other."""
    few = seeds[: 1 if is_quick else PINPOINT_SEEDS]
    return [Task(plant=PLANT, seed=s) for s in seeds] + [
        Task(plant="pinpoint", seed=s) for s in few
    ]


def unknown_tasks(seeds: Iterable[int]) -> list[Task]:
    """Return the sprayers that the controller does not know."""
    return [Task(plant=p, seed=s, is_unknown=True) for p, s in product((PLANT,), seeds)]


def fly_task(task: Task) -> Done:
    """Calibrate, then fly the field."""
    field = FlightTask(plant=task.plant, seed=task.seed)
    best = None if task.is_unknown else perfect(field)
    flown, rows = [], {}
    for output in BOTH:
        mission = identification.Task(
            seed=task.seed, output=output, plant=task.plant, lags=task.lags, gain=task.gain
        )
        found, record = fly_once(mission)
        rows[output] = tuple(compared(task.seed, found, record))
        # The position's age no meter sees: it comes from marks, once for an autopilot.
        lag = replace(nominal_lag(task.plant, output), **settings(found))
        setup, _ = place(field, output)
        if task.is_unknown:
            wrong = replace(setup, lag=scaled_lag(setup.lag, task.lags))
            flown.append(_kept(_fly(task, wrong, output), field, output, best, UNKNOWN))
            setup = replace(setup, flow_trim=FlowTrim())
        ours = replace(setup, lag=lag)
        name = RECOVERED if task.is_unknown else IDENTIFIED
        flown.append(_kept(_fly(task, ours, output), field, output, best, name))
    return Done(plant=task.plant, flown=tuple(flown), compared=rows)


def _fly(task: Task, setup: Setup, output: Output) -> Evaluation:
    field = FlightTask(plant=task.plant, seed=task.seed)
    profile = scaled_flow(load_profile(task.plant), task.gain)
    _, path = place(field, output)
    rate_hz = METER_RATE_HZ if setup.flow_trim is not None else 0.0
    options = replace(options_of(output, task.seed), meter_rate_hz=rate_hz)
    return evaluate(fly(setup, path, profile, options, speed_m_s=PAPER_M_S).record)


def _kept(
    found: Evaluation, field: FlightTask, output: str, best: Evaluation | None, lags: str
) -> Flown:
    return kept(found, task=field, output=output, perfect=best, lags=lags)
