"""Measure everything: one JSON object on stdout, a table and the progress on stderr."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from tests.bench.accuracy import accuracy
from tests.bench.arrival import arrivals
from tests.bench.figures import Figure, rounded, table
from tests.bench.flights import fly_all, tasks
from tests.bench.loading import loading, raster
from tests.bench.lookup import cell_lookup, lookup_growth, lookups
from tests.bench.realtime import times_real_time
from tests.bench.report import page
from tests.bench.steps import growth, large_field, small_field

SEEDS, QUICK_SEEDS = 20, 3
PROCESSES = 2
OURS_MIN = 0.9

Say = Callable[[str], None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the results; 0 even where a target is missed: the figures are the result."""
    given = _parser().parse_args(arguments)
    begin, load = perf_counter(), os.getloadavg()[0]
    count = given.seeds or (QUICK_SEEDS if given.quick else SEEDS)
    seeds = range(given.seed, given.seed + count)
    timed, share = timings(given.seed, is_quick=given.quick, say=say)
    figures = [*timed, *flights(seeds, is_quick=given.quick, say=say)]
    wall_s = perf_counter() - begin
    print_results(figures, seed=given.seed, is_quick=given.quick, wall_s=wall_s)
    if given.page is not None:
        busy = f"{share:.0%} of one core was ours while timing, load average before {load:.1f}"
        about = {
            "machine": f"{os.cpu_count()} {platform.machine()} cores",
            "python": platform.python_version(),
            "busy": busy,
        }
        quick = " --quick" if given.quick else ""
        text = f"{given.seed} --seeds {count}{quick} --page docs/performance.md"
        given.page.write_text(page(figures, arguments=text, seeds=seeds, about=about), "utf-8")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("seed", nargs="?", type=int, default=1, help="the first of the seeds")
    parser.add_argument("--quick", action="store_true", help="3 seeds, 5 m/s, smaller samples")
    parser.add_argument("--seeds", type=int, help=f"how many seeds; {SEEDS} unless told")
    parser.add_argument("--page", type=Path, help="also write a page of Markdown here")
    return parser


def timings(seed: int, *, is_quick: bool, say: Say) -> tuple[list[Figure], float]:
    """Measure what is measured in time, before anything runs beside it.

    Returns also which share of the time this program had a core to itself.
    """
    wall, cpu = perf_counter(), process_time()
    zones = (100, 10_000) if is_quick else (100, 1_000, 10_000, 100_000)
    say("core steps")
    figures = [
        small_field(seed=seed, repeats=1 if is_quick else 3),
        large_field(seed=seed, length_m=300.0 if is_quick else 900.0),
        growth(seed=seed, zones=zones),
    ]
    say("look-ups, simulation, maps")
    figures += lookups(seed=seed)
    figures.append(lookup_growth(seed=seed, zones=(100, 10_000 if is_quick else 100_000)))
    figures.append(cell_lookup(seed=seed))
    figures.append(times_real_time(seed=seed, repeats=2 if is_quick else 4))
    figures.append(loading(seed=seed, repeats=1 if is_quick else 3))
    figures += raster(seed=seed, repeats=1 if is_quick else 3)
    # What other programs took away shows here: 1.0 is a machine of our own.
    share = (process_time() - cpu) / (perf_counter() - wall)
    if share < OURS_MIN:
        say(f"the machine is busy: {share:.0%} of the time was ours; timings are too long")
    say("message to orders")
    return figures + arrivals(seed=seed, count=100 if is_quick else 400), share


def flights(seeds: range, *, is_quick: bool, say: Say) -> list[Figure]:
    """Measure the accuracy of many flights, in two processes."""
    todo = tasks(seeds, is_quick=is_quick)

    def progress(done: int) -> None:
        if done % 10 == 0 or done == len(todo):
            say(f"flights: {done} of {len(todo)} paths")

    return accuracy(fly_all(todo, processes=PROCESSES, progress=progress))


def results(
    figures: Sequence[Figure], *, seed: int, is_quick: bool, wall_s: float
) -> dict[str, Any]:
    """Return the JSON object."""
    return {
        "seed": seed,
        "quick": is_quick,
        "machine": {
            "python": platform.python_version(),
            "architecture": platform.machine(),
            "cores": os.cpu_count(),
        },
        "wall_s": rounded(wall_s),
        "missed_targets": [figure.key for figure in figures if figure.met is False],
        "figures": {figure.key: figure.as_json() for figure in figures},
    }


def print_results(figures: Sequence[Figure], *, seed: int, is_quick: bool, wall_s: float) -> None:
    """Write the table to stderr and the JSON object to stdout."""
    found = results(figures, seed=seed, is_quick=is_quick, wall_s=wall_s)
    sys.stderr.write(table(figures) + f"\n\nseed {seed}, {wall_s:.0f} s\n")
    sys.stderr.flush()
    sys.stdout.write(json.dumps(found, indent=1) + "\n")


def say(text: str) -> None:
    """Tell the progress."""
    sys.stderr.write(f"{text} ...\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
