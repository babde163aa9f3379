"""Two judges of one flight: `evaluate`, and one that shares nothing with the program."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import shapely

from analysis.evaluation import Evaluation, evaluate
from analysis.flight_record import Fidelity
from companion.core.frame import LocalFrame
from sitl.anyang import EXAMPLE, demo_lags, demo_setup, demo_trajectory
from sitl.flight import FlightOptions, fly
from sitl.profile import FlowLaw, load_profile
from tests.bench.flow_laws import second
from tests.second_judge import Ground, Verdict, flat

WANG = load_profile("wang-2024")
PASS_S = 36.0  # the first pass: twenty changes are enough to tell


class Judged(NamedTuple):
    ours: Evaluation
    other: Verdict


def judged(fidelity: Fidelity, law: FlowLaw, *, aside_m: float = 0.0) -> Judged:
    """Fly the first pass of the demo, or to its left, and have both judge it."""
    setup = replace(demo_setup(5.0), lag=demo_lags("gpio"))
    path = demo_trajectory(5.0, 1)
    cut = path.at(path.time_s[path.time_s < path.time_s[0] + PASS_S])
    left = np.radians(cut.heading_deg - 90.0)
    cut = replace(
        cut,
        east_m=cut.east_m + aside_m * np.sin(left),
        north_m=cut.north_m + aside_m * np.cos(left),
    )
    options = FlightOptions(fidelity=fidelity, flow_law=law)
    record = fly(setup, cut, WANG, options, speed_m_s=5.0).record
    origin = (setup.frame.latitude_deg, setup.frame.longitude_deg)
    return Judged(evaluate(record), second(record, origin))


@pytest.fixture(scope="module")
def averaged() -> Judged:
    return judged("averaged", "smooth")


@pytest.fixture(scope="module")
def pulsed() -> Judged:
    return judged("pulsed", "straight")


@pytest.mark.parametrize("which", ["averaged", "pulsed"])
def test_both_judges_find_the_same(which: str, request: pytest.FixtureRequest) -> None:
    ours, other = request.getfixturevalue(which)
    assert ours.apart == 0  # the other one knows no verdicts
    assert len(other.lag_m) == ours.lag_distance_m.count > 50
    assert other.missed == ours.missed
    assert other.lag_mean_abs_m == pytest.approx(ours.lag_distance_m.mean_abs, abs=0.005)
    assert other.lag_mean_m == pytest.approx(ours.lag_distance_m.mean, abs=0.005)
    assert max(map(abs, other.lag_m)) == pytest.approx(ours.lag_distance_m.max_abs, abs=0.005)
    assert other.misapplied_percent == pytest.approx(ours.misapplied_percent, abs=0.2)
    assert other.accuracy_percent == pytest.approx(ours.spraying_accuracy_percent, abs=0.2)
    share = 100.0 / ours.applied_ml
    assert share * other.off_target_ml == pytest.approx(share * ours.off_target_ml, abs=0.2)


def test_a_flight_is_judged_as_it_is(pulsed: Judged) -> None:
    """On a sprayer whose law is the controller's: what a mutant of the program must move.

    Bounds lie as near as the flight's own figures allow; mutants.toml has what they catch.
    """
    _, other = pulsed
    assert other.missed == 0
    assert other.lag_mean_abs_m < 0.060
    assert abs(other.lag_mean_m) < 0.025
    assert other.misapplied_percent < 2.6
    assert other.accuracy_percent > 97.5
    assert other.off_target_ml < 0.01


def test_a_flight_beside_its_pass_is_judged_as_it_is() -> None:
    """Two of its valves hang over the border: who takes left for right sprays there."""
    _, other = judged("averaged", "straight", aside_m=2.1)
    assert other.missed == 0
    assert other.lag_mean_abs_m < 0.05
    assert other.misapplied_percent < 4.0
    assert other.off_target_ml < 0.01


def test_the_map_is_laid_flat_as_the_program_does_it() -> None:
    frame = LocalFrame(35.996089, 114.543487)
    rng = np.random.default_rng(1)
    lon_lat = rng.uniform(-0.01, 0.01, (200, 2)) + np.array((114.543487, 35.996089))
    east_m, north_m = frame.to_local_all(lon_lat[:, 1], lon_lat[:, 0])
    found = flat(lon_lat, (35.996089, 114.543487))
    assert np.abs(found - np.column_stack((east_m, north_m))).max() < 0.002


def test_the_map_is_read_as_the_program_reads_it() -> None:
    setup = demo_setup(5.0)
    origin = (setup.frame.latitude_deg, setup.frame.longitude_deg)
    ground = Ground(EXAMPLE / "prescription.shp", "rate", EXAMPLE / "boundary.geojson", origin)
    zones = setup.prescription.zones
    assert len(ground.polygons) == len(zones) == 40
    rates = ground.all_rates(*np.array([z.polygon.centroid.coords[0] for z in zones]).T)
    assert rates.tolist() == [zone.rate_l_ha for zone in zones]
    assert shapely.hausdorff_distance(ground.field, setup.prescription.field) < 0.002
