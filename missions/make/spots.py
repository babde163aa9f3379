"""From weeds to strips of ground that are sprayed although nothing is exactly where it should be.

How much wider than the weeds is a budget of errors, each a figure of the configuration: what always
happens (a valve's flow needs way to build up; without correction wind carries droplets off) is
added up, what happens by chance is added in squares. The boom closes in parts, so across the track
ground is that of whole valves: whatever a strip touches is sprayed in its whole width.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from missions.strips import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """One cause of error: along and across the track; `by_chance` ones are standard deviations."""

    name: str
    along_m: float
    across_m: float
    by_chance: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """All causes, and what follows for how far ground around a weed is sprayed."""

    parts: tuple[Part, ...]
    miss_share: float

    def sd_m(self, axis: str) -> float:
        """Return one standard deviation of all that happens by chance.

        >>> parts = (Part(name="a", along_m=0.3, across_m=0.0, by_chance=True),
        ...          Part(name="b", along_m=0.4, across_m=0.0, by_chance=True))
        >>> Budget(parts=parts, miss_share=0.02).sd_m("along")
        0.5
        """
        return math.hypot(*(self._of(one, axis) for one in self.parts if one.by_chance))

    def sure_m(self, axis: str) -> float:
        """Return the sum of what always happens."""
        return sum(self._of(one, axis) for one in self.parts if not one.by_chance)

    def reach_m(self, axis: str) -> float:
        """Return how far around a weed must be sprayed.

        Along and across share the chance of a miss, and so do both sides of each.
        """
        sds = NormalDist().inv_cdf(1.0 - self.miss_share / 4.0)
        return self.sure_m(axis) + sds * self.sd_m(axis)

    @staticmethod
    def _of(part: Part, axis: str) -> float:
        return part.along_m if axis == "along" else part.across_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Opening:
    """Where the valves over one band are open: from `start_m` to `end_m` along the passes."""

    band: int
    start_m: float
    end_m: float


def openings(
    spots: Sequence[BaseGeometry], edges_m: Floats, budget: Budget, *, least_m: float, gap_m: float
) -> list[Opening]:
    """Return where each band is open for spots (along, right).

    Args:
        spots: the weeds' own ground.
        edges_m: of the bands, one a valve.
        budget: how far around them.
        least_m: a shorter opening is made so long: a rate must be there to be told.
        gap_m: gaps that are shorter stay open; valves could not close and open again in them.
    """
    along_m, across_m = budget.reach_m("along"), budget.reach_m("across")
    wanted: dict[int, list[tuple[float, float]]] = {}
    for spot in spots:
        _, low, _, high = spot.bounds
        first = max(int(np.searchsorted(edges_m, low - across_m, "right")) - 1, 0)
        last = min(int(np.searchsorted(edges_m, high + across_m, "left")), len(edges_m) - 1)
        for band in range(first, last):
            reach = shapely.box(
                spot.bounds[0], edges_m[band] - across_m, spot.bounds[2],
                edges_m[band + 1] + across_m,
            )  # fmt: skip
            near = shapely.intersection(spot, reach)
            if near.is_empty:
                continue
            start, _, end, _ = near.bounds
            short = max(least_m - (end - start) - 2.0 * along_m, 0.0) / 2.0
            wanted.setdefault(band, []).append((start - along_m - short, end + along_m + short))
    found = []
    for band, spans in sorted(wanted.items()):
        spans.sort()
        start, end = spans[0]
        for low, high in [*spans[1:], (math.inf, math.inf)]:
            if low - end >= gap_m:
                found.append(Opening(band=band, start_m=start, end_m=end))
                start, end = low, high
            else:
                end = max(end, high)
    return found


def grounds(found: Sequence[Opening], edges_m: Floats) -> list[Polygon]:
    """Return the ground of every opening (along, right)."""
    return [
        shapely.box(one.start_m, edges_m[one.band], one.end_m, edges_m[one.band + 1])
        for one in found
    ]


def misses(points: Floats, treated: BaseGeometry, budget: Budget) -> Floats:
    """Return how probably each point (along, right) is missed.

    From a point to the edge of what is sprayed, along and across: what always happens is taken off
    on both sides, and what happens by chance is normal.
    """
    shapely.prepare(treated)
    start, low, end, high = treated.bounds
    chance = NormalDist()
    found = np.ones(len(points))
    for at, (along, right) in enumerate(points.tolist()):
        if not treated.intersects(shapely.Point(along, right)):
            continue
        kept = 1.0
        for axis, line in (
            ("along", shapely.LineString([(start - 1.0, right), (end + 1.0, right)])),
            ("across", shapely.LineString([(along, low - 1.0), (along, high + 1.0)])),
        ):
            before, after = _to_edges(line, treated, (along, right), 0 if axis == "along" else 1)
            sd, sure = budget.sd_m(axis), budget.sure_m(axis)
            if sd > 0.0:
                kept *= max(
                    chance.cdf((after - sure) / sd) - chance.cdf(-(before - sure) / sd), 0.0
                )
            elif min(before, after) < sure:
                kept = 0.0
        found[at] = 1.0 - kept
    return found


def _to_edges(
    line: shapely.LineString, treated: BaseGeometry, place: tuple[float, float], axis: int
) -> tuple[float, float]:
    """Return how far it is on a line from a place to the edges of the ground around it."""
    for part in shapely.get_parts(shapely.intersection(line, treated)):
        low, high = part.bounds[axis], part.bounds[axis + 2]
        if low - 1e-9 <= place[axis] <= high + 1e-9:
            return place[axis] - low, high - place[axis]
    return 0.0, 0.0


def pieces(
    found: Sequence[Opening], valve_edges_m: Floats, edges_m: Floats, lead_m: float
) -> list[tuple[float, float, float]]:
    """Return what is flown: (start, end, right) of each stretch on the middle of a pass.

    >>> some = [Opening(band=0, start_m=5.0, end_m=9.0), Opening(band=1, start_m=8.0, end_m=12.0)]
    >>> edges = np.array([0.0, 1.0, 2.0])
    >>> pieces(some, edges, np.array([0.0, 2.0]), 1.0)
    [(4.0, 13.0, 1.0)]
    """
    middle = 0.5 * (valve_edges_m[:-1] + valve_edges_m[1:])
    owner = np.clip(np.searchsorted(edges_m, middle) - 1, 0, len(edges_m) - 2)
    spans: dict[int, list[tuple[float, float]]] = {}
    for one in found:
        spans.setdefault(int(owner[one.band]), []).append(
            (one.start_m - lead_m, one.end_m + lead_m)
        )
    rows = []
    for number, (left, right) in enumerate(pairwise(edges_m.tolist())):
        for start, end in _joined(spans.get(number, [])):
            rows.append((start, end, 0.5 * (left + right)))
    return rows


def _joined(spans: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    found: list[tuple[float, float]] = []
    for start, end in sorted(spans):
        if found and start <= found[-1][1]:
            found[-1] = (found[-1][0], max(found[-1][1], end))
        else:
            found.append((start, end))
    return found
