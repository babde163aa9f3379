"""The twin against what Wang et al. 2024 (P1) measured with a real sprayer.

    vrspray campaign examples/campaigns/validation.toml --out flown
    python -m tools.studies.validation flown --out docs/measurements

P1's controller (`sitl/wang.py`, which doses by P1's Eq. 2) flies over P1's field at P1's speeds,
without compensation and with both look-aheads, and then the same flights with `scheduled`. The
rates are P1's at every speed: its Table 5 has the same ten at 4, 5 and 6 m/s, and they fill its
valves' range of 2 to 6 L/min. (The demo scales them by speed, so that it can fly at any.)

How the validation is shown: lines for a terminal, and a page.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import Any, Literal

from analysis.dose import RateAccuracy
from analysis.evaluation import Distances
from analysis.published import (
    P1_RATES_L_HA,
    P1_RESULTS,
    P1_SPRAYING_ACCURACY_PERCENT,
    P1LagDistance,
    p1_accuracy_percent,
    p1_lag_distance_m,
)
from companion.errors import ConfigError, VrsprayError
from sitl.campaign.dataset import read_columns, read_manifest
from sitl.demo import P1_LOOK_AHEAD_S, PROFILE, SCHEDULED

SPEEDS_M_S = (4.0, 5.0, 6.0)
# How near the means of P1's controller must be to P1's where P1 has a mean for both methods.
BOUND_M = 0.3
BOUND_SPEED_M_S = 5.0
BOUND_METHODS = ("none", "look-ahead")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownMethod:
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
    *(FlownMethod(method=method) for method in P1_LOOK_AHEAD_S),
    FlownMethod(method=SCHEDULED),
    FlownMethod(method=SCHEDULED, output="servo"),
)
LOOK_AHEAD, BY_TABLE = (
    FlownMethod(method="look-ahead"),
    FlownMethod(method="look-ahead", by_table=True),
)
# What is flown; the pictures show `WAYS`.
EVERY_WAY = (*WAYS, BY_TABLE)


def pooled_by_rate(flights: Iterable[Iterable[RateAccuracy]]) -> tuple[RateAccuracy, ...]:
    """Return the rows of all flights together, as if they had been one."""
    by_rate: dict[float | None, list[RateAccuracy]] = {}
    for flight in flights:
        for row in flight:
            by_rate.setdefault(row.rate_l_ha, []).append(row)
    ordered = sorted(by_rate, key=lambda rate: float("inf") if rate is None else rate)
    pooled = []
    for rate in ordered:
        percent = pooled_percent(by_rate[rate])
        if percent is not None:
            samples = sum(row.samples for row in by_rate[rate])
            pooled.append(RateAccuracy(rate_l_ha=rate, percent=percent, samples=samples))
    return tuple(pooled)


def pooled_percent(rows: Iterable[RateAccuracy]) -> float | None:
    """Return the SA of all data points of some rows; None without any.

    >>> low = RateAccuracy(rate_l_ha=10.0, percent=90.0, samples=1)
    >>> pooled_percent([low, RateAccuracy(rate_l_ha=20.0, percent=98.0, samples=3)])
    96.0
    """
    each = list(rows)
    samples = sum(row.samples for row in each)
    return sum(row.percent * row.samples for row in each) / samples if samples else None


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

    way: FlownMethod
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
    def of(way: FlownMethod, speed_m_s: float, flights: list[Flown]) -> Row:
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

    def row(self, way: FlownMethod, speed_m_s: float) -> Row:
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


COMMAND = "python -m tools.studies.validation"
SET_CHANGE_L_MIN = 4.0
Table = list[tuple[str, ...]]

INTRODUCTION = """\
<!-- Written by `python -m tools.studies.validation`; do not edit. -->

# Validation against Wang et al. 2024

The emulated controller of Wang et al. 2024 (P1) and ours fly P1's field on the simulated sprayer,
beside P1's published figures; [accuracy](../explanation/accuracy.md) says what agrees and what not.
"""

LAG_TEXT = """\
## Lag distance

*Settled*, as P1 measures it: from the boundary to where the total flow stays within 10 % of the
step at its new target; + is too late.
"""

OURS_TEXT = """\
Distance to the volume-equivalent step. More than a plot (12 m) is a failed measurement, left in.
"""

CLOSE_TEXT = """\
## What a look-ahead takes away
"""

ACCURACY_TEXT = """\
## Spraying accuracy by speed and rate

P1's Table 5 and the simulated sprayer: Eqs. 18 and 19 for each rate [L/ha], transitions included.
"""

EQ_2_TEXT = """\
### What P1's Eq. 2 explains of it

What is missing to 100 %, in points; *low* are the rates below 4 L/min, *high* the others.
"""

# What the two pictures show, for those who cannot see them.
PICTURES_SHOW = (
    "Settled lag distance of each method at 4, 5 and 6 m/s, with the ranges that P1 published",
    "Spraying accuracy by speed and prescribed rate: P1's Table 5, and the twin with each method",
)


def summary_lines(result: Validation) -> list[str]:
    """Return the tables for a terminal."""
    lines = [*_plain(_lag_table(result)), "", *_plain(_ours_table(result)), ""]
    lines += [*_plain(_accuracy_table(result)), "", *_plain(_eq_2_table(result)), ""]
    lines += [
        f"{method} at {BOUND_SPEED_M_S:g} m/s within {BOUND_M:g} m of P1: {'yes' if held else 'NO'}"
        for method, held in result.bounds().items()
    ]
    return [*lines, basis(result)]


def write_page(result: Validation, folder: Path, *, pictures: Sequence[str], command: str) -> None:
    """Write `validation.md` into a folder; `pictures` are paths from there.

    Raises:
        ConfigError: when it cannot be written.
    """
    path, today = folder / "validation.md", datetime.now(tz=UTC).date().isoformat()
    bounds = ", ".join(
        f"`{method}` {'met' if held else '**missed**'}" for method, held in result.bounds().items()
    )
    images = [
        f"![{alt}]({picture})\n" for alt, picture in zip(PICTURES_SHOW, pictures, strict=False)
    ]
    parts = [
        INTRODUCTION,
        f"Made by `{command}` on {today}: {basis(result)} Means at {BOUND_SPEED_M_S:g} m/s within "
        f"{BOUND_M:g} m of P1's: {bounds}.\n",
        LAG_TEXT,
        *images[:1],
        _markdown(_lag_table(result)),
        OURS_TEXT,
        _markdown(_ours_table(result)),
        CLOSE_TEXT,
        _markdown(_close_table(result)),
        ACCURACY_TEXT,
        *images[1:],
        _markdown(_accuracy_table(result)),
        EQ_2_TEXT,
        _markdown(_eq_2_table(result)),
    ]
    try:
        path.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from None


def basis(result: Validation) -> str:
    """Return what the figures rest on."""
    flights = sum(row.flights for row in result.rows)
    seeds = result.seeds
    span = f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"
    return f"{flights} flights, {span}, pulsed twin."


def _lag_table(result: Validation) -> Table:
    head = ("Speed", "Method", "Mean [m]", "Range [m]", "By rate [m]", "By flight [m]",
            "Changes", "Apart", "Missed", "P1 mean [m]", "P1 range [m]")  # fmt: skip
    return [head, *(_lag_row(row) for row in result.rows)]


def _lag_row(row: Row) -> tuple[str, ...]:
    lag, rates = row.settled, row.settled.rate_means_m
    seeds = lag.seed_means_m or (None, None)
    return (
        f"{row.speed_m_s:g} m/s",
        row.way.name,
        _metres(lag.all_m.mean),
        _range(lag.all_m.min, lag.all_m.max),
        _range(min(rates), max(rates)) if rates else "-",
        _range(*seeds),
        str(lag.all_m.count),
        str(lag.apart),
        str(lag.missed),
        *_published(row.published),
    )


def _published(row: P1LagDistance | None) -> tuple[str, str]:
    return ("-", "-") if row is None else (_metres(row.mean), _range(row.min, row.max))


def _ours_table(result: Validation) -> Table:
    head = ("Speed", "Method", "Mean [m]", "Mean of absolute values [m]", "Worst [m]",
            "Changes", "Apart", "Missed")  # fmt: skip
    rows = [
        (
            f"{row.speed_m_s:g} m/s",
            row.way.name,
            _metres(row.lag_distance_m.mean, places=3),
            _metres(row.lag_distance_m.mean_abs, places=3),
            _metres(row.lag_distance_m.max_abs),
            str(row.lag_distance_m.count),
            str(row.apart),
            str(row.missed),
        )
        for row in result.rows
    ]
    return [head, *rows]


def _close_table(result: Validation) -> Table:
    """Return what each look-ahead took away from the distance of `none`, and as time."""
    head = ("Speed", "`none`, as time [s]", "0.71 s takes away [m]", "as time [s]",
            "0.97 s takes away [m]", "as time [s]")  # fmt: skip
    table: Table = [head]
    for speed in result.speeds_m_s:
        means = [result.row(way, speed).settled.all_m.mean for way in WAYS[:3]]
        none, short, stated = (float("nan") if mean is None else mean for mean in means)
        cells = (none / speed, none - short, (none - short) / speed)
        more = (none - stated, (none - stated) / speed)
        table.append((f"{speed:g} m/s", *(f"{cell:.2f}" for cell in (*cells, *more))))
    return table


def _accuracy_table(result: Validation) -> Table:
    head = ("Method", "Speed", *(f"{rate:g}" for rate in P1_RATES_L_HA), "All", "By flight")
    table: Table = [head]
    for speed, published in P1_SPRAYING_ACCURACY_PERCENT.items():
        mean = p1_accuracy_percent(speed)
        table.append(("P1, Table 5", f"{speed:g} m/s", *_cells(published), *_cells([mean]), "-"))
    for way in EVERY_WAY:
        for row in (row for row in result.rows if row.way == way):
            cells = row.cells_percent()
            low, high = row.seed_accuracy_percent
            ends = (*_cells([mean_of(cells)]), f"{low:.2f} to {high:.2f}")
            table.append((way.name, f"{row.speed_m_s:g} m/s", *_cells(cells), *ends))
    return table


def _eq_2_table(result: Validation) -> Table:
    """Return what is lost of the accuracy: by P1, with its table, with its law."""
    head = ("Speed", "Who", "Loss, all [points]", "low rates", "high rates")
    table: Table = [head]
    for speed, published in P1_SPRAYING_ACCURACY_PERCENT.items():
        flown = {row.way for row in result.rows if row.speed_m_s == speed}
        if not {BY_TABLE, LOOK_AHEAD} <= flown:
            continue
        lines: dict[str, Sequence[float | None]] = {"P1": published}
        for way in (BY_TABLE, LOOK_AHEAD):
            lines[way.name] = result.row(way, speed).cells_percent()
        # 60 B V / 10 000 of P1's Eq. 1, with B = 6 m.
        low = [rate * 0.036 * speed < SET_CHANGE_L_MIN for rate in P1_RATES_L_HA]
        for who, cells in lines.items():
            parts = (
                cells,
                [cell for cell, is_low in zip(cells, low, strict=True) if is_low],
                [cell for cell, is_low in zip(cells, low, strict=True) if not is_low],
            )
            lost = [_lost(mean_of(part)) for part in parts]
            table.append((f"{speed:g} m/s", who, *lost))
    return table


def _lost(percent: float | None) -> str:
    return "-" if percent is None else f"{100.0 - percent:.2f}"


def mean_of(cells: Sequence[float | None]) -> float | None:
    """Return the plain mean of cells, as P1's; None without any."""
    known = [cell for cell in cells if cell is not None]
    return fmean(known) if known else None


def _cells(values: Sequence[float | None]) -> tuple[str, ...]:
    return tuple("-" if value is None else f"{value:.2f}" for value in values)


def _metres(value_m: float | None, *, places: int = 2) -> str:
    return "-" if value_m is None else f"{value_m:.{places}f}"


def _range(low_m: float | None, high_m: float | None) -> str:
    return "-" if low_m is None or high_m is None else f"{low_m:.2f} to {high_m:.2f}"


def _plain(table: Table) -> list[str]:
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    return [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in table
    ]


def _markdown(table: Table) -> str:
    rows = [table[0], ("---", "---", *("---:" for _ in table[0][2:])), *table[1:]]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"
