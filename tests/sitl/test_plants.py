"""The plants beside the paper's: volume conserved, exact integrals, lags; the core's inputs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import UnionType
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import load
from companion.core import inputs as core_inputs
from companion.core.controller import Memory, step
from companion.core.nozzle import TRIM_AGE_S
from companion.core.types import FlowReport, Input, SprayPlan, Telemetry, TimedChange
from companion.errors import ConfigError
from companion.output.pwm import PulseEngine
from missions.maps.compiling import compiled_setup
from sitl.flight import FlightOptions, fly, sprayer
from sitl.knowledge import lags, measured_sets, pwm_limits
from sitl.plant import AveragedPlant, PulsedPlant
from sitl.plants import PumpFlow, PumpPlant
from sitl.profile import ML_S_PER_L_MIN, PlantProfile, flow_table, load_profile
from tests.bench.pump import SPEED_M_S, TUNED_S, flights, path, setup
from tests.builders import flying
from tools.studies.measure_pump import measure

PINPOINT, PUMP = load_profile("pinpoint"), load_profile("pump")
assert PUMP.pump is not None
BARE = replace(PUMP, pump=replace(PUMP.pump, shut_off=False))
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ORDERS = st.lists(
    st.tuples(st.floats(0.0, 20.0), st.one_of(st.just(0.0), st.floats(0.15, 1.0))), max_size=12
)

Orders = Sequence[tuple[float, float]]


def pumped(profile: PlantProfile, orders: Orders) -> PumpPlant:
    plant = PumpPlant(profile, seed=1)
    for at_s, duty in sorted(orders):
        plant.record_change(at_s, 0, duty)
    return plant


def brute_force_ml(profile: PlantProfile, orders: Orders, end_s: float, step_s: float) -> float:
    """Return the volume by small steps of the differential equation, written from its text."""
    pump = profile.pump
    assert pump is not None
    table = flow_table(profile)
    level = opening = flow = volume = 0.0
    waiting = sorted(orders)
    heard: list[tuple[float, float]] = []  # level of the pump, when it hears of it
    valve: list[tuple[float, bool]] = []
    wanted = not pump.shut_off
    duty_before = 0.0
    for at_s, duty in waiting:
        if duty == duty_before:
            continue
        if duty > 0.0 or not pump.shut_off:
            heard.append((at_s + pump.dead_s, table.mean_ml_s(duty, 1)))
        if (duty > 0.0) != (duty_before > 0.0):
            valve.append((at_s + profile.dead_open_s, duty > 0.0))
        duty_before = duty
    for i in range(round(end_s / step_s)):
        now_s = (i + 0.5) * step_s
        while heard and heard[0][0] <= now_s:
            level = heard.pop(0)[1]
        flow += (level - flow) / (pump.up_s if level > flow else pump.down_s) * step_s
        if pump.shut_off:
            while valve and valve[0][0] <= now_s:
                wanted = valve.pop(0)[1]
            opening += (1.0 if wanted else -1.0) * step_s / profile.ramp_s
            opening = min(max(opening, 0.0), 1.0)
        else:
            opening = 1.0
        volume += flow * opening * step_s
    return volume


@pytest.mark.parametrize("profile", [PUMP, BARE], ids=["valve", "bare"])
@pytest.mark.parametrize(
    "orders",
    [
        [(0.5, 0.6), (8.0, 0.3)],
        [(0.5, 1.0), (1.0, 0.2), (1.3, 0.9), (4.0, 0.0), (5.0, 0.5)],
        [(0.5, 0.4), (6.0, 0.0), (9.0, 0.8), (9.5, 0.15)],
    ],
)
def test_a_pumps_volume_is_that_of_its_differential_equation(
    profile: PlantProfile, orders: Orders
) -> None:
    exact_ml = float(pumped(profile, orders).volume_ml(np.array([14.0]))[0, 0])
    assert exact_ml > 50.0
    assert exact_ml == pytest.approx(brute_force_ml(profile, orders, 14.0, 0.001), rel=1e-3)


@settings(max_examples=40, deadline=None)
@given(orders=ORDERS, has_valve=st.booleans())
def test_a_pumps_volume_never_falls_and_any_cut_gives_the_same(
    orders: Orders, has_valve: bool
) -> None:
    plant = pumped(PUMP if has_valve else BARE, orders)
    times_s = np.linspace(0.0, 30.0, 601)
    volume_ml = plant.volume_ml(times_s)
    assert np.all(np.diff(volume_ml, axis=0) >= -1e-9)
    alone = [plant.volume_ml(np.array([at_s]))[0, 0] for at_s in times_s[::50]]
    assert np.array_equal(alone, volume_ml[::50, 0])
    plant.forget(12.0)
    assert np.allclose(plant.volume_ml(times_s[times_s >= 12.0]), volume_ml[times_s >= 12.0])


@settings(max_examples=40, deadline=None)
@given(orders=ORDERS)
def test_what_a_pump_was_asked_for_is_on_the_ground_or_still_in_its_lag(orders: Orders) -> None:
    """With one time constant: asked = delivered + time constant times the flow that stands."""
    assert BARE.pump is not None
    even = replace(BARE, pump=replace(BARE.pump, down_s=BARE.pump.up_s))
    plant = pumped(even, orders)
    end_s = 25.0
    table = flow_table(even)
    ends = [*(at_s for at_s, _ in sorted(orders)[1:]), end_s - BARE.pump.dead_s]
    asked_ml = sum(
        table.mean_ml_s(duty, 1) * (until_s - at_s)
        for (at_s, duty), until_s in zip(sorted(orders), ends, strict=False)
    )
    late = plant.volume_ml(np.array([end_s - 1e-4, end_s]))[:, 0]
    in_lag_ml = BARE.pump.up_s * (late[1] - late[0]) / 1e-4
    assert late[1] + in_lag_ml == pytest.approx(asked_ml, rel=1e-4, abs=1e-3)


def test_a_step_of_30_percent_stands_after_the_published_times() -> None:
    for before, after, stands_s in ((0.5, 0.65, 3.8), (0.65, 0.455, 2.6)):
        plant = pumped(PUMP, [(0.0, before), (20.0, after)])
        times_s = 20.0 + np.arange(-1.0, 12.0, 0.01)
        flow = np.gradient(plant.volume_ml(times_s)[:, 0], times_s)
        off = np.abs(flow - flow[-1]) > 0.1 * abs(flow[-1] - flow[0])
        assert times_s[np.flatnonzero(off)[-1]] - 20.0 == pytest.approx(stands_s, abs=0.02)


@pytest.mark.parametrize("profile", [PUMP, BARE], ids=["valve", "bare"])
def test_the_rig_finds_the_pumps_true_lags(profile: PlantProfile) -> None:
    found, true = measure(profile), lags(profile)
    for name in ("on_s", "off_s", "up_s", "down_s"):
        assert getattr(found, name) == pytest.approx(getattr(true, name), abs=0.004), name
    assert found.up_s > found.down_s + 0.4
    assert profile.pump is not None
    assert found.up_time_s == pytest.approx(profile.pump.up_s, abs=0.004)
    assert found.down_time_s == pytest.approx(profile.pump.down_s, abs=0.004)
    assert found.off_end_s == pytest.approx(true.off_end_s, abs=0.02)


def test_the_meter_behind_a_pump_counts_in_passing_what_it_counts_at_once() -> None:
    plant = pumped(PUMP, [(0.5, 0.6), (6.0, 0.0), (9.0, 0.8)])
    stream = plant.meter_stream()
    times_s = np.arange(0.1, 14.0, 0.1)
    counts = [stream.count(at_s) for at_s in times_s.tolist()]
    assert counts == plant.meter_count(times_s).tolist()
    assert counts[-1] > 1000


def test_a_pump_is_no_row_of_pulses_and_the_other_way_round() -> None:
    with pytest.raises(ConfigError, match="pump"):
        PulsedPlant(PUMP, seed=1)
    with pytest.raises(ValueError, match="no pump"):
        PumpPlant(PINPOINT, seed=1)
    plant, _ = sprayer(PUMP, FlightOptions(fidelity="pulsed"), 0.0)
    assert isinstance(plant, PumpPlant)
    with pytest.raises(ValueError, match="equal edges"):
        replace(PUMP, valve_count=2)


def pulses(profile: PlantProfile, changes: Sequence[TimedChange], end_s: float) -> PulsedPlant:
    engine = PulseEngine(pwm_limits(profile), 6, start_s=0.0, overrun_s=profile.overrun_s)
    plan = SprayPlan(
        sequence=1, issued_s=0.0, duty=(0.0,) * 6, changes=tuple(changes), lease_until_s=end_s - 1.0
    )
    engine.submit(plan, now_s=0.0)
    plant = PulsedPlant(profile, seed=1)
    plant.record(engine.advance(end_s))
    return plant


@pytest.mark.parametrize("duty", [0.2, 0.35, 0.5, 0.8, 0.9, 1.0])
def test_pulses_of_the_boom_give_its_curve(duty: float) -> None:
    changes = [TimedChange(at_s=0.5, valve=valve, duty=duty) for valve in range(6)]
    plant = pulses(PINPOINT, changes, 30.0)
    ends_ml = plant.volume_ml(np.array([5.0, 25.0])).sum(axis=1)
    flow_l_min = (ends_ml[1] - ends_ml[0]) / 20.0 / ML_S_PER_L_MIN
    assert flow_l_min == pytest.approx(
        6 * flow_table(PINPOINT).mean_ml_s(duty, 6) / ML_S_PER_L_MIN, rel=1e-3
    )


def test_the_booms_nozzle_stands_after_20_ms_and_ends_10_ms_after_the_coil() -> None:
    plant = PulsedPlant(replace(PINPOINT, lag_scatter=0.0, flow_scatter=0.0), seed=1)
    engine = PulseEngine(pwm_limits(PINPOINT), 6, start_s=0.0)
    engine.order(0, 0.5, at_s=1.0, restart=True)
    edges = engine.advance(1.3)
    plant.record(edges)
    opens_s, closes_s = edges[0].at_s, edges[1].at_s
    assert (edges[0].is_open, edges[1].is_open) == (True, False)
    times_s = opens_s + np.array([0.019, 0.020, 0.021, 0.025])
    flow = np.diff(plant.volume_ml(times_s)[:, 0]) / np.diff(times_s)
    assert flow[0] < flow[1] == pytest.approx(flow[2])
    ends_ml = plant.volume_ml(closes_s + np.array([0.009, 0.010, 0.015]))[:, 0]
    assert ends_ml[0] < ends_ml[1] == pytest.approx(ends_ml[2])


@settings(max_examples=40, deadline=None)
@given(
    changes=st.lists(
        st.tuples(
            st.floats(0.01, 3.0),
            st.integers(0, 5),
            st.one_of(st.just(0.0), st.floats(0.2, 0.9), st.just(1.0)),
        ),
        max_size=15,
    )
)
def test_the_booms_volume_never_falls_however_short_its_pulses(
    changes: Sequence[tuple[float, int, float]],
) -> None:
    ordered = [TimedChange(at_s=t, valve=v, duty=d) for t, v, d in sorted(changes)]
    plant = pulses(PINPOINT, ordered, 5.0)
    volume_ml = plant.volume_ml(np.linspace(0.0, 6.0, 3001))
    assert np.all(np.diff(volume_ml, axis=0) >= -1e-9)
    assert np.allclose(volume_ml[-1], volume_ml[-400], atol=1e-9)


def test_the_booms_mean_flow_has_the_same_volume_in_both_fidelities() -> None:
    changes = [TimedChange(at_s=0.5, valve=v, duty=0.4) for v in range(6)]
    changes += [TimedChange(at_s=2.0, valve=v, duty=0.7) for v in range(6)]
    mean = AveragedPlant(PINPOINT, seed=1)
    for change in changes:
        mean.record_change(change.at_s, change.valve, change.duty)
    at_s = np.array([3.5])
    pulsed_ml = pulses(PINPOINT, changes, 9.0).volume_ml(at_s).sum()
    assert pulsed_ml == pytest.approx(mean.volume_ml(at_s).sum(), rel=0.02)


def test_scheduled_brings_a_pumps_steps_to_their_boundaries() -> None:
    found = flights(PUMP, 1, ("none", "scheduled"))
    ours, none = found["scheduled"], found["none"]
    assert ours.missed == none.missed == 0
    assert ours.lag_distance_m.count == 14
    assert abs(ours.lag_distance_m.mean or 9.0) < 1.0 < 6.0 < (none.lag_distance_m.mean or 0.0)
    assert 13.0 <= (none.settled_lag_distance_m.mean or 0.0) <= 24.0
    assert (ours.misapplied_percent or 9.0) < 0.6 * (none.misapplied_percent or 0.0)
    # The valve switches at the border, however slow the pump is.
    assert 0.0 <= (ours.border_margin_m.min or -1.0) < 0.5


def test_in_still_air_a_pumps_steps_lie_within_half_a_metre() -> None:
    found = flights(PUMP, 2, gust_m_s=0.0)["scheduled"].lag_distance_m
    assert found.count == 14
    assert (found.mean_abs or 9.0) <= 0.5


def test_the_rivals_look_ahead_is_the_pumps_mean_lag_and_its_own_delays() -> None:
    lag = lags(PUMP)
    assert pytest.approx(0.5 * (lag.up_s + lag.down_s) + 0.42 + 0.1, abs=0.01) == TUNED_S


@pytest.mark.parametrize("name", ["pinpoint", "pump"])
def test_the_example_of_a_plant_knows_its_curve(name: str) -> None:
    mine, profile = compiled_setup(load(EXAMPLES / name / "config.toml")), load_profile(name)
    assert mine.nozzle_sets[0].curve == measured_sets(profile)[0].curve
    assert mine.pwm == pwm_limits(profile)
    assert len(mine.boom.valves) == profile.valve_count
    true = lags(profile)
    for kind in ("on_s", "off_s", "up_s", "down_s"):
        assert getattr(mine.lag, kind) == pytest.approx(getattr(true, kind), abs=0.004)


def test_the_core_is_given_inputs_of_numbers_and_words_and_nothing_else() -> None:
    """No plant, trajectory or profile can be reached from what the controller is handed."""
    given: list[Input] = []
    options = FlightOptions(seed=1, fidelity="averaged", meter_rate_hz=5.0)
    way = path(1)
    # A minute of it has every kind of input.
    until_s = float(way.time_s[0]) + 60.0
    fly(
        setup(PUMP), way, PUMP, options, speed_m_s=SPEED_M_S, on_input=given.append,
        disturb=lambda items: (item for item in items if item.received_s < until_s),
    )  # fmt: skip
    assert {Telemetry, FlowReport} <= {type(item) for item in given}
    allowed = get_args(Input)
    assert isinstance(Input, UnionType)
    assert all(kind.__module__ == core_inputs.__name__ for kind in allowed)
    plain = (float, int, str, bool, type(None), core_inputs.Fix)
    kinds = {type(item): tuple(each.name for each in dataclasses.fields(item)) for item in given}
    assert set(kinds) <= set(allowed)
    found = {(type(item), tuple(map(kind_of, values(item, kinds[type(item)])))) for item in given}
    for kind, parts in found:
        assert all(part in plain for each in parts for part in each), (kind, parts)
    assert not any(hasattr(item, "__dict__") for item in given)


def values(item: Input, names: Sequence[str]) -> list[object]:
    return [getattr(item, name) for name in names]


def kind_of(value: object) -> tuple[type, ...]:
    return tuple(map(type, value)) if type(value) is tuple else (type(value),)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["gaining", "braking"])
def test_a_trim_leads_by_the_lag_of_its_own_direction(sign: float) -> None:
    mine = setup(PUMP)
    state = flying(10.0, 30.0, acceleration_east_m_s2=0.1 * sign)
    up = sign > 0.0
    constant_s = mine.lag.up_time_s if up else mine.lag.down_time_s
    acts_s = (mine.timing.up_s if up else mine.timing.down_s) - constant_s
    acts_s += 0.5 * mine.pwm.period_s + TRIM_AGE_S
    left = math.exp(-acts_s / state.acceleration_fade_s)
    gained_s = state.acceleration_fade_s * (1.0 - left) + constant_s * left
    wanted = 5.0 + 0.1 * sign * gained_s
    curve = mine.nozzle_sets[0].curve
    steady = curve.duty_for(18.0 * 6.0 * 5.0 * 60.0 / 10_000.0)
    plan = SprayPlan(sequence=1, issued_s=9.9, duty=(steady,), changes=(), lease_until_s=10.2)
    decision, _ = step(mine, state, Memory(plan=plan), 10.0)
    expected = curve.duty_for(18.0 * 6.0 * wanted * 60.0 / 10_000.0)
    assert abs(expected - steady) > 0.002
    assert decision.plan.changes[0].duty == pytest.approx(expected, abs=1e-6)
    assert not decision.plan.changes[0].restart


def test_a_pumps_steps_are_ordered_seconds_ahead_and_its_valve_at_the_border() -> None:
    # Not driven past its target: the order is the target, its lead the whole lag.
    mine = setup(PUMP, lag=replace(measure(PUMP), up_time_s=0.0, down_time_s=0.0))
    for east_m, speed_lag_s, rate in ((60.0, mine.lag.up_s, 23.4), (120.0, mine.lag.down_s, 16.4)):
        state = flying(10.0, east_m - 5.0 * (speed_lag_s + 0.2))
        decision, _ = step(mine, state, Memory(), 10.0)
        change = decision.plan.changes[-1]
        assert change.at_s == pytest.approx(10.2, abs=1e-6)
        duty = mine.nozzle_sets[0].curve.duty_for(rate * 6.0 * 5.0 * 60.0 / 10_000.0)
        assert change.duty == pytest.approx(duty, abs=1e-6)
    state = flying(10.0, 480.0 - 1.5)
    decision, _ = step(mine, state, Memory(), 10.0)
    assert decision.plan.changes[-1].duty == 0.0
    ahead_s = (1.5 - mine.border_buffer_m) / 5.0 - mine.lag.off_end_s
    assert decision.plan.changes[-1].at_s == pytest.approx(10.0 + ahead_s, abs=0.01)


def test_a_pumps_flow_at_one_time_is_the_same_as_at_many() -> None:
    flow = PumpFlow(up_s=1.5, down_s=1.0, start_s=0.0, has_valve=True)
    flow.pump(1.0, 60.0)
    flow.valve(2.0, 0.03, is_open=True)
    flow.valve(7.0, 0.03, is_open=False)
    times_s = np.linspace(0.0, 9.0, 37)
    single = [flow.volume_at(at_s) for at_s in times_s.tolist()]
    assert single == pytest.approx(flow.volume_ml(times_s).tolist(), abs=1e-9)
    assert single[-1] == pytest.approx(single[-4], abs=1e-9)
