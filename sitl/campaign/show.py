"""What the rows of a campaign say: figures by setting, which settings matter, with intervals.

Settings are chosen, seeds are drawn: a group's figure is the mean over its settings, seed by seed,
and its 95 % interval is Student's over the seeds. Flights of one seed share path and sprayer, so
two settings are compared seed by seed: what a seed does to both of them drops out.

`sobol` designs give shares of variance, of a setting alone (S1) and with all its interactions (ST).
`morris` designs give the mean size of its effect over the whole range (mu*), and how much that
differs from place to place (sigma). Of a Latin hypercube, S1 by RBD-FAST.
"""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.atomic_write import write_atomically
from companion.csv_table import csv_of
from companion.errors import ConfigError
from companion.wording import missing, writing
from sitl.campaign.dataset import COPY, arrow, parquet_of, read_columns, read_manifest
from sitl.campaign.design import (
    GRID,
    HYPERCUBE,
    MORRIS,
    MORRIS_LEVELS,
    SOBOL,
    Campaign,
    problem_of,
    read_campaign,
)
from sitl.campaign.flying import DISTANCES, figure_types

Floats = NDArray[np.float64]
SHOWN = (
    "lag_distance_mean_abs_m", "lag_distance_max_abs_m", "misapplied_percent",
    "spraying_accuracy_percent", "off_target_ml",
)  # fmt: skip
# More values of a setting than these are shown in so many bins.
VALUES_MAX, BINS = 12, 6
CONFIDENCE = 0.95
# Over fewer an interval is several times as wide as over ten, and its width is chance.
SEEDS_MIN = 5


def least_of(figure: str) -> float:
    """Return the least value that a figure can have, where no interval can reach below."""
    is_signed = figure.startswith(DISTANCES) and "_abs_" not in figure
    is_signed |= figure.endswith(("accuracy_percent", "error_percent", "bound_m"))
    return -math.inf if is_signed and not figure.endswith("_count") else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A mean with its interval over `seeds`, which needs two, and the range of single values."""

    mean: float
    low: float | None
    high: float | None
    min: float
    max: float
    seeds: int

    @staticmethod
    def of(table: Floats, *, least: float = -math.inf) -> Estimate | None:
        """Return the mean of a table: a row a setting, a column a seed, NaN where there is none.

        Every seed counts with the same settings: a setting without any figure is left out, then
        seeds that lack some; where fewer than two would be left, settings that lack some.
        """
        known = ~np.isnan(table)
        table, known = table[known.any(axis=1)], known[known.any(axis=1)]
        if not known.any():
            return None
        seeds, settings = known.all(axis=0), known.all(axis=1)
        if seeds.sum() < 2 and settings.any():
            seeds, table = seeds | True, table[settings]
        samples = table[:, seeds].mean(axis=0)
        count = len(samples)
        mean, half = float(samples.mean()) if count else float(np.nanmean(table)), None
        if count > 1:
            from scipy.stats import t

            quantile = float(t.ppf(0.5 + 0.5 * CONFIDENCE, count - 1))
            half = quantile * float(samples.std(ddof=1)) / math.sqrt(count)
        return Estimate(
            mean=mean,
            low=None if half is None else max(mean - half, least),
            high=None if half is None else mean + half,
            min=float(np.nanmin(table)),
            max=float(np.nanmax(table)),
            seeds=count,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """Flights that have one value of a setting, or one of a range, or are one case.

    `within` has what else they share. Beside those with the value `against`, its figures are
    differences: how much more, over the same seeds and settings.
    """

    setting: str
    value: str
    middle: float | None
    flights: int
    figures: dict[str, Estimate | None]
    within: dict[str, str] = field(default_factory=dict)
    against: str | None = None


@dataclass(frozen=True, kw_only=True)
class Rows:
    """The rows of a campaign as columns."""

    campaign: Campaign
    manifest: dict[str, Any]
    figures: dict[str, Floats]
    settings: dict[str, list[Any]]
    case: list[str]
    point: NDArray[np.int64]
    seed: NDArray[np.int64]
    flight: NDArray[np.int64]
    errors: list[str | None]

    @property
    def failed(self) -> int:
        """Return how many flights could not be flown."""
        return sum(error is not None for error in self.errors)

    def by_point(self, values: Floats, chosen: NDArray[np.bool_]) -> Floats:
        """Return the mean of each setting among the chosen rows; NaN where no flight has one."""
        table = _table(self.point[chosen], self.seed[chosen], values[chosen])
        means: Floats = np.ma.masked_invalid(table).mean(axis=1).filled(np.nan)
        return means


def read_rows(folder: Path, figures: Sequence[str]) -> Rows:
    """Read what is to be shown of a campaign's folder.

    Raises:
        ConfigError: it is none, or a figure is unknown.
    """
    manifest = read_manifest(folder)
    known = figure_types()
    for name in figures:
        if name not in known:
            raise ConfigError(f"--figure {name}: choose of {', '.join(known)}")
    varied = list(manifest["varied"])
    names = ["flight", "case", "point", "seed", "error", *varied, *figures]
    table = read_columns(folder, list(dict.fromkeys(names)))
    return Rows(
        campaign=read_campaign_copy(folder),
        manifest=manifest,
        figures={
            name: table[name].cast("float64").fill_null(np.nan).to_numpy() for name in figures
        },
        settings={name: table[name].to_pylist() for name in varied},
        case=table["case"].to_pylist(),
        point=table["point"].to_numpy(),
        seed=table["seed"].to_numpy(),
        flight=table["flight"].to_numpy(),
        errors=table["error"].to_pylist(),
    )


def read_campaign_copy(folder: Path) -> Campaign:
    """Return the campaign as it was; its other files need not be there any more."""
    return read_campaign(folder / COPY, checked=False)


def groups_of(rows: Rows, by: Sequence[str] = ()) -> list[Group]:
    """Return the groups of every case and every varied setting, or of those that are wanted.

    Raises:
        ConfigError: one is unknown.
    """
    campaign = rows.campaign
    cases = ("case",) if len(campaign.cases) > 1 else ()
    wanted = [(*cases, factor.name) for factor in campaign.factors]
    wanted = [cases, *wanted] if cases else wanted
    if by:
        known = ["case", *rows.settings]
        for name in by:
            if name not in known:
                raise ConfigError(f"--by {name}: choose of {', '.join(known)}")
        wanted = [tuple(dict.fromkeys(by))]
    if not wanted:
        everything = np.ones(len(rows.point), dtype=bool)
        return [_group(rows, everything, setting="campaign", value=campaign.name)]
    return [
        _group(
            rows, chosen, setting=names[-1], value=values[-1], middle=middle,
            within=dict(zip(names[:-1], values[:-1], strict=True)),
        )
        for names in wanted
        for values, middle, chosen in _combined(rows, names)
    ]  # fmt: skip


def differences_of(rows: Rows, by: Sequence[str] = ()) -> list[Group]:
    """Return what each value of the first setting, by default the case, gives beyond the first."""
    setting, *rest = dict.fromkeys(by or ["case"])
    levels, places, _ = _levels(rows, setting)
    values_of = rows.case if setting == "case" else rows.settings[setting]
    if not 1 < len(levels) == len(set(values_of)):  # ranges hold several values of one pair
        return []
    columns = [rows.settings[each.name] for each in rows.campaign.factors if each.name != setting]
    columns += [] if setting == "case" else [rows.case]
    pairs: dict[tuple[Any, ...], int] = {}
    keys = np.array([
        pairs.setdefault(tuple(column[row] for column in columns), len(pairs))
        for row in range(len(rows.point))
    ])  # fmt: skip
    found = []
    for values, _, chosen in _combined(rows, rest):
        for number, value in enumerate(levels[1:], start=1):
            either = chosen & ((places == number) | (places == 0))
            first = places[either] == 0
            figures = {
                name: Estimate.of(np.subtract(*(
                    _table(keys[either], rows.seed[either], np.where(here, each[either], np.nan))
                    for here in (~first, first)
                )))
                for name, each in rows.figures.items()
            }  # fmt: skip
            within = dict(zip(rest, values, strict=True))
            if any(figures.values()):
                found.append(
                    Group(setting=setting, value=value, middle=None, flights=int(either.sum()),
                          figures=figures, within=within, against=levels[0])
                )  # fmt: skip
    return found


def _table(settings: NDArray[np.int64], seeds: NDArray[np.int64], values: Floats) -> Floats:
    """Return values, a row a setting, a column a seed."""
    _, row = np.unique(settings, return_inverse=True)
    _, column = np.unique(seeds, return_inverse=True)
    table = np.full((row.max(initial=-1) + 1, column.max(initial=-1) + 1), np.nan)
    known = ~np.isnan(values)
    table[row[known], column[known]] = values[known]
    return table


def _combined(
    rows: Rows, names: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], float | None, NDArray[np.bool_]]]:
    """Yield what the settings are together, the last one's middle, and which flights have them."""
    if not names:
        yield (), None, np.ones(len(rows.point), dtype=bool)
        return
    texts, places, middles = zip(*(_levels(rows, name) for name in names), strict=True)
    for at in np.unique(np.column_stack(places), axis=0).tolist():
        chosen = np.logical_and.reduce([
            column == one for column, one in zip(places, at, strict=True)
        ])  # fmt: skip
        yield (
            tuple(text[one] for text, one in zip(texts, at, strict=True)),
            middles[-1][at[-1]],
            chosen,
        )


def _levels(rows: Rows, name: str) -> tuple[list[str], NDArray[np.int64], list[float | None]]:
    """Return the values of a setting as text, which of them each flight has, and their middles."""
    column = rows.case if name == "case" else rows.settings[name]
    values = list(dict.fromkeys(column))
    is_number = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if len(values) <= VALUES_MAX or not is_number:
        values = sorted(values) if is_number else values
        at = {value: number for number, value in enumerate(values)}
        middles = [float(value) if is_number else None for value in values]
        return [shown_value(v) for v in values], np.array([at[v] for v in column]), middles
    numbers = np.array(column, dtype=np.float64)
    edges = np.linspace(numbers.min(), numbers.max(), BINS + 1)
    place = np.clip(np.searchsorted(edges, numbers, side="right") - 1, 0, BINS - 1)
    return (
        [f"{low:.3g} to {high:.3g}" for low, high in pairwise(edges)],
        place,
        [0.5 * float(low + high) for low, high in pairwise(edges)],
    )


def shown_value(value: Any) -> str:
    """Return a setting's value as tables and pictures have it."""
    return f"{value:g}" if isinstance(value, float) else "-" if value is None else str(value)


def _group(
    rows: Rows, chosen: NDArray[np.bool_], *, setting: str, value: str,
    middle: float | None = None, within: dict[str, str] | None = None,
) -> Group:  # fmt: skip
    return Group(
        setting=setting,
        value=value,
        middle=middle,
        flights=int(chosen.sum()),
        figures={
            name: Estimate.of(
                _table(rows.point[chosen], rows.seed[chosen], values[chosen]), least=least_of(name)
            )
            for name, values in rows.figures.items()
        },
        within=within or {},
    )


def errors_of(rows: Rows) -> list[dict[str, Any]]:
    """Return each reason why flights failed, how many did, and the first of them."""
    counts = Counter(error for error in rows.errors if error is not None)
    return [
        {"error": error, "flights": count, "first": int(rows.flight[rows.errors.index(error)])}
        for error, count in counts.most_common()
    ]


def as_json(
    rows: Rows, groups: Sequence[Group], differences: Sequence[Group], sensitivity: Sequence[Any]
) -> dict[str, Any]:
    """Return all of it."""
    return {
        "campaign": rows.manifest["name"],
        "flights": rows.manifest["flights"],
        "written": len(rows.flight),
        "failed": rows.failed,
        "errors": errors_of(rows),
        "confidence": CONFIDENCE,
        "groups": [asdict(group) for group in groups],
        "differences": [asdict(each) for each in differences],
        "sensitivity": [asdict(each) for each in sensitivity],
    }


def lines_of(rows: Rows, groups: Sequence[Group]) -> Iterator[str]:
    """Yield the tables for a terminal."""
    total, written = rows.manifest["flights"], len(rows.flight)
    yield f"{rows.manifest['name']}: {written} of {total} flights, {rows.failed} failed"
    for each in errors_of(rows):
        yield f"failed: {each['flights']} (first: flight {each['first']}): {each['error']}"
    for table in tables_of(groups):
        yield ""
        yield from plain(table)
    if len(rows.campaign.seeds) < 2:
        return
    yield ""
    yield (
        f"mean ± half of its {100 * CONFIDENCE:.0f} % interval over {len(rows.campaign.seeds)} "
        "seeds, of these settings"
    )


def tables_of(groups: Sequence[Group]) -> Iterator[list[tuple[str, ...]]]:
    """Yield a table for each setting, the first row of each its heading."""
    tables: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for each in groups:
        name = each.setting if each.against is None else f"{each.setting}, beyond {each.against}"
        names = (*each.within, name, "flights")
        rows = tables.setdefault(names, [(*names, *each.figures)])
        cells = (_cell(found) for found in each.figures.values())
        rows.append((*each.within.values(), each.value, str(each.flights), *cells))
    yield from tables.values()


TABLES = (".csv", ".tex", ".parquet")
LATEX = str.maketrans({**{each: f"\\{each}" for each in "_%&#$"}, "±": r"$\pm$"})


def write_tables(path: Path, groups: Sequence[Group]) -> None:
    """Write the tables: for LaTeX as they are shown, else a row for each figure of each group.

    Raises:
        ConfigError: the suffix is none of these, or the file cannot be written.
    """
    if path.suffix not in TABLES:
        raise ConfigError(f"--out {path}: no table has this suffix; give .csv, .tex or .parquet")
    rows = [row for each in groups for row in _tidy(each)]
    if path.suffix == ".csv":
        content = csv_of(rows).encode()
    elif path.suffix == ".tex":
        content = "\n".join(_latex(table) for table in tables_of(groups)).encode()
    else:
        names = dict.fromkeys(name for row in rows for name in row)
        columns = {name: [row.get(name) for row in rows] for name in names}
        content = parquet_of(arrow().table(columns))
    with writing(f"--out {path}"):
        write_atomically(path, content)


def _tidy(each: Group) -> Iterator[dict[str, Any]]:
    for figure, found in each.figures.items():
        yield {
            "kind": "mean" if each.against is None else "difference",
            **each.within,
            each.setting: each.value,
            "against": each.against,
            "flights": each.flights,
            "figure": figure,
            **({} if found is None else asdict(found)),
        }


def _latex(table: Sequence[Sequence[str]]) -> str:
    head, *rows = [" & ".join(cell.translate(LATEX) for cell in row) + r" \\" for row in table]
    columns = "l" + "r" * (len(table[0]) - 1)
    lines = [rf"\begin{{tabular}}{{{columns}}}", r"\hline", head, r"\hline", *rows, r"\hline"]
    return "\n".join([*lines, r"\end{tabular}", ""])


def _cell(found: Estimate | None) -> str:
    if found is None:
        return "-"
    digits = 3 if abs(found.mean) < 10.0 else 1
    if found.high is None or found.low is None:
        return f"{found.mean:.{digits}f}"
    if found.mean - found.low < 0.999 * (found.high - found.mean):  # cut at its least value
        return f"{found.mean:.{digits}f} [{found.low:g}, {found.high:.{digits}f}]"
    return f"{found.mean:.{digits}f} ± {found.high - found.mean:.{digits}f}"


def plain(table: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield a table in columns: the first to the left, the others to the right."""
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    for row in table:
        cells = (
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        yield "  ".join(cells).rstrip()


# ---------------------------------------------------------------------------- which settings matter

RESAMPLES = 200
FAST_POINTS = 65
# Fewer are too few to draw again from. Of functions whose indices are known (Ishigami's, a straight
# line), 95 % intervals held S1 and ST in at least 95 % of 100 designs with 64 samples, and in 68 to
# 84 % with 2; mu* in 91 % with 16 trajectories, and in 52 to 84 % with 2. Measured on 2026-11-26.
SAMPLES_FOR_INTERVAL = {SOBOL: 64, MORRIS: 16}


@dataclass(frozen=True, slots=True, kw_only=True)
class Index:
    """How much one setting matters for one figure.

    Its 95 % interval is by bootstrap; there is none of too few samples.
    """

    case: str
    figure: str
    setting: str
    name: str
    value: float
    low: float | None
    high: float | None


def sensitivity_of(rows: Rows) -> list[Index]:
    """Return every index; nothing where the design is a grid or has too few points.

    Raises:
        ConfigError: SALib is missing, or flights are.
    """
    campaign = rows.campaign
    if campaign.kind == GRID or not campaign.factors:
        return []
    if campaign.kind == HYPERCUBE and len(campaign.points) < FAST_POINTS:
        return []
    try:
        import SALib  # noqa: F401
    except ImportError as error:
        raise ConfigError(missing("SALib", "campaign")) from error
    found = []
    size, has_interval = len(campaign.points), _has_interval(rows)
    for number, (case, _) in enumerate(campaign.cases):
        chosen = rows.point // size == number
        for figure, values in rows.figures.items():
            means = rows.by_point(values, chosen)
            if len(means) < size or np.isnan(means).any() or not np.ptp(means) > 0.0:
                continue
            found += [
                Index(case=case, figure=figure, setting=setting, name=name, value=value,
                      low=low if has_interval else None, high=high if has_interval else None)
                for setting, name, value, low, high in _indices(rows, means)
            ]  # fmt: skip
    return found


def notes_of(rows: Rows, found: Sequence[Index]) -> Iterator[str]:
    """Yield why figures have no sensitivity, and why indices have no interval."""
    campaign = rows.campaign
    if len(campaign.seeds) < SEEDS_MIN:
        few = f"intervals over {len(campaign.seeds)} seeds mean little"
        few = few if len(campaign.seeds) > 1 else "one seed: no intervals"
        yield f"{few}; write seeds = 10, then run it again with the same --out"
    if found and not _has_interval(rows):
        needed = SAMPLES_FOR_INTERVAL[campaign.kind]
        yield (
            f"no intervals of sensitivity: {campaign.samples} samples are too few for a "
            f"{campaign.kind} design; write design.samples = {needed} or more"
        )
    if campaign.kind == GRID or len({each.figure for each in found}) == len(rows.figures):
        return
    if campaign.kind == HYPERCUBE and len(campaign.points) < FAST_POINTS:
        yield f"no sensitivity: a latin-hypercube design needs {FAST_POINTS} samples or more"
        return
    yield (
        "no sensitivity of figures that do not vary, or that flights lack: fly the rest of the "
        "campaign, or leave out values that fail"
    )


def _has_interval(rows: Rows) -> bool:
    return rows.campaign.samples >= SAMPLES_FOR_INTERVAL.get(rows.campaign.kind, 0)


def _indices(rows: Rows, means: Floats) -> Iterator[tuple[str, str, float, float, float]]:
    from SALib.analyze import morris, rbd_fast, sobol

    campaign = rows.campaign
    problem, seed = problem_of(campaign), campaign.seed
    names = problem["names"]
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        if campaign.kind == SOBOL:
            found = sobol.analyze(
                problem, means, calc_second_order=campaign.second_order, conf_level=CONFIDENCE,
                num_resamples=RESAMPLES, seed=seed,
            )  # fmt: skip
            kinds: tuple[str, ...] = ("S1", "ST")
        elif campaign.kind == HYPERCUBE:
            found = rbd_fast.analyze(
                problem, campaign.points, means, conf_level=CONFIDENCE, num_resamples=RESAMPLES,
                seed=seed,
            )  # fmt: skip
            kinds = ("S1",)
        else:
            found = morris.analyze(
                problem, campaign.points, means, conf_level=CONFIDENCE, num_resamples=RESAMPLES,
                num_levels=MORRIS_LEVELS, seed=seed,
            )  # fmt: skip
            kinds = ("mu_star",)
    for kind in kinds:
        for name, value, half in zip(names, found[kind], found[f"{kind}_conf"], strict=True):
            yield name, kind, float(value), float(value - half), float(value + half)
    if campaign.kind == MORRIS:
        spread = _spread_of_effects(rows, means)
        for name, value, (low, high) in zip(names, found["sigma"], spread, strict=True):
            yield name, "sigma", float(value), low, high


def _spread_of_effects(rows: Rows, means: Floats) -> list[tuple[float, float]]:
    """Return intervals of sigma, which SALib gives none of: by drawing trajectories again."""
    points = rows.campaign.points
    steps = points.shape[1] + 1
    x, y = points.reshape(-1, steps, points.shape[1]), means.reshape(-1, steps)
    moved = np.diff(x, axis=1)
    effect = np.diff(y, axis=1)[:, :, None] * np.sign(moved) / np.abs(moved).sum(axis=2)[:, :, None]
    effects = effect.sum(axis=1)
    rng = np.random.default_rng(np.random.SeedSequence(rows.campaign.seed))
    drawn = rng.integers(0, len(effects), size=(RESAMPLES, len(effects)))
    spread = effects[drawn].std(axis=1, ddof=1)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = np.quantile(spread, [tail, 1.0 - tail], axis=0)
    return list(zip(low.tolist(), high.tolist(), strict=True))


def sensitivity_lines(found: Sequence[Index]) -> Iterator[str]:
    """Yield a table for each case and figure."""
    for case, figure in dict.fromkeys((each.case, each.figure) for each in found):
        rows = [each for each in found if (each.case, each.figure) == (case, figure)]
        kinds = list(dict.fromkeys(each.name for each in rows))
        table: list[tuple[str, ...]] = [(f"{figure}{f', {case}' if case else ''}", *kinds)]
        for setting in dict.fromkeys(each.setting for each in rows):
            of: dict[str, Any] = {each.name: each for each in rows if each.setting == setting}
            table.append((setting, *(_index_cell(of[kind]) for kind in kinds)))
        yield ""
        yield from plain(table)


def _index_cell(found: Index) -> str:
    if found.low is None or found.high is None:
        return f"{found.value:.3f}"
    return f"{found.value:.3f} [{found.low:.3f}, {found.high:.3f}]"
