"""What a prescription file says, before it becomes the core's `Prescription`.

Everything here is already decided: coordinates are WGS84 longitude and latitude, rates are L/ha.
What was found on the way is kept as `Problem`s, so that nothing is repaired in silence.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import shapely
from shapely import MultiPolygon, Polygon

from companion.errors import MapError

Severity = Literal["error", "warning"]

# A rate column holds at most this, in L/ha; the core refuses the same.
RATE_MAX_L_HA = 100_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One thing that is wrong or remarkable, where it is, and what the operator can do."""

    severity: Severity
    code: str
    text: str
    where: str = ""
    fix: str = ""

    def __post_init__(self) -> None:
        if self.severity not in ("error", "warning"):
            raise ValueError(f"no severity: {self.severity}")


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


@dataclass(frozen=True, slots=True, kw_only=True)
class MapFile:
    """One prescription file, understood; `sha256` is over all bytes of its set of files."""

    path: Path
    format: str
    crs: str
    unit: str
    rate_field: str
    zones: tuple[MapZone, ...]
    sha256: str
    problems: tuple[Problem, ...] = ()


def map_error(path: Path, text: str, *, fix: str) -> MapError:
    """Return the error for a file that cannot be used: one line with file, reason and fix."""
    line = " ".join(f"{path}: {text}; {fix}".split())
    return MapError(line if len(line) <= 600 else f"{line[:597]}...")
