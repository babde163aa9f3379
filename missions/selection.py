"""Few lines chosen from many: a small field's passes in any phase and course that fits it.

On a small field most lines begin or end at a slanted border, and no single family of parallel
lines fits it: where lines along one border meet those along another, which passes along the border
are flown, and where what is too much falls twice, decide on a fifth of the time. Annealing over
sets of lines weighs their time against ground that is left out and ground that is sprayed twice.
All randomness comes from a seed, and it is counted in moves: the same field has the same lines.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from missions.boom import SLACK_M, Boom, where_inside
from missions.corners import Motion
from missions.coverage import reachable
from missions.open_lines import edges_along, evenly
from missions.searching import below, steps
from missions.strips import Floats, axes, directions, joined, lengths_m

# The ground is looked at in so many points, one for 2.5 m2 of a hectare.
POINTS, STEP_MIN_M = 4_000, 0.25
# A move may cost so much at first, at last next to nothing.
MOVES, HOT_S, COLD_S = 2_000, 6.0, 0.05
# The best sets are annealed again, so many times as long.
FINALISTS, FINAL = 4, 4
# Ground left beyond what may be left costs so much: a patch of 2 m2 has a pass of its own.
LEFT_S_M2 = 4.0
# Two edges that face each other, so far off each other, have lines between their courses.
FAN_MIN_DEG, FAN_MAX_DEG, FAN_EDGES = 0.3, 25.0, 5


def families(
    ground: BaseGeometry, boom: Boom, angles_deg: list[float], *, with_fans: bool = True
) -> list[Floats]:
    """Return lines along each course, flush with each edge along them, and fans between edges."""
    found = [_along(ground, boom, angle_deg) for angle_deg in angles_deg]
    if with_fans:
        fans = _fans(ground, boom.width_m)
        found += [joined(_parts(fan, ground, boom)) for fan in fans]
    return [lines for lines in found if len(lines)]


def _parts(lines: Floats, ground: BaseGeometry, boom: Boom) -> list[Floats]:
    """Return the parts of lines that may be flown, by whole booms and by those that close."""
    whole = where_inside(lines, ground, boom.width_m)
    return [whole, boom.where_open(lines)] if boom.closes else [whole]


def _along(ground: BaseGeometry, boom: Boom, angle_deg: float) -> Floats:
    width_m = boom.width_m
    turned_by = axes(angle_deg)
    turned = shapely.transform(ground, lambda points: points @ turned_by.T)
    found = []
    for part in shapely.get_parts(turned):
        west, low, east, high = part.bounds
        places = [evenly(low, high, width_m)]
        for edge in edges_along(part, width_m).tolist():
            for over_m in {each % width_m for own in boom.over_m for each in (own, -own)}:
                first = low + (edge - low + over_m) % width_m - width_m / 2.0
                flush = np.arange(first, high + width_m, width_m)
                places.append(flush[(flush > low) & (flush < high)])
        across = np.unique(np.round(np.concatenate(places), 3))
        rows = np.column_stack(
            [np.full(len(across), west - 1.0), across, np.full(len(across), east + 1.0), across]
        )
        back = np.column_stack([rows[:, :2] @ turned_by, rows[:, 2:] @ turned_by])
        found += _parts(back, ground, boom)
    return joined(found)


def _fans(ground: BaseGeometry, width_m: float) -> list[Floats]:
    """Return lines that lead over from the course of one long edge to that of another."""
    hull = shapely.get_coordinates(ground.convex_hull.simplify(0.3))
    edges = np.column_stack([hull[:-1], hull[1:]])
    length_m = lengths_m(edges)
    order = np.argsort(-length_m, kind="stable")[:FAN_EDGES]
    edges = edges[order][length_m[order] > 2.0 * width_m]
    middle = shapely.get_coordinates(ground.convex_hull.centroid)[0]
    found = [
        np.array(_fan(edges[one], edges[other], middle, ground, width_m))
        for one in range(len(edges))
        for other in range(one)
    ]
    return [lines for lines in found if len(lines)]


def _fan(
    one: Floats, other: Floats, middle: Floats, ground: BaseGeometry, width_m: float
) -> list[list[float]]:
    first, second = directions(one[None])[0], directions(other[None])[0]
    if first @ second < 0.0:
        second = -second
    bend_deg = math.degrees(math.acos(min(1.0, float(first @ second))))
    if not FAN_MIN_DEG < bend_deg < FAN_MAX_DEG:
        return []
    sides = []
    for edge, along in ((one, first), (other, second)):
        inwards = np.array([along[1], -along[0]])
        if (middle - edge[:2]) @ inwards < 0.0:
            inwards = -inwards
        sides.append((edge[:2] + inwards * width_m / 2.0, along, inwards))
    if sides[0][2] @ sides[1][2] > 0.0:
        return []
    # Two places on each side, cut square to the course between both.
    along = (first + second) / np.hypot(*(first + second))
    reach = shapely.get_coordinates(ground) @ along
    ends = [
        [start + own * ((place_m - start @ along) / (own @ along)) for start, own, _ in sides]
        for place_m in (float(reach.min()), float(reach.max()))
    ]
    apart_m = max(float(np.hypot(*(high - low))) for low, high in ends)
    count = math.ceil(apart_m / width_m - 1e-3) + 1
    rows = []
    for share in np.linspace(0.0, 1.0, count).tolist():
        start, end = (low + (high - low) * share for low, high in ends)
        rows.append([*(start - along), *(end + along)])
    return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class Aim:
    """What is wanted: ground that may be left, and what ground sprayed twice is worth.

    `doubled_max_share` of what is covered of `target_m2` may be sprayed twice at most; None where
    time alone decides. Where both cannot be kept, `covers_first` says which of them is.
    """

    left_max_m2: float
    doubled_s_m2: float
    doubled_max_share: float | None = None
    target_m2: float = 0.0
    covers_first: bool = True

    def cost_s(self, *, left_m2: float, doubled_m2: float) -> float:
        """Return the time that ground left out and sprayed twice is worth."""
        cost = self.doubled_s_m2 * doubled_m2
        first, second = LEFT_S_M2, LEFT_S_M2 / 8.0
        left_s_m2, twice_s_m2 = (first, second) if self.covers_first else (second, first)
        cost += left_s_m2 * max(left_m2 - self.left_max_m2, 0.0)
        if self.doubled_max_share is not None:
            doubled_max_m2 = self.doubled_max_share * (self.target_m2 - left_m2)
            cost += twice_s_m2 * max(doubled_m2 - doubled_max_m2, 0.0)
        return cost


def chosen(
    pools: list[tuple[Floats, list[int]]], ground: BaseGeometry, boom: Boom, *, aim: Aim,
    motion: Motion, moves: int = MOVES,
) -> list[Floats]:  # fmt: skip
    """Return sets of lines that cover the ground in little time, the best first.

    A pool is lines, and those of them to start with.
    """
    points, each_m2 = _points(reachable(ground, boom.width_m))
    tried: list[tuple[float, int, list[int], _Set]] = []
    for pool, first in pools:
        cost_s = motion.legs_s(lengths_m(pool)) + motion.between_passes_s(boom.width_m)
        state = _Set(
            covers=_covered(pool, points, boom), each_m2=each_m2, cost_s=cost_s.tolist(), aim=aim,
        )  # fmt: skip
        state.take(first)
        value_s, lines = state.anneal(random.Random(1), moves)
        tried.append((value_s, len(tried), lines, state))
    found = []
    for _, number, lines, state in sorted(tried, key=lambda each: each[:2])[:FINALISTS]:
        state.take(lines)
        again_s, better = state.anneal(random.Random(2), FINAL * moves)
        pool = pools[number][0]
        found.append((again_s, number, pool[sorted(better)]))
    return [lines for _, _, lines in sorted(found, key=lambda each: each[:2])]


def _points(target: BaseGeometry) -> tuple[Floats, float]:
    """Return points all over the ground, and the area of each."""
    west, south, east, north = target.bounds
    step_m = max(math.sqrt(target.area / POINTS), STEP_MIN_M)
    x, y = np.meshgrid(
        np.arange(west + step_m / 2.0, east, step_m), np.arange(south + step_m / 2.0, north, step_m)
    )
    inside = shapely.contains_xy(target, x.ravel(), y.ravel())
    points = np.column_stack([x.ravel()[inside], y.ravel()[inside]])
    return points, target.area / max(len(points), 1)


def _covered(pool: Floats, points: Floats, boom: Boom) -> NDArray[np.bool_]:
    """Return which points each line's strip covers, shape (lines, points)."""
    spans = boom.spans(pool)
    ways = directions(pool)
    covers = np.zeros((len(pool), len(points)), dtype=np.bool_)
    for number, (line, way) in enumerate(zip(pool, ways, strict=True)):
        off = points - line[:2]
        s, t = off @ way, off @ np.array([way[1], -way[0]])
        on = covers[number]
        first, last = np.searchsorted(spans[:, 0], [number, number + 1])
        for left_m, right_m, start_m, end_m in spans[first:last, 1:].tolist():
            aside = (t >= left_m - SLACK_M) & (t <= right_m + SLACK_M)
            on |= aside & (s >= start_m) & (s <= end_m)
    return covers


class _Set:
    """The lines that are taken, and how often each point is covered.

    Points are the bits of whole numbers: a few operations change a line's thousand of them. What a
    point is covered by is counted in binary, each of the `_digits` for all points.
    """

    def __init__(
        self, *, covers: NDArray[np.bool_], each_m2: float, cost_s: list[float], aim: Aim
    ) -> None:
        count = covers.shape[1]
        self._covers = [
            int.from_bytes(row.tobytes(), "little")
            for row in np.packbits(covers, axis=1, bitorder="little")
        ]
        self._sizes: list[int] = covers.sum(axis=1).tolist()
        self._each_m2, self._cost_s, self._aim = each_m2, cost_s, aim
        self._every, self._digits, self._treated = (1 << count) - 1, [0], 0
        self._taken: list[int] = []
        # The lines over a point follow each other, from where the first of them is.
        self._over: list[int] = np.nonzero(covers.T)[1].tolist()
        self._first: list[int] = [0, *np.cumsum(covers.sum(axis=0)).tolist()]
        self._bare, self._doubled, self._spent_s = count, 0, 0.0

    def take(self, lines: list[int]) -> None:
        """Take these lines and no others."""
        for line in list(self._taken):
            self.drop(line)
        for line in lines:
            self.add(line)

    def add(self, line: int) -> None:
        own = self._covers[line]
        again = (own & self._treated).bit_count()
        self._bare -= self._sizes[line] - again
        self._doubled += again
        self._treated |= own
        digits = self._digits
        for place, digit in enumerate(digits):
            digits[place] = digit ^ own
            own &= digit
            if not own:
                break
        else:
            digits.append(own)
        self._taken.append(line)
        self._spent_s += self._cost_s[line]

    def drop(self, line: int) -> None:
        own = left = self._covers[line]
        digits, treated = self._digits, 0
        for place, digit in enumerate(digits):
            digits[place] = digit = digit ^ left
            left &= digit
            treated |= digit
        again = (own & treated).bit_count()
        self._bare += self._sizes[line] - again
        self._doubled -= again
        self._treated = treated
        self._taken.remove(line)
        self._spent_s -= self._cost_s[line]

    def value_s(self) -> float:
        each_m2 = self._each_m2
        return self._spent_s + self._aim.cost_s(
            left_m2=self._bare * each_m2, doubled_m2=self._doubled * each_m2
        )

    def anneal(self, draw: random.Random, moves: int) -> tuple[float, list[int]]:
        best, best_s = list(self._taken), self.value_s()
        now_s, heat = best_s, HOT_S
        cooling = (COLD_S / HOT_S) ** (1.0 / moves)
        for _ in steps("choice of lines", moves):
            heat *= cooling
            counts = (list(self._digits), self._treated, self._bare, self._doubled)
            changed = self._move(draw)
            value_s = self.value_s()
            if value_s - now_s > -heat * math.log(1.0 - draw.random()):
                for line in changed[::-1]:
                    self._note(line)
                self._digits, self._treated, self._bare, self._doubled = counts
                continue
            now_s = value_s
            if now_s < best_s - 1e-9:
                best, best_s = list(self._taken), now_s
        return best_s, best

    def _move(self, draw: random.Random) -> list[int]:
        """Change the set; return the lines that were taken or dropped, in order."""
        kind, changed = draw.random(), []
        if kind < 0.75 and self._taken:
            changed.append(self._taken[below(draw, len(self._taken))])
            self._flip(changed[0])
        if kind > 0.25:
            line = self._drawn(draw, changed)
            if line is not None and line not in changed:
                self._flip(line)
                changed.append(line)
        return changed

    def _drawn(self, draw: random.Random, changed: list[int]) -> int | None:
        """Return a line over ground that is bare now."""
        some = self._covers[changed[0]] if changed else self._every
        bare = some & ~self._treated
        if not bare:
            return None
        point = _set_bit(bare, below(draw, bare.bit_count()))
        first, end = self._first[point], self._first[point + 1]
        return self._over[first + below(draw, end - first)] if end > first else None

    def _note(self, line: int) -> None:
        """Have a line taken or dropped again, but for what is counted of the points."""
        if line in self._taken:
            self._taken.remove(line)
            self._spent_s -= self._cost_s[line]
        else:
            self._taken.append(line)
            self._spent_s += self._cost_s[line]

    def _flip(self, line: int) -> None:
        if line in self._taken:
            self.drop(line)
        else:
            self.add(line)


def _set_bit(bits: int, number: int) -> int:
    """Return the place of a bit that is set; the lowest one has the number 0.

    >>> [_set_bit(0b1011000, number) for number in range(3)]
    [3, 4, 6]
    """
    place, wide = 0, bits.bit_length()
    while wide > 1:
        half = wide >> 1
        low = bits & ((1 << half) - 1)
        count = low.bit_count()
        if number < count:
            bits, wide = low, half
        else:
            bits, wide, place, number = bits >> half, wide - half, place + half, number - count
    return place
