"""What run-ins and terrain cost on fields A, B and C: minutes, and items of the missions.

    python -m tests.bench.plan_ground

The ground is made up: thirty waves of 60 to 800 m, as high as 0.4 % of their length (seed 1).
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from missions.demand import Uniform
from missions.field import Field
from missions.files.items import items_of
from missions.plan import Plan
from missions.planner import plan_mission
from missions.surroundings import NOTHING_AROUND, RunIn, Surroundings
from missions.terrain import Dem, Terrain
from tests.bench.missions import RATE_L_HA, fields, settings

CELL_M, AROUND_M = 10.0, 600.0


def waves(field: Field, seed: int = 1) -> Dem:
    """Return a rolling ground under a field."""
    draw = np.random.default_rng(seed)
    west, south, east, north = field.outline.bounds
    x = np.arange(west - AROUND_M, east + AROUND_M, CELL_M)
    y = np.arange(south - AROUND_M, north + AROUND_M, CELL_M)[::-1]
    across, up = np.meshgrid(x, y)
    heights = np.zeros_like(across)
    for _ in range(30):
        length_m, course, phase = draw.uniform(60.0, 800.0), *draw.uniform(0.0, 6.283, 2)
        along = across * np.cos(course) + up * np.sin(course)
        heights += 0.004 * length_m * np.sin(along * 6.283 / length_m + phase)
    return Dem(
        name="waves", heights_m=heights, transform=(CELL_M, 0.0, x[0], 0.0, -CELL_M, y[0]),
        crs=field.frame.crs,
    )  # fmt: skip


def planned(field: Field, around: Surroundings, *, tank_l: float = 40.0) -> Plan:
    """Return the plan of a field with the settings of the other benches."""
    chosen = replace(settings(moves=2000), tank_l=tank_l)
    return plan_mission(field, chosen, Uniform(rate_l_ha=RATE_L_HA), around=around)


def said(plan: Plan) -> str:
    """Return minutes and items of a plan."""
    items = [len(items_of(plan, sortie)) for sortie in plan.sorties]
    return f"{plan.flight_s / 60.0:6.1f} min, {sum(items):5} items, {max(items):3} in a sortie"


def main() -> int:
    """Print a line for each field and choice."""
    for name, field in fields().items():
        free = field.outline.convex_hull.buffer(500.0).difference(field.blocked)
        runs = {
            "no run-in": NOTHING_AROUND,
            "run-in inside": Surroundings(run_in=RunIn()),
            "run-in anywhere": Surroundings(run_in=RunIn(ground=free)),
        }
        for label, around in runs.items():
            plan = planned(field, around, tank_l=4000.0)
            print(f"{name} {label:16} {said(plan)}; {'; '.join(plan.warnings)[:60]}")  # noqa: T201
        dem = waves(field)
        relief_m = float(np.ptp(dem.heights_m))
        print(f"{name} flat             {said(planned(field, NOTHING_AROUND))}")  # noqa: T201
        for tolerance_m in (0.5, 1.0, 2.0):
            terrain = Terrain(dem=dem, frame=field.frame, tolerance_m=tolerance_m)
            plan = planned(field, Surroundings(terrain=terrain))
            print(f"{name} {relief_m:.0f} m, {tolerance_m:g} m kept {said(plan)}")  # noqa: T201
    return 0


if __name__ == "__main__":
    sys.exit(main())
