"""Where zones lie on top of each other, in pairs with their area."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Geometry, STRtree

from companion.core.outline import lines_of, without_overlay
from companion.core.prescription import SLIVER_M
from companion.errors import MapError
from missions.maps.local import Area
from missions.maps.model import map_error

Objects = NDArray[np.object_]
Ints = NDArray[np.int64]

# Below this two zones share a digitising error, not ground.
OVERLAP_MAX_M2 = 1.0
# Boxes that share less cannot hide an overlap worth adding up.
_BOX_MIN_M2 = 1e-3
_BITE = 5000
# How many pairs one question to the tree should bring, and for how many parts it may ask.
_HITS_WANTED = 50_000
_CHUNK_MAX = 256
# Enough to tell the operator; a map with more is drawn in layers.
PAIRS_MAX = 1000
# Parts with fewer vertices are compared faster than they are prepared for it.
_PREPARED_MIN = 100
# What one look may cost: pairs of boxes (some 20 s), vertices of the pairs that touch (50 s), and
# crossings of edges beyond what neighbours have along a common border. A sound map of 22 500
# polygons with a border of 20 000 vertices around them needs a tenth at most.
CANDIDATES_MAX = 5_000_000
VERTICES_MAX = 300_000_000
CROSSINGS_MAX = 400_000
_CROSSINGS_PER_VERTEX = 4
# An edge of an outline has its neighbours near, and theirs where it is short. Closing slivers
# takes some 12 us for every further pair, and some 0.2 us for a pair of boxes.
_NEAR_EACH, NEAR_MAX, BOXES_MAX = 12, 200_000, 20_000_000
# Pairs of boxes of the edges of rings that cross themselves; each is met from both sides. A repair
# with so many takes some 2 s.
SELF_CROSSINGS_MAX = 200_000
# Rings of so few edges have no crossings to speak of.
_FEW_EDGES = 50
# Pairs that cannot have many crossings are not asked: one side is short, or both are.
_SHORT, _PRODUCT_MIN = 100, 300_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """Two zones by index, and the ground that they share."""

    first: int
    second: int
    area_m2: float


def overlaps(
    zones: Sequence[Area], *, above_m2: float = OVERLAP_MAX_M2, tried: bool = False
) -> list[Overlap]:
    """Return the pairs of zones that share more than `above_m2`, the largest first.

    The zones are in metres. The work is done in bites and ends after many pairs, because a file
    with every zone on the same ground has billions of them. A file that would take longer than
    anyone waits before it comes to that is refused. `tried`: the edges alone do not tell.
    """
    if not zones:
        return []
    parts, owner = shapely.get_parts(np.array(zones, dtype=object), return_index=True)
    # A sound map is one without a single overlay.
    joined = None if tried else without_overlay(parts)
    if joined is not None and joined[1] <= above_m2:
        return []
    vertices = shapely.get_num_coordinates(parts).astype(np.int64)
    shapely.prepare(parts[vertices >= _PREPARED_MIN])
    shared: dict[tuple[int, int], float] = defaultdict(float)
    visited = crossings = large = 0
    for one, two in _candidates(parts, owner, above_m2):
        one, two = _meeting(parts, vertices, one, two)
        visited += int(vertices[one].sum() + vertices[two].sum())
        if not visited <= VERTICES_MAX:
            raise _too_complicated()
        crossings += _crossings(parts, vertices, one, two, CROSSINGS_MAX - crossings)
        area_m2 = shapely.area(shapely.intersection(parts[one], parts[two]))
        pairs = np.sort(np.column_stack([owner[one], owner[two]]), axis=1).tolist()
        for (first, second), pair_m2 in zip(pairs, area_m2.tolist(), strict=True):
            before_m2 = shared[first, second]
            shared[first, second] = before_m2 + pair_m2
            large += before_m2 <= above_m2 < before_m2 + pair_m2
        if large > PAIRS_MAX:
            break
    found = [
        Overlap(first=first, second=second, area_m2=area_m2)
        for (first, second), area_m2 in shared.items()
        if not area_m2 <= above_m2
    ]
    return sorted(found, key=lambda overlap: overlap.area_m2, reverse=True)


def check_crossings(areas: Objects, path: Path) -> None:
    """Refuse rings that cross themselves so often that their repair has no end.

    Every crossing becomes a corner, and rings of 18 000 edges can have a hundred million.
    """
    left = SELF_CROSSINGS_MAX
    for area in areas[shapely.get_num_coordinates(areas) > _FEW_EDGES]:
        boxes = _edge_boxes(area)
        # Every edge meets itself and its two neighbours.
        expected = _CROSSINGS_PER_VERTEX * len(boxes)
        left -= max(0, _hits(boxes, boxes, left + expected) - expected)
        if not left >= 0:
            raise map_error(
                path,
                f"its rings cross themselves in more than {SELF_CROSSINGS_MAX // 2} places",
                fix="repair the map where it is made, and export it again",
                code="too-complicated",
            )


def _hits(first: Objects, second: Objects, most: int) -> int:
    """Return how many pairs of boxes meet; something more than `most` where they are more."""
    tree = STRtree(first)
    hits, start, chunk = 0, 0, 1
    while start < len(second) and hits <= most:
        more = len(tree.query(second[start : start + chunk])[0])
        start += chunk
        chunk = max(1, min(2 * chunk, int(chunk * _HITS_WANTED / max(more, 1))))
        hits += more
    return hits


def _candidates(parts: Objects, owner: Ints, above_m2: float) -> Iterator[tuple[Ints, Ints]]:
    """Yield, in bites, each pair of parts of different zones whose boxes share ground, once.

    Zones of one part share no more than their boxes do, which has to be enough by itself.
    """
    alone = np.bincount(owner)[owner] == 1
    tree = STRtree(parts)
    boxes = shapely.bounds(parts)
    start, chunk, looked_at = 0, 4, 0
    while start < len(parts):
        one, two = tree.query(parts[start : start + chunk])
        one = one + start
        start += chunk
        wanted = int(chunk * _HITS_WANTED / max(len(one), 1))
        chunk = max(1, min(2 * chunk, wanted, _CHUNK_MAX))
        once = (one < two) & (owner[one] != owner[two])
        one, two = one[once], two[once]
        low = np.maximum(boxes[one, :2], boxes[two, :2])
        high = np.minimum(boxes[one, 2:], boxes[two, 2:])
        size = np.clip(high - low, 0.0, None)
        least_m2 = np.where(alone[one] & alone[two], above_m2, _BOX_MIN_M2)
        large = size[:, 0] * size[:, 1] > least_m2
        one, two = one[large], two[large]
        looked_at += len(one)
        if not looked_at <= CANDIDATES_MAX:
            raise _too_complicated()
        for bite in range(0, len(one), _BITE):
            yield one[bite : bite + _BITE], two[bite : bite + _BITE]


def _meeting(parts: Objects, vertices: Ints, one: Ints, two: Ints) -> tuple[Ints, Ints]:
    """Return the pairs that meet at all: a border's box holds every zone inside its ring.

    Neighbours that only touch are told from others at a quarter of what an overlay takes.
    """
    swap = vertices[one] < vertices[two]
    large, small = np.where(swap, two, one), np.where(swap, one, two)
    meets = shapely.intersects(parts[large], parts[small])
    few = np.flatnonzero(meets & (vertices[large] < _PREPARED_MIN))
    meets[few] = ~shapely.touches(parts[large[few]], parts[small[few]])
    return one[meets], two[meets]


def _crossings(parts: Objects, vertices: Ints, one: Ints, two: Ints, left: int) -> int:
    """Return how many more edges cross than along a common border; refuse more than `left`.

    Two combs laid across each other share millions of little squares.
    """
    few, many = np.minimum(vertices[one], vertices[two]), np.maximum(vertices[one], vertices[two])
    found = 0
    for pair in np.flatnonzero((few > _SHORT) | (few * many > _PRODUCT_MIN)).tolist():
        first, second = _edge_boxes(parts[one[pair]]), _edge_boxes(parts[two[pair]])
        expected = _CROSSINGS_PER_VERTEX * int(few[pair] + many[pair])
        more = max(0, _hits(first, second, left - found + expected) - expected)
        if not found + more <= left:
            raise _too_complicated()
        found += more
    return found


def _edge_boxes(part: Area) -> Objects:
    """Return the box of every edge."""
    points, ring = shapely.get_coordinates(shapely.get_rings(part), return_index=True)
    same = ring[1:] == ring[:-1]
    ends = np.hstack([points[:-1], points[1:]])[same]
    low, high = np.minimum(ends[:, :2], ends[:, 2:]), np.maximum(ends[:, :2], ends[:, 2:])
    boxes: Objects = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    return boxes


def check_outline(ground: Geometry, path: Path) -> None:
    """Refuse an outline so dense that closing the slivers in it takes longer than anyone waits.

    Edges that are nearer to each other than a sliver is wide all cross when they are moved.
    """
    rings = shapely.get_rings(shapely.get_parts(ground))
    points, ring = shapely.get_coordinates(rings, return_index=True)
    ends = np.stack([points[:-1], points[1:]], axis=1)[ring[1:] == ring[:-1]]
    lines = lines_of(ends)
    tree = STRtree(lines)
    boxes = near = start = 0
    chunk = 4
    while start < len(lines):
        some = lines[start : start + chunk]
        more = len(tree.query(some)[0])
        boxes += more
        near += len(tree.query(some, "dwithin", distance=SLIVER_M)[0])
        if not (near <= _NEAR_EACH * len(lines) + NEAR_MAX and boxes <= BOXES_MAX):
            raise map_error(
                path,
                f"its outline has {len(lines)} edges, more than {NEAR_MAX} times one of them is "
                f"within {SLIVER_M * 100:.0f} cm of another",
                fix="simplify the map (in QGIS: Simplify, 0.1 m), or draw it again",
                code="too-complicated",
            )
        start += chunk
        chunk = max(1, min(2 * chunk, int(chunk * _HITS_WANTED / max(more, 1)), _CHUNK_MAX))


def _too_complicated() -> MapError:
    return MapError(
        "the zones of the map touch each other in too many places to be compared; "
        "simplify the map, or cut it to one field",
        code="too-complicated",
        fix="simplify the map, or cut it to one field",
    )
