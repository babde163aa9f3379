"""The ground of a straight spray line: half a swath to each side, square ends.

Lines are rows of (east, north, east, north) in metres, from start to end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

Floats = NDArray[np.float64]
Objects = NDArray[np.object_]

# Side by side with a border, floating point may see an overlap that is not there; strips are
# tested this much narrower. What it lets through is less than 1e-5 m wide.
NARROWER_M = 1e-5
# Ground of many strips is put together on a grid of this.
GRID_M = 1e-6


def no_lines() -> Floats:
    """Return no line at all."""
    return np.empty((0, 4))


def lengths_m(lines: Floats) -> Floats:
    """Return the length of every line.

    >>> lengths_m(np.array([[0.0, 0.0, 3.0, 4.0]])).tolist()
    [5.0]
    """
    length: Floats = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    return length


def directions(lines: Floats) -> Floats:
    """Return the unit vector of every line; none may be a point."""
    unit: Floats = (lines[:, 2:] - lines[:, :2]) / lengths_m(lines)[:, None]
    return unit


def rectangles(lines: Floats, width_m: float) -> Objects:
    """Return the strip of every line as a polygon.

    >>> rectangles(np.array([[0.0, 0.0, 10.0, 0.0]]), 6.0)[0].area
    60.0
    """
    if not len(lines):
        return np.empty(0, dtype=object)
    along = directions(lines)
    right = np.column_stack([along[:, 1], -along[:, 0]]) * (width_m / 2.0)
    start, end = lines[:, :2], lines[:, 2:]
    corners = np.stack([start + right, end + right, end - right, start - right], axis=1)
    return np.asarray(shapely.polygons(corners), dtype=object)


def united(lines: Floats, width_m: float) -> BaseGeometry:
    """Return the ground of all strips together."""
    return whole(rectangles(lines, width_m))


def whole(strips: Objects) -> BaseGeometry:
    """Return the ground of strips together.

    On a grid: without one GEOS leaves strips out where sides of theirs nearly coincide, as those of
    parallel passes do. For the same reason an intersection of strips needs one: GEOS may give a
    whole strip as what it shares with the one that it touches.
    """
    return shapely.union_all(strips, grid_size=GRID_M)


def sprayed_twice(strips: Objects) -> BaseGeometry:
    """Return the ground that lies under more than one strip."""
    tree = shapely.STRtree(strips)
    one, other = tree.query(strips, predicate="intersects")
    keep = one < other
    return whole(shapely.intersection(strips[one[keep]], strips[other[keep]], grid_size=GRID_M))


def reach_inside(
    starts: Floats, along: Floats, wanted_m: Floats, ground: BaseGeometry, width_m: float
) -> Floats:
    """Return how far, up to `wanted_m`, a strip from each start stays on the ground."""
    reach = np.maximum(np.asarray(wanted_m, dtype=np.float64), 0.0).copy()
    some = np.flatnonzero(reach > 1e-6)
    if not len(some):
        return reach
    ends = starts[some] + along[some] * reach[some, None]
    ahead = rectangles(np.column_stack([starts[some], ends]), width_m - 2.0 * NARROWER_M)
    shapely.prepare(ground)
    out = some[~shapely.covers(ground, ahead)]
    if len(out):
        half_m = width_m / 2.0 - NARROWER_M
        reach[out] = _to_border_m(starts[out], along[out], reach[out], ground, half_m)
    return reach


def _to_border_m(
    starts: Floats, along: Floats, up_to_m: Floats, ground: BaseGeometry, half_m: float
) -> Floats:
    """Return how far strips, as wide to both sides, go until some of them leaves the ground."""
    found = np.where(shapely.intersects_xy(ground, starts), up_to_m, 0.0)
    edges, tree = border_edges(ground)
    strips = rectangles(np.column_stack([starts, starts + along * up_to_m[:, None]]), 2.0 * half_m)
    row, edge = tree.query(strips)
    ends = edges[edge] - starts[row, None]
    ahead_m = np.einsum("pej,pj->pe", ends, along[row])
    aside_m = ends[..., 0] * along[row, None, 1] - ends[..., 1] * along[row, None, 0]
    # What of each edge is in front of the strip: a part of it, from its first end on.
    rise_m, sides_m = np.diff(aside_m), np.array([-half_m, half_m])
    with np.errstate(divide="ignore", invalid="ignore"):
        crossed = np.sort((sides_m - aside_m[:, :1]) / rise_m)
    is_along = np.abs(rise_m) < 1e-12
    crossed = np.where(is_along, np.where(np.abs(aside_m[:, :1]) < half_m, [0, 1], 2), crossed)
    part = np.clip(crossed, 0.0, 1.0)
    met_m = ahead_m[:, :1] + np.diff(ahead_m) * part
    is_met = (part[:, 0] < part[:, 1]) & (met_m.max(axis=1) > 0.0)
    np.minimum.at(found, row[is_met], np.maximum(met_m[is_met].min(axis=1), 0.0))
    return found


# One ground is looked at many times.
@lru_cache(maxsize=4)
def border_edges(ground: BaseGeometry) -> tuple[Floats, shapely.STRtree]:
    """Return the edges of some ground by their ends, and where to find them."""
    rings = shapely.get_rings(shapely.get_parts(ground))
    points, ring = shapely.get_coordinates(rings, return_index=True)
    edges = np.stack([points[:-1], points[1:]], axis=1)[ring[1:] == ring[:-1]]
    return edges, shapely.STRtree(shapely.linestrings(edges))


def stretched(
    lines: Floats, before_m: Floats, after_m: Floats, ground: BaseGeometry, width_m: float
) -> Floats:
    """Return the lines, longer at both ends by what is wanted and the ground allows."""
    if not len(lines):
        return lines
    along = directions(lines)
    back = reach_inside(lines[:, :2], -along, before_m, ground, width_m)
    ahead = reach_inside(lines[:, 2:], along, after_m, ground, width_m)
    longer: Floats = np.column_stack(
        [lines[:, :2] - along * back[:, None], lines[:, 2:] + along * ahead[:, None]]
    )
    return longer


def joined(parts: Sequence[Floats]) -> Floats:
    """Return the lines of all parts."""
    return np.concatenate([no_lines(), *parts])


# Which valves are open where: the companion closes a strip that touches the border.
#
# A strip here is the segment of the boom that one valve sprays. On a pass along the border the
# outer one is closed all the way, and the plan counts no litres for it.

Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Extents:
    """Ground on which a strip may be open, and the part of it deep inside the whole boom."""

    ground: BaseGeometry
    deep: BaseGeometry

    def deep_inside(self, middle: Floats) -> Bools:
        """Return where the whole boom is far from any border."""
        found: Bools = shapely.contains_xy(self.deep, middle[:, 0], middle[:, 1])
        return found

    def is_open(self, middle: Floats, right: Floats, strip: tuple[float, float]) -> Bools:
        """Return where the strip (right_m, width_m) of a boom lies on the ground as a whole."""
        right_m, width_m = strip
        found = np.ones(len(middle), dtype=np.bool_)
        for across_m in (right_m - width_m / 2.0, right_m, right_m + width_m / 2.0):
            places = middle + right * across_m
            found &= shapely.contains_xy(self.ground, places[:, 0], places[:, 1])
        return found


def extents_of(limit: BaseGeometry, *, width_m: float, buffer_m: float) -> Extents:
    """Return the extents of a field whose border is kept off by `buffer_m`."""
    ground = limit.buffer(-buffer_m)
    deep = limit.buffer(-(buffer_m + width_m / 2.0))
    shapely.prepare(ground)
    shapely.prepare(deep)
    return Extents(ground=ground, deep=deep)


# Spray lines over a piece of ground: a pass along every border, and parallel ones inside.
#
# Two laws carry it. A line at half a swath from the border has its strip inside, so the pass along
# the border does no harm outside. Ground that is a whole swath from the border may be covered by a
# strip of that width in any direction: at every place along the strip there is such ground in the
# strip, and all within a swath of it is inside. So every strip may run from the first to the last
# place of the inner ground that it covers, slanted ends included, and still nothing lies outside.

# Corners sharper than this are cut off; what is lost there, patches win back.
MITRE_LIMIT = 5.0
# Shorter pieces of a border pass are roundings of its corner, which its neighbours cover.
SHORT_M = 0.02
# Ground between two strips that is not worth a line of its own.
CRUMB_M2 = 0.02
# Strips may lie so far apart before one more is flown: 0.03 % of a swath of 7 m.
GAP_M = 0.002
# No line is shorter: a point has no direction.
LINE_MIN_M = 0.5


def border_passes(ground: BaseGeometry, width_m: float) -> Floats:
    """Return a line along every edge of the ground, half a swath inside."""
    inside = ground.buffer(-width_m / 2.0, join_style="mitre", mitre_limit=MITRE_LIMIT)
    parts = [
        _along_ring(shapely.get_coordinates(ring), ground, width_m)
        for polygon in shapely.get_parts(inside)
        if isinstance(polygon, Polygon) and not polygon.is_empty
        for ring in (polygon.exterior, *polygon.interiors)
    ]
    return joined(parts)


def _along_ring(points: Floats, ground: BaseGeometry, width_m: float) -> Floats:
    """Return the edges of one ring, each far enough past its corners that none is left out."""
    lines = np.column_stack([points[:-1], points[1:]])
    lines = lines[np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1]) > SHORT_M]
    if not len(lines):
        return no_lines()
    course = np.arctan2(lines[:, 3] - lines[:, 1], lines[:, 2] - lines[:, 0])
    turn = np.abs((np.roll(course, -1) - course + math.pi) % (2.0 * math.pi) - math.pi)
    # Past a corner of angle d the outer side of a strip must go half a width times tan(d / 2).
    past_m = np.minimum(width_m / 2.0 * np.tan(np.minimum(turn, 3.0) / 2.0), 1.5 * width_m)
    return stretched(lines, np.roll(past_m, 1), past_m, ground, width_m)


def inner_ground(ground: BaseGeometry, width_m: float) -> BaseGeometry:
    """Return what the passes along the border leave to be sprayed."""
    return ground.buffer(-width_m, join_style="mitre", mitre_limit=MITRE_LIMIT)


def axes(angle_deg: float) -> Floats:
    """Return the unit vectors along and to the right of a course, clockwise from north."""
    angle = math.radians(angle_deg)
    return np.array([[math.sin(angle), math.cos(angle)], [math.cos(angle), -math.sin(angle)]])


def inner_lines(inner: BaseGeometry, width_m: float, angle_deg: float) -> Floats:
    """Return parallel lines whose strips cover the inner ground, evenly spaced to fit it."""
    turned_by = axes(angle_deg)
    turned = shapely.transform(inner, lambda points: points @ turned_by.T)
    parts = [
        _lines_of_part(part, width_m) for part in shapely.get_parts(turned) if not part.is_empty
    ]
    lines = joined(parts)
    return np.column_stack([lines[:, :2] @ turned_by, lines[:, 2:] @ turned_by])


def count_across(across_m: float, width_m: float) -> int:
    """Return how many strips cover a width; a gap that nobody can fly or see is none.

    >>> count_across(30.0, 6.0), count_across(30.005, 6.0), count_across(30.1, 6.0)
    (5, 5, 6)
    """
    return max(1, math.ceil(across_m / (width_m + GAP_M) - 1e-6))


def _lines_of_part(part: Polygon, width_m: float) -> Floats:
    """Return the lines of one connected piece, along the first of its axes."""
    west, low, east, high = part.bounds
    count = count_across(high - low, width_m)
    step_m = (high - low) / count
    floors = low + step_m * np.arange(count)
    # GEOS clips in a fifth of the time that an intersection takes, but does not promise to be right
    # where a side of the part lies on a band's edge: all together must be the part.
    bands = [
        shapely.clip_by_rect(part, west - 1.0, floor, east + 1.0, floor + step_m)
        for floor in floors.tolist()
    ]
    if not abs(shapely.area(bands).sum() - part.area) <= CRUMB_M2:
        across = [[west - 1.0, floor, east + 1.0, floor] for floor in floors + step_m / 2.0]
        bands = shapely.intersection(part, rectangles(np.array(across), step_m)).tolist()
    cuts, band_of = shapely.get_parts(bands, return_index=True)
    keep = shapely.area(cuts) > CRUMB_M2
    bounds = shapely.bounds(cuts[keep])
    if not len(bounds):
        return no_lines()
    middle = floors[band_of[keep]] + step_m / 2.0
    return _long_enough(np.column_stack([bounds[:, 0], middle, bounds[:, 2], middle]))


def _long_enough(lines: Floats) -> Floats:
    """Return lines of at least `LINE_MIN_M`, longer to both sides where they are too short."""
    more = np.maximum(LINE_MIN_M - (lines[:, 2] - lines[:, 0]), 0.0) / 2.0
    lines[:, 0] -= more
    lines[:, 2] += more
    return lines
