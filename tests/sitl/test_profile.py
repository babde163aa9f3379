from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.errors import ConfigError
from sitl.knowledge import boom, lags
from sitl.profile import ML_S_PER_L_MIN, PROFILES, FlowTable, draw_scatter, load_profile

WANG = load_profile("wang-2024")


@pytest.mark.parametrize("path", sorted(PROFILES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_profile_loads_under_its_own_name(path: Path) -> None:
    assert load_profile(path.stem).name == path.stem
    assert boom(load_profile(path)).width_m == load_profile(path.stem).boom_width_m


def test_the_papers_sprayer_has_its_table_2() -> None:
    small, large = WANG.nozzle_sets
    assert large.flow_l_min == pytest.approx(
        [12 * q for q in (0.123, 0.252, 0.273, 0.385, 0.421, 0.496, 0.508)]
    )
    assert small.flow_l_min == pytest.approx(
        [8 * q for q in (0.128, 0.234, 0.277, 0.393, 0.435, 0.521, 0.534)]
    )
    assert (small.valves, large.valves) == ((0, 1, 2, 3), (0, 1, 2, 3, 4, 5))
    assert WANG.normally_open


def test_the_larger_sprayer_delivers_120_to_180_l_ha_at_5_m_s() -> None:
    measured = load_profile("orchard-180").nozzle_sets[0]
    assert measured.flow_l_min[0] < 21.6 < 32.4 < measured.flow_l_min[-1]


@pytest.mark.parametrize("name", ["wang-2024", "orchard-180"])
def test_whole_lags_stay_within_an_eighth_of_a_second(name: str) -> None:
    true = lags(load_profile(name))
    assert true.on_start_s < true.on_s < true.off_end_s <= 0.12 + 1e-9


@pytest.mark.parametrize("duty", [0.2, 0.35, 0.5, 0.77, 0.9, 1.0])
def test_the_flow_table_is_the_measured_curve_of_each_set(duty: float) -> None:
    table = FlowTable(WANG)
    for nozzle_set in WANG.nozzle_sets:
        count = len(nozzle_set.valves)
        flow_l_min = table.mean_ml_s(duty, count) * count / ML_S_PER_L_MIN
        assert flow_l_min == pytest.approx(
            float(nozzle_set.flows_l_min("smooth", np.array([duty]))[0]), rel=1e-5
        )


def test_scatter_keeps_the_flow_of_every_set() -> None:
    for seed in range(5):
        scale = draw_scatter(WANG, np.random.default_rng(seed)).flow_scale
        assert np.mean(scale[:4]) == pytest.approx(1.0)
        assert np.mean(scale) == pytest.approx(1.0)
        assert np.std(scale) > 0.002


def test_scatter_has_the_spread_of_the_profile() -> None:
    drawn = [draw_scatter(WANG, np.random.default_rng(seed)) for seed in range(300)]
    assert np.std([one.shift_s for one in drawn]) == pytest.approx(0.05 * WANG.mean_lag_s, rel=0.1)
    assert np.std([one.flow_scale for one in drawn]) == pytest.approx(0.02, rel=0.2)


def test_an_unknown_profile_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(ConfigError, match="wang-2024"):
        load_profile("wong")


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("ramp_s = 0.030", "ramp_s = 0.0", "ramp_s"),
        ("ramp_s = 0.030", "rampe_s = 0.030", "rampe_s"),
        ("valve_count = 6", "", "valve_count"),
        ("0.4, 0.5, 0.7", "0.5, 0.4, 0.7", "strictly increasing"),
        ("dead_close_s = 0.090", "dead_close_s = nan", "dead_close_s"),
        ("valves = [0, 1, 2, 3] ", "valves = [0, 7]", "contain"),
        ("[pwm]", "[pwm", "TOML"),
    ],
)
def test_a_broken_profile_is_refused_with_its_reason(
    old: str, new: str, reason: str, tmp_path: Path
) -> None:
    text = (PROFILES / "wang-2024.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.toml"
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(ConfigError, match=reason) as caught:
        load_profile(path)
    assert "\n" not in str(caught.value)


def test_a_valve_that_never_closes_is_refused() -> None:
    with pytest.raises(ValueError, match="never closes"):
        replace(WANG, dead_close_s=0.1)
