"""The rate at given points, as the core sees it in flight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from shapely import STRtree

from companion.maps.build import build_prescription, frame_for
from companion.maps.local import places
from companion.maps.model import MapFile, MapZone

Point = tuple[float, float]
Answer = tuple[float | None, list[str]]


def point_rates(
    map_file: MapFile, points: Sequence[Point], *, overlap: str = "error"
) -> list[dict[str, object]]:
    """Return rate and zone at each (latitude, longitude), in the order of the points.

    A point exactly on an edge takes the smallest rate of the zones that meet there. Ground that
    only a zone without a rate covers has that zone's name and no rate.
    """
    frame = frame_for(map_file)
    prescription = build_prescription(map_file, frame, overlap=overlap)
    east_m, north_m = places(points, frame).T
    real = np.isfinite(east_m) & np.isfinite(north_m)
    found = prescription.zones_at(np.where(real, east_m, np.inf), np.where(real, north_m, np.inf))
    answers: dict[int, Answer] = {
        index: (
            prescription.rate_of(zones),
            [prescription.zones[zone].name for zone in sorted(zones)],
        )
        for index, zones in enumerate(found)
        if zones
    }
    answers |= _touched(
        map_file, points, [i for i in range(len(points)) if real[i] and i not in answers]
    )
    return [_row(point, *answers.get(index, (None, []))) for index, point in enumerate(points)]


def _row(point: Point, rate_l_ha: float | None, names: list[str]) -> dict[str, object]:
    latitude_deg, longitude_deg = point
    zone = ", ".join(names) if names else None
    return {"lat": latitude_deg, "lon": longitude_deg, "rate_l_ha": rate_l_ha, "zone": zone}


def _touched(map_file: MapFile, points: Sequence[Point], which: list[int]) -> dict[int, Answer]:
    """Return, for points inside no zone with a rate, the smallest rate and the zones touched."""
    if not which:
        return {}
    zones = map_file.zones
    parts, owner = shapely.get_parts(
        np.array([zone.geometry for zone in zones], dtype=object), return_index=True
    )
    spots = shapely.points([(points[index][1], points[index][0]) for index in which])
    around: dict[int, list[MapZone]] = {index: [] for index in which}
    for place, part in STRtree(parts).query(spots, predicate="intersects").T.tolist():
        around[which[place]].append(zones[owner[part]])
    return {index: _smallest(met) for index, met in around.items()}


def _smallest(met: list[MapZone]) -> Answer:
    rates = [zone.rate_l_ha for zone in met if zone.rate_l_ha is not None]
    if not rates:
        return None, [zone.name for zone in met]
    return min(rates), [zone.name for zone in met if zone.rate_l_ha == min(rates)]
