"""The ground that was sprayed, as polygons."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from analysis.assess.ground import open_spans, treated_of
from analysis.flown.applied_flight import AppliedFlight, ValveChanges
from analysis.flown.read_applied import read_applied
from tests.analysis.report_flight import fly

NAN = math.nan


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> AppliedFlight:
    return read_applied(fly(tmp_path_factory.mktemp("treated")))


def straight(
    flight: AppliedFlight, changes: list[tuple[float, int, float]], course_deg: float = 90.0
) -> AppliedFlight:
    """Return 10 s at 5 m/s from the origin on a course, with these (time, valve, duty)."""
    time_s = np.arange(0.0, 10.01, 0.1)
    course = math.radians(course_deg)
    same = np.zeros(len(time_s))
    return replace(
        flight,
        time_s=time_s,
        east_m=5.0 * time_s * math.sin(course),
        north_m=5.0 * time_s * math.cos(course),
        heading_deg=same + course_deg,
        course_deg=same + course_deg,
        flow_l_min=same,
        changes=ValveChanges(
            planned_s=np.array([each[0] for each in changes]),
            actual_s=np.full(len(changes), NAN),
            valve=np.array([each[1] for each in changes], dtype=np.int64),
            duty=np.array([each[2] for each in changes]),
        ),
    )


def test_flight_treats_the_plots_that_it_flew_over(flight: AppliedFlight) -> None:
    treated = treated_of(flight)
    field = flight.setup.prescription.field
    assert treated.area.difference(field.buffer(0.05)).area < 0.01
    # 48 m by the 6 m of the boom, less the margin at both borders.
    assert 0.9 * 288.0 < treated.area.area < 288.0
    assert treated.first_s is not None and treated.last_s is not None
    assert flight.time_s[0] < treated.first_s < treated.last_s < flight.time_s[-1]


def test_edges_lie_where_the_lags_put_them(flight: AppliedFlight) -> None:
    valve = flight.setup.boom.valves[0]
    treated = treated_of(straight(flight, [(2.0, 0, 0.5), (6.0, 0, 0.8), (8.0, 0, 0.0)]))
    lag = flight.setup.lag
    west, south, east, north = treated.area.bounds
    assert west == pytest.approx(5.0 * (2.0 + lag.on_s + lag.output_s), abs=1e-6)
    assert east == pytest.approx(5.0 * (8.0 + lag.off_s + lag.output_s), abs=1e-6)
    # Eastwards, what is left of the vehicle lies north.
    assert north == pytest.approx(-valve.right_m + valve.width_m / 2, abs=1e-6)
    assert south == pytest.approx(-valve.right_m - valve.width_m / 2, abs=1e-6)


def test_times_that_the_output_gave_count_more_than_planned_ones(flight: AppliedFlight) -> None:
    flown = straight(flight, [(2.0, 0, 0.5), (8.0, 0, 0.0)])
    late = replace(flown, changes=replace(flown.changes, actual_s=np.array([2.5, NAN])))
    ((planned_s, _),) = open_spans(flown, 0)
    ((given_s, _),) = open_spans(late, 0)
    assert given_s - planned_s == pytest.approx(0.5)


def test_a_valve_left_open_sprays_to_the_end_of_the_journal(flight: AppliedFlight) -> None:
    ((_, end_s),) = open_spans(straight(flight, [(2.0, 0, 0.5)]), 0)
    assert end_s == 10.0


@given(course_deg=st.floats(0.0, 360.0))
def test_area_is_the_same_on_every_course(flight: AppliedFlight, course_deg: float) -> None:
    changes = [(2.0, valve, duty) for valve in range(6) for duty in (0.5,)]
    changes += [(6.0, valve, 0.0) for valve in range(6)]
    treated = treated_of(straight(flight, changes, course_deg))
    lag = flight.setup.lag
    length_m = 5.0 * (4.0 + lag.off_s - lag.on_s)
    assert treated.area.area == pytest.approx(6.0 * length_m, rel=1e-3)
    assert shapely.get_num_geometries(treated.area) == 1


def test_ground_sprayed_twice_counts_once(flight: AppliedFlight) -> None:
    once = straight(flight, [(2.0, 0, 0.5), (6.0, 0, 0.0)])
    there_and_back = replace(
        once,
        time_s=np.concatenate([once.time_s, 20.0 + once.time_s]),
        east_m=np.concatenate([once.east_m, once.east_m]),
        north_m=np.concatenate([once.north_m, once.north_m]),
        heading_deg=np.concatenate([once.heading_deg, once.heading_deg]),
        course_deg=np.concatenate([once.course_deg, once.course_deg]),
        changes=ValveChanges(
            planned_s=np.array([2.0, 6.0, 22.0, 26.0]),
            actual_s=np.full(4, NAN),
            valve=np.zeros(4, dtype=np.int64),
            duty=np.array([0.5, 0.0, 0.5, 0.0]),
        ),
    )
    assert treated_of(there_and_back).area_ha == pytest.approx(treated_of(once).area_ha, rel=1e-6)


def test_geodata_lie_where_the_field_is(flight: AppliedFlight) -> None:
    found = shapely.geometry.shape(treated_of(flight).as_geojson(flight.setup.frame))
    assert found.geom_type == "MultiPolygon"
    assert found.is_valid
    longitude, latitude = found.centroid.coords[0]
    east_m, north_m = flight.setup.frame.to_local(latitude, longitude)
    assert east_m == pytest.approx(24.0, abs=0.5)
    assert north_m == pytest.approx(3.0, abs=0.2)


def test_without_spraying_there_is_no_area(tmp_path: Path) -> None:
    treated = treated_of(read_applied(fly(tmp_path, enabled=False)))
    assert treated.area_ha == 0.0
    assert (treated.first_s, treated.last_s) == (None, None)
