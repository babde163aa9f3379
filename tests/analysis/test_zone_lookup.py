"""Very many points are looked up as the prescription has each, and pieces as their points."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import given
from hypothesis import strategies as st

from analysis.changes import lookup_of
from analysis.track import PIECE, PIECES_FROM, Places, Track
from companion.core.prescription import Prescription, Zone
from tests.builders import plots

OVERLAPPING = Prescription(
    [
        *plots([[20.0, 25.0], [15.0, 0.0]], length_m=6.0),
        Zone(name="over", polygon=shapely.box(4.0, 4.0, 9.0, 9.0), rate_l_ha=30.0),
    ],
    overlap="max",
)
LENGTHS = st.floats(-2.0, 14.0)


@given(st.lists(st.tuples(LENGTHS, LENGTHS), min_size=1, max_size=40))
def test_numbers_stand_for_the_zones_of_each_point(points: list[tuple[float, float]]) -> None:
    east_m, north_m = np.array(points).T
    lookup = lookup_of(OVERLAPPING)
    found = [lookup.zones(key) for key in lookup.keys(east_m, north_m).tolist()]
    assert found == OVERLAPPING.zones_at(east_m, north_m)


@given(
    start=st.tuples(LENGTHS, LENGTHS),
    bends=st.lists(st.floats(-0.3, 0.3), min_size=4 * PIECE, max_size=4 * PIECE),
    course=st.floats(0.0, 6.3),
)
def test_nothing_changes_on_a_piece_that_is_called_constant(
    start: tuple[float, float], bends: list[float], course: float
) -> None:
    courses = course + np.cumsum(bends)
    east_m = start[0] + np.concatenate(([0.0], np.cumsum(0.09 * np.sin(courses))))
    north_m = start[1] + np.concatenate(([0.0], np.cumsum(0.09 * np.cos(courses))))
    clear = lookup_of(OVERLAPPING).constant(east_m, north_m)
    zones = OVERLAPPING.owners_at(east_m, north_m)
    assert len(clear) == 4
    for piece in np.flatnonzero(clear).tolist():
        under = zones[piece * PIECE : (piece + 1) * PIECE + 1]
        assert all(each == under[0] for each in under)


def test_most_of_a_long_straight_way_is_constant() -> None:
    wide = Prescription(plots([[20.0, 25.0]], length_m=50.0))
    east_m = np.arange(0.5, 99.5, 0.09)
    clear = lookup_of(wide).constant(east_m, np.full(len(east_m), 3.0))
    assert 0.9 < clear.mean() < 1.0


FIELD = Prescription(plots([[20.0, 25.0], [15.0, 0.0]], length_m=25.0))


@given(
    start=st.tuples(st.floats(-5.0, 30.0), st.floats(-5.0, 30.0)),
    course=st.floats(0.0, 6.3),
    bend=st.floats(-0.02, 0.02),
    spacing_m=st.floats(0.03, 0.3),
    heading_rad=st.floats(0.0, 6.3),
)
def test_a_whole_piece_of_a_path_is_inside_as_each_of_its_points_is(
    start: tuple[float, float], course: float, bend: float, spacing_m: float, heading_rad: float
) -> None:
    count = (PIECES_FROM + 2) * PIECE + 5
    courses = course + bend * np.arange(count)
    east_m = start[0] + np.cumsum(spacing_m * np.sin(courses))
    north_m = start[1] + np.cumsum(spacing_m * np.cos(courses))
    places = Places(np.arange(count) * 0.01, east_m, north_m, np.full(count, heading_rad))
    strip = Track(
        valve=0,
        width_m=2.0,
        step_s=0.01,
        period_s=0.1,
        time_s=places.time_s,
        east_m=east_m,
        north_m=north_m,
        heading_rad=places.heading_rad,
        distance_m=np.arange(count) * spacing_m,
        speed_m_s=np.full(count, spacing_m / 0.01),
        across_m=np.full(count, 2.0),
        volume_ml=np.zeros(count),
        marks=np.arange(count),
    )
    # Of so few points each is asked for.
    halves = (places.some(each) for each in np.array_split(np.arange(count), 2))
    one_by_one = np.concatenate([strip.wholly_inside(FIELD, half) for half in halves])
    assert (strip.wholly_inside(FIELD, places) == one_by_one).all()
