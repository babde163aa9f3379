"""What spray lines do to a field: covered, covered twice, and outside."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from missions.demand import Rates, Uniform
from missions.strips import Floats, Objects, rectangles, whole

# Less than this is no ground but the last digits of large numbers.
NOISE_M2 = 1e-6
# Of the cells in which rates are looked at.
CELL_M, CELLS_MAX = 0.5, 200_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """`reachable_percent` is of what a strip of that width can reach: the ground opened by it.

    `percent` is of the ground that has a rate, `without_rate_m2` what has none.
    """

    percent: float
    reachable_percent: float
    overlap_percent: float
    outside_m2: float
    largest_skip_m2: float
    without_rate_m2: float = 0.0


def reachable(ground: BaseGeometry, width_m: float) -> BaseGeometry:
    """Return the ground that a disc of half the width can touch without leaving it."""
    return ground.buffer(-width_m / 2.0).buffer(width_m / 2.0 * (1.0 - 1e-9))


def measure(
    lines: Floats, ground: BaseGeometry, width_m: float, *, strips: Objects | None = None
) -> Coverage:
    """Return what all lines cover of the ground: their whole strips, or those that are given."""
    strips = rectangles(lines, width_m) if strips is None else strips
    covered = whole(strips)
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


def of_rated_ground(
    found: Coverage, flown: Objects, ground: BaseGeometry, *, rates: Rates
) -> Coverage:
    """Return the coverage of the ground that has a rate, by the strips that are flown for it.

    The rates are looked at in the middles of cells, so many that none is wider than a boom's valve
    on most fields.
    """
    if isinstance(rates, Uniform):
        return found
    west, south, east, north = ground.bounds
    cell_m = max(CELL_M, math.sqrt((east - west) * (north - south) / CELLS_MAX))
    steps = [np.arange(a + cell_m / 2.0, b, cell_m) for a, b in ((west, east), (south, north))]
    east_m, north_m = (axis.ravel() for axis in np.meshgrid(*steps))
    shapely.prepare(ground)
    inside = shapely.contains_xy(ground, east_m, north_m)
    east_m, north_m = east_m[inside], north_m[inside]
    rated = rates.rates_at(east_m, north_m) > 0.0
    if rated.all() or not rated.any():
        return found
    covered = whole(flown)
    shapely.prepare(covered)
    treated = shapely.contains_xy(covered, east_m[rated], north_m[rated])
    return replace(
        found,
        percent=100.0 * float(treated.mean()),
        without_rate_m2=ground.area * float((~rated).mean()),
    )
