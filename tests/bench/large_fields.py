"""Large fields with many refills, beside sorties that go home when they are empty.

    python -m tests.bench.large_fields [--only NAME] [--tank 10 --tank 40] [--json]

The samples of 100 ha and more (VRSPRAY_SAMPLES) and made-up fields, depot in the middle and in a
corner. Times, naive sorties and the lower bound are those of `tests.naive_sorties`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import shapely
from shapely import Polygon
from shapely.affinity import rotate
from shapely.geometry.base import BaseGeometry

from missions.demand import Uniform
from missions.energy import Battery
from missions.field import Field, build_field
from missions.files.write import lines_text
from missions.plan import Settings
from missions.planner import plan_mission
from tests.bench.parcels import read_parcel
from tests.mission_fields import blob, degrees
from tests.mission_judge import Drawn
from tests.naive_sorties import (
    UPRIGHT_S,
    Flight,
    ferries_inside,
    figures,
    least_idle_m,
    legs_of,
    naive,
    passes_of,
)

WIDTH_M, RATE_L_HA, REFILL_S, LEAST_HA = 6.0, 20.0, 60.0, 100.0
FLIGHT = Flight()


def cases() -> Iterator[tuple[str, Drawn]]:
    """Yield large fields, real and made up."""
    samples = os.environ.get("VRSPRAY_SAMPLES")
    for path in sorted(Path(samples).glob("fields/*.geojson")) if samples else ():
        drawn = Drawn(outline=read_parcel(path, kind="real").outline, width_m=WIDTH_M)
        if drawn.plane.area(drawn.outline).area >= LEAST_HA * 1e4:
            yield path.stem, drawn
    for area_ha in (120.0, 300.0):
        yield f"blob-{area_ha:g}", Drawn(outline=degrees(blob(area_ha, seed=3)))
        yield f"box-{area_ha:g}", Drawn(outline=degrees(_box(area_ha)))
        yield f"ell-{area_ha:g}", Drawn(outline=degrees(_ell(area_ha)))


def _box(area_ha: float) -> Polygon:
    side_m = math.sqrt(area_ha * 1e4)
    return rotate(shapely.box(0.0, 0.0, 1.25 * side_m, side_m / 1.25), 20.0)


def _ell(area_ha: float) -> BaseGeometry:
    part_m = math.sqrt(area_ha * 1e4 / 3.0)
    shape = shapely.box(0.0, 0.0, 2 * part_m, part_m).union(shapely.box(0, 0, part_m, 2 * part_m))
    return rotate(shape, 12.0)


def depots_of(drawn: Drawn) -> dict[str, tuple[float, float]]:
    """Return (latitude, longitude) of the middle of the field, or near it, and of a corner."""
    ground = drawn.outline.buffer(-20.0 / 111_200.0)
    middle = ground.centroid
    if not ground.covers(middle):
        middle = shapely.shortest_line(ground, middle).boundary.geoms[0]
    hull = drawn.outline.minimum_rotated_rectangle
    corner = shapely.Point(hull.exterior.coords[0])
    corner = shapely.shortest_line(ground, corner).boundary.geoms[0]
    return {"middle": (middle.y, middle.x), "corner": (corner.y, corner.x)}


def compared(
    drawn: Drawn, depot: tuple[float, float], *, tank_l: float, flight_s: float | None = None,
    moves: int = 40_000,
) -> dict[str, Any]:  # fmt: skip
    """Return the figures of a plan, of the naive sorties, and the bound."""
    field = build_field(drawn.outline, obstacles=list(drawn.obstacles), swath_width_m=drawn.width_m)
    settings = Settings(
        swath_width_m=drawn.width_m, speed_m_s=FLIGHT.speed_m_s, tank_l=tank_l, reserve_l=0.0,
        refill_s=REFILL_S, moves=moves, battery=_battery(flight_s),
    )  # fmt: skip
    begun = process_time()
    plan = plan_mission(field, settings, Uniform(rate_l_ha=RATE_L_HA), depots=(depot,))
    took_s = process_time() - begun
    sorties = legs_of(drawn, json.loads(lines_text(plan)))
    endless = in_one(drawn, field, depot)
    ((home_x, home_y),) = drawn.plane.metres(np.array([[depot[1], depot[0]]]))
    home = float(home_x), float(home_y)
    # Several where one has more items than an autopilot has room for: as if it went on.
    passes = [each for number in sorted(endless) for each in passes_of(endless[number])]
    limit_s = math.inf if flight_s is None else flight_s
    plain = naive(
        passes, home, FLIGHT, usable_l=tank_l, limit_s=limit_s, ferry=ferries_inside(drawn, home)
    )
    straight = naive(passes, home, FLIGHT, usable_l=tank_l, limit_s=limit_s)
    found = figures(sorties, FLIGHT, refill_s=REFILL_S)
    other = figures(plain, FLIGHT, refill_s=REFILL_S)
    over_all = figures(straight, FLIGHT, refill_s=REFILL_S)
    longest_m = FLIGHT.speed_m_s * (limit_s - UPRIGHT_S)
    least_m = least_idle_m(passes, [home], usable_l=tank_l, longest_m=longest_m)
    return {
        "ha": field.area_m2 / 1e4,
        "hours": found.hours, "naive_hours": other.hours, "ratio": found.hours / other.hours,
        "least_ratio": least_hours(other.spray_km + least_m / 1e3, passes, tank_l) / other.hours,
        "straight_ratio": found.hours / over_all.hours,
        "said_hours": plan.total_s / 3600.0,
        "idle_km": found.idle_km, "naive_idle_km": other.idle_km, "least_idle_km": least_m / 1e3,
        "spray_km": found.spray_km, "naive_spray_km": other.spray_km,
        "sorties": found.sorties, "naive_sorties": other.sorties,
        "most_l": found.most_l, "longest_s": found.longest_s, "cpu_s": took_s,
    }  # fmt: skip


def least_hours(way_km: float, passes: list[Any], tank_l: float) -> float:
    """Return a lower bound of the time: way at speed, least landings, least turns."""
    litres = sum(each.litres for each in passes)
    landings = math.ceil(litres / tank_l - 1e-6)
    seconds = way_km * 1e3 / FLIGHT.speed_m_s + landings * (UPRIGHT_S + REFILL_S)
    return seconds / 3600.0


def _battery(flight_s: float | None) -> Battery | None:
    if flight_s is None:
        return None
    return Battery(hover_w=3600.0, cruise_w=3600.0, capacity_wh=flight_s, reserve_percent=0.0)


def in_one(drawn: Drawn, field: Field, depot: tuple[float, float]) -> Any:
    """Return the legs of the plan with an endless tank."""
    settings = Settings(
        swath_width_m=drawn.width_m, speed_m_s=FLIGHT.speed_m_s, tank_l=99_999.0, reserve_l=0.0
    )
    plan = plan_mission(field, settings, Uniform(rate_l_ha=RATE_L_HA), depots=(depot,))
    return legs_of(drawn, json.loads(lines_text(plan)))


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.large_fields", description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name has this")
    parser.add_argument("--tank", type=float, action="append", metavar="L")
    parser.add_argument("--minutes", type=float, help="that a battery lasts")
    parser.add_argument("--moves", type=int, default=40_000)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    results = {}
    for name, drawn in cases():
        for where, depot in depots_of(drawn).items():
            for tank_l in given.tank or (10.0, 20.0, 40.0):
                key = f"{name} {where} {tank_l:g} L"
                if given.only not in key:
                    continue
                flight_s = None if given.minutes is None else 60.0 * given.minutes
                row = compared(drawn, depot, tank_l=tank_l, flight_s=flight_s, moves=given.moves)
                results[key] = row
                say(f"{key:28}" + "".join(f" {k} {v:.2f}" for k, v in row.items()))
    if given.json:
        sys.stdout.write(json.dumps(results, indent=1) + "\n")
    return 0


def say(text: str) -> None:
    """Tell a figure."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
