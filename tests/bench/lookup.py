"""The rate at a point: our tree of polygons beside the paper's loop over all of them."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter

import numpy as np
from pyproj import CRS
from shapely import Point

from companion.core.prescription import Prescription
from missions.maps.build import build_prescription, frame_for
from missions.maps.model import MapCells, MapFile
from tests.bench.fields import example, grid_zones
from tests.bench.figures import Figure, collector_as_in_flight, spread

TARGET_US = 20.0


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


def lookup_growth(*, seed: int, zones: tuple[int, int] = (100, 100_000), n: int = 3000) -> Figure:
    """Measure what a look-up costs on a map of many zones over what it costs on one of few."""
    means = []
    for count in zones:
        columns = round(count**0.5)
        made = Prescription(grid_zones(count // columns, columns, seed=seed))
        west, south, east, north = made.bounds_m
        rng = np.random.default_rng(seed)
        points = list(zip(rng.uniform(west, east, n), rng.uniform(south, north, n), strict=True))
        with collector_as_in_flight():
            means.append(_mean_us(made, points))
    return Figure(
        key="lookup_growth",
        what=f"rate at a point: {zones[1]} polygons over {zones[0]}",
        value=means[1] / means[0],
        unit="",
        n=n,
        target=2.0,
        details={"few": means[0], "many": means[1]},
    )


def cell_lookup(*, seed: int, side: int = 1000, n: int = 3000) -> Figure:
    """Measure look-ups on `side` x `side` cells, each of its own rate."""
    rng = np.random.default_rng(seed)
    degree = 9e-6
    cells = MapCells(
        rates_l_ha=rng.uniform(10.0, 30.0, (side, side)),
        transform=(degree, 0.0, 114.5, 0.0, -degree, 36.0),
        crs=CRS.from_epsg(4326),
    )
    found = MapFile(
        path=Path("raster.tif"), format="geotiff", crs="EPSG:4326", unit="L/ha",
        rate_field="band 1", zones=(), sha256="", cells=cells,
    )  # fmt: skip
    made = build_prescription(found, frame_for(found))
    west, south, east, north = made.bounds_m
    points = list(zip(rng.uniform(west, east, n), rng.uniform(south, north, n), strict=True))
    with collector_as_in_flight():
        mean = _mean_us(made, points)
    return Figure(
        key=f"lookup_{side * side}_cells",
        what=f"rate at a point, {side * side} cells: mean",
        value=mean,
        unit="us",
        n=n,
        target=TARGET_US,
    )


def _mean_us(prescription: Prescription, points: list[tuple[float, float]]) -> float:
    for place in points[:50]:
        prescription.rate_at(*place)
    begin = perf_counter()
    for place in points:
        prescription.rate_at(*place)
    return (perf_counter() - begin) * 1e6 / len(points)


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
        target=TARGET_US,
        alternative={"linear scan": scan["mean"]},
        details={**found, "each_of_many": together, "scan_n": len(slow)},
    )
