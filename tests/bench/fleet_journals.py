"""What a fleet's records cost: `python -m tests.bench.fleet_journals [--rows N] [--flown N] ...`.

Flights of the twin over P1's field are flown and recorded, each with a seed of its own (`--flown`;
kept in `--keep` for the next time), and copied as other flights until there are `--journals` of
them: those are added. A second fleet has `--rows` synthetic flights
and `--real` of the journals: it is queried and reported. Each command runs in a process of its own;
printed are its seconds by the clock, its processor time, and the peak of its memory.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from analysis.fleet.flight_row import recorded
from analysis.fleet.row import Row
from analysis.fleet.store import Store
from tests.analysis.fleet_flights import copied, started

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "anyang"
MACHINES, FIELDS, PRODUCTS, OPERATORS = 40, 300, 12, 25
CHILD = """
import json, resource, sys, time
from companion.cli.app import execute
began_s = time.perf_counter()
code = execute(sys.argv[1:])
used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
peak = next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM'))
print(json.dumps({
    'code': code, 'wall_s': time.perf_counter() - began_s, 'peak_mb': int(peak) / 1024,
    'cpu_s': sum(each.ru_utime + each.ru_stime for each in used),
}), file=sys.stderr)
"""
SQL = (
    "SELECT machine, month, count(*) AS flights, sum(area_ha) AS ha, sum(applied_l) AS l, "
    "sum(missed_changes) AS missed, quantile_cont(mean_lag_m, 0.95) AS lag FROM flights "
    "WHERE kind = 'real' GROUP BY ALL ORDER BY ALL"
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print a line for each command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--real", type=int, default=200)
    parser.add_argument("--journals", type=int, default=1000)
    parser.add_argument("--flown", type=int, default=200)
    parser.add_argument("--keep", type=Path, help="where flown journals are, or are put")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--evaluate", type=int, default=200, help="journals of the second step")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flown = _flown(given.keep or folder / "flown", given.flown, given.seed)
        journals = _journals(folder / "journals", flown, given.journals)
        added = str(folder / "added")
        told = measured("add --quick", "fleet", "add", str(journals), "--into", added, "--quick")
        _say(f"  {told['journals'] / told['record_s']:.1f} journals a second by the clock")
        _say(f"  {told['journals'] / told['cpu_s']:.1f} journals a second of processor time")
        before = _digest(folder / "added")
        measured("the same again", "fleet", "add", str(journals), "--into", added, "--quick")
        _say(f"  folder unchanged: {_digest(folder / 'added') == before}")
        some = _some(journals, folder / "some", given.evaluate)
        told = measured("add", "fleet", "add", str(some), "--into", str(folder / "evaluated"))
        _say(f"  {told['journals'] / told['cpu_s']:.1f} evaluated a second of processor time")
        fleet = str(folder / "fleet")
        synthetic(Store.at(fleet), next(journals.iterdir()), given.rows, seed=given.seed)
        real = _some(journals, folder / "real", given.real)
        measured("real journals beside", "fleet", "add", str(real), "--into", fleet)
        measured("query", "fleet", "query", SQL, "--fleet", fleet)
        measured("report", "fleet", "report", "--fleet", fleet, "--out", str(folder / "report"))
        size = sum(each.stat().st_size for each in Path(fleet).rglob("*.parquet"))
        _say(f"{size / (given.rows + given.real):.0f} bytes a flight")
    return 0


def measured(what: str, *arguments: str) -> dict[str, Any]:
    """Run a command, print what it took, and return its answer with that."""
    command = [sys.executable, "-c", CHILD, *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = json.loads(done.stderr.strip().splitlines()[-1])
    if told["code"] != 0:
        raise SystemExit(done.stderr)
    _say(
        f"{what}: {told['wall_s']:.2f} s, {told['cpu_s']:.2f} s of processor time, "
        f"peak {told['peak_mb']:.0f} MB"
    )
    return {**json.loads(done.stdout), **told}


def synthetic(store: Store, journal: Path, count: int, *, seed: int) -> None:
    """Fill a store with made-up flights over a year; all but the figures is that of a journal."""
    row = recorded(journal)
    if not isinstance(row, dict):
        raise SystemExit(str(row))
    chance = random.Random(seed)
    store.merge((_made_up(row, number, chance) for number in range(count)), {})


def _made_up(row: Row, number: int, chance: random.Random) -> Row:
    at = datetime(2025, 12, 1, tzinfo=UTC) + timedelta(minutes=chance.uniform(0.0, 525_000.0))
    machine = chance.randrange(MACHINES)
    days = (at - datetime(2025, 12, 1, tzinfo=UTC)).days
    area_ha = chance.uniform(0.5, 4.0)
    changes = chance.randrange(20, 400)
    kind = chance.choices(("real", "training", "simulated"), (94, 3, 3))[0]
    reasons = ("speed-below-min", "stale-position", "rc-switch", "leak", "no-flow")
    chosen = chance.sample(reasons, chance.choices((0, 1, 2), (6, 3, 1))[0])
    return {
        **row,
        "flight_id": hashlib.sha256(f"{number}".encode()).hexdigest()[:20],
        "kind": kind,
        "month": at.strftime("%Y-%m"),
        "started_utc": at,
        "is_evaluated": True,
        "machine": f"T40 ES-{machine:02d}",
        "field": f"Field {chance.randrange(FIELDS):03d}",
        "product": f"Product {chance.randrange(PRODUCTS):02d}",
        "operator": f"op-{chance.randrange(OPERATORS):012x}",
        "training": {"real": "no", "training": "water"}.get(kind, "simulated"),
        "simulated": "yes" if kind == "simulated" else "no",
        "duration_s": area_ha * 300.0,
        "spraying_s": area_ha * 250.0,
        "area_ha": area_ha,
        "applied_l": area_ha * chance.uniform(15.0, 30.0),
        "applied_by": chance.choice(("flow meter", "model")),
        "modelled_l": area_ha * 20.0,
        "flow_drift_percent": chance.gauss(-0.01 * days, 1.5),
        "missed_m2": chance.expovariate(1.0 / 20.0),
        "doubled_m2": chance.expovariate(1.0 / 20.0),
        "untreated_m2": 0.0,
        "changes": changes,
        "missed_changes": chance.choices((0, 1, 2), (90, 8, 2))[0],
        "apart_changes": chance.randrange(10),
        "mean_lag_m": abs(chance.gauss(0.04 + 0.0001 * days * (machine == 7), 0.01)),
        "worst_lag_m": chance.uniform(0.1, 0.3),
        "closings": [
            {"reason": each, "count": chance.randrange(1, 4), "seconds": chance.uniform(0.5, 20.0)}
            for each in chosen
        ],
        "faults": [{"kind": "leak", "count": 1}] if "leak" in chosen else [],
        "valves": [
            {"valve": str(valve), "flow_factor": round(1.0 + 0.01 * (valve - 3.5) - 1e-4 * days, 4)}
            for valve in range(1, 7)
        ],
        "record_version": f"{number:012d}.3.0001.1.1.synthetic",
    }


def _flown(folder: Path, count: int, seed: int) -> list[Path]:
    """Fly and record, each flight with a seed of its own; what is there already is not flown."""
    from sitl.fly import FlyOptions, fly_mission
    from sitl.fly_files import write_journal

    found = []
    for number in range(seed, seed + count):
        made = folder / f"{number}"
        path = made / "flight-0001.gpkg"
        if not path.is_file():
            options = FlyOptions(
                config=EXAMPLE / "config.toml",
                mission=EXAMPLE / "mission.waypoints",
                fidelity="averaged",
                seed=number,
                out=made,
            )
            path = write_journal(fly_mission(options, lambda _text: None), made)
        found.append(path)
    return found


def _journals(folder: Path, sources: Sequence[Path], count: int) -> Path:
    """Copy journals as other flights."""
    for number in range(count):
        day = started(1 + number % 28, 1 + number // 28 % 12)
        text = day["started_utc"].replace("+00:00", "")[:-6] + f"{number:06d}+00:00"
        copied(
            sources[number % len(sources)],
            folder / f"flight-{number:04d}.gpkg",
            {**day, "started_utc": text},
        )
    return folder


def _some(journals: Path, folder: Path, count: int) -> Path:
    """Return a folder with links to some of the journals."""
    folder.mkdir()
    for path in sorted(journals.iterdir())[:count]:
        (folder / path.name).hardlink_to(path)
    return folder


def _digest(folder: Path) -> str:
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found.update(str(path.relative_to(folder)).encode())
        found.update(path.read_bytes() if path.is_file() else b"")
    return found.hexdigest()


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
