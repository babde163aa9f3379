"""The places of a sortie at which something changes, one after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from missions.plan import Leg, Place, Sortie

# Waypoints closer than this to the one before say nothing new: a border goes on in its next line.
SAME_M = 0.6
# Autopilots are to fly no leg shorter than this. The end of a line so near to its neighbour is no
# waypoint of its own where the way passes it within half of `SAME_M`.
NEAR_M = 2.0
# A place on the straight between its neighbours is no waypoint where it is this near to one of
# them: an autopilot that plans each leg from rest to rest slows down for every short one. The
# companion lets a leg end 30 m beyond its line, and no farther.
RUN_M, ASIDE_M = 25.0, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """A place of the way, the speed of the way to it, and whether a line begins or ends there.

    `height_m` is above home, or the ground that is followed; None leaves it to that of the lines.
    `on_line` is a place at which a line ends, where it goes on in the next one as well.
    """

    place: Place
    speed_m_s: float
    opens: bool | None = None
    height_m: float | None = None
    on_line: bool = False


def waypoints_of(sortie: Sortie, *, apart: bool = False) -> list[Stop]:
    """Return the places of a sortie from the depot on.

    Where one line goes on in the next, their ends are one place in the middle, unless `apart`;
    where the speed changes inside a line, there is a place and nothing closes.
    Where the height changes, there are two places above each other.
    The way back to the depot is left to the return, but for its bends. What is straight on, a run
    into a line or a short gap, is one way with its line, unless `apart`.
    """
    legs = sortie.legs
    stops = [Stop(place=legs[0].points[0], speed_m_s=legs[0].speed_m_s, height_m=legs[0].height_m)]
    for number, leg in enumerate(legs):
        before = legs[number - 1] if number else leg
        if leg.height_m != before.height_m:
            stops += _changed(before, leg)
        if leg.kind == "spray":
            goes_on = legs[number - 1].kind == "spray"
            ends = number + 1 == len(legs) or legs[number + 1].kind != "spray"
            if not goes_on:
                _add(stops, leg.points[0], legs[number - 1].speed_m_s, apart=apart)
            stops.append(
                Stop(
                    place=leg.points[-1], speed_m_s=leg.speed_m_s,
                    opens=False if ends else None, on_line=True,
                )
            )  # fmt: skip
            continue
        stops += [
            Stop(place=place, speed_m_s=leg.speed_m_s, height_m=leg.height_m)
            for place in leg.points[1:-1]
        ]
    return stops if apart else _without_runs(stops)


def near_pairs(stops: Sequence[Stop]) -> list[tuple[Place, Place]]:
    """Return the waypoints that are too near to the one before, each with that one.

    The take-off is none. One above another is far enough from it: the way between is a climb.
    """
    return [
        (one.place, other.place)
        for one, other in pairwise(stops[1:])
        if math.dist(one.place, other.place) < NEAR_M and one.height_m == other.height_m
    ]


def _changed(before: Leg, leg: Leg) -> list[Stop]:
    """Return the end of one leg and above or below it the start of the next, but those of lines."""
    return [
        Stop(place=leg.points[0], speed_m_s=each.speed_m_s, height_m=each.height_m)
        for each in (before, leg)
        if each.kind != "spray"
    ]


def _without_runs(stops: list[Stop]) -> list[Stop]:
    kept, passed = stops[:1], list[Place]()
    for here, after in zip(stops[1:], [*stops[2:], None], strict=True):
        goes_on = (
            after is not None
            and after.speed_m_s == here.speed_m_s
            and kept[-1].height_m == here.height_m == after.height_m
        )
        if after is not None and goes_on:
            ends = (kept[-1].place, here.place, after.place)
            if is_run(*ends) or (here.on_line and is_passed(*ends, passed)):
                passed.append(here.place)
                continue
        kept.append(here)
        passed = []
    return kept


def is_passed(before: Place, here: Place, after: Place, passed: Sequence[Place] = ()) -> bool:
    """Return whether the end of a line that is too near to another place needs no waypoint.

    The way passes it, and those between that have none already, a little aside. No more of them
    are left out than that needs.

    >>> is_passed((0.0, 0.0), (0.1, 8.0), (0.0, 9.2)), is_passed((0.0, 0.0), (1.0, 8.0), (0.0, 9.2))
    (True, False)
    """
    last = passed[-1] if passed else before
    near = math.dist(before, here) < NEAR_M
    near = near or math.dist(here, after) < NEAR_M <= math.dist(last, here)
    return near and all(_is_beside(before, each, after, SAME_M / 2.0) for each in (here, *passed))


def is_run(before: Place, here: Place, after: Place) -> bool:
    """Return whether a place between two others needs no waypoint: straight on, near to one.

    >>> is_run((0.0, 0.0), (0.0, 7.2), (0.0, 90.0)), is_run((0.0, 0.0), (0.0, 80.0), (6.0, 80.0))
    (True, False)
    """
    near_m = min(math.dist(before, here), math.dist(here, after))
    return near_m <= RUN_M and _is_beside(before, here, after, ASIDE_M)


def _is_beside(before: Place, here: Place, after: Place, aside_m: float) -> bool:
    """Return whether the straight way between two places passes another one so near."""
    far_m = math.dist(before, after)
    if far_m == 0.0:
        return False
    east, north = (after[0] - before[0]) / far_m, (after[1] - before[1]) / far_m
    off_east, off_north = here[0] - before[0], here[1] - before[1]
    along_m = off_east * east + off_north * north
    return 0.0 < along_m < far_m and abs(off_east * north - off_north * east) < aside_m


def _add(stops: list[Stop], place: Place, speed_m_s: float, *, apart: bool) -> None:
    """Add the start of a line; one that the last line goes on in is already there."""
    last = stops[-1]
    if last.opens is False and math.dist(last.place, place) < SAME_M and not apart:
        middle = ((last.place[0] + place[0]) / 2.0, (last.place[1] + place[1]) / 2.0)
        stops[-1] = Stop(place=middle, speed_m_s=last.speed_m_s, on_line=True)
        return
    stops.append(Stop(place=place, speed_m_s=speed_m_s, opens=True, on_line=True))
