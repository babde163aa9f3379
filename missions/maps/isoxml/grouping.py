"""Zones of a map as treatment zones of a task, which has room for only so many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.errors import ShapelyError

from missions.maps.isoxml.elements import printable, raw_rate
from missions.maps.local import polygons_of
from missions.maps.model import MapZone, map_error

# Codes go from 0 to 254 (ISO 11783-10), three of which are for the special cases.
ZONES_MAX = 252


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneGroup:
    """What becomes one treatment zone; `raw` None where no rate is prescribed."""

    name: str
    raw: int | None
    polygons: tuple[Polygon, ...]


def grouped(zones: Sequence[MapZone], path: Path) -> list[ZoneGroup]:
    """Return each zone by itself, or where they are too many, all of one rate together."""
    if len(zones) <= ZONES_MAX:
        return [
            ZoneGroup(
                name=printable(zone.name),
                raw=_raw(zone),
                polygons=tuple(polygons_of(zone.geometry)),
            )
            for zone in zones
        ]
    by_raw: dict[int | None, list[MapZone]] = {}
    for zone in zones:
        by_raw.setdefault(_raw(zone), []).append(zone)
    if len(by_raw) > ZONES_MAX:
        raise map_error(
            path,
            f"the map has {len(by_raw)} different rates, and ISOXML has room for {ZONES_MAX} "
            "treatment zones",
            fix="round the rates (--round), or convert the map to another format",
            code="too-many-rates",
        )
    return [
        ZoneGroup(
            name="no rate" if raw is None else f"{raw / 1e4:.10g} L/ha",
            raw=raw,
            polygons=tuple(part for zone in ones for part in polygons_of(zone.geometry)),
        )
        for raw, ones in by_raw.items()
    ]


def outline(zones: Sequence[MapZone], path: Path) -> MultiPolygon | None:
    """Return the ground of all zones together, as the outline of a field that has none."""
    if not zones:
        return None
    try:
        united = shapely.union_all(np.array([zone.geometry for zone in zones], dtype=object))
    except ShapelyError as error:
        raise map_error(
            path,
            f"the zones have no outline ({str(error)[:120]})",
            fix="give the map a boundary, or repair its zones",
            code="broken-geometry",
        ) from None
    return MultiPolygon(polygons_of(united))


def _raw(zone: MapZone) -> int | None:
    return None if zone.rate_l_ha is None else raw_rate(zone.rate_l_ha)
