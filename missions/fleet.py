"""Several aircraft: each its own share of the field, side by side across the lines.

A share ends midway between two lines. The lines of a share that are nearer than the gap to the
next share, its seam, are sorties of their own, flown last: so only they have to wait for the
neighbour (see `schedule`). Every aircraft works its share in the same direction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from missions.demand import Demand
from missions.depots import DepotChoice
from missions.errors import PlanError
from missions.field import Field
from missions.free_space import free_space
from missions.paced import Paced
from missions.plan import Settings, Sortie
from missions.strips import Floats, axes, directions, lengths_m
from missions.ways import Ways, build_ways

# A line that is cut shorter than this stays whole, in the share of its middle.
PART_MIN_M = 2.0
# Lines this parallel to the course are passes; others run along the border.
PARALLEL = np.cos(np.radians(1.0))

One = Callable[[Floats, list[Demand], Ways], Paced]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fleet:
    """Sorties of all aircraft, and all depots."""

    paced: Paced
    depots: Floats


def fleet_sorties(
    field: Field,
    lines: Floats,
    demand: list[Demand],
    settings: Settings,
    *,
    angle_deg: float,
    depots: Floats,
    one: One,
) -> Fleet:
    """Return the sorties of all aircraft; `one` makes those of some lines.

    As many depots as aircraft are one for each, in their order across the field; any other number
    is for all of them; where none is given, the best for each share is taken.
    """
    across = axes(angle_deg)[1]
    borders = _borders(lines, demand, settings, across)
    seams = borders + settings.swath_width_m / 2.0 - settings.aircraft_gap_m
    lines, demand = _cut_at(lines, demand, np.sort(np.concatenate([borders, seams])), across)
    middle = (lines[:, :2] + lines[:, 2:]) / 2.0 @ across
    share = np.searchsorted(borders, middle)
    is_seam = np.append(seams, np.inf)[share] < middle
    places = _depots(field, lines, demand, share, depots, across, settings)
    all_places = np.unique(np.concatenate(places), axis=0) if not len(depots) else depots
    sorties: list[Sortie] = []
    misses = []
    unfenced = uncut = 0
    for aircraft in range(settings.aircraft):
        ways = build_ways(field, places[aircraft])
        for part in (False, True):
            some = np.flatnonzero((share == aircraft) & (is_seam == part))
            if not sum(demand[at].total_l for at in some) > 0.0:
                continue
            found = one(lines[some], [demand[at] for at in some], ways)
            order = sorted(found.sorties, key=lambda each: _across_m(each, across))
            numbers = {}
            for sortie in order:
                numbers[sortie.number] = len(sorties) + 1
                sorties.append(
                    replace(
                        sortie, number=len(sorties) + 1, aircraft=aircraft + 1,
                        depot=_index(all_places, places[aircraft][sortie.depot]),
                    )
                )  # fmt: skip
            misses += [(numbers[number], miss) for number, miss in found.misses]
            unfenced += found.unfenced
            uncut += found.uncut or len(found.sorties)
    paced = Paced(
        sorties=tuple(sorties), misses=tuple(misses), unfenced=unfenced, uncut=uncut
    )  # fmt: skip
    return Fleet(paced=paced, depots=all_places)


def _borders(lines: Floats, demand: list[Demand], settings: Settings, across: Floats) -> Floats:
    """Return where the shares end, across the lines: such that all take about as long."""
    count = settings.aircraft
    middle = (lines[:, :2] + lines[:, 2:]) / 2.0 @ across
    stop_s = 2.0 * settings.speed_m_s / settings.acceleration_m_s2
    litres = np.array([need.total_l for need in demand])
    work_s = lengths_m(lines) / settings.speed_m_s + stop_s
    work_s += litres / settings.usable_l * settings.refill_s
    work_s[litres <= 0.0] = 0.0
    is_pass = np.abs(directions(lines) @ across) < np.sqrt(1.0 - PARALLEL**2)
    places = np.sort(middle[is_pass])
    between = (places[1:] + places[:-1])[np.diff(places) > settings.swath_width_m / 10.0] / 2.0
    if len(between) < count - 1:
        raise PlanError(
            f"{count} aircraft need at least as many lines side by side, and there are "
            f"{len(between) + 1}; take fewer (mission.aircraft), or another mission.angle_deg"
        )
    order = np.argsort(middle)
    done = np.concatenate([[0.0], np.cumsum(work_s[order])]) / work_s.sum()
    reached = done[np.searchsorted(middle[order], between)]
    chosen: list[int] = []
    for number in range(1, count):
        first = chosen[-1] + 1 if chosen else 0
        last = len(between) - (count - 1 - number)
        best = int(np.argmin(np.abs(reached[first:last] - number / count)))
        chosen.append(first + best)
    found: Floats = between[chosen]
    return found


def _cut_at(
    lines: Floats, demand: list[Demand], cuts: Floats, across: Floats
) -> tuple[Floats, list[Demand]]:
    """Return the lines cut where they cross one of these places across the field."""
    rows, needs = [], []
    for row, need in zip(lines, demand, strict=True):
        start, end = float(row[:2] @ across), float(row[2:] @ across)
        length_m = float(need.at_m[-1])
        at_m = [0.0]
        if abs(end - start) > PART_MIN_M:
            crossed = sorted((cuts - start) / (end - start) * length_m)
            for place in crossed:
                if place - at_m[-1] >= PART_MIN_M and length_m - place >= PART_MIN_M:
                    at_m.append(float(place))
        at_m.append(length_m)
        for first, last in pairwise(at_m):
            part = need.part(first, last)
            needs.append(Demand(at_m=part.at_m - part.at_m[0], litres=part.litres))
            points = row[:2] + np.outer([first, last], (row[2:] - row[:2]) / length_m)
            rows.append(points.ravel())
    return np.array(rows), needs


def _depots(
    field: Field,
    lines: Floats,
    demand: list[Demand],
    share: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    depots: Floats,
    across: Floats,
    settings: Settings,
) -> list[Floats]:
    """Return the depots of each aircraft."""
    count = settings.aircraft
    if len(depots) == count:
        order = np.argsort(depots @ across, kind="stable")
        return [depots[[at]] for at in order]
    if len(depots):
        return [depots] * count
    found = []
    inside = free_space(field.fly)
    for aircraft in range(count):
        some = np.flatnonzero(share == aircraft)
        litres = np.array([demand[at].total_l for at in some])
        choice = DepotChoice(
            field=field, lines=lines[some], litres=litres, inside=inside, settings=settings
        )
        found.append(choice.ways().depots)
    return found


def _across_m(sortie: Sortie, across: Floats) -> float:
    points = np.array([leg.points[0] for leg in sortie.legs if leg.kind == "spray"])
    return float((points @ across).mean())


def _index(places: Floats, place: Sequence[float] | Floats) -> int:
    return int(np.argmin(np.hypot(*(places - np.asarray(place)).T)))
