"""A prescription as GeoJSON (RFC 7946)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from missions.maps.model import MapZone, map_error
from missions.maps.outline import BOUNDARY_NAME
from missions.maps.whole_file import write_whole

UNIT = "L/ha"
# A tenth of a millimetre on the ground, and a millionth of a litre.
_DEGREE_DECIMALS = 9
_RATE_DECIMALS = 6


def write_geojson(
    zones: Sequence[MapZone], path: Path, *, boundary: MultiPolygon | None = None
) -> None:
    """Write a feature for every zone, one on a line.

    The outline of the field is a member of the collection beside the features, which other
    programs pass over (RFC 7946, section 6.1): as a feature it would be one more zone.
    """
    if not zones:
        raise map_error(
            path, "there is no zone to write", fix="take a map with zones", code="no-polygon"
        )
    head = '{"type": "FeatureCollection",\n'
    if boundary is not None:
        head += f'"{BOUNDARY_NAME}": {_json(_geometry(boundary))},\n'
    features = ",\n".join(_json(_feature(zone)) for zone in zones)
    text = f'{head}"features": [\n{features}\n]}}\n'
    write_whole(path, text.encode("utf-8", "replace"))


def _feature(zone: MapZone) -> dict[str, object]:
    rate = None if zone.rate_l_ha is None else round(zone.rate_l_ha, _RATE_DECIMALS)
    return {
        "type": "Feature",
        "properties": {"name": zone.name, "rate": rate, "unit": UNIT},
        "geometry": _geometry(zone.geometry),
    }


def _geometry(geometry: Polygon | MultiPolygon) -> dict[str, object]:
    """Return a geometry whose shells turn anticlockwise (RFC 7946, section 3.1.6)."""
    turned = shapely.orient_polygons(geometry, exterior_cw=False)
    parts = [
        [_positions(ring) for ring in shapely.get_rings(part)] for part in shapely.get_parts(turned)
    ]
    if isinstance(geometry, Polygon):
        return {"type": "Polygon", "coordinates": parts[0]}
    return {"type": "MultiPolygon", "coordinates": parts}


def _positions(ring: shapely.LinearRing) -> list[list[float]]:
    positions: list[list[float]] = np.round(
        shapely.get_coordinates(ring), _DEGREE_DECIMALS
    ).tolist()
    return positions


def _json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
