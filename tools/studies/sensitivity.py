"""What an error that nobody knows of costs: of lag, of position, of its rate, of wind.

    vrspray campaign examples/campaigns/sensitivity.toml --out flown
    python -m tools.studies.sensitivity flown --page docs/measurements/sensitivity.md

compares the cases of a campaign with its first one, flights of the same seed with each other. Of
wind: where the liquid lands is moved by wind x fall time, 0.80 s for ballistic droplets of 250 um
from 3.5 m through a downwash of 8 m/s that fades to the ground, 0.45 s at its full speed.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import typer

from companion.cli.answer import AsJson, answer
from companion.errors import ConfigError, VrsprayError
from companion.wording import install_command
from sitl.campaign.dataset import read_columns, read_manifest
from tools.studies import run_study

# Figures by their columns in a campaign's dataset.
COLUMNS = {
    "lag_mean_m": "lag_distance_mean_m",
    "lag_mean_abs_m": "lag_distance_mean_abs_m",
    "lag_worst_m": "lag_distance_max_abs_m",
    "misapplied_percent": "misapplied_percent",
    "off_target_ml": "off_target_ml",
    "apart": "apart",
    "missed": "missed",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What one flight achieved, or several: then means, but the worst and the counts of all."""

    lag_mean_m: float
    lag_mean_abs_m: float
    lag_worst_m: float
    misapplied_percent: float
    off_target_ml: float
    apart: int
    missed: int

    @staticmethod
    def of(row: Mapping[str, Any]) -> Figures:
        """Return the figures of one flight.

        Raises:
            VrsprayError: when there was nothing to measure.
        """
        values = {name: row[column] for name, column in COLUMNS.items()}
        if None in values.values():
            reason = row["error"] or "no change of rate could be measured"
            raise VrsprayError(f"{row['case']}, seed {row['seed']}: {reason}")
        return Figures(**values)

    @staticmethod
    def all_of(flights: Iterable[Figures]) -> Figures:
        """Return one line of several flights."""
        each = list(flights)
        return Figures(
            lag_mean_m=fmean(one.lag_mean_m for one in each),
            lag_mean_abs_m=fmean(one.lag_mean_abs_m for one in each),
            lag_worst_m=max(one.lag_worst_m for one in each),
            misapplied_percent=fmean(one.misapplied_percent for one in each),
            off_target_ml=fmean(one.off_target_ml for one in each),
            apart=sum(one.apart for one in each),
            missed=sum(one.missed for one in each),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Cost:
    """Disturbed minus undisturbed, seed by seed: the mean over the seeds, and the worst seed."""

    mean: float
    worst: float

    @staticmethod
    def of(disturbed: Iterable[Figures], plain: Iterable[Figures], name: str) -> Cost:
        """Return the cost in one figure."""
        costs = [
            float(getattr(one, name) - getattr(other, name))
            for one, other in zip(disturbed, plain, strict=True)
        ]
        return Cost(mean=fmean(costs), worst=max(costs))


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A disturbance, what was achieved under it, and what it cost."""

    label: str
    figures: Figures
    lag_mean_abs_cost_m: Cost
    lag_worst_cost_m: Cost
    misapplied_cost_points: Cost
    off_target_cost_ml: Cost

    @staticmethod
    def of(label: str, flights: list[Figures], plain: list[Figures]) -> Row:
        """Return the row of the flights of some seeds beside the undisturbed ones."""
        return Row(
            label=label,
            figures=Figures.all_of(flights),
            lag_mean_abs_cost_m=Cost.of(flights, plain, "lag_mean_abs_m"),
            lag_worst_cost_m=Cost.of(flights, plain, "lag_worst_m"),
            misapplied_cost_points=Cost.of(flights, plain, "misapplied_percent"),
            off_target_cost_ml=Cost.of(flights, plain, "off_target_ml"),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """The undisturbed flights and every row."""

    speed_m_s: float
    fidelity: str
    seeds: tuple[int, ...]
    flights: int
    undisturbed: Figures
    plain: str
    rows: tuple[Row, ...]


def result_of(folder: Path) -> Result:
    """Return what a campaign's dataset says; its first case is the undisturbed one.

    Raises:
        VrsprayError: it is none, or lacks flights.
    """
    names = ["case", "seed", "error", "speed_m_s", "fidelity", *COLUMNS.values()]
    rows = read_columns(folder, names).to_pylist()
    if len(rows) < read_manifest(folder)["flights"]:
        raise ConfigError(f"{folder}: not all flown yet; run the campaign to its end")
    found: dict[str, list[Figures]] = {}
    for row in rows:
        found.setdefault(row["case"], []).append(Figures.of(row))
    plain, *others = found
    return Result(
        speed_m_s=rows[0]["speed_m_s"],
        fidelity=rows[0]["fidelity"],
        seeds=tuple(sorted({row["seed"] for row in rows})),
        flights=len(rows),
        undisturbed=Figures.all_of(found[plain]),
        plain=plain,
        rows=tuple(Row.of(label, found[label], found[plain]) for label in others),
    )


app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: python -m tools.studies.sensitivity flown --page sensitivity.md")
def sensitivity(
    flown: Annotated[Path, typer.Argument(metavar="DIR", help="Dataset of the campaign.")],
    page: Annotated[Path | None, typer.Option(metavar="MD", help="Write the page.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the costs.")] = None,
    as_json: AsJson = False,
) -> None:
    """Say what errors of lag, position, rate and wind cost in lag distance and volume."""
    result = result_of(flown)
    if plot is not None:
        write_plot(result, plot)
    if page is not None:
        command = f"{COMMAND} {shlex.join(sys.argv[1:])}".strip()
        write_page(result, page, plot=plot, command=command)
    answer(asdict(result), table_lines(result), as_json=as_json)


def main() -> int:
    """Run it; what a user did wrong is one line."""
    return run_study(app)


# How the costs of errors are shown: lines for a terminal, a page, a picture.

COMMAND = "python -m tools.studies.sensitivity"
HEAD = (
    "Disturbance", "Lag mean [m]", "Abs [m]", "Cost [m]", "Worst [m]", "Cost [m]",
    "Misapplied [%]", "Cost [points]", "Outside [mL]",
)  # fmt: skip

INTRODUCTION = """\
<!-- Written by `python -m tools.studies.sensitivity`; do not edit. -->

# Sensitivity

What an error costs that nobody knows of: flights over the field of Wang et al. 2024 (216 changes)
with one disturbance each, method `scheduled`. *Cost* is disturbed minus undisturbed, the mean over
seeds; + is too late; *Abs* is the mean of absolute lag distances, *Worst* the largest of all seeds,
*Outside* what fell outside the border. [Accuracy](../explanation/accuracy.md) reads it for you.
"""


def table_lines(result: Result) -> list[str]:
    """Return the table for a terminal."""
    rows = _rows(result)
    widths = [max(len(row[i]) for row in (HEAD, *rows)) for i in range(len(HEAD))]
    lines = [
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in (HEAD, *rows)
    ]
    return [*lines, _basis(result)]


def write_page(result: Result, path: Path, *, plot: Path | None, command: str = COMMAND) -> None:
    """Write the page.

    Raises:
        ConfigError: when it cannot be written.
    """
    rows = [HEAD, ("---", *("---:" for _ in HEAD[1:])), *_rows(result)]
    table = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    today = datetime.now(tz=UTC).date().isoformat()
    parts = [INTRODUCTION, f"Made by `{command}` on {today}: {_basis(result)}\n"]
    if plot is not None:
        link = Path(os.path.relpath(plot, path.parent)).as_posix()
        parts.append(f"![What each disturbance costs]({link})\n")
    try:
        path.write_text("\n".join([*parts, table + "\n"]), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from None


def write_plot(result: Result, path: Path) -> None:
    """Draw what each disturbance costs.

    Raises:
        ConfigError: without matplotlib, or when the picture cannot be written.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError(f"no picture without matplotlib; {install_command('office')}")
    from matplotlib import rc_context

    from sitl.demo_pictures import COLOURS, DPI, INK, STYLE, new_figure

    height_in = 1.3 + 0.28 * len(result.rows)
    with rc_context(STYLE):
        figure = new_figure(
            (9.0, height_in),
            "What an unknown error costs",
            f"Disturbed minus undisturbed: {_basis(result)}",
        )
        left, right = figure.subplots(1, 2, sharey=True)
        figure.subplots_adjust(
            left=0.32, right=0.95, top=1.0 - 0.75 / height_in, bottom=0.5 / height_in, wspace=0.1
        )
        places = range(len(result.rows))
        lag_m = [row.lag_mean_abs_cost_m.mean for row in result.rows]
        points = [row.misapplied_cost_points.mean for row in result.rows]
        for axes, costs, colour, name, form in (
            (left, lag_m, COLOURS["scheduled"], "mean absolute lag distance [m]", "{:+.3f}"),
            (right, points, COLOURS["none"], "misapplied volume [points]", "{:+.2f}"),
        ):
            bars = axes.barh(places, costs, color=colour, height=0.65)
            axes.bar_label(bars, [form.format(cost) for cost in costs], padding=3, size=8)
            axes.set_xlabel(name)
            axes.margins(x=0.25)
            axes.axvline(0.0, lw=0.8, color=INK)
            axes.spines["left"].set_visible(False)
            axes.tick_params(axis="y", length=0)
        left.set_yticks(places, [row.label for row in result.rows])
        left.invert_yaxis()
        try:
            figure.savefig(path, dpi=DPI, facecolor="white", metadata={"Software": None})
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: cannot be written ({error})") from None


def _basis(result: Result) -> str:
    """Return what the figures rest on."""
    return (
        f"{result.flights} flights, seeds {result.seeds[0]} to {result.seeds[-1]}, "
        f"{result.fidelity} twin, {result.speed_m_s:g} m/s."
    )


def _rows(result: Result) -> list[tuple[str, ...]]:
    plain = result.undisturbed
    return [_row(result.plain, plain, None)] + [
        _row(row.label, row.figures, row) for row in result.rows
    ]


def _row(label: str, figures: Figures, row: Row | None) -> tuple[str, ...]:
    return (
        label,
        f"{figures.lag_mean_m:+.3f}",
        f"{figures.lag_mean_abs_m:.3f}",
        "" if row is None else f"{row.lag_mean_abs_cost_m.mean:+.3f}",
        f"{figures.lag_worst_m:.3f}",
        "" if row is None else f"{row.lag_worst_cost_m.mean:+.3f}",
        f"{figures.misapplied_percent:.2f}",
        "" if row is None else f"{row.misapplied_cost_points.mean:+.2f}",
        f"{figures.off_target_ml:.0f}",
    )


if __name__ == "__main__":
    sys.exit(main())
