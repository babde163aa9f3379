"""How long the report of a flight takes: `python -m tests.bench.reports [JOURNAL] [--repeats N]`.

Without a journal it flies `examples/orchard` (21 minutes, 6 valves, a flow meter at 50 Hz). The
whole command runs in a process of its own, start and imports with it; the evaluation alone is
`analysis.evaluation.evaluate` on a record that is at hand. Processor time (user and system), which
other programs on the machine take nothing of but the caches; the wall clock beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

from analysis.assess.assessment import assess
from analysis.evaluation import evaluate
from analysis.flown.applied_record import record_of
from analysis.flown.read_applied import read_applied

ORCHARD = Path(__file__).parents[2] / "examples" / "orchard"


def flown(folder: Path) -> Path:
    """Fly the orchard and return the journal."""
    words = ["sitl", "fly", "--config", str(ORCHARD / "config.toml")]
    words += ["--mission", str(ORCHARD / "mission.waypoints"), "--out", str(folder), "--seed", "1"]
    _vrspray(words)
    return folder / "flight-0001.gpkg"


def command_s(journal: Path, *options: str) -> tuple[float, float]:
    """Return processor and wall time of one `vrspray report`."""
    with tempfile.TemporaryDirectory() as folder:
        begin, before = perf_counter(), os.times()
        _vrspray(["report", str(journal), "--out", folder, *options])
        after = os.times()
        cpu_s = after.children_user - before.children_user
        return cpu_s + after.children_system - before.children_system, perf_counter() - begin


def stages_s(journal: Path) -> dict[str, float]:
    """Return the processor time of reading, of the evaluation alone and of all that is assessed."""
    marks = [process_time()]
    flight = read_applied(journal)
    marks.append(process_time())
    record = record_of(flight)
    marks.append(process_time())
    evaluate(record)
    marks.append(process_time())
    assess(flight)
    marks.append(process_time())
    names = ("read", "record", "evaluation alone", "assessment")
    return {name: marks[i + 1] - marks[i] for i, name in enumerate(names)}


def measured(journal: Path, repeats: int) -> dict[str, Any]:
    """Return the medians over some repeats, and the worst of the whole command."""
    runs = [command_s(journal) for _ in range(repeats)]
    pdf = [command_s(journal, "--pdf") for _ in range(repeats)]
    stages = [stages_s(journal) for _ in range(repeats)]
    return {
        "repeats": repeats,
        "report_cpu_s": median(cpu for cpu, _ in runs),
        "report_cpu_worst_s": max(cpu for cpu, _ in runs),
        "report_wall_s": median(wall for _, wall in runs),
        "report_pdf_cpu_s": median(cpu for cpu, _ in pdf),
        "stages_cpu_s": {key: median(each[key] for each in stages) for key in stages[0]},
        "load": os.getloadavg()[0],
    }


def _vrspray(words: Sequence[str]) -> None:
    program = "import sys; from companion.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, *words]
    subprocess.run(command, check=True, capture_output=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print one JSON object."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.reports", description=__doc__)
    parser.add_argument("journal", nargs="?", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        found = measured(given.journal or flown(Path(folder)), given.repeats)
    sys.stdout.write(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
