"""When each sortie takes off, and what it finds in tank and battery.

It takes off after refill and fresh battery, and never beside another aircraft.

Two sorties of different aircraft whose ways come nearer than the gap are never in the air
together, whatever the times turn out to be: the later one names the one that must have landed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import shapely
from shapely import LineString, Point
from shapely.geometry.base import BaseGeometry

from missions.plan import Plan, Sortie


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

        What the sortie before left, its reserve at least, is still in the tank, and nobody pours it
        out.
        """
        reserve_l = self._plan.settings.reserve_l
        before_l = self._left_l.get(sortie.aircraft, 0.0)
        add_l = max(sortie.volume_l + (reserve_l - before_l), 0.0)
        self._left_l[sortie.aircraft] = max(reserve_l, before_l - sortie.volume_l)
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
            "fill_l": max(sortie.volume_l + reserve_l, before_l),
            "add_l": add_l,
            "first": first,
            "battery_percent": used,
            "battery_left_percent": left,
        }
