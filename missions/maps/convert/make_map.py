"""Maps for trials and tests: points in P2's format, and plots in rows as in P1's field.

Everything follows from the arguments and a seed: the same call makes the same map.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from companion.core.frame import LocalFrame
from missions.maps.model import Floats, MapFile, MapZone
from missions.maps.text.text_points import MAX_POINTS, TangentPlane, TextMap

PLOTS_MAX = 100_000
RANGE_MAX_M = 20_000.0
# Different rates in a map of points, and bumps in its field.
LEVELS = 10
_BUMPS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class Points:
    """What a map of points shall be: `count` of them over two ranges, rates in L/min.

    The coordinates begin at `east_min_m` and `north_min_m` from the origin (latitude, longitude,
    altitude).
    """

    origin: tuple[float, float, float]
    count: int
    east_range_m: float
    north_range_m: float
    east_min_m: float = 0.0
    north_min_m: float = 0.0
    rate_min_l_min: float
    rate_max_l_min: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not 4 <= self.count <= MAX_POINTS:
            raise ValueError(f"a map has 4 to {MAX_POINTS} points, not {self.count}")
        for size in (self.east_range_m, self.north_range_m):
            if not 0.0 < size <= RANGE_MAX_M:
                raise ValueError(f"a map reaches over 0 to {RANGE_MAX_M:g} m, not {size:g}")
        for start in (self.east_min_m, self.north_min_m):
            if not abs(start) <= RANGE_MAX_M:
                raise ValueError(f"a map lies within {RANGE_MAX_M:g} m of its origin")
        if not 0.0 <= self.rate_min_l_min <= self.rate_max_l_min < 1e5:
            raise ValueError(
                f"no rates in L/min: {self.rate_min_l_min:g} to {self.rate_max_l_min:g}"
            )


def make_points(wanted: Points) -> TextMap:
    """Return points in rows, like vines, that fill both ranges to their ends.

    >>> made = make_points(Points(
    ...     origin=(39.5, -0.4, 50.0), count=7, east_range_m=20.0, north_range_m=10.0,
    ...     rate_min_l_min=10.0, rate_max_l_min=13.0,
    ... ))
    >>> made.count, float(made.rate_l_min.min()), float(made.rate_l_min.max())
    (7, 10.0, 13.0)
    """
    across = math.sqrt(wanted.count * wanted.north_range_m / wanted.east_range_m)
    rows = min(max(2, round(across)), wanted.count // 2)
    counts = [wanted.count // rows + (row < wanted.count % rows) for row in range(rows)]
    east = np.concatenate([np.linspace(0.0, wanted.east_range_m, count) for count in counts])
    north = np.repeat(np.linspace(0.0, wanted.north_range_m, rows), counts)
    rates = _rates(east / wanted.east_range_m, north / wanted.north_range_m, wanted)
    latitude, longitude, altitude = wanted.origin
    plane = TangentPlane(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    found = plane.to_geodetic(
        east + wanted.east_min_m, north + wanted.north_min_m, np.zeros(wanted.count)
    )
    return TextMap(
        latitude_deg=found[0], longitude_deg=found[1], altitude_m=found[2], rate_l_min=rates
    )


def _rates(x: Floats, y: Floats, wanted: Points) -> Floats:
    """Return a hilly field in steps, from the least to the largest rate."""
    chance = random.Random(wanted.seed)
    height = np.zeros(len(x))
    for _ in range(_BUMPS):
        east, north, width = chance.random(), chance.random(), 0.1 + 0.3 * chance.random()
        size = chance.choice((-1.0, 1.0)) * (0.5 + chance.random())
        height += size * np.exp(-((x - east) ** 2 + (y - north) ** 2) / (2.0 * width**2))
    low, high = float(height.min()), float(height.max())
    share = (height - low) / (high - low) if high > low else np.zeros(len(x))
    steps = np.rint(share * (LEVELS - 1)) / (LEVELS - 1)
    span = wanted.rate_max_l_min - wanted.rate_min_l_min
    rates: Floats = np.round(wanted.rate_min_l_min + span * steps, 6)
    return rates


@dataclass(frozen=True, slots=True, kw_only=True)
class Plots:
    """What a map of plots shall be: rows of rectangles, rates in L/ha.

    A row runs in the direction of `angle_deg` (clockwise from north) from the origin, and each
    further row lies to the left of the one before it.

    Args:
        origin: latitude and longitude of the corner where the first plot begins, on its right.
        rates_l_ha: one after the other along the rows, again and again; with a seed, each time
            in another order, so that every row of as many plots has each rate once.
        gap_m: alley between plots, without a rate.
    """

    origin: tuple[float, float]
    rows: int
    columns: int
    length_m: float
    width_m: float
    rates_l_ha: tuple[float, ...]
    gap_m: float = 0.0
    angle_deg: float = 90.0
    seed: int | None = None

    def __post_init__(self) -> None:
        if not (self.rows >= 1 and self.columns >= 1 and self.rows * self.columns <= PLOTS_MAX):
            raise ValueError(f"a map has 1 to {PLOTS_MAX} plots")
        if not (0.1 <= self.length_m <= RANGE_MAX_M and 0.1 <= self.width_m <= RANGE_MAX_M):
            raise ValueError(f"a plot is 0.1 to {RANGE_MAX_M:g} m long and wide")
        if not 0.0 <= self.gap_m <= 1_000.0:
            raise ValueError(f"a gap between plots is 0 to 1000 m, not {self.gap_m:g}")
        longest = max(
            self.columns * (self.length_m + self.gap_m), self.rows * (self.width_m + self.gap_m)
        )
        if not longest <= RANGE_MAX_M:
            raise ValueError(f"the plots reach over {longest:g} m, more than {RANGE_MAX_M:g}")
        if not math.isfinite(self.angle_deg):
            raise ValueError(f"no direction: {self.angle_deg}")
        if not self.rates_l_ha or not all(0.0 <= rate < 1e5 for rate in self.rates_l_ha):
            raise ValueError("plots need rates in L/ha, 0 or more")


def make_plots(wanted: Plots, path: Path, *, map_format: str) -> MapFile:
    """Return the plots as a map, row by row; the first is called r1c1, the next r1c2."""
    frame = LocalFrame(latitude_deg=wanted.origin[0], longitude_deg=wanted.origin[1])
    heading = math.radians(wanted.angle_deg)
    # Along the row, and to the left of it.
    turn = np.array(
        [[math.sin(heading), math.cos(heading)], [-math.cos(heading), math.sin(heading)]]
    )

    def to_degrees(points: Floats) -> Floats:
        local = points @ turn
        latitude, longitude = frame.to_geographic_all(local[:, 0].tolist(), local[:, 1].tolist())
        return np.column_stack([longitude, latitude])

    row, column = np.divmod(np.arange(wanted.rows * wanted.columns), wanted.columns)
    along = column * (wanted.length_m + wanted.gap_m)
    left = row * (wanted.width_m + wanted.gap_m)
    plots = shapely.box(along, left, along + wanted.length_m, left + wanted.width_m)
    zones = [
        MapZone(name=f"r{row + 1}c{column + 1}", geometry=ground, rate_l_ha=rate)
        for row, column, ground, rate in zip(
            row.tolist(),
            column.tolist(),
            shapely.transform(plots, to_degrees),
            plot_rates(wanted),
            strict=True,
        )
    ]
    return MapFile(
        path=path,
        format=map_format,
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="rate",
        zones=tuple(zones),
        sha256="",
    )


def plot_rates(wanted: Plots) -> list[float]:
    """Return the rate of every plot, row by row."""
    chance = None if wanted.seed is None else random.Random(wanted.seed)
    count = wanted.rows * wanted.columns
    found: list[float] = []
    while len(found) < count:
        block: Sequence[float] = wanted.rates_l_ha
        if chance is not None:
            block = chance.sample(block, len(block))
        found.extend(block)
    return found[:count]
