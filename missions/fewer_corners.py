"""Areas drawn with fewer corners: within a tolerance, never beyond what they were; and fences.

A receiver that is carried around a field leaves a point every metre, each off by centimetres, and
a drawn tree is a circle of 64 corners. Passes along such borders would be as many. Here a border is
drawn anew with the fewest edges such that every edge has the border that it stands for on its
outer side, and none of it farther away than the tolerance: a shortest path over corners at
several depths inside of those given (Imai and Iri 1988, with one-sided tolerance).

Borders of fences go the other way: they hold all that they held, within ground that is allowed.
What was said above keeps near to a border everywhere. A fence only has to keep near to the field:
inside of it, bays and corners beside a way may be closed as far as that saves corners.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from missions.maps.local import Area, as_area, polygons_of
from missions.strips import Floats

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

# New corners lie so deep inside, in parts of the tolerance: 0 keeps a corner where it was drawn.
DEPTHS = np.array([0.0, 0.1, 0.25, 0.5, 0.75, 1.0])
# The border begins at its sharpest corner, as deep as the best of these.
STARTS = (0, 2)
# Of two borders with as many edges the one that gives less ground away; a corner more is worth
# as much as the ground along four edges in the middle of the tolerance.
DEPTH_COST = 0.125
# From so many corners at once as many points ahead are looked at, and then twice as many, to so
# many at once.
TOGETHER, AHEAD, AHEAD_MOST = 256, 8, 64
# Rings of nearly as many corners are drawn together, so many corners of them.
ROWS, ALIKE = 1024, 0.5
# Rounding of angles [rad]: 1e-9 is a micrometre over a kilometre. The caller keeps a margin.
ROUNDING = 1e-9
TURN = 2.0 * math.pi
# Where the whole tolerance leads to no border, it is made less, so many times.
LESS, TRIED_MAX = 0.6, 6
# With less it is the same place. An edge along a given corner is beyond it by the digits of its
# coordinates: it touches, and the caller's margin is a thousand times as wide.
SAME_M, TOUCH_M = 1e-4, 1e-6


def inside_with_fewer_corners(area: Area, tolerance_m: float) -> Area:
    """Return ground within the area, whose border keeps within the tolerance of the area's."""
    return each_inside([area], tolerance_m)[0]


def each_inside(areas: Sequence[Area], tolerance_m: float) -> list[Area]:
    """Return ground within each area, as `inside_with_fewer_corners` does; in less time."""
    parts = [polygons_of(area) for area in areas]
    every = [part for some in parts for part in some]
    shells = iter(_shells([part.exterior for part in every], tolerance_m, inwards=True))
    rings = [ring for part in every for ring in part.interiors]
    holes = iter(_shells(rings, tolerance_m, inwards=False))
    found = []
    for area, some in zip(areas, parts, strict=True):
        left = []
        for part in some:
            outer, inner = next(shells), list(islice(holes, len(part.interiors)))
            left += polygons_of(outer.difference(shapely.union_all(inner)) if inner else outer)
        found.append(as_area(left) or area)
    return found


def around_with_fewer_corners(area: BaseGeometry, tolerance_m: float) -> BaseGeometry:
    """Return ground that has all of the area in it, and its outer border within the tolerance.

    Ground that it encloses is given up: nobody flies there.
    """
    rings = [part.exterior for part in polygons_of(area)]
    found: BaseGeometry = shapely.union_all(_shells(rings, tolerance_m, inwards=False))
    return found


def _shells(
    rings: Sequence[shapely.LinearRing], tolerance_m: float, *, inwards: bool
) -> list[Polygon]:
    """Return the ground in each ring drawn with fewer corners, less of it or more."""
    given = [Polygon(ring) for ring in rings]
    points = [_points(ring, clockwise=not inwards) for ring in rings]
    found = list(given)
    left = list(range(len(rings)))
    for _ in range(TRIED_MAX if rings else 0):
        drawn = _rings([points[at] for at in left], tolerance_m)
        fitting = (
            _fitting(given[at], points[at], corners, tolerance_m, inwards=inwards)
            for at, corners in zip(left, drawn, strict=True)
        )
        tried, left = left, []
        for at, polygon in zip(tried, fitting, strict=True):
            if polygon is None:
                left.append(at)
            else:
                found[at] = polygon
        if not left:
            break
        # Borders that nearly touch, and corners like needles.
        tolerance_m *= LESS
    return found


def _fitting(
    given: Polygon, points: Floats, corners: Floats, tolerance_m: float, *, inwards: bool
) -> Polygon | None:
    """Return the ground in a ring of these corners, where it may stand for the one given."""
    if len(corners) < 3:
        return None
    drawn = Polygon(corners)
    if not (drawn.is_valid and _is_near(points, drawn, tolerance_m)):
        return None
    inner, outer = (drawn, given) if inwards else (given, drawn)
    return drawn if outer.buffer(TOUCH_M, join_style="mitre").covers(inner) else None


def _is_near(points: Floats, drawn: Polygon, tolerance_m: float) -> bool:
    far_m = shapely.distance(drawn.exterior, shapely.points(points))
    return bool(far_m.max() <= tolerance_m + SAME_M)


def _points(ring: shapely.LinearRing, *, clockwise: bool) -> Floats:
    """Return the corners of a ring once each, free ground to the left of it."""
    points = shapely.get_coordinates(ring)[:-1]
    if shapely.is_ccw(ring) == clockwise:
        points = points[::-1]
    far = np.hypot(*(points - points[_from(-1, len(points))]).T) > SAME_M
    kept: Floats = points[far]
    return kept


def _rings(rings: Sequence[Floats], tolerance_m: float) -> list[Floats]:
    """Return the corners of each ring with the fewest edges.

    Trees are many rings of nearly as many corners: those are drawn together, which takes a fraction
    of the time.
    """
    found = list(rings)
    left = sorted(
        (at for at, points in enumerate(rings) if len(points) > 4), key=lambda at: -len(rings[at])
    )
    while left:
        most = len(rings[left[0]])
        some = [
            at
            for at in left[: max(ROWS // min(most, TOGETHER), 1)]
            if len(rings[at]) >= ALIKE * most
        ]
        left = left[len(some) :]
        closed, inwards = zip(*(_from_sharpest(rings[at]) for at in some), strict=True)
        drawn = _cheapest(_Rings.of(closed, inwards, tolerance_m))
        for at, corners in zip(some, drawn, strict=True):
            found[at] = corners
    return found


def _from_sharpest(points: Floats) -> tuple[Floats, Floats]:
    """Return a closed ring from its sharpest corner on, and the way inside from each corner.

    Its start stays where a corner is.
    """
    edges = points[_from(1, len(points))] - points
    course = np.arctan2(edges[:, 1], edges[:, 0])
    turn = (course - course[_from(-1, len(points))] + math.pi) % (2.0 * math.pi) - math.pi
    start = int(np.argmax(np.abs(turn)))
    around = np.append(_from(start, len(points)), start)
    return points[around], _inwards(edges, turn)[around]


def _from(start: int, count: int) -> Ints:
    """Return the numbers of the corners of a ring from one of them on."""
    found: Ints = np.arange(start, start + count) % count
    return found


def _inwards(edges: Floats, turn: Floats) -> Floats:
    """Return the way from each corner to the place one metre inside of both of its edges."""
    unit = edges / np.hypot(*edges.T)[:, None]
    normal = np.column_stack([-unit[:, 1], unit[:, 0]])
    both = normal + normal[_from(-1, len(normal))]
    length = np.hypot(*both.T)
    mitre = 1.0 / np.maximum(np.cos(turn / 2.0), 1e-9)
    flat: Floats = np.where(
        length[:, None] > 1e-9, both / np.maximum(length, 1e-9)[:, None] * mitre[:, None], unit
    )
    return flat


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rings:
    """Closed rings with the places at which new corners may lie, by ring, corner and depth.

    One that has fewer corners than others stays at its last one, which is its first.
    """

    closed: Floats
    places: Floats
    counts: Ints
    tolerance_m: float

    @classmethod
    def of(cls, closed: Sequence[Floats], inwards: Sequence[Floats], tolerance_m: float) -> _Rings:
        counts = np.array([len(each) - 1 for each in closed])
        at = np.minimum(np.arange(counts.max() + 1), counts[:, None])
        corners = np.stack([each[some] for each, some in zip(closed, at, strict=True)])
        inside = np.stack([each[some] for each, some in zip(inwards, at, strict=True)])
        # The mitre of a sharp corner is cut off: no place is farther from its corner.
        steep = np.maximum(np.hypot(inside[..., 0], inside[..., 1]), 1.0)[..., None]
        deep = np.minimum(DEPTHS, 1.0 / steep) * tolerance_m
        places = corners[:, :, None, :] + inside[:, :, None, :] * deep[..., None]
        return cls(closed=corners, places=places, counts=counts, tolerance_m=tolerance_m)


# What leaves out the depths that are not in a set of them, for each set; a bit stands for each.
_BITS = np.array(1 << np.arange(len(DEPTHS)), dtype=np.uint8)
_SETS = 1 << len(DEPTHS)
_LEFT_OUT = np.where(np.arange(_SETS) & _BITS[:, None], 0.0, np.inf)
_EDGE = 1.0 + DEPTH_COST * DEPTHS


def _cheapest(rings: _Rings) -> list[Floats]:
    """Return the corners of the cheapest rings; where there is none, the corners given."""
    many, size, depths = len(rings.closed), rings.closed.shape[1], len(DEPTHS)
    # One row for each depth at which a ring may begin.
    cost = np.full((len(STARTS), many, size, depths), np.inf)
    cost[np.arange(len(STARTS)), :, 0, STARTS] = 0.0
    # Where the edge to each place begins: at which corner, and at one of which depths.
    before, from_set = np.zeros(cost.shape, dtype=np.int64), np.zeros(cost.shape, dtype=np.uint8)
    least = np.empty((len(STARTS), many * _SETS))
    for at, sets, row in _seen(rings):
        over = cost[:, :, at, :, None] + _LEFT_OUT
        np.minimum.reduce(over, axis=2, out=least.reshape(len(STARTS), many, _SETS))
        spent = least.take(row, axis=1, mode="clip")
        spent += _EDGE
        ends = slice(at + 1, at + 1 + sets.shape[1])
        better = spent < cost[:, :, ends] - 1e-12
        np.copyto(cost[:, :, ends], spent, where=better)
        np.copyto(before[:, :, ends], at, where=better)
        np.copyto(from_set[:, :, ends], sets, where=better)
    found = []
    for ring, count in enumerate(rings.counts.tolist()):
        cost_of = cost[np.arange(len(STARTS)), ring, count, STARTS]
        start = int(cost_of.argmin())
        if not math.isfinite(cost_of[start]):
            found.append(rings.closed[ring, :count])
            continue
        way = _chain(
            cost[start, ring], before[start, ring], from_set[start, ring], count, STARTS[start]
        )
        found.append(rings.places[ring, way[:, 0], way[:, 1]])
    return found


def _chain(cost: Floats, before: Ints, from_set: Bytes, corner: int, depth: int) -> Ints:
    """Return the corners and depths of a ring from its end back to its start, the start first."""
    found = list[tuple[int, int]]()
    while corner:
        one = int(before[corner, depth])
        spent = cost[one] + _EDGE[depth] + _LEFT_OUT[:, from_set[corner, depth]]
        corner, depth = one, int(spent.argmin())
        found.append((corner, depth))
    return np.array(found[::-1])


def _seen(rings: _Rings) -> Iterator[tuple[int, Bytes, Ints]]:
    """Yield each corner with the sets of depths from which edges to places ahead may begin.

    They are by ring, how many corners ahead an edge ends, and the depth there; once more as rows
    of a table with all sets of each ring.
    """
    many, size = rings.closed.shape[:2]
    own = _SETS * np.arange(many)[:, None, None, None]
    for first in range(0, size - 1, TOGETHER):
        starts = np.arange(first, min(first + TOGETHER, size - 1))
        sets = _ahead(rings, starts)
        sets = sets.reshape(many, len(starts), *sets.shape[1:])
        rows = sets + own
        is_end = sets.max(axis=(0, 3)) > 0
        farthest = sets.shape[2] - is_end[:, ::-1].argmax(axis=1)
        for at in np.flatnonzero(is_end.any(axis=1)).tolist():
            some = slice(farthest[at])
            yield first + at, sets[:, at, some], rows[:, at, some]


def _ahead(rings: _Rings, starts: Ints) -> Bytes:
    """Return from which depths of some corners edges to corners ahead may end at which depth.

    Corners of all rings are looked at together, the nearest first, as long as any of them is seen.
    """
    counts, size = rings.counts, rings.closed.shape[1]
    east_m, north_m = (rings.places[..., axis].reshape(-1, len(DEPTHS)) for axis in (0, 1))
    found = []
    ring, at = np.repeat(np.arange(len(counts)), len(starts)), np.tile(starts, len(counts))
    total = len(at)
    some = np.flatnonzero(at < counts[ring])
    ring, at = ring[some], at[some]
    onward = np.arctan2(*(rings.closed[ring, at + 1] - rings.closed[ring, at]).T[::-1])
    low = np.full((len(DEPTHS), len(at)), -math.inf)
    high = -low
    ahead, many = 1, AHEAD
    while len(at):
        ends = at[:, None] + np.arange(ahead, ahead + many)
        is_there = ends <= counts[ring, None]
        # Beyond the last corner it is looked at again: nothing comes after it.
        ends = np.minimum(ends, counts[ring, None])
        least, most = _sectors(rings, ring, at, ends, onward)
        least = np.maximum(np.maximum.accumulate(least, axis=2), low[:, :, None])
        most = np.minimum(np.minimum.accumulate(most, axis=2), high[:, :, None])
        sets = np.zeros((total, many, len(DEPTHS)), dtype=np.uint8)
        low_all, high_all = least - ROUNDING, most + ROUNDING
        # Courses are dear: they are asked for only where there are any that an edge may have.
        row, near = np.nonzero((low_all <= high_all).any(axis=0) & is_there)
        here, there = (ring * size + at)[row], (ring * size)[row] + ends[row, near]
        to_east_m, to_north_m = east_m.take(there, axis=0), north_m.take(there, axis=0)
        sets_of = np.zeros(to_east_m.shape, dtype=np.uint8)
        for depth, bit in enumerate(_BITS):
            east, north = (
                to_east_m - east_m[here, depth, None],
                to_north_m - north_m[here, depth, None],
            )
            course = _courses(east, north, onward[row, None])
            fits = course >= low_all[depth, row, near, None]
            fits &= course <= high_all[depth, row, near, None]
            fits &= east * east + north * north > SAME_M**2
            sets_of |= fits.view(np.uint8) * bit
        sets[some[row], near] = sets_of
        found.append(sets)
        ahead, many = ahead + many, min(2 * many, AHEAD_MOST)
        low, high = least[:, :, -1], most[:, :, -1]
        on = (low <= high).any(axis=0) & (at + ahead <= counts[ring])
        some, ring, at, onward = some[on], ring[on], at[on], onward[on]
        low, high = low[:, on], high[:, on]
    return np.concatenate(found, axis=1)


def _sectors(
    rings: _Rings, ring: Ints, at: Ints, ends: Ints, onward: Floats
) -> tuple[Floats, Floats]:
    """Return the courses that leave each point to the right, by the tolerance at most.

    They are by the depth of the start, the start, and the end.
    """
    points, starts = rings.closed[ring[:, None], ends], rings.places[ring, at].transpose(2, 1, 0)
    east_m, north_m = (points[..., axis] - starts[axis, ..., None] for axis in (0, 1))
    course = _courses(east_m, north_m, onward[:, None])
    far_m = np.sqrt(east_m * east_m + north_m * north_m)
    wide = np.where(
        far_m <= rings.tolerance_m,
        math.pi,
        np.arcsin(np.minimum(rings.tolerance_m / np.maximum(far_m, 1e-12), 1.0)),
    )
    is_same = far_m <= SAME_M
    return (
        np.where(is_same, -math.inf, course),
        np.where(is_same, math.inf, course + wide),
    )


def _courses(east_m: Floats, north_m: Floats, onward: Floats) -> Floats:
    """Return the course of ways, from the course onward."""
    course: Floats = np.arctan2(north_m, east_m) - onward + math.pi
    # The remainder of two half turns, in a fraction of its time.
    course += TURN * ((course < 0.0) * 1.0 - (course >= TURN))
    return course - math.pi


# Smaller ground is rounding: it is not looked at whether that is allowed.
LEAST_M2 = 1e-9


def with_corners(border: Polygon, allowed: BaseGeometry, most: int) -> Polygon:
    """Return a border around all of another one with so many corners, or as few as it takes."""
    return FewerAndFewer(border, allowed).with_corners(most)


class FewerAndFewer:
    """Borders around all of another one, each with one corner less than the one before.

    A corner inwards is left out, or an edge whose neighbours then meet farther out, whichever adds
    least ground; what is added lies within `allowed`. They are drawn as far as they are asked for.
    """

    def __init__(self, border: Polygon, allowed: BaseGeometry) -> None:
        shapely.prepare(allowed)
        self._allowed = allowed
        self._drawn = [shapely.get_coordinates(orient(Polygon(border.exterior)).exterior)[:-1]]

    def with_corners(self, most: int) -> Polygon:
        """Return the first border with so many corners, or the last one that there is."""
        while len(self._drawn[-1]) > max(most, 3):
            fewer = self._next(self._drawn[-1])
            if fewer is None:
                break
            self._drawn.append(fewer)
        fits = (points for points in self._drawn if len(points) <= max(most, 3))
        return Polygon(next(fits, self._drawn[-1]))

    def _next(self, points: Floats) -> Floats | None:
        for fewer, added in _steps(points):
            if Polygon(fewer).is_valid and (added.area <= LEAST_M2 or self._allowed.covers(added)):
                return fewer
        return None


def _steps(points: Floats) -> Iterator[tuple[Floats, Polygon]]:
    """Yield the borders with one corner less and the ground that each adds, the least first."""
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    turn = _cross(points - before, after - points)
    inwards = np.flatnonzero(turn <= 0.0)
    edges, met = _meeting(points, turn)
    triangles = np.concatenate(
        [
            np.stack([before[inwards], points[inwards], after[inwards]], axis=1),
            np.stack([points[edges], met, after[edges]], axis=1),
        ]
    )
    grounds = np.asarray(shapely.polygons(triangles))
    for at in np.argsort(shapely.area(grounds), kind="stable").tolist():
        if at < len(inwards):
            yield np.delete(points, inwards[at], axis=0), grounds[at]
            continue
        edge = int(edges[at - len(inwards)])
        fewer = points.copy()
        fewer[edge] = met[at - len(inwards)]
        yield np.delete(fewer, (edge + 1) % len(points), axis=0), grounds[at]


def _meeting(points: Floats, turn: Floats) -> tuple[Ints, Floats]:
    """Return edges between two outward corners, and where the edges beside each meet beyond it."""
    edges = np.flatnonzero((turn > 0.0) & (np.roll(turn, -1) > 0.0))
    start, end = points[edges], np.roll(points, -1, axis=0)[edges]
    one = start - np.roll(points, 1, axis=0)[edges]
    other = end - np.roll(points, -2, axis=0)[edges]
    sine, across = _cross(one, other), end - start
    flat = np.abs(sine) < 1e-9 * np.hypot(*one.T) * np.hypot(*other.T)
    sine = np.where(flat, 1.0, sine)
    on_one, on_other = _cross(across, other) / sine, _cross(across, one) / sine
    meets = ~flat & (on_one > 0.0) & (on_other > 0.0)
    found: Floats = (start + one * on_one[:, None])[meets]
    return edges[meets], found


def _cross(one: Floats, other: Floats) -> Floats:
    found: Floats = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    return found
