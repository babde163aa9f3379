"""A flight map read as any other map: to plan over what will be flown, and to look at it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from companion.core.frame import LocalFrame
from companion.flight_map import read_flight_map
from missions.maps.crs import Floats
from missions.maps.local import Area, polygons_of
from missions.maps.model import MapFile, MapZone


def read_compiled(path: Path) -> MapFile:
    """Return a flight map in longitude and latitude; of cells, the ground of each rate.

    Its rates are L/ha already, its boundary is without the exclusions.
    """
    found = read_flight_map(path)
    prescription = found.prescription
    *areas, field = _degrees(
        [*(zone.polygon for zone in prescription.zones), prescription.field], found.frame
    )
    zones = [
        MapZone(name=zone.name, geometry=area, rate_l_ha=zone.rate_l_ha)
        for zone, area in zip(prescription.zones, areas, strict=True)
        if not area.is_empty
    ]
    return MapFile(
        path=path,
        format="flight map",
        crs="EPSG:4326",
        unit="L/ha",
        rate_field="rate_l_ha",
        zones=tuple(zones),
        sha256=prescription.sha256,
        boundary=MultiPolygon(polygons_of(field)),
        default_rate_l_ha=prescription.default_rate_l_ha,
    )


def _degrees(areas: Sequence[Area], frame: LocalFrame) -> list[Area]:
    def there(places: Floats) -> Floats:
        latitudes, longitudes = frame.to_geographic_all(
            places[:, 0].tolist(), places[:, 1].tolist()
        )
        return np.column_stack([longitudes, latitudes])

    found = shapely.transform(np.array(areas, dtype=object), there)
    return [area for area in found if isinstance(area, Polygon | MultiPolygon)]
