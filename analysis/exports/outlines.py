"""The outline of the ground that a strip swept between two samples of its path."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import MultiPoint, MultiPolygon, Polygon

if TYPE_CHECKING:
    from analysis.exports.ground import Ground
    from analysis.track import Track

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Corners of the edges lie so far apart at most; what is straighter than a centimetre loses them.
_CORNER_M = 0.5
_STRAIGHT_M = 0.01
# What is no area at all is given this much, so that it can be drawn.
_HAIR_M = 0.001


def outlines(track: Track, first: Ints, last: Ints) -> list[Ground]:
    """Return the ground of each stretch in metres: left edge there, right edge back."""
    if not len(first):
        return []
    half_m = 0.5 * track.width_m
    right_e, right_n = half_m * np.cos(track.heading_rad), -half_m * np.sin(track.heading_rad)
    left = np.stack((track.east_m - right_e, track.north_m - right_n), axis=1)
    right = np.stack((track.east_m + right_e, track.north_m + right_n), axis=1)
    corners = [
        _corners(track.distance_m, begin, end)
        for begin, end in zip(first.tolist(), last.tolist(), strict=True)
    ]
    edges = [np.concatenate((left[at], right[at[::-1]])) for at in corners]
    number = np.repeat(np.arange(len(edges)), [len(edge) for edge in edges])
    lines = np.asarray(shapely.linearrings(np.concatenate(edges), indices=number), dtype=object)
    areas = np.asarray(shapely.polygons(lines), dtype=object)
    rings = np.asarray(shapely.simplify(areas, _STRAIGHT_M), dtype=object)
    is_good = shapely.is_valid(rings) & ~shapely.is_empty(rings)
    found = cast("list[Ground]", rings.tolist())
    for at in np.flatnonzero(~is_good).tolist():
        found[at] = _of_pieces(left[corners[at]], right[corners[at]])
    return found


def _corners(distance_m: Floats, first: int, last: int) -> Ints:
    """Return the samples at which an outline has its corners, both ends among them."""
    steps = np.floor((distance_m[first:last] - distance_m[first]) / _CORNER_M)
    inner = first + 1 + np.flatnonzero(steps[1:] != steps[:-1])
    return np.concatenate(([first], inner, [last]))


def _of_pieces(left: Floats, right: Floats) -> Ground:
    """Return the ground of an edge that crosses itself: all pieces between corners, as one."""
    corners = np.stack((left[:-1], left[1:], right[1:], right[:-1]), axis=1)
    pieces = [MultiPoint(each).convex_hull for each in corners]
    found = shapely.union_all([each for each in pieces if isinstance(each, Polygon)])
    if isinstance(found, Polygon | MultiPolygon) and not found.is_empty:
        return found
    return MultiPoint(np.concatenate((left, right))).convex_hull.buffer(_HAIR_M)
