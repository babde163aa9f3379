"""What is known of each sortie before take-off, in words and as keys."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely

from companion.wording import counted
from missions.boom import boom_of
from missions.files.items import items_of
from missions.files.plan_rules import ITEMS_MAX
from missions.least_ferry import least_idle_of
from missions.plan import Plan, Sortie
from missions.schedule import separation_m
from missions.strips import GRID_M, whole


def sheet(plan: Plan, *, with_sprayer: bool = False, once: bool = False) -> dict[str, Any]:
    """Return the summary, with what each sortie needs to be filled, flown and uploaded.

    `once` is said of litres that already leave out what is sprayed twice.
    """
    found: dict[str, Any] = plan.summary() | {"least_idle_m": least_idle_of(plan)}
    overlap_l = {} if once else _overlap_l(plan)
    found["overlap_l"] = sum(overlap_l.values())
    found["overlap_litres_percent"] = 100.0 * found["overlap_l"] / plan.volume_l
    aboard = _Aboard(plan)
    in_time = sorted(plan.sorties, key=lambda each: (each.start_s, each.number))
    filled = {sortie.number: aboard.fill(sortie) for sortie in in_time}
    for row, sortie in zip(found["sorties"], plan.sorties, strict=True):
        row["items"] = len(items_of(plan, sortie, with_sprayer=with_sprayer))
        row["land_s"] = sortie.start_s + row["airborne_s"]
        row["farthest_m"] = _farthest_m(plan, sortie)
        row["overlap_l"] = overlap_l.get(sortie.number, 0.0)
        row |= filled[sortie.number]
    found["items_max"] = ITEMS_MAX[plan.settings.autopilot]
    if plan.settings.aircraft > 1:
        found["aircraft"] = _crafts(plan)
        found["separation_m"] = separation_m(plan)
    return found


def ground_text(found: dict[str, Any]) -> str:
    """Return the ground that is to be covered; what has no rate is none of it.

    >>> ground_text({"area_ha": 2.0, "without_rate_ha": 0.5})
    '1.50 ha (another 0.50 ha have no rate)'
    >>> ground_text({"area_ha": 2.0, "without_rate_ha": 0.0})
    '2.00 ha'
    """
    bare_ha = found["without_rate_ha"]
    text = f"{found['area_ha'] - bare_ha:.2f} ha"
    return text if bare_ha == 0.0 else f"{text} (another {bare_ha:.2f} ha have no rate)"


class _Aboard:
    """What is in tank and battery of each aircraft, sortie after sortie."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._left_wh: dict[int, float] = {}

    def fill(self, sortie: Sortie) -> dict[str, Any]:
        """Return what is put in before a sortie, and what is left after it.

        The reserve of the sortie before is still in the tank, and nobody pours it out.
        """
        reserve_l = self._plan.settings.reserve_l
        first = sortie.aircraft not in self._left_wh
        battery, used_wh = self._plan.settings.battery, self._plan.energy_wh(sortie)
        capacity_wh = None if battery is None else battery.capacity_wh
        used = left = None
        if capacity_wh is None or used_wh is None:
            self._left_wh[sortie.aircraft] = 0.0
        else:
            full = first or sortie.swaps
            left_wh = (capacity_wh if full else self._left_wh[sortie.aircraft]) - used_wh
            self._left_wh[sortie.aircraft] = left_wh
            used, left = 100.0 * used_wh / capacity_wh, 100.0 * left_wh / capacity_wh
        return {
            "fill_l": sortie.volume_l + reserve_l,
            "add_l": sortie.volume_l + (reserve_l if first else 0.0),
            "first": first,
            "battery_percent": used,
            "battery_left_percent": left,
        }


def _farthest_m(plan: Plan, sortie: Sortie) -> float:
    """Return how far from its depot a sortie comes: as far as one of its corners."""
    depot = plan.depots[sortie.depot]
    return max(math.dist(depot, place) for leg in sortie.legs for place in leg.points)


def _overlap_l(plan: Plan) -> dict[int, float]:
    """Return the litres of each sortie that fall on ground already sprayed.

    A line's litres count evenly along it; where valves close, they are counted by valve.
    """
    if any(leg.overlap_l is not None for sortie in plan.sorties for leg in sortie.legs):
        return {
            sortie.number: sum(leg.overlap_l or 0.0 for leg in sortie.legs)
            for sortie in plan.sorties
        }
    flown = [
        (sortie.number, leg)
        for sortie in sorted(plan.sorties, key=lambda each: (each.start_s, each.number))
        for leg in sortie.legs
        if leg.kind == "spray"
    ]
    lines = np.array([[*leg.points[0], *leg.points[-1]] for _, leg in flown])
    strips = boom_of(plan.settings, plan.field).strips(lines)
    one, other = shapely.STRtree(strips).query(strips, predicate="intersects")
    earlier: dict[int, list[int]] = {}
    for at, before in zip(one.tolist(), other.tolist(), strict=True):
        if before < at:
            earlier.setdefault(at, []).append(before)
    found: dict[int, float] = {}
    for at, before in earlier.items():
        twice = shapely.intersection(strips[at], whole(strips[before]), grid_size=GRID_M)
        number, leg = flown[at]
        share = float(twice.area) / float(strips[at].area)
        found[number] = found.get(number, 0.0) + leg.volume_l * share
    return found


def _crafts(plan: Plan) -> list[dict[str, Any]]:
    rows = []
    for number in sorted({sortie.aircraft for sortie in plan.sorties}):
        own = [sortie for sortie in plan.sorties if sortie.aircraft == number]
        rows.append(
            {
                "number": number,
                "sorties": [sortie.number for sortie in own],
                "volume_l": sum(sortie.volume_l for sortie in own),
                "flight_s": sum(sortie.flight_s for sortie in own),
                "end_s": max(sortie.start_s + plan.airborne_s(sortie) for sortie in own),
            }
        )
    return rows


def sortie_lines(plan: Plan, found: dict[str, Any]) -> list[str]:
    """Return a line for each sortie, with what it waits for."""
    rows = zip(plan.sorties, found["sorties"], strict=True)
    return [_line(plan, sortie, row) for sortie, row in rows]


def _line(plan: Plan, sortie: Sortie, row: dict[str, Any]) -> str:
    texts = [
        f"sortie {sortie.number:3}  fill to {row['fill_l']:6.2f} L, spray {sortie.volume_l:6.2f} L"
        f"  {row['airborne_s'] / 60.0:5.1f} min from {sortie.start_s / 60.0:.0f} min  "
        f"{counted(sortie.lines, 'line')}, {_speeds(sortie.speeds_m_s)}, "
        f"{row['items']} of {ITEMS_MAX[plan.settings.autopilot]} items, "
        f"up to {row['farthest_m']:.0f} m away, {row['overlap_l']:.2f} L twice"
    ]
    used_wh = plan.energy_wh(sortie)
    if used_wh is not None:
        share = row["battery_percent"]
        of_it = "" if share is None else f" ({share:.0f} %)"
        texts.append(f"{used_wh:.0f} Wh{of_it}{', fresh battery' if sortie.swaps else ''}")
    if plan.settings.aircraft > 1:
        texts.append(f"aircraft {sortie.aircraft}")
    if sortie.after:
        numbers = " and ".join(str(number) for number in sortie.after)
        texts.append(f"not before sortie {numbers} has landed")
    return ", ".join(texts)


def _speeds(speeds_m_s: tuple[float, float]) -> str:
    """Return speeds in words.

    >>> _speeds((6.0, 6.0)), _speeds((4.5, 6.0))
    ('6 m/s', '4.5 to 6 m/s')
    """
    low, high = speeds_m_s
    return f"{high:g} m/s" if low == high else f"{low:g} to {high:g} m/s"
