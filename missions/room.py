"""Sorties that fit into the autopilot's memory: one with too many items is flown as several.

So is one whose fence has no room, where fences are looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from missions.errors import PlanError
from missions.paced import Paced
from missions.plan import Leg, Sortie
from missions.ways import Ways


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
