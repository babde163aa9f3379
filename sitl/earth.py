"""Where on the ellipsoid a place in metres lies: the twin's own, shared with no one it judges.

The metres are those of a transverse Mercator projection with scale 1 at its origin, worked out from
the radii of curvature of WGS84 to the third order: to a millimetre within 20 km.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
E2 = FLATTENING * (2.0 - FLATTENING)
# Each round of the way back is nearer by the square of the field's size over the earth's.
ROUNDS = 5


@dataclass(frozen=True, slots=True)
class Earth:
    """Metres east and north of a place (degrees, WGS84).

    >>> earth = Earth(latitude_deg=35.996, longitude_deg=114.543)
    >>> east_m, north_m = earth.to_local_all([35.996], [114.544])
    >>> round(float(east_m[0]), 2), round(float(north_m[0]), 4)
    (90.17, 0.0005)
    """

    latitude_deg: float
    longitude_deg: float

    def to_local_all(
        self, latitude_deg: ArrayLike, longitude_deg: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Return east and north of many places."""
        lat = np.radians(np.asarray(latitude_deg, dtype=np.float64))
        lon = np.radians(np.asarray(longitude_deg, dtype=np.float64) - self.longitude_deg)
        lat_0 = np.radians(self.latitude_deg)
        sin, cos = np.sin(lat), np.cos(lat)
        across_m = SEMI_MAJOR_M / np.sqrt(1.0 - E2 * sin**2)
        middle = 1.0 - E2 * np.sin(0.5 * (lat + lat_0)) ** 2
        along_m = SEMI_MAJOR_M * (1.0 - E2) / middle**1.5
        part, t2 = (lon * cos) ** 2, (sin / cos) ** 2
        eta2 = E2 / (1.0 - E2) * cos**2
        east_m = across_m * lon * cos * (1.0 + part * (1.0 - t2 + eta2) / 6.0)
        lift = 1.0 + part * (5.0 - t2 + 9.0 * eta2) / 12.0
        north_m = along_m * (lat - lat_0) + 0.5 * across_m * sin * cos * lon**2 * lift
        return east_m, north_m

    def to_local(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return east and north of one place."""
        east_m, north_m = self.to_local_all(latitude_deg, longitude_deg)
        return float(east_m), float(north_m)

    def to_geographic(self, east_m: float, north_m: float) -> tuple[float, float]:
        """Return latitude and longitude of one place."""
        latitude, longitude = self.to_geographic_all(east_m, north_m)
        return float(latitude), float(longitude)

    def to_geographic_all(self, east_m: ArrayLike, north_m: ArrayLike) -> tuple[Floats, Floats]:
        """Return latitudes and longitudes of many places: the other way round, by rounds."""
        east, north = np.asarray(east_m, dtype=np.float64), np.asarray(north_m, dtype=np.float64)
        degree_m = np.radians(SEMI_MAJOR_M)
        latitude = self.latitude_deg + north / degree_m
        longitude = self.longitude_deg + east / (degree_m * np.cos(np.radians(latitude)))
        for _ in range(ROUNDS):
            found_east, found_north = self.to_local_all(latitude, longitude)
            latitude = latitude + (north - found_north) / degree_m
            shorter = degree_m * np.cos(np.radians(latitude))
            longitude = longitude + (east - found_east) / shorter
        return latitude, longitude
