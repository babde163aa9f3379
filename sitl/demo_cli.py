"""Command line of the demo: `vrspray demo`."""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from companion.cli.answer import AsJson, answer, new_app, note, progress
from companion.cli.terminal import terminal, visible
from companion.wording import missing, writing
from sitl.cli import FlowLaw
from sitl.workers import termination_as_interrupt

if TYPE_CHECKING:
    from sitl.demo import DemoOptions, DemoResult


JOURNAL = "flight-0001.gpkg"
PICTURES = ("map.png", "lags.png", "flow.png")
# The report of the journal's flight; a folder.
FLIGHT_REPORT = "flight-report"
FILES = ("demo.json", "report.html", JOURNAL, *PICTURES, FLIGHT_REPORT)
# The table where the output is not a terminal.
WIDTH = 110
# From here on there is room between the columns.
WIDE = 96


class Fidelity(StrEnum):
    """How the twin simulates the flow."""

    PULSED = "pulsed"
    AVERAGED = "averaged"


class Output(StrEnum):
    """Which way the orders take to the valves."""

    GPIO = "gpio"
    SERVO = "servo"


app = new_app()


@app.command(epilog="Example: vrspray demo --out demo-out --speed 5 --seed 2")
def demo_flights(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")] = Path(
        "demo-out"
    ),
    speed: Annotated[
        list[float] | None,
        typer.Option(metavar="V", help="Speed [m/s], 1 to 15; repeatable. Default: 4, 5, 6."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 1,
    fidelity: Annotated[Fidelity, typer.Option(help="Pulses, or their mean.")] = Fidelity.PULSED,
    output: Annotated[
        Output, typer.Option(help="Lines of this computer, or servo outputs of the autopilot.")
    ] = Output.GPIO,
    flow_law: Annotated[
        FlowLaw | None,
        typer.Option(help="True flow between measured points; default: the profile's."),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(metavar="MODULE:CLASS", help="Your own controller, beside the others."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Fly the field of Wang et al. 2024 with all methods and compare them.

    Simulated: no hardware, no network. Exit 0: flown; 2: an option or the folder is wrong; 130:
    interrupted.
    """
    began_s = time.perf_counter()
    from sitl.demo import DemoOptions, check

    options = DemoOptions(
        speeds_m_s=tuple(dict.fromkeys(speed or DemoOptions().speeds_m_s)),
        seed=seed,
        fidelity=fidelity.value,
        output=output.value,
        flow_law=None if flow_law is None else flow_law.value,
        controller=controller,
    )
    check(options)
    with termination_as_interrupt(), _staging(out) as stage:
        result = _flown(options, stage, quiet=as_json)
        found = {**result.as_json(), "wall_s": time.perf_counter() - began_s}
        names = _write(result, found, stage)
        _move(names, stage, out)
    answer(found, (), as_json=as_json)
    if not as_json:
        _print(result, [out / name for name in names])


def _flown(options: DemoOptions, stage: Path, *, quiet: bool) -> DemoResult:
    from sitl.demo import fly_demo, jobs_of

    total = len(jobs_of(options, None))
    flown = itertools.count(1)
    with progress(quiet=quiet) as tell:
        tell("flights", 0, total)
        return fly_demo(
            options, journal_folder=stage, on_flown=lambda: tell("flights", next(flown), total)
        )


# ---------------------------------------------------------------------------------------- the files


@contextmanager
def _staging(out: Path) -> Iterator[Path]:
    """Yield a folder inside `out` that is gone afterwards: there is all of a demo or nothing."""
    is_new = not out.exists()
    with writing(f"--out {out}"):
        out.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=".demo-", dir=out))
    try:
        yield stage
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        if is_new and not any(out.iterdir()):
            out.rmdir()


def _write(result: DemoResult, found: dict[str, Any], stage: Path) -> list[str]:
    """Write what belongs to a demo and return the names of the files."""
    from sitl.demo_page import page

    pictures: Sequence[str] = ()
    if importlib.util.find_spec("matplotlib") is None:
        note(f"no pictures: {missing('matplotlib')}")
    else:
        from sitl.demo_pictures import draw_pictures

        pictures = draw_pictures(result, stage)
    text = json.dumps(found, indent=1, allow_nan=False)
    (stage / "demo.json").write_text(text + "\n", encoding="utf-8")
    document = page(result, [stage / name for name in pictures])
    (stage / "report.html").write_text(document, encoding="utf-8")
    if can_report():
        write_report(stage / JOURNAL, stage / FLIGHT_REPORT)
    else:
        note(f"no report of the flight: {missing('jinja2 or matplotlib')}")
    return [name for name in FILES if (stage / name).exists()]


def _move(names: Sequence[str], stage: Path, out: Path) -> None:
    """Put the files in their place, and take away those of an earlier demo that have no new one."""
    with writing(f"--out {out}"):
        for name in FILES:
            if name == FLIGHT_REPORT and (out / name).is_dir():
                shutil.rmtree(out / name)
            if name in names:
                (stage / name).replace(out / name)
            else:
                (out / name).unlink(missing_ok=True)


# ---------------------------------------------------------------------------------------- the table


def _print(result: DemoResult, paths: Sequence[Path]) -> None:
    from sitl.demo_page import legend_lines, sentence

    console = Console(highlight=False, file=terminal(sys.stdout))
    if not console.is_terminal:
        console = Console(highlight=False, width=WIDTH, file=terminal(sys.stdout))
    console.print(_table(result, padding=1 if console.width >= WIDE else 0))
    for line in (*legend_lines(), ""):
        console.print(line, style="dim")
    console.print(sentence(result))
    console.print(
        visible(f"Files in {paths[0].parent}{os.sep}: {', '.join(path.name for path in paths)}")
    )


def _table(result: DemoResult, *, padding: int) -> Table:
    from sitl.demo_page import COLUMNS, rows_of

    table = Table(box=SIMPLE_HEAD, padding=(0, padding), pad_edge=False)
    for number, name in enumerate(COLUMNS):
        table.add_column(name, justify="left" if number == 1 else "right", no_wrap=True)
    for group in rows_of(result):
        for number, row in enumerate(group):
            last = number == len(group) - 1
            style = "dim italic" if row.published else "bold" if row.ours else None
            table.add_row(*row.cells, style=style, end_section=last)
    return table


# What the program's own command line takes in: one command of the kind that Typer makes.
demo = typer.main.get_command(app)


# The report of the demo's flight, as `vrspray report` makes it of any journal.

# What a report needs besides the program itself: the extra `report`.
NEEDED = ("jinja2", "matplotlib")


def can_report() -> bool:
    """Return whether all is installed that a report needs."""
    return all(importlib.util.find_spec(name) is not None for name in NEEDED)


def write_report(journal: Path, folder: Path) -> None:
    """Evaluate the flight in `journal` and write its report into `folder`."""
    from analysis.report.build import ReportOptions, build_report
    from analysis.report.folder import write_files

    write_files(folder, build_report(journal, ReportOptions()).files)
