r"""Measure everything: one JSON object on stdout, a table and the progress on stderr.

    python -m tests.bench [SEED] [--only 'arc-*'] [--quick] > results.json
    python -m tests.bench --from times.json --from results.json \
        --page docs/measurements/performance.md

Parts may be measured at different times; the page says when each one was.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from companion.errors import ConfigError
from sitl.own_method import load_controller
from tests.bench.figures import Figure, rounded, table
from tests.bench.parts import PARTS, Options, Part, chosen
from tests.bench.report import page

SEEDS, QUICK_SEEDS = 20, 3
PROCESSES = 2
OURS_MIN = 0.9
# Waiting for messages is no work: this part says nothing of how busy the machine is.
WAITING = "arrivals"


@dataclass(slots=True)
class Run:
    """What has been measured so far."""

    figures: list[Figure] = field(default_factory=list)
    took_s: dict[str, float] = field(default_factory=dict)
    load: float = field(default_factory=lambda: os.getloadavg()[0])
    worked_s: float = 0.0
    timed_s: float = 0.0

    @property
    def wall_s(self) -> float:
        """Return the time of all parts."""
        return sum(self.took_s.values())

    @property
    def ours(self) -> float | None:
        """Return which share of the time this program had a core, while times were measured."""
        return self.worked_s / self.timed_s if self.timed_s > 0.0 else None


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the results; 0 even where a target is missed: the figures are the result."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser()
    given = parser.parse_args(words)
    count = given.seeds or (QUICK_SEEDS if given.quick else SEEDS)
    if given.controller is not None:
        try:
            load_controller(given.controller)  # refused before any flight
        except ConfigError as error:
            parser.error(str(error))
    options = Options(
        seed=given.seed,
        count=count,
        is_quick=given.quick,
        flights=given.flights,
        processes=given.processes,
        controller=given.controller,
        say=say,
    )
    # With saved results only what is asked for by name is measured again.
    parts = [] if given.saved and not given.only else chosen(given.only, options)
    if given.only and not parts:
        parser.error(f"--only {given.only[0]}: choose of {', '.join(p.name for p in PARTS)}")
    sources = [_read(parser, path) for path in given.saved]
    if parts:
        run = measure(parts, options)
        found = results(run, options, command=f"python -m tests.bench {shlex.join(words)}".strip())
        print_results(run.figures, found)
        sources.append(found)
    if given.page is not None:
        given.page.write_text(page(sources), "utf-8")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("seed", nargs="?", type=int, default=1, help="the first of the seeds")
    parser.add_argument("--quick", action="store_true", help="3 seeds, 5 m/s, smaller samples")
    parser.add_argument("--seeds", type=int, help=f"how many seeds; {SEEDS} unless told")
    parser.add_argument("--only", action="append", default=[], metavar="PATTERN", help="some parts")
    parser.add_argument("--flights", type=int, default=0, help="calibration missions more; 200")
    parser.add_argument("--processes", type=int, default=PROCESSES, help="flights at a time")
    parser.add_argument(
        "--controller", metavar="MODULE:CLASS", help="fly one's own method beside ours"
    )
    parser.add_argument("--page", type=Path, help="also write a page of Markdown here")
    parser.add_argument(
        "--from", dest="saved", action="append", default=[], type=Path, metavar="JSON",
        help="results saved before; of figures in two of them the later one counts",
    )  # fmt: skip
    return parser


def _read(parser: argparse.ArgumentParser, path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        parser.error(f"--from {path}: cannot be read ({error})")
    if not isinstance(found, dict) or not isinstance(found.get("figures"), dict):
        parser.error(f"--from {path}: these are no results of this program")
    return found


def measure(parts: Sequence[Part], options: Options) -> Run:
    """Measure the parts one after the other: times first, before anything runs beside them."""
    run = Run()
    for part in sorted(parts, key=lambda part: not part.is_timed):
        say(part.name)
        wall, cpu = perf_counter(), process_time()
        run.figures += part.run(options)
        run.took_s[part.name] = perf_counter() - wall
        if part.is_timed and part.name != WAITING:
            run.worked_s += process_time() - cpu
            run.timed_s += run.took_s[part.name]
        say(f"{part.name}: {run.took_s[part.name]:.0f} s")
    # What other programs took away shows here: 1.0 is a machine of our own.
    if run.ours is not None and run.ours < OURS_MIN:
        say(f"the machine is busy: {run.ours:.0%} of the time was ours; timings are too long")
    return run


def results(run: Run, options: Options, *, command: str) -> dict[str, Any]:
    """Return the JSON object."""
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "command": command,
        "seed": options.seed,
        "seeds": options.count,
        "quick": options.is_quick,
        "machine": {
            "python": platform.python_version(),
            "architecture": platform.machine(),
            "cores": os.cpu_count(),
            "load_before": rounded(run.load),
            "ours_while_timing": rounded(run.ours),
        },
        "wall_s": rounded(run.wall_s),
        "parts_s": rounded(run.took_s),
        "missed_targets": [figure.key for figure in run.figures if figure.met is False],
        "figures": {figure.key: figure.as_json() for figure in run.figures},
    }


def print_results(figures: Sequence[Figure], found: dict[str, Any]) -> None:
    """Write the table to stderr and the JSON object to stdout."""
    parts = ", ".join(f"{name} {took:.0f} s" for name, took in found["parts_s"].items())
    sys.stderr.write(table(figures) + f"\n\nseed {found['seed']}; {parts}\n")
    sys.stderr.flush()
    sys.stdout.write(json.dumps(found, indent=1) + "\n")


def say(text: str) -> None:
    """Tell the progress."""
    sys.stderr.write(f"{text} ...\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
