"""The shortest way between two places that stays on ground which may be flown over.

A visibility graph: a shortest way bends only at corners that stick out into the free space.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.maps.local import as_area, polygons_of
from missions.fewer_corners import inside_with_fewer_corners
from missions.strips import Floats

# Ways bend this far from a corner, so that rounding does not put them behind it.
CLEAR_M, MITRE_LIMIT = 0.3, 2.0
# Places on the border count as inside.
TOUCH_M = 1e-6
# With more corners than these it is drawn simpler, inside of itself, up to the last tolerance.
CORNERS_MAX, SIMPLER_M = 300, (0.1, 0.2, 0.4, 0.8, 1.6)


def _corners(space: BaseGeometry) -> Floats:
    """Return the corners at which a way may have to bend."""
    inside = as_area(
        polygons_of(space.buffer(-CLEAR_M, join_style="mitre", mitre_limit=MITRE_LIMIT))
    )
    if inside is None:
        return np.empty((0, 2))
    found = _sticking_out(inside)
    for tolerance_m in SIMPLER_M:
        if len(found) <= CORNERS_MAX:
            break
        found = _sticking_out(inside_with_fewer_corners(inside, tolerance_m))
    return found


def _sticking_out(space: BaseGeometry) -> Floats:
    parts = shapely.orient_polygons(shapely.get_parts(space))
    found = [np.empty((0, 2))]
    for part in parts:
        for ring in (part.exterior, *part.interiors):
            points = shapely.get_coordinates(ring)[:-1]
            before, after = (
                points - np.roll(points, 1, axis=0),
                np.roll(points, -1, axis=0) - points,
            )
            turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
            found.append(points[turn < 0.0])  # inside is on the left: a right turn sticks out
    return np.concatenate(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeSpace:
    """Where one may fly; `between_m` are the ways between its corners."""

    space: BaseGeometry
    corners: Floats
    between_m: Floats
    next_corner: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    is_convex: bool

    def sees(self, starts: Floats, ends: Floats) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Return, for each pair, whether the straight way between them is free."""
        if self.is_convex:
            return np.ones(len(starts), dtype=np.bool_)
        straight = shapely.linestrings(np.stack([starts, ends], axis=1))
        return np.asarray(shapely.covers(self.space, straight), dtype=np.bool_)

    def to_corners_m(self, points: Floats) -> Floats:
        """Return the straight distance from every point to every corner that it sees."""
        count, corners = len(points), len(self.corners)
        if not corners or not count:
            return np.full((count, corners), math.inf)
        starts, ends = np.repeat(points, corners, axis=0), np.tile(self.corners, (count, 1))
        far_m = np.hypot(*(ends - starts).T)
        return np.where(self.sees(starts, ends), far_m, math.inf).reshape(count, corners)

    def way(
        self, start: tuple[float, float], end: tuple[float, float]
    ) -> list[tuple[float, float]]:
        """Return the places of the shortest way, both ends among them; nothing where none is."""
        ends = np.array([start, end])
        if bool(self.sees(ends[:1], ends[1:])[0]):
            return [start, end]
        reach = self.to_corners_m(ends)
        if not reach.size:
            return []
        total = reach[0][:, None] + self.between_m + reach[1][None, :]
        first, last = np.unravel_index(int(np.argmin(total)), total.shape)
        if not math.isfinite(total[first, last]):
            return []
        chain = [int(first)]
        while chain[-1] != last:
            chain.append(int(self.next_corner[chain[-1], last]))
        bends = [(float(x), float(y)) for x, y in self.corners[chain]]
        return [start, *bends, end]


def free_space(ground: BaseGeometry) -> FreeSpace:
    """Return the free space of a ground, whose border may be touched."""
    space = ground.buffer(TOUCH_M, join_style="mitre")
    is_convex = space.convex_hull.area - space.area < 1e-6 * space.area
    corners = np.empty((0, 2)) if is_convex else _corners(ground)
    shapely.prepare(space)
    count = len(corners)
    direct = FreeSpace(
        space=space, corners=corners, between_m=np.zeros((count, count)),
        next_corner=np.zeros((count, count), dtype=np.int64), is_convex=is_convex,
    ).to_corners_m(corners)  # fmt: skip
    between = np.full((count, count), math.inf)
    following = np.zeros((count, count), dtype=np.int64)
    for target in range(count):
        between[target], following[:, target] = _to_target(direct, target)
    return FreeSpace(
        space=space, corners=corners, between_m=between, next_corner=following,
        is_convex=is_convex,
    )  # fmt: skip


def _to_target(
    direct_m: Floats, target: int
) -> tuple[Floats, np.ndarray[tuple[int, ...], np.dtype[np.int64]]]:
    """Return the ways from all corners to one, and the next corner on each (Dijkstra)."""
    distance = np.full(len(direct_m), math.inf)
    following = np.full(len(direct_m), target, dtype=np.int64)
    distance[target] = 0.0
    heap = [(0.0, target)]
    while heap:
        far_m, corner = heapq.heappop(heap)
        if far_m > distance[corner]:
            continue
        through = far_m + direct_m[:, corner]
        for better in np.flatnonzero(through < distance - 1e-9).tolist():
            distance[better] = through[better]
            following[better] = corner
            heapq.heappush(heap, (float(through[better]), better))
    return distance, following
