"""Lag distances of a sprayer whose pump makes the flow: `python -m tests.bench.pump [SEED…]`.

Two passes over zones of 60 m, rate steps of 30 % of the rate before, gusts of 1 m/s, noise of the
position, lags measured beforehand on the rig (`python -m tools.studies.measure_pump`). In the same
run the controller of Wang et al. 2024 without look-ahead, with its own, and with one tuned to this
pump.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from statistics import fmean, median
from typing import Any

import shapely

from analysis.evaluation import Evaluation, evaluate
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription, Zone
from companion.core.safety import Limits
from companion.core.setup import Setup
from companion.core.types import Method
from sitl.flight import FlightOptions, fly
from sitl.knowledge import boom, measured_sets, pwm_limits
from sitl.profile import PlantProfile, load_profile
from sitl.trajectory import Trajectory
from sitl.vehicle import Leg, Route, Vehicle
from sitl.wang import LOOK_AHEAD_S, PROGRAM_S, WangController, curve_duties
from tests.bench.figures import Figure
from tools.studies.measure_pump import measure

SEEDS = (1, 2, 3, 4, 5)
SPEED_M_S = 5.0
TARGET_M = 0.5
METHODS = ("none", "look-ahead", "look-ahead-tuned", "scheduled")
ZONE_M, WIDTH_M, RUN_OUT_M, ASIDE_M = 60.0, 6.0, 15.0, 1.0
# Each 30 % above or below the one before it, in the direction of flight; L/ha.
ROWS = (
    (18.0, 23.4, 16.4, 21.3, 27.7, 19.4, 13.6, 17.7),
    (22.0, 15.4, 20.0, 26.0, 18.2, 23.7, 16.6, 11.6),
)
# The pump's mean lag and the program's own time, half a poll: one look-ahead for all changes.
TUNED_S = 1.62 + PROGRAM_S + 0.1


def field() -> Prescription:
    """Return two rows of zones along the east, the second one flown westwards."""
    length_m = ZONE_M * len(ROWS[0])
    zones = []
    for row, rates in enumerate(ROWS):
        along = rates if row % 2 == 0 else rates[::-1]
        for number, rate in enumerate(along):
            box = shapely.box(
                number * ZONE_M, row * WIDTH_M, (number + 1) * ZONE_M, (row + 1) * WIDTH_M
            )
            zones.append(Zone(name=f"{row}-{number}", polygon=box, rate_l_ha=rate))
    # A boom of one section shuts as a whole where its strip touches the border: sprayable ground
    # reaches farther to both sides.
    ground = shapely.box(0.0, -ASIDE_M, length_m, len(ROWS) * WIDTH_M + ASIDE_M)
    return Prescription(zones, boundary=ground)


def path(seed: int, *, speed_m_s: float = SPEED_M_S, gust_m_s: float = 1.0) -> Trajectory:
    """Return the flight through the middles of the rows."""
    west_m, east_m = -RUN_OUT_M, ZONE_M * len(ROWS[0]) + RUN_OUT_M
    legs = (
        Leg(east_m=east_m, north_m=3.0, speed_m_s=speed_m_s, kind="spray"),
        Leg(east_m=east_m, north_m=9.0, speed_m_s=speed_m_s, kind="transit"),
        Leg(east_m=west_m, north_m=9.0, speed_m_s=speed_m_s, kind="spray"),
    )
    route = Route(start_east_m=west_m, start_north_m=3.0, legs=legs, height_m=3.5)
    return Vehicle(route, start_s=100.0, seed=seed, gust_m_s=gust_m_s).fly_to_end()


def setup(profile: PlantProfile, **change: object) -> Setup:
    """Return the controller's knowledge of this sprayer: its curve and its measured lags."""
    given: dict[str, Any] = {
        "frame": LocalFrame(36.0, 114.5),
        "prescription": field(),
        "boom": boom(profile),
        "nozzle_sets": measured_sets(profile),
        "pwm": pwm_limits(profile),
        "lag": measure(profile),
        "method": Method.SCHEDULED,
        "look_ahead_s": 0.0,
        "limits": Limits(),
    }
    return Setup(**(given | change))


def flights(
    profile: PlantProfile,
    seed: int,
    methods: Iterable[str] = ("scheduled",),
    *,
    gust_m_s: float = 1.0,
) -> dict[str, Evaluation]:
    """Return what came of one path with each method."""
    mine, way = setup(profile), path(seed, gust_m_s=gust_m_s)
    options = FlightOptions(seed=seed, fidelity="averaged")
    ahead_s = {"none": 0.0, "look-ahead": LOOK_AHEAD_S, "look-ahead-tuned": TUNED_S}
    found = {}
    for method in methods:
        wang = None
        if method != "scheduled":
            wang = WangController(setup=mine, look_ahead_s=ahead_s[method], dose=curve_duties(mine))
        result = fly(mine, way, profile, options, speed_m_s=SPEED_M_S, wang=wang, method=method)
        found[method] = evaluate(result.record)
    return found


def summary(found: Sequence[Evaluation]) -> dict[str, Any]:
    """Return the means over the seeds, and the worst seed."""
    lags = [each.lag_distance_m for each in found]
    settled = [each.settled_lag_distance_m for each in found]
    means = [lag.mean_abs for lag in lags if lag.mean_abs is not None]
    return {
        "lag_mean_abs_m": _mean(means),
        "lag_median_abs_m": _median_abs(found),
        "lag_mean_abs_worst_seed_m": max(means, default=None),
        "lag_max_abs_m": max((lag.max_abs for lag in lags if lag.max_abs), default=None),
        "lag_mean_m": _mean([lag.mean for lag in lags]),
        "changes": sum(lag.count for lag in lags),
        "apart": sum(each.apart for each in found),
        "missed": sum(each.missed for each in found),
        "settled_lag_mean_m": _mean([lag.mean for lag in settled]),
        "settled_missed": sum(each.settled_missed for each in found),
        "spraying_accuracy_percent": _mean([each.spraying_accuracy_percent for each in found]),
        "misapplied_percent": _mean([each.misapplied_percent for each in found]),
        "off_target_ml": max(each.off_target_ml for each in found),
        "border_margin_min_m": min(
            (each.border_margin_m.min for each in found if each.border_margin_m.min is not None),
            default=None,
        ),
    }


def _median_abs(found: Sequence[Evaluation]) -> float | None:
    """Return the median over all changes: one gust in the wrong place makes a mean of hundreds."""
    steps = [step for each in found for step in each.steps if not step.change.border]
    lags = [abs(step.lag_distance_m) for step in steps if step.lag_distance_m is not None]
    return median(lags) if lags else None


def _mean(values: Iterable[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return fmean(there) if there else None


def fly_task(seed: int) -> dict[str, Evaluation]:
    """Return what came of one path with every method; the pump has a shut-off valve."""
    return flights(load_profile("pump"), seed, METHODS)


def figures(found: Sequence[dict[str, Evaluation]], *, section: str) -> list[Figure]:
    """Return the lag distances of the pump's sprayer beside those of the paper's controller."""
    by_method = {name: summary([each[name] for each in found]) for name in METHODS}
    ours = by_method.pop("scheduled")
    shared: dict[str, Any] = {"unit": "m", "n": ours["changes"], "section": section}
    return [
        Figure(
            key="pump_lag",
            what="lag distance, pump, 5 m/s, steps of 30 %: mean of absolute values",
            value=ours["lag_mean_abs_m"],
            target=TARGET_M,
            alternative={name: each["lag_mean_abs_m"] for name, each in by_method.items()},
            details=ours,
            row="pump, steps of 30 %: lag distance, mean of absolute values",
            **shared,
        ),
        Figure(
            key="pump_worst_lag",
            what="lag distance, pump, 5 m/s, steps of 30 %: worst of all seeds",
            value=ours["lag_max_abs_m"],
            alternative={name: each["lag_max_abs_m"] for name, each in by_method.items()},
            **shared,
        ),
        Figure(
            key="pump_missed",
            what="changes missed, pump",
            value=float(ours["missed"]),
            target=0.0,
            row="pump: changes missed",
            **(shared | {"unit": ""}),
        ),
    ]


def main(arguments: Sequence[str]) -> int:
    """Fly all methods with both kinds of pump and print the figures as JSON."""
    seeds = [int(text) for text in arguments] or list(SEEDS)
    shut_off = load_profile("pump")
    assert shut_off.pump is not None
    bare = replace(shut_off, pump=replace(shut_off.pump, shut_off=False))
    results: dict[str, Any] = {"seeds": seeds, "speed_m_s": SPEED_M_S}
    for name, profile in (("shut-off valve", shut_off), ("no valve", bare)):
        flown = [flights(profile, seed, METHODS) for seed in seeds]
        results[name] = {m: summary([each[m] for each in flown]) for m in METHODS}
    still = [flights(shut_off, seed, gust_m_s=0.0)["scheduled"] for seed in seeds]
    results["shut-off valve, still air"] = {"scheduled": summary(still)}
    sys.stdout.write(json.dumps(results, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
