"""Lags identified from one flight of the calibration mission, against the twin's truth.

    python -m tests.bench.identification [--flights 200] [--first 1] [--output servo] [--lags 1.5]

Every flight is another sprayer of the make: its valves' lags and flows, its meter's gain and
noise, its gusts and its position noise are drawn from the seed. The truth is the mean over the
same changes and valves of the volume-equivalent lag, from each valve's own true volume. One JSON
object on stdout, a table on stderr.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Literal

import numpy as np

from analysis.calibration.identify import Identified, identify, trimmed_ml
from analysis.calibration.steps import Kind, record_of
from companion.config import load
from companion.core.types import Decision, FlowReport
from missions.maps.compiling import compiled_setup
from sitl.anyang import EXAMPLE
from sitl.calibration_mission import write_calibration
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.routes import read_route
from sitl.vehicle import Vehicle
from sitl.workers import do_all
from tests.bench.identification_figures import Compared, all_four, summary
from tests.bench.sprayers import PLANT, nominal_lag, scaled_flow, scaled_lag, with_sprayer

if TYPE_CHECKING:
    from analysis.calibration.identify import Fit
    from analysis.flight_record import FlightRecord, Floats
    from companion.core.setup import Setup
    from companion.core.types import Input
    from sitl.vehicle import Route

METER_RATE_HZ = 50.0
TRUTH_PERIODS = 8
TRUTH_SETTLED_S = 0.25
DRY = 0.02

Output = Literal["gpio", "servo"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One flight; the controller's lags are `lags` times the nominal, the flow `gain` times."""

    seed: int
    output: Output
    plant: str = PLANT
    lags: float = 1.0
    gain: float = 1.0


@cache
def _mission(plant: str, output: Output, lags: float) -> tuple[Setup, Route]:
    """Return set-up and route of the calibration flight; the lags are `lags` times the known."""
    with tempfile.TemporaryDirectory() as folder:
        written = write_calibration(EXAMPLE / "config.toml", Path(folder) / "calibration.plan")
        config = load(written.config)
        setup = compiled_setup(config)
        route = read_route(written.mission, setup.frame, speed_m_s=None, default_speed_m_s=5.0)
    if plant != PLANT:
        setup = with_sprayer(setup, load_profile(plant))
    return replace(setup, lag=scaled_lag(nominal_lag(plant, output), lags)), route


def fly_once(task: Task) -> tuple[Identified, FlightRecord]:
    """Fly the mission and identify from what the journal would hold."""
    setup, route = _mission(task.plant, task.output, task.lags)
    trajectory = Vehicle(route, start_s=0.0, seed=task.seed).fly_to_end()
    trace: list[Input | Decision] = []
    result = fly(
        setup,
        trajectory,
        scaled_flow(load_profile(task.plant), task.gain),
        FlightOptions(output=task.output, seed=task.seed, meter_rate_hz=METER_RATE_HZ),
        speed_m_s=5.0,
        observer=trace.append,
        on_input=lambda item: trace.append(item) if isinstance(item, FlowReport) else None,
    )
    return identify(record_of(trace, setup)), result.record


def compare(task: Task) -> list[Compared]:
    """Fly, and return how the flight's lags lie to the truth."""
    return compared(task.seed, *fly_once(task))


def compared(seed: int, found: Identified, record: FlightRecord) -> list[Compared]:
    """Return how a flight's lags lie to the truth."""
    rows = []
    for kind, estimate in found.lags.items():
        fits = [fit for fit in found.fits if fit.step.kind is kind]
        truth_s = fmean(true_lag_s(record, fit) for fit in fits) - found.output_s
        rows.append(
            Compared(
                seed=seed,
                name=kind.value,
                count=estimate.count,
                value_s=estimate.value,
                low_s=estimate.low,
                high_s=estimate.high,
                truth_s=truth_s,
            )
        )
    for kind, end in ((Kind.ON, found.on_start), (Kind.OFF, found.off_end)):
        if end is None:
            continue
        fits = [fit for fit in found.fits if fit.step.kind is kind]
        ends = [true_end_s(record, fit) - found.output_s for fit in fits]
        rows.append(
            Compared(
                seed=seed,
                name="on_start" if kind is Kind.ON else "off_end",
                count=end.count,
                value_s=end.value,
                low_s=end.low,
                high_s=end.high,
                truth_s=min(ends) if kind is Kind.ON else max(ends),
            )
        )
    return rows


def true_lag_s(record: FlightRecord, fit: Fit) -> float:
    """Return the mean over the valves of the volume-equivalent lag, each from its own volume."""
    return fmean(_valve_lag_s(record, fit, number) for number in range(len(fit.step.orders)))


def _valve_lag_s(record: FlightRecord, fit: Fit, number: int) -> float:
    order = fit.step.orders[number]
    first, last = np.searchsorted(record.time_s, (order.at_s - 1.5, order.at_s + 1.5))
    time_s = record.time_s[first:last]
    trimmed = trimmed_ml(fit.step, time_s, fit.lag_s, valve=order.valve)
    volume_ml: Floats = record.volume_ml[first:last, order.valve] - trimmed
    period_s = record.pwm_period_s
    before = _line(time_s, volume_ml, order.at_s - TRUTH_PERIODS * period_s, period_s)
    after = _line(time_s, volume_ml, order.at_s + TRUTH_SETTLED_S, period_s)
    return (before[1] - after[1]) / (after[0] - before[0]) - order.at_s


def _line(time_s: Floats, volume_ml: Floats, from_s: float, period_s: float) -> tuple[float, float]:
    """Return slope and intercept over whole periods: means of the first and of the last one."""
    first_s, last_s = from_s, from_s + (TRUTH_PERIODS - 1) * period_s
    means = []
    for begin_s in (first_s, last_s):
        times_s = begin_s + period_s * (np.arange(400) + 0.5) / 400
        means.append(float(np.interp(times_s, time_s, volume_ml).mean()))
    slope = (means[1] - means[0]) / (last_s - first_s)
    return slope, means[0] - slope * (first_s + 0.5 * period_s)


def true_end_s(record: FlightRecord, fit: Fit) -> float:
    """Return when the total flow first exceeds, or last exceeded, 2 % after the order."""
    orders = fit.step.orders
    is_on = fit.step.kind is Kind.ON
    at_s = orders[0].at_s if is_on else orders[-1].at_s
    first, last = np.searchsorted(record.time_s, (at_s, at_s + TRUTH_SETTLED_S + 0.2))
    volume_ml = record.volume_ml[first : last + 1].sum(axis=1)
    times_s = record.time_s[first : last + 1]
    flow = np.diff(volume_ml) / np.diff(times_s)
    steady = fit.after.slope_ml_s if is_on else fit.before.slope_ml_s
    wet = np.flatnonzero(flow > DRY * steady)
    if not is_on:
        # Ordered in the gap between two pulses, a valve at the nozzle gives nothing any more.
        return float(times_s[wet[-1] + 1]) - at_s if len(wet) else 0.0
    # As of a valve ordered fully open: a pulse stands in the middle of its period.
    ahead_s = 0.5 * (1.0 - max(order.after for order in orders)) * record.pwm_period_s
    return float(times_s[wet[0]]) - at_s - ahead_s


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.identification")
    parser.add_argument("--flights", type=int, default=200)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--output", choices=("gpio", "servo"), default="gpio")
    parser.add_argument("--plant", default="wang-2024")
    parser.add_argument("--lags", type=float, default=1.0, help="configured over known lags")
    parser.add_argument("--processes", type=int, default=1)
    given = parser.parse_args(arguments)
    make = partial(Task, output=given.output, plant=given.plant, lags=given.lags)
    tasks = [make(seed=seed) for seed in range(given.first, given.first + given.flights)]
    rows = [row for rows in do_all(compare, tasks, processes=given.processes) for row in rows]
    kinds = summary(rows, given.flights)
    for name, values in kinds.items():
        line = "  ".join(f"{key} {value:.4f}" for key, value in values.items())
        sys.stderr.write(f"{name:9s} {line}\n")
    print(json.dumps({"kinds": kinds, "all": all_four(rows, given.flights)}))  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
