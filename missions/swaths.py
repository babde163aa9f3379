"""Spray lines over a piece of ground: a pass along every border, and parallel ones inside.

Two laws carry it. A line at half a swath from the border has its strip inside, so the pass along
the border does no harm outside. Ground that is a whole swath from the border may be covered by a
strip of that width in any direction: at every place along the strip there is such ground in the
strip, and all within a swath of it is inside. So every strip may run from the first to the last
place of the inner ground that it covers, slanted ends included, and still nothing lies outside.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from missions.strips import Floats, joined, no_lines, rectangles, stretched

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
    ends = np.full(count, west - 1.0), np.full(count, east + 1.0)
    across = np.column_stack([ends[0], floors + step_m / 2.0, ends[1], floors + step_m / 2.0])
    bands = rectangles(across, step_m)
    cuts, band_of = shapely.get_parts(shapely.intersection(part, bands), return_index=True)
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
