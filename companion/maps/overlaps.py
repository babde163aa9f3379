"""Where zones lie on top of each other, in pairs with their area."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import STRtree

from companion.maps.local import Area

Objects = NDArray[np.object_]
Ints = NDArray[np.int64]

# Below this two zones share a digitising error, not ground.
OVERLAP_MAX_M2 = 1.0
# Boxes that share less cannot hide an overlap worth adding up.
_BOX_MIN_M2 = 1e-3
_CHUNK = 64
_BITE = 5000
# Enough to tell the operator; a map with more is drawn in layers.
PAIRS_MAX = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """Two zones by index, and the ground that they share."""

    first: int
    second: int
    area_m2: float


def overlaps(zones: Sequence[Area], *, above_m2: float = OVERLAP_MAX_M2) -> list[Overlap]:
    """Return the pairs of zones that share more than `above_m2`, the largest first.

    The zones are in metres. The work is done in bites and ends after many pairs, because a file
    with every zone on the same ground has billions of them.
    """
    if not zones:
        return []
    parts, owner = shapely.get_parts(np.array(zones, dtype=object), return_index=True)
    shared: dict[tuple[int, int], float] = defaultdict(float)
    for one, two in _candidates(parts, owner):
        area_m2 = shapely.area(shapely.intersection(parts[one], parts[two]))
        pairs = np.sort(np.column_stack([owner[one], owner[two]]), axis=1).tolist()
        for (first, second), pair_m2 in zip(pairs, area_m2.tolist(), strict=True):
            shared[first, second] += pair_m2
        if sum(not area_m2 <= above_m2 for area_m2 in shared.values()) > PAIRS_MAX:
            break
    found = [
        Overlap(first=first, second=second, area_m2=area_m2)
        for (first, second), area_m2 in shared.items()
        if not area_m2 <= above_m2
    ]
    return sorted(found, key=lambda overlap: overlap.area_m2, reverse=True)


def _candidates(parts: Objects, owner: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Yield, in bites, each pair of parts of different zones whose boxes share ground, once."""
    tree = STRtree(parts)
    boxes = shapely.bounds(parts)
    for start in range(0, len(parts), _CHUNK):
        one, two = tree.query(parts[start : start + _CHUNK])
        one = one + start
        once = (one < two) & (owner[one] != owner[two])
        one, two = one[once], two[once]
        low = np.maximum(boxes[one, :2], boxes[two, :2])
        high = np.minimum(boxes[one, 2:], boxes[two, 2:])
        size = np.clip(high - low, 0.0, None)
        large = size[:, 0] * size[:, 1] > _BOX_MIN_M2
        one, two = one[large], two[large]
        for bite in range(0, len(one), _BITE):
            yield one[bite : bite + _BITE], two[bite : bite + _BITE]
