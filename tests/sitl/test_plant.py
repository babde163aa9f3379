from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.core.types import SprayPlan, TimedChange
from companion.output.pwm import Edge, PulseEngine
from sitl.knowledge import pwm_limits
from sitl.plant import AveragedPlant, Floats, Plant, PulsedPlant
from sitl.profile import ML_S_PER_L_MIN, flow_table, load_profile

WANG = load_profile("wang-2024")
EVEN = replace(WANG, lag_scatter=0.0, flow_scatter=0.0)
T = WANG.pwm.period_s
GRID_S = np.arange(400) / 400.0 * 3.0 * T


def pulsed(
    old: float, new: float, at_s: float, *, seed: int = 1, until_s: float = 9.0
) -> PulsedPlant:
    plant = PulsedPlant(WANG, seed=seed)
    engine = PulseEngine(pwm_limits(WANG), 6, start_s=0.0)
    changes = tuple(TimedChange(at_s=at_s, valve=v, duty=new) for v in range(6))
    plan = SprayPlan(
        sequence=0, issued_s=0.0, duty=(old,) * 6, changes=changes, lease_until_s=until_s
    )
    engine.submit(plan, now_s=0.0)
    plant.record(engine.advance(until_s + 1.0))
    return plant


def averaged(old: float, new: float, at_s: float, *, seed: int = 1) -> AveragedPlant:
    plant = AveragedPlant(WANG, seed=seed)
    for duty, time_s in ((old, 0.0), (new, at_s)):
        for valve in range(6):
            plant.record_change(time_s, valve, duty)
    return plant


def metered_l_min(plant: Plant, times_s: Floats) -> Floats:
    """Return the metered flow, mean of the PWM period before each time."""
    metered_ml = plant.meter_volume_ml(times_s) - plant.meter_volume_ml(times_s - T)
    flow_l_min: Floats = metered_ml * (60.0 / 1000.0 / T)
    return flow_l_min


def lag_of(plant: Plant, valve: int, old: float, new: float, at_s: float) -> float:
    """Return the volume-equivalent lag: where the lines of the volume before and after meet."""
    table = flow_table(WANG)
    scale = plant._scatter.flow_scale[valve]
    flow_0 = table.mean_ml_s(old, 6) * scale
    flow_1 = table.mean_ml_s(new, 6) * scale
    before_s, after_s = at_s - 0.5 - 3.0 * T + GRID_S, at_s + 2.5 + GRID_S
    line_0 = np.mean(plant.volume_ml(before_s)[:, valve] - flow_0 * before_s)
    line_1 = np.mean(plant.volume_ml(after_s)[:, valve] - flow_1 * after_s)
    return float((line_0 - line_1) / (flow_1 - flow_0)) - at_s


def nominal_l_min(duty: float, count: int) -> float:
    return flow_table(WANG).mean_ml_s(duty, count) * count / ML_S_PER_L_MIN


def total_l_min(plant: Plant, from_s: float, periods: int = 11) -> float:
    ends = plant.volume_ml(np.array([from_s, from_s + periods * T]))
    return float((ends[1] - ends[0]).sum() / (periods * T)) / ML_S_PER_L_MIN


@pytest.mark.parametrize("duty", [0.2, 0.5, 0.64, 0.8, 0.9, 1.0])
def test_the_steady_flow_is_the_measured_curve_in_both_fidelities(duty: float) -> None:
    expected = nominal_l_min(duty, 6)
    assert total_l_min(pulsed(0.0, duty, 0.5), 3.0) == pytest.approx(expected, rel=1e-5)
    assert total_l_min(averaged(0.0, duty, 0.5), 3.0) == pytest.approx(expected, rel=1e-5)


def test_four_valves_have_the_curve_of_eight_nozzles() -> None:
    plant = AveragedPlant(WANG, seed=3)
    for valve in range(6):
        plant.record_change(0.0, valve, 0.7)
    for valve in (4, 5):
        plant.record_change(2.0, valve, 0.0)
    expected = nominal_l_min(0.7, 4)
    assert total_l_min(plant, 4.0) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("old", "new"), [(0.0, 0.6), (0.0, 1.0), (0.5, 0.7), (0.8, 0.5), (0.6, 0.0), (1.0, 0.0)]
)
def test_both_fidelities_have_the_same_lag_of_about_a_tenth_of_a_second(
    old: float, new: float
) -> None:
    rng = np.random.default_rng(5)
    for seed in range(3):
        at_s = 3.0 + float(rng.uniform())
        for valve in (0, 5):
            both = [
                lag_of(plant, valve, old, new, at_s)
                for plant in (
                    pulsed(old, new, at_s, seed=seed),
                    averaged(old, new, at_s, seed=seed),
                )
            ]
            assert both[0] == pytest.approx(both[1], abs=0.006)
            assert both[1] == pytest.approx(0.1025, abs=0.018)


def test_the_lag_of_a_valve_is_what_the_perfect_plant_says() -> None:
    plant = averaged(0.5, 0.7, 3.0, seed=4)
    for valve in range(6):
        expected = WANG.mean_lag_s + plant._scatter.shift_s[valve]
        assert lag_of(plant, valve, 0.5, 0.7, 3.0) == pytest.approx(expected, abs=1e-4)


def test_flow_starts_after_the_opening_dead_time_and_ends_after_closing_and_ramp() -> None:
    plant = PulsedPlant(EVEN, seed=1)
    plant.record([Edge(1.0, 0, True, 1.0), Edge(2.0, 0, False, 0.0)])
    times_s = np.array([1.0849, 1.0851, 2.1199, 2.1201, 9.0])
    volume_ml = plant.volume_ml(times_s)[:, 0]
    assert volume_ml[0] == 0.0 < volume_ml[1]
    assert volume_ml[2] < volume_ml[3]
    assert volume_ml[4] == pytest.approx(volume_ml[3], abs=1e-9)


def test_a_valve_stuck_closed_never_flows_and_one_stuck_open_always_does() -> None:
    plant = AveragedPlant(EVEN, seed=1)
    plant.stick(0.0, 1, is_open=True)
    plant.stick(0.0, 2, is_open=False)
    for valve in range(6):
        plant.record_change(0.0, valve, 0.5)
        plant.record_change(2.0, valve, 0.0)
    flows = np.diff(plant.volume_ml(np.array([1.0, 2.0, 3.0, 4.0])), axis=0)
    assert flows[0, 2] == 0.0 < flows[0, 3]
    assert flows[0, 1] > 1.5 * flows[0, 3]
    assert flows[2, 1] > 0.0 == pytest.approx(flows[2, 3], abs=1e-9)


@pytest.mark.parametrize("kind", [pulsed, averaged])
def test_forgetting_the_past_changes_nothing_of_the_present(kind: type) -> None:
    times_s = np.linspace(4.0, 8.0, 300)
    whole, short = kind(0.5, 0.8, 4.5), kind(0.5, 0.8, 4.5)
    for before_s in (1.0, 2.5, 3.5):
        short.forget(before_s)
    assert short.volume_ml(times_s) == pytest.approx(whole.volume_ml(times_s), abs=1e-7)
    assert metered_l_min(short, times_s) == pytest.approx(metered_l_min(whole, times_s), abs=1e-7)
    assert np.array_equal(short.meter_count(times_s), whole.meter_count(times_s))
    with pytest.raises(ValueError, match="forgotten"):
        short.volume_ml(np.array([1.0]))


def test_the_meter_is_off_by_its_gain_and_a_little_noise() -> None:
    gains = []
    for seed in range(30):
        plant = averaged(0.0, 0.7, 0.1, seed=seed)
        times_s = 2.0 + T * np.arange(60)
        ratio = metered_l_min(plant, times_s) / nominal_l_min(0.7, 6)
        gains.append(float(ratio.mean()))
        assert 0.003 < np.std(ratio) < 0.02
    assert 0.96 < min(gains) < 0.985 < 1.015 < max(gains) < 1.04


def test_the_meter_gives_its_pulses_by_the_litre() -> None:
    plant = AveragedPlant(
        replace(EVEN, meter=replace(EVEN.meter, gain_spread=0.0, noise=0.0)), seed=1
    )
    plant.record_change(0.0, 0, 1.0)
    times_s = np.array([30.0])
    litres = float(plant.volume_ml(times_s - 0.001).sum()) / 1000.0
    assert int(plant.meter_count(times_s)[0]) == int(litres * 4600.0)


def test_the_same_seed_is_the_same_sprayer_and_another_one_is_not() -> None:
    ends = [pulsed(0.0, 0.6, 0.5, seed=seed).volume_ml(np.array([8.0])) for seed in (1, 1, 2)]
    assert np.array_equal(ends[0], ends[1])
    assert not np.array_equal(ends[0], ends[2])
    assert float(ends[0].sum()) == pytest.approx(float(ends[2].sum()), rel=2e-3)


def test_wrong_duties_are_refused() -> None:
    with pytest.raises(ValueError, match="duty"):
        AveragedPlant(WANG, seed=1).record_change(0.0, 0, float("nan"))
