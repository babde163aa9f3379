"""How far the figures of a journal are from the truth: `python -m tests.bench.assessed`.

Flies the paper's field in the twin, writes the journal that the companion would have written,
evaluates it as if nothing else were known, and compares with the truth of the same flight.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.evaluation import Evaluation, evaluate
from analysis.flown.applied_record import record_of
from analysis.flown.read_applied import read_applied
from sitl.fly import FlyOptions, fly_mission
from sitl.fly_files import write_journal

ANYANG = Path(__file__).parents[2] / "examples" / "anyang"
SEEDS = (1, 2, 3, 4, 5)
FIGURES = (
    "lag_mean_m",
    "lag_mean_abs_m",
    "lag_max_abs_m",
    "settled_mean_m",
    "misapplied_percent",
    "spraying_accuracy_percent",
    "volume_error_percent",
    "border_margin_min_m",
    "off_target_ml",
    "applied_l",
)


def figures(found: Evaluation) -> dict[str, float]:
    """Return the figures of one flight that are compared."""
    lag = found.lag_distance_m
    values = (
        lag.mean, lag.mean_abs, lag.max_abs, found.settled_lag_distance_m.mean,
        found.misapplied_percent, found.spraying_accuracy_percent, found.volume_error_percent,
        found.border_margin_m.min, found.off_target_ml, found.applied_ml / 1000.0,
    )  # fmt: skip
    return {
        name: float("nan") if value is None else value
        for name, value in zip(FIGURES, values, strict=True)
    }


def config_for(output: str, folder: Path) -> Path:
    """Return the example's configuration, with the lags that were measured for an output."""
    text = (ANYANG / "config.toml").read_text(encoding="utf-8")
    for name in ("prescription.shp", "boundary.geojson"):
        text = text.replace(f'"{name}"', f'"{(ANYANG / name).as_posix()}"')
    if output == "gpio":
        head, _, rest = text.partition("[lag]")
        _, _, tail = rest.partition("[output]")
        lags = (ANYANG / "lags" / "gpio.toml").read_text(encoding="utf-8")
        text = f'{head}{lags}\nmethod = "scheduled"\n[output]{tail}'
    path = folder / f"{output}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def flights(output: str, seeds: Sequence[int]) -> Iterator[dict[str, dict[str, float]]]:
    """Yield truth, model and meter of each flight."""
    for seed in seeds:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            flown = fly_mission(
                FlyOptions(
                    config=config_for(output, folder),
                    mission=ANYANG / "mission.waypoints",
                    output="gpio" if output == "gpio" else "servo",
                    seed=seed,
                    out=folder,
                ),
                lambda _: None,
            )
            flight = read_applied(write_journal(flown, folder))
        yield {
            "truth": figures(flown.evaluation),
            "model": figures(evaluate(record_of(flight))),
            "meter": figures(evaluate(record_of(flight, source="meter"))),
        }
        sys.stderr.write(f"{output}, seed {seed} done\n")


def summary(found: Sequence[dict[str, dict[str, float]]]) -> dict[str, Any]:
    """Return each figure's mean over the flights, and how far the journal's is from the truth."""
    table = {}
    for name in FIGURES:
        truth = np.array([each["truth"][name] for each in found])
        row: dict[str, float] = {"truth": float(truth.mean())}
        for way in ("model", "meter"):
            values = np.array([each[way][name] for each in found])
            row[way] = float(values.mean())
            row[f"{way}_worst_difference"] = float(np.abs(values - truth).max())
        table[name] = row
    return table


def main() -> None:
    """Print the comparison as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--outputs", nargs="+", default=["gpio", "servo"])
    options = parser.parse_args()
    results = {output: summary(list(flights(output, options.seeds))) for output in options.outputs}
    sys.stdout.write(json.dumps({"seeds": options.seeds, "flights": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
