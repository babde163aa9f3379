"""A map as zones alone, for formats that know neither cells nor a default rate nor an outline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
from shapely import MultiPolygon

from missions.maps.build import frame_for
from missions.maps.convert.cell_zones import zones_of
from missions.maps.local import Area, as_area, polygons_of, project
from missions.maps.model import MapFile, MapZone

# Ground beyond the boundary that a zone may keep: less is a rounding along a shared edge.
BEYOND_MAX_M2 = 1.0
DEFAULT_NAME = "default"


def plain_zones(map_file: MapFile, *, clip: bool) -> list[MapZone]:
    """Return zones that say all that the map says, in its order.

    Cells become zones, and ground that has the map's default a zone of its own, the first. With
    `clip`, zones end at the map's boundary, because the file that is written cannot hold it.
    """
    zones = list(map_file.zones)
    if map_file.cells is not None:
        zones = zones_of(map_file.cells, path=map_file.path)
    if map_file.boundary is None:
        return zones
    default = _default_zone(map_file.boundary, zones, map_file.default_rate_l_ha)
    if clip:
        zones = _clipped(map_file, map_file.boundary, zones)
    return zones if default is None else [default, *zones]


def outline_of_rates(map_file: MapFile) -> MultiPolygon:
    """Return the ground of all that has a rate, for a format that wants an outline of the field."""
    cells = map_file.cells
    if cells is None:
        grounds = [zone.geometry for zone in map_file.zones if zone.rate_l_ha is not None]
    else:
        rated = np.where(np.isnan(cells.rates_l_ha), np.nan, 0.0)
        grounds = [zone.geometry for zone in zones_of(replace(cells, rates_l_ha=rated))]
    return MultiPolygon(polygons_of(shapely.union_all(np.array(grounds, dtype=object))))


def _default_zone(
    boundary: MultiPolygon, zones: list[MapZone], rate_l_ha: float | None
) -> MapZone | None:
    """Return the ground inside the boundary where no zone has a rate."""
    if rate_l_ha is None:
        return None
    rated = [zone.geometry for zone in zones if zone.rate_l_ha is not None]
    rest = boundary.difference(shapely.union_all(np.array(rated, dtype=object)))
    ground = as_area(polygons_of(rest))
    if ground is None:
        return None
    return MapZone(name=DEFAULT_NAME, geometry=ground, rate_l_ha=rate_l_ha)


def _clipped(map_file: MapFile, boundary: MultiPolygon, zones: list[MapZone]) -> list[MapZone]:
    frame = frame_for(map_file)
    shapely.prepare(boundary)
    kept = []
    for zone in zones:
        ground: Area | None = zone.geometry
        if not boundary.covers(zone.geometry):
            beyond = as_area(polygons_of(zone.geometry.difference(boundary)))
            if beyond is not None and project(beyond, frame).area > BEYOND_MAX_M2:
                ground = as_area(polygons_of(zone.geometry.intersection(boundary)))
        if ground is not None:
            kept.append(MapZone(name=zone.name, geometry=ground, rate_l_ha=zone.rate_l_ha))
    return kept
