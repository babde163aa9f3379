"""The rate at a point: our tree of polygons beside the paper's loop over all of them."""

from __future__ import annotations

from time import perf_counter

import numpy as np
from shapely import Point

from companion.core.prescription import Prescription
from tests.bench.fields import example, grid_zones
from tests.bench.figures import Figure, collector_as_in_flight, spread


def linear_scan(prescription: Prescription, east_m: float, north_m: float) -> float | None:
    """Return the rate as Wang et al. 2024, Table 4, find it: polygon by polygon."""
    point = Point(east_m, north_m)
    for zone in prescription.zones:
        if zone.polygon.contains(point):
            return zone.rate_l_ha
    return None


def lookups(
    *, seed: int, sides: tuple[int, ...] = (32, 150), ours: int = 3000, theirs: int = 300
) -> list[Figure]:
    """Measure look-ups on the example's 40 plots and on grids of `sides` x `sides`."""
    maps = [example().prescription]
    maps += [Prescription(grid_zones(side, side, seed=seed)) for side in sides]
    with collector_as_in_flight():
        return [_one_map(each, seed=seed, ours=ours, theirs=theirs) for each in maps]


def _one_map(prescription: Prescription, *, seed: int, ours: int, theirs: int) -> Figure:
    west, south, east, north = prescription.bounds_m
    rng = np.random.default_rng(seed)
    points = list(zip(rng.uniform(west, east, ours), rng.uniform(south, north, ours), strict=True))
    for place in points[:50]:
        prescription.rate_at(*place)
    fast = []
    for place in points:
        begin = perf_counter()
        prescription.rate_at(*place)
        fast.append((perf_counter() - begin) * 1e6)
    slow = []
    # A whole scan of a large map takes milliseconds: fewer points there.
    count = max(10, min(theirs, theirs * 1_000 // len(prescription.zones)))
    for place in points[:count]:
        begin = perf_counter()
        linear_scan(prescription, *place)
        slow.append((perf_counter() - begin) * 1e6)
    begin = perf_counter()
    prescription.rates_at(*np.array(points).T)
    together = (perf_counter() - begin) * 1e6 / len(points)
    found, scan = spread(fast), spread(slow)
    zones = len(prescription.zones)
    return Figure(
        key=f"lookup_{zones}_polygons",
        what=f"rate at a point, {zones} polygons: mean",
        value=found["mean"],
        unit="us",
        n=len(fast),
        alternative={"linear scan": scan["mean"]},
        details={**found, "each_of_many": together, "scan_n": len(slow)},
    )
