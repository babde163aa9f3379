"""What a prescription file says, before it becomes the core's `Prescription`.

Everything here is already decided: coordinates are WGS84 longitude and latitude, rates are L/ha.
What was found on the way is kept as `Problem`s, so that nothing is repaired in silence.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from companion.errors import MapError, Problem, Severity

__all__ = [
    "Affine", "MapCells", "MapFile", "MapZone", "Problem", "Severity", "map_error",
    "unusable_polygons",
]  # fmt: skip

Floats = NDArray[np.float64]

# A rate column holds at most this, in L/ha; the core refuses the same.
RATE_MAX_L_HA = 100_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MapZone:
    """One record of the file: its ground in longitude and latitude, and its rate.

    `rate_l_ha` None means that the file gives no rate here; 0 means that it says zero.
    """

    name: str
    geometry: Polygon | MultiPolygon
    rate_l_ha: float | None

    def __post_init__(self) -> None:
        if self.rate_l_ha is not None and not 0.0 <= self.rate_l_ha < RATE_MAX_L_HA:
            raise ValueError(f"rate of zone {self.name} is no rate: {self.rate_l_ha}")

    @property
    def part_count(self) -> int:
        """Return the number of single polygons."""
        return int(shapely.get_num_geometries(self.geometry))

    @property
    def hole_count(self) -> int:
        """Return the number of holes in all parts."""
        return int(shapely.get_num_interior_rings(shapely.get_parts(self.geometry)).sum())


# x = a column + b row + c, y = d column + e row + f: from the corner of a cell to coordinates.
Affine = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCells:
    """A map in rows and columns of cells, as the file has them.

    Args:
        rates_l_ha: (rows, columns); NaN where the file gives no rate, 0 where it says zero.
        transform: from (column, row) to x and y of `crs`; whole numbers are corners of cells, so
            the centre of the first cell is at (0.5, 0.5).
        crs: of x and y, always x (or longitude) first.
    """

    rates_l_ha: Floats
    transform: Affine
    crs: CRS

    def __post_init__(self) -> None:
        rates = self.rates_l_ha
        if rates.ndim != 2 or not rates.size:
            raise ValueError(f"cells need rows and columns: {rates.shape}")
        with np.errstate(invalid="ignore"):
            wrong = ~np.isnan(rates) & ~((rates >= 0.0) & (rates < RATE_MAX_L_HA))
        if wrong.any():
            raise ValueError(f"rate of a cell is no rate: {rates[wrong][0]}")
        a, b, _, d, e, _ = self.transform
        if not (np.isfinite(self.transform).all() and a * e - b * d != 0.0):
            raise ValueError(f"the cells have no size: {self.transform}")


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFile:
    """One prescription file, understood; `sha256` is over all bytes of its set of files.

    It holds either `zones` or `cells`. `boundary`, in longitude and latitude, is the outline of
    the field where the file has one; `default_rate_l_ha` is what the file prescribes inside it
    where there is no zone.
    """

    path: Path
    format: str
    crs: str
    unit: str
    rate_field: str
    zones: tuple[MapZone, ...]
    sha256: str
    cells: MapCells | None = None
    boundary: MultiPolygon | None = None
    default_rate_l_ha: float | None = None
    problems: tuple[Problem, ...] = ()

    def __post_init__(self) -> None:
        if self.cells is not None and self.zones:
            raise ValueError("a map has zones or cells, not both")

    @property
    def rates_l_ha(self) -> tuple[float, ...]:
        """Return the different rates in the file, the least first."""
        if self.cells is not None:
            rates = self.cells.rates_l_ha
            return tuple(np.unique(rates[~np.isnan(rates)]).tolist())
        return tuple(sorted({zone.rate_l_ha for zone in self.zones if zone.rate_l_ha is not None}))


def map_error(path: Path, text: str, *, fix: str, code: str = "unusable") -> MapError:
    """Return the error for a file that cannot be used: one line with file, reason and fix."""
    line = " ".join(f"{path}: {text}; {fix}".split())
    return MapError(line if len(line) <= 600 else f"{line[:597]}...", code=code, fix=fix)


def unusable_polygons(path: Path, error: ShapelyError) -> MapError:
    """Return the error for polygons with which geometry itself fails."""
    return map_error(
        path,
        f"its polygons cannot be used ({str(error)[:120]})",
        fix="repair the map where it is made, and export it again",
        code="broken-geometry",
    )
