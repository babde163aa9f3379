"""What the demo flies: the field of Wang et al. 2024 (P1), at several speeds, with four methods.

P1's controller is emulated for `none` and both look-aheads; `scheduled` is ours. One more flight
at each speed has perfect knowledge: what the sprayer can do at best on that path. Nothing prints.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from analysis.evaluation import P1_RESULTS, Evaluation, evaluate, limit_ratio, whole_boom
from analysis.flight_record import Fidelity
from companion.assembly import deliverable
from companion.core.setup import Setup
from companion.errors import ConfigError
from companion.record.journal import Journal
from sitl.demo_field import (
    MAP_SPEED_M_S,
    START_S,
    demo_lags,
    demo_setup,
    demo_trajectory,
    example,
    scaled,
)
from sitl.demo_pool import do_all
from sitl.demo_traces import Traces, traces_of
from sitl.flight import FlightOptions, FlightResult, fly, true_profile
from sitl.flow_law import FlowLaw
from sitl.knowledge import perfect_setup
from sitl.profile import PlantProfile, load_profile
from sitl.wang import LOOK_AHEAD_S, LOOK_AHEAD_STATED_S, WangController, table_2_sets

__all__ = [
    "METHODS",
    "PERFECT",
    "SCHEDULED",
    "DemoOptions",
    "DemoResult",
    "Flown",
    "Job",
    "check",
    "fly_demo",
    "fly_one",
    "scaled",
]

PROFILE = "wang-2024"
# P1's controller by its look-ahead; `scheduled` is not in it.
P1_LOOK_AHEAD_S = {
    "none": 0.0,
    "look-ahead": LOOK_AHEAD_S,
    "look-ahead-stated": LOOK_AHEAD_STATED_S,
}
SCHEDULED, PERFECT = "scheduled", "perfect"
METHODS = (*P1_LOOK_AHEAD_S, SCHEDULED)

SPEED_MIN_M_S, SPEED_MAX_M_S = 1.0, 15.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """What is asked of the demo."""

    speeds_m_s: tuple[float, ...] = (4.0, 5.0, 6.0)
    seed: int = 1
    fidelity: Fidelity = "pulsed"
    output: Literal["gpio", "servo"] = "gpio"
    flow_law: FlowLaw | None = None

    @property
    def shown_m_s(self) -> float:
        """Return the speed of the journal and of the pictures of one speed: the map's own."""
        return min(self.speeds_m_s, key=lambda speed: abs(speed - MAP_SPEED_M_S))


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One flight to be flown, perhaps by another process."""

    method: str
    speed_m_s: float
    seed: int
    fidelity: Fidelity
    output: Literal["gpio", "servo"]
    flow_law: FlowLaw | None = None
    traced: bool = False
    journal_folder: Path | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What is kept of a flight; `traces` where it will be in a picture."""

    job: Job
    evaluation: Evaluation
    simulated_s: float
    traces: Traces | None


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoResult:
    """All flights by speed and method, and those with perfect knowledge by speed."""

    options: DemoOptions
    flights: tuple[Flown, ...]
    perfect: tuple[Flown, ...]
    wall_s: float

    def limit_ratio(self, flown: Flown) -> float | None:
        """Return what a flight misapplied over what perfect knowledge does at its speed."""
        speed_m_s = flown.job.speed_m_s
        best = next(other for other in self.perfect if other.job.speed_m_s == speed_m_s)
        return limit_ratio(flown.evaluation, best.evaluation)

    def as_json(self) -> dict[str, object]:
        """Return what stands in demo.json."""
        return {
            "flights": [self._entry(flown) for flown in self.flights],
            "perfect": [self._entry(flown) for flown in self.perfect],
            "published": P1_RESULTS,
            "wall_s": self.wall_s,
            "simulated_s": sum(flown.simulated_s for flown in (*self.flights, *self.perfect)),
        }

    def _entry(self, flown: Flown) -> dict[str, object]:
        return flown.evaluation.as_json(limit_ratio=self.limit_ratio(flown))


def fly_demo(
    options: DemoOptions,
    *,
    journal_folder: Path | None = None,
    processes: int | None = None,
    on_flown: Callable[[], None] = lambda: None,
) -> DemoResult:
    """Fly all of it; the same options give the same figures.

    Raises:
        ConfigError: where the options or the example cannot be flown.
    """
    began_s = time.perf_counter()
    check(options)
    jobs = jobs_of(options, journal_folder)
    found = do_all(fly_one, jobs, processes=processes, on_done=on_flown)
    return DemoResult(
        options=options,
        flights=tuple(flown for flown in found if flown.job.method != PERFECT),
        perfect=tuple(flown for flown in found if flown.job.method == PERFECT),
        wall_s=time.perf_counter() - began_s,
    )


def check(options: DemoOptions) -> None:
    """Refuse what cannot be flown, or what the nozzles cannot deliver."""
    for speed_m_s in options.speeds_m_s:
        if not SPEED_MIN_M_S <= speed_m_s <= SPEED_MAX_M_S:
            raise ConfigError(
                f"--speed {speed_m_s:g}: outside [{SPEED_MIN_M_S:g}, {SPEED_MAX_M_S:g}] m/s"
            )
        for problem in deliverable(demo_setup(speed_m_s), speed_m_s):
            raise ConfigError(f"--speed {speed_m_s:g}: {problem.text}; {problem.fix}")
    if options.fidelity == "averaged" and options.output == "servo":
        raise ConfigError(
            "--output servo: the averaged twin has no pulses and so no board that makes them; "
            "give --fidelity pulsed"
        )


def jobs_of(options: DemoOptions, journal_folder: Path | None) -> list[Job]:
    """Return every flight, by speed and then by method, perfect knowledge last."""
    jobs = []
    for speed_m_s in options.speeds_m_s:
        shown = speed_m_s == options.shown_m_s
        for method in (*METHODS, PERFECT):
            jobs.append(
                Job(
                    method=method,
                    speed_m_s=speed_m_s,
                    seed=options.seed,
                    fidelity=options.fidelity,
                    output=options.output,
                    flow_law=options.flow_law,
                    traced=shown and method != PERFECT,
                    journal_folder=journal_folder if shown and method == SCHEDULED else None,
                )
            )
    return jobs


def fly_one(job: Job) -> Flown:
    """Fly one flight and judge it by its truth."""
    setup, profile = demo_setup(job.speed_m_s), load_profile(PROFILE)
    setup = replace(setup, lag=demo_lags(job.output))
    if job.journal_folder is None:
        result = _fly(job, setup, profile)
    else:
        config = example()
        text = {"config_path": str(config.path), "config_toml": config.source_text}
        with Journal.create(
            job.journal_folder,
            setup=setup,
            setup_text=text,
            started_s=START_S,
            waits=True,
            training="simulated",
        ) as journal:
            result = _fly(job, setup, profile, journal)
    # P1's controller closes valves where it changes its nozzle set: one strip, as P1 judged it.
    record = whole_boom(result.record) if job.method in P1_LOOK_AHEAD_S else result.record
    return Flown(
        job=job,
        evaluation=evaluate(record),
        simulated_s=result.simulated_s,
        traces=traces_of(record, setup) if job.traced else None,
    )


def _fly(
    job: Job, setup: Setup, profile: PlantProfile, journal: Journal | None = None
) -> FlightResult:
    look_ahead_s = P1_LOOK_AHEAD_S.get(job.method)
    knows = job.method == PERFECT
    options = FlightOptions(
        fidelity=job.fidelity,
        output=job.output,
        seed=job.seed,
        knows=knows,
        flow_law=job.flow_law,
    )
    profile = true_profile(profile, options)
    if knows:
        setup = perfect_setup(setup, profile, seed=job.seed, output_s=setup.lag.output_s)
    wang = None
    if look_ahead_s is not None:
        wang = WangController(setup=setup, look_ahead_s=look_ahead_s)
        setup = replace(setup, nozzle_sets=table_2_sets())
    return fly(
        setup,
        demo_trajectory(job.speed_m_s, job.seed),
        profile,
        options,
        speed_m_s=job.speed_m_s,
        wang=wang,
        method=job.method,
        observer=None if journal is None else journal.record_decision,
        on_input=None if journal is None else journal.record_input,
    )
