"""What the demo flies: the field of Wang et al. 2024 (P1), at several speeds, with four methods.

P1's controller is emulated for `none` and both look-aheads; `scheduled` is ours. One more flight
at each speed has perfect knowledge: what the sprayer can do at best on that path. Nothing prints.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from analysis.evaluation import P1_RESULTS, Evaluation, evaluate, limit_ratio, whole_boom
from analysis.flight_record import Fidelity
from analysis.lag import ordered_ml_s
from analysis.track import boxed, rise_over
from companion.assembly import deliverable
from companion.core.nozzle import flow_for_rate
from companion.core.setup import Setup
from companion.errors import ConfigError
from companion.journal.journal import Journal
from companion.simulated import SIMULATED, Simulated
from sitl.anyang import (
    MAP_SPEED_M_S,
    START_S,
    anyang_passes,
    demo_lags,
    demo_setup,
    demo_trajectory,
    example,
    scaled,
)
from sitl.deposit import L_HA_PER_ML_M2
from sitl.flight import FlightOptions, FlightResult, fly, true_profile
from sitl.knowledge import perfect_setup
from sitl.own_method import load_controller
from sitl.profile import FlowLaw, PlantProfile, load_profile
from sitl.valve_calibration import (
    calibrate_curves,
    calibrate_valves,
    with_curves,
    with_figures,
)
from sitl.wang import LOOK_AHEAD_S, LOOK_AHEAD_STATED_S, WangController, table_2_sets
from sitl.workers import do_all

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord
    from companion.core.frame import LocalFrame


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


# What the pictures show of one flight: the rate on the ground, and the flow along one pass.

Floats = NDArray[np.float64]

# Of the first pass, this much before and behind the field; around it, this much of the ground.
RUN_M = 8.0
MARGIN_X_M = 6.0
MARGIN_Y_M = 1.5
CELL_M = 0.1
L_MIN_PER_ML_S = 0.06


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldAxes:
    """The plots laid on their side: x along the first pass from the edge, y to the left of it."""

    east_m: float
    north_m: float
    along_east: float
    along_north: float
    length_m: float
    width_m: float

    def place(self, east_m: Floats, north_m: Floats) -> tuple[Floats, Floats]:
        """Return x and y of points in the flight's frame."""
        east, north = east_m - self.east_m, north_m - self.north_m
        x_m = east * self.along_east + north * self.along_north
        return x_m, north * self.along_east - east * self.along_north

    @property
    def course_deg(self) -> float:
        """Return the course of the first pass."""
        return float(np.degrees(np.arctan2(self.along_east, self.along_north)))


def field_axes(setup: Setup) -> FieldAxes:
    """Return the axes whose origin is a corner of the plots: x and y begin at 0 there."""
    along_east, along_north = _along(setup.frame)
    corners = shapely.get_coordinates([zone.polygon for zone in setup.prescription.zones])
    raw = FieldAxes(
        east_m=0.0,
        north_m=0.0,
        along_east=along_east,
        along_north=along_north,
        length_m=0.0,
        width_m=0.0,
    )
    x_m, y_m = raw.place(corners[:, 0], corners[:, 1])
    x_0, y_0 = float(x_m.min()), float(y_m.min())
    return FieldAxes(
        east_m=x_0 * along_east - y_0 * along_north,
        north_m=x_0 * along_north + y_0 * along_east,
        along_east=along_east,
        along_north=along_north,
        length_m=float(x_m.max()) - x_0,
        width_m=float(y_m.max()) - y_0,
    )


def _along(frame: LocalFrame) -> tuple[float, float]:
    line = anyang_passes(frame)[0]
    east, north = line.end_east_m - line.start_east_m, line.end_north_m - line.start_north_m
    length = float(np.hypot(east, north))
    return east / length, north / length


@dataclass(frozen=True, slots=True, kw_only=True)
class Traces:
    """Flows [L/min] of the whole boom along the first pass, and the rate on a raster [L/ha].

    `applied` is the mean over one PWM period. The raster's cells are `CELL_M` wide, its corner
    lies `MARGIN_X_M` and `MARGIN_Y_M` outside the plots'; rows along y, columns along x.
    """

    along_m: Floats
    prescribed_l_min: Floats
    ordered_l_min: Floats
    applied_l_min: Floats
    applied_l_ha: Floats


def traces_of(record: FlightRecord, setup: Setup) -> Traces:
    """Return what the pictures need of a flight."""
    axes = field_axes(setup)
    along_m, _ = axes.place(record.east_m, record.north_m)
    inside = (along_m > -RUN_M) & (along_m < axes.length_m + RUN_M)
    first = int(np.argmax(inside))
    chosen = slice(first, first + int(np.argmin(inside[first:])))
    period = record.pwm_period_s / record.step_s
    total_ml = record.volume_ml.sum(axis=1)
    path_m = np.concatenate(
        ([0.0], np.cumsum(np.hypot(np.diff(record.east_m), np.diff(record.north_m))))
    )
    speed_m_s = (rise_over(path_m, period) / record.pwm_period_s)[chosen]
    applied = (rise_over(total_ml, period) / record.pwm_period_s)[chosen]
    rates = record.prescription.rates_at(record.east_m[chosen], record.north_m[chosen])
    return Traces(
        along_m=along_m[chosen],
        prescribed_l_min=np.nan_to_num(rates)
        * flow_for_rate(1.0, 1.0, setup.boom.width_m)
        * speed_m_s,
        ordered_l_min=_ordered_l_min(record, record.time_s[chosen]),
        applied_l_min=L_MIN_PER_ML_S * applied,
        applied_l_ha=_raster(record, axes),
    )


def _ordered_l_min(record: FlightRecord, time_s: Floats) -> Floats:
    """Return the flow that the orders stand for, by the measured curve of the set in use."""
    at_s, total_ml_s = ordered_ml_s(record.orders, record.nozzle_sets)
    found: Floats = L_MIN_PER_ML_S * total_ml_s[np.searchsorted(at_s, time_s, side="right")]
    return found


def _raster(record: FlightRecord, axes: FieldAxes) -> Floats:
    """Return the rate on the ground, the volume of each valve spread over one PWM period.

    Exact along the track, pass by pass: a raster that single drops fall into would show the beat
    of its cells with the samples.
    """
    x_m, y_m = axes.place(record.east_m, record.north_m)
    period = record.pwm_period_s / record.step_s
    volume_ml = np.column_stack([boxed(column, period) for column in record.volume_ml.T])
    columns = round((axes.length_m + 2.0 * MARGIN_X_M) / CELL_M)
    rows = round((axes.width_m + 2.0 * MARGIN_Y_M) / CELL_M)
    edges_m = CELL_M * np.arange(columns + 1) - MARGIN_X_M
    middles_m = 0.5 * (edges_m[1:] + edges_m[:-1])
    row_m = (CELL_M * (np.arange(rows) + 0.5) - MARGIN_Y_M)[:, None]
    raster = np.zeros((rows, columns))
    for one in _passes(x_m, edges_m[0] - CELL_M, edges_m[-1] + CELL_M):
        back = x_m[one][-1] < x_m[one][0]
        order = slice(None, None, -1 if back else 1)
        along_m, side_m = x_m[one][order], y_m[one][order]
        for valve, total_ml in zip(record.boom.valves, volume_ml[one][order].T, strict=True):
            dropped_ml = np.abs(np.diff(np.interp(edges_m, along_m, total_ml)))
            right_m = -valve.right_m if back else valve.right_m
            off_m = row_m - (np.interp(middles_m, along_m, side_m) - right_m)
            rate = dropped_ml * (L_HA_PER_ML_M2 / (CELL_M * valve.width_m))
            raster += np.where(np.abs(off_m) <= 0.5 * valve.width_m, rate, 0.0)
    return raster


def _passes(x_m: Floats, first_m: float, last_m: float) -> list[slice]:
    """Return the pieces of the path that lie between two x: the passes."""
    inside = ((x_m > first_m) & (x_m < last_m)).astype(np.int8)
    turns = np.flatnonzero(np.diff(np.concatenate(([0], inside, [0]))))
    pieces = zip(turns[::2].tolist(), turns[1::2].tolist(), strict=True)
    whole_m = 0.9 * (last_m - first_m)
    return [slice(a, b) for a, b in pieces if abs(x_m[b - 1] - x_m[a]) > whole_m]


PROFILE = "wang-2024"
# P1's controller by its look-ahead; `scheduled` is not in it.
P1_LOOK_AHEAD_S = {
    "none": 0.0,
    "look-ahead": LOOK_AHEAD_S,
    "look-ahead-stated": LOOK_AHEAD_STATED_S,
}
SCHEDULED, PERFECT = "scheduled", "perfect"
METHODS = (*P1_LOOK_AHEAD_S, SCHEDULED)
# Ours again, on a sprayer each valve of which was measured by itself.
CALIBRATED = "calibrated"

SPEED_MIN_M_S, SPEED_MAX_M_S = 1.0, 15.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """What is asked of the demo."""

    speeds_m_s: tuple[float, ...] = (4.0, 5.0, 6.0)
    seed: int = 1
    fidelity: Fidelity = "pulsed"
    output: Literal["gpio", "servo"] = "gpio"
    flow_law: FlowLaw | None = None
    controller: str | None = None

    @property
    def own_method(self) -> str | None:
        """Return what the flights of one's own controller are called: its class."""
        return None if self.controller is None else self.controller.rpartition(":")[2]

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
    controller: str | None = None


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
    if options.controller is not None:
        load_controller(options.controller)
        if options.own_method in (*METHODS, CALIBRATED, PERFECT):
            raise ConfigError(
                f"--controller {options.controller}: {options.own_method} is one of the demo's own "
                "methods; give the class another name"
            )


def jobs_of(options: DemoOptions, journal_folder: Path | None) -> list[Job]:
    """Return every flight, by speed and then by method, perfect knowledge last."""
    jobs = []
    for speed_m_s in options.speeds_m_s:
        shown = speed_m_s == options.shown_m_s
        own = () if options.own_method is None else (options.own_method,)
        for method in (*METHODS, CALIBRATED, *own, PERFECT):
            jobs.append(
                Job(
                    method=method,
                    speed_m_s=speed_m_s,
                    seed=options.seed,
                    fidelity=options.fidelity,
                    output=options.output,
                    flow_law=options.flow_law,
                    traced=shown and method in METHODS,
                    journal_folder=journal_folder if shown and method == SCHEDULED else None,
                    controller=options.controller if method in own else None,
                )
            )
    return jobs


def fly_one(job: Job) -> Flown:
    """Fly one flight and judge it by its truth."""
    setup, profile = demo_setup(job.speed_m_s), load_profile(PROFILE)
    # The averaged twin has no pulses, and nothing to rest before.
    centres = job.output == "gpio" and job.fidelity == "pulsed"
    setup = replace(setup, lag=demo_lags(job.output), centres_pulses=centres)
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
            training=SIMULATED,
            simulated=Simulated(word="yes", because="flown by vrspray demo"),
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
    if job.method == CALIBRATED:
        by_pulses = replace(options, fidelity="pulsed", output="gpio")
        found = calibrate_valves(setup, profile, by_pulses).found
        curves, _ = calibrate_curves(setup, profile, by_pulses)
        setup = with_figures(with_curves(setup, curves), found)
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
        own=None if job.controller is None else load_controller(job.controller),
        observer=None if journal is None else journal.record_decision,
        on_input=None if journal is None else journal.record_input,
    )
