"""The twin against what Wang et al. 2024 (P1) measured with a real sprayer.

    vrspray campaign examples/campaigns/validation.toml --out flown
    python -m sitl.studies.validation flown --out docs/measurements

P1's controller (`sitl/wang.py`, which doses by P1's Eq. 2) flies over P1's field at P1's speeds,
without compensation and with both look-aheads, and then the same flights with `scheduled`. The
rates are P1's at every speed: its Table 5 has the same ten at 4, 5 and 6 m/s, and they fill its
valves' range of 2 to 6 L/min. (The demo scales them by speed, so that it can fly at any.)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from analysis.evaluation import Distances
from analysis.flow_accuracy import RateAccuracy, pooled_by_rate, pooled_percent
from analysis.published import P1_RATES_L_HA, P1_RESULTS, P1LagDistance, p1_lag_distance_m
from companion.errors import ConfigError, VrsprayError
from sitl.campaign.dataset import read_columns, read_manifest
from sitl.demo import P1_LOOK_AHEAD_S, PROFILE, SCHEDULED

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


def pooled(flights: Iterable[Distances]) -> Distances:
    """Return the distances of all flights as those of one."""
    each = [one for one in flights if one.count]
    if not each:
        return Distances.of(())
    count = sum(one.count for one in each)
    return Distances(
        mean=sum((one.mean or 0.0) * one.count for one in each) / count,
        mean_abs=sum((one.mean_abs or 0.0) * one.count for one in each) / count,
        max_abs=max(one.max_abs or 0.0 for one in each),
        min=min(one.min or 0.0 for one in each),
        max=max(one.max or 0.0 for one in each),
        count=count,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Flown:
    """What is kept of a flight: a row of the campaign's dataset."""

    row: Mapping[str, Any]

    def distances(self, name: str) -> Distances:
        """Return one of its distances."""
        ends = ("mean", "mean_abs", "max_abs", "min", "max")
        found = {end: self.row[f"{name}_{end}_m"] for end in ends}
        return Distances(**found, count=self.row[f"{name}_count"])

    @property
    def by_rate(self) -> tuple[RateAccuracy, ...]:
        """Return its accuracy by rate."""
        columns = ("rate_l_ha", "rate_accuracy_percent", "rate_samples")
        return tuple(
            RateAccuracy(rate_l_ha=rate, percent=percent, samples=samples)
            for rate, percent, samples in zip(*(self.row[name] for name in columns), strict=True)
        )


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
    def of(flights: Iterable[Flown]) -> SettledLag:
        """Return the summary of some flights at one speed."""
        each = list(flights)
        by_rate: dict[float, list[tuple[float, int]]] = {}
        columns = ("rate_l_ha", "rate_settled_lag_mean_m", "rate_settled_lag_count")
        for one in each:
            for rate, mean, count in zip(*(one.row[name] for name in columns), strict=True):
                if count and rate is not None:
                    by_rate.setdefault(rate, []).append((mean, count))
        all_m = [one.distances("settled_lag_distance") for one in each]
        seeds = [one.mean for one in all_m if one.mean is not None]
        return SettledLag(
            all_m=pooled(all_m),
            rate_means_m=tuple(
                sum(mean * count for mean, count in by_rate[rate])
                / sum(count for _, count in by_rate[rate])
                for rate in sorted(by_rate)
            ),
            seed_means_m=(min(seeds), max(seeds)) if seeds else None,
            apart=sum(one.row["settled_apart"] for one in each),
            missed=sum(one.row["settled_missed"] for one in each),
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
    def of(way: Way, speed_m_s: float, flights: list[Flown]) -> Row:
        """Return the row of the flights of one method at one speed."""
        by_rate = pooled_by_rate(flown.by_rate for flown in flights)
        whole = pooled_percent(by_rate)
        seeds = [pooled_percent(flown.by_rate) for flown in flights]
        known = [percent for percent in seeds if percent is not None]
        if whole is None:
            raise VrsprayError(f"{way.name} at {speed_m_s:g} m/s: no flight sprayed in the field")
        return Row(
            way=way,
            speed_m_s=speed_m_s,
            flights=len(flights),
            settled=SettledLag.of(flights),
            published=p1_lag_distance_m(way.method, speed_m_s),
            lag_distance_m=pooled(flown.distances("lag_distance") for flown in flights),
            apart=sum(flown.row["apart"] for flown in flights),
            missed=sum(flown.row["missed"] for flown in flights),
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


def validate(folder: Path) -> Validation:
    """Return what the dataset of examples/campaigns/validation.toml says.

    Raises:
        VrsprayError: it is another one, or lacks flights.
    """
    if len(read_columns(folder, ["flight"])) < read_manifest(folder)["flights"]:
        raise ConfigError(f"{folder}: not all flown yet; run the campaign to its end")
    rows = read_columns(folder, None).to_pylist()
    ways = {way.name: way for way in EVERY_WAY}
    groups: dict[tuple[float, str], list[Flown]] = {}
    for row in rows:
        if row["error"] is not None:
            raise VrsprayError(f"{folder}: flight {row['flight']}: {row['error']}")
        if row["case"] not in ways:
            raise ConfigError(f"{folder}: no validation: its cases are not those of the study")
        groups.setdefault((row["speed_m_s"], row["case"]), []).append(Flown(row=row))
    order = [(speed, name) for speed in sorted({speed for speed, _ in groups}) for name in ways]
    return Validation(
        seeds=tuple(sorted({row["seed"] for row in rows})),
        rows=tuple(
            Row.of(ways[name], speed, groups[speed, name])
            for speed, name in order
            if (speed, name) in groups
        ),
    )
