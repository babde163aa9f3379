"""What lines are worth: without those, and those ends, that bring next to nothing.

A short line beside a hole may take ten times as long as the ground that it alone covers takes
elsewhere. A plan may leave out a little; where that saves most, is decided here, last of all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from missions.boom import SLACK_M, Boom
from missions.corners import Motion
from missions.demand import Pieces
from missions.free_space import FreeSpace
from missions.network import JOIN_M, Ints, Network, build_network, soft_bend_deg
from missions.paced import Paced
from missions.plan import Leg
from missions.plan import Sortie as FlownSortie
from missions.stops import NEAR_M, near_pairs, waypoints_of
from missions.strips import (
    LINE_MIN_M,
    Bools,
    Floats,
    Objects,
    directions,
    lengths_m,
    rectangles,
    whole,
)
from missions.tour import Ring, Sortie, by_savings, cost_s, one_chain, shortest_tour
from missions.ways import Ways

# A plan covers 99.9 % of what a strip can reach; all that is left out together stays below this.
LEFT_SHARE = 0.00085
# A line stays if the ground that it alone covers is sprayed elsewhere in a tenth of its time.
WORTH = 0.1
# So many lines are tried, those that bring least.
TRIED_MAX = 16
# Ground beside a strip that is nothing but rounding, and a part of a line not worth cutting off.
CRUMB_M2, LEAST_M = 0.02, 0.5
# What ways that go on from a line keep from walls, and rounding.
MARGINS_M, SAME_M = 0.03, 1e-3


def worthwhile(
    tour: Tour, target: BaseGeometry, boom: Boom, *, left_share: float = LEFT_SHARE,
    worth: float = WORTH,
) -> Floats:  # fmt: skip
    """Return the lines of a tour that are worth their time, without the ends that others cover."""
    lines, motion = tour.lines, tour.motion
    if len(lines) < 2:
        return lines
    ground = _Ground(lines, target, boom)
    spare_m2 = left_share * target.area - target.difference(boom.united(lines)).area
    alone_m2 = np.array([ground.alone_m2(at, up_to_m2=spare_m2) for at in range(len(lines))])
    pays_m2_s = worth * motion.speed_m_s * boom.width_m
    taken_s = motion.legs_s(lengths_m(lines))
    few = np.flatnonzero(alone_m2 < spare_m2)
    few = few[np.argsort(alone_m2[few], kind="stable")][:TRIED_MAX]
    ring = Ring(tour.network, tour.order)
    saved_s = {int(at): float(taken_s[at]) - _change_s(ring, int(at)) for at in few}
    for at in sorted(saved_s, key=lambda each: alone_m2[each] / max(saved_s[each], 1e-9)):
        # The neighbours of one that was left out are worth more than before.
        lost_m2 = ground.alone_m2(at)
        if lost_m2 > spare_m2 or not lost_m2 < pays_m2_s * saved_s[at]:
            continue
        before = ring.ends.copy()
        gain_s = float(taken_s[at]) - ring.leave_out(at)
        if not lost_m2 < pays_m2_s * gain_s:
            ring.set(before)
            continue
        ground.kept[at] = False
        spare_m2 -= lost_m2
    for at in np.argsort(lengths_m(lines), kind="stable").tolist():
        if ground.kept[at]:
            ground.trim(at)
    return ground.lines[ground.kept]


def without_stubs(
    lines: Floats, space: BaseGeometry, target: BaseGeometry, boom: Boom, *, left_share: float
) -> Floats:
    """Return lines without those that no way makes as long as a leg has to be.

    They lie between two walls, where no strip fits the other way. Those stay whose ground may not
    be left out.
    """
    stubs = np.flatnonzero(lengths_m(lines) < NEAR_M)
    along = directions(lines[stubs])
    ends = lines[stubs] + np.hstack([-along, along]) * NEAR_M
    ways = shapely.intersection(shapely.linestrings(ends.reshape(-1, 2, 2)), space)
    middles = np.asarray(shapely.points((lines[stubs, :2] + lines[stubs, 2:]) / 2.0))
    parts, way_of = shapely.get_parts(ways, return_index=True)
    own = shapely.distance(parts, middles[way_of]) < SAME_M
    room_m = np.bincount(way_of[own], shapely.length(parts[own]), minlength=len(stubs))
    stubs = stubs[room_m < NEAR_M + MARGINS_M]
    if not len(stubs) or len(stubs) == len(lines):
        return lines
    ground = _Ground(lines, target, boom)
    spare_m2 = left_share * target.area - target.difference(boom.united(lines)).area
    alone_m2 = {at: ground.alone_m2(at) for at in stubs.tolist()}
    for at in sorted(alone_m2, key=lambda each: alone_m2[each]):
        lost_m2 = ground.alone_m2(at)
        if lost_m2 <= spare_m2:
            ground.kept[at] = False
            spare_m2 -= lost_m2
    return lines[ground.kept]


class Crowded:
    """Lines too short for a leg at waypoints that are too near to each other: some are left out.

    The ground that they alone cover comes out of what a plan may leave, as far as that goes.
    """

    def __init__(
        self, lines: Floats, target: BaseGeometry, boom: Boom, *, left_share: float, apart: bool
    ) -> None:
        self._lines = lines
        self._target = target
        self._boom = boom
        self._left_share = left_share
        self._apart = apart
        self._left_out: set[int] = set()

    def paced(
        self,
        sorties: Sequence[FlownSortie],
        pace: Callable[[Sequence[FlownSortie]], Paced],
        ways: Ways,
        *,
        share: float,
    ) -> Paced:
        """Return the sorties as `pace` does, without short lines where waypoints stay too near.

        They are this share of all lines, and may leave so much of what all may.
        """
        found = pace(sorties)
        places = self._near(found)
        if not len(places):
            return found
        spare_m2, given, tried = share * self._spare_m2, list(sorties), 0
        for at, sortie in enumerate(given):
            for line in self._beside(sortie, places)[: TRIED_MAX - tried]:
                tried += 1
                lost_m2 = self._ground.alone_m2(line)
                fewer = _without(sortie, self._lines[line], ways)
                if lost_m2 > spare_m2 or fewer is None:
                    continue
                if len(self._near(pace([fewer]))) < len(self._near(pace([sortie]))):
                    spare_m2 -= lost_m2
                    self._ground.kept[line] = False
                    self._left_out.add(line)
                    given[at] = sortie = fewer
        # The next sorties may fly them.
        self._ground.kept[:] = True
        return pace(given)

    def flown(self, sorties: Sequence[FlownSortie]) -> Floats:
        """Return the lines without those that were left out and none of these sorties flies."""
        legs = [leg for each in sorties for leg in each.legs if leg.kind == "spray"]
        unflown = [
            at
            for at in self._left_out
            if not any(_is_line(self._lines[[at]], leg).any() for leg in legs)
        ]
        found: Floats = np.delete(self._lines, unflown, axis=0)
        return found

    @cached_property
    def _ground(self) -> _Ground:
        return _Ground(self._lines, self._target, self._boom)

    @cached_property
    def _spare_m2(self) -> float:
        left_m2 = self._target.difference(self._boom.united(self._lines)).area
        return self._left_share * self._target.area - float(left_m2)

    def _near(self, found: Paced) -> Floats:
        """Return the places of waypoints that are too near to the one before, and of those."""
        pairs = [
            pair
            for sortie in found.sorties
            for pair in near_pairs(waypoints_of(sortie, apart=self._apart))
        ]
        return np.array(pairs).reshape(-1, 2)

    def _beside(self, sortie: FlownSortie, places: Floats) -> list[int]:
        """Return the short lines of a sortie beside these places, those of least ground first."""
        legs = [leg for leg in sortie.legs if leg.kind == "spray" and leg.length_m < NEAR_M]
        found = set()
        for leg in legs:
            ends = np.array(leg.points)
            if np.hypot(*(ends[:, None] - places[None]).transpose(2, 0, 1)).min() < NEAR_M:
                found |= {int(at) for at in np.flatnonzero(_is_line(self._lines, leg))}
        return sorted(found, key=self._ground.alone_m2)


def _is_line(lines: Floats, leg: Leg) -> Bools:
    """Return which of the lines a leg is, flown from either end."""
    row = np.array([*leg.points[0], *leg.points[-1]])
    either = [np.abs(lines - each).max(axis=1) for each in (row, np.roll(row, 2))]
    found: Bools = np.minimum(*either) < SAME_M
    return found


def _without(sortie: FlownSortie, line: Floats, ways: Ways) -> FlownSortie | None:
    """Return a sortie without one of its lines; None where it has no other."""
    legs = sortie.legs
    (at,) = [
        number
        for number, leg in enumerate(legs)
        if leg.kind == "spray" and _is_line(line[None], leg).any()
    ]
    before, after = legs[at - 1], legs[at + 1]
    if len(legs) < 5:
        return None
    start, end = before.points[0], after.points[-1]
    if at == 1:
        way, kind = ways.home(sortie.depot, end), before.kind
    elif at == len(legs) - 2:
        way, kind = ways.home(sortie.depot, start)[::-1], after.kind
    else:
        way, leaves = ways.between(start, end)
        kind = "ferry" if leaves else "transit"
    joined_way = replace(before, kind=kind, points=tuple(way), through=False)
    return replace(sortie, legs=(*legs[: at - 1], joined_way, *legs[at + 2 :]))


def _change_s(ring: Ring, piece: int) -> float:
    """Return what a tour takes more without a piece, whose own time is not in it."""
    before = ring.ends.copy()
    change_s = ring.leave_out(piece)
    ring.set(before)
    return change_s


class _Ground:
    """Lines and their strips while they are dropped and cut."""

    def __init__(self, lines: Floats, target: BaseGeometry, boom: Boom) -> None:
        self.lines = lines.copy()
        self.kept = np.ones(len(lines), dtype=np.bool_)
        self._along = directions(lines)
        self._strips = boom.strips(lines)
        self._near = shapely.STRtree(self._strips.copy())
        self._target = target
        self._boom = boom
        shapely.prepare(target)

    def alone_m2(self, at: int, *, up_to_m2: float = math.inf) -> float:
        """Return how much ground no other line covers.

        Where that is more than asked for whatever the others share with each other, it may be less
        than it is: that is known in a fraction of the time.
        """
        own, near = self._own(at)
        least_m2 = own.area - float(shapely.area(shapely.intersection(own, near)).sum())
        if least_m2 > up_to_m2 + CRUMB_M2:
            return least_m2
        return float(shapely.area(self._parts(own, near)).sum())

    def _own(self, at: int) -> tuple[BaseGeometry, Objects]:
        """Return the ground of a line, and the strips of others that may cover some of it."""
        strip = self._strips[at]
        near = self._near.query(strip, predicate="intersects")
        others: Objects = self._strips[near[self.kept[near] & (near != at)]]
        return shapely.intersection(strip, self._target), others

    @staticmethod
    def _parts(own: BaseGeometry, others: Objects) -> Objects:
        parts: Objects = shapely.get_parts(shapely.difference(own, whole(others)))
        return parts

    def lost_m2(self, pair: Ints, met: Floats) -> float:
        """Return how much ground is no longer covered if two lines become others."""
        old, new = self._strips[pair], self._boom.strips(met)
        gone = shapely.intersection(whole(old).difference(whole(new)), self._target)
        if gone.is_empty:
            return 0.0
        near = self._near.query(gone, predicate="intersects")
        others = self._strips[near[self.kept[near] & ~np.isin(near, pair)]]
        return float(shapely.area(self._parts(gone, others)).sum())

    def put(self, pair: Ints, met: Floats) -> None:
        """Have two lines become others."""
        self.lines[pair] = met
        self._strips[pair] = self._boom.strips(met)
        self._near = shapely.STRtree(self._strips.copy())

    def trim(self, at: int) -> None:
        """Cut off the ends of a line that others cover, and from which none goes on."""
        joins = [self._joins(at, end) for end in self.lines[at].reshape(2, 2).copy()]
        if all(joins):
            return
        parts = self._parts(*self._own(at))
        parts = parts[shapely.area(parts) > CRUMB_M2]
        if not len(parts):
            return
        first, along = self.lines[at, :2].copy(), self._along[at]
        length_m = float(np.hypot(*(self.lines[at, 2:] - first)))
        places_m = (shapely.get_coordinates(parts) - first) @ along
        start_m, end_m = max(float(places_m.min()), 0.0), min(float(places_m.max()), length_m)
        if joins[0]:
            start_m = 0.0
        if joins[1]:
            end_m = length_m
        if length_m - (end_m - start_m) < LEAST_M:
            return
        end_m = min(max(end_m, start_m + LINE_MIN_M), length_m)
        start_m = max(min(start_m, end_m - LINE_MIN_M), 0.0)
        self.lines[at] = [*(first + along * start_m), *(first + along * end_m)]
        self._strips[at] = self._boom.strips(self.lines[[at]])[0]

    def _joins(self, at: int, end: Floats) -> bool:
        """Return whether another line begins or ends here: it may be flown without a stop."""
        others = self.kept.copy()
        others[at] = False
        ends = self.lines[others].reshape(-1, 2)
        return bool((np.hypot(*(ends - end).T) < JOIN_M).any())


# Some lines as one tour: what they take in all, turns, detours and joins among it.
#
# Layouts are compared by it. A count of turns would do for parallel lines, but not for borders
# whose passes are flown one into the next, nor for holes and bays.

# With more lines a plan has so many turns that one more or less does not count.
LINES_MAX = 500
# Few lines are searched for longer: 300 kicks for 40 of them, 20 for 155.
KICKS, KICKS_MIN, KICKS_MAX = 480_000, 20, 300


@dataclass(frozen=True, slots=True, kw_only=True)
class Tour:
    """Lines in the order `order`; the ways to the first and from the last are left out."""

    lines: Floats
    network: Network
    order: Sortie
    motion: Motion
    space: FreeSpace

    @property
    def seconds(self) -> float:
        """Return the time of all lines and of the ways between them."""
        flown_s = float(self.motion.legs_s(lengths_m(self.lines)).sum())
        return flown_s + cost_s(self.network, [self.order])

    def again(self, lines: Floats) -> Tour:
        """Return a tour of the same lines, as they are now, in the same order to begin with."""
        network = _network(lines, self.space, self.motion)
        order = shortest_tour(network, self.order, kicks=KICKS_MIN)
        return replace(self, lines=lines, network=network, order=order)


def _network(lines: Floats, space: FreeSpace, motion: Motion) -> Network:
    count = len(lines)
    pieces = Pieces(ends=lines, litres=np.zeros(count), line=np.arange(count))
    return build_network(pieces, space, motion)


def tour_of(lines: Floats, space: FreeSpace, motion: Motion) -> Tour:
    """Return a good tour of some lines."""
    count = len(lines)
    network = _network(lines, space, motion)
    order = one_chain(network, by_savings(network, 1.0))
    kicks = min(max(KICKS_MIN, KICKS // count**2), KICKS_MAX)
    order = shortest_tour(network, order, kicks=kicks)
    return Tour(lines=lines, network=network, order=order, motion=motion, space=space)


# Neighbours of a tour that meet in one corner, which is flown through.
#
# A pass along a border goes on past its corner, as far as the outer side of its strip needs, and
# the next one begins as far before it: an aircraft that flies both to their ends turns back between
# them. So does one whose two passes end before a corner. Where other lines cover what the first of
# these cover past the corner, both end in it.

# Ends so far from the corner are moved there, those past it and those before it.
PAST_MAX_M, SHORT_MAX_M = 3.0, 8.0
# Lines with less bend between them have no corner; less ground is rounding.
ONE_SINE, ROUNDING_M2 = 1e-3, 1e-3


def meeting(
    tour: Tour, target: BaseGeometry, ground: BaseGeometry, boom: Boom, *, left_share: float,
    overlap_s_m2: float,
) -> Tour:  # fmt: skip
    """Return a tour whose neighbours meet in a corner where that is quicker.

    What is sprayed twice for it costs `overlap_s_m2`.
    """
    if len(tour.lines) < 2:
        return tour
    motion, lines = tour.motion, _Ground(tour.lines, target, boom)
    spare_m2 = left_share * target.area - target.difference(boom.united(tour.lines)).area
    pays_m2_s = WORTH * motion.speed_m_s * boom.width_m
    bend = math.cos(math.radians(soft_bend_deg(motion)))
    is_changed = False
    for before, after in zip(tour.order[:-1], tour.order[1:], strict=True):
        corner = _corner(_flown(lines.lines, before), _flown(lines.lines, after), bend)
        if corner is None:
            continue
        pair = np.array([before >> 1, after >> 1])
        met = lines.lines[pair].copy()
        met[0, _end_of(before ^ 1)], met[1, _end_of(after)] = corner, corner
        long_m = lengths_m(met)
        if long_m.min() < LINE_MIN_M or not _stay(met, lines.lines[pair], ground, boom.width_m):
            continue
        was_s = float(tour.network.between_s[before ^ 1, after])
        was_s += float(motion.legs_s(lengths_m(lines.lines[pair])).sum())
        is_s = float(motion.legs_s(long_m).sum())
        is_s -= float(motion.spared_straight_s(long_m[:1], long_m[1:])[0])
        more_m = float((long_m - lengths_m(lines.lines[pair])).sum())
        gain_s = was_s - is_s - max(more_m, 0.0) * boom.width_m * overlap_s_m2
        lost_m2 = lines.lost_m2(pair, met) if gain_s > 0.0 else math.inf
        if lost_m2 > max(spare_m2, ROUNDING_M2) or not lost_m2 < pays_m2_s * gain_s:
            continue
        spare_m2 -= lost_m2
        lines.put(pair, met)
        is_changed = True
    return tour if not is_changed else tour.again(lines.lines)


def _flown(lines: Floats, enter: int) -> Floats:
    """Return where the line of a piece that is entered at this end begins and ends."""
    row = lines[enter >> 1]
    return row if not enter & 1 else np.roll(row, 2)


def _end_of(end: int) -> slice:
    return slice(2, 4) if end & 1 else slice(0, 2)


def _corner(one: Floats, other: Floats, bend: float) -> Floats | None:
    """Return where two lines meet, if that is near to the end of one and the start of the other."""
    along, onward = directions(np.array([one, other]))
    gap = other[:2] - one[2:]
    sine, cosine = along[0] * onward[1] - along[1] * onward[0], float(along @ onward)
    if cosine < bend or abs(sine) < ONE_SINE or float(np.hypot(*gap)) < SAME_M:
        return None
    ahead_m = (gap[0] * onward[1] - gap[1] * onward[0]) / sine
    late_m = (gap[0] * along[1] - gap[1] * along[0]) / sine
    # From the corner on to where the other begins: below zero where that is before the corner.
    if not (-PAST_MAX_M < ahead_m < SHORT_MAX_M and -PAST_MAX_M < -late_m < SHORT_MAX_M):
        return None
    corner: Floats = one[2:] + along * ahead_m
    return corner


def _stay(met: Floats, were: Floats, ground: BaseGeometry, width_m: float) -> bool:
    """Return whether lines that have become longer keep their strips on the ground."""
    longer = lengths_m(met) > lengths_m(were)
    strips = rectangles(met[longer], width_m - 2.0 * SLACK_M)
    return bool(shapely.covers(ground, strips).all())
