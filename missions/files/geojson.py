"""The whole plan as GeoJSON: a line for each leg, a point for each depot."""

from __future__ import annotations

import json
from typing import Any

from missions.plan import Leg, Place, Plan, Sortie

# 1e-9 degrees are 0.1 mm.
DIGITS = 9


def geojson_text(plan: Plan) -> str:
    """Return the content of the file."""
    features = [
        _leg(plan, sortie, sequence, leg)
        for sortie in plan.sorties
        for sequence, leg in enumerate(sortie.legs)
        if leg.length_m > 0.0
    ]
    features += [_depot(plan, number, depot) for number, depot in enumerate(plan.depots, start=1)]
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"


def _place(plan: Plan, place: Place) -> list[float]:
    latitude_deg, longitude_deg = plan.frame.to_geographic(*place)
    return [round(longitude_deg, DIGITS), round(latitude_deg, DIGITS)]


def _leg(plan: Plan, sortie: Sortie, sequence: int, leg: Leg) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": {
            "kind": leg.kind,
            "sortie": sortie.number,
            "sequence": sequence,
            "speed_m_s": leg.speed_m_s,
            "volume_l": round(leg.volume_l, 6),
            "height_m": plan.settings.height_m if leg.height_m is None else leg.height_m,
        },
        "geometry": {
            "type": "LineString",
            "coordinates": [_place(plan, point) for point in leg.points],
        },
    }


def _depot(plan: Plan, number: int, depot: Place) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": {"kind": "depot", "number": number},
        "geometry": {"type": "Point", "coordinates": _place(plan, depot)},
    }
