"""Measure everything: one JSON object on stdout, a table and the progress on stderr."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from time import perf_counter, process_time
from typing import Any

from tests.bench.accuracy import accuracy
from tests.bench.arrival import arrivals
from tests.bench.figures import Figure, rounded, table
from tests.bench.flights import fly_all, tasks
from tests.bench.loading import loading
from tests.bench.lookup import lookups
from tests.bench.realtime import times_real_time
from tests.bench.steps import growth, large_field, small_field

SEEDS, QUICK_SEEDS = 20, 3
PROCESSES = 2

Say = Callable[[str], None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the results; 0 even where a target is missed: the figures are the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("seed", nargs="?", type=int, default=1, help="the first of the seeds")
    parser.add_argument("--quick", action="store_true", help="3 seeds, 5 m/s, smaller samples")
    given = parser.parse_args(arguments)
    begin = perf_counter()
    figures = [
        *timings(given.seed, is_quick=given.quick, say=say),
        *flights(given.seed, is_quick=given.quick, say=say),
    ]
    print_results(figures, seed=given.seed, is_quick=given.quick, wall_s=perf_counter() - begin)
    return 0


def timings(seed: int, *, is_quick: bool, say: Say) -> list[Figure]:
    """Measure what is measured in time, one after the other, before anything runs beside it."""
    wall, cpu = perf_counter(), process_time()
    zones = (100, 10_000) if is_quick else (100, 1_000, 10_000, 100_000)
    say("core steps")
    figures = [
        small_field(seed=seed, repeats=1 if is_quick else 3),
        large_field(seed=seed),
        growth(seed=seed, zones=zones),
    ]
    say("look-ups, simulation, maps")
    figures += lookups(seed=seed)
    figures.append(times_real_time(seed=seed, repeats=2 if is_quick else 4))
    figures.append(loading(seed=seed, repeats=1 if is_quick else 3))
    # What other programs took away shows here: 1.0 is a machine of our own.
    share = (process_time() - cpu) / (perf_counter() - wall)
    if share < 0.9:
        say(f"the machine is busy: {share:.0%} of the time was ours; timings are too long")
    say("message to orders")
    return figures + arrivals(seed=seed, count=100 if is_quick else 400)


def flights(seed: int, *, is_quick: bool, say: Say) -> list[Figure]:
    """Measure the accuracy of many flights, in two processes."""
    todo = tasks(range(seed, seed + (QUICK_SEEDS if is_quick else SEEDS)), is_quick=is_quick)

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
