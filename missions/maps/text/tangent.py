"""The local tangent plane of P2's maps: metres east, north and up of an origin that is chosen.

P2 (Rovira-Más et al. 2024) goes from latitude, longitude and altitude through earth-centred,
earth-fixed X, Y, Z to a plane that touches the earth at the origin, on the WGS 84 ellipsoid.
The core's `LocalFrame` is a map projection instead. From the same origin, on the ellipsoid, the
two differ by up to d^3 / (3 R^2): 8 micrometres at 1 km, 1 mm at 5 km. But the tangent plane
stretches with altitude, by h / R (0.1 m per km at 640 m), and leans with the distance of
its origin; so its cells are tied to the ground by their corners (`text_map.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# WGS 84: semi-major axis [m] and flattening (NIMA TR8350.2, table 3.1).
SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2.0 - FLATTENING)
# Each round divides the error of the latitude by 150 (1 / e^2): nine leave nothing of a radian.
_ROUNDS = 9


def to_ecef(latitude_deg: Floats, longitude_deg: Floats, altitude_m: Floats) -> Floats:
    """Return earth-centred, earth-fixed X, Y, Z in metres, one row for each point.

    >>> to_ecef(np.array([0.0]), np.array([90.0]), np.array([1.0])).round(3).tolist()
    [[0.0, 6378138.0, 0.0]]
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    normal_m = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    across_m = (normal_m + altitude_m) * np.cos(latitude)
    return np.column_stack(
        [
            across_m * np.cos(longitude),
            across_m * np.sin(longitude),
            (normal_m * (1.0 - ECCENTRICITY_2) + altitude_m) * np.sin(latitude),
        ]
    )


def from_ecef(points_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Return latitude [deg], longitude [deg] and altitude [m] of rows X, Y, Z."""
    x, y, z = points_m.T
    across_m = np.hypot(x, y)
    latitude = np.arctan2(z, across_m * (1.0 - ECCENTRICITY_2))
    for _ in range(_ROUNDS):
        sine = np.sin(latitude)
        normal_m = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY_2 * sine**2)
        latitude = np.arctan2(z + ECCENTRICITY_2 * normal_m * sine, across_m)
    sine = np.sin(latitude)
    altitude_m = (
        across_m * np.cos(latitude)
        + z * sine
        - SEMI_MAJOR_M * np.sqrt(1.0 - ECCENTRICITY_2 * sine**2)
    )
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude_m


@dataclass(frozen=True, slots=True, kw_only=True)
class TangentPlane:
    """East, north and up [m] of an origin.

    >>> plane = TangentPlane(latitude_deg=39.4829175, longitude_deg=-0.337570611, altitude_m=5.007)
    >>> east, north, up = plane.to_local(
    ...     np.array([39.4829515]), np.array([-0.337544528]), np.array([5.644])
    ... )
    >>> round(float(east[0]), 3), round(float(north[0]), 3), round(float(up[0]), 3)
    (2.244, 3.775, 0.637)
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float = 0.0

    def __post_init__(self) -> None:
        if not (abs(self.latitude_deg) <= 90.0 and abs(self.longitude_deg) <= 180.0):
            raise ValueError(f"origin is no position: {self.latitude_deg}, {self.longitude_deg}")
        if not math.isfinite(self.altitude_m):
            raise ValueError(f"origin has no altitude: {self.altitude_m}")

    def to_local(
        self, latitude_deg: Floats, longitude_deg: Floats, altitude_m: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return east, north and up of many points."""
        ahead = to_ecef(latitude_deg, longitude_deg, altitude_m) - self._origin_m()
        east, north, up = self._turn() @ ahead.T
        return east, north, up

    def to_geodetic(
        self, east_m: Floats, north_m: Floats, up_m: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return latitude [deg], longitude [deg] and altitude [m] of many points."""
        local = np.column_stack([east_m, north_m, up_m])
        return from_ecef(local @ self._turn() + self._origin_m())

    def on_ground(
        self, east_m: Floats, north_m: Floats, altitude_m: float
    ) -> tuple[Floats, Floats]:
        """Return latitude and longitude [deg] of what lies at an altitude over east and north."""
        up_m = np.full(len(east_m), altitude_m - self.altitude_m)
        for _ in range(_ROUNDS):
            latitude, longitude, found_m = self.to_geodetic(east_m, north_m, up_m)
            up_m += altitude_m - found_m
        return latitude, longitude

    def _origin_m(self) -> Floats:
        place = (self.latitude_deg, self.longitude_deg, self.altitude_m)
        latitude, longitude, altitude = (np.array([value]) for value in place)
        return to_ecef(latitude, longitude, altitude)

    def _turn(self) -> Floats:
        """Return the rotation from X, Y, Z to east, north, up."""
        latitude, longitude = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
        sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
        return np.array(
            [
                [-sin_lon, cos_lon, 0.0],
                [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
                [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
            ]
        )
