"""What is known of each sortie before take-off: when, and what it finds, in words and as keys.

It takes off after refill and fresh battery, and never beside another aircraft.

Two sorties of different aircraft whose ways come nearer than the gap are never in the air
together, whatever the times turn out to be: the later one names the one that must have landed.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from shapely import LineString, Point
from shapely.geometry.base import BaseGeometry

from companion.wording import counted
from missions.boom import boom_of
from missions.energy import J_WH
from missions.files.items import ITEMS_MAX, items_of
from missions.plan import Plan, Sortie
from missions.refill_search import main_course
from missions.strips import GRID_M, Floats, directions, lengths_m, whole

# --------------------------------------------------------------------------------------------- when


def scheduled(plan: Plan) -> Plan:
    """Return the plan with the start of each sortie; within an aircraft they keep their order."""
    waiting = {
        aircraft: [each for each in plan.sorties if each.aircraft == aircraft]
        for aircraft in sorted({sortie.aircraft for sortie in plan.sorties})
    }
    near = _conflicts(plan)
    free_s = dict.fromkeys(waiting, 0.0)
    left_wh = dict.fromkeys(waiting, _usable_wh(plan))
    done: list[Sortie] = []
    while any(waiting.values()):
        starts = {
            aircraft: _start(plan, queue[0], free_s[aircraft], done, near)
            for aircraft, queue in waiting.items()
            if queue
        }
        aircraft = min(starts, key=lambda each: (starts[each], each))
        sortie = waiting[aircraft].pop(0)
        used_wh = plan.energy_wh(sortie) or 0.0
        swaps = used_wh > left_wh[aircraft]
        left_wh[aircraft] = (_usable_wh(plan) if swaps else left_wh[aircraft]) - used_wh
        start_s = max(starts[aircraft], free_s[aircraft] + (plan.settings.swap_s if swaps else 0.0))
        taken = replace(sortie, start_s=start_s, swaps=swaps, after=_after(sortie, done, near))
        free_s[aircraft] = start_s + plan.airborne_s(taken) + plan.settings.refill_s
        done.append(taken)
    return replace(plan, sorties=tuple(sorted(done, key=lambda each: each.number)))


def _usable_wh(plan: Plan) -> float:
    battery = plan.settings.battery
    return float("inf") if battery is None else battery.usable_wh


def _start(
    plan: Plan, sortie: Sortie, free_s: float, done: list[Sortie], near: set[frozenset[int]]
) -> float:
    """Return when a sortie may start: once its aircraft is ready and those near it have landed."""
    landed = [
        each.start_s + plan.airborne_s(each)
        for each in done
        if frozenset((each.number, sortie.number)) in near
    ]
    return max([free_s, *landed])


def _after(sortie: Sortie, done: list[Sortie], near: set[frozenset[int]]) -> tuple[int, ...]:
    """Return the last sortie of each other aircraft that must have landed before."""
    last: dict[int, int] = {}
    for each in done:
        if frozenset((each.number, sortie.number)) in near:
            last[each.aircraft] = each.number
    return tuple(sorted(last.values()))


def way_of(sortie: Sortie) -> LineString:
    """Return the whole way of a sortie."""
    return LineString([point for leg in sortie.legs for point in leg.points])


def separation_m(plan: Plan) -> float | None:
    """Return how near the ways of aircraft come that may be in the air together."""
    near = _conflicts(plan)
    ways = _ways(plan)
    found = [
        _apart_m(plan, one, other, ways)
        for at, one in enumerate(plan.sorties)
        for other in plan.sorties[at + 1 :]
        if one.aircraft != other.aircraft and frozenset((one.number, other.number)) not in near
    ]
    return min(found, default=None)


def _conflicts(plan: Plan) -> set[frozenset[int]]:
    """Return the pairs of sorties that come too near to each other."""
    ways = _ways(plan)
    gap_m = plan.settings.aircraft_gap_m
    return {
        frozenset((one.number, other.number))
        for at, one in enumerate(plan.sorties)
        for other in plan.sorties[at + 1 :]
        if one.aircraft != other.aircraft and not _apart_m(plan, one, other, ways) >= gap_m
    }


def _ways(plan: Plan) -> dict[int, LineString]:
    return {sortie.number: way_of(sortie) for sortie in plan.sorties}


def _apart_m(plan: Plan, one: Sortie, other: Sortie, ways: dict[int, LineString]) -> float:
    """Return how near two ways come; around a depot that both use, people look after that."""
    first: BaseGeometry = ways[one.number]
    second: BaseGeometry = ways[other.number]
    if one.depot == other.depot:
        around = Point(plan.depots[one.depot]).buffer(plan.settings.aircraft_gap_m)
        first, second = first.difference(around), second.difference(around)
        if first.is_empty or second.is_empty:
            return float("inf")
    return float(shapely.distance(first, second))


def fleet_warnings(plan: Plan) -> tuple[str, ...]:
    """Warn where aircraft that wait for each other take longer than one of them would alone.

    One aircraft is reckoned to fly the same legs with as few sorties as its tank and battery allow.
    """
    count, sorties = len({sortie.aircraft for sortie in plan.sorties}), plan.sorties
    if count < 2:
        return ()
    fewest = max(math.ceil(plan.volume_l / plan.settings.usable_l), 1)
    used_wh = [plan.energy_wh(sortie) or 0.0 for sortie in sorties]
    fewest = min(max(fewest, math.ceil(sum(used_wh) / _usable_wh(plan))), len(sorties))
    spared_s = min(
        plan.airborne_s(sortie) - sum(leg.seconds for leg in sortie.legs if leg.kind != "ferry")
        for sortie in sorties
    )
    alone_s = sum(map(plan.airborne_s, sorties)) - (len(sorties) - fewest) * spared_s
    alone_s += (fewest - 1) * plan.settings.refill_s
    if plan.total_s <= alone_s:
        return ()
    return (
        f"{count} aircraft wait for each other and take {plan.total_s / 60.0:.1f} min; one alone "
        f"would take about {alone_s / 60.0:.1f} min (--aircraft, mission.aircraft)",
    )


def filled_of(plan: Plan) -> dict[int, dict[str, Any]]:
    """Return by its number what each sortie finds in tank and battery, and what is put in."""
    aboard = _Aboard(plan)
    in_time = sorted(plan.sorties, key=lambda each: (each.start_s, each.number))
    return {sortie.number: aboard.fill(sortie) for sortie in in_time}


class _Aboard:
    """What is in tank and battery of each aircraft, sortie after sortie."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._left_wh: dict[int, float] = {}
        self._left_l: dict[int, float] = {1: plan.settings.in_tank_l}

    def fill(self, sortie: Sortie) -> dict[str, Any]:
        """Return what is put in before a sortie, and what is left after it.

        `needs_l` is what passes ask for, or what the flight puts out where that is more. What the
        sortie before left, its reserve at least, is still in the tank, and nobody pours it
        out.
        """
        # The tank holds no more: beyond that it is the reserve that is sprayed (and warned of).
        needs_l = min(self._plan.needs_l(sortie), self._plan.settings.usable_l)
        reserve_l = self._plan.settings.reserve_l
        before_l = self._left_l.get(sortie.aircraft, 0.0)
        add_l = max(needs_l + (reserve_l - before_l), 0.0)
        self._left_l[sortie.aircraft] = max(reserve_l, before_l - needs_l)
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
            "fill_l": max(needs_l + reserve_l, before_l),
            "add_l": add_l,
            "needs_l": needs_l,
            "first": first,
            "battery_percent": used,
            "battery_left_percent": left,
        }


# ----------------------------------------------------------------------------- in words and as keys


def sheet(plan: Plan, *, with_sprayer: bool = False, once: bool = False) -> dict[str, Any]:
    """Return the summary, with what each sortie needs to be filled, flown and uploaded.

    `once` is said of litres that already leave out what is sprayed twice.
    """
    found: dict[str, Any] = plan.summary() | {"least_idle_m": least_idle_of(plan)}
    overlap_l = {} if once else overlap_by_sortie_l(plan)
    found["overlap_l"] = sum(overlap_l.values())
    found["overlap_litres_percent"] = 100.0 * found["overlap_l"] / plan.volume_l
    filled = filled_of(plan)
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


def _farthest_m(plan: Plan, sortie: Sortie) -> float:
    """Return how far from its depot a sortie comes: as far as one of its corners."""
    depot = plan.depots[sortie.depot]
    return max(math.dist(depot, place) for leg in sortie.legs for place in leg.points)


def overlap_by_sortie_l(plan: Plan) -> dict[int, float]:
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
        f"sortie {sortie.number:3}  fill to {row['fill_l']:6.2f} L, spray {row['needs_l']:6.2f} L"
        f"  {row['airborne_s'] / 60.0:5.1f} min from {sortie.start_s / 60.0:.0f} min  "
        f"{counted(sortie.lines, 'line')}, {_speeds(sortie.speeds_m_s)}, "
        f"{row['items']} mission items (the autopilot holds {ITEMS_MAX[plan.settings.autopilot]}), "
        f"at most {row['farthest_m']:.0f} m from the depot, "
        f"{row['overlap_l']:.2f} L on ground sprayed before"
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


# How far the sorties of a plan must fly without spraying, whatever their order.

# So many places of a pass, and slopes, are looked at.
SAMPLES, SLOPES = 16, 41
PARALLEL = math.cos(math.radians(1.0))
# Passes whose litres by the metre differ by less count as even.
EVEN = 0.01


def least_idle_m(
    lines: Floats, litres: Floats, depots: Floats, *, usable_l: float, longest_m: float = math.inf
) -> float:
    """Return a lower bound of ferries and transits together.

    Let h be a height that is 0 at the depots, rises by 1 a metre at most, and by s at most along
    the passes. A sortie that sprays S metres and flies I without is at most I / 2 + s S / 4 high
    on average: it climbed there, and will climb down. So I is at least twice its mean height less
    s S / 2, and S is what a tank or a battery lets it spray. With s = 0 this is the bound of
    Haimovich and Rinnooy Kan (1985) across the passes; s = 1 allows for sorties out and back. The
    s that gives most is taken. Passes in other courses than most count as ways that cost nothing;
    where rates differ, the mean is that of the litres, and less is known of the climb.
    """
    if not len(lines) or not float(litres.sum()) > 0.0:
        return 0.0
    along = np.array(main_course(lines))
    cosine = np.abs(directions(lines) @ along)
    main = cosine > PARALLEL
    length_m = lengths_m(lines)
    by_metre = litres[main] / length_m[main]
    is_even = float(by_metre.max()) <= (1.0 + EVEN) * float(by_metre.min())
    shares = (np.arange(SAMPLES) + 0.5) / SAMPLES
    step = lines[main, 2:] - lines[main, :2]
    places = lines[main, None, :2] + shares[None, :, None] * step[:, None, :]
    away = places[None] - depots[:, None, None, :]
    u, v = np.abs(away @ along), np.abs(away @ np.array([-along[1], along[0]]))
    bends = np.arccos(np.clip(cosine[~main], 0.0, 1.0))
    least_m = 0.0
    for s in np.linspace(0.0, 1.0, SLOPES).tolist():
        far = np.hypot(u, v)
        height = np.where(u <= s * far, far, s * u + math.sqrt(1.0 - s * s) * v)
        mean_m = height.min(axis=0).mean(axis=1)
        flat = math.acos(s)
        slopes = np.where(bends >= flat, 1.0, np.cos(flat - bends))
        aside_m = float((slopes * length_m[~main]).sum())
        climb_m = s * float(length_m[main].sum())
        found = [2.0 / usable_l * float(mean_m @ litres[main]) - climb_m]
        if is_even:
            longest_m = min(longest_m, usable_l / float(by_metre.min()))
            found.append(2.0 / longest_m * float(mean_m @ length_m[main]) - climb_m / 2.0)
        least_m = max(least_m, max(found) - aside_m)
    return least_m


def least_idle_of(plan: Plan) -> float:
    """Return what the ferries and transits of a plan come to at least, for its passes."""
    legs = [leg for sortie in plan.sorties for leg in sortie.legs if leg.kind == "spray"]
    legs = [leg for leg in legs if leg.length_m > 0.0]
    settings, longest_m = plan.settings, math.inf
    battery = settings.battery
    if legs and battery is not None and battery.capacity_wh is not None:
        lightest_w = min(battery.cruise_w, battery.hover_w)
        seconds = battery.usable_wh * J_WH / lightest_w
        longest_m = seconds * max(leg.speed_m_s for leg in legs)
    return least_idle_m(
        np.array([[*leg.points[0], *leg.points[-1]] for leg in legs]).reshape(-1, 4),
        np.array([leg.volume_l for leg in legs]),
        np.array(plan.depots),
        usable_l=settings.usable_l,
        longest_m=longest_m,
    )
