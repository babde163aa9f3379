"""How much of a flight fell on ground whose rate is 0."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import shapely

from analysis.border import off_target_ml
from analysis.strips import strips_of
from companion.core.prescription import Prescription

if TYPE_CHECKING:
    from analysis.flight_record import FlightRecord


def zero_rate_ml(record: FlightRecord, outside_ml: float) -> float:
    """Return what fell on ground whose rate is 0, given what fell outside the field."""
    prescription = record.prescription
    bounds = shapely.total_bounds(shapely.points(record.east_m, record.north_m))
    near = shapely.box(*bounds).buffer(record.boom.reach_m + 1.0)
    dry, wet = (
        shapely.union_all(
            [
                zone.polygon
                for zone in prescription.zones
                if (zone.rate_l_ha > 0.0) == is_wet and zone.polygon.intersects(near)
            ]
        )
        for is_wet in (False, True)
    )
    dry = dry.intersection(prescription.field).difference(wet)
    if dry.is_empty:
        return 0.0
    ground = prescription.field.difference(dry)
    open_ground = Prescription(
        prescription.zones,
        boundary=shapely.MultiPolygon(
            [part for part in shapely.get_parts(ground) if isinstance(part, shapely.Polygon)]
        ),
        overlap=prescription.overlap,
        default_rate_l_ha=prescription.default_rate_l_ha,
    )
    sure = replace(record, prescription=open_ground)
    return max(off_target_ml(strips_of(sure), open_ground) - outside_ml, 0.0)
