"""Ground of an export: whole, valid and with all of the volume, whatever the path does."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given as drawn
from hypothesis import settings
from hypothesis import strategies as st

from analysis.exports.cli import FORMATS
from analysis.exports.samples import LENGTH_M, outlines, swaths_of
from analysis.exports.source import Source
from analysis.flight_record import FlightRecord
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.read_applied import read_applied
from analysis.track import tracks_of
from companion.core.prescription import Prescription
from tests.analysis.export_flight import fly
from tests.builders import plots, setup

FLOW_ML_S = 10.0


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> AppliedFlight:
    return read_applied(fly(tmp_path_factory.mktemp("flown")))


@pytest.fixture(scope="module")
def unsprayed(tmp_path_factory: pytest.TempPathFactory) -> AppliedFlight:
    elsewhere = [replace(each, polygon=shapely.affinity.translate(each.polygon, 900.0, 0.0))
                 for each in plots([[20.0]])]  # fmt: skip
    folder = tmp_path_factory.mktemp("unsprayed")
    return read_applied(fly(folder, given=setup(prescription=Prescription(elsewhere))))


def sprayed_along(
    flight: AppliedFlight, east_m: np.ndarray, north_m: np.ndarray, heading_deg: np.ndarray
) -> FlightRecord:
    """Return a record of a path along which all valves are open, but for a tenth at either end."""
    record = Source(flight=flight, shape="swaths").record
    count = len(east_m)
    flows = np.where((np.arange(count) > count // 10) & (np.arange(count) < count * 9 // 10), 1, 0)
    volume_ml = np.cumsum(flows) * FLOW_ML_S * record.step_s
    return replace(
        record,
        time_s=record.time_s[0] + record.step_s * np.arange(count),
        east_m=east_m,
        north_m=north_m,
        heading_deg=heading_deg,
        volume_ml=np.repeat(volume_ml[:, None], len(record.boom.valves), axis=1),
        orders=(),
    )


@settings(max_examples=30)
@drawn(
    radius_m=st.floats(0.5, 30.0),
    speed_m_s=st.floats(0.5, 10.0),
    sideways_deg=st.floats(-90.0, 90.0),
)
def test_any_turn_leaves_valid_ground_and_all_of_the_volume(
    flight: AppliedFlight, radius_m: float, speed_m_s: float, sideways_deg: float
) -> None:
    turned = np.arange(600) * 0.01 * speed_m_s / radius_m
    record = sprayed_along(
        flight,
        radius_m * np.sin(turned),
        3.0 - radius_m * np.cos(turned),
        np.degrees(np.pi / 2 - turned) + sideways_deg,
    )
    swaths = swaths_of(flight, record)
    assert all(each.is_valid and not each.is_empty for each in swaths.polygons)
    assert {each.geom_type for each in swaths.polygons} <= {"Polygon", "MultiPolygon"}
    total_ml = float(record.volume_ml[-1].sum())
    assert swaths.volume_ml.sum() + swaths.unmapped_ml == pytest.approx(total_ml, rel=1e-9)
    assert swaths.distance_m.max(initial=0.0) <= LENGTH_M + 0.011 * 2 * speed_m_s * (
        1.0 + 3.0 / radius_m
    )


def test_a_straight_stretch_is_a_rectangle(flight: AppliedFlight) -> None:
    along_m = 0.05 * np.arange(600)
    record = sprayed_along(flight, along_m, np.full(600, 3.0), np.full(600, 90.0))
    (shape,) = outlines(tracks_of(record)[0], np.array([100]), np.array([300]))
    # The leftmost of six strips of a metre, flying east: 2 to 3 m north of the path.
    assert shape.equals(shapely.box(5.0, 5.0, 15.0, 6.0))
    assert len(shapely.get_coordinates(shape)) == 5
    assert outlines(tracks_of(record)[0], np.array([], int), np.array([], int)) == []


def test_stretches_end_at_valves_rates_and_lengths(flight: AppliedFlight) -> None:
    swaths = Source(flight=flight, shape="swaths").swaths
    first = swaths.valve == 0
    # The leftmost valve: 12 m of each rate, cut after 10 m; only the first pass is 48 m of plots
    # for it as for the others, on the second it is over them too.
    rates = swaths.rate_l_ha[first][:8].tolist()
    assert rates == [20.0, 20.0, 25.0, 25.0, 15.0, 15.0, 20.0, 20.0]
    assert swaths.distance_m[first][2:6] == pytest.approx([10.0, 2.0, 10.0, 2.0], abs=0.1)
    assert (np.diff(swaths.start_s) >= 0.0).all()
    assert (swaths.end_s > swaths.start_s).all()
    assert set(swaths.valve[swaths.start_s > 113.0].tolist()) == {0, 1, 2}


def test_what_a_valve_gives_on_one_spot_is_said_and_not_drawn(flight: AppliedFlight) -> None:
    record = sprayed_along(flight, np.full(600, 20.0), np.full(600, 3.0), np.full(600, 90.0))
    swaths = swaths_of(flight, record)
    assert len(swaths) == 0
    assert swaths.unmapped_ml == pytest.approx(float(record.volume_ml[-1].sum()))


@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.name)
def test_a_flight_without_spraying_is_an_export_of_nothing_sprayed(
    unsprayed: AppliedFlight, form: object
) -> None:
    for shape in getattr(form, "shapes", ()):
        given = Source(flight=unsprayed, shape=shape)
        out = Path("x" + (*form.suffixes, *form.also)[-1])  # type: ignore[attr-defined]
        content = form.maker()(given, out)  # type: ignore[attr-defined]
        assert sum(len(chunk) for chunks in content.values() for chunk in chunks) > 0
        assert given.volume_l == 0.0
        assert json.dumps(given.facts(), allow_nan=False)
        if shape != "swaths":
            assert given.rows > 100
