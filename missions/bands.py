"""Orders of passes by bands: cut across, so that a tank ends on the side from which it came.

A sortie that flies one pass out and the next one back, both half a tank long, is empty where it
began. So passes are cut into bands of a whole share of a tank, and each band is flown to and fro.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from missions.passes import Part, Passes, turned
from missions.refills import STUB_M
from missions.strips import Floats

# What lies behind an obstacle by less than this is flown around; of so many chains the nearest.
AROUND, AROUND_M, NEAREST = 1.5, 30.0, 2
# Cuts of other lines than those along the course fall where they may.
PARALLEL = math.cos(math.radians(30.0))


def cut_across(
    passes: Passes, parts: Sequence[Part], course: tuple[float, float], cuts_m: Sequence[float]
) -> dict[int, list[Part]]:
    """Return parts by the band that they lie in, cut at these places along the course."""
    found: dict[int, list[Part]] = {}
    east, north = course
    for line, start_m, end_m in parts:
        x, y = passes.starts[line]
        u, v = passes.along[line]
        rise = u * east + v * north
        base_m = x * east + y * north
        low_m, high_m = min(start_m, end_m), max(start_m, end_m)
        places = [low_m]
        if abs(rise) > PARALLEL:
            crossed = sorted((cut - base_m) / rise for cut in cuts_m)
            places += [each for each in crossed if low_m + STUB_M < each < high_m - STUB_M]
        places.append(high_m)
        for one, other in pairwise(places):
            middle = base_m + rise * (one + other) / 2.0
            band = sum(cut < middle for cut in cuts_m) if cuts_m else 0
            found.setdefault(band, []).append((line, one, other))
    return found


def to_and_fro(passes: Passes, parts: Sequence[Part], *, first: int = 0) -> list[Part]:
    """Return parts such that each begins at the nearest end, from the end `first` on.

    Ends 2 i and 2 i + 1 are those of part i.
    """
    if len(parts) < 2:
        return list(parts)
    if len(parts) < FEW:
        return _few(passes, parts, first)
    ends = np.array(
        [passes.place(line, at_m) for line, start_m, end_m in parts for at_m in (start_m, end_m)]
    )
    x, y = ends[:, 0].copy(), ends[:, 1].copy()
    run, here = [], first
    for _ in parts:
        run.append(_entered(parts, here))
        east, north = ends[here ^ 1]
        x[here >> 1 << 1 : (here >> 1 << 1) + 2] = math.inf
        here = int(np.argmin((x - east) ** 2 + (y - north) ** 2))
    return run


# With fewer parts than this no arrays are made.
FEW = 40


def _few(passes: Passes, parts: Sequence[Part], first: int) -> list[Part]:
    places = [passes.place(line, at_m) for line, *both in parts for at_m in both]
    left = list(range(len(places)))
    run, here = [], first
    while True:
        run.append(_entered(parts, here))
        x, y = places[here ^ 1]
        left = [end for end in left if end >> 1 != here >> 1]
        if not left:
            return run
        here = min(left, key=lambda end: (places[end][0] - x) ** 2 + (places[end][1] - y) ** 2)


def _entered(parts: Sequence[Part], end: int) -> Part:
    line, start_m, end_m = parts[end >> 1]
    return (line, end_m, start_m) if end & 1 else (line, start_m, end_m)


def in_sight(passes: Passes, run: Sequence[Part]) -> list[list[Part]]:
    """Return a run in chains, cut where the next part lies behind what must be flown around."""
    chains = [[run[0]]]
    for before, after in pairwise(run):
        one, other = passes.place(before[0], before[2]), passes.place(after[0], after[1])
        straight_m = math.dist(one, other)
        if passes.gap_m(one, other) > AROUND * straight_m + AROUND_M:
            chains.append([])
        chains[-1].append(after)
    return chains


def linked(passes: Passes, chains: Sequence[list[Part]]) -> list[Part]:
    """Return chains one after the other, each time the one that is nearest to fly to."""
    left = [list(chain) for chain in chains]
    run = left.pop(0)
    while left:
        here = passes.place(run[-1][0], run[-1][2])
        ends = [
            (math.dist(here, passes.place(line, at_m)), number, is_turned)
            for number, chain in enumerate(left)
            for is_turned, (line, at_m) in enumerate(
                ((chain[0][0], chain[0][1]), (chain[-1][0], chain[-1][2]))
            )
        ]
        ends.sort()
        _, number, is_turned = min(
            ends[:NEAREST],
            key=lambda each: passes.gap_m(
                here,
                passes.place(left[each[1]][-1][0], left[each[1]][-1][2])
                if each[2]
                else passes.place(left[each[1]][0][0], left[each[1]][0][1]),
            ),
        )
        chain = left.pop(number)
        run += turned(chain) if is_turned else chain
    return run


def outermost(passes: Passes, parts: Sequence[Part], across: tuple[float, float]) -> int:
    """Return the end that lies farthest to one side."""
    east, north = across

    def aside(end: int) -> float:
        x, y = passes.place(parts[end >> 1][0], parts[end >> 1][1 + (end & 1)])
        return x * east + y * north

    return min(range(2 * len(parts)), key=aside)


def main_course(lines: Floats) -> tuple[float, float]:
    """Return the direction of most metres.

    >>> main_course(np.array([[0.0, 0.0, 0.0, 9.0], [0.0, 9.0, 3.0, 9.0], [3.0, 9.0, 3.0, 0.0]]))
    (0.0, 1.0)
    """
    step = lines[:, 2:] - lines[:, :2]
    length_m = np.hypot(*step.T)
    keys = np.round(np.degrees(np.arctan2(step[:, 1], step[:, 0])) % 180.0).astype(np.int64) % 180
    most = int(np.argmax(np.bincount(keys, weights=length_m)))
    some = np.flatnonzero(keys == most)
    at = int(some[np.argmax(length_m[some])])
    east, north = (step[at] / length_m[at]).tolist()
    return east, north
