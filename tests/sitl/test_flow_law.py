"""What lies between measured points: three laws; and the sprayer that is known in full."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.core.types import SprayPlan, TimedChange
from companion.errors import ConfigError
from sitl.anyang import demo_setup, demo_trajectory
from sitl.flight import FlightOptions, fly, sprayer
from sitl.knowledge import lags, measured_sets, perfect_setup, true_sets
from sitl.profile import FLOW_LAWS, PROFILES, FlowLaw, flow_by_law, flow_table, load_profile

WANG = load_profile("wang-2024")
LARGE = WANG.nozzle_sets[1]
DUTIES = np.linspace(0.0, 1.0, 1001)


@pytest.mark.parametrize("law", ["smooth", "straight"])
@pytest.mark.parametrize("path", sorted(PROFILES.glob("*.toml")), ids=lambda path: path.stem)
def test_both_interpolating_laws_meet_every_measured_point(law: FlowLaw, path: Path) -> None:
    for each in load_profile(path).nozzle_sets:
        found = each.flows_l_min(law, np.array(each.duty))
        assert found == pytest.approx(each.flow_l_min, abs=1e-12)


@pytest.mark.parametrize("law", FLOW_LAWS)
@pytest.mark.parametrize("path", sorted(PROFILES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_law_rises_with_the_duty_and_begins_at_nothing(law: FlowLaw, path: Path) -> None:
    for each in load_profile(path).nozzle_sets:
        found = each.flows_l_min(law, DUTIES)
        assert found[0] == 0.0
        assert np.diff(found).min() >= -1e-12
        assert found[-1] == pytest.approx(each.flow_max_l_min)


def test_the_smooth_law_has_no_kink_and_is_not_the_straight_one() -> None:
    inner = np.arange(0.21, 0.99, 0.0005)
    smooth, straight = (LARGE.flows_l_min(law, inner) for law in ("smooth", "straight"))
    assert np.abs(np.diff(smooth, 2)).max() < 0.1 * np.abs(np.diff(straight, 2)).max()
    assert 0.02 < np.abs(smooth / straight - 1.0).max() < 0.06


def test_the_offset_law_is_the_effective_open_time() -> None:
    """Orchard's table is made of it: 40 L/min times (duty + 15 Hz * 3 ms)."""
    orchard = load_profile("orchard-180").nozzle_sets[0]
    found = orchard.flows_l_min("offset", np.array([0.2, 0.37, 0.8]))
    assert found == pytest.approx(40.0 * (np.array([0.2, 0.37, 0.8]) + 0.045))
    # P1's Table 2 scatters about it by several percent of the flow.
    off = LARGE.flows_l_min("offset", np.array(LARGE.duty)) / np.array(LARGE.flow_l_min) - 1.0
    assert 0.02 < np.abs(off).max() < 0.12


def test_two_points_are_a_straight_line_by_every_law() -> None:
    for law in FLOW_LAWS:
        found = flow_by_law(law, (0.2, 1.0), (1.0, 5.0), np.array([0.1, 0.6]))
        assert found == pytest.approx([0.5, 3.0])


def test_a_profile_says_its_law_and_a_flight_may_say_another(tmp_path: Path) -> None:
    assert WANG.flow_law == "smooth"
    text = (PROFILES / "wang-2024.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace('"smooth"', '"offset"'), encoding="utf-8")
    assert load_profile(path).flow_law == "offset"
    path.write_text(text.replace('"smooth"', '"cubic"'), encoding="utf-8")
    with pytest.raises(ConfigError, match="flow_law is one of smooth, straight, offset"):
        load_profile(path)


@pytest.mark.parametrize("law", FLOW_LAWS)
def test_knowledge_of_a_law_is_the_law(law: FlowLaw) -> None:
    profile = replace(WANG, flow_law=law)
    for truth, told in zip(profile.nozzle_sets, true_sets(profile), strict=True):
        duty = np.linspace(0.2, 1.0, 77)
        flows = truth.flows_l_min(law, duty)
        found = [told.curve.duty_for(flow) for flow in flows.tolist()]
        assert found == pytest.approx(duty.tolist(), abs=2e-3)
    points = measured_sets(profile)[1].curve
    assert (points.duty, points.flow_l_min) == (LARGE.duty, LARGE.flow_l_min)


@pytest.mark.parametrize("fidelity", ["averaged", "pulsed"])
def test_a_known_sprayer_delivers_alike_from_every_valve_at_one_time(fidelity: str) -> None:
    options = FlightOptions(seed=3, knows=True, fidelity=fidelity)  # type: ignore[arg-type]
    plant, output = sprayer(WANG, options, 0.0)
    told = perfect_setup(demo_setup(5.0), WANG, seed=3, output_s=0.0)
    changes = tuple(
        TimedChange(at_s=10.0 - told.lag.up_s, valve=valve, duty=0.8, restart=True)
        for valve in range(6)
    )
    plan = SprayPlan(
        sequence=1, issued_s=0.0, duty=(0.4,) * 6, changes=changes, lease_until_s=100.0
    )
    output.submit(plan, now_s=0.0)
    output.finish(30.0)
    ends_s = np.array([2.0, 6.0, 15.0, 25.0])
    ml = plant.volume_ml(ends_s)
    low, high = (ml[1] - ml[0]) / 4.0, (ml[3] - ml[2]) / 10.0
    table = flow_table(WANG)
    assert low == pytest.approx(np.full(6, table.mean_ml_s(0.4, 6)), rel=6e-3)
    assert high == pytest.approx(np.full(6, table.mean_ml_s(0.8, 6)), rel=3e-3)
    # Where the lines of the volume before and after meet: each valve's own step.
    step_s = (ml[3] - ml[1] - high * 25.0 + low * 6.0) / (low - high)
    if fidelity == "averaged":
        assert step_s == pytest.approx(np.full(6, 10.0), abs=1e-6)
    assert step_s == pytest.approx(np.full(6, 10.0), abs=0.03)


def test_without_knowledge_the_same_valves_differ() -> None:
    plant, output = sprayer(WANG, FlightOptions(seed=3, fidelity="averaged"), 0.0)
    plan = SprayPlan(sequence=1, issued_s=0.0, duty=(0.4,) * 6, changes=(), lease_until_s=100.0)
    output.submit(plan, now_s=0.0)
    output.finish(30.0)
    assert np.ptp(np.diff(plant.volume_ml(np.array([5.0, 10.0])), axis=0)) > 0.5


def test_a_flight_takes_the_law_that_it_is_given(two_passes: None) -> None:
    setup, path = demo_setup(12.0), demo_trajectory(12.0, 1)
    volumes = set()
    for law in (None, *FLOW_LAWS):
        options = FlightOptions(fidelity="averaged", flow_law=law, noise=False)
        setup = replace(setup, lag=lags(WANG))
        record = fly(setup, path, WANG, options, speed_m_s=12.0).record
        volumes.add(round(float(record.volume_ml[-1].sum()), 3))
    assert len(volumes) == 3
