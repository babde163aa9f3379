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
Bools = NDArray[np.bool_]

# New corners lie so deep inside, in parts of the tolerance: 0 keeps a corner where it was drawn.
DEPTHS = np.array([0.0, 0.1, 0.25, 0.5, 0.75, 1.0])
# The border begins at its sharpest corner, as deep as the best of these.
STARTS = (0, 2)
# Of two borders with as many edges the one that gives less ground away; a corner more is worth
# as much as the ground along four edges in the middle of the tolerance.
DEPTH_COST = 0.125
# From so many corners at once as many points ahead are looked at, and then twice as many.
TOGETHER, AHEAD = 64, 8
# Rings of as many corners are drawn together, so many corners of them.
ROWS = 512
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
    for _ in range(TRIED_MAX):
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
    far = np.hypot(*(points - np.roll(points, 1, axis=0)).T) > SAME_M
    kept: Floats = points[far]
    return kept


def _rings(rings: Sequence[Floats], tolerance_m: float) -> list[Floats]:
    """Return the corners of each ring with the fewest edges.

    Trees are many rings of as many corners: those are drawn together, which takes a fraction of
    the time.
    """
    found = list(rings)
    alike: dict[int, list[int]] = {}
    for at, points in enumerate(rings):
        if len(points) > 4:
            alike.setdefault(len(points), []).append(at)
    for count, each in alike.items():
        many = max(ROWS // min(count, TOGETHER), 1)
        for first in range(0, len(each), many):
            some = each[first : first + many]
            closed, inwards = zip(*(_from_sharpest(rings[at]) for at in some), strict=True)
            drawn = _cheapest(np.stack(closed), np.stack(inwards), tolerance_m)
            for at, corners in zip(some, drawn, strict=True):
                found[at] = corners
    return found


def _from_sharpest(points: Floats) -> tuple[Floats, Floats]:
    """Return a closed ring from its sharpest corner on, and the way inside from each corner.

    Its start stays where a corner is.
    """
    edges = np.roll(points, -1, axis=0) - points
    course = np.arctan2(edges[:, 1], edges[:, 0])
    turn = (course - np.roll(course, 1) + math.pi) % (2.0 * math.pi) - math.pi
    start = int(np.argmax(np.abs(turn)))
    points, turn, edges = (np.roll(each, -start, axis=0) for each in (points, turn, edges))
    inwards = _inwards(edges, turn)
    return np.vstack([points, points[:1]]), np.vstack([inwards, inwards[:1]])


def _inwards(edges: Floats, turn: Floats) -> Floats:
    """Return the way from each corner to the place one metre inside of both of its edges."""
    unit = edges / np.hypot(*edges.T)[:, None]
    normal = np.column_stack([-unit[:, 1], unit[:, 0]])
    both = normal + np.roll(normal, 1, axis=0)
    length = np.hypot(*both.T)
    mitre = 1.0 / np.maximum(np.cos(turn / 2.0), 1e-9)
    flat: Floats = np.where(
        length[:, None] > 1e-9, both / np.maximum(length, 1e-9)[:, None] * mitre[:, None], unit
    )
    return flat


def _cheapest(closed: Floats, inwards: Floats, tolerance_m: float) -> list[Floats]:
    """Return the corners of the cheapest rings; where there is none, the corners given."""
    rings, count, depths = len(closed), closed.shape[1] - 1, len(DEPTHS)
    # The mitre of a sharp corner is cut off: no place is farther from its corner.
    steep = np.maximum(np.hypot(inwards[..., 0], inwards[..., 1]), 1.0)[..., None]
    deep = np.minimum(DEPTHS, 1.0 / steep) * tolerance_m
    places = closed[:, :, None, :] + inwards[:, :, None, :] * deep[..., None]
    # One row for each depth at which a ring may begin.
    cost = np.full((rings, len(STARTS), count + 1, depths), np.inf)
    cost[:, np.arange(len(STARTS)), 0, STARTS] = 0.0
    before = np.full(cost.shape, -1, dtype=np.int64)
    for at, edges in _seen(closed, places, tolerance_m):
        spent = edges[:, None] + cost[:, :, at, :, None, None]
        least = spent.min(axis=2)
        ends = slice(at + 1, at + 1 + edges.shape[2])
        better = least < cost[:, :, ends] - 1e-12
        if better.any():
            np.copyto(cost[:, :, ends], least, where=better)
            np.copyto(before[:, :, ends], at * depths + spent.argmin(axis=2), where=better)
    cost_of = cost[:, np.arange(len(STARTS)), count, STARTS]
    found = []
    for ring, row in enumerate(cost_of.argmin(axis=1).tolist()):
        if not math.isfinite(cost_of[ring, row]):
            found.append(closed[ring, :-1])
            continue
        node, chain = count * depths + STARTS[row], list[int]()
        while node >= depths or not chain:
            node = int(before[ring, row].flat[node])
            chain.append(node)
        found.append(places[ring].reshape(-1, 2)[chain[::-1]])
    return found


def _seen(closed: Floats, places: Floats, tolerance_m: float) -> Iterator[tuple[int, Floats]]:
    """Yield each corner with what edges from it to places ahead cost, infinite where none may be.

    It is by ring, the depth of its start, how many corners ahead it ends, and the depth there.
    """
    rings, count = len(closed), closed.shape[1] - 1
    edge = 1.0 + DEPTH_COST * DEPTHS
    for first in range(0, count, TOGETHER):
        starts = np.arange(first, min(first + TOGETHER, count))
        possible = _ahead(closed, places, starts, tolerance_m)
        possible = possible.reshape(rings, len(starts), *possible.shape[1:])
        beyond = starts[:, None] + np.arange(possible.shape[3]) >= count
        is_end = possible.any(axis=(0, 2, 4)) & ~beyond
        farthest = possible.shape[3] - is_end[:, ::-1].argmax(axis=1)
        costs = np.where(possible, edge, np.inf)
        for at in np.flatnonzero(is_end.any(axis=1)).tolist():
            yield first + at, costs[:, at, :, : farthest[at]]


def _ahead(closed: Floats, places: Floats, starts: Ints, tolerance_m: float) -> Bools:
    """Return from which depths of some corners edges to corners ahead may end at which depth.

    Corners of all rings are looked at together, the nearest first, as long as any of them is seen.
    """
    rings, count = len(closed), closed.shape[1] - 1
    found = []
    ring, at = np.repeat(np.arange(rings), len(starts)), np.tile(starts, rings)
    some = np.arange(len(at))
    total = len(at)
    onward = np.arctan2(*(closed[ring, at + 1] - closed[ring, at]).T[::-1])
    low = np.full((len(at), len(DEPTHS)), -math.inf)
    high = -low
    ahead, many = 1, AHEAD
    while len(at):
        # Beyond the last corner it is looked at again: nothing comes after it.
        ends = np.minimum(at[:, None] + np.arange(ahead, ahead + many), count)
        least, most = _sectors(closed[ring[:, None], ends], places[ring, at], onward, tolerance_m)
        least = np.maximum(np.maximum.accumulate(least, axis=2), low[:, :, None])
        most = np.minimum(np.minimum.accumulate(most, axis=2), high[:, :, None])
        possible = np.zeros((total, *least.shape[1:], len(DEPTHS)), dtype=np.bool_)
        # Courses are dear: they are asked for only where there are any that an edge may have.
        row, depth, end = np.nonzero(least - ROUNDING <= most + ROUNDING)
        low_some, high_some = least[row, depth, end, None], most[row, depth, end, None]
        course, far_m = _courses(
            places[ring[row], ends[row, end]],
            places[ring[row], at[row], depth, None],
            onward[row, None],
        )
        possible[some[row], depth, end] = (
            (course >= low_some - ROUNDING) & (course <= high_some + ROUNDING) & (far_m > SAME_M)
        )
        found.append(possible)
        ahead, many = ahead + many, 2 * many
        low, high = least[:, :, -1], most[:, :, -1]
        on = (low <= high).any(axis=1) & (at + ahead <= count)
        some, ring, at = some[on], ring[on], at[on]
        onward, low, high = onward[on], low[on], high[on]
    return np.concatenate(found, axis=2)


def _sectors(
    points: Floats, starts: Floats, onward: Floats, tolerance_m: float
) -> tuple[Floats, Floats]:
    """Return the courses that leave each point to the right, by the tolerance at most."""
    course, far_m = _courses(points[:, None], starts[:, :, None], onward[:, None, None])
    wide = np.where(
        far_m <= tolerance_m,
        math.pi,
        np.arcsin(np.minimum(tolerance_m / np.maximum(far_m, 1e-12), 1.0)),
    )
    is_same = far_m <= SAME_M
    return (
        np.where(is_same, -math.inf, course),
        np.where(is_same, math.inf, course + wide),
    )


def _courses(points: Floats, starts: Floats, onward: Floats) -> tuple[Floats, Floats]:
    """Return the course to points from starts, from the course onward, and how far they are."""
    way = points - starts
    east_m, north_m = way[..., 0], way[..., 1]
    course = np.arctan2(north_m, east_m) - onward + math.pi
    # The remainder of two half turns, in a fraction of its time.
    course += TURN * ((course < 0.0) * 1.0 - (course >= TURN))
    return course - math.pi, np.hypot(east_m, north_m)


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
