"""Where the liquid falls: the strips of the valves along the true path, on a raster, exactly.

What leaves a valve between two times is spread evenly over elements across its strip and falls
straight down at the middle of the way. Wind, tilt and the fall of droplets are left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import shapely
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence


Floats = NDArray[np.float64]

ELEMENT_M = 0.1
# Time steps along the path are joined up to this length; the raster is not finer.
STEP_M = 0.05
_CHUNK = 8192
L_HA_PER_ML_M2 = 10.0


class Nozzles(Protocol):
    """What one valve covers: the middle of its strip in the body frame, and its width."""

    @property
    def right_m(self) -> float: ...  # noqa: D102
    @property
    def forward_m(self) -> float: ...  # noqa: D102
    @property
    def width_m(self) -> float: ...  # noqa: D102


class Strips(Protocol):
    """A boom as it is mounted: lengths, and nothing worked out of them."""

    @property
    def width_m(self) -> float: ...  # noqa: D102
    @property
    def valves(self) -> Sequence[Nozzles]: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class _Strip:
    """What one valve dropped: middles of its strip, unit vectors along it, volumes."""

    east_m: Floats
    north_m: Floats
    right_east: Floats
    right_north: Floats
    volume_ml: Floats
    width_m: float

    def elements(self, chosen: NDArray[np.bool_] | None = None) -> Iterator[tuple[Floats, ...]]:
        """Yield (east, north, volume) of the elements, a chunk at a time."""
        count = max(1, math.ceil(self.width_m / ELEMENT_M - 1e-9))
        offset_m = self.width_m * ((np.arange(count) + 0.5) / count - 0.5)
        rows = np.flatnonzero(self.volume_ml if chosen is None else chosen)
        for first in range(0, len(rows), _CHUNK):
            row = rows[first : first + _CHUNK]
            east_m = self.east_m[row, None] + offset_m * self.right_east[row, None]
            north_m = self.north_m[row, None] + offset_m * self.right_north[row, None]
            volume_ml = np.repeat(self.volume_ml[row] / count, count)
            yield east_m.ravel(), north_m.ravel(), volume_ml


class Deposit:
    """Volume on a raster of square cells over `bounds` (west, south, east, north) [m].

    What falls beside the raster is counted too, so that the sum is what was put out.
    """

    def __init__(self, bounds: tuple[float, float, float, float], cell_m: float = 0.1) -> None:
        west_m, south_m, east_m, north_m = bounds
        if not (west_m < east_m and south_m < north_m and cell_m > 0.0):
            raise ValueError(f"no raster of {cell_m} m cells over {bounds}")
        self.west_m, self.south_m, self.cell_m = west_m, south_m, cell_m
        self.columns = math.ceil((east_m - west_m) / cell_m - 1e-9)
        self.rows = math.ceil((north_m - south_m) / cell_m - 1e-9)
        if not self.rows * self.columns <= 200_000_000:
            raise ValueError(f"a raster of {self.rows} x {self.columns} cells is too large")
        # One more cell for what falls beside.
        self._cells_ml = np.zeros(self.rows * self.columns + 1)
        self._strips: list[_Strip] = []

    @property
    def cells_ml(self) -> Floats:
        """Return the volume of each cell: rows from south, columns from west."""
        return self._cells_ml[:-1].reshape(self.rows, self.columns)

    @property
    def total_ml(self) -> float:
        """Return all that fell."""
        return float(self._cells_ml.sum())

    @property
    def applied_l_ha(self) -> Floats:
        """Return the rate that each cell received."""
        return self.cells_ml * (L_HA_PER_ML_M2 / self.cell_m**2)

    def add(
        self,
        *,
        east_m: Floats,
        north_m: Floats,
        heading_deg: Floats,
        volume_ml: Floats,
        boom: Strips,
    ) -> None:
        """Add a piece of flight: the path at some times, (n, valves) cumulative volumes then."""
        if not len(east_m) == len(north_m) == len(heading_deg) == len(volume_ml):
            raise ValueError("path and volumes are not of the same times")
        if volume_ml.shape[1] != len(boom.valves):
            raise ValueError(f"{volume_ml.shape[1]} volumes for {len(boom.valves)} valves")
        kept = _thinned(east_m, north_m, heading_deg, 0.5 * boom.width_m)
        east_m, north_m = _middles(east_m[kept]), _middles(north_m[kept])
        # Where the heading wraps, its middle lies the short way round.
        heading_rad = np.radians(_middles(np.unwrap(heading_deg[kept], period=360.0)))
        sin, cos = np.sin(heading_rad), np.cos(heading_rad)
        dropped_ml = np.diff(volume_ml[kept], axis=0)
        for valve, of_valve_ml in zip(boom.valves, dropped_ml.T, strict=True):
            strip = _Strip(
                east_m + valve.forward_m * sin + valve.right_m * cos,
                north_m + valve.forward_m * cos - valve.right_m * sin,
                cos,
                -sin,
                of_valve_ml,
                valve.width_m,
            )
            self._strips.append(strip)
            for element_east, element_north, element_ml in strip.elements():
                self._put(element_east, element_north, element_ml)

    def _put(self, east_m: Floats, north_m: Floats, volume_ml: Floats) -> None:
        column = np.floor((east_m - self.west_m) / self.cell_m).astype(np.int64)
        row = np.floor((north_m - self.south_m) / self.cell_m).astype(np.int64)
        beside = (column < 0) | (column >= self.columns) | (row < 0) | (row >= self.rows)
        index = np.where(beside, len(self._cells_ml) - 1, row * self.columns + column)
        # bincount over the whole raster is slow for a small chunk: over the span that it touches.
        cells, place = np.unique(index, return_inverse=True)
        self._cells_ml[cells] += np.bincount(place, weights=volume_ml, minlength=len(cells))

    def off_target_ml(self, field: shapely.Polygon | shapely.MultiPolygon) -> float:
        """Return what fell outside `field`, judged at each element's point and not its cell."""
        shapely.prepare(field)
        outside_ml = 0.0
        inner: dict[float, shapely.Geometry] = {}
        for strip in self._strips:
            if strip.width_m not in inner:
                inner[strip.width_m] = field.buffer(-0.5 * strip.width_m - 1e-3)
                shapely.prepare(inner[strip.width_m])
            wet = strip.volume_ml != 0.0
            near = np.zeros(len(wet), dtype=np.bool_)
            near[wet] = ~shapely.contains_xy(
                inner[strip.width_m], strip.east_m[wet], strip.north_m[wet]
            )
            for east_m, north_m, volume_ml in strip.elements(near):
                inside = shapely.intersects_xy(field, east_m, north_m)
                outside_ml += float(volume_ml[~inside].sum())
        return outside_ml


def _middles(values: Floats) -> Floats:
    middles: Floats = 0.5 * (values[:-1] + values[1:])
    return middles


def _thinned(
    east_m: Floats, north_m: Floats, heading_deg: Floats, reach_m: float
) -> NDArray[np.int64]:
    """Return indices between which no point of the boom moves by more than `STEP_M`, if it can."""
    turn_rad = np.radians(np.diff(np.unwrap(heading_deg, period=360.0)))
    moved_m = np.hypot(np.diff(east_m), np.diff(north_m)) + reach_m * np.abs(turn_rad)
    way_m = np.concatenate(([0.0], np.cumsum(moved_m)))
    # The last sample of each stretch of STEP_M, so that a stretch is never exceeded.
    stretch = np.floor(way_m / STEP_M).astype(np.int64)
    last = np.flatnonzero(np.diff(stretch))
    return np.unique(np.concatenate(([0], last, [len(way_m) - 1])))
