"""Lines that are flown in any parts: what a part needs, and what ways between parts take.

Refills are searched for among very many sorties: what all of them ask is known beforehand, in
tables, for one part at a time and for many of them at once.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from missions.corners import Motion
from missions.demand import Demand
from missions.free_space import FreeSpace
from missions.network import ACROSS_M, JOIN_M, STRAIGHT_M, soft_bend_deg
from missions.strips import Floats, directions, lengths_m

# A line, and from where to where along it [m]; the second is the lesser where it is flown back.
Part = tuple[int, float, float]
Place = tuple[float, float]
Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]

# Times by the root of the way, to this length; longer ways are flown at speed.
TABLED_M, KNOTS = 400.0, 1600
TOUCH_M = 1e-3
# Neighbouring passes see each other. No way through: far apart, whatever the ferry around costs.
SEEN_M = 9.0
HIDDEN, HIDDEN_M = 3.0, 1000.0


class Times:
    """How long ways take, as `missions.corners` has it, fast for one way at a time."""

    def __init__(self, motion: Motion) -> None:
        self._scale: float = KNOTS / math.sqrt(TABLED_M)
        knots_m = (np.arange(KNOTS + 2) / self._scale) ** 2
        self._roots: Floats = np.sqrt(knots_m)
        self._legs: list[float] = motion.legs_s(knots_m).tolist()
        self._ways: list[float] = motion.ways_s(knots_m).tolist()
        self._leg_knots_s, self._way_knots_s = np.array(self._legs), np.array(self._ways)
        self._speed_m_s: float = motion.speed_m_s
        self._leg_more_s: float = self._legs[KNOTS] - float(knots_m[KNOTS]) / motion.speed_m_s
        self._way_more_s: float = self._ways[KNOTS] - float(knots_m[KNOTS]) / motion.speed_m_s
        self._reaching_s = float(motion.legs_s(np.array([1e5]))[0]) - 1e5 / motion.speed_m_s
        self._begins_early = motion.corners == "ardupilot"
        # The cosine of the bends that are as good as none.
        self.bend = math.cos(math.radians(soft_bend_deg(motion)))
        self.is_soft = self._begins_early

    def leg_s(self, length_m: float) -> float:
        """Return the time of a straight leg from rest to rest."""
        if length_m >= TABLED_M:
            return length_m / self._speed_m_s + self._leg_more_s
        at = math.sqrt(length_m) * self._scale
        low = int(at)
        one_s, other_s = self._legs[low], self._legs[low + 1]
        return one_s + (at - low) * (other_s - one_s)

    def way_s(self, length_m: float) -> float:
        """Return what a way between two passes adds."""
        if length_m >= TABLED_M:
            return length_m / self._speed_m_s + self._way_more_s
        at = math.sqrt(length_m) * self._scale
        low = int(at)
        one_s, other_s = self._ways[low], self._ways[low + 1]
        return one_s + (at - low) * (other_s - one_s)

    def legs_s(self, length_m: Floats) -> Floats:
        """Return `leg_s` of many lengths."""
        near_s: Floats = np.interp(np.sqrt(length_m), self._roots, self._leg_knots_s)
        is_long = length_m >= TABLED_M
        found_s: Floats = np.where(is_long, length_m / self._speed_m_s + self._leg_more_s, near_s)
        return found_s

    def ways_s(self, length_m: Floats) -> Floats:
        """Return `way_s` of many lengths."""
        near_s: Floats = np.interp(np.sqrt(length_m), self._roots, self._way_knots_s)
        is_long = length_m >= TABLED_M
        found_s: Floats = np.where(is_long, length_m / self._speed_m_s + self._way_more_s, near_s)
        return found_s

    def on_s(self, before_m: float, gap_m: float, after_m: float) -> float:
        """Return what a gap adds between two parts of a line that is flown straight on."""
        if gap_m < JOIN_M:
            return -self._spared_s(before_m, after_m)
        spared_s = self._spared_s(before_m, gap_m) + self._spared_s(gap_m, after_m)
        return self.leg_s(gap_m) - spared_s

    def _spared_s(self, one_m: float, other_m: float) -> float:
        """Return what `Motion.spared_straight_s` says."""
        one_s, other_s = self.leg_s(one_m), self.leg_s(other_m)
        if self._begins_early:
            return min(one_s / 2.0, other_s / 2.0, self._reaching_s)
        return (one_s + other_s - (one_m + other_m) / self._speed_m_s) / 2.0


class _Many:
    """What `Passes` knows of one place or part, for many of them at once."""

    def __init__(self, passes: Passes) -> None:
        self._passes = passes
        self._starts, self._along = passes.lines[:, :2], directions(passes.lines)
        self._length_m = np.array(passes.length_m)
        self._even_l_m = np.array(passes.even_l_m)
        self.pace_s_m = np.array(passes.pace_s_m)
        self._slow_s_m = self.pace_s_m - 1.0 / passes.speed_m_s
        self._depots = np.array(passes.depots)
        self._bent: tuple[Floats, Ints, Ints] | None = None

    def places(self, lines: Ints, at_m: Floats) -> Floats:
        """Return `Passes.place`."""
        found: Floats = self._starts[lines] + at_m[:, None] * self._along[lines]
        return found

    def homes_m(self, lines: Ints, at_m: Floats) -> Floats:
        """Return `Passes.homes_m`, shape (depots, n)."""
        places = self.places(lines, at_m)
        found_m: Floats = np.hypot(
            places[:, 0] - self._depots[:, :1], places[:, 1] - self._depots[:, 1:]
        )
        if not self._passes.bent_m:
            return found_m
        bent_m, begin, count = self._bent_ways()
        some = np.flatnonzero(count[lines])
        line = lines[some]
        at = at_m[some] / self._length_m[line] * (count[line] - 1)
        low = np.clip(at.astype(np.int64), 0, count[line] - 2)
        one_m, other_m = bent_m[:, begin[line] + low], bent_m[:, begin[line] + low + 1]
        found_m[:, some] = one_m + (at - low) * (other_m - one_m)
        return found_m

    def _bent_ways(self) -> tuple[Floats, Ints, Ints]:
        """Return all bent ways, by depot, and of each line where its own begin and how many."""
        if self._bent is None:
            count = np.zeros(len(self._length_m), dtype=np.int64)
            for line, bent_m in self._passes.bent_m.items():
                count[line] = len(bent_m[0])
            ways = sorted(self._passes.bent_m.items())
            ways_m = np.concatenate([bent_m for _, bent_m in ways], axis=1)
            self._bent = ways_m, np.cumsum(count) - count, count
        return self._bent

    def needs_l(self, lines: Ints, start_m: Floats, end_m: Floats) -> Floats:
        """Return `Passes.need_l`."""
        needs_l = self._even_l_m[lines] * np.abs(end_m - start_m)
        for at in np.flatnonzero(self._even_l_m[lines] == 0.0).tolist():
            needs_l[at] = self._passes.need_l((int(lines[at]), start_m[at], end_m[at]))
        return needs_l

    def after_m(self, lines: Ints, ends_m: Floats, litres: Floats) -> Floats:
        """Return `Passes.after_m` of parts from and to `ends_m`, shape (2, n)."""
        start_m, end_m = ends_m
        even = self._even_l_m[lines]
        is_even = even > 0.0
        done_m = np.divide(litres, even, out=np.zeros_like(litres), where=is_even)
        done_m = np.minimum(done_m, np.abs(end_m - start_m))
        found_m: Floats = start_m + np.where(end_m > start_m, done_m, -done_m)
        for at in np.flatnonzero(~is_even).tolist():
            part = int(lines[at]), float(start_m[at]), float(end_m[at])
            found_m[at] = self._passes.after_m(part, float(litres[at]))
        return found_m

    def parts_s(self, lines: Ints, length_m: Floats) -> Floats:
        """Return how long parts of lines take, from rest to rest."""
        found_s: Floats = self._passes.times.legs_s(length_m) + self._slow_s_m[lines] * length_m
        return found_s

    def joins_s(self, lines: Ints, start_m: Floats, end_m: Floats) -> tuple[Floats, Floats]:
        """Return `Passes.join_s` between each part and the next."""
        ends, starts = self.places(lines[:-1], end_m[:-1]), self.places(lines[1:], start_m[1:])
        gap_m: Floats = np.hypot(*(starts - ends).T)
        is_back = (end_m < start_m)[:, None]
        away = np.where(is_back, -self._along[lines], self._along[lines])
        # Two bends of a soft one each may be a square one together.
        least = -1e-9 if self._passes.times.is_soft else self._passes.times.bend
        is_on = (gap_m < ACROSS_M) & ((away[:-1] * away[1:]).sum(axis=1) > least)
        hidden = np.flatnonzero((gap_m > SEEN_M) & ~is_on)
        if len(hidden) and not self._passes.space.is_convex:
            gap_m[hidden] = self._passes.gaps_m(ends[hidden], starts[hidden])
        joins_s: Floats = self._passes.times.ways_s(gap_m)
        for at in np.flatnonzero(is_on).tolist():
            before = int(lines[at]), float(start_m[at]), float(end_m[at])
            after = int(lines[at + 1]), float(start_m[at + 1]), float(end_m[at + 1])
            joins_s[at], gap_m[at] = self._passes.join_s(before, after)
        return joins_s, gap_m


@dataclass(slots=True, kw_only=True)
class Passes:
    """Lines that are flown in any parts: where they lie, what they need, how far each depot is.

    `pace_s_m` is the time of a metre of each. `bent_m` has, for lines that a depot does not see,
    the ways to every depot from places evenly apart, by depot and place.
    """

    lines: Floats
    demand: Sequence[Demand]
    times: Times
    depots: Sequence[Place]
    pace_s_m: Sequence[float]
    speed_m_s: float
    space: FreeSpace
    bent_m: dict[int, list[list[float]]] = field(default_factory=dict)
    known_m: dict[tuple[Place, Place], float] = field(default_factory=dict)
    length_m: list[float] = field(init=False)
    along: list[tuple[float, float]] = field(init=False)
    starts: list[Place] = field(init=False)
    at_m: list[list[float]] = field(init=False)
    litres: list[list[float]] = field(init=False)
    even_l_m: list[float] = field(init=False)
    many: _Many = field(init=False)

    def __post_init__(self) -> None:
        self.length_m = lengths_m(self.lines).tolist()
        self.along = [(x, y) for x, y in directions(self.lines).tolist()]
        self.starts = [(row[0], row[1]) for row in self.lines.tolist()]
        self.at_m = [need.at_m.tolist() for need in self.demand]
        self.litres = [need.litres.tolist() for need in self.demand]
        self.even_l_m = [
            litres[1] / at_m[1] if len(at_m) == 2 and at_m[0] == 0.0 else 0.0
            for at_m, litres in zip(self.at_m, self.litres, strict=True)
        ]
        self.many = _Many(self)

    def place(self, line: int, at_m: float) -> Place:
        """Return where a place of a line lies."""
        (x, y), (east, north) = self.starts[line], self.along[line]
        return x + at_m * east, y + at_m * north

    def homes_m(self, line: int, at_m: float) -> list[float]:
        """Return the ways from a place of a line to every depot."""
        bent = self.bent_m.get(line)
        if bent is not None:
            at = at_m / self.length_m[line] * (len(bent[0]) - 1)
            low = min(max(int(at), 0), len(bent[0]) - 2)
            return [ways[low] + (at - low) * (ways[low + 1] - ways[low]) for ways in bent]
        x, y = self.place(line, at_m)
        return [math.hypot(x - east, y - north) for east, north in self.depots]

    def used_l(self, line: int, at_m: float) -> float:
        """Return what a line needs up to a place."""
        if self.even_l_m[line]:
            return self.even_l_m[line] * at_m
        known, litres = self.at_m[line], self.litres[line]
        high = min(max(bisect_right(known, at_m), 1), len(known) - 1)
        one, other = known[high - 1], known[high]
        share = (at_m - one) / (other - one) if other > one else 0.0
        return litres[high - 1] + share * (litres[high] - litres[high - 1])

    def need_l(self, part: Part) -> float:
        """Return what a part needs."""
        line, start_m, end_m = part
        return abs(self.used_l(line, end_m) - self.used_l(line, start_m))

    def after_m(self, part: Part, litres: float) -> float:
        """Return where on its line a part has used so much."""
        line, start_m, end_m = part
        if self.even_l_m[line]:
            done_m = litres / self.even_l_m[line]
            return min(start_m + done_m, end_m) if end_m > start_m else max(start_m - done_m, end_m)
        begun = self.used_l(line, start_m)
        wanted = begun + litres if end_m > start_m else begun - litres
        known, used = self.at_m[line], self.litres[line]
        high = min(max(bisect_left(used, wanted), 1), len(used) - 1)
        one, other = used[high - 1], used[high]
        share = (wanted - one) / (other - one) if other > one else 0.0
        found = known[high - 1] + share * (known[high] - known[high - 1])
        low_m, high_m = min(start_m, end_m), max(start_m, end_m)
        return min(max(found, low_m), high_m)

    def join_s(self, before: Part, after: Part) -> tuple[float, float]:
        """Return what the way from one part to the next adds, and its length."""
        one, other = self.place(before[0], before[2]), self.place(after[0], after[1])
        gap_m = math.hypot(other[0] - one[0], other[1] - one[1])
        if gap_m < ACROSS_M and self._goes_on(before, after, one, other, gap_m):
            one_m, other_m = abs(before[2] - before[1]), abs(after[2] - after[1])
            return self.times.on_s(one_m, gap_m, other_m), gap_m
        gap_m = self.gap_m(one, other)
        return self.times.way_s(gap_m), gap_m

    def gap_m(self, one: Place, other: Place) -> float:
        """Return the way between two places, over the best corners where one hides the other."""
        gap_m = math.hypot(other[0] - one[0], other[1] - one[1])
        if gap_m <= SEEN_M or self.space.is_convex:
            return gap_m
        return float(self.gaps_m(np.array([one]), np.array([other]))[0])

    def gaps_m(self, ones: Floats, others: Floats) -> Floats:
        """Return `gap_m` between places that may not see each other."""
        pairs = [
            ((x, y), (u, v)) for (x, y), (u, v) in zip(ones.tolist(), others.tolist(), strict=True)
        ]
        new = [at for at, pair in enumerate(pairs) if pair not in self.known_m]
        if new:
            seen = self.space.sees(ones[new], others[new]).tolist()
            for at, is_seen in zip(new, seen, strict=True):
                one, other = pairs[at]
                gap_m = math.hypot(other[0] - one[0], other[1] - one[1])
                if not is_seen:
                    around_m = self.space.around_m(one, other)
                    is_way = math.isfinite(around_m)
                    gap_m = around_m if is_way else HIDDEN * gap_m + HIDDEN_M
                self.known_m[one, other] = self.known_m[other, one] = gap_m
        return np.array([self.known_m[pair] for pair in pairs])

    def _goes_on(self, before: Part, after: Part, one: Place, other: Place, gap_m: float) -> bool:
        (east, north), (x, y) = self.along[before[0]], self.along[after[0]]
        if before[2] < before[1]:
            east, north = -east, -north
        if after[2] < after[1]:
            x, y = -x, -y
        bend = self.times.bend
        if gap_m < JOIN_M:
            return east * x + north * y > bend
        way = other[0] - one[0], other[1] - one[1]
        ahead_m, onward_m = way[0] * east + way[1] * north, way[0] * x + way[1] * y
        if self.times.is_soft and min(ahead_m, onward_m) > bend * gap_m:
            return gap_m <= SEEN_M or self.gap_m(one, other) < gap_m + TOUCH_M
        return (
            east * x + north * y > bend
            and abs(way[0] * north - way[1] * east) <= STRAIGHT_M
            and ahead_m > 0.0
            and abs(east * y - north * x) < STRAIGHT_M / gap_m
        )


def turned(run: Sequence[Part]) -> list[Part]:
    """Return parts flown the other way.

    >>> turned([(0, 0.0, 5.0), (3, 8.0, 2.0)])
    [(3, 2.0, 8.0), (0, 5.0, 0.0)]
    """
    return [(line, end_m, start_m) for line, start_m, end_m in reversed(run)]


def joined_parts(run: Sequence[Part]) -> list[Part]:
    """Return a run without the cuts that it flies straight over.

    >>> joined_parts([(0, 9.0, 5.0), (0, 5.0, 2.0), (1, 0.0, 4.0)])
    [(0, 9.0, 2.0), (1, 0.0, 4.0)]
    """
    found: list[Part] = []
    for line, start_m, end_m in run:
        last = found[-1] if found else None
        if (
            last is not None
            and last[0] == line
            and abs(last[2] - start_m) < TOUCH_M
            and (last[2] > last[1]) == (end_m > start_m)
        ):
            found[-1] = (line, last[1], end_m)
        else:
            found.append((line, start_m, end_m))
    return found
