"""Sorties as blocks of ground, from side to side: a day that ends early leaves a sprayed half.

What lies apart from the rest of its sortie has a price, so that the search avoids it wherever that
takes little time; stripes are what it finds without one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely

from missions.passes import Part, Passes
from missions.strips import Objects

# Passes whose strips touch: spacing is a little uneven, and borders are drawn with few corners.
BESIDE = 1.1
# A metre that lies apart counts as so many seconds.
APART_S_M = 3.0
# Passes in other courses tie no block together: between every other pass they make stripes of it.
PARALLEL = math.cos(math.radians(30.0))

# From one side on blocks grow so much less along the passes.
ALONG = 0.1


class Blocks:
    """Which parts of lines lie beside each other."""

    def __init__(self, passes: Passes, width_m: float, course: tuple[float, float]) -> None:
        self._passes, self._beside_m = passes, BESIDE * width_m
        self._course, self.across = course, (-course[1], course[0])
        self._is_main = [
            abs(east * course[0] + north * course[1]) > PARALLEL for east, north in passes.along
        ]
        every = [(at, 0.0, length_m) for at, length_m in enumerate(passes.length_m)]
        # Ground that no pass ties together is not asked to be.
        self._ground = _joined(len(every), self._pairs(self._drawn(every)))

    def apart_s(self, sortie: Sequence[Part]) -> float:
        """Return what the parts of a sortie that lie apart from its largest block count as."""
        if len(sortie) < 2:
            return 0.0
        is_main = [self._is_main[line] for line, _, _ in sortie]
        pairs = self._pairs(self._drawn(sortie))
        block = _joined(
            len(sortie), [(one, other) for one, other in pairs if is_main[one] == is_main[other]]
        )
        tied = {
            block[one if is_main[other] else other]
            for one, other in pairs
            if is_main[one] != is_main[other]
        }
        size_m: dict[tuple[int, int], float] = {}
        for at, (line, start_m, end_m) in enumerate(sortie):
            if is_main[at] or block[at] not in tied:
                key = self._ground[line], block[at]
                size_m[key] = size_m.get(key, 0.0) + abs(end_m - start_m)
        largest: dict[int, float] = {}
        for (ground, _), each_m in size_m.items():
            largest[ground] = max(largest.get(ground, 0.0), each_m)
        return APART_S_M * (sum(size_m.values()) - sum(largest.values()))

    def in_turn(self, sorties: Sequence[list[Part]]) -> list[list[Part]]:
        """Return the sorties from side to side, each beside one before, where there is one."""
        drawn = [shapely.multilinestrings(self._drawn(sortie)) for sortie in sorties]
        middles = np.array([shapely.get_coordinates(each).mean(axis=0) for each in drawn])
        aside_m = (middles @ self.across).tolist()
        near: list[set[int]] = [set() for _ in sorties]
        for one, other in self._pairs(np.array(drawn, dtype=object)):
            near[one].add(other)
            near[other].add(one)
        left, beside, order = set(range(len(sorties))), set[int](), list[int]()
        while left:
            at = min(beside & left or left, key=lambda each: (aside_m[each], each))
            left.remove(at)
            beside |= near[at]
            order.append(at)
        return [sorties[at] for at in order]

    def grown(self, parts: Sequence[Part], tank_l: float) -> list[list[Part]]:
        """Return the parts in blocks that a tank is enough for, each grown from its first part.

        Where no more of the ground beside it is left, a block goes on at the next.
        """
        need_l = [self._passes.need_l(part) for part in parts]
        drawn = self._drawn(parts)
        middles = shapely.get_coordinates(shapely.centroid(drawn))
        aside_m, along_m = middles @ self.across, middles @ self._course
        near: list[set[int]] = [set() for _ in parts]
        for one, other in self._pairs(drawn):
            near[one].add(other)
            near[other].add(one)
        left, blocks, edge = set(range(len(parts))), list[list[Part]](), set[int]()
        while left:
            first = min(edge & left or left, key=lambda each: (aside_m[each], each))
            far_m = (aside_m + ALONG * np.abs(along_m - along_m[first])).tolist()
            block, load_l, beside = list[int](), 0.0, {first}
            while beside:
                at = min(beside, key=lambda each: (far_m[each], each))
                beside.remove(at)
                if block and load_l + need_l[at] > tank_l:
                    continue
                block.append(at)
                left.remove(at)
                load_l += need_l[at]
                beside |= near[at] & left
                if not beside and left and not any(near[each] & left for each in block):
                    beside = {min(left, key=lambda each: (far_m[each], each))}
            edge.update(*(near[at] for at in block))
            blocks.append([parts[at] for at in block])
        return blocks

    def _drawn(self, parts: Sequence[Part]) -> Objects:
        place = self._passes.place
        ends = [[place(line, start_m), place(line, end_m)] for line, start_m, end_m in parts]
        return np.asarray(shapely.linestrings(ends), dtype=object)

    def _pairs(self, drawn: Objects) -> list[tuple[int, int]]:
        one, other = shapely.STRtree(drawn).query(
            drawn, predicate="dwithin", distance=self._beside_m
        )
        return [(a, b) for a, b in zip(one.tolist(), other.tolist(), strict=True) if a < b]


def _joined(count: int, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Return for each of so many which group it is of.

    >>> _joined(4, [(0, 2), (2, 3)])
    [0, 1, 0, 0]
    """
    of = list(range(count))
    for pair in pairs:
        one, other = sorted(of[each] for each in pair)
        if one != other:
            of = [one if each == other else each for each in of]
    return of
