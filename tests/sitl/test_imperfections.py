"""What real parts have: each imperfection moves the flow or the edge as its table says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.errors import ConfigError
from sitl.plant import BoardEdge as Edge
from sitl.plant import PulsedPlant
from sitl.profile import PROFILES, TYPICAL, Imperfections, Parts, PlantProfile, load_profile
from tests.bench.valves import flow_over_nominal

WANG = load_profile("wang-2024")
STILL = replace(WANG, lag_scatter=0.0, flow_scatter=0.0)


def with_parts(**what: float) -> PlantProfile:
    return replace(STILL, imperfections=Imperfections(**what))


def trains(plant: PulsedPlant, valves: tuple[int, ...], *, duty: float, periods: int) -> None:
    """Open and close valves together, period by period."""
    period_s = WANG.pwm.period_s
    for number in range(periods):
        for offset_s, is_open in ((0.0, True), (duty * period_s, False)):
            at_s = number * period_s + offset_s
            plant.record(
                [Edge(at_s=at_s, valve=valve, is_open=is_open, duty=duty) for valve in valves]
            )


def delivered_ml(profile: PlantProfile, valves: tuple[int, ...] = (0,), duty: float = 0.5) -> float:
    """Return what valve 0 delivers in 22 periods beside the others."""
    plant = PulsedPlant(profile, seed=3)
    trains(plant, valves, duty=duty, periods=22)
    return float(plant.volume_ml(np.array([3.0]))[0, 0])


def test_without_the_table_nothing_changes() -> None:
    assert delivered_ml(STILL) == delivered_ml(with_parts())


def test_an_offset_delivers_so_much_longer_at_every_duty() -> None:
    parts = Parts(Imperfections(offset_scatter_s=0.001), 6, seed=3, start_s=0.0)
    more = [
        delivered_ml(with_parts(offset_scatter_s=0.001), duty=duty) / delivered_ml(STILL, duty=duty)
        for duty in (0.3, 0.8)
    ]
    assert abs(flow_over_nominal(parts, 0, STILL.pwm.period_s) - 1.0) > 1e-3
    assert abs(more[0] - 1.0) > 2.0 * abs(more[1] - 1.0) > 0.0


def test_a_curvature_bends_the_flow_over_the_duty() -> None:
    bent = with_parts(curvature_scatter=0.05)
    low, high = (delivered_ml(bent, duty=d) / delivered_ml(STILL, duty=d) for d in (0.3, 0.8))
    assert (low - 1.0) * (high - 1.0) < 0.0


def test_open_valves_take_pressure_from_each_other() -> None:
    shared = with_parts(interaction=0.1)
    together, beside = (
        delivered_ml(shared, (0, 1, 2, 3, 4, 5)),
        delivered_ml(STILL, (0, 1, 2, 3, 4, 5)),
    )
    assert together < 0.97 * beside


def test_a_rested_valve_opens_later_and_once_warm_more_flows() -> None:
    assert delivered_ml(with_parts(rest_lag_s=0.01)) < delivered_ml(STILL)
    assert delivered_ml(with_parts(pressure_lag_s=0.01)) < delivered_ml(STILL)
    assert delivered_ml(with_parts(warming=0.05, warming_time_s=1.0)) > 1.01 * delivered_ml(STILL)


def test_a_supply_that_swings_averages_out_and_no_flow_falls_below_zero() -> None:
    plant = PulsedPlant(replace(WANG, imperfections=TYPICAL), seed=5)
    trains(plant, (0, 1, 2, 3, 4, 5), duty=0.6, periods=60)
    volume_ml = plant.volume_ml(np.linspace(0.0, 7.0, 7001))
    assert np.diff(volume_ml, axis=0).min() > -1e-9
    mean = delivered_ml(with_parts(ripple=0.05, ripple_hz=2.0)) / delivered_ml(STILL)
    assert mean == pytest.approx(1.0, abs=0.01)
    assert mean != 1.0


def test_valves_made_alike_have_neither_offset_nor_curvature() -> None:
    assert TYPICAL.alike == replace(TYPICAL, offset_scatter_s=0.0, curvature_scatter=0.0)


@pytest.mark.parametrize(
    "line", ["ripple = -0.1", "interaction = 0.9", "rest_time_s = 0.0", "warming = inf"]
)
def test_what_no_part_has_is_refused(line: str, tmp_path: Path) -> None:
    text = (PROFILES / "wang-2024.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(f"{text}\n[imperfections]\n{line}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="imperfections"):
        load_profile(path)
    path.write_text(f"{text}\n[imperfections]\nripple = 0.01\n", encoding="utf-8")
    assert load_profile(path).imperfections == Imperfections(ripple=0.01)
