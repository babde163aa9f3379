"""The prescription: which rate belongs where, and where spraying is allowed at all.

Built once, immutable. A zone is one polygon with one rate; the field is where spraying is
allowed (the boundary, or the outline of all zones, less the exclusions).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon


@dataclass(frozen=True, slots=True, kw_only=True)
class Zone:
    """One polygon of the map, in the flight's frame [m], and its rate; 0 is a rate."""

    name: str
    polygon: Polygon | MultiPolygon
    rate_l_ha: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.rate_l_ha < 100_000.0:
            raise ValueError(f"rate of zone {self.name} is no rate: {self.rate_l_ha}")


class Prescription:
    """Zones with rates and the field they may be sprayed on; see `build`."""
