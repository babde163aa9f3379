"""Ways between lines whose waypoints are far enough apart for an autopilot to fly each.

Lines end where they end. Where a waypoint would come too near to the one before, the way begins
farther along the line and ends in the direction of the next one, its corners move outwards or are
left out, as long as it stays on free ground. What is straight on from a line is one way with it
(`missions.stops`), so that such a way has no waypoint where its line ends.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import islice, pairwise, product

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from missions.plan import Leg, Place, Settings, Sortie, is_high
from missions.stops import NEAR_M, SAME_M, is_passed, middle, near_pairs, waypoints_of
from missions.strips import Floats
from missions.ways import Ways

Pair = tuple[Place, Place]
NOWHERE = frozenset[int]()

# A little more than the least distance: places are rounded when they are written, by 8 mm each.
APART_M = NEAR_M + 0.016
# So far a way may go on straight from one line, or straight into the next.
BEYOND_M = (0.0, 0.5, 1.0, 1.5, 2.02, 2.5, 3.0, 4.0)
# Room is used but for so much, and where that is more than other tries by so much.
ROOM_M = 0.01
# Where both lines meet farther beyond their ends than this, no waypoint is put there.
MEET_MAX_M = 8.0
# Corners are tried so far outwards, and along the ways beside them.
OUT_M, ALONG_M = (1.0, 2.02, 3.0), (1.0, 2.02)
RING = 12
# Corners farther than this from the next waypoint stay; so many are left out in a row.
CROWDED_M, SKIPPED_MAX = 4.0, 3
# A waypoint more is worth so much way, and one that is too near more than any detour tried here.
WAYPOINT_M, TOO_NEAR_M = 6.0, 1000.0
# So many pairs too near are looked at, with so many legs around, and at first so many ways each.
PAIRS_MAX, AROUND, TRIED_MAX, TOUCH_M = 20, 6, 8, 1e-6
STRAIGHT = 1.0 - 1e-6  # the cosine of what is straight on


@dataclass(frozen=True, slots=True, kw_only=True)
class _Option:
    """A way between two lines; `first` and `last` are its waypoints next to them."""

    points: tuple[Place, ...]
    first: Place
    last: Place
    cost_m: float
    near: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class _End:
    """The end of a line, or home, and the direction in which a way may go on from it.

    `least_m` is how far it goes on at least; `keeps` says that the end stays a waypoint then.
    """

    at: Place
    along: Place | None = None
    least_m: float = 0.0
    keeps: bool = True
    is_home: bool = False

    def beyond(self, far_m: float) -> Place:
        """Return the place so far beyond the end."""
        if self.along is None or not far_m:
            return self.at
        return self.at[0] + self.along[0] * far_m, self.at[1] + self.along[1] * far_m

    def tried_m(self, inside: BaseGeometry) -> list[float]:
        """Return how far a way may go on from here inside the field."""
        if self.along is None:
            return [0.0]
        longer = [far_m for far_m in BEYOND_M if far_m > self.least_m]
        free = _are_free(inside, [(self.at, self.beyond(far_m)) for far_m in longer])
        found = [far_m for far_m, is_free in zip(longer, free, strict=True) if is_free]
        room_m = self.least_m if all(free) else self._room_m(inside)
        if room_m > (found[-1] if found else self.least_m) + ROOM_M:
            found.append(room_m)
        return [self.least_m, *found]

    def _room_m(self, inside: BaseGeometry) -> float:
        """Return how far the ground beyond the end is free, but for a little."""
        ray = shapely.LineString([self.at, self.beyond(BEYOND_M[-1])])
        parts = shapely.get_parts(shapely.intersection(ray, inside))
        near = parts[shapely.distance(parts, shapely.Point(self.at)) < ROOM_M]
        return float(shapely.length(near).max(initial=0.0)) - ROOM_M


@dataclass(frozen=True, slots=True, kw_only=True)
class _Free:
    """Where a way may go on straight from a line, and where its corners may lie."""

    inside: BaseGeometry
    corners: BaseGeometry


@dataclass(frozen=True, slots=True, kw_only=True)
class _Crowded:
    """Ways at which waypoints stay too near, by what is tried there.

    In `passed` no end of a line is passed aside, in `straight` none lies straight on, and in `few`
    corners may be anywhere, though there are ways without, and a line is left before the next one
    that goes on from it.
    """

    passed: frozenset[int] = frozenset()
    straight: frozenset[int] = frozenset()
    few: frozenset[int] = frozenset()

    def with_more(self, ways: frozenset[int]) -> tuple[_Crowded, ...]:
        """Return what may be tried at more ways, one after the other."""
        passed, straight = self.passed | ways, self.straight | ways
        return (
            replace(self, passed=passed),
            replace(self, straight=straight),
            replace(self, passed=passed, straight=straight),
            replace(self, few=self.few | ways),
        )


@dataclass(frozen=True, kw_only=True)
class Spacing:
    """Keeps waypoints apart; `apart`, lines have waypoints at both ends whatever comes.

    What was found for a way between two lines, or for a sortie, is known when it comes again.
    """

    ways: Ways
    settings: Settings
    apart: bool = False
    _known: dict[tuple[object, ...], list[_Option]] = field(
        default_factory=dict, repr=False, compare=False
    )
    _known_legs: dict[tuple[Leg, ...], tuple[Leg, ...]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def spaced(self, sorties: Sequence[Sortie]) -> tuple[Sortie, ...]:
        """Return the sorties with their ways between lines so that waypoints are far apart."""
        for each in sorties:
            if each.legs not in self._known_legs:
                self._known_legs[each.legs] = self._spaced(each).legs
        return tuple(replace(each, legs=self._known_legs[each.legs]) for each in sorties)

    def _spaced(self, sortie: Sortie) -> Sortie:
        known = _Crowded()
        best, near = self._mended(sortie, known)
        for pair in near[:PAIRS_MAX]:
            # What is thought of the ends of short lines in a row, that they are passed or straight
            # on, need not come so: once more as if not. Then with corners anywhere.
            for crowded in known.with_more(_at(best.legs, pair)):
                again, left = self._mended(sortie, crowded)
                if len(left) < len(near):
                    best, near, known = again, left, crowded
                    break
        return best

    def _mended(self, sortie: Sortie, crowded: _Crowded) -> tuple[Sortie, list[Pair]]:
        """Return the sortie spaced, ways changed one by one where pairs stay near, and the rest."""
        best = replace(sortie, legs=self._legs(sortie.legs, crowded))
        near, tried = self._near(best), set[Pair]()
        # One that is mended may leave another one beside it.
        while len(tried) < PAIRS_MAX and (new := [pair for pair in near if pair not in tried]):
            tried.add(new[0])
            legs = self._with_another_way(sortie.legs, best.legs, new[0])
            if legs is best.legs:
                continue
            left = self._near(again := replace(best, legs=legs))
            if len(left) < len(near):
                best, near = again, left
        return best, near

    def _near(self, sortie: Sortie) -> list[Pair]:
        """Return the waypoints that are too near to the one before, or will be once rounded."""
        return near_pairs(waypoints_of(sortie, apart=self.apart), within_m=APART_M)

    def _with_another_way(
        self, given: tuple[Leg, ...], legs: tuple[Leg, ...], pair: Pair
    ) -> tuple[Leg, ...]:
        """Return legs with another way, such that a pair is no longer too near; else as they are.

        Each is looked at as it will be written, whatever was thought of the ways one by one: which
        ends are passed in a row of short lines depends on more than the ways beside them.
        """
        at = _at(legs, pair)
        ways = [
            number
            for number in range(max(min(at, default=0) - 2, 0), max(at, default=-1) + 3)
            if number < len(legs) and legs[number].kind != "spray"
        ]
        # Enough around them that what is passed there is as in the whole sortie.
        first, last = max(min(ways, default=0) - AROUND, 0), max(ways, default=0) + AROUND
        first -= first > 0 and legs[first].kind == "spray"

        @cache  # the kinds of ways below share most of them
        def near(number: int, leg: Leg) -> int:
            shown = (*legs[first:number], leg, *legs[number + 1 : last + 1])
            return len(self._near(Sortie(number=1, depot=0, legs=shown)))

        now = near(first, legs[first])
        for is_straight, are_few in product((False, True), repeat=2):
            found = []
            for number in ways:
                here = frozenset({number})
                kind = _Crowded(
                    straight=here if is_straight else NOWHERE, few=here if are_few else NOWHERE
                )
                most = None if is_straight and are_few else TRIED_MAX
                changed = self._changes(given[number], self._others(given, number, kind)[:most])
                better = (leg for leg in changed if near(number, leg) < now)
                found += [
                    (leg.length_m - legs[number].length_m, number, leg) for leg in islice(better, 1)
                ]
            if found:
                _, number, leg = min(found, key=lambda each: each[:2])
                return (*legs[:number], leg, *legs[number + 1 :])
        return legs

    @staticmethod
    def _changes(given: Leg, options: Sequence[_Option]) -> Iterator[Leg]:
        """Yield a way as it was given, and with each of the options, the best first."""
        yield given
        for option in options:
            if option.points != given.points:
                yield replace(given, points=option.points, through=False)

    def _legs(self, legs: tuple[Leg, ...], crowded: _Crowded) -> tuple[Leg, ...]:
        joins = [number for number, leg in enumerate(legs) if leg.kind != "spray"]
        plain = [self._plain(legs, number, crowded) for number in joins]
        # Places at which the speed changes inside a line.
        inner = [
            tuple(leg.points[-1] for leg in legs[one + 1 : other - 1])
            for one, other in pairwise(joins)
        ]
        short = [
            _near(option.last, places, following.first) > 0
            for (option, following), places in zip(pairwise(plain), inner, strict=True)
        ]
        options = []
        for at, number in enumerate(joins):
            coupled = any(short[max(at - 1, 0) : at + 1])
            some = [plain[at]]
            if coupled or plain[at].near:
                found = self._others(legs, number, crowded)
                some += found if coupled else found[:1]
            options.append(some)
        if all(len(some) == 1 for some in options):
            return legs
        chosen = _cheapest(options, inner)
        found_legs = list(legs)
        for number, option in zip(joins, chosen, strict=True):
            through = legs[number].through and option.points == legs[number].points
            found_legs[number] = replace(legs[number], points=option.points, through=through)
        return tuple(found_legs)

    def _plain(self, legs: Sequence[Leg], number: int, crowded: _Crowded) -> _Option:
        """Return a way as it is."""
        leg = legs[number]
        before, after = _beside(legs, number)
        if before is not None and after is not None and len(leg.points) == 2 and not self.apart:
            known = _as_one(before, leg, after, keeps=number in crowded.passed)
            if known is not None:
                return known
        ends = self._ends(legs, number, keeps=number in crowded.straight)
        inner = leg.points[1 + bool(ends[0].least_m) : len(leg.points) - 1 - bool(ends[1].least_m)]
        return _option(ends, (ends[0].least_m, ends[1].least_m), inner)

    def _ends(self, legs: Sequence[Leg], number: int, *, keeps: bool) -> tuple[_End, _End]:
        """Return where a way begins and ends."""
        leg = legs[number]
        high = self.settings.ferry_height_m is not None and is_high(leg)
        ways = (leg.points, leg.points[::-1])
        found = []
        for line, points, sign in zip(_beside(legs, number), ways, (1.0, -1.0), strict=True):
            if line is None or high:
                found.append(_End(at=points[0], is_home=line is None))
                continue
            east, north = np.subtract(line.points[-1], line.points[0]) * sign / line.length_m
            along = (float(east), float(north))
            stays = keeps or self.apart or line.speed_m_s != leg.speed_m_s
            found.append(
                _End(at=points[0], along=along, least_m=_run_m(points, along), keeps=stays)
            )
        return found[0], found[1]

    def _others(self, legs: Sequence[Leg], number: int, crowded: _Crowded) -> list[_Option]:
        """Return other ways for one, the best first."""
        leg = legs[number]
        if leg.through and number not in crowded.few:
            return []
        before, after = _beside(legs, number)
        keeps, anywhere = number in crowded.straight, number in crowded.few
        key = (keeps, anywhere, before and before.points, before and before.speed_m_s, leg,
               after and after.points, after and after.speed_m_s)  # fmt: skip
        if key not in self._known:
            ends, free = self._ends(legs, number, keeps=keeps), self._free(leg)
            inner = leg.points[
                1 + bool(ends[0].least_m) : len(leg.points) - 1 - bool(ends[1].least_m)
            ]
            found = [*_meeting(ends, free.inside), *_around(ends, inner, free)]
            if anywhere or all(each.near for each in found):
                found += _around(ends, inner, free, anywhere=True)
            self._known[key] = sorted(found, key=lambda each: (each.near, each.cost_m))
        return self._known[key]

    def _free(self, leg: Leg) -> _Free:
        """Return the ground that a way may use: the field's, unless it leaves the field."""
        inside = self.ways.inside.space
        if leg.kind != "ferry" or shapely.covers(inside, shapely.LineString(leg.points)):
            return _Free(inside=inside, corners=inside)
        return _Free(inside=inside, corners=self._outside)

    @cached_property
    def _outside(self) -> BaseGeometry:
        space = (self.ways.high or self.ways).around.space
        shapely.prepare(space)
        return space


def _beside(legs: Sequence[Leg], number: int) -> tuple[Leg | None, Leg | None]:
    """Return the lines before and after a way."""
    before = legs[number - 1] if number else None
    after = legs[number + 1] if number + 1 < len(legs) else None
    return (
        before if before is not None and before.kind == "spray" else None,
        after if after is not None and after.kind == "spray" else None,
    )


def _as_one(before: Leg, leg: Leg, after: Leg, *, keeps: bool) -> _Option | None:
    """Return a way whose ends are one waypoint, or none; None for one that has two."""
    end, start = leg.points
    far_m = math.dist(end, start)
    one, other = before.points[0], after.points[-1]
    at: Place | None = None
    if far_m < SAME_M:
        at = middle(end, start)
        both_are_short = max(math.dist(one, at), math.dist(at, other)) < NEAR_M
        if is_passed(one, at, other) and not both_are_short and not keeps:
            at = None
    elif not leg.through:
        if keeps:
            return None
        at = start if is_passed(one, end, start) else end
        if at == end and not is_passed(end, start, other):
            return None
    if at is None:
        return _Option(points=leg.points, first=other, last=one, cost_m=far_m)
    return _Option(points=leg.points, first=at, last=at, cost_m=far_m + WAYPOINT_M)


def _run_m(points: Sequence[Place], along: Place) -> float:
    """Return how far a way that bends later goes on straight from its line."""
    if len(points) < 3:
        return 0.0
    east_m, north_m = points[1][0] - points[0][0], points[1][1] - points[0][1]
    far_m = math.hypot(east_m, north_m)
    return far_m if east_m * along[0] + north_m * along[1] > STRAIGHT * far_m > 0.0 else 0.0


def _at(legs: Sequence[Leg], pair: Pair) -> frozenset[int]:
    """Return the ways between lines that have waypoints at one of two places."""
    return frozenset(
        number
        for number, leg in enumerate(legs)
        if leg.kind != "spray"
        for one in (*leg.points, middle(leg.points[0], leg.points[-1]))
        for place in pair
        if abs(one[0] - place[0]) < TOUCH_M and math.dist(one, place) < TOUCH_M
    )


def _near(first: Place, inner: Sequence[Place], last: Place) -> int:
    """Return how many places are too near to the one before."""
    return sum(math.dist(a, b) < NEAR_M for a, b in pairwise((first, *inner, last)))


def _are_free(space: BaseGeometry, ways: Sequence[tuple[Place, Place]]) -> list[bool]:
    """Return of each straight way whether it is free; the border lies a little outside."""
    if not ways:
        return []
    lines = shapely.linestrings(np.array(ways))
    found: list[bool] = np.asarray(shapely.contains_properly(space, lines)).tolist()
    return found


def _option(
    ends: tuple[_End, _End], beyond_m: tuple[float, float], corners: Sequence[Place]
) -> _Option:
    """Return the way that goes on so far from both lines, and its cost."""
    begin = [ends[0].at, ends[0].beyond(beyond_m[0])][: 1 + bool(beyond_m[0])]
    end = [ends[1].beyond(beyond_m[1]), ends[1].at][not beyond_m[1] :]
    points = (*begin, *corners, *(end[1:] if begin[-1] == end[0] else end))
    # The end of a line that is straight on is no waypoint, nor is home.
    first = int(bool(beyond_m[0]) and not ends[0].keeps)
    last = len(points) - int(bool(beyond_m[1]) and not ends[1].keeps)
    parts_m = list(map(math.dist, points, points[1:]))
    flown_m = parts_m[first + ends[0].is_home : max(last - ends[1].is_home - 1, 0)]
    near = sum(part_m < NEAR_M for part_m in flown_m)
    length_m = sum(parts_m)
    return _Option(
        points=points, first=points[first], last=points[last - 1],
        cost_m=length_m + WAYPOINT_M * (last - first), near=near,
    )  # fmt: skip


def _meeting(ends: tuple[_End, _End], inside: BaseGeometry) -> list[_Option]:
    """Return the way over the place where both lines, longer, meet."""
    one, other = ends
    if one.along is None or other.along is None:
        return []
    (ux, uy), (vx, vy) = one.along, other.along
    x, y = other.at[0] - one.at[0], other.at[1] - one.at[1]
    sine = ux * vy - uy * vx
    if abs(sine) < 1e-6:
        return []
    beyond_m = ((x * vy - y * vx) / sine, (x * uy - y * ux) / sine)
    lengths = zip(beyond_m, ends, strict=True)
    if not all(max(end.least_m, 1e-3) <= far_m <= MEET_MAX_M for far_m, end in lengths):
        return []
    place = one.beyond(beyond_m[0])
    if not all(_are_free(inside, [(one.at, place), (place, other.at)])):
        return []
    # To the last digit the same place for both.
    met = replace(
        other,
        along=((place[0] - other.at[0]) / beyond_m[1], (place[1] - other.at[1]) / beyond_m[1]),
    )
    found = _option((one, met), beyond_m, ())
    return [found]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Nodes:
    """Places that a way may lead over, by rank: 0 where it begins, the last where it ends."""

    places: Floats
    ranks: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    beyond_m: tuple[float, ...]


def _around(
    ends: tuple[_End, _End], corners: Sequence[Place], free: _Free, *, anywhere: bool = False
) -> list[_Option]:
    """Return ways over corners as they are or moved, one for each pair of begin and end.

    They are moved outwards, or `anywhere`; a way without corners then has one.
    """
    nodes = _nodes(ends, corners, free.inside, anywhere=anywhere)
    steps_m = _steps_m(nodes, (ends[0].is_home, ends[1].is_home), free.corners)
    count = int((nodes.ranks == 0).sum())
    goals = np.flatnonzero(nodes.ranks == nodes.ranks[-1]).tolist()
    # From each of the places where it begins, which come first.
    starts = np.arange(count)
    cost_m = np.full((count, len(nodes.ranks)), math.inf)
    cost_m[starts, starts] = 0.0
    before = np.zeros(cost_m.shape, dtype=np.int64)
    for node in range(count, len(nodes.ranks)):
        over = cost_m + steps_m[:, node]
        before[:, node] = over.argmin(axis=1)
        cost_m[:, node] = over.min(axis=1)
    found = []
    for start, (costs_m, chosen) in enumerate(zip(cost_m.tolist(), before.tolist(), strict=True)):
        for goal in goals:
            if not math.isfinite(costs_m[goal]):
                continue
            chain = [goal]
            while chain[-1] != start:
                chain.append(chosen[chain[-1]])
            places = [_place(nodes.places[each]) for each in chain[-2:0:-1]]
            found.append(_option(ends, (nodes.beyond_m[start], nodes.beyond_m[goal]), places))
    return found


def _place(point: Floats) -> Place:
    return float(point[0]), float(point[1])


def _nodes(
    ends: tuple[_End, _End], corners: Sequence[Place], inside: BaseGeometry, *, anywhere: bool
) -> _Nodes:
    one, other = ends
    way = (one.beyond(one.least_m), *corners, other.beyond(other.least_m))
    if anywhere:
        moved = [_ring(corner) for corner in corners] or [[*_ring(one.at), *_ring(other.at)]]
    else:
        moved = [_moved(*some) for some in zip(way[:-2], way[1:-1], way[2:], strict=True)]
    first, last = one.tried_m(inside), other.tried_m(inside)
    groups = [[one.beyond(each) for each in first], *moved, [other.beyond(each) for each in last]]
    between = sum(len(some) for some in moved)
    return _Nodes(
        places=np.array([place for some in groups for place in some]),
        ranks=np.repeat(np.arange(len(groups)), [len(some) for some in groups]),
        beyond_m=(*first, *[0.0] * between, *last),
    )


def _ring(center: Place) -> list[Place]:
    """Return a place and others all around it."""
    return [
        center,
        *(
            (center[0] + far_m * math.cos(turn), center[1] + far_m * math.sin(turn))
            for far_m in OUT_M
            for turn in (math.tau * step / RING for step in range(RING))
        ),
    ]


def _moved(before: Place, corner: Place, after: Place) -> list[Place]:
    """Return a corner, and where it has another one near by, places that it may move to."""
    back, on = np.subtract(before, corner), np.subtract(after, corner)
    back_m, on_m = float(np.hypot(*back)), float(np.hypot(*on))
    if min(back_m, on_m) > CROWDED_M or min(back_m, on_m) < 1e-6:
        return [corner]
    back, on = back / back_m, on / on_m
    out = -(back + on)
    wide = float(np.hypot(*out))
    out = out / wide if wide > 1e-3 else np.array([-on[1], on[0]])
    steps = [far_m * out for far_m in OUT_M]
    steps += [far_m * along for far_m in ALONG_M for along in (back, on)]
    return [corner, *(_place(np.add(corner, step)) for step in steps)]


def _steps_m(nodes: _Nodes, homes: tuple[bool, bool], space: BaseGeometry) -> Floats:
    """Return what a step from one place to another one costs, infinite where there is none."""
    ranks, places = nodes.ranks, nodes.places
    ahead = ranks[None, :] - ranks[:, None]
    rows, columns = np.nonzero((ahead > 0) & (ahead <= SKIPPED_MAX))
    far_m = np.hypot(*(places[rows] - places[columns]).T)
    at_home = (homes[0] & (ranks[rows] == 0)) | (homes[1] & (ranks[columns] == ranks[-1]))
    far_m += WAYPOINT_M + np.where((far_m < APART_M) & ~at_home, TOO_NEAR_M, 0.0)
    free = shapely.contains_properly(
        space, shapely.linestrings(np.stack([places[rows], places[columns]], axis=1))
    )
    found = np.full((len(ranks), len(ranks)), math.inf)
    found[rows[free], columns[free]] = far_m[free]
    return found


def _cheapest(
    options: Sequence[Sequence[_Option]], inner: Sequence[Sequence[Place]]
) -> list[_Option]:
    """Return one option for each way, so that they are the best of all in a row."""
    cost_m = np.array([_cost_m(each) for each in options[0]])
    before = []
    for some, following, places in zip(options[:-1], options[1:], inner, strict=True):
        if len(some) == len(following) == 1:
            near = _near(some[0].last, places, following[0].first)
            cost_m = cost_m + TOO_NEAR_M * near + _cost_m(following[0])
            before.append(ONLY)
            continue
        ends = np.array([one.last for one in some])
        over = cost_m[:, None] + TOO_NEAR_M * _all_near(ends, places, following)
        before.append(over.argmin(axis=0))
        cost_m = over.min(axis=0) + np.array([_cost_m(each) for each in following])
    chain = [int(cost_m.argmin())]
    for step in reversed(before):
        chain.append(int(step[chain[-1]]))
    return [some[at] for some, at in zip(options, reversed(chain), strict=True)]


# The option before, where there is one alone.
ONLY = np.zeros(1, dtype=np.int64)


def _all_near(ends: Floats, inner: Sequence[Place], following: Sequence[_Option]) -> Floats:
    """Return `_near` from each end to the first place of each option."""
    starts = np.array([other.first for other in following])
    if not inner:
        return _are_near(ends, starts)
    between = _near(inner[0], inner[1:-1], inner[-1]) if len(inner) > 1 else 0
    found: Floats = (
        _are_near(ends, np.array(inner[:1])) + _are_near(np.array(inner[-1:]), starts) + between
    )
    return found


def _are_near(ones: Floats, others: Floats) -> Floats:
    far_m = np.hypot(*(ones[:, None, :] - others[None, :, :]).transpose(2, 0, 1))
    return np.where(far_m < NEAR_M, 1.0, 0.0)


def _cost_m(option: _Option) -> float:
    return option.cost_m + TOO_NEAR_M * option.near
