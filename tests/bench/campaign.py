"""What a campaign costs: `python -m tests.bench.campaign [--dataset DIR] [--page]`.

Two workers of a campaign beside two processes that share nothing and fly the same flights, all four
at a time, so that what else the computer does meets both. `--dataset` takes what a long campaign
has logged. `--page` writes docs/measurements/scale.md, up to the part that others write.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import pyarrow.parquet as pq

from sitl.campaign.bundle import bundle_of
from sitl.campaign.dataset import open_dataset, read_columns
from sitl.campaign.design import read_campaign
from sitl.campaign.running import Tally, fly_missing, pool_of

PAGE = Path(__file__).resolve().parents[2] / "docs" / "measurements" / "scale.md"
FIELD = """
version = 1
seeds = {{first = {first}, count = {count}}}
[fixed]
flight.fidelity = "averaged"
"""
OTHERS = "\n## Journals"
WORKERS = (1, 8, 64)
MANY = 1_000_000
STEPS_A_SECOND = 20.0
# By cProfile of two flights of P1's field on 2026-11-26: `sitl.flight._fly_ours` 29.4 s, of which
# its `decide` and `hear` 28.9 s.
BOUND = (
    "What bounds the twin is the code that flies: estimator and controller, in Python, take 98 %",
    "of its loop by profile. A worker is as fast as a process alone at the same moment. Garbage",
    "collection costs nothing that can be measured, neighbours on the same cores do: four flights",
    "had 122 x real time at a load of 20.\n",
)
# Flies seeds of the field when it is told to, and says when each was done and what they took.
ALONE = """
import json, sys, time
from pathlib import Path
from sitl.campaign.flying import fly_flight
first, count = map(int, sys.argv[1:])
given = (("flight.fidelity", "averaged"),)
fly_flight(given, first, Path())
print("ready", flush=True)
sys.stdin.readline()
began_s, loop_s, simulated_s, done = time.process_time(), 0.0, 0.0, []
for seed in range(first + 1, first + 1 + count):
    row = fly_flight(given, seed, Path())
    loop_s += row.loop_cpu_s
    simulated_s += row.figures["simulated_s"]
    done.append(time.monotonic())
print(json.dumps([time.process_time() - began_s, simulated_s / loop_s, done]))
"""


MILLION = """
import resource, sys
from pathlib import Path
import pyarrow.parquet
import sitl.campaign.running
from sitl.campaign.design import read_campaign
campaign = read_campaign(Path(sys.argv[1]))
for number in range(0, campaign.flights, 1000):
    campaign.flight(number)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
"""
HYPERCUBE = """
version = 1
seeds = 10
[design]
kind = "latin-hypercube"
samples = 100000
[[vary]]
set = "error.lag_short_s"
low = -0.05
high = 0.05
[[vary]]
set = "vehicle.gust_m_s"
low = 0.0
high = 3.0
"""


def memory_mb() -> float:
    """Return what the scheduling process of a million flights holds before the first of them."""
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "million.toml"
        file.write_text(HYPERCUBE)
        command = [sys.executable, "-c", MILLION, str(file)]
        return float(subprocess.run(command, capture_output=True, check=True, text=True).stdout)


def compare(count: int) -> dict[str, Any]:
    """Fly by two workers of a campaign and by two processes that share nothing, all at a time.

    Each of the four gets the same share of the cores whatever else they have to do: so the rates
    until the first side is done compare the two ways, and not two moments of this computer.
    """
    started = [
        subprocess.Popen(
            [sys.executable, "-c", ALONE, str(first), str(count // 2)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
        for first in (100, 200)
    ]  # fmt: skip
    for each in started:
        assert each.stdout is not None
        each.stdout.readline()
    ours: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part, first, number in (("warm", 900, 4), ("measured", 300, count)):
            text = FIELD.format(first=first, count=number)
            (folder / f"{part}.toml").write_text(text)
        campaign = read_campaign(folder / "measured.toml")
        bundle = bundle_of(campaign)
        with pool_of(2, bundle) as pool:
            warm = open_dataset(read_campaign(folder / "warm.toml"), bundle, folder / "warm")
            fly_missing(warm, bundle, pool, Tally(), tell=lambda _: None)
            tally, dataset = Tally(), open_dataset(campaign, bundle, folder / "measured")
            began_s = time.monotonic()
            for each in started:
                assert each.stdin is not None
                each.stdin.write("\n")
                each.stdin.flush()
            fly_missing(dataset, bundle, pool, tally, tell=lambda _: ours.append(time.monotonic()))
    told = [json.loads(each.communicate()[0]) for each in started]
    theirs = sorted(at_s for _, _, done in told for at_s in done)
    end_s = min(ours[-1], theirs[-1])
    rates = [sum(at_s <= end_s for at_s in done) / (end_s - began_s) for done in (ours, theirs)]
    of = tally.as_json()
    alone = {
        "flights_per_cpu_s": count / sum(cpu_s for cpu_s, _, _ in told),
        "times_real_time": sum(times for _, times, _ in told) / len(told),
    }
    return {
        "flights_per_s": rates[0],
        "flights_per_s_alone": rates[1],
        "flights_per_s_ratio": rates[0] / rates[1],
        "overhead_percent": of["overhead_percent"],
    } | {
        key: value
        for name, theirs_is in alone.items()
        for key, value in (
            (name, of[name]), (f"{name}_alone", theirs_is), (f"{name}_ratio", of[name] / theirs_is)
        )
    }  # fmt: skip


def logged(folder: Path) -> dict[str, Any]:
    """Return what the runs of a dataset took, and its size."""
    runs = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    parts = list((folder / "flights").glob("part=*/flights.parquet"))
    size = json.loads((folder / "manifest.json").read_text())["part_flights"]
    rows, in_one = read_columns(folder, None), io.BytesIO()
    pq.write_table(rows, in_one, compression="zstd", compression_level=3)
    sums = {
        key: sum(run[key] for run in runs)
        for key in ("flown", "failed", "wall_s", "flight_cpu_s", "own_cpu_s")
    }
    return sums | {
        "runs": len(runs),
        "written": len(parts) * size,
        "bytes_per_flight": sum(part.stat().st_size for part in parts) / (len(parts) * size),
        "bytes_in_one": in_one.tell() / len(rows),
        "flights_per_cpu_s": (sums["flown"] - sums["failed"]) / sums["flight_cpu_s"],
        "overhead_percent": 100.0 * sums["own_cpu_s"] / sums["flight_cpu_s"],
        "own_s_per_flight": sums["own_cpu_s"] / sums["flown"],
        "times_real_time": median(run["times_real_time"] for run in runs if run["times_real_time"]),
    }


def page(found: dict[str, Any], log: dict[str, Any] | None, command: str) -> str:
    """Return the page's first part."""
    of = log or found
    rate = of["flights_per_cpu_s"]
    lines = [
        "<!-- Written by `python -m tests.bench.campaign --page` down to Journals; do not edit that"
        " part. -->\n",
        "# Scale\n",
        "What one core does, where the limits are, and what a million flights cost. *Measured* is",
        "marked apart from *computed*.\n",
        "## Campaigns, measured\n",
        f"Made by `{command}` on {datetime.now(tz=UTC).date()}, {os.cpu_count()} x86_64 cores with"
        f" other programs, load average {os.getloadavg()[0]:.1f}: times are upper bounds, ratios"
        " are of the same run.\n",
        "| What | Measured | Target |",
        "| --- | --- | --- |",
        "| two workers over two processes that share nothing: flights a second | "
        f"{found['flights_per_s_ratio']:.2f} | >= 0.9 |",
        "| the same, flights a second of processor time | "
        f"{found['flights_per_cpu_s_ratio']:.2f} | |",
        "| averaged twin in a worker over the same outside | "
        f"{found['times_real_time_ratio']:.2f} | |",
        f"| averaged twin in a worker | {found['times_real_time']:.0f} x real time | >= 300 |",
        "| the same, processor time of a control step, of which there are 20 a second | "
        f"{_step_ms(found['times_real_time']):.2f} ms | <= {_step_ms(300.0):.2f} |",
    ]
    if log is not None:
        lines += [
            "| flights of the published field, a campaign killed and resumed | "
            f"{log['written']} | 2000 |",
            f"| flights a second and core | {log['flights_per_cpu_s']:.2f} | |",
            "| scheduling and writing, of a flight's processor time | "
            f"{log['overhead_percent']:.2f} % | <= 5 |",
            f"| dataset, bytes a flight: in parts of 10, in one | {log['bytes_per_flight']:.0f}, "
            f"{log['bytes_in_one']:.0f} | |",
        ]
    lines += [
        "| memory of the scheduling process with a hypercube of a million flights | "
        f"{found['memory_mb']:.0f} MB | |",
        "",
        *BOUND,
        *_computed(rate, of, log),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _step_ms(times_real_time: float) -> float:
    return 1000.0 / STEPS_A_SECOND / times_real_time


def _computed(rate: float, of: dict[str, Any], log: dict[str, Any] | None) -> list[str]:
    own_s = log["own_s_per_flight"] if log else of["overhead_percent"] / 100.0 / rate
    lines = [
        "## Campaigns, computed\n",
        f"A million such flights at {rate:.2f} a second and core, a core for each worker:\n",
        "| Workers | Time | Processor time |",
        "| --- | --- | --- |",
    ]
    for workers in WORKERS:
        hours = MANY / rate / 3600.0 / workers
        lines.append(f"| {workers} | {hours:.1f} h | {MANY / rate / 3600.0:.0f} core hours |")
    lines += [
        "",
        "- One process schedules and writes. At "
        f"{1000.0 * own_s:.1f} ms a flight it is busy all the time with "
        f"{1.0 / (own_s * rate):.0f} workers; more of them bring nothing.",
        "- It holds the points of the design, the rows of parts under way, and two flights a "
        "worker; not the flights to come.",
        "- A million flights are 200 parts of 5000: a killed scheduler loses the parts under way.",
        "- Files travel once to each worker, 200 MB at most.",
    ]
    if log is not None:
        lines.append(f"- Their dataset has {MANY * log['bytes_in_one'] / 1e9:.2f} GB.")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print JSON, and write the page where it is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--dataset", type=Path)
    parser.add_argument("--page", action="store_true")
    given = parser.parse_args(arguments)
    found = compare(given.flights) | {"memory_mb": memory_mb()}
    log = None if given.dataset is None else logged(given.dataset)
    sys.stdout.write(json.dumps({"compared": found, "logged": log}, indent=1) + "\n")
    if given.page:
        words = [f"--flights {given.flights}"]
        words += ["--dataset DIR"] if log else []
        text = page(found, log, f"python -m tests.bench.campaign {' '.join(words)}")
        rest = ""
        if PAGE.exists():
            _, mark, rest = PAGE.read_text(encoding="utf-8").partition(OTHERS)
            rest = mark + rest
        PAGE.write_text(text + rest, encoding="utf-8")


if __name__ == "__main__":
    main()
