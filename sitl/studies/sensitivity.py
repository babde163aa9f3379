"""What an error that nobody knows of costs: of lag, of position, of its rate, of wind.

    python -m sitl.studies.sensitivity --page docs/measurements/sensitivity.md

flies the field of Wang et al. 2024 (P1) with `scheduled`, once undisturbed and once with each
disturbance, and compares flights of the same seed. Wind is not flown: where the undisturbed
flight's liquid lands is moved by wind x fall time and judged again.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import sys
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Annotated

import typer

from analysis.evaluation import Evaluation, evaluate
from analysis.flight_record import Fidelity, FlightRecord
from companion.cli.answer import AsJson, answer, note
from companion.errors import ConfigError, VrsprayError
from companion.wording import install_command
from sitl.demo_field import demo_lags, demo_setup, demo_trajectory
from sitl.disturbances import (
    UNDISTURBED,
    Disturbance,
    chosen,
    displaced,
    drifted,
    shortened,
)
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile

SPEED_M_S = 5.0
PROFILE = "wang-2024"


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
    def of(found: Evaluation) -> Figures:
        """Return the figures of one flight.

        Raises:
            VrsprayError: when there was nothing to measure.
        """
        lag = found.lag_distance_m
        mean, mean_abs, worst = lag.mean, lag.mean_abs, lag.max_abs
        misapplied = found.misapplied_percent
        if mean is None or mean_abs is None or worst is None or misapplied is None:
            raise VrsprayError(f"seed {found.meta.seed}: no change of rate could be measured")
        return Figures(
            lag_mean_m=mean,
            lag_mean_abs_m=mean_abs,
            lag_worst_m=worst,
            misapplied_percent=misapplied,
            off_target_ml=found.off_target_ml,
            apart=found.apart,
            missed=found.missed,
        )

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

    key: str
    label: str
    figures: Figures
    lag_mean_abs_cost_m: Cost
    lag_worst_cost_m: Cost
    misapplied_cost_points: Cost
    off_target_cost_ml: Cost

    @staticmethod
    def of(what: Disturbance, flights: list[Figures], plain: list[Figures]) -> Row:
        """Return the row of the flights of some seeds beside the undisturbed ones."""
        return Row(
            key=what.key,
            label=what.label,
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
    fidelity: Fidelity
    seeds: tuple[int, ...]
    flights: int
    undisturbed: Figures
    rows: tuple[Row, ...]


def measure(
    what: Iterable[Disturbance],
    *,
    seeds: Iterable[int],
    fidelity: Fidelity = "pulsed",
    on_flown: Callable[[], None] = lambda: None,
) -> Result:
    """Fly every disturbance with every seed; the same arguments give the same figures."""
    disturbances, numbers = tuple(what), tuple(seeds)
    plain: list[Figures] = []
    found: dict[str, list[Figures]] = {each.key: [] for each in disturbances}
    flights = 0
    for seed in numbers:
        record = flown(UNDISTURBED, seed=seed, fidelity=fidelity)
        plain.append(Figures.of(evaluate(record)))
        on_flown()
        flights += 1
        for each in disturbances:
            if each.is_drift:
                landed = drifted(record, each, demo_setup(SPEED_M_S).frame)
            else:
                landed = flown(each, seed=seed, fidelity=fidelity)
                flights += 1
            found[each.key].append(Figures.of(evaluate(landed)))
            on_flown()
    return Result(
        speed_m_s=SPEED_M_S,
        fidelity=fidelity,
        seeds=numbers,
        flights=flights,
        undisturbed=Figures.all_of(plain),
        rows=tuple(Row.of(each, found[each.key], plain) for each in disturbances),
    )


def flown(what: Disturbance, *, seed: int, fidelity: Fidelity) -> FlightRecord:
    """Return the truth of one flight whose controller knows nothing of the disturbance."""
    profile, setup = load_profile(PROFILE), demo_setup(SPEED_M_S)
    result = fly(
        replace(setup, lag=shortened(demo_lags("gpio"), what)),
        demo_trajectory(SPEED_M_S, seed),
        profile,
        FlightOptions(fidelity=fidelity, seed=seed, position_rate_hz=what.rate_hz),
        speed_m_s=SPEED_M_S,
        disturb=partial(displaced, what=what, frame=setup.frame),
    )
    return result.record


app = typer.Typer(add_completion=False, rich_markup_mode=None)


@app.command(epilog="Example: python -m sitl.studies.sensitivity --seeds 5 --only lag-short-20")
def sensitivity(
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Seeds 1 to N.")] = 5,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY", help="This disturbance; may be repeated. Default: all."),
    ] = None,
    averaged: Annotated[
        bool, typer.Option("--averaged", help="The mean of the pulses instead of pulses.")
    ] = False,
    page: Annotated[Path | None, typer.Option(metavar="MD", help="Write the page.")] = None,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the costs.")] = None,
    as_json: AsJson = False,
) -> None:
    """Say what errors of lag, position, rate and wind cost in lag distance and volume."""
    result = measure(
        chosen(only or ()),
        seeds=range(1, seeds + 1),
        fidelity="averaged" if averaged else "pulsed",
    )
    if plot is not None:
        write_plot(result, plot)
    if page is not None:
        command = f"{COMMAND} {shlex.join(sys.argv[1:])}".strip()
        write_page(result, page, plot=plot, command=command)
    answer(asdict(result), table_lines(result), as_json=as_json)


def main() -> int:
    """Run it; what a user did wrong is one line."""
    try:
        app()
    except ConfigError as error:
        note(f"error: {error}")
        return 2
    except VrsprayError as error:
        note(f"error: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())


# How the costs of errors are shown: lines for a terminal, a page, a picture.

COMMAND = "python -m sitl.studies.sensitivity"
HEAD = (
    "Disturbance", "Lag mean [m]", "Abs [m]", "Cost [m]", "Worst [m]", "Cost [m]",
    "Misapplied [%]", "Cost [points]", "Outside [mL]",
)  # fmt: skip

INTRODUCTION = """\
<!-- Written by `python -m sitl.studies.sensitivity`; do not edit. -->

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

    from sitl.demo_style import COLOURS, DPI, INK, STYLE, new_figure

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
    return [_row("undisturbed, positions at 20 Hz", plain, None)] + [
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
