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
                if outer.buffer(TOUCH_M, join_style="mitre").covers(inner):
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
    return _cheapest(closed, inwards, tolerance_m)


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


def _cheapest(closed: Floats, inwards: Floats, tolerance_m: float) -> Floats:
    """Return the corners of the cheapest ring; where there is none, the corners given."""
    count, depths = len(closed) - 1, len(DEPTHS)
    # The mitre of a sharp corner is cut off: no place is farther from its corner.
    steep = np.maximum(np.hypot(*inwards.T), 1.0)[:, None]
    deep = np.minimum(DEPTHS[None, :], 1.0 / steep) * tolerance_m
    places = closed[:, None, :] + inwards[:, None, :] * deep[:, :, None]
    # One row for each depth at which the ring may begin.
    cost = np.full((len(STARTS), count + 1, depths), np.inf)
    cost[np.arange(len(STARTS)), 0, STARTS] = 0.0
    before = np.full(cost.shape, -1, dtype=np.int64)
    for at, edges in _seen(closed, places, tolerance_m):
        spent = edges + cost[:, at, :, None, None]
        least = spent.min(axis=1)
        ends = slice(at + 1, at + 1 + edges.shape[1])
        better = least < cost[:, ends] - 1e-12
        if better.any():
            np.copyto(cost[:, ends], least, where=better)
            np.copyto(before[:, ends], at * depths + spent.argmin(axis=1), where=better)
    cost_of = cost[np.arange(len(STARTS)), count, STARTS]
    row = int(np.argmin(cost_of))
    if not math.isfinite(cost_of[row]):
        return closed[:-1]
    node, chain = count * depths + STARTS[row], list[int]()
    while node >= depths or not chain:
        node = int(before[row].flat[node])
        chain.append(node)
    found: Floats = places.reshape(-1, 2)[chain[::-1]]
    return found


def _seen(closed: Floats, places: Floats, tolerance_m: float) -> Iterator[tuple[int, Floats]]:
    """Yield each corner with what edges from it to places ahead cost, infinite where none may be.

    It is by the depth of its start, how many corners ahead it ends, and the depth there.
    """
    count = len(closed) - 1
    edge = 1.0 + DEPTH_COST * DEPTHS
    for first in range(0, count, TOGETHER):
        starts = np.arange(first, min(first + TOGETHER, count))
        possible = _ahead(closed, places, starts, tolerance_m)
        beyond = starts[:, None] + np.arange(possible.shape[2]) >= count
        is_end = possible.any(axis=(1, 3)) & ~beyond
        farthest = possible.shape[2] - is_end[:, ::-1].argmax(axis=1)
        costs = np.where(possible, edge, np.inf)
        for at in np.flatnonzero(is_end.any(axis=1)).tolist():
            yield first + at, costs[at, :, : farthest[at]]


def _ahead(closed: Floats, places: Floats, starts: Ints, tolerance_m: float) -> Bools:
    """Return from which depths of some corners edges to corners ahead may end at which depth.

    Corners are looked at some together, the nearest first, as long as any of them is seen.
    """
    count = len(closed) - 1
    found = []
    some, at = np.arange(len(starts)), starts
    onward = np.arctan2(*(closed[at + 1] - closed[at]).T[::-1])
    low = np.full((len(at), len(DEPTHS)), -math.inf)
    high = -low
    ahead, many = 1, AHEAD
    while len(at):
        # Beyond the last corner it is looked at again: nothing comes after it.
        ends = np.minimum(at[:, None] + np.arange(ahead, ahead + many), count)
        least, most = _sectors(closed[ends], places[at], onward, tolerance_m)
        least = np.maximum(np.maximum.accumulate(least, axis=2), low[:, :, None])
        most = np.minimum(np.minimum.accumulate(most, axis=2), high[:, :, None])
        possible = np.zeros((len(starts), *least.shape[1:], len(DEPTHS)), dtype=np.bool_)
        # Courses are dear: they are asked for only where there are any that an edge may have.
        row, depth, end = np.nonzero(least - ROUNDING <= most + ROUNDING)
        low_some, high_some = least[row, depth, end, None], most[row, depth, end, None]
        course, far_m = _courses(
            places[ends[row, end]], places[at[row], depth, None], onward[row, None]
        )
        possible[some[row], depth, end] = (
            (course >= low_some - ROUNDING) & (course <= high_some + ROUNDING) & (far_m > SAME_M)
        )
        found.append(possible)
        ahead, many = ahead + many, 2 * many
        low, high = least[:, :, -1], most[:, :, -1]
        on = (low <= high).any(axis=1) & (at + ahead <= count)
        some, at, onward, low, high = some[on], at[on], onward[on], low[on], high[on]
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
