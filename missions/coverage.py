"""What spray lines do to a field: covered, covered twice, and outside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from missions.strips import Floats, rectangles

# Less than this is no ground but the last digits of large numbers.
NOISE_M2 = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """`reachable_percent` is of what a strip of that width can reach: the ground opened by it."""

    percent: float
    reachable_percent: float
    overlap_percent: float
    outside_m2: float
    largest_skip_m2: float


def reachable(ground: BaseGeometry, width_m: float) -> BaseGeometry:
    """Return the ground that a disc of half the width can touch without leaving it."""
    return ground.buffer(-width_m / 2.0).buffer(width_m / 2.0 * (1.0 - 1e-9))


def measure(lines: Floats, ground: BaseGeometry, width_m: float) -> Coverage:
    """Return what the whole strips of all lines cover of the ground, without help of valves."""
    strips = rectangles(lines, width_m)
    covered = shapely.union_all(strips)
    area_m2 = ground.area
    if not area_m2 > 0.0:
        raise ValueError("there is no ground to cover")
    possible = reachable(ground, width_m)
    inside = shapely.intersection(covered, ground)
    outside_m2 = covered.area - inside.area
    skipped = shapely.difference(ground, covered)
    patches = shapely.area(shapely.get_parts(skipped))
    reached = shapely.intersection(covered, possible).area
    return Coverage(
        percent=100.0 * inside.area / area_m2,
        reachable_percent=100.0 * reached / possible.area if possible.area > 0.0 else 100.0,
        overlap_percent=100.0
        * max(float(shapely.area(strips).sum()) - covered.area, 0.0)
        / area_m2,
        outside_m2=outside_m2 if outside_m2 > NOISE_M2 else 0.0,
        largest_skip_m2=float(np.max(patches, initial=0.0)),
    )
