"""One flight has one set of figures, and its worst change is a bound."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
import shapely.affinity
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry.base import BaseGeometry

from analysis.assess.assessment import assess, bound_m, figures_of, uncertainty_m, worst_of
from analysis.assess.ground import _lattice, within
from analysis.flown.applied_flight import AppliedFlight, Series
from analysis.flown.read_applied import read_applied
from analysis.report.build import ReportOptions, build_report
from analysis.report.drawing import prescribed_and_applied
from analysis.report.figure_style import sheet_of
from companion.config.application_table import PROFILES
from companion.map_pictures import rate_ends
from missions.maps.picture_ground import Colours
from tests.analysis.report_flight import fly
from tests.bench.worst import disagreements
from tests.golden.checking import names, unpacked


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("figures"))


@pytest.fixture(scope="module")
def flight(journal: Path) -> AppliedFlight:
    return read_applied(journal)


# ------------------------------------------------------------------------------- one set of them


@pytest.mark.parametrize("name", names())
def test_headline_tiles_balance_and_record_of_a_recorded_flight_agree(name: str) -> None:
    with unpacked(name) as path:
        report = build_report(path, ReportOptions(profiles=PROFILES, with_figures=False))
    if "balance" in report.contents and report.contents["verdict"]["applied_by"] != "nothing":
        assert list(disagreements(report)) == []
    contents = report.contents
    for warning in (each for each in contents["warnings"] if each["code"] == "missed"):
        counts, _, first = warning["text"].partition("(")
        assert sum(map(int, re.findall(r"\d+", counts))) == contents["missed"]
        place = [float(each) for each in re.findall(r"-?\d+\.\d{6}", first)]
        near = [contents["flight"][f"{name}_deg"] for name in ("latitude", "longitude")]
        assert place == pytest.approx(near, abs=0.01)


def test_litres_are_metered_where_there_is_a_meter(flight: AppliedFlight) -> None:
    found = figures_of(assess(flight), area_ha=0.1)
    assert found.applied_by == "model"
    times = np.linspace(flight.time_s[0], flight.time_s[-1], 50)
    metered = replace(
        flight, meter_ml=Series(time_s=times, value=np.linspace(0.0, 1234.0, len(times)))
    )
    found = figures_of(assess(metered), area_ha=0.1)
    assert (found.applied_by, found.applied_l) == ("flow meter", pytest.approx(1.234))
    assert found.mean_rate_l_ha == pytest.approx(12.34)


def test_of_a_flight_of_which_too_little_is_known_nothing_is_said() -> None:
    assert figures_of(None, area_ha=0.2, is_whole=False).applied_l is None
    assert figures_of(None, area_ha=0.2).applied_l == 0.0


# ----------------------------------------------------------------------------------- the bound


def test_a_bound_is_stated_only_where_the_journal_allows_it(flight: AppliedFlight) -> None:
    steps = assess(flight).evaluation.steps
    fixed = Series(time_s=flight.time_s[:1], value=np.array([6.0]))
    good = replace(flight, fix=fixed)
    told = worst_of(good, steps)
    assert told.why_not == ""
    largest = max(
        abs(step.lag_distance_m)
        for step in steps
        if step.lag_distance_m is not None and not step.change.border
    )
    assert told.bound_m is not None
    assert told.bound_m > largest
    for bad in (
        replace(flight, fix=None),
        replace(flight, fix=replace(fixed, value=np.array([5.0]))),
        replace(flight, fix=replace(fixed, value=np.array([np.nan]))),
        replace(good, lost=3),
    ):
        refused = worst_of(bad, steps)
        assert refused.bound_m is None
        assert refused.why_not
    assert worst_of(good, []).bound_m is None


def test_a_change_is_less_certain_at_speed_and_with_a_small_step(flight: AppliedFlight) -> None:
    step = next(each for each in assess(flight).evaluation.steps if not each.change.border)
    lag = flight.setup.lag
    faster = replace(step, change=replace(step.change, speed_m_s=2.0 * step.change.speed_m_s))
    smaller = replace(step, change=replace(step.change, before_l_ha=20.0, after_l_ha=22.0))
    larger = replace(smaller, change=replace(smaller.change, after_l_ha=30.0))
    assert uncertainty_m(faster, lag) > uncertainty_m(step, lag)
    assert uncertainty_m(smaller, lag) > uncertainty_m(larger, lag)


@given(
    lags=st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=60),
    sd=st.floats(0.01, 0.2),
    seed=st.integers(0, 2**16),
)
def test_what_scatters_as_stated_keeps_the_bound(lags: list[float], sd: float, seed: int) -> None:
    lag_m = np.array(lags)
    found = bound_m(lag_m, np.full(len(lags), sd))
    assert found >= float(np.abs(lag_m).max())
    chance = np.random.default_rng(seed)
    drawn = lag_m + chance.normal(0.0, sd, size=(2000, len(lags)))
    kept = float((np.abs(drawn).max(axis=1) <= found).mean())
    assert kept > 0.925


# ----------------------------------------------------------------------------- slanted edges


@pytest.mark.parametrize("turned_deg", [0.0, 12.0, 45.0])
def test_points_of_a_field_count_its_strips_however_they_lie(turned_deg: float) -> None:
    def turned(*box: float) -> BaseGeometry:
        return shapely.affinity.rotate(shapely.box(*box), turned_deg, origin=(0, 0))

    field = turned(0.0, 0.0, 61.3, 22.7)
    places = _lattice(field)
    assert within(field, *places).all()
    # Ten passes of a metre, as edges that lie along rows of points would be in or out as one.
    strips = shapely.union_all(
        [turned(0.0, 2.0 * each, 61.3, 2.0 * each + 1.0) for each in range(10)]
    )
    assert within(strips, *places).mean() == pytest.approx(strips.area / field.area, rel=2e-3)


def test_a_rate_has_one_colour_on_report_and_map(flight: AppliedFlight) -> None:
    cells = assess(flight).cells
    assert cells is not None
    prescribed, applied, _ = prescribed_and_applied(sheet_of(flight, cells)).figure.axes
    rates = flight.setup.prescription.rates_l_ha
    mesh, same = prescribed.collections[0], applied.collections[0]
    assert mesh.get_clim() == same.get_clim() == rate_ends(rates)
    assert mesh.cmap is not None
    colours = Colours.of(np.array(rates))
    for rate in rates:
        assert mesh.to_rgba(rate) == pytest.approx(colours(np.array(rate)))
