"""The twin lays marks: a boundary flown to and fro at two speeds, errors unknown to the controller.

    python -m tools.studies.marks --flights 99 [--fidelity averaged] [--body 0.3] [--datum 0.8,-0.5]

flies so many seeds and prints how often the marks' intervals hold the truth. `--csv FILE` writes
the marks of one flight as a person would. The controller has position_s = 0, its boom where the
configuration says and the map where it was drawn; the estimator is late, the boom elsewhere, the
map shifted.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import shapely

from analysis.flight_record import Fidelity, whole_boom
from analysis.lag import Verdict, measure_steps
from analysis.marks import Mark, MarksFit, fit_marks
from analysis.strips import strips_of
from companion.core.boom import Boom
from companion.core.frame import LocalFrame
from companion.core.prescription import Prescription, Zone
from companion.core.setup import Setup
from sitl.anyang import anyang_lag, example
from sitl.flight import MESSAGE_DELAY_S, FlightOptions, fly
from sitl.profile import load_profile
from sitl.vehicle import Leg, Route, Vehicle

# Two rates whose flows the sprayer can deliver at both speeds: 1.6 to 5.8 L/min.
RATES_L_HA = (15.0, 27.0)
SPEEDS_M_S = (3.0, 6.0)
# Ground of one rate on each side of the boundary: 3 s at the higher speed, long enough for the
# level of the flow; and the run-out, where the aircraft gets its speed.
HALF_M = 18.0
RUN_OUT_M = 14.0
ORIGIN_DEG = (35.996089, 114.543487)
START_S = 100.0
# Passes lie this far from the boundary that they do not cross: wider than boom and offsets.
ASIDE_M = 9.0
TAPE_SD_M = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A sprayer with errors that its controller does not know, and how it is flown.

    The map lies `datum_*_m` east and north of the ground; the boom is `body_offset_m` ahead of
    where the controller has it. `rounds` passes in each direction at each speed; with `crossed`
    there are as many over a boundary at right angles. `position_s` is what is configured.
    """

    seed: int = 1
    estimator_lag_s: float = 0.031
    body_offset_m: float = 0.0
    datum_east_m: float = 0.0
    datum_north_m: float = 0.0
    tape_sd_m: float = TAPE_SD_M
    course_deg: float = 0.0
    rounds: int = 3
    crossed: bool = False
    position_s: float = 0.0
    fidelity: Fidelity = "pulsed"


def lay_marks(trial: Trial) -> list[Mark]:
    """Return the marks of one flight, measured from the true boundary with a tape."""
    profile = load_profile("wang-2024")
    setup = _setup(trial)
    trajectory = Vehicle(_route(trial), start_s=START_S, seed=trial.seed).fly_to_end()
    options = FlightOptions(
        fidelity=trial.fidelity, seed=trial.seed, estimator_lag_s=trial.estimator_lag_s
    )
    flown = fly(setup, trajectory, profile, options, speed_m_s=SPEEDS_M_S[-1]).record
    truth = replace(flown, prescription=_field(trial), boom=_ahead(flown.boom, trial.body_offset_m))
    strip = strips_of(whole_boom(truth))[0]
    tape = np.random.default_rng((trial.seed, 77))
    marks = []
    for step in measure_steps(strip.track, strip.stretches, strip.orders, truth.duty_limits):
        if step.verdict is not Verdict.MEASURED or step.lag_distance_m is None:
            continue
        if step.change.border:
            continue
        at_s = np.array([step.change.time_s - 0.5, step.change.time_s + 0.5])
        path = trajectory.at(at_s)
        course = math.atan2(float(np.diff(path.east_m)[0]), float(np.diff(path.north_m)[0]))
        marks.append(
            Mark(
                course_deg=math.degrees(course) % 360.0,
                speed_m_s=step.change.speed_m_s,
                mark_m=step.lag_distance_m + float(tape.normal(0.0, trial.tape_sd_m)),
                kind="up" if step.change.after_l_ha > step.change.before_l_ha else "down",
            )
        )
    return marks


def _setup(trial: Trial) -> Setup:
    """Return what the controller is told: lags that a meter found."""
    config = example()
    return Setup(
        frame=LocalFrame(*ORIGIN_DEG),
        prescription=_field(trial, trial.datum_east_m, trial.datum_north_m),
        boom=config.boom(),
        nozzle_sets=config.nozzle_sets(),
        pwm=config.pwm_limits(),
        lag=replace(anyang_lag("gpio"), position_s=trial.position_s),
        method=config.method(),
        look_ahead_s=config.look_ahead_s(),
        limits=config.limits(),
    )


def _field(trial: Trial, east_m: float = 0.0, north_m: float = 0.0) -> Prescription:
    """Return four squares like a chessboard, turned by the course, moved by a shift."""
    zones = []
    for number, (along, right) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        corners = [(0.0, 0.0), (along, 0.0), (along, right), (0.0, right)]
        places = [_place(trial, HALF_M * a, HALF_M * r) for a, r in corners]
        shifted = [(east + east_m, north + north_m) for east, north in places]
        rate = RATES_L_HA[0 if along == right else 1]
        zones.append(Zone(name=str(number), polygon=shapely.Polygon(shifted), rate_l_ha=rate))
    return Prescription(zones)


def _route(trial: Trial) -> Route:
    """Return the passes: along the course, and with `crossed` across it."""
    reach_m = HALF_M + RUN_OUT_M
    ends = [((-reach_m, -ASIDE_M), (reach_m, -ASIDE_M))]
    if trial.crossed:
        ends.append(((-ASIDE_M, -reach_m), (-ASIDE_M, reach_m)))
    legs: list[Leg] = []
    for first, last in ends:
        if legs:
            legs.append(_leg(trial, first, SPEEDS_M_S[-1], is_pass=False))
        for _ in range(trial.rounds):
            for speed_m_s in SPEEDS_M_S:
                legs.append(_leg(trial, last, speed_m_s, is_pass=True))
                legs.append(_leg(trial, first, speed_m_s, is_pass=True))
    east_m, north_m = _place(trial, *ends[0][0])
    return Route(start_east_m=east_m, start_north_m=north_m, legs=tuple(legs))


def _leg(trial: Trial, end: tuple[float, float], speed_m_s: float, *, is_pass: bool) -> Leg:
    east_m, north_m = _place(trial, *end)
    kind: Literal["spray", "transit"] = "spray" if is_pass else "transit"
    return Leg(east_m=east_m, north_m=north_m, speed_m_s=speed_m_s, kind=kind)


def _place(trial: Trial, along_m: float, right_m: float) -> tuple[float, float]:
    """Return east and north of a point along and right of the course."""
    angle = math.radians(trial.course_deg)
    sin, cos = math.sin(angle), math.cos(angle)
    return along_m * sin + right_m * cos, along_m * cos - right_m * sin


def _ahead(boom: Boom, forward_m: float) -> Boom:
    """Return the boom with every valve that much farther ahead."""
    valves = tuple(replace(valve, forward_m=valve.forward_m + forward_m) for valve in boom.valves)
    return replace(boom, valves=valves)


def csv_of(marks: Sequence[Mark]) -> str:
    """Return marks as a person writes them down: whole degrees, tenths, centimetres."""
    lines = [
        f"{mark.course_deg:.0f},{mark.speed_m_s:.1f},{mark.mark_m:.2f},{mark.kind}"
        for mark in marks
    ]
    return "\n".join(["course_deg,speed_m_s,mark_m,kind", *lines, ""])


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """One flight of a campaign: errors of the estimates, half widths, hits of the intervals."""

    error: tuple[float, ...]
    half_width: tuple[float, ...]
    hit: tuple[bool, ...]


def score(fit: MarksFit, trial: Trial, position_s: float) -> Score:
    """Return how well a fit found time error, body offset and shift along or in both axes."""
    found = [(fit.time_error_s, position_s)]
    if fit.body_offset_m is not None:
        found.append((fit.body_offset_m, trial.body_offset_m))
    shift = (trial.datum_east_m, trial.datum_north_m)
    if fit.axis_deg is not None:
        angle = math.radians(fit.axis_deg)
        along = shift[0] * math.sin(angle) + shift[1] * math.cos(angle)
        shift = (along * math.sin(angle), along * math.cos(angle))
    found += [(fit.datum_east_m, shift[0]), (fit.datum_north_m, shift[1])]
    return Score(
        error=tuple(each.value - truth for each, truth in found),
        half_width=tuple(0.5 * (each.high - each.low) for each, _ in found),
        hit=tuple(each.low <= truth <= each.high for each, truth in found),
    )


def main(arguments: Sequence[str]) -> int:
    """Fly a campaign and print a line for each quantity."""
    parser = argparse.ArgumentParser(prog="python -m tools.studies.marks", description=__doc__)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--fidelity", choices=("averaged", "pulsed"), default="pulsed")
    parser.add_argument("--body", type=float, default=0.0)
    parser.add_argument("--datum", default="0,0")
    parser.add_argument("--course", type=float, default=0.0)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tape-sd", type=float, default=TAPE_SD_M)
    parser.add_argument("--crossed", action="store_true")
    parser.add_argument("--csv", type=Path, help="write the marks of the first seed and end")
    given = parser.parse_args(arguments)
    east_m, north_m = (float(part) for part in given.datum.split(","))
    first = Trial(
        seed=given.first_seed,
        body_offset_m=given.body,
        datum_east_m=east_m,
        datum_north_m=north_m,
        course_deg=given.course,
        rounds=given.rounds,
        tape_sd_m=given.tape_sd,
        crossed=given.crossed,
        fidelity=given.fidelity,
    )
    if given.csv is not None:
        given.csv.write_text(csv_of(lay_marks(first)), encoding="utf-8")
        return 0
    truth_s = first.estimator_lag_s + MESSAGE_DELAY_S
    scores = []
    for seed in range(given.first_seed, given.first_seed + given.flights):
        trial = replace(first, seed=seed)
        scores.append(score(fit_marks(lay_marks(trial)), trial, truth_s))
    names = ("time_error_s", "body_offset_m", "datum_east_m", "datum_north_m")
    for index, name in enumerate(names):
        errors = np.array([each.error[index] for each in scores])
        hits = sum(each.hit[index] for each in scores)
        half = np.mean([each.half_width[index] for each in scores])
        sys.stdout.write(
            f"{name}: error mean {errors.mean():+.4f}, sd {errors.std():.4f}, worst "
            f"{np.abs(errors).max():.4f}; interval +-{half:.4f}, holds the truth in {hits} of "
            f"{len(scores)}\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
