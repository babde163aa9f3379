"""The same sprayer by three laws of the flow between its measured points, and two judges of each.

The controller knows the measured points and nothing of the law; the flight with perfect knowledge
knows it. What a figure changes from law to law is what the table leaves open.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

from analysis.evaluation import Evaluation, evaluate
from analysis.flight_record import FlightRecord
from sitl.anyang import EXAMPLE
from sitl.flight import FlightOptions, fly
from sitl.profile import FLOW_LAWS, FlowLaw, load_profile
from tests.bench import flights
from tests.bench.accuracy import accuracy
from tests.bench.figures import Figure
from tests.bench.sprayers import PLANT, known_setup
from tests.second_judge import Ground, Truth, Verdict, judge

LAG_TARGET_M = 0.005
POINTS_TARGET = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """One path of the sprayer by one law."""

    law: FlowLaw
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """What came of it, and how far the two judges are apart: metres, points."""

    flown: flights.Flown
    lag_m: float
    points: float


def tasks(seeds: Iterable[int]) -> list[Task]:
    """Return what there is to fly."""
    return [Task(law=law, seed=seed) for law, seed in product(FLOW_LAWS, seeds)]


def fly_task(task: Task) -> Judged:
    """Fly with the measured points, and with perfect knowledge."""
    same = flights.Task(seed=task.seed)
    profile = replace(load_profile(PLANT), flow_law=task.law)
    setup, path = flights.place(same, "gpio")
    options = FlightOptions(seed=task.seed)
    record = fly(setup, path, profile, options, speed_m_s=same.speed_m_s).record
    known = known_setup(setup, profile, "gpio", task.seed)
    best = fly(known, path, profile, replace(options, knows=True), speed_m_s=same.speed_m_s)
    ours = evaluate(record)
    origin_deg = (setup.frame.latitude_deg, setup.frame.longitude_deg)
    apart = _apart(ours, second(record, origin_deg))
    flown = flights.kept(ours, task=same, output="gpio", perfect=evaluate(best.record))
    return Judged(
        flown=replace(flown, plant=f"{PLANT}-{task.law}"), lag_m=apart[0], points=apart[1]
    )


def second(record: FlightRecord, origin_deg: tuple[float, float]) -> Verdict:
    """Return what the second judge finds of a flight over the example at the map's own speed."""
    profile = load_profile(PLANT)
    truth = Truth(
        time_s=record.time_s,
        east_m=record.east_m,
        north_m=record.north_m,
        heading_deg=record.heading_deg,
        volume_ml=record.volume_ml,
        strips=tuple((strip.right_m, 0.0, strip.width_m) for strip in profile.strips),
        origin_deg=origin_deg,
        period_s=profile.pwm.period_s,
    )
    ground = Ground(EXAMPLE / "prescription.shp", "rate", EXAMPLE / "boundary.geojson", origin_deg)
    return judge(truth, ground)


def _apart(ours: Evaluation, other: Verdict) -> tuple[float, float]:
    lag, share = ours.lag_distance_m, 100.0 / ours.applied_ml
    metres = (
        (lag.mean_abs, other.lag_mean_abs_m),
        (lag.mean, other.lag_mean_m),
        (lag.max_abs, max(map(abs, other.lag_m))),
    )
    points = (
        (ours.misapplied_percent, other.misapplied_percent),
        (ours.spraying_accuracy_percent, other.accuracy_percent),
        (share * ours.off_target_ml, share * other.off_target_ml),
    )
    found = []
    for pairs in (metres, points):
        found.append(max(abs(a - b) if a is not None else float("inf") for a, b in pairs))
    return found[0], found[1]


def figures(judged: Sequence[Judged], *, section: str) -> list[Figure]:
    """Return the figures of each law, and the largest differences of the judges."""
    shared = {"n": len(judged), "section": section}
    return [
        *accuracy([each.flown for each in judged], section=section),
        Figure(
            key="second_judge_lag",
            what="second judge: lag distance (mean, mean of absolute values, worst), most apart",
            value=max(each.lag_m for each in judged),
            unit="m",
            target=LAG_TARGET_M,
            row="second judge against evaluation.py: lag distances",
            **shared,
        ),
        Figure(
            key="second_judge_points",
            what="second judge: misapplied, spraying accuracy, off target, most apart",
            value=max(each.points for each in judged),
            unit="points",
            target=POINTS_TARGET,
            row="second judge against evaluation.py: shares",
            **shared,
        ),
    ]
