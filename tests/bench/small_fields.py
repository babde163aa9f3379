"""Small and narrow fields: time and product beside the grid that Mission Planner flies.

Equal coverage is the grid's, which sprays beyond the border: `outside_percent` of the field. Where
its lines end as soon as a strip would leave the field, it covers `grid_inside_reached`.

python -m tests.bench.small_fields [--only NAME] [--seed 1] [--each 4] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
from time import process_time
from typing import Any

import numpy as np
import shapely

from missions.demand import Uniform
from missions.field import Field, build_field
from missions.layouts import LOST_SHARE
from missions.plan import LEAVE_PERCENT, Leg, Plan, Settings, Sortie
from missions.planner import plan_mission
from missions.sheet import sheet
from missions.stops import timed
from missions.strips import Floats, directions, lengths_m, rectangles
from tests.bench.missions import say
from tests.bench.peers import lines_of
from tests.mission_judge import Drawn
from tests.small_fields import small_fields

# Six valves of a metre, as in examples/anyang.
VALVES = tuple((-2.5 + number, 1.0) for number in range(6))
SPEED_M_S, RATE_L_HA, TANK_L = 6.0, 20.0, 99_999.0
# Valves that close at the border are looked at so often along a line.
ALONG_M = 0.1


def settings(width_m: float, **changes: Any) -> Settings:
    """Return what all are planned with."""
    return Settings(swath_width_m=width_m, speed_m_s=SPEED_M_S, tank_l=TANK_L, **changes)


def grid(drawn: Drawn, field: Field) -> dict[str, Any]:
    """Return the figures of a grid along the longest edge, and of what of it stays inside."""
    lines = lines_of("grid", field.outline, drawn.width_m)
    strips = shapely.union_all(rectangles(lines, drawn.width_m), grid_size=1e-6)
    inside = _kept_inside(lines, field, drawn.width_m)
    return {
        "minutes": minutes(legs_of(lines), drawn.width_m),
        "outside_percent": 100.0 * strips.difference(field.limit).area / field.area_m2,
        "inside_minutes": minutes(legs_of(inside), drawn.width_m) if len(inside) else 0.0,
        "inside_reached_percent": covered(inside, field, drawn.width_m)["reached_percent"],
    } | covered(lines, field, drawn.width_m)


def _kept_inside(lines: Floats, field: Field, width_m: float) -> Floats:
    """Return the lines as far as their strips lie on the field: of each the longest part."""
    rows = []
    for line, way in zip(lines, directions(lines), strict=True):
        strip = rectangles(line[None], width_m - 0.01)[0]
        outside = shapely.get_parts(strip.difference(field.limit))
        reached_m, best = 0.0, (0.0, 0.0)
        spans = [((shapely.get_coordinates(part) - line[:2]) @ way) for part in outside]
        ends = sorted((float(span.min()), float(span.max())) for span in spans if len(span))
        for start_m, end_m in [*ends, (float(lengths_m(line[None])[0]), math.inf)]:
            best = max(best, (reached_m, start_m), key=lambda each: each[1] - each[0])
            reached_m = max(reached_m, end_m)
        if best[1] - best[0] > 0.5:
            rows.append([*(line[:2] + way * best[0]), *(line[:2] + way * best[1])])
    return np.array(rows).reshape(-1, 4)


def by_valves(lines: Floats, field: Field) -> Any:
    """Return the ground over which a valve lies on the field with all its width."""
    ground = field.limit.buffer(0.002)
    shapely.prepare(ground)
    found = []
    for line, way, long_m in zip(lines, directions(lines), lengths_m(lines), strict=True):
        right = np.array([way[1], -way[0]])
        at_m = np.linspace(0.0, long_m, max(2, round(long_m / ALONG_M) + 1))[:, None]
        for right_m, width_m in VALVES:
            sides = [
                line[:2] + way * at_m + right * (right_m + side * width_m / 2.0) for side in (-1, 1)
            ]
            on = shapely.covers(ground, shapely.linestrings(np.stack(sides, axis=1)))
            change = np.diff(np.concatenate([[0], on.astype(np.int8), [0]]))
            first, last = np.flatnonzero(change == 1), np.flatnonzero(change == -1) - 1
            some = last > first
            first, last, (left, other) = first[some], last[some], sides
            corners = [left[first], left[last], other[last], other[first]]
            found.append(shapely.polygons(np.stack(corners, axis=1)))
    return np.concatenate(found)


def covered(
    lines: Floats, field: Field, width_m: float, *, ends_over: bool = False
) -> dict[str, Any]:
    """Return what lines cover, in % of the ground that a strip can reach, and what twice."""
    half_m = width_m / 2.0
    ground = field.limit
    reach = ground.buffer(-half_m, quad_segs=32).buffer(half_m, quad_segs=32)
    strips = by_valves(lines, field) if ends_over else rectangles(lines, width_m)
    all_of_it = shapely.union_all(strips, grid_size=1e-6)
    return {
        "lines": len(lines),
        "reached_percent": 100.0 * all_of_it.intersection(reach).area / reach.area,
        "off_m2": all_of_it.difference(ground).area,
        "twice_percent": 100.0 * (float(shapely.area(strips).sum()) - all_of_it.area) / ground.area,
    }


def legs_of(lines: Floats) -> list[Leg]:
    """Return lines in their order as legs, with the ways between them."""
    legs: list[Leg] = []
    for row in lines.tolist():
        start, end = (row[0], row[1]), (row[2], row[3])
        if legs:
            legs.append(
                Leg(kind="transit", points=(legs[-1].points[-1], start), speed_m_s=SPEED_M_S)
            )
        legs.append(Leg(kind="spray", points=(start, end), speed_m_s=SPEED_M_S))
    return legs


def minutes(legs: list[Leg], width_m: float) -> float:
    """Return the time of legs from rest to rest, as the plan's autopilot flies them."""
    first, last = legs[0].points[0], legs[-1].points[-1]
    home = (last[0] + 100.0, last[1])
    ferries = (
        Leg(kind="ferry", points=(first, first), speed_m_s=SPEED_M_S),
        Leg(kind="ferry", points=(last, home), speed_m_s=SPEED_M_S),
    )
    sortie = Sortie(number=1, depot=0, legs=(ferries[0], *legs, ferries[1]))
    return sum(leg.seconds for leg in timed([sortie], settings(width_m))[0].legs[:-1]) / 60.0


def planned(drawn: Drawn, **changes: Any) -> tuple[Plan, dict[str, Any]]:
    """Return the plan and its figures."""
    begun = process_time()
    field = build_field(drawn.outline, swath_width_m=drawn.width_m)
    plan = plan_mission(field, settings(drawn.width_m, **changes), Uniform(rate_l_ha=RATE_L_HA))
    took_s = process_time() - begun
    legs = [leg for sortie in plan.sorties for leg in sortie.legs[1:-1]]
    lines = np.array([[*each.points[0], *each.points[-1]] for each in legs if each.kind == "spray"])
    return plan, {
        "minutes": minutes(legs, drawn.width_m),
        "twice_l_percent": sheet(plan)["overlap_litres_percent"],
        "cpu_s": took_s,
    } | covered(lines, field, drawn.width_m, ends_over=plan.settings.ends_over)


def at_equal_coverage(drawn: Drawn, reached_percent: float, **changes: Any) -> dict[str, Any]:
    """Return the figures of the quickest plan that covers as much as another."""
    left_percent = 100.0 - reached_percent
    most = {min(max(left_percent / share, LEAVE_PERCENT), 50.0) for share in (LOST_SHARE, 1.0)}
    found = [
        planned(drawn, leave_max_percent=percent, **changes)[1]
        for percent in sorted(most, reverse=True)
    ]
    enough = [each for each in found if each["reached_percent"] >= reached_percent]
    return min(enough or found[-1:], key=lambda each: each["minutes"])


def compared(drawn: Drawn) -> dict[str, float]:
    """Return the plan, that of one family of lines alone, and the grid, at equal coverage too."""
    plan, ours = planned(drawn)
    _, family = planned(drawn, moves=0)
    theirs = grid(drawn, plan.field)
    equal = at_equal_coverage(drawn, theirs["reached_percent"])
    # On ditches next to nothing of the grid stays inside.
    inside_time = inside_reached = math.nan
    if theirs["inside_reached_percent"] > 50.0:
        inside = at_equal_coverage(drawn, theirs["inside_reached_percent"])
        inside_time = inside["minutes"] / theirs["inside_minutes"]
        inside_reached = inside["reached_percent"]
    closes = {"valves": VALVES, "border_buffer_m": 0.0, "ends_over": True}
    _, over = planned(drawn, **closes)
    over_equal = at_equal_coverage(drawn, theirs["reached_percent"], **closes)
    _, closing = planned(drawn, valves=VALVES, switch_off_percent=100.0)
    return {
        "ha": plan.field.area_m2 / 1e4,
        "grid_reached": theirs["reached_percent"],
        "outside_percent": theirs["outside_percent"],
        "grid_inside_reached": theirs["inside_reached_percent"],
        "time_family": family["minutes"] / theirs["minutes"],
        "time": ours["minutes"] / theirs["minutes"],
        "reached": ours["reached_percent"],
        "equal_time": equal["minutes"] / theirs["minutes"],
        "equal_reached": equal["reached_percent"],
        "inside_time": inside_time,
        "inside_reached": inside_reached,
        "over_time": over["minutes"] / theirs["minutes"],
        "over_reached": over["reached_percent"],
        "over_off_m2": over["off_m2"],
        "over_equal_time": over_equal["minutes"] / theirs["minutes"],
        "over_equal_reached": over_equal["reached_percent"],
        "twice_l_percent_family": family["twice_l_percent"],
        "twice_l_percent": ours["twice_l_percent"],
        "twice_l_percent_over": over["twice_l_percent"],
        "twice_l_percent_closing": closing["twice_l_percent"],
        "cpu_s": ours["cpu_s"],
        "over_cpu_s": over["cpu_s"],
    }


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.small_fields", description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name has this")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=4, help="fields of a kind")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    rows: dict[str, Any] = {}
    for name, drawn in small_fields(given.seed, given.each):
        if given.only in name:
            rows[name] = row = compared(drawn)
            say(f"{name:20}" + "".join(f"  {key} {value:.2f}" for key, value in row.items()))
    for key in next(iter(rows.values()), {}):
        values = [row[key] for row in rows.values() if not math.isnan(row[key])]
        if not values:
            continue
        say(
            f"{key:24} median {statistics.median(values):8.3f}  mean {statistics.mean(values):8.3f}"
            f"  least {min(values):8.3f}  most {max(values):8.3f}"
        )
    if given.json:
        sys.stdout.write(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
