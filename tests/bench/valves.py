"""Valves measured one by one: how well they are found, and what that is worth in the field.

    python -m tests.bench.valves [--seeds 20] [--speeds 2,4,6] [--plant wang-2024] [--imperfect]

Each seed is another sprayer whose valves scatter. It is measured by the twin's own meter through
the companion's ground work, then flown over the example: with the set's figures alone, with those
of each valve, with the curve between the weighed duties too, with identical valves (the noise
floor), and with perfect knowledge.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from statistics import fmean

import numpy as np

from analysis.calibration.curve import SetCurve
from analysis.evaluation import Evaluation, evaluate
from sitl.flight import fly
from sitl.profile import TYPICAL, Parts, PlantProfile, draw_scatter, load_profile
from sitl.valve_calibration import (
    Calibrated,
    calibrate_curves,
    calibrate_valves,
    with_curves,
    with_figures,
)
from sitl.workers import do_all
from tests.bench.flights import Task, perfect, place
from tests.bench.report import made_by
from tests.bench.sprayers import PLANT, Output, options_of, sprayer_setup

PAGE_TEXT = """<!-- Written by `python -m tests.bench.valves --page`; do not edit. -->

# Valves measured one by one

`{command}`, {today}, in simulation. Each sprayer is another draw of valves (1 sd: 2 % in flow, 5 %
in lag). They are measured by the twin's meter (3 % gain, 1 % noise a PWM period, 4600 pulses a
litre) through the companion's ground work, and so is the flow between the points of the bucket
test (*and the curve*). Then the sprayer flies the example's field: by the set's figures, by each
valve's, these and the curve, with identical valves and the same noise, and with perfect knowledge.

```text
{figures}
```

*Limit* is what is misapplied over that of perfect knowledge. What remains above it once the curve
is measured is the noise of position and speed.
"""
PERFECT = "perfect knowledge"
PAGE = Path(__file__).parents[2] / "docs" / "measurements" / "valves.md"


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """How far one valve's figures are off, and whether their intervals hold the truth."""

    factor: float
    factor_held: bool
    lags_s: tuple[float, ...]
    lags_held: tuple[bool, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """How far the flow between two weighed duties is off: measured, and on the straight line."""

    error: float
    straight: float
    held: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Flight:
    """What is kept of a flight."""

    misapplied_percent: float
    accuracy_percent: float
    mean_m: float
    worst_m: float
    missed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One sprayer at one speed: its calibration and its flights by what is known of it."""

    seed: int
    speed_m_s: float
    output: Output
    minutes: float
    litres: float
    curve_minutes: float
    curve_litres: float
    points: tuple[Point, ...]
    valves: tuple[Found, ...]
    flights: dict[str, Flight]


def measure(todo: tuple[str, int, float, Output, bool, bool]) -> Row:
    """Calibrate one sprayer and fly it by what is known of it."""
    plant, seed, speed_m_s, output, is_alone, is_imperfect = todo
    profile, options = _profile(plant, is_imperfect), options_of(output, seed)
    ground = _calibrated(plant, seed, is_alone, is_imperfect)
    drawn = draw_scatter(profile, np.random.default_rng(seed))
    flow, shift = np.array(drawn.flow_scale), np.array(drawn.shift_s)
    if profile.imperfections is not None:
        parts = Parts(profile.imperfections, profile.valve_count, seed=seed, start_s=0.0)
        flow *= [
            flow_over_nominal(parts, valve, profile.pwm.period_s)
            for valve in range(profile.valve_count)
        ]
    true = zip((flow / flow.mean()).tolist(), (shift - shift.mean()).tolist(), strict=True)
    valves = tuple(
        Found(
            factor=own.factor.value - factor,
            factor_held=own.factor.low <= factor <= own.factor.high,
            lags_s=tuple(lag.value - late_s for lag in own.lags.values()),
            lags_held=tuple(lag.low <= late_s <= lag.high for lag in own.lags.values()),
        )
        for own, (factor, late_s) in zip(ground.found.valves, true, strict=True)
    )
    task = Task(plant=plant, speed_m_s=speed_m_s, seed=seed)
    setup, path = place(task, output)
    known = with_figures(setup, ground.found)
    curves, curve_s, curve_errors = _curves(plant, seed, is_imperfect)
    shaped = with_figures(with_curves(setup, curves), ground.found)
    alike = replace(options, scatter=False)
    best = perfect(task, profile)
    flights = {
        "the set's figures": evaluate(
            fly(setup, path, profile, options, speed_m_s=speed_m_s).record
        ),
        "each valve's": evaluate(fly(known, path, profile, options, speed_m_s=speed_m_s).record),
        "and the curve": evaluate(fly(shaped, path, profile, options, speed_m_s=speed_m_s).record),
        "identical valves": evaluate(fly(setup, path, profile, alike, speed_m_s=speed_m_s).record),
    }
    if best is not None:
        flights[PERFECT] = best
    return Row(
        seed=seed,
        speed_m_s=speed_m_s,
        output=output,
        minutes=ground.minutes,
        litres=ground.litres,
        curve_minutes=curve_s / 60.0,
        curve_litres=sum(curve.volume_ml for curve in curves) / 1000.0,
        points=curve_errors,
        valves=valves,
        flights={name: _flight(each) for name, each in flights.items()},
    )


def flow_over_nominal(parts: Parts, valve: int, period_s: float) -> float:
    """Return the mean flow of a valve over the nominal one's, at two levels of duty."""
    shares = []
    for duty in (0.4, 0.75):
        longer = 1.0 + parts._longer_s[valve] / (duty * period_s)
        shares.append(longer * (1.0 + parts._bend[valve] * (duty - 0.5)))
    return sum(shares) / len(shares)


def _profile(plant: str, is_imperfect: bool) -> PlantProfile:
    profile = load_profile(plant)
    return replace(profile, imperfections=TYPICAL) if is_imperfect else profile


@lru_cache(maxsize=32)
def _calibrated(plant: str, seed: int, is_alone: bool, is_imperfect: bool) -> Calibrated:
    """Return what a sprayer's valves are found to be; it serves all speeds and outputs."""
    setup = sprayer_setup(plant, "gpio")
    return calibrate_valves(
        setup, _profile(plant, is_imperfect), options_of("gpio", seed), is_alone=is_alone
    )


@lru_cache(maxsize=32)
def _curves(
    plant: str, seed: int, is_imperfect: bool
) -> tuple[tuple[SetCurve, ...], float, tuple[Point, ...]]:
    """Return how the flow is found to run between weighed duties, the time, and the errors."""
    profile, setup = _profile(plant, is_imperfect), sprayer_setup(plant, "gpio")
    curves, seconds = calibrate_curves(setup, profile, options_of("gpio", seed))
    weighed = {each.valves: each for each in profile.nozzle_sets}
    points = []
    for curve in curves:
        between = [point for point in curve.points if not point.is_weighed]
        duty = np.array([point.duty for point in between])
        true = weighed[curve.valves].flows_l_min(profile.flow_law, duty).tolist()
        points += [
            Point(
                error=point.flow_l_min / flow - 1.0,
                straight=point.straight_l_min / flow - 1.0,
                held=point.low <= flow <= point.high,
            )
            for point, flow in zip(between, true, strict=True)
        ]
    return curves, seconds, tuple(points)


def _flight(found: Evaluation) -> Flight:
    lag = found.lag_distance_m
    return Flight(
        misapplied_percent=_number(found.misapplied_percent),
        accuracy_percent=_number(found.spraying_accuracy_percent),
        mean_m=_number(lag.mean_abs),
        worst_m=_number(lag.max_abs),
        missed=found.missed,
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def lines(rows: Sequence[Row]) -> list[str]:
    """Return the figures for a person."""
    valves = [valve for row in rows for valve in row.valves]
    factors = np.abs([valve.factor for valve in valves])
    lags = np.abs([lag for valve in valves for lag in valve.lags_s])
    held = [each for valve in valves for each in valve.lags_held]
    told = [
        f"{len(valves)} valves, {fmean(row.minutes for row in rows):.1f} min and "
        f"{fmean(row.litres for row in rows):.1f} L a sprayer",
        f"flow factor: 95 % within {100 * np.quantile(factors, 0.95):.2f} %, worst "
        f"{100 * factors.max():.2f} %; interval holds the truth in "
        f"{100 * fmean(valve.factor_held for valve in valves):.0f} %",
        f"lags: 95 % within {1000 * np.quantile(lags, 0.95):.2f} ms, worst "
        f"{1000 * lags.max():.2f} ms; interval holds the truth in {100 * fmean(held):.0f} %",
    ]
    points = [point for row in rows for point in row.points]
    errors, straight = np.abs([(point.error, point.straight) for point in points]).T
    told += [
        f"curve: {fmean(row.curve_minutes for row in rows):.1f} min and "
        f"{fmean(row.curve_litres for row in rows):.1f} L; between weighed duties 95 % within "
        f"{100 * np.quantile(errors, 0.95):.2f} %, worst {100 * errors.max():.2f} % (straight: "
        f"{100 * np.quantile(straight, 0.95):.2f} and {100 * straight.max():.2f} %); interval "
        f"holds the truth in {100 * fmean(point.held for point in points):.0f} %",
    ]
    for output in sorted({row.output for row in rows}):
        for speed in sorted({row.speed_m_s for row in rows}):
            told += _of_speed([r for r in rows if (r.output, r.speed_m_s) == (output, speed)])
    return told


def _of_speed(rows: Sequence[Row]) -> list[str]:
    told = [f"{rows[0].output}, {rows[0].speed_m_s:g} m/s, {len(rows)} seeds:"]
    for name in rows[0].flights:
        flights = [row.flights[name] for row in rows]
        over = [
            row.flights[name].misapplied_percent
            / row.flights["identical valves"].misapplied_percent
            for row in rows
        ]
        limits = [
            row.flights[name].misapplied_percent / row.flights[PERFECT].misapplied_percent
            for row in rows
            if PERFECT in row.flights
        ]
        limit = f"; limit {fmean(limits):.2f}" if limits else ""
        told.append(
            f"  {name:18s} misapplied {fmean(f.misapplied_percent for f in flights):.2f} %, "
            f"{fmean(over):.3f} x identical valves (worst {max(over):.3f}){limit}; accuracy "
            f"{fmean(f.accuracy_percent for f in flights):.2f} %; lag "
            f"{fmean(f.mean_m for f in flights):.3f} m, worst "
            f"{max(f.worst_m for f in flights):.3f} m; missed {sum(f.missed for f in flights)}"
        )
    return told


def main() -> None:
    """Measure, and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--speeds", default="2,4,6")
    parser.add_argument("--outputs", default="gpio,servo")
    parser.add_argument("--plant", default=PLANT)
    parser.add_argument("--others-open", action="store_true")
    parser.add_argument("--imperfect", action="store_true", help="parts as sitl/profile.py")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--page", action="store_true", help="write docs/measurements/valves.md")
    asked = parser.parse_args()
    todo = [
        (asked.plant, seed, float(speed), output, not asked.others_open, asked.imperfect)
        for output in asked.outputs.split(",")
        for speed in asked.speeds.split(",")
        for seed in range(1, asked.seeds + 1)
    ]
    rows = do_all(measure, todo, processes=asked.processes)
    if asked.page:
        figures = "\n".join(lines(rows))
        PAGE.write_text(PAGE_TEXT.format(**made_by("valves"), figures=figures))
    told = json.dumps([asdict(row) for row in rows]) if asked.json else "\n".join(lines(rows))
    sys.stdout.write(told + "\n")


if __name__ == "__main__":
    main()
