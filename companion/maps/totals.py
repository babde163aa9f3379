"""What a map prescribes in all: ground and litres of each rate, as it would be sprayed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely

from companion.core.frame import LocalFrame
from companion.maps.build import frame_for
from companion.maps.cells import cell_areas_m2
from companion.maps.convert.plain_zones import plain_zones
from companion.maps.convert.rasterise import in_field
from companion.maps.local import project_all
from companion.maps.model import Floats, MapFile

M2_PER_HA = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """All ground of each rate, the least rate first; where zones overlap it counts for each."""

    rates_l_ha: Floats
    areas_ha: Floats

    @property
    def litres(self) -> Floats:
        """Return what the ground of each rate takes."""
        return self.rates_l_ha * self.areas_ha

    @property
    def area_ha(self) -> float:
        """Return the ground of all rates."""
        return float(self.areas_ha.sum())

    @property
    def all_litres(self) -> float:
        """Return what all ground takes."""
        return float(self.litres.sum())


def as_sprayed(map_file: MapFile) -> MapFile:
    """Return the map without a default: it has become zones or cells, none beyond the boundary."""
    if map_file.boundary is None:
        return replace(map_file, default_rate_l_ha=None)
    if map_file.cells is None:
        zones = tuple(plain_zones(map_file, clip=True))
        return replace(map_file, zones=zones, default_rate_l_ha=None)
    cells = in_field(map_file.cells, map_file, clip=True)
    return replace(map_file, cells=cells, default_rate_l_ha=None)


def totals(map_file: MapFile, frame: LocalFrame | None = None) -> Totals:
    """Return the ground of each rate."""
    frame = frame_for(map_file) if frame is None else frame
    if map_file.cells is None:
        rated = [zone for zone in map_file.zones if zone.rate_l_ha is not None]
        rates = np.array([zone.rate_l_ha for zone in rated], dtype=np.float64)
        ground = np.array([zone.geometry for zone in rated], dtype=object)
        area_m2 = shapely.area(project_all(ground, frame)) if rated else np.zeros(0)
    else:
        there = ~np.isnan(map_file.cells.rates_l_ha)
        rates = map_file.cells.rates_l_ha[there]
        area_m2 = cell_areas_m2(map_file.cells, frame)[there]
    different, index = np.unique(rates, return_inverse=True)
    sums = np.bincount(index, weights=area_m2, minlength=len(different))
    return Totals(rates_l_ha=different, areas_ha=sums / M2_PER_HA)
