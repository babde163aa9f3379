"""The rates of a prescription at hundreds of thousands of places at once."""

from __future__ import annotations

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from companion.core.prescription import Prescription
from missions.strips import Floats


class MapRates:
    """What `Prescription.rates_at` says, for places inside the field.

    Zone by zone instead of place by place; where zones overlap, or there is none, the prescription
    itself is asked.
    """

    def __init__(self, prescription: Prescription) -> None:
        self._prescription = prescription
        zones = [] if prescription.cells is not None else list(prescription.zones)
        polygons = np.array([zone.polygon for zone in zones], dtype=object)
        self._parts, owner = shapely.get_parts(polygons, return_index=True)
        self._rates = np.array([zones[at].rate_l_ha for at in owner.tolist()])
        self._bounds = shapely.bounds(self._parts)
        shapely.prepare(self._parts)

    @property
    def field(self) -> BaseGeometry:
        """Return the ground outside of which nothing is sprayed."""
        return self._prescription.field

    def rates_at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Return the rate at each place [L/ha]; NaN where there is none."""
        rates = np.full(len(east_m), np.nan)
        found = np.zeros(len(east_m), dtype=np.int64)
        order = np.argsort(east_m, kind="stable")
        sorted_m = east_m[order]
        for part, rate, bounds in zip(self._parts, self._rates, self._bounds, strict=True):
            first, last = np.searchsorted(sorted_m, (bounds[0], bounds[2]))
            some = order[first : last + 1]
            some = some[(north_m[some] >= bounds[1]) & (north_m[some] <= bounds[3])]
            inside = some[shapely.contains_xy(part, east_m[some], north_m[some])]
            rates[inside] = rate
            found[inside] += 1
        has_default = self._prescription.default_rate_l_ha is not None
        ask = (found > 1) | ((found == 0) & (has_default or self._prescription.cells is not None))
        if ask.any():
            rates[ask] = self._prescription.rates_at(east_m[ask], north_m[ask])
        return rates
