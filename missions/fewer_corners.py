"""Areas drawn with fewer corners, never beyond what they were: within a tolerance, inwards only.

A receiver that is carried around a field leaves a point every metre, each off by centimetres, and
a drawn tree is a circle of 64 corners. Passes along such borders would be as many. Here a border is
drawn anew with the fewest edges such that every edge has the border that it stands for on its
outer side, and none of it farther away than the tolerance: a shortest path over corners at
several depths inside of those given (Imai and Iri 1988, with one-sided tolerance).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from companion.maps.local import Area, as_area, polygons_of
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
# So many points ahead are looked at together at first, and then twice as many.
AHEAD = 8
# Rounding of angles [rad]: 1e-9 is a micrometre over a kilometre. The caller keeps a margin.
ROUNDING = 1e-9
# Where the whole tolerance leads to no border, it is made less, so many times.
LESS, TRIED_MAX = 0.6, 6
# With less it is the same place.
SAME_M = 1e-4


def inside_with_fewer_corners(area: Area, tolerance_m: float) -> Area:
    """Return ground within the area, whose border keeps within the tolerance of the area's."""
    left = []
    for part in polygons_of(area):
        outer = _shell(part.exterior, tolerance_m, inwards=True)
        holes = [_shell(ring, tolerance_m, inwards=False) for ring in part.interiors]
        left += polygons_of(outer.difference(shapely.union_all(holes)) if holes else outer)
    return as_area(left) or area


def around_with_fewer_corners(area: BaseGeometry, tolerance_m: float) -> BaseGeometry:
    """Return ground that has all of the area in it, and its outer border within the tolerance.

    Ground that it encloses is given up: nobody flies there.
    """
    drawn = [_shell(part.exterior, tolerance_m, inwards=False) for part in polygons_of(area)]
    found: BaseGeometry = shapely.union_all(drawn)
    return found


def _shell(ring: shapely.LinearRing, tolerance_m: float, *, inwards: bool) -> Polygon:
    """Return the ground in a ring drawn with fewer corners, less of it or more."""
    given, points = Polygon(ring), _points(ring, clockwise=not inwards)
    for _ in range(TRIED_MAX):
        corners = _ring(points, tolerance_m)
        if len(corners) >= 3:
            drawn = Polygon(corners)
            if drawn.is_valid and _is_near(points, drawn, tolerance_m):
                inner, outer = (drawn, given) if inwards else (given, drawn)
                if outer.covers(inner):
                    return drawn
        # Borders that nearly touch, and corners like needles.
        tolerance_m *= LESS
    return given


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


def _ring(points: Floats, tolerance_m: float) -> Floats:
    """Return the corners of the ring with the fewest edges; its start stays where a corner is."""
    if len(points) <= 4:
        return points
    edges = np.roll(points, -1, axis=0) - points
    course = np.arctan2(edges[:, 1], edges[:, 0])
    turn = (course - np.roll(course, 1) + math.pi) % (2.0 * math.pi) - math.pi
    start = int(np.argmax(np.abs(turn)))
    points, turn, edges = (np.roll(each, -start, axis=0) for each in (points, turn, edges))
    inwards = _inwards(edges, turn)
    closed = np.vstack([points, points[:1]])
    inwards = np.vstack([inwards, inwards[:1]])
    tried = [_path(closed, inwards, tolerance_m, depth) for depth in STARTS]
    return min(tried, key=lambda found: found[0])[1]


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


def _path(
    closed: Floats, inwards: Floats, tolerance_m: float, first_depth: int
) -> tuple[float, Floats]:
    """Return the cost and the corners of the cheapest ring that begins at this depth."""
    count, depths = len(closed) - 1, len(DEPTHS)
    # The mitre of a sharp corner is cut off: no place is farther from its corner.
    steep = np.maximum(np.hypot(*inwards.T), 1.0)[:, None]
    deep = np.minimum(DEPTHS[None, :], 1.0 / steep) * tolerance_m
    places = closed[:, None, :] + inwards[:, None, :] * deep[:, :, None]
    cost = np.full((count + 1, depths), np.inf)
    cost[0, first_depth] = 0.0
    before = np.full((count + 1, depths), -1, dtype=np.int64)
    for at in range(count):
        known = np.flatnonzero(np.isfinite(cost[at]))
        if not len(known):
            continue
        for ends, possible in _seen(closed, places, at, known, tolerance_m):
            spent = 1.0 + DEPTH_COST * DEPTHS[None, None, :] + cost[at, known][:, None, None]
            spent = np.where(possible, spent, np.inf)
            which = np.argmin(spent, axis=0)
            least = np.take_along_axis(spent, which[None], axis=0)[0]
            better = least < cost[ends] - 1e-12
            cost[ends] = np.where(better, least, cost[ends])
            before[ends] = np.where(better, at * depths + known[which], before[ends])
    node = count * depths + first_depth
    if not math.isfinite(cost[count, first_depth]):
        return math.inf, closed[:-1]
    chain: list[int] = []
    while node >= depths or not chain:
        node = int(before[divmod(node, depths)])
        chain.append(node)
    found: Floats = places.reshape(-1, 2)[chain[::-1]]
    return float(cost[count, first_depth]), found


def _seen(
    closed: Floats, places: Floats, at: int, known: Ints, tolerance_m: float
) -> Iterator[tuple[Ints, Bools]]:
    """Yield runs of corners ahead, and which of their places an edge from here may end at."""
    count = len(closed) - 1
    starts = places[at, known]
    onward = math.atan2(*(closed[at + 1] - closed[at])[::-1])
    low, high = np.full(len(known), -math.inf), np.full(len(known), math.inf)
    first, ahead = at + 1, AHEAD
    while first <= count:
        ends = np.arange(first, min(first + ahead, count + 1))
        first, ahead = first + ahead, 2 * ahead
        least, most = _sectors(closed[ends], starts, onward, tolerance_m)
        least = np.maximum(np.maximum.accumulate(least, axis=1), low[:, None])
        most = np.minimum(np.minimum.accumulate(most, axis=1), high[:, None])
        course, far_m = _courses(places[ends][None], starts[:, None, None, :], onward)
        possible = (course >= least[:, :, None] - ROUNDING) & (
            course <= most[:, :, None] + ROUNDING
        )
        possible &= far_m > SAME_M
        yield ends, possible
        low, high = least[:, -1], most[:, -1]
        if not (low <= high).any():
            return


def _sectors(
    points: Floats, starts: Floats, onward: float, tolerance_m: float
) -> tuple[Floats, Floats]:
    """Return the courses that leave each point to the right, by the tolerance at most."""
    course, far_m = _courses(points[None], starts[:, None, :], onward)
    is_near = far_m <= tolerance_m
    wide = np.where(
        is_near, math.pi, np.arcsin(np.minimum(tolerance_m / np.maximum(far_m, 1e-12), 1.0))
    )
    is_same = far_m <= SAME_M
    return (
        np.where(is_same, -math.inf, course),
        np.where(is_same, math.inf, course + wide),
    )


def _courses(points: Floats, starts: Floats, onward: float) -> tuple[Floats, Floats]:
    """Return the course to points from starts, from the course onward, and how far they are."""
    way = points - starts
    course = np.arctan2(way[..., 1], way[..., 0]) - onward
    return (course + math.pi) % (2.0 * math.pi) - math.pi, np.hypot(way[..., 0], way[..., 1])
