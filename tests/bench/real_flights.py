"""How exact on flights really flown: `make bench-real`, all logs of VRSPRAY_REAL at three rates.

    python -m tests.bench.real_flights [LOG ...] [--rates 20,10,5] [--flights 3] > results.json

The table goes to stderr. Where the log holds fewer states than are asked for, those between know
the future: such rows are marked and held to no bar. `bars` are those of missions in AUTO.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from companion.errors import ConfigError
from sitl.along import AlongOptions, fly_along, prepare
from tests import holes_judge

# By rate: misapplied over perfect knowledge's, in turns too, and how far the median lag may be off.
HOLES_HZ = 10.0
BARS = {10.0: (1.5, 2.5, (1.3, 0.02)), 5.0: (2.5, None, None)}


def main() -> int:
    """Fly along all logs; return 0 where all that is barred holds."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.real_flights")
    parser.add_argument("logs", nargs="*", type=Path)
    parser.add_argument("--rates", default="20,10,5")
    parser.add_argument("--flights", type=int, default=3)
    given = parser.parse_args()
    real = os.environ.get("VRSPRAY_REAL")
    if not given.logs and real is None:
        tell("no logs of real flights: set VRSPRAY_REAL, or name some")
        return 0
    logs = given.logs or sorted((Path(real or "") / "flights").iterdir())
    results = []
    head = f"{'log':<24}{'Hz':>4} {'method':<11}{'misapplied %':>22}{'in turns':>10}"
    tell(f"{head}{'lag m':>8}{'median':>8}{'step m':>8}{'missed':>11}")
    for log in logs:
        for rate_hz in map(float, given.rates.split(",")):
            try:
                found = flown(log, rate_hz, given.flights)
            except ConfigError as error:
                tell(f"{log.name}: {error}")
                break
            results.append(found)
            say(found)
    json.dump(results, sys.stdout, indent=1)
    return int(any(bar["broken"] for result in results for bar in result["bars"]))


def tell(text: str) -> None:
    """Say a line beside the results."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def flown(log: Path, rate_hz: float, flights: int) -> dict[str, Any]:
    """Return the results of one log at one rate, with its bars."""
    options = AlongOptions(log=log, position_rate_hz=rate_hz, flights=flights)
    found = fly_along(options, lambda _text: None)
    found["knows_the_future"] = rate_hz > 1.05 * found["recorded_rate_hz"]
    by_hand = not set(found["modes"]) <= {"AUTO", "MISSION"}
    rows = {row["method"]: row for row in found["methods"]}
    ours, theirs = at_holes(options)
    found["holes"] = {"vrspray": asdict(ours), "reference": asdict(theirs)}
    found["bars"] = [] if by_hand or found["knows_the_future"] else bars_of(rows, rate_hz)
    if found["bars"] and rate_hz == HOLES_HZ:
        named = [
            dict(zip(("of", "is", "limit"), bar, strict=True))
            for bar in holes_judge.bars(ours, theirs)
        ]
        found["bars"] += [bar | {"broken": not bar["is"] <= bar["limit"]} for bar in named]
    return found


def at_holes(options: AlongOptions) -> tuple[holes_judge.Early, holes_judge.Early]:
    """Return how early valves close before holes in the field, and who knows the true state."""
    seeds = range(options.seed, options.seed + options.flights)
    beds = [prepare(replace(options, seed=seed)) for seed in seeds]
    return holes_judge.judged(beds, seeds)


def bars_of(rows: dict[str, Any], rate_hz: float) -> list[dict[str, Any]]:
    """Return what is barred at a rate, and whether it holds."""
    if rate_hz not in BARS:
        return []
    whole, turn, lag = BARS[rate_hz]
    ours, perfect = rows["vrspray"], rows["perfect"]
    found = []
    for name, times in (("misapplied_percent", whole), ("turn_misapplied_percent", turn)):
        if times is not None and perfect[name] is not None:
            limit = times * perfect[name]["mean"]
            found.append({"of": name, "is": ours[name]["mean"], "limit": limit})
    if lag is not None and perfect["lag_distance_m"]["median_abs"] is not None:
        limit = lag[0] * perfect["lag_distance_m"]["median_abs"] + lag[1]
        found.append({"of": "lag", "is": ours["lag_distance_m"]["median_abs"], "limit": limit})
    return [bar | {"broken": not bar["is"] <= bar["limit"]} for bar in found]


def say(found: dict[str, Any]) -> None:
    """Print the rows of one log at one rate."""

    def number(values: dict[str, Any] | None, key: str = "mean", digits: int = 3) -> str:
        return "-" if values is None or values[key] is None else f"{values[key]:.{digits}f}"

    for row in found["methods"]:
        wrong = row["misapplied_percent"]
        spread = "-" if wrong is None else f"{wrong['min']:.2f}..{wrong['max']:.2f}"
        lag = row["lag_distance_m"]
        mark = "*" if found["knows_the_future"] else " "
        missed = f"{row['missed']}/{row['changes']}"
        tell(
            f"{found['log']:<24}{found['position_rate_hz']:>3g}{mark} {row['method']:<11}"
            f"{number(wrong, digits=2):>7}{spread:>15}"
            f"{number(row['turn_misapplied_percent'], digits=1):>10}"
            f"{number(lag, 'mean_abs'):>8}{number(lag, 'median_abs'):>8}"
            f"{number(row['switch_m'], 'mean_abs'):>8}{missed:>11}"
        )
    for name, early in found["holes"].items():
        tell(
            f"  holes, {name}: {early['closings']} closings {number(early, 'mean_m')} m before "
            f"(median {number(early, 'median_m')}), {number(early, 'beyond_m', 2)} m beyond at "
            f"most, {number(early, 'lost_percent', 2)} % of the ground lost"
        )
    for bar in found["bars"]:
        word = "broken" if bar["broken"] else "holds"
        tell(f"  bar {bar['of']}: {bar['is']:.3f} of {bar['limit']:.3f}: {word}")


if __name__ == "__main__":
    sys.exit(main())
