"""The shortest way between two places that stays on ground which may be flown over.

A visibility graph: a shortest way bends only at corners that stick out into the free space.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from missions.fewer_corners import inside_with_fewer_corners
from missions.maps.local import as_area, polygons_of
from missions.strips import Floats

# Ways bend this far from a corner, so that rounding does not put them behind it.
CLEAR_M, MITRE_LIMIT = 0.3, 2.0
# Places on the border count as inside, and ends of lines a little outside (`NARROWER_M`).
TOUCH_M = 2e-5
# Ways as long as each other, but for rounding.
SAME_M = 1e-6
# With more corners than these it is drawn simpler, inside of itself, up to the last tolerance.
CORNERS_MAX, SIMPLER_M = 300, (0.4, 1.6)
# Free sight is looked for to so many of the nearest corners, and to all where that is no way.
NEAREST = 40
# Of two ways of one length the one over fewer stations.
STATION_M = 1e-9
# Rows of a table of ways are worked on together, so many: they stay in the processor's cache.
TOGETHER = 64
# Of so many places at once ways to corners are looked at.
POINTS_TOGETHER = 512
# Of a way so many corners are looked at first, those that lie least aside.
FIRST = 24
# Around one straight line so many corners are looked at, those that lie least aside.
ASIDE = 60
# Of so many ways and more, those that lead through cells outside are left out first: looking at so
# many places of each takes a fifth of the time. So many cells lie side by side.
MANY, PLACES, CELLS, ROUND_M = 256, 7, 96, 1e-6


Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]
Bools = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
Place = tuple[float, float]


def _corners(space: BaseGeometry) -> tuple[Floats, Ints]:
    """Return the corners at which a way may have to bend, and the ring of each."""
    inside = as_area(
        polygons_of(space.buffer(-CLEAR_M, join_style="mitre", mitre_limit=MITRE_LIMIT))
    )
    if inside is None:
        return np.empty((0, 2)), np.empty(0, dtype=np.int64)
    found = _sticking_out(inside)
    for tolerance_m in SIMPLER_M:
        if len(found[0]) <= CORNERS_MAX:
            break
        found = _sticking_out(inside_with_fewer_corners(inside, tolerance_m))
    return found


def _sticking_out(space: BaseGeometry) -> tuple[Floats, Ints]:
    parts = shapely.orient_polygons(shapely.get_parts(space))
    found, ring_of = [np.empty((0, 2))], [np.empty(0, dtype=np.int64)]
    for part in parts:
        for ring in (part.exterior, *part.interiors):
            points = shapely.get_coordinates(ring)[:-1]
            before, after = (
                points - np.roll(points, 1, axis=0),
                np.roll(points, -1, axis=0) - points,
            )
            turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
            some = points[turn < 0.0]  # inside is on the left: a right turn sticks out
            found.append(some)
            ring_of.append(np.full(len(some), len(found), dtype=np.int64))
    return np.concatenate(found), np.concatenate(ring_of)


@dataclass(frozen=True, slots=True, kw_only=True)
class FreeSpace:
    """Where one may fly; `between_m` are ways between its corners, nearly the shortest.

    `direct_m` are the straight ones of them, infinite where there is none.
    """

    space: BaseGeometry
    corners: Floats
    direct_m: Floats
    between_m: Floats
    is_convex: bool

    def sees(self, starts: Floats, ends: Floats) -> Bools:
        """Return, for each pair, whether the straight way between them is free."""
        found: Bools = np.ones(len(starts), dtype=np.bool_)
        if self.is_convex or not len(starts):
            return found
        if len(starts) >= MANY:
            found = ~_cells_outside(self.space).are_crossed(starts, ends)
            starts, ends = starts[found], ends[found]
        straight = shapely.linestrings(np.stack([starts, ends], axis=1))
        # The border lies `TOUCH_M` outside: no end is on it, and this answers in a third of the
        # time that `covers` takes.
        found[found] = shapely.contains_properly(self.space, straight)
        return found

    def to_corners_m(self, points: Floats, *, nearest: int | None = NEAREST) -> Floats:
        """Return the straight distance from every point to its nearest corners that it sees.

        With `nearest` None all corners are looked at; infinite stands for those that are not seen.
        """
        found = np.full((len(points), len(self.corners)), math.inf)
        if not len(self.corners):
            return found
        # Some at a time: what is computed on the way stays small.
        for first in range(0, len(points), POINTS_TOGETHER):
            some = slice(first, first + POINTS_TOGETHER)
            found[some] = self._some_to_corners_m(points[some], nearest)
        return found

    def _some_to_corners_m(self, points: Floats, nearest: int | None) -> Floats:
        count, corners = len(points), len(self.corners)
        found = np.full((count, corners), math.inf)
        far_m = np.hypot(
            points[:, 0][:, None] - self.corners[:, 0][None, :],
            points[:, 1][:, None] - self.corners[:, 1][None, :],
        )
        if nearest is None or nearest >= corners:
            rows, columns = np.divmod(np.arange(count * corners), corners)
        else:
            near = np.argpartition(far_m, nearest, axis=1)[:, :nearest]
            rows, columns = np.repeat(np.arange(count), nearest), near.ravel()
        seen = self.sees(points[rows], self.corners[columns])
        rows, columns = rows[seen], columns[seen]
        found[rows, columns] = far_m[rows, columns]
        return found

    def way(self, start: Place, end: Place) -> list[Place]:
        """Return the places of the shortest way, both ends among them; nothing where none is."""
        ends = np.array([start, end])
        if bool(self.sees(ends[:1], ends[1:])[0]):
            return [start, end]
        found, _ = self._over_corners(start, end)
        return self._straightened(ends, found) if found else []

    def around_m(self, start: Place, end: Place) -> float:
        """Return the way between two places that do not see each other; infinite without one."""
        return self._over_corners(start, end)[1]

    def _over_corners(self, start: Place, end: Place) -> tuple[list[int], float]:
        """Return the corners of the shortest way, and its length.

        Corners are looked at by how far aside they lie: no way over one is shorter than that.
        """
        if not len(self.corners):
            return [], math.inf
        from_m = np.hypot(*(self.corners - start).T)
        to_m = np.hypot(*(self.corners - end).T)
        aside_m = from_m + to_m
        order = np.argsort(aside_m, kind="stable")
        count = FIRST
        while True:
            some = order[:count]
            total_m = self.between_m[np.ix_(some, some)] + from_m[some, None] + to_m[some]
            row, column, length_m = self._in_sight(start, end, some, total_m)
            if count >= len(order) or length_m <= aside_m[order[count]]:
                break
            count *= 4
        if not math.isfinite(length_m):
            return [], math.inf
        chain, last = [int(some[row])], int(some[column])
        while chain[-1] != last:
            over = self.direct_m[chain[-1]] + self.between_m[:, last]
            chain.append(int(np.argmin(over)))
        return chain, length_m

    def _in_sight(
        self, start: Place, end: Place, some: Ints, total_m: Floats
    ) -> tuple[int, int, float]:
        """Return the first and last corner of the shortest of these ways that are both seen."""
        places = self.corners[some]
        total_m[~self.sees(np.tile(start, (len(some), 1)), places)] = np.inf
        total_m[:, ~self.sees(np.tile(end, (len(some), 1)), places)] = np.inf
        pair = divmod(int(np.argmin(total_m)), len(some))
        return (*pair, float(total_m[pair]))

    def _straightened(self, ends: Floats, chain: list[int]) -> list[Place]:
        """Return the shortest way over the corners that lie no farther aside than this one."""
        known = np.concatenate([ends[:1], self.corners[chain], ends[1:]])
        known_m = float(np.hypot(*np.diff(known, axis=0).T).sum())
        aside_m = np.hypot(*(self.corners - ends[0]).T) + np.hypot(*(self.corners - ends[1]).T)
        some = np.argsort(aside_m, kind="stable")[:ASIDE]
        some = np.union1d(some[aside_m[some] < known_m], chain)
        places = np.concatenate([ends[:1], self.corners[some], ends[1:]])
        rows, columns = np.triu_indices(len(places), 1)
        far_m = np.hypot(*(places[:, None] - places[None, :]).transpose(2, 0, 1))
        # No other can be part of a shorter way.
        bound_m = np.minimum(
            far_m[0, rows] + far_m[columns, -1], far_m[0, columns] + far_m[rows, -1]
        )
        some = np.flatnonzero(bound_m + far_m[rows, columns] <= known_m + SAME_M)
        rows, columns = rows[some], columns[some]
        seen = self.sees(places[rows], places[columns])
        rows, columns = rows[seen], columns[seen]
        direct = np.full(far_m.shape, math.inf)
        direct[rows, columns] = direct[columns, rows] = far_m[rows, columns]
        return [(float(x), float(y)) for x, y in places[_one_way(direct)]]


class _CellsOutside:
    """Cells of a grid over some ground that lie outside of it as a whole."""

    def __init__(self, ground: BaseGeometry) -> None:
        west, south, east, north = ground.bounds
        self._origin = np.array([west, south])
        self._wide_m = max(east - west, north - south) / CELLS
        x, y = np.meshgrid(*(self._origin[:, None] + np.arange(CELLS) * self._wide_m))
        far_m = self._wide_m + ROUND_M
        cells = shapely.box(x - ROUND_M, y - ROUND_M, x + far_m, y + far_m)
        self._are_outside = np.asarray(shapely.disjoint(ground, cells), dtype=np.bool_)

    def are_crossed(self, starts: Floats, ends: Floats) -> Bools:
        """Return which straight ways have a place in such a cell: none of them is free."""
        found = np.zeros(len(starts), dtype=np.bool_)
        start, way = (starts - self._origin) / self._wide_m, (ends - starts) / self._wide_m
        for share in (np.arange(PLACES) + 1.0) / (PLACES + 1.0):
            column, row = np.clip(start + way * share, 0, CELLS - 1).astype(np.int64).T
            found |= self._are_outside[row, column]
        return found


@lru_cache(maxsize=4)
def _cells_outside(ground: BaseGeometry) -> _CellsOutside:
    return _CellsOutside(ground)


def _one_way(direct: Floats) -> list[int]:
    """Return the stations of the shortest way from the first to the last (Dijkstra, 1959)."""
    last = len(direct) - 1
    before = np.zeros(len(direct), dtype=np.int64)
    reached, waiting = np.full(len(direct), math.inf), np.zeros(len(direct))
    reached[0] = 0.0
    while True:
        station = int(np.argmin(reached + waiting))
        if station == last:
            break
        waiting[station] = math.inf
        through = reached[station] + direct[station] + STATION_M
        better = through < reached
        reached[better] = through[better]
        before[better] = station
    way = [last]
    while way[-1]:
        way.append(int(before[way[-1]]))
    return way[::-1]


def free_space(ground: BaseGeometry) -> FreeSpace:
    """Return the free space of a ground, whose border may be touched."""
    space = ground.buffer(TOUCH_M, join_style="mitre")
    is_convex = space.convex_hull.area - space.area < 1e-6 * space.area
    corners, rings = (
        (np.empty((0, 2)), np.empty(0, dtype=np.int64)) if is_convex else _corners(ground)
    )
    shapely.prepare(space)
    none = np.zeros((len(corners), len(corners)))
    found = FreeSpace(
        space=space, corners=corners, direct_m=none, between_m=none, is_convex=is_convex
    )
    if not len(corners):
        return found
    direct = found.to_corners_m(corners)
    _see(found, direct, *_neighbours(rings))
    between = _shortest(_both_ways(direct))
    # Islands of corners that are near to each other alone.
    rows, columns = np.nonzero(np.triu(np.isinf(between)))
    if len(rows) and _see(found, direct, rows, columns):
        between = _shortest(_both_ways(direct))
    return replace(found, direct_m=_both_ways(direct), between_m=between)


def _both_ways(direct: Floats) -> Floats:
    """Return the ways that are seen from either end."""
    found: Floats = np.minimum(direct, direct.T)
    np.fill_diagonal(found, math.inf)
    return found


def _neighbours(rings: Ints) -> tuple[Ints, Ints]:
    """Return each corner with the next one of its ring: there is mostly a way between them."""
    at = np.arange(len(rings))
    following = at + 1
    is_last = np.append(rings[1:] != rings[:-1], True)
    first = np.searchsorted(rings, rings)
    following[is_last] = first[is_last]
    return at, following


def _see(space: FreeSpace, direct: Floats, rows: Ints, columns: Ints) -> bool:
    """Add the straight ways of pairs of corners that see each other; return whether any does."""
    corners = space.corners
    seen = space.sees(corners[rows], corners[columns])
    rows, columns = rows[seen], columns[seen]
    direct[rows, columns] = np.hypot(*(corners[rows] - corners[columns]).T)
    return bool(len(rows))


def _shortest(direct_m: Floats) -> Floats:
    """Return the lengths of the shortest ways over any stations (Floyd, 1962).

    They are the same both ways: only the part beyond the diagonal is worked on, rows together.
    """
    count = len(direct_m)
    between = direct_m.copy()
    np.fill_diagonal(between, 0.0)
    # Each part lies together in memory: so it takes little more than half of the time.
    parts = [
        (start, between[start : start + TOGETHER, start:].copy())
        for start in range(0, count, TOGETHER)
    ]
    through = np.empty(TOGETHER * count)
    for station in range(count):
        block, row = divmod(station, TOGETHER)
        above = [part[:, station - start] for start, part in parts[:block]]
        to = np.concatenate([*above, parts[block][1][row]])
        on = to + STATION_M
        for start, part in parts:
            over = through[: part.size].reshape(part.shape)
            np.add.outer(to[start : start + len(part)], on[start:], out=over)
            np.minimum(part, over, out=part)
    for start, part in parts:
        between[start : start + len(part), start:] = part
    whole: Floats = np.where(np.tri(count, dtype=np.bool_), between.T, between)
    return whole
