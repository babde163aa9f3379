"""The twin against what Wang et al. 2024 (P1) measured with a real sprayer.

    python -m sitl.studies.validation --out docs/measurements

flies P1's controller (`sitl/wang.py`, which doses by P1's Eq. 2) over P1's field at P1's speeds,
without compensation and with both look-aheads, and then the same flights with `scheduled`. The
rates are P1's at every speed: its Table 5 has the same ten at 4, 5 and 6 m/s, and they fill its
valves' range of 2 to 6 L/min. (The demo scales them by speed, so that it can fly at any.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from statistics import fmean
from typing import Literal

from analysis.evaluation import Distances, Evaluation, evaluate
from analysis.flight_record import FlightRecord, whole_boom
from analysis.flow_accuracy import RateAccuracy, accuracy_by_rate, pooled_by_rate, pooled_percent
from analysis.published import P1_RATES_L_HA, P1_RESULTS, P1LagDistance, p1_lag_distance_m
from analysis.strips import strips_of
from companion.core.setup import Setup
from sitl.demo import P1_LOOK_AHEAD_S, PROFILE, SCHEDULED
from sitl.demo_field import MAP_SPEED_M_S, demo_lags, demo_setup, demo_trajectory
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.wang import WangController, curve_duties, eq_2_duties, table_2_sets
from sitl.workers import do_all

SPEEDS_M_S = (4.0, 5.0, 6.0)
# How near the means of P1's controller must be to P1's where P1 has a mean for both methods.
BOUND_M = 0.3
BOUND_SPEED_M_S = 5.0
BOUND_METHODS = ("none", "look-ahead")


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """A method and the output it works through; `servo` is the board that restarts.

    P1's controller doses by its Eq. 2, or, to see what that costs, by its measured Table 2.
    """

    method: str
    output: Literal["gpio", "servo"] = "gpio"
    by_table: bool = False

    @property
    def name(self) -> str:
        """Return what tables and pictures call it."""
        if self.by_table:
            return f"{self.method}, by Table 2"
        return self.method if self.method in P1_LOOK_AHEAD_S else f"{self.method}, {self.output}"


WAYS = (
    *(Way(method=method) for method in P1_LOOK_AHEAD_S),
    Way(method=SCHEDULED),
    Way(method=SCHEDULED, output="servo"),
)
LOOK_AHEAD, BY_TABLE = Way(method="look-ahead"), Way(method="look-ahead", by_table=True)
# What is flown; the pictures show `WAYS`.
EVERY_WAY = (*WAYS, BY_TABLE)


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """One flight to be flown, perhaps by another process."""

    way: Way
    speed_m_s: float
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What is kept of a flight."""

    job: Job
    evaluation: Evaluation
    by_rate: tuple[RateAccuracy, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SettledLag:
    """P1's lag distance over all changes of some flights.

    `rate_means_m` are the means by new rate, lowest first: P1's Figure 8a shows a distance for
    each rate. `seed_means_m` are the lowest and the highest mean of a flight.
    """

    all_m: Distances
    rate_means_m: tuple[float, ...]
    seed_means_m: tuple[float, float] | None
    apart: int
    missed: int

    @staticmethod
    def of(flights: Iterable[Evaluation]) -> SettledLag:
        """Return the summary of some flights at one speed."""
        each = list(flights)
        by_rate: dict[float, list[float]] = {}
        for found in each:
            for step in found.settled_steps:
                if step.lag_distance_m is not None:
                    by_rate.setdefault(step.change.after_l_ha, []).append(step.lag_distance_m)
        means = [found.settled_lag_distance_m.mean for found in each]
        seeds = [mean for mean in means if mean is not None]
        return SettledLag(
            all_m=Distances.of(lag for lags in by_rate.values() for lag in lags),
            rate_means_m=tuple(fmean(by_rate[rate]) for rate in sorted(by_rate)),
            seed_means_m=(min(seeds), max(seeds)) if seeds else None,
            apart=sum(found.settled_apart for found in each),
            missed=sum(found.settled_missed for found in each),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What one method did at one speed, over all seeds, beside what P1 had.

    `lag_distance_m` is ours (volume-equivalent, by valve), `settled` is P1's. The accuracy is that
    of all data points; `seed_accuracy_percent` the lowest and the highest of a flight.
    """

    way: Way
    speed_m_s: float
    flights: int
    settled: SettledLag
    published: P1LagDistance | None
    lag_distance_m: Distances
    apart: int
    missed: int
    accuracy_percent: float
    seed_accuracy_percent: tuple[float, float]
    by_rate: tuple[RateAccuracy, ...]

    @staticmethod
    def of(flights: list[Flown]) -> Row:
        """Return the row of the flights of one method at one speed."""
        job = flights[0].job
        by_rate = pooled_by_rate(flown.by_rate for flown in flights)
        whole = pooled_percent(by_rate)
        seeds = [pooled_percent(flown.by_rate) for flown in flights]
        known = [percent for percent in seeds if percent is not None]
        if whole is None:
            raise ValueError("no flight sprayed in the field")
        steps = [s for f in flights for s in f.evaluation.steps if not s.change.border]
        return Row(
            way=job.way,
            speed_m_s=job.speed_m_s,
            flights=len(flights),
            settled=SettledLag.of(flown.evaluation for flown in flights),
            published=p1_lag_distance_m(job.way.method, job.speed_m_s),
            lag_distance_m=Distances.of(step.lag_distance_m for step in steps),
            apart=sum(flown.evaluation.apart for flown in flights),
            missed=sum(flown.evaluation.missed for flown in flights),
            accuracy_percent=whole,
            seed_accuracy_percent=(min(known), max(known)),
            by_rate=by_rate,
        )

    def cells_percent(self) -> tuple[float | None, ...]:
        """Return the accuracy at each of P1's rates, as a row of its Table 5."""
        found = {row.rate_l_ha: row.percent for row in self.by_rate}
        return tuple(found.get(rate) for rate in P1_RATES_L_HA)


@dataclass(frozen=True, slots=True, kw_only=True)
class Validation:
    """All rows, by speed and then by method."""

    seeds: tuple[int, ...]
    rows: tuple[Row, ...]

    def row(self, way: Way, speed_m_s: float) -> Row:
        """Return the row of a method and a speed."""
        return next(row for row in self.rows if (row.way, row.speed_m_s) == (way, speed_m_s))

    @property
    def speeds_m_s(self) -> tuple[float, ...]:
        """Return the speeds flown, lowest first."""
        return tuple(sorted({row.speed_m_s for row in self.rows}))

    def bounds(self) -> dict[str, bool]:
        """Say for each bound method whether its mean is near enough to P1's; missing is no."""
        held = dict.fromkeys(BOUND_METHODS, False)
        for row in self.rows:
            mean_m, p1 = row.settled.all_m.mean, row.published
            bound = row.speed_m_s == BOUND_SPEED_M_S and row.way.method in held
            bound = bound and not row.way.by_table
            if bound and mean_m is not None and p1 is not None:
                held[row.way.method] = abs(mean_m - p1.mean) <= BOUND_M
        return held

    def as_json(self) -> dict[str, object]:
        """Return all of it, with P1's figures."""
        bounds = self.bounds()
        return {
            "profile": PROFILE,
            "fidelity": "pulsed",
            "seeds": list(self.seeds),
            "flights": sum(row.flights for row in self.rows),
            "rows": [asdict(row) for row in self.rows],
            "published": P1_RESULTS,
            "bound_m": BOUND_M,
            "within_bound": bounds,
            "valid": all(bounds.values()),
        }


def validate(
    seeds: Iterable[int],
    *,
    speeds_m_s: Iterable[float] = SPEEDS_M_S,
    ways: Iterable[Way] = EVERY_WAY,
    processes: int | None = None,
    on_flown: Callable[[], None] = lambda: None,
) -> Validation:
    """Fly all of it; the same arguments give the same figures."""
    numbers, each_way = tuple(seeds), tuple(ways)
    groups = [(way, speed) for speed in speeds_m_s for way in each_way]
    jobs = [Job(way=w, speed_m_s=v, seed=seed) for w, v in groups for seed in numbers]
    flown = do_all(fly_one, jobs, processes=processes, on_done=on_flown)
    size = len(numbers)
    return Validation(
        seeds=numbers,
        rows=tuple(Row.of(flown[i : i + size]) for i in range(0, len(flown), size)),
    )


def fly_one(job: Job) -> Flown:
    """Fly one flight and judge it by its truth."""
    record = record_of(job)
    if job.way.method in P1_LOOK_AHEAD_S:
        # Its nozzle sets change: what single valves share says nothing then.
        record = whole_boom(record)
    return Flown(job=job, evaluation=evaluate(record), by_rate=accuracy_by_rate(strips_of(record)))


def record_of(job: Job) -> FlightRecord:
    """Return the truth of one flight."""
    profile, setup = load_profile(PROFILE), field_setup(job.speed_m_s)
    look_ahead_s = P1_LOOK_AHEAD_S.get(job.way.method)
    wang = None
    if look_ahead_s is not None:
        dose = curve_duties(setup) if job.way.by_table else eq_2_duties
        wang = WangController(setup=setup, look_ahead_s=look_ahead_s, dose=dose)
        setup = replace(setup, nozzle_sets=table_2_sets())
    return fly(
        replace(setup, lag=demo_lags(job.way.output)),
        demo_trajectory(job.speed_m_s, job.seed),
        profile,
        FlightOptions(output=job.way.output, seed=job.seed),
        speed_m_s=job.speed_m_s,
        wang=wang,
        method=job.way.method,
    ).record


def field_setup(speed_m_s: float) -> Setup:
    """Return the example's set-up for a speed, with P1's rates as they are."""
    prescription = demo_setup(MAP_SPEED_M_S).prescription
    return replace(demo_setup(speed_m_s), prescription=prescription)
