from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.core.frame import LocalFrame
from missions.maps.text_points import TangentPlane


def degrees(limit: float) -> st.SearchStrategy[float]:
    return st.floats(-limit, limit, allow_subnormal=False)


def earth_centred(
    latitude_deg: float, longitude_deg: float, altitude_m: float
) -> NDArray[np.float64]:
    """Return earth-centred, earth-fixed X, Y, Z [m] on WGS 84 (NIMA TR8350.2, table 3.1)."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    eccentricity_2 = (2.0 - 1.0 / 298.257223563) / 298.257223563
    normal_m = 6_378_137.0 / math.sqrt(1.0 - eccentricity_2 * math.sin(latitude) ** 2)
    across_m = (normal_m + altitude_m) * math.cos(latitude)
    return np.array(
        [
            across_m * math.cos(longitude),
            across_m * math.sin(longitude),
            (normal_m * (1.0 - eccentricity_2) + altitude_m) * math.sin(latitude),
        ]
    )


def turned(latitude_deg: float, longitude_deg: float) -> NDArray[np.float64]:
    """Return the rotation from X, Y, Z to east, north, up."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    sin_lat, cos_lat = math.sin(latitude), math.cos(latitude)
    sin_lon, cos_lon = math.sin(longitude), math.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


@given(
    latitude=degrees(90.0),
    longitude=degrees(180.0),
    altitude=st.floats(-500.0, 9000.0),
    away=st.tuples(degrees(0.5), degrees(0.5), st.floats(-500.0, 9000.0)),
)
def test_plane_is_the_one_of_p2_by_earth_centred_coordinates(
    latitude: float, longitude: float, altitude: float, away: tuple[float, float, float]
) -> None:
    place = max(-90.0, min(90.0, latitude + away[0])), longitude + away[1], away[2]
    ahead = earth_centred(*place) - earth_centred(latitude, longitude, altitude)
    plane = TangentPlane(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    found = plane.to_local(*(np.array([value]) for value in place))
    np.testing.assert_allclose(np.ravel(found), turned(latitude, longitude) @ ahead, atol=1e-7)


@given(
    latitude=degrees(90.0),
    longitude=degrees(180.0),
    altitude=st.floats(-500.0, 9000.0),
    local=st.tuples(*[st.floats(-20_000.0, 20_000.0)] * 3),
)
def test_there_and_back_is_the_same_place(
    latitude: float, longitude: float, altitude: float, local: tuple[float, float, float]
) -> None:
    plane = TangentPlane(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude)
    there = plane.to_geodetic(*(np.array([value]) for value in local))
    # PROJ's way back is a closed form: 0.1 um near the ground, a few at 20 km of altitude.
    np.testing.assert_allclose(np.ravel(plane.to_local(*there)), local, atol=1e-5)


def test_origin_is_nought() -> None:
    plane = TangentPlane(latitude_deg=-33.9, longitude_deg=18.4, altitude_m=50.0)
    found = plane.to_local(np.array([-33.9]), np.array([18.4]), np.array([50.0]))
    np.testing.assert_allclose(np.ravel(found), 0.0, atol=1e-9)


@pytest.mark.parametrize(("away_m", "apart_m"), [(1_000.0, 1e-5), (5_000.0, 1.1e-3)])
@pytest.mark.parametrize("latitude", [-60.0, 0.0, 39.5])
def test_on_the_ellipsoid_it_parts_from_the_flight_frame_by_d3_over_3_r2(
    latitude: float, away_m: float, apart_m: float
) -> None:
    frame = LocalFrame(latitude_deg=latitude, longitude_deg=-0.4)
    turn = np.linspace(0.0, 2.0 * math.pi, 16, endpoint=False)
    east, north = away_m * np.sin(turn), away_m * np.cos(turn)
    degrees = frame.to_geographic_all(east.tolist(), north.tolist())
    plane = TangentPlane(latitude_deg=latitude, longitude_deg=-0.4)
    found = plane.to_local(np.array(degrees[0]), np.array(degrees[1]), np.zeros(16))
    apart = np.hypot(found[0] - east, found[1] - north)
    assert 0.0 < apart.max() < apart_m


def test_plane_stretches_with_altitude_by_a_tenth_of_a_metre_per_km_at_640_m() -> None:
    plane = TangentPlane(latitude_deg=39.5, longitude_deg=-0.4, altitude_m=640.0)
    frame = LocalFrame(latitude_deg=39.5, longitude_deg=-0.4)
    latitude, longitude = frame.to_geographic(0.0, 1000.0)
    _, north, _ = plane.to_local(np.array([latitude]), np.array([longitude]), np.array([640.0]))
    assert north[0] == pytest.approx(1000.1, abs=0.005)


def test_origin_altitude_changes_up_alone() -> None:
    place = np.array([39.51]), np.array([-0.41]), np.array([30.0])
    low = TangentPlane(latitude_deg=39.5, longitude_deg=-0.4).to_local(*place)
    high = TangentPlane(latitude_deg=39.5, longitude_deg=-0.4, altitude_m=100.0).to_local(*place)
    np.testing.assert_allclose(np.ravel(low) - np.ravel(high), [0.0, 0.0, 100.0], atol=1e-6)


def test_on_ground_finds_what_lies_at_an_altitude_over_the_plane() -> None:
    plane = TangentPlane(latitude_deg=39.5, longitude_deg=-0.4, altitude_m=10.0)
    east, north = np.array([12_000.0, -300.0]), np.array([-5_000.0, 800.0])
    latitude, longitude = plane.on_ground(east, north, 420.0)
    found = plane.to_local(latitude, longitude, np.full(2, 420.0))
    np.testing.assert_allclose(found[:2], [east, north], atol=1e-6)


@pytest.mark.parametrize("place", [(91.0, 0.0, 0.0), (0.0, 181.0, 0.0), (0.0, 0.0, math.nan)])
def test_origin_that_is_no_place_is_a_bug(place: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="origin"):
        TangentPlane(latitude_deg=place[0], longitude_deg=place[1], altitude_m=place[2])
