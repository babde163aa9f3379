"""The places of a sortie at which something changes, one after the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from companion.core.frame import LocalFrame
from companion.wording import counted
from missions.corners import Course, Ints, overlapping, parts_s
from missions.plan import Leg, Place, Settings, Sortie
from missions.strips import Floats

# Waypoints closer than this to the one before say nothing new: a border goes on in its next line.
SAME_M = 0.6
# Autopilots are to fly no leg shorter than this. The end of a line so near to its neighbour is no
# waypoint of its own where the way passes it within half of `SAME_M`.
NEAR_M = 2.0
# A place on the straight between its neighbours is no waypoint where it is this near to one of
# them: an autopilot that plans each leg from rest to rest slows down for every short one. The
# companion lets a leg end 30 m beyond its line, and no farther.
RUN_M, ASIDE_M = 25.0, 0.05


class Stop(NamedTuple):
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
                Stop(leg.points[-1], leg.speed_m_s, opens=False if ends else None, on_line=True)
            )
            continue
        stops += [Stop(place, leg.speed_m_s, height_m=leg.height_m) for place in leg.points[1:-1]]
    return stops if apart else _without_runs(stops)


def near_pairs(stops: Sequence[Stop], *, within_m: float = NEAR_M) -> list[tuple[Place, Place]]:
    """Return the waypoints that are too near to the one before, each with that one.

    The take-off is none. One above another is far enough from it: the way between is a climb.
    """
    return [
        (one.place, other.place)
        for one, other in pairwise(stops[1:])
        if math.dist(one.place, other.place) < within_m and one.height_m == other.height_m
    ]


def near_warnings(
    sorties: Sequence[Sortie], frame: LocalFrame, *, apart: bool = False
) -> tuple[str, ...]:
    """Return how many waypoints are too near to the one before all the same, and where."""
    pairs = [pair for each in sorties for pair in near_pairs(waypoints_of(each, apart=apart))]
    if not pairs:
        return ()
    nearest = min(pairs, key=lambda pair: math.dist(*pair))
    latitude_deg, longitude_deg = frame.to_geographic(*nearest[1])
    why = (
        "DO_SPRAYER needs one at both ends of each line; plan without --sprayer"
        if apart
        else "lines and free ground leave no room there; leave that nook out of the outline"
    )
    return (
        f"{counted(len(pairs), 'waypoint')} less than {NEAR_M:g} m from the one before, the "
        f"nearest {math.dist(*nearest):.1f} m near {latitude_deg:.6f}, {longitude_deg:.6f}: {why}",
    )


def _changed(before: Leg, leg: Leg) -> list[Stop]:
    """Return the end of one leg and above or below it the start of the next, but those of lines."""
    return [
        Stop(place=leg.points[0], speed_m_s=each.speed_m_s, height_m=each.height_m)
        for each in (before, leg)
        if each.kind != "spray"
    ]


def _without_runs(stops: list[Stop]) -> list[Stop]:
    kept, row, last = stops[:1], _Row(), stops[0]
    for here, after in pairwise(stops[1:]):
        if (
            after.speed_m_s == here.speed_m_s
            and last.height_m == here.height_m == after.height_m
            # Most places are corners: what is no run and not passed is known at once.
            and _is_beside(last.place, here.place, after.place, SAME_M / 2.0)
            and row.leaves_out(
                (last.place, here.place, after.place), opens=here.opens, on_line=here.on_line
            )
        ):
            continue
        kept.append(here)
        last = here
        if row.passed:
            row = _Row()
    return [*kept, *stops[1:][-1:]]


@dataclass(slots=True)
class _Row:
    """Places in a row that are no waypoints, and the first of them at which a line ends.

    Of those `passed` the `straight` ones lie straight on.
    """

    passed: list[Place] = field(default_factory=list)
    straight: list[Place] = field(default_factory=list)
    ended: Place | None = None

    def leaves_out(
        self, ends: tuple[Place, Place, Place], *, opens: bool | None, on_line: bool
    ) -> bool:
        """Leave the middle place out where the way between the others needs no waypoint there.

        It lies beside that way (`_is_beside`). A line whose leg begins or ends too far beyond it
        stays dry: of a gap one place stays.
        """
        before, here, after = ends
        ended = here if self.ended is None and opens is False else self.ended
        is_far = opens is True and math.dist(before, here) > RUN_M
        is_far |= ended is not None and math.dist(ended, after) > RUN_M
        is_straight = self.ended is None and is_run(*ends, self.passed, self.straight)
        if is_far or not (is_straight or (on_line and is_passed(*ends, self.passed))):
            return False
        self.passed.append(here)
        if is_straight:
            self.straight.append(here)
        self.ended = ended
        return True


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


def is_run(
    before: Place,
    here: Place,
    after: Place,
    passed: Sequence[Place] = (),
    straight: Sequence[Place] = (),
) -> bool:
    """Return whether a place between two others needs no waypoint: straight on, near to one.

    What was passed before keeps as near to the way: small bends of a long row would add up.

    >>> is_run((0.0, 0.0), (0.0, 7.2), (0.0, 90.0)), is_run((0.0, 0.0), (0.0, 80.0), (6.0, 80.0))
    (True, False)
    """
    near_m = min(math.dist(before, here), math.dist(here, after))
    return (
        near_m <= RUN_M
        and all(_is_beside(before, each, after, ASIDE_M) for each in (here, *straight))
        and all(_is_beside(before, each, after, SAME_M / 2.0) for each in passed)
    )


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
        stops[-1] = Stop(place=middle(last.place, place), speed_m_s=last.speed_m_s, on_line=True)
        return
    stops.append(Stop(place=place, speed_m_s=speed_m_s, opens=True, on_line=True))


def middle(one: Place, other: Place) -> Place:
    """Return the place halfway."""
    return (one[0] + other[0]) / 2.0, (one[1] + other[1]) / 2.0


# How long each leg of a sortie takes, as its autopilot flies it: one model for all figures.
#
# The way home after the last place is the return's: it begins and ends at rest.

# Places nearer than this are one.
TOUCH_M = 1e-3
SQUARE_DEG = 90.0


class _Stretch(NamedTuple):
    """A way between two waypoints; `legs` are (leg, metres) that it is of.

    One that leads `upright_m` up, or down, has both above each other.
    """

    start: Place
    end: Place
    speed_m_s: float
    legs: tuple[tuple[int, float], ...]
    upright_m: float = 0.0

    @property
    def length_m(self) -> float:
        return abs(self.upright_m) or math.dist(self.start, self.end)

    @property
    def course_deg(self) -> float:
        east_m, north_m = self.end[0] - self.start[0], self.end[1] - self.start[1]
        return math.degrees(math.atan2(east_m, north_m))


def timed(sorties: Sequence[Sortie], settings: Settings) -> tuple[Sortie, ...]:
    """Return the sorties with the seconds of each leg."""
    return tuple(_timed(sortie, settings) for sortie in sorties)


def _timed(sortie: Sortie, settings: Settings) -> Sortie:
    ways, motion = _ways(sortie, settings.height_m), settings.motion
    seconds = [0.0] * len(sortie.legs)
    sprays = [leg.kind == "spray" for leg in sortie.legs]
    for some in (_ways_without_runs(ways[:-1], sprays), ways[-1:]):
        found = parts_s(
            [way.length_m for way in some],
            [_bend_deg(before, after) for before, after in pairwise(some)],
            [_course(way, settings) for way in some],
            motion.corners,
        )
        for way, taken_s in zip(some, found, strict=True):
            whole_m = sum(length_m for _, length_m in way.legs)
            for leg, length_m in way.legs:
                seconds[leg] += taken_s * length_m / whole_m
    legs = (replace(leg, seconds=each) for leg, each in zip(sortie.legs, seconds, strict=True))
    return replace(sortie, legs=tuple(legs))


class Track(NamedTuple):
    """Places of a sortie at even times, the way that each is on, and what of it which leg is.

    `parts` are (way, leg, from_m, to_m), of the lines alone.
    """

    step_s: float
    places: Floats
    way: Ints
    parts: tuple[tuple[int, int, float, float], ...]
    ends: Floats


def track_of(sortie: Sortie, settings: Settings, step_s: float) -> Track:
    """Return how a sortie is flown: where two ways overlap in time, both move the aircraft."""
    sprays = [leg.kind == "spray" for leg in sortie.legs]
    ways = _ways_without_runs(_ways(sortie, settings.height_m)[:-1], sprays)
    bends_deg = [_bend_deg(before, after) for before, after in pairwise(ways)]
    legs, overlaps_s = overlapping(
        [way.length_m for way in ways], bends_deg, [_course(way, settings) for way in ways]
    )
    seconds = np.array([leg.seconds for leg in legs])
    start_s = np.cumsum([0.0, *(seconds[:-1] - overlaps_s)])
    # The next way is flown from the middle of what both have together.
    turns_s = np.array([*(start_s[1:] + np.array(overlaps_s) / 2.0), start_s[-1] + seconds[-1]])
    at_s = np.arange(0.0, turns_s[-1], step_s)
    way_of = np.searchsorted(turns_s, at_s, side="right")
    ends = np.array([(*way.start, *way.end) for way in ways])
    unit = (ends[:, 2:] - ends[:, :2]) / np.array([[way.length_m] for way in ways])
    places = ends[way_of, :2].copy()
    for number, leg in enumerate(legs):
        for other in (number - 1, number, number + 1):
            mine = slice(*np.searchsorted(way_of, [other, other + 1]))
            along_m = leg.way_m(at_s[mine] - start_s[number])
            # Of the way before, what is still missing to its end.
            along_m -= ways[number].length_m * (other > number)
            places[mine] += along_m[:, None] * unit[number]
    parts = []
    for number, way in enumerate(ways):
        to_m = np.cumsum([length_m for _, length_m in way.legs])
        parts += [
            (number, leg, float(end_m - length_m), float(end_m))
            for (leg, length_m), end_m in zip(way.legs, to_m, strict=True)
            if sprays[leg]
        ]
    return Track(step_s, places, way_of, tuple(parts), ends)


def _course(way: _Stretch, settings: Settings) -> Course:
    """Return how fast a way is flown, and how that speed is reached."""
    if not way.upright_m:
        return settings.motion.at(way.speed_m_s)
    vertical = settings.vertical
    return Course(
        speed_m_s=vertical.climb_m_s if way.upright_m > 0.0 else vertical.descent_m_s,
        acceleration_m_s2=vertical.acceleration_m_s2,
        jerk_m_s3=settings.motion.jerk_m_s3,
    )


def _bend_deg(before: _Stretch, after: _Stretch) -> float:
    if before.upright_m or after.upright_m:
        return SQUARE_DEG
    return (after.course_deg - before.course_deg + 180.0) % 360.0 - 180.0


def _ways(sortie: Sortie, lines_m: float) -> list[_Stretch]:
    """Return the straight ways of a sortie, one after the other, climbs and descents among them.

    What a ferry takes to climb and descend, at its two ends, is its own.
    """
    found = []
    here = sortie.legs[0].points[0]
    heights_m = [lines_m if leg.height_m is None else leg.height_m for leg in sortie.legs]
    for number, leg in enumerate(sortie.legs):
        rise_m = heights_m[number] - heights_m[max(number - 1, 0)]
        if rise_m:
            higher = number if rise_m > 0.0 else number - 1
            found.append(
                _Stretch(
                    start=here, end=here, speed_m_s=leg.speed_m_s,
                    legs=((higher, abs(rise_m)),), upright_m=rise_m,
                )
            )  # fmt: skip
        if _is_no_way(sortie, number):
            # The ends of both lines are one waypoint, in the middle: beside another place than
            # that it might be left out where it is written, or the other way round.
            here = middle(leg.points[0], leg.points[-1])
            if found:
                found[-1] = found[-1]._replace(end=here)
            continue
        # A line that begins at one waypoint with the last one has no way to it.
        is_met = number > 0 and _is_no_way(sortie, number - 1)
        for place in leg.points[1:] if is_met else leg.points:
            length_m = math.dist(here, place)
            if length_m > TOUCH_M:
                found.append(
                    _Stretch(
                        start=here, end=place, speed_m_s=leg.speed_m_s, legs=((number, length_m),),
                    )
                )  # fmt: skip
                here = place
    return found


def _is_no_way(sortie: Sortie, number: int) -> bool:
    """Whether a leg joins two lines whose ends are written as one waypoint."""
    leg = sortie.legs[number]
    if leg.kind == "spray" or len(leg.points) > 2 or leg.length_m >= SAME_M:
        return False
    around = (*sortie.legs[max(number - 1, 0) : number], *sortie.legs[number + 1 : number + 2])
    return [other.kind for other in around] == ["spray", "spray"]


def _ways_without_runs(ways: list[_Stretch], sprays: Sequence[bool]) -> list[_Stretch]:
    """Return the ways between waypoints: those that lead straight on are one.

    `sprays` says of which legs are lines.
    """
    kept, row = ways[:1], _Row()
    for way in ways[1:]:
        last = kept[-1]
        before, after = sprays[last.legs[-1][0]], sprays[way.legs[0][0]]
        level = not way.upright_m and not last.upright_m
        if (
            level
            and way.speed_m_s == last.speed_m_s
            and _is_beside(last.start, last.end, way.end, SAME_M / 2.0)
            and row.leaves_out(
                (last.start, last.end, way.end),
                opens=None if before == after else after,
                on_line=before or after,
            )
        ):
            kept[-1] = last._replace(end=way.end, legs=(*last.legs, *way.legs))
        else:
            kept.append(way)
            row = _Row()
    return kept
