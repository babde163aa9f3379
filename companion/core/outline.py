"""Polygons that share their borders, joined into one ground: the border of a map without one.

A map of 22 000 polygons has a quarter of a million edges, and most of them stand twice: once with
each of two neighbours, in opposite directions. What stands once is the outline. An overlay finds
that out anew for every pair, and takes ten times as long. A flight map has its border: no flight
loads this.
"""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry, STRtree

from companion.core.frame import Floats, Ints

Objects = NDArray[np.object_]

# A corner this near to a neighbour's edge stands on it: maps are written with so many decimals.
CORNER_OFF_M = 0.001
# Corners that stand on edges, for every edge; a border has one or two.
_CORNERS_MAX = 20
_BITE = 5_000
# A polygon with more corners is not made smaller: that could take longer than all the rest.
_SIMPLE_MAX = 1_000


def dissolved(parts: Objects, *, tried: bool = False) -> Geometry:
    """Return the ground of all single, valid polygons (in metres) together.

    Corners may move by a millimetre onto the edge of a neighbour. Polygons that overlap by more
    are joined to the others by an overlay. `tried`: `without_overlay` could not join them.
    """
    found = None if tried else without_overlay(parts)
    if found is not None:
        return found[0]
    inner = shrunk(parts)
    one, two = STRtree(inner).query(inner, "intersects")
    alone = np.ones(len(parts), dtype=np.bool_)
    alone[one[one != two]] = False
    found = without_overlay(parts[alone])
    if found is None:
        return shapely.union_all(parts)
    return shapely.union(found[0], shapely.union_all(parts[~alone]))


def shrunk(parts: Objects) -> Objects:
    """Return the polygons without the half millimetre along their borders that neighbours share."""
    inner = parts.copy()
    simple = shapely.get_num_coordinates(parts) <= _SIMPLE_MAX
    inner[simple] = shapely.buffer(parts[simple], -CORNER_OFF_M / 2, join_style="mitre")
    return inner


def without_overlay(parts: Objects) -> tuple[Geometry, float] | None:
    """Return the ground of polygons that do not overlap, and how much could; None if they may.

    How many polygons lie over a point follows from their edges alone, each with its polygon on the
    left, and two opposite edges cancel out. Where what is left over is the outline of some ground,
    one polygon lies over each of its points and none over others: no pair overlaps. That it is
    the outline is checked. Only the area [m2] between an edge and the corners that were put on it
    is hidden from that, and no two polygons share more than all of it.
    """
    if len(parts) < 2:
        return (parts[0], 0.0) if len(parts) else None
    xy, ring = shapely.get_coordinates(
        shapely.get_rings(shapely.orient_polygons(parts)), return_index=True
    )
    # As complex numbers: numpy finds equal ones much faster than equal rows.
    places, corner = np.unique(xy @ np.array([1.0, 1.0j]), return_inverse=True)
    points = np.column_stack([places.real, places.imag])
    edge = np.flatnonzero(ring[1:] == ring[:-1])
    edges = _cancelled(np.column_stack([corner[edge], corner[edge + 1]]), len(places))
    cut = None if edges is None else _cut_at_corners(edges, points)
    if cut is None:
        return None
    left = _cancelled(cut[0], len(places))
    ground = None if left is None else _ground(left, places)
    return None if ground is None else (ground, cut[1])


def lines_of(ends: Floats) -> Objects:
    """Return a line for every two ends (n, 2, 2)."""
    return np.array(shapely.linestrings(ends))


def _cancelled(edges: Ints, count: int) -> Ints | None:
    """Return the edges (from, to) without those that are opposite; None where two are the same."""
    low, high = edges.min(axis=1), edges.max(axis=1)
    way, which = np.unique(low * count + high, return_inverse=True)
    sign = np.sign(edges[:, 1] - edges[:, 0])
    left = np.bincount(which, weights=sign, minlength=len(way)).astype(np.int64)
    if not (np.abs(left) <= 1).all():
        return None
    low, high = np.divmod(way[left != 0], count)
    forward = left[left != 0, None] > 0
    return np.where(forward, np.column_stack([low, high]), np.column_stack([high, low]))


def _cut_at_corners(edges: Ints, points: Floats) -> tuple[Ints, float] | None:
    """Return the edges, cut where corners of others stand on them, and the area in between."""
    corners = np.unique(edges)
    found = _near(edges, corners, points)
    if found is None:
        return None
    edge, corner = found
    start, end = edges[edge].T
    along, to_corner = points[end] - points[start], points[corner] - points[start]
    share = (along * to_corner).sum(axis=1) / (along**2).sum(axis=1)
    on = (corner != start) & (corner != end) & (share > 0.0) & (share < 1.0)
    # Between an edge and its corners: no more than the triangles over it, each with one of them.
    cross = along[:, 0] * to_corner[:, 1] - along[:, 1] * to_corner[:, 0]
    hidden_m2 = float(np.abs(cross[on]).sum()) / 2
    order = np.lexsort((share[on], edge[on]))
    corner, edge = corner[on][order], edge[on][order]
    # Every edge as its start, its corners and its end, then from each of these to the next.
    stops = np.bincount(edge, minlength=len(edges))
    last = np.cumsum(stops + 2) - 1
    chain = np.empty(2 * len(edges) + len(corner), dtype=np.int64)
    chain[last - stops - 1], chain[last] = edges.T
    chain[np.arange(len(corner)) + 2 * edge + 1] = corner
    goes_on = np.ones(len(chain), dtype=np.bool_)
    goes_on[last] = False
    begin = np.flatnonzero(goes_on)
    return np.column_stack([chain[begin], chain[begin + 1]]), hidden_m2


def _near(edges: Ints, corners: Ints, points: Floats) -> tuple[Ints, Ints] | None:
    """Return the edges and the corners that are near each other; None where they crowd."""
    tree = STRtree(lines_of(points[edges]))
    at = np.array(shapely.points(points[corners]))
    found: list[tuple[Ints, Ints]] = []
    left = _CORNERS_MAX * len(edges)
    for first in range(0, len(corners), _BITE):
        near, edge = tree.query(at[first : first + _BITE], "dwithin", distance=CORNER_OFF_M)
        found.append((edge, corners[first + near]))
        left -= len(edge)
        if left < 0:
            return None
    if not found:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    return np.concatenate([one for one, _ in found]), np.concatenate([two for _, two in found])


def _ground(edges: Ints, places: NDArray[np.complex128]) -> Geometry | None:
    """Return the ground whose outline these edges are, all of them and no others, or None."""
    if not len(edges):
        return None
    points = np.column_stack([places.real, places.imag])
    lines = lines_of(points[edges])
    faces = shapely.orient_polygons(shapely.get_parts(shapely.polygonize(lines)))
    if not len(faces):
        return None
    xy, ring = shapely.get_coordinates(shapely.get_rings(faces), return_index=True)
    face_of_ring = np.repeat(np.arange(len(faces)), shapely.get_num_interior_rings(faces) + 1)
    begin = np.flatnonzero(ring[1:] == ring[:-1])
    corner = np.searchsorted(places, xy @ np.array([1.0, 1.0j]))
    ways = corner[begin] * len(places) + corner[begin + 1]
    wanted = np.sort(edges[:, 0] * len(places) + edges[:, 1])
    # Of a face that is no ground, but lies in a hole of it, all edges run the other way.
    right = wanted[np.searchsorted(wanted, ways).clip(max=len(wanted) - 1)] == ways
    owner = face_of_ring[ring[begin]]
    inside = np.bincount(owner, weights=~right, minlength=len(faces)) == 0
    if not np.array_equal(np.sort(ways[inside[owner]]), wanted):
        return None
    ground = shapely.multipolygons(faces[inside])
    return ground if shapely.is_valid(ground) else None
