"""A plan and the naive serpentine, both flown by the closed-loop twin, in one table.

    python -m tests.bench.plan_table [--field anyang|comb] [--seed 1]

Anyang is the field of Wang et al. 2024 with its map and sprayer, the comb is field C of
`tests.bench.missions` with two rates and the same sprayer. The naive plan is a grid along the
longest edge, each next line the nearest, home where the tank is empty and back to that place; its
flight sprays by the map alone, ours on the lines of the plan (`mission.lines`). What fell is summed
up on cells of half a metre, and compared with the map on those wholly inside the field.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import shapely
from shapely import box

from analysis.flight_record import FlightRecord
from companion.config import Config, load
from missions.corners import Motion
from missions.coverage import measure
from missions.demand import Demand, demands
from missions.files.items import items_of
from missions.maps.compiling import compiled_setup
from missions.plan import Leg, Place, Plan, Sortie
from missions.planner import plan_mission
from missions.reading import Asked, Task, read_task
from missions.sheet import scheduled
from missions.strips import Floats
from sitl.flight import FlightOptions, fly
from sitl.profile import load_profile
from sitl.vehicle import Vehicle
from tests.bench.missions import comb, to_degrees
from tests.bench.peers import grid_lines, longest_edge_deg, nearest_order
from tests.bench.plan_twin import route_of, with_lines

ANYANG = Path(__file__).parents[2] / "examples" / "anyang"
CELL_M = 0.5
# A dose within a tenth of the prescribed one is right; one below a twentieth is none.
RIGHT, NONE = 0.1, 0.05
POWER = "power_hover_w = 4000.0\npower_cruise_w = 3500.0\npower_per_kg_w = 60.0\n"


def config_of(name: str, folder: Path) -> tuple[Config, Path]:
    """Return the configuration and the outline of a field, written to a folder."""
    text = (ANYANG / "config.toml").read_text()
    files = {"prescription.shp": ANYANG / "prescription.shp",
             "boundary.geojson": ANYANG / "boundary.geojson"}  # fmt: skip
    if name == "comb":
        files = {key: folder / f"{key.split('.')[0]}.geojson" for key in files}
        west = comb().intersection(box(0.0, 0.0, 150.0, 400.0))
        east = comb().intersection(box(150.0, 0.0, 400.0, 400.0))
        _write(files["prescription.shp"], [(west, 15.0), (east, 25.0)])
        _write(files["boundary.geojson"], [(comb(), 0.0)])
        text = re.sub(r"^tank_l = .*$", "tank_l = 20.0", text, flags=re.MULTILINE)
        text = re.sub(r"^(angle_deg|depots) = .*$", "", text, flags=re.MULTILINE)
        text = text.replace("[prescription]\n", '[prescription]\nunit = "L/ha"\n')
    for key, path in files.items():
        text = text.replace(f'"{key}"', f'"{path}"')
    path = folder / "config.toml"
    path.write_text(text.replace("[mission]\n", f"[mission]\n{POWER}"))
    return load(path), files["boundary.geojson"]


def _write(path: Path, parts: list[tuple[Any, float]]) -> None:
    features = [
        {
            "type": "Feature",
            "properties": {"rate": rate},
            "geometry": json.loads(shapely.to_geojson(to_degrees(part))),
        }
        for part, rate in parts
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))


def naive(plan: Plan, task: Task) -> Plan:
    """Return the grid along the longest edge, cut where the tank is empty, with straight ways."""
    settings, width_m = task.settings, task.settings.swath_width_m
    ground = task.field.outline
    grid = grid_lines(ground, longest_edge_deg(ground), in_pairs=True, width_m=width_m)
    lines = nearest_order(grid)
    motion = Motion(speed_m_s=settings.speed_m_s, acceleration_m_s2=settings.acceleration_m_s2)
    needs = demands(lines, task.rates, width_m=width_m, valves=settings.valves)
    sorties = [
        _sortie(number, legs, plan.depots[0], motion)
        for number, legs in enumerate(_tanks(lines, needs, settings.usable_l), start=1)
    ]
    made = replace(
        plan, lines=lines, sorties=tuple(sorties),
        coverage=measure(lines, task.field.limit, width_m),
    )  # fmt: skip
    return scheduled(made)


def _tanks(
    lines: Floats, needs: list[Demand], usable_l: float
) -> list[list[tuple[Place, Place, float]]]:
    """Return start, end and litres of what is flown with each tank."""
    tanks: list[list[tuple[Place, Place, float]]] = [[]]
    left_l = usable_l
    for row, need in zip(lines, needs, strict=True):
        length_m = float(need.at_m[-1])
        marks_l = [0.0, *np.arange(left_l, need.total_l, usable_l).tolist(), need.total_l]
        cuts_m = [float(np.interp(mark, need.litres, need.at_m)) for mark in marks_l]
        cuts_m[0], cuts_m[-1] = 0.0, length_m
        for number, ((a, b), (x, y)) in enumerate(
            zip(pairwise(cuts_m), pairwise(marks_l), strict=True)
        ):
            if number:
                tanks.append([])
            start, end = (row[:2] + (row[2:] - row[:2]) * at / length_m for at in (a, b))
            tanks[-1].append(((start[0], start[1]), (end[0], end[1]), y - x))
        used_l = marks_l[-1] - marks_l[-2]
        left_l = (left_l if len(marks_l) == 2 else usable_l) - used_l
    return tanks


def _sortie(
    number: int, rows: list[tuple[Place, Place, float]], depot: Place, motion: Motion
) -> Sortie:
    def leg(kind: Any, start: Place, end: Place, litres: float = 0.0) -> Leg:
        return Leg(
            kind=kind, points=(start, end), speed_m_s=motion.speed_m_s,
            seconds=motion.leg_s(math.dist(start, end)), volume_l=litres,
        )  # fmt: skip

    legs = [leg("ferry", depot, rows[0][0])]
    for at, (start, end, litres) in enumerate(rows):
        if at:
            legs.append(leg("transit", rows[at - 1][1], start))
        legs.append(leg("spray", start, end, litres))
    legs.append(leg("ferry", rows[-1][1], depot))
    return Sortie(number=number, depot=0, legs=tuple(legs))


class Ground:
    """Millilitres on cells of the field."""

    def __init__(self, plan: Plan, task: Task) -> None:
        self._west, self._south, east, north = task.field.outline.buffer(20.0).bounds
        columns = math.ceil((east - self._west) / CELL_M)
        rows = math.ceil((north - self._south) / CELL_M)
        self.ml = np.zeros((rows, columns))
        self.outside_ml = 0.0
        x = self._west + (np.arange(columns) + 0.5) * CELL_M
        y = self._south + (np.arange(rows) + 0.5) * CELL_M
        self.east_m, self.north_m = (each.ravel() for each in np.meshgrid(x, y))
        inner = task.field.limit.buffer(-CELL_M)
        self.inside = shapely.contains_xy(inner, self.east_m, self.north_m)
        self.field = shapely.contains_xy(task.field.limit, self.east_m, self.north_m)
        rates = task.rates.rates_at(self.east_m, self.north_m)
        self.asked_l_ha = np.where(self.inside, np.nan_to_num(rates), 0.0)

    def add(self, record: FlightRecord) -> None:
        """Add what a flight put down: each valve's volume, spread over its strip."""
        used = np.diff(record.volume_ml, axis=0)
        heading = np.radians(record.heading_deg[1:])
        for number, valve in enumerate(record.boom.valves):
            places = np.linspace(-0.5, 0.5, 9)[:-1] + 1.0 / 16.0
            for place in places:
                right_m = valve.right_m + place * valve.width_m
                x = record.east_m[1:] + right_m * np.cos(heading)
                y = record.north_m[1:] - right_m * np.sin(heading)
                column = ((x - self._west) / CELL_M).astype(int)
                row = ((y - self._south) / CELL_M).astype(int)
                np.add.at(self.ml, (row, column), used[:, number] / len(places))

    def figures(self) -> dict[str, float]:
        """Return shares of the ground that got too little, too much or nothing, and the litres."""
        dose = self.ml.ravel() / 1000.0 / (CELL_M**2 / 10_000.0)
        some = self.inside & (self.asked_l_ha > 0.0)
        share = dose[some] / self.asked_l_ha[some]
        return {
            "untreated_percent": 100.0 * float((share < NONE).mean()),
            "under_percent": 100.0 * float((share < 1.0 - RIGHT).mean()),
            "over_percent": 100.0 * float((share > 1.0 + RIGHT).mean()),
            "applied_l": float(self.ml.sum()) / 1000.0,
            "off_field_ml": float(self.ml.ravel()[~self.field].sum()),
        }


def figures(plan: Plan, task: Task, config: Config, *, seed: int) -> dict[str, Any]:
    """Fly all sorties and return the table's column."""
    setup = compiled_setup(config, frame=plan.frame)
    ground = Ground(plan, task)
    fence = task.field.fly.buffer(0.01)
    outside_m = 0.0
    for sortie in plan.sorties:
        route, _ = route_of(plan, sortie)
        trajectory = Vehicle(
            route, start_s=0.0, seed=seed + sortie.number,
            acceleration_m_s2=plan.settings.acceleration_m_s2,
        ).fly_to_end()  # fmt: skip
        result = fly(
            setup, trajectory, load_profile("wang-2024"),
            FlightOptions(fidelity="averaged", output="servo", seed=seed + sortie.number),
            speed_m_s=plan.settings.speed_m_s, mission=route,
        )  # fmt: skip
        ground.add(result.record)
        ways = [leg.points for leg in sortie.legs if leg.kind != "ferry" and leg.length_m > 0.0]
        outside_m += sum(shapely.LineString(way).difference(fence).length for way in ways)
    total = plan.summary()
    spray_m, total_m = plan.length_m("spray"), float(total["total_m"])  # type: ignore[arg-type]
    places = [point for sortie in plan.sorties for leg in sortie.legs for point in leg.points]
    return {
        "coverage_percent": plan.coverage.percent,
        "overlap_percent": plan.coverage.overlap_percent,
        "strip_outside_m2": plan.coverage.outside_m2,
        "largest_skip_m2": plan.coverage.largest_skip_m2,
        **ground.figures(),
        "planned_l": plan.volume_l,
        "spray_m": spray_m,
        "transit_m": plan.length_m("transit"),
        "ferry_m": plan.length_m("ferry"),
        "non_work_percent": 100.0 * (total_m - spray_m) / total_m,
        "turns": plan.turns,
        "sorties": len(plan.sorties),
        "flight_min": plan.flight_s / 60.0,
        "energy_wh": sum(plan.energy_wh(sortie) or 0.0 for sortie in plan.sorties),
        "farthest_m": max(math.dist(plan.depots[0], place) for place in places),
        "transit_outside_m": outside_m,
        "items_most": max(len(items_of(plan, sortie)) for sortie in plan.sorties),
    }


def main() -> int:
    """Print the table; 0 even where a target is missed: the figures are the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.plan_table", description=__doc__)
    parser.add_argument("--field", choices=["anyang", "comb"], default="anyang")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        config, outline = config_of(given.field, Path(scratch))
        begun = process_time()
        task = read_task(Asked(field=outline), config, {})
        plan = plan_mission(task.field, task.settings, task.rates, depots=task.depots)
        took_s = process_time() - begun
        ours = figures(plan, task, with_lines(plan, config), seed=given.seed)
        other = figures(naive(plan, task), task, config, seed=given.seed)
    sys.stdout.write(json.dumps({"ours": ours | {"planning_s": took_s}, "naive": other}, indent=1))
    sys.stdout.write("\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
