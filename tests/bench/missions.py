"""Plans for three fields and for hundreds of random ones, beside the patterns that others fly.

    python -m tests.bench.missions [--random 350] [--seed 1] [--refill] [--json]

Field A is the boundary of sample 01, B the outline of sample 03 (VRSPRAY_SAMPLES), C a comb with
two holes. The patterns of QGroundControl's survey and Mission Planner's grid are written anew from
their rules: parallel lines over the bounding box, one line from the first to the last crossing, or
one between each pair of crossings.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import sys
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.affinity import rotate, translate

from companion.core.frame import LocalFrame
from companion.errors import VrsprayError
from missions.corners import Motion
from missions.demand import Uniform
from missions.field import Field, build_field
from missions.maps.local import Area, as_area, polygons_of
from missions.maps.registry import read_area
from missions.plan import Plan, Settings
from missions.planner import plan_mission
from missions.strips import Floats, lengths_m, united
from tests.bench.peers import grid_lines, longest_edge_deg, nearest_order

WIDTH_M, SPEED_M_S, RATE_L_HA, TANK_L = 7.0, 6.0, 20.0, 40.0
MOTION = Motion(speed_m_s=SPEED_M_S, acceleration_m_s2=2.5)
FRAME = LocalFrame(latitude_deg=48.0, longitude_deg=11.0)
SAMPLES = {
    "A": "01_shp_lha_multipolygon/boundary/Boundary.shp",
    "B": "03_shp_value_noUnit/20250415_211530.shp",
}


def settings(**changes: Any) -> Settings:
    """Return what the reference's figures were made with."""
    return Settings(
        swath_width_m=WIDTH_M, speed_m_s=SPEED_M_S, tank_l=TANK_L, reserve_l=0.0, **changes
    )


def to_degrees(area: Area, frame: LocalFrame = FRAME) -> Area:
    """Return an area of the frame in longitude and latitude."""

    def turn(points: Floats) -> Floats:
        lat, lon = frame.to_geographic_all(points[:, 0].tolist(), points[:, 1].tolist())
        return np.column_stack([lon, lat])

    found: Area = shapely.transform(area, turn)
    return found


def comb() -> Polygon:
    """Return field C: a back with three teeth, two holes, 7.5 ha."""
    shell = [
        (0, 0), (300, 0), (300, 330), (220, 330), (220, 120), (180, 120),
        (180, 330), (120, 330), (120, 105), (75, 105), (75, 330), (0, 330),
    ]  # fmt: skip
    holes = [
        [(20, 30), (60, 30), (60, 70), (20, 70)],
        [(235, 150), (275, 150), (275, 190), (235, 190)],
    ]
    return Polygon(shell, holes)


def fields() -> dict[str, Field]:
    """Return fields A and B, where the samples are there, and C."""
    found = {}
    folder = os.environ.get("VRSPRAY_SAMPLES")
    if folder:
        for name, path in SAMPLES.items():
            found[name] = build_field(read_area(Path(folder) / path), swath_width_m=WIDTH_M)
    found["C"] = build_field(to_degrees(comb()), swath_width_m=WIDTH_M, frame=FRAME)
    return found


# --- what others fly --------------------------------------------------------------------------


def pattern(field: Field, *, in_pairs: bool) -> dict[str, Any]:
    """Return the figures of a grid along the longest edge; time from first to last line."""
    begun = process_time()
    # Neither knows holes: they are flown over, and sprayed.
    ground = as_area([Polygon(part.exterior) for part in polygons_of(field.outline)])
    assert ground is not None
    angle_deg = longest_edge_deg(ground)
    lines = nearest_order(grid_lines(ground, angle_deg, in_pairs=in_pairs, width_m=WIDTH_M))
    took_s = process_time() - begun
    hops = np.hypot(*(lines[1:, :2] - lines[:-1, 2:]).T)
    covered = united(lines, WIDTH_M)
    strips_m2 = float(lengths_m(lines).sum()) * WIDTH_M
    return {
        "coverage_percent": 100.0 * covered.intersection(field.spray).area / field.area_m2,
        "overlap_percent": 100.0 * (strips_m2 - covered.area) / field.area_m2,
        "outside_m2": covered.difference(field.spray).area,
        "path_km": (lengths_m(lines).sum() + hops.sum()) / 1000.0,
        "minutes": float(MOTION.legs_s(lengths_m(lines)).sum() + MOTION.legs_s(hops).sum()) / 60.0,
        "planning_s": took_s,
    }


def ours(field: Field, **changes: Any) -> tuple[Plan, dict[str, Any]]:
    """Return the plan with one endless tank and its figures; time from first to last line."""
    begun = process_time()
    plan = plan_mission(
        field,
        Settings(swath_width_m=WIDTH_M, speed_m_s=SPEED_M_S, tank_l=99_999.0, **changes),
        Uniform(rate_l_ha=RATE_L_HA),
    )
    took_s = process_time() - begun
    legs = [leg for sortie in plan.sorties for leg in sortie.legs[1:-1]]
    return plan, {
        "coverage_percent": plan.coverage.percent,
        "reachable_percent": plan.coverage.reachable_percent,
        "overlap_percent": plan.coverage.overlap_percent,
        "outside_m2": plan.coverage.outside_m2,
        "transit_outside_m": transit_outside_m(plan),
        "path_km": sum(leg.length_m for leg in legs) / 1000.0,
        "minutes": sum(leg.seconds for leg in legs) / 60.0,
        "planning_s": took_s,
    }


def transit_outside_m(plan: Plan) -> float:
    """Return how far transits lead outside the ground that may be flown over."""
    ground = plan.field.fly.buffer(1e-3)
    outside = 0.0
    for sortie in plan.sorties:
        for leg in sortie.legs:
            if leg.kind == "transit" and leg.length_m > 0.0:
                outside += shapely.LineString(leg.points).difference(ground).length
    return outside


# --- random fields ----------------------------------------------------------------------------


def random_field(seed: int) -> tuple[str, Area]:
    """Return the kind and the ground of one random field: metres around the frame's origin."""
    draw = random.Random(seed)
    kind = ("convex", "concave", "holes", "sliver", "islands", "comb", "smooth")[seed % 7]
    size_m = draw.uniform(60.0, 400.0)
    if kind == "convex":
        area: Area = shapely.MultiPoint(
            [(draw.uniform(-1, 1) * size_m, draw.uniform(-1, 1) * size_m) for _ in range(12)]
        ).convex_hull  # type: ignore[assignment]
    elif kind == "sliver":
        long, wide = draw.uniform(150, 600), draw.uniform(1.1, 4.0) * WIDTH_M
        area = Polygon([(0, 0), (long, draw.uniform(0, 20)), (long, wide + 10), (0, wide)])
    elif kind == "comb":
        area = _random_comb(draw)
    else:
        corners = 60 if kind == "smooth" else draw.randint(6, 16)
        area = _star(draw, size_m, corners, rough=0.05 if kind == "smooth" else 0.45)
    if kind == "holes":
        for _ in range(draw.randint(1, 5)):
            x, y = draw.uniform(-0.6, 0.6) * size_m, draw.uniform(-0.6, 0.6) * size_m
            hole = _star(draw, draw.uniform(3.0, 0.15 * size_m), draw.randint(4, 9), rough=0.3)
            area = area.difference(translate(hole, x, y)).buffer(0)
    if kind == "islands":
        other = _star(draw, size_m * 0.5, draw.randint(5, 9), rough=0.3)
        area = MultiPolygon(
            [*polygons_of(area), translate(other, 2.5 * size_m, draw.uniform(0, size_m))]
        )
    area = rotate(area, draw.uniform(0.0, 360.0), origin=(0.0, 0.0))
    found = as_area(polygons_of(area.buffer(0)))
    assert found is not None
    return kind, found


def _star(draw: random.Random, size_m: float, corners: int, *, rough: float) -> Polygon:
    turns = sorted(draw.uniform(0.0, 2.0 * math.pi) for _ in range(corners))
    if corners >= 30:
        turns = [2.0 * math.pi * number / corners for number in range(corners)]
    radii = [size_m * (1.0 - rough * draw.random()) for _ in turns]
    places = [(r * math.cos(t), r * math.sin(t)) for r, t in zip(radii, turns, strict=True)]
    whole = max(polygons_of(Polygon(places).buffer(0)), key=lambda part: part.area)
    assert isinstance(whole, Polygon)
    return whole


def _random_comb(draw: random.Random) -> Polygon:
    teeth, wide, gap = draw.randint(2, 4), draw.uniform(15, 60), draw.uniform(5, 40)
    back, long = draw.uniform(15, 60), draw.uniform(30, 200)
    parts = [shapely.box(0, 0, teeth * wide + (teeth - 1) * gap, back)]
    for number in range(teeth):
        west = number * (wide + gap)
        parts.append(shapely.box(west, 0, west + wide, back + long * draw.uniform(0.4, 1.0)))
    whole = shapely.union_all(parts)
    assert isinstance(whole, Polygon)
    return whole


def try_random(seed: int) -> dict[str, Any]:
    """Return the figures of one random field, or why it has no plan."""
    kind, ground = random_field(seed)
    begun = process_time()
    try:
        field = build_field(to_degrees(ground), swath_width_m=WIDTH_M, frame=FRAME)
        plan = plan_mission(field, settings(moves=2_000), Uniform(rate_l_ha=RATE_L_HA))
    except VrsprayError as error:
        fits = not ground.buffer(-WIDTH_M / 2.0 - 0.01).is_empty
        return {"seed": seed, "kind": kind, "error": str(error), "fits": fits}
    return {
        "seed": seed,
        "kind": kind,
        "area_ha": field.area_m2 / 1e4,
        "reachable_percent": plan.coverage.reachable_percent,
        "overlap_percent": plan.coverage.overlap_percent,
        "outside_m2": outside_m2(plan, ground),
        "transit_outside_m": transit_outside_m(plan),
        "lines": len(plan.lines),
        "volume_error": abs(
            plan.volume_l / RATE_L_HA * 1e4 / WIDTH_M - lengths_m(plan.lines).sum()
        ),
        "seconds": process_time() - begun,
    }


def outside_m2(plan: Plan, ground: Area) -> float:
    """Return what the strips of all sorties cover outside the ground as it was drawn."""
    rows = [
        [*leg.points[0], *leg.points[-1]]
        for sortie in plan.sorties
        for leg in sortie.legs
        if leg.kind == "spray"
    ]
    covered = united(np.array(rows), plan.settings.swath_width_m)
    return float(covered.difference(ground).area)


# --- refill -----------------------------------------------------------------------------------


def refill(field: Field, *, moves: int) -> list[dict[str, Any]]:
    """Return the ferry with a depot in the middle of the long edge and at a corner of field A."""
    whole, _ = ours(field)
    ring = max(polygons_of(field.outline), key=lambda part: part.area).exterior
    corners = shapely.get_coordinates(field.outline.minimum_rotated_rectangle)
    sides = np.hypot(*np.diff(corners, axis=0).T)
    long = int(np.argmax(sides))
    found = []
    for name, place in (
        ("middle", (corners[long] + corners[long + 1]) / 2),
        ("corner", corners[0]),
    ):
        depot = ring.interpolate(ring.project(shapely.Point(place))).coords[0][:2]
        begun = process_time()
        plan = plan_mission(
            field, settings(moves=moves), Uniform(rate_l_ha=RATE_L_HA),
            depots=(field.frame.to_geographic(depot[0], depot[1]),),
        )  # fmt: skip
        took_s = process_time() - begun
        naive_m, sorties = naive_ferry_m(whole, depot)
        ferry_m, transit_m = plan.length_m("ferry"), plan.length_m("transit")
        found.append(
            {
                "depot": name,
                "naive_ferry_km": naive_m / 1000.0,
                "naive_sorties": sorties,
                "ferry_km": ferry_m / 1000.0,
                "transit_km": transit_m / 1000.0,
                "sorties": len(plan.sorties),
                "ferry_percent": 100.0 * ferry_m / naive_m,
                "planning_s": took_s,
            }
        )
    return found


def naive_ferry_m(plan: Plan, depot: tuple[float, ...]) -> tuple[float, int]:
    """Return the ferry of one serpentine that goes home where the tank is empty, and back there."""
    per_m = RATE_L_HA * WIDTH_M / 10_000.0
    left_l, ferry_m, sorties = TANK_L, 0.0, 1
    lines = [leg.points for leg in plan.sorties[0].legs if leg.kind == "spray"]
    ferry_m += math.dist(depot, lines[0][0]) + math.dist(depot, lines[-1][-1])
    for start, end in lines:
        length_m, done_m = math.dist(start, end), 0.0
        while (length_m - done_m) * per_m > left_l:
            done_m += left_l / per_m
            share = done_m / length_m
            place = (start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1]))
            ferry_m += 2.0 * math.dist(depot, place)
            left_l, sorties = TANK_L, sorties + 1
        left_l -= (length_m - done_m) * per_m
    return ferry_m, sorties


def main() -> int:
    """Print the figures; 0 even where a target is missed: the figures are the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.missions", description=__doc__)
    parser.add_argument("--random", type=int, default=350, help="random fields")
    parser.add_argument("--seed", type=int, default=1, help="the first of their seeds")
    parser.add_argument("--moves", type=int, default=40_000, help="of the search for refills")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    results: dict[str, Any] = {"fields": {}, "refill": [], "random": []}
    for name, field in fields().items():
        rows = {"ours": ours(field)[1]}
        rows["grid"] = pattern(field, in_pairs=True)
        rows["survey"] = pattern(field, in_pairs=False)
        results["fields"][name] = rows
        for who, row in rows.items():
            say(f"{name} {who:7}" + "".join(f" {key} {value:.3f}" for key, value in row.items()))
        if name == "A":
            results["refill"] = refill(field, moves=given.moves)
            for found in results["refill"]:
                say(f"refill {found}")
    found = [try_random(seed) for seed in range(given.seed, given.seed + given.random)]
    results["random"] = found
    report(found)
    if given.json:
        sys.stdout.write(json.dumps(results, indent=1) + "\n")
    return 0


def report(found: list[dict[str, Any]]) -> None:
    """Say how the random fields fared, the worst cases first."""
    failed = [row for row in found if "error" in row]
    for row in failed:
        say(f"no plan: {row}")
    planned = [row for row in found if "error" not in row]
    if not planned:
        return
    for key, worst in (
        ("reachable_percent", min), ("outside_m2", max), ("transit_outside_m", max),
        ("volume_error", max), ("seconds", max),
    ):  # fmt: skip
        row = worst(planned, key=lambda each, key=key: each[key])  # type: ignore[misc]
        say(
            f"worst {key}: {row[key]:.5g} (seed {row['seed']}, {row['kind']}, {row['lines']} lines)"
        )
    low = [row for row in planned if row["reachable_percent"] < 99.9]
    say(f"{len(planned)} planned, {len(failed)} not, {len(low)} below 99.9 %")
    for row in low:
        say(f"  seed {row['seed']}, {row['kind']}: {row['reachable_percent']:.3f} %")


def say(text: str) -> None:
    """Tell a figure."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main())
