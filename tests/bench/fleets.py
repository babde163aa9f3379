"""Two and three aircraft, and small batteries, on random fields: what must hold, and the worst.

    python -m tests.bench.fleets [--random 70] [--seed 1]

Each field is planned for one aircraft without a battery, for two and three, and for one whose
battery lasts for some five minutes. 20 L/ha, 20 L.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from typing import Any

from companion.errors import VrsprayError
from missions.demand import Uniform
from missions.energy import Battery
from missions.field import build_field
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.sheet import separation_m
from tests.bench.missions import (
    FRAME,
    RATE_L_HA,
    SPEED_M_S,
    WIDTH_M,
    outside_m2,
    random_field,
    to_degrees,
    transit_outside_m,
)

# 360 Wh above the reserve: some five minutes in the air.
BATTERY = Battery(hover_w=4000.0, cruise_w=3500.0, per_kg_w=60.0, capacity_wh=450.0)


def settings(**changes: Any) -> Settings:
    """Return the settings of all these plans."""
    return Settings(
        swath_width_m=WIDTH_M, speed_m_s=SPEED_M_S, tank_l=20.0, reserve_l=1.0, moves=2_000,
        **changes,
    )  # fmt: skip


def try_field(seed: int) -> dict[str, Any]:
    """Return what one field gives: refusals in words, and figures."""
    kind, ground = random_field(seed)
    found: dict[str, Any] = {"seed": seed, "kind": kind}
    try:
        field = build_field(to_degrees(ground), swath_width_m=WIDTH_M, frame=FRAME)
        one = plan_mission(field, settings(), Uniform(rate_l_ha=RATE_L_HA))
    except VrsprayError as error:
        return found | {"error": str(error)}
    for name, changes in (
        ("two", {"aircraft": 2}), ("three", {"aircraft": 3}),
        ("battery", {"battery": BATTERY, "nose_rate_deg_s": 45.0}),
    ):  # fmt: skip
        try:
            plan = plan_mission(field, settings(**changes), Uniform(rate_l_ha=RATE_L_HA))
        except VrsprayError as error:
            found[name] = {"error": str(error)}
            continue
        found[name] = {
            "share_of_time": plan.total_s / one.total_s,
            "litres_more": plan.volume_l - one.volume_l,
            "outside_m2": outside_m2(plan, ground),
            "transit_outside_m": transit_outside_m(plan),
            "separation_m": separation_m(plan),
            "most_wh": max((plan.energy_wh(sortie) or 0.0) for sortie in plan.sorties),
            "most_l": max(sortie.volume_l for sortie in plan.sorties),
            "waits_s": waits_s(plan),
        }
    return found


def waits_s(plan: Plan) -> float:
    """Return how long aircraft stand ready and wait for another to land."""
    free_s: dict[int, float] = {}
    waited = 0.0
    for sortie in plan.sorties:
        if sortie.aircraft in free_s:
            waited += max(sortie.start_s - free_s[sortie.aircraft], 0.0)
        else:
            waited += sortie.start_s
        free_s[sortie.aircraft] = sortie.start_s + plan.airborne_s(sortie) + plan.settings.refill_s
    return waited


def worst(rows: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Return the worst of one kind of plan."""
    some = [row[name] for row in rows if name in row and "error" not in row[name]]
    apart = [row["separation_m"] for row in some if row["separation_m"] is not None]
    refused = Counter(
        row[name]["error"].split(":")[0][:60]
        for row in rows
        if name in row and "error" in row[name]
    )
    shares = sorted(row["share_of_time"] for row in some)
    return {
        "planned": len(some),
        "refused": dict(refused),
        "median_share_of_time": shares[len(shares) // 2] if shares else None,
        "largest_share_of_time": shares[-1] if shares else None,
        "litres_apart_most": max(abs(row["litres_more"]) for row in some),
        "outside_m2": max(row["outside_m2"] for row in some),
        "transit_outside_m": max(row["transit_outside_m"] for row in some),
        "separation_m": min(apart, default=None),
        "most_wh": max(row["most_wh"] for row in some),
        "most_l": max(row["most_l"] for row in some),
        "median_wait_s": sorted(row["waits_s"] for row in some)[len(some) // 2],
    }


def main() -> int:
    """Print the worst; 0 even where a target is missed: the figures are the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.fleets", description=__doc__)
    parser.add_argument("--random", type=int, default=70, help="random fields")
    parser.add_argument("--seed", type=int, default=1, help="the first of their seeds")
    given = parser.parse_args()
    rows = [try_field(seed) for seed in range(given.seed, given.seed + given.random)]
    found = {name: worst(rows, name) for name in ("two", "three", "battery")}
    found["no_plan"] = {"fields": sum("error" in row for row in rows)}
    sys.stdout.write(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
