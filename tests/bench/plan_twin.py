"""Litres of sorties as they are planned beside those of the twin, line by line.

    python -m tests.bench.plan_twin [--sorties 12] [--seed 1] [--everywhere]

Plans the real map of sample 01 (VRSPRAY_SAMPLES) for the orchard's sprayer and flies sorties,
evenly chosen, from the depot and back to it, with the plan's file as `mission.lines`. What counts
is all that the twin sprays, ferries and side steps included; what it sprays while it flies none of
the lines (`between_l`), and off them (`off_lines_ml`), is listed apart. `--everywhere` leaves the
key out.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.border import off_target
from analysis.strips import strips_of
from companion.config import Config, load
from companion.core.setup import Setup
from missions.files.write import lines_text
from missions.maps.compiling import compiled_setup
from missions.plan import Plan, Sortie
from missions.planner import plan_mission
from missions.reading import Asked, read_task
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.vehicle import Leg, Route, Vehicle

ORCHARD = Path(__file__).parents[2] / "examples" / "orchard"
SAMPLE = "01_shp_lha_multipolygon"
MOVES = 40_000


def config_for(folder: Path, rates: Path, boundary: Path) -> Config:
    """Write the orchard's configuration for another map and return it."""
    text = (ORCHARD / "config.toml").read_text()
    text = text.replace(
        'file = "prescription.shp"', f'file = "{rates}"\nboundary = "{boundary}"\nunit = "L/ha"'
    )
    text = re.sub(r"^(rate_field|angle_deg) = .*$", "", text, flags=re.MULTILINE)
    path = folder / "config.toml"
    path.write_text(text)
    return load(path)


def planned(config: Config, boundary: Path, *, moves: int = MOVES, **changes: Any) -> Plan:
    """Return the plan of a configuration's own map."""
    task = read_task(Asked(field=boundary), config, {"moves": moves, **changes})
    return plan_mission(task.field, task.settings, task.rates, depots=task.depots)


def with_lines(plan: Plan, config: Config) -> Config:
    """Return the configuration that sprays on the plan's lines only, its file beside it."""
    path = config.path.parent / "plan.lines.geojson"
    path.write_text(lines_text(plan))
    return load(config.path, overrides=[f'mission.lines="{path}"'])


def route_of(plan: Plan, sortie: Sortie) -> tuple[Route, tuple[bool, ...]]:
    """Return the whole way of a sortie, and of each of its legs whether it is a spray line."""
    legs: list[Leg] = []
    for leg in sortie.legs:
        kind = "spray" if leg.kind == "spray" else "transit"
        if leg.length_m > 0.01:
            legs += [
                Leg(east_m=east_m, north_m=north_m, speed_m_s=leg.speed_m_s, kind=kind)  # type: ignore[arg-type]
                for east_m, north_m in leg.points[1:]
            ]
    start = sortie.legs[0].points[0]
    route = Route(
        start_east_m=start[0], start_north_m=start[1], legs=tuple(legs),
        height_m=plan.settings.height_m,
    )  # fmt: skip
    return route, tuple(leg.kind == "spray" for leg in legs)


def flown(
    plan: Plan, sortie: Sortie, setup: Setup, *, seed: int, plant: str = "orchard-180"
) -> dict[str, float]:
    """Return planned litres of a sortie, and those of the twin: all, between lines, off them."""
    route, is_line = route_of(plan, sortie)
    trajectory = Vehicle(
        route, start_s=0.0, seed=seed, acceleration_m_s2=plan.settings.acceleration_m_s2
    ).fly_to_end()
    result = fly(
        setup, trajectory, load_profile(plant),
        FlightOptions(fidelity="averaged", output="servo", seed=seed),
        speed_m_s=plan.settings.speed_m_s,
        mission=route,
    )  # fmt: skip
    record = result.record
    used_l = np.diff(record.volume_ml.sum(axis=1)) / 1000.0
    on_line = np.array(is_line)[trajectory.at(record.time_s).leg]
    return {
        "sortie": sortie.number,
        "planned_l": sortie.volume_l,
        "twin_l": float(used_l.sum()),
        "between_l": float(used_l[~on_line[1:]].sum()),
        "off_lines_ml": off_target(strips_of(record), record.prescription).off_line_ml,
        "ferry_m": sortie.length_m("ferry") + sortie.length_m("transit"),
        "simulated_s": result.simulated_s,
    }


def compared(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Return how far the plan is from the twin, for each sortie and in all."""
    for row in rows:
        row["error_percent"] = 100.0 * (row["planned_l"] / row["twin_l"] - 1.0)
    total = sum(row["planned_l"] for row in rows) / sum(row["twin_l"] for row in rows)
    return {
        "sorties": list(rows),
        "worst_percent": max(abs(row["error_percent"]) for row in rows),
        "total_percent": 100.0 * (total - 1.0),
    }


def main() -> int:
    """Print the figures; 0 even where a target is missed: the figures are the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.plan_twin", description=__doc__)
    parser.add_argument("--sorties", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed-m-s", type=float)
    parser.add_argument("--everywhere", action="store_true")
    given = parser.parse_args()
    samples = os.environ.get("VRSPRAY_SAMPLES")
    if not samples:
        parser.error("VRSPRAY_SAMPLES names the folder of the samples")
    folder = Path(samples) / SAMPLE
    boundary = folder / "boundary" / "Boundary.shp"
    with tempfile.TemporaryDirectory() as scratch:
        config = config_for(Path(scratch), folder / "Rx.shp", boundary)
        plan = planned(config, boundary, speed_m_s=given.speed_m_s)
        chosen = np.linspace(0, len(plan.sorties) - 1, given.sorties).round().astype(int).tolist()
        wanted = config if given.everywhere else with_lines(plan, config)
        setup = compiled_setup(wanted, frame=plan.frame)
        rows = []
        for at in chosen:
            rows.append(flown(plan, plan.sorties[at], setup, seed=given.seed))
            sys.stderr.write(f"{rows[-1]}\n")
    found = compared(rows) | {"of": len(plan.sorties), "volume_l": plan.volume_l}
    sys.stdout.write(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
