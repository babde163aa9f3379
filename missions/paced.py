"""Sorties with a speed for each leg; what stays out of the valves' range, in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.core.frame import LocalFrame
from companion.wording import counted
from missions.demand import Rates
from missions.errors import PlanError
from missions.heights import capped, slowed
from missions.plan import Leg, Settings, Sortie
from missions.speeds import Miss, Stretches, between, choices, chosen, misses_of, stretches_of
from missions.strips import Floats
from missions.terrain import Terrain
from missions.ways import Ways

# A part of a line shorter than this is no leg of its own.
PART_MIN_M = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Paced:
    """Sorties with their speeds, and what no allowed speed brings into range.

    `unfenced` is how many of the `uncut` ones had no room for a fence and are flown as several.
    """

    sorties: tuple[Sortie, ...]
    misses: tuple[tuple[int, Miss], ...]
    unfenced: int = 0
    uncut: int = 0


def paced(
    sorties: Sequence[Sortie], rates: Rates, settings: Settings, terrain: Terrain | None = None
) -> Paced:
    """Return the sorties, each line at the speeds that its rates and its slopes need.

    A line with several speeds becomes several legs, one after the other without a stop.
    """
    if settings.flow_l_min is None and terrain is None:
        return Paced(sorties=tuple(sorties), misses=())
    found, misses = [], []
    for sortie in sorties:
        legs: list[Leg] = []
        for leg in sortie.legs:
            if leg.kind != "spray":
                legs.append(leg if terrain is None else slowed(leg, terrain, settings))
                continue
            parts = stretches_of(leg, rates, settings)
            taken = chosen(parts, choices(parts, settings), settings.acceleration_m_s2)
            if terrain is not None:
                parts, taken = capped(leg, parts, taken, terrain, settings)
            misses += [(sortie.number, m) for m in misses_of(leg, parts, taken, settings)]
            legs += _split(leg, parts, taken, settings)
        found.append(replace(sortie, legs=_joined(legs, settings)))
    return Paced(sorties=tuple(found), misses=tuple(misses))


def _split(leg: Leg, parts: Stretches, taken: Floats, settings: Settings) -> list[Leg]:
    """Return the legs of a line; before a slower one the aircraft brakes in the faster one."""
    last = np.flatnonzero(np.append(np.diff(taken) != 0.0, True))
    speeds = taken[last]
    if len(speeds) == 1 and speeds[0] == settings.speed_m_s:
        return [leg]
    length_m = leg.length_m
    cuts = np.concatenate([[0.0], parts.ends_m[last]])
    cuts[-1] = length_m
    for number in range(1, len(speeds)):
        slows = speeds[number - 1] ** 2 - speeds[number] ** 2
        brake_m = max(slows, 0.0) / (2.0 * settings.acceleration_m_s2)
        cut = max(cuts[number] - brake_m, cuts[number - 1] + PART_MIN_M)
        if cut > length_m - PART_MIN_M:
            # No part so short at the end: it is begun earlier, where it is slower, or not at all.
            cut = _earlier(cuts[number - 1], length_m) if slows > 0.0 else length_m
        cuts[number] = cut
    at_m = np.concatenate([[0.0], parts.ends_m])
    at_m[-1] = length_m
    litres = np.interp(cuts, at_m, np.concatenate([[0.0], np.cumsum(parts.litres)]))
    litres[-1] = leg.volume_l
    legs = []
    for number, speed in enumerate(speeds.tolist()):
        if cuts[number + 1] - cuts[number] < 1e-6:
            continue
        points = (between(leg, cuts[number] / length_m), between(leg, cuts[number + 1] / length_m))
        legs.append(
            Leg(
                kind="spray", points=points, speed_m_s=speed,
                volume_l=float(litres[number + 1] - litres[number]),
            )
        )  # fmt: skip
    ends = (leg.points[0], leg.points[-1])
    legs[0] = replace(legs[0], points=(ends[0], legs[0].points[1]))
    legs[-1] = replace(legs[-1], points=(legs[-1].points[0], ends[1]))
    return legs


def _earlier(before_m: float, length_m: float) -> float:
    """Return where the last, slower part of a line begins: with the one before if that is short."""
    cut = length_m - PART_MIN_M
    return cut if cut >= before_m + PART_MIN_M else before_m


def _joined(legs: list[Leg], settings: Settings) -> tuple[Leg, ...]:
    """Return the legs, those between two lines at a speed that suits the lines.

    One flown through without a stop has the slower speed of the two. A side step too short for
    its speed to matter has that of the next line: one order less.
    """
    found = list(legs)
    acceleration = settings.acceleration_m_s2
    for number, leg in enumerate(legs):
        if leg.kind != "transit" or not 0 < number < len(legs) - 1:
            continue
        after = legs[number + 1].speed_m_s
        slower = min(legs[number - 1].speed_m_s, after)
        if leg.through:
            found[number] = replace(leg, speed_m_s=slower)
        elif len(leg.points) == 2 and leg.length_m <= after**2 / acceleration:
            slope_m_s = leg.speed_m_s if leg.speed_m_s < settings.speed_m_s else after
            found[number] = replace(leg, speed_m_s=min(after, slope_m_s))
    return tuple(found)


def range_warnings(
    misses: Sequence[tuple[int, Miss]], frame: LocalFrame, settings: Settings
) -> tuple[str, ...]:
    """Return what stays too much and what too little for the valves, with the worst place."""
    if settings.flow_l_min is None:
        return ()
    low, high = settings.flow_l_min
    texts = []
    for is_high in (True, False):
        some = [(number, miss) for number, miss in misses if (miss.flow_l_min > high) == is_high]
        if not some:
            continue
        number, worst = (max if is_high else min)(some, key=lambda each: each[1].flow_l_min)
        latitude_deg, longitude_deg = frame.to_geographic(*worst.place)
        length_m = sum(miss.length_m for _, miss in some)
        texts.append(
            f"{math.ceil(length_m)} m of lines take {'more' if is_high else 'less'} than the "
            f"nozzle sets deliver ({low:.2f} to {high:.2f} L/min): {worst.rate_l_ha:g} L/ha at "
            f"{worst.speed_m_s:g} m/s takes {worst.flow_l_min:.2f} L/min, sortie {number} near "
            f"{latitude_deg:.6f}, {longitude_deg:.6f}; {_fix(worst, settings, is_high=is_high)}"
        )
    return tuple(texts)


def _fix(worst: Miss, settings: Settings, *, is_high: bool) -> str:
    low, high = settings.flow_l_min or (0.0, math.inf)
    if is_high:
        return f"fit larger nozzles: below {settings.speeds_m_s[0]:g} m/s nothing is sprayed"
    speed = math.ceil(10.0 * worst.speed_m_s * low / worst.flow_l_min) / 10.0
    if worst.flow_l_min <= 0.0 or not math.isfinite(high):
        return "fit smaller nozzles"
    return f"allow {speed:g} m/s (--speed-max-m-s), or fit smaller nozzles"


# Sorties that fit into the autopilot's memory: one with too many items is flown as several.
#
# So is one whose fence has no room, where fences are looked at.


def in_room(
    sorties: Sequence[Sortie],
    ways: Ways,
    pace: Callable[[Sequence[Sortie]], Paced],
    items: Callable[[Sortie], int],
    *,
    room: int,
    fenced: Callable[[Sortie], bool] | None = None,
) -> Paced:
    """Return the sorties with their speeds; one with more items than room is cut between lines.

    Speeds and slopes add items: only what is paced can be counted. With `fenced`, which says
    whether there is a fence for one, those without are cut as long as they have two lines.

    Raises:
        PlanError: where one line alone has too many.
    """
    while True:
        found = pace(sorties)
        over = {each.number for each in found.sorties if items(each) > room}
        if fenced is not None:
            over |= {each.number for each in found.sorties if _joins(each) and not fenced(each)}
        if not over:
            return found
        parts = [
            part
            for each in sorties
            for part in (_halves(each, ways, room) if each.number in over else (each,))
        ]
        sorties = [replace(part, number=number) for number, part in enumerate(parts, start=1)]


def _halves(sortie: Sortie, ways: Ways, room: int) -> tuple[Sortie, Sortie]:
    legs = sortie.legs
    joins = _joins(sortie)
    if not joins:
        raise PlanError(
            f"a line of sortie {sortie.number} alone has more items than the {room} for which the "
            "autopilot has room; allow more height error (mission.terrain_tolerance_m)"
        )
    middle = min(joins, key=lambda number: abs(2 * number - len(legs) + 1))
    home = ways.home(sortie.depot, legs[middle].points[0])[::-1]
    out = ways.home(sortie.depot, legs[middle].points[-1])
    speed_m_s = legs[0].speed_m_s
    back = Leg(kind="ferry", points=tuple(home), speed_m_s=speed_m_s)
    again = Leg(kind="ferry", points=tuple(out), speed_m_s=speed_m_s)
    return (
        replace(sortie, legs=(*legs[:middle], back)),
        replace(sortie, legs=(again, *legs[middle + 1 :])),
    )


def _joins(sortie: Sortie) -> list[int]:
    """Return the numbers of the ways between lines."""
    inner = range(1, len(sortie.legs) - 1)
    return [number for number in inner if sortie.legs[number].kind != "spray"]


def room_warnings(found: Paced) -> tuple[str, ...]:
    """Return how many sorties were cut because there was no room for their fences."""
    if not found.unfenced:
        return ()
    return (
        f"{counted(found.unfenced, 'sortie')} would have a fence with more corners than the "
        f"autopilot has room for: they are flown as several, "
        f"{counted(len(found.sorties), 'sortie')} in place of {found.uncut}",
    )
