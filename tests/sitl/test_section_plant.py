"""A pump that feeds sections, a constant pump before PWM valves: volume, laws, meter, motors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.types import DriveChange, DrivePlan, SprayPlan, TimedChange
from companion.output.pwm import PulseEngine
from sitl.drives import DriveFollower, Motors
from sitl.flight import FlightOptions, sprayer
from sitl.knowledge import lags, pwm_limits
from sitl.plant import AveragedPlant, PulsedPlant
from sitl.plants import PumpPlant, SuppliedAveraged, SuppliedPulsed
from sitl.profile import ML_S_PER_L_MIN, PlantProfile, flow_table, load_profile
from sitl.section_plant import SectionPlant

SECTIONS, PWM_PUMP, SPINNING = (
    load_profile(name) for name in ("pump-sections", "pwm-pump", "atomiser")
)
assert SECTIONS.supply is not None
assert PWM_PUMP.supply is not None
LIKE_ONE = replace(SECTIONS, lag_scatter=0.0, flow_scatter=0.0)
PUMP_ORDERS = st.lists(
    st.tuples(st.floats(0.0, 15.0), st.one_of(st.just(1000.0), st.floats(1150.0, 2000.0))),
    max_size=8,
)
VALVE_ORDERS = st.lists(
    st.tuples(st.floats(0.0, 15.0), st.integers(0, 5), st.booleans()), max_size=16
)
Pulses = Sequence[tuple[float, float]]
Edges = Sequence[tuple[float, int, bool]]


def ordered(profile: PlantProfile, pulses: Pulses, edges: Edges) -> SectionPlant:
    plant = SectionPlant(profile, seed=3)
    for at_s, pulse_us in sorted(pulses):
        plant.record_pump(at_s, pulse_us)
    for at_s, valve, is_open in sorted(edges):
        plant.record_change(at_s, valve, 1.0 if is_open else 0.0)
    return plant


def brute_force_ml(
    pulses: Pulses, edges: Edges, end_s: float, step_s: float
) -> tuple[list[float], float]:
    """Return each section's volume and the pump's, by small steps of the laws as they are told."""
    supply, measured = LIKE_ONE.supply, LIKE_ONE.nozzle_sets[0]
    table = flow_table(LIKE_ONE)
    assert supply is not None
    most = supply.relief * measured.flow_max_l_min * ML_S_PER_L_MIN
    heard: list[tuple[float, float]] = []
    before = 0.0
    for at_s, pulse_us in sorted(pulses):
        fraction = supply.fraction(pulse_us)
        if fraction != before:
            dead_s = supply.spin_up_s if before == 0.0 else supply.dead_s
            latest_s = heard[-1][0] if heard else 0.0
            heard.append((max(at_s + dead_s, latest_s), 6 * table.mean_ml_s(fraction, 6)))
            before = fraction
    moves = sorted(
        (at_s + (LIKE_ONE.dead_open_s if is_open else LIKE_ONE.dead_close_s), valve, is_open)
        for at_s, valve, is_open in edges
    )
    level = flow = pumped = 0.0
    openings, wanted, volumes = [0.0] * 6, [False] * 6, [0.0] * 6
    for i in range(round(end_s / step_s)):
        now_s = (i + 0.5) * step_s
        while heard and heard[0][0] <= now_s:
            level = heard.pop(0)[1]
        while moves and moves[0][0] <= now_s:
            _, valve, wanted[valve] = moves.pop(0)
        for valve in range(6):
            by = step_s / LIKE_ONE.ramp_s
            openings[valve] += by if wanted[valve] else -by
            openings[valve] = min(max(openings[valve], 0.0), 1.0)
        flow += (level - flow) / (supply.up_s if level > flow else supply.down_s) * step_s
        pumped += flow * step_s
        total = sum(openings) / 6.0
        for valve in range(6):
            if total > 1e-9:
                volumes[valve] += openings[valve] / 6.0 * min(flow / total, most) * step_s
    return volumes, pumped


@pytest.mark.parametrize(
    ("pulses", "edges"),
    [
        ([(0.1, 1700.0)], [(0.5, v, True) for v in range(6)]),
        (
            [(0.1, 2000.0), (4.0, 1300.0), (6.0, 1900.0), (8.0, 1000.0), (8.5, 1500.0)],
            [(0.5 + 0.2 * v, v, True) for v in range(6)]
            + [(3.0 + 0.25 * v, v, False) for v in range(6)]
            + [(5.5, v, True) for v in range(3)]
            + [(9.0, 1, False), (9.2, 4, True)],
        ),
    ],
)
def test_sections_volumes_are_those_of_the_laws_in_small_steps(
    pulses: Pulses, edges: Edges
) -> None:
    plant = ordered(LIKE_ONE, pulses, edges)
    end_s = np.array([12.0])
    volumes, pumped = brute_force_ml(pulses, edges, 12.0, 0.001)
    assert plant.flow.pumped_ml(end_s)[0] == pytest.approx(pumped, rel=2e-3)
    assert sum(volumes) > 100.0
    for found, expected in zip(plant.volume_ml(end_s)[0], volumes, strict=True):
        assert found == pytest.approx(expected, rel=3e-3, abs=0.5)


@settings(max_examples=30, deadline=None)
@given(pulses=PUMP_ORDERS, edges=VALVE_ORDERS)
def test_no_section_falls_and_together_they_never_give_more_than_the_pump(
    pulses: Pulses, edges: Edges
) -> None:
    plant = ordered(SECTIONS, pulses, edges)
    times_s = np.linspace(0.0, 25.0, 2501)
    volume_ml = plant.volume_ml(times_s)
    assert np.all(np.diff(volume_ml, axis=0) >= -1e-9)
    back_ml = plant.flow.pumped_ml(times_s[::50]) - volume_ml[::50].sum(axis=1)
    assert np.all(np.diff(back_ml) >= -1e-6)
    alone = [plant.volume_ml(np.array([at_s]))[0] for at_s in times_s[::100]]
    assert np.allclose(alone, volume_ml[::100], atol=1e-9)
    plant.forget(12.0)
    late = times_s >= 12.0
    assert np.allclose(plant.volume_ml(times_s[late]), volume_ml[late], atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(pulses=PUMP_ORDERS, edges=VALVE_ORDERS)
def test_what_is_heard_in_passing_is_what_is_heard_at_once(pulses: Pulses, edges: Edges) -> None:
    """Orders come in order of time, looked at between them, as in a flight."""
    at_once, passing = ordered(SECTIONS, pulses, edges), SectionPlant(SECTIONS, seed=3)
    both = [(at_s, -1, pulse_us) for at_s, pulse_us in pulses]
    both += [(at_s, valve, float(is_open)) for at_s, valve, is_open in edges]
    for at_s, valve, value in sorted(both):
        passing.flow.volume_at(at_s + 0.2)
        if valve < 0:
            passing.record_pump(at_s, value)
        else:
            passing.record_change(at_s, valve, value)
    times_s = np.linspace(0.0, 25.0, 101)
    assert np.allclose(passing.volume_ml(times_s), at_once.volume_ml(times_s), atol=1e-7)


def test_all_that_is_pumped_comes_out_where_the_sections_can_take_it() -> None:
    edges = [(0.0, valve, True) for valve in range(6)]
    plant = ordered(SECTIONS, [(0.5, 1600.0), (6.0, 1800.0), (12.0, 1300.0)], edges)
    end_s = np.array([25.0])
    assert plant.flow.pumped_ml(end_s)[0] == pytest.approx(plant.volume_ml(end_s).sum(), rel=1e-9)


def test_one_open_section_of_six_gets_what_the_relief_valve_leaves_it() -> None:
    supply = SECTIONS.supply
    assert supply is not None
    plant = ordered(LIKE_ONE, [(0.0, 2000.0)], [(0.0, 2, True)])
    volume = plant.volume_ml(np.array([15.0, 20.0]))
    most = supply.relief * LIKE_ONE.nozzle_sets[0].flow_max_l_min * ML_S_PER_L_MIN / 6.0
    assert (volume[1] - volume[0])[2] == pytest.approx(5.0 * most)
    assert (volume[1] - volume[0]).sum() == pytest.approx(5.0 * most)


def test_with_all_open_a_step_is_that_of_the_pump_with_a_valve() -> None:
    """Two plants written apart: the same curve, lags and orders give the same volume."""
    supply = LIKE_ONE.supply
    assert supply is not None
    even = replace(LIKE_ONE, supply=replace(supply, spin_up_s=supply.dead_s))
    sections = ordered(even, [(1.0, 1500.0), (9.0, 1650.0)], [(0.2, v, True) for v in range(6)])
    one = load_profile("pump")
    assert one.pump is not None
    bare = PumpPlant(replace(one, pump=replace(one.pump, shut_off=False)), seed=1)
    bare.record_change(1.0, 0, 0.5)
    bare.record_change(9.0, 0, 0.65)
    times_s = np.array([3.0, 8.0, 10.0, 20.0])
    assert np.allclose(sections.volume_ml(times_s).sum(axis=1), bare.volume_ml(times_s)[:, 0])


def test_the_meter_of_the_sections_counts_in_passing_what_it_counts_at_once() -> None:
    edges = [(0.3 * v, v, True) for v in range(6)] + [(6.0, v, False) for v in range(6)]
    plant = ordered(SECTIONS, [(0.0, 1700.0), (4.0, 1400.0)], edges)
    counter = plant.meter_counter()
    times_s = np.arange(0.1, 9.0, 0.1)
    counts = [counter(at_s) for at_s in times_s.tolist()]
    assert counts == plant.meter_count(times_s).tolist()
    assert counts[-1] > 500


def test_a_sprayer_without_valves_sprays_as_long_as_its_pump_gives() -> None:
    supply = SECTIONS.supply
    assert supply is not None
    bare = replace(SECTIONS, supply=replace(supply, valves=False))
    plant = ordered(bare, [(0.0, 1500.0), (10.0, 1000.0)], [(1.0, 0, False)])
    ends_ml = plant.volume_ml(np.array([0.5, 10.0, 25.0])).sum(axis=1)
    assert ends_ml[0] == 0.0
    assert ends_ml[2] == pytest.approx(plant.flow.pumped_ml(np.array([25.0]))[0])
    assert lags(bare).off_end_s > supply.dead_s + 3.0 * supply.down_s
    with pytest.raises(ValueError, match="constant pump has valves"):
        replace(supply, control="constant", valves=False)


# ------------------------------------------------------------------- PWM valves, constant pump


def fed(plant: AveragedPlant, changes: Edges) -> AveragedPlant:
    for at_s, valve, is_open in changes:
        plant.record_change(at_s, valve, 0.6 if is_open else 0.0)
    return plant


CHANGES: Edges = [(0.5, v, True) for v in range(6)] + [(5.0, v, v > 2) for v in range(6)]


def test_behind_a_pump_that_runs_pwm_valves_are_what_they_were() -> None:
    profile = replace(PWM_PUMP, supply=None)
    alone = fed(AveragedPlant(profile, seed=2, start_s=-9.0), CHANGES)
    plant = SuppliedAveraged(PWM_PUMP, seed=2, start_s=-9.0)
    plant.record_pump(-9.0, 1500.0)
    fed(plant, CHANGES)
    times_s = np.linspace(-9.0, 8.0, 500)
    assert np.allclose(plant.volume_ml(times_s), alone.volume_ml(times_s), atol=1e-9)


def test_a_late_pump_costs_the_volume_of_its_lag() -> None:
    supply = PWM_PUMP.supply
    assert supply is not None
    late, early = (SuppliedAveraged(PWM_PUMP, seed=2, start_s=-9.0) for _ in range(2))
    early.record_pump(-9.0, 1500.0)
    late.record_pump(1.0, 1500.0)
    changes: Edges = [(0.0, v, True) for v in range(6)]
    at_s = np.array([0.5, 6.0])
    found, full = (fed(plant, changes).volume_ml(at_s).sum(axis=1) for plant in (late, early))
    assert found[0] == 0.0
    flow_ml_s = (full[1] - full[0]) / 5.5
    lag_s = supply.spin_up_s + supply.up_s
    assert found[1] == pytest.approx(flow_ml_s * (6.0 - 1.0 - lag_s), rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(
    pump=st.lists(st.tuples(st.floats(0.0, 6.0), st.sampled_from([1000.0, 1600.0])), max_size=6),
    changes=st.lists(
        st.tuples(st.floats(0.0, 6.0), st.integers(0, 5), st.sampled_from([0.0, 0.3, 0.7, 1.0])),
        max_size=10,
    ),
)
def test_supplied_pulses_never_fall_never_exceed_and_keep_the_volume_of_the_means(
    pump: Pulses, changes: Sequence[tuple[float, int, float]]
) -> None:
    engine = PulseEngine(pwm_limits(PWM_PUMP), 6, start_s=0.0, overrun_s=PWM_PUMP.overrun_s)
    for at_s, valve, duty in sorted(changes):
        engine.order(valve, duty, at_s=at_s, restart=True)
    edges = engine.advance(9.0)
    free = PulsedPlant(replace(PWM_PUMP, supply=None), seed=4)
    plant = SuppliedPulsed(PWM_PUMP, seed=4)
    for at_s, pulse_us in sorted(pump):
        plant.record_pump(at_s, pulse_us)
    free.record(edges)
    plant.record(edges)
    times_s = np.linspace(0.0, 9.0, 901)
    volume, most = plant.volume_ml(times_s), free.volume_ml(times_s)
    assert np.all(np.diff(volume, axis=0) >= -1e-9)
    assert np.all(volume <= most + 1e-9)
    # The flow times the pressure, summed by small steps.
    fine_s = np.linspace(0.0, 9.0, 9001)
    pressure = plant.pressure.values(0.5 * (fine_s[1:] + fine_s[:-1]))[:, None]
    summed = (np.diff(free.volume_ml(fine_s), axis=0) * pressure).sum(axis=0)
    assert np.allclose(volume[-1], summed, rtol=2e-3, atol=0.02)
    plant.forget(4.0)
    assert np.allclose(plant.volume_ml(times_s[500:]), volume[500:], atol=1e-9)


def test_both_fidelities_of_a_constant_pump_give_the_same_volume() -> None:
    engine = PulseEngine(pwm_limits(PWM_PUMP), 6, start_s=0.0, overrun_s=PWM_PUMP.overrun_s)
    for valve in range(6):
        engine.order(valve, 0.6, at_s=0.5, restart=True)
    pulsed, mean = SuppliedPulsed(PWM_PUMP, seed=2), SuppliedAveraged(PWM_PUMP, seed=2)
    for plant in (pulsed, mean):
        plant.record_pump(1.0, 1500.0)
        plant.record_pump(7.0, 1000.0)
    pulsed.record(engine.advance(10.0))
    fed(mean, [(0.5, v, True) for v in range(6)])
    at_s = np.array([10.0])
    assert pulsed.volume_ml(at_s).sum() == pytest.approx(mean.volume_ml(at_s).sum(), rel=0.02)


def test_the_meter_behind_a_constant_pump_counts_in_passing_what_it_counts_at_once() -> None:
    plant = SuppliedAveraged(PWM_PUMP, seed=2)
    counter = plant.meter_counter()
    plant.record_pump(0.2, 1500.0)
    plant.record_pump(5.5, 1000.0)
    fed(plant, CHANGES)
    times_s = np.arange(0.1, 8.0, 0.1)
    counts = [counter(at_s) for at_s in times_s.tolist()]
    assert counts == plant.meter_count(times_s).tolist()
    assert counts[-1] > 500


# ------------------------------------------------------------------------------------- motors


def plan(now_s: float, *drives: DrivePlan, lease_s: float = 0.3) -> SprayPlan:
    return SprayPlan(
        sequence=1,
        issued_s=now_s,
        duty=(1.0, 1.0),
        changes=(),
        lease_until_s=now_s + lease_s,
        drives=drives,
    )


def test_a_motor_follows_its_plans_and_stops_with_the_lease() -> None:
    follower = DriveFollower()
    later = DriveChange(at_s=1.2, fraction=0.7)
    drive = DrivePlan(fraction=0.5, changes=(later,))
    made = follower.submit(drive, now_s=1.0, lease_until_s=1.3)
    made += follower.advance(5.0)
    assert [(each.at_s, each.fraction) for each in made] == [(1.0, 0.5), (1.2, 0.7), (1.3, 0.0)]


def test_a_plan_that_names_no_motor_stops_them() -> None:
    plant, output = sprayer(SPINNING, FlightOptions(fidelity="averaged"), 0.0)
    output.submit(plan(1.0, *[DrivePlan(fraction=0.5)] * 3), now_s=1.0)
    output.submit(plan(1.1), now_s=1.1)
    output.finish(9.0)
    assert isinstance(plant, SectionPlant)
    motors = getattr(output, "motors", None)
    assert isinstance(motors, Motors)
    pulses = [(order.drive, order.pulse_us) for order in motors.orders]
    assert pulses == [(0, 1500.0), (1, 1500.0), (2, 1500.0), (0, 1000.0), (1, 1000.0), (2, 1000.0)]


@pytest.mark.parametrize("name", ["pump-sections", "atomiser", "pwm-pump"])
@pytest.mark.parametrize("fidelity", ["averaged", "pulsed"])
@pytest.mark.parametrize("path", ["gpio", "servo"])
def test_each_way_to_the_valves_opens_them_and_turns_the_motors(
    name: str, fidelity: str, path: str
) -> None:
    profile = load_profile(name)
    options = FlightOptions(fidelity=fidelity, output=path)  # type: ignore[arg-type]
    plant, output = sprayer(profile, options, 0.0)
    drives = tuple(DrivePlan(fraction=0.6) for _ in range(profile.drive_count))
    for i in range(100):
        now_s = 0.05 * i
        given = plan(now_s, *drives)
        is_open = (1.0,) * profile.valve_count
        output.submit(replace(given, sequence=i + 1, duty=is_open), now_s=now_s)
    output.finish(9.0)
    volume_ml = plant.volume_ml(np.array([5.0, 8.0, 9.0])).sum(axis=1)
    assert volume_ml[0] > 50.0
    assert volume_ml[2] == pytest.approx(volume_ml[1])


def test_an_atomisers_speed_and_droplets_follow_their_laws() -> None:
    motors = Motors(SPINNING, SectionPlant(SPINNING, seed=1), start_s=0.0)
    motors.order(1.0, 1, 1550.0)
    motors.order(6.0, 1, 1000.0)
    times_s = np.arange(0.0, 9.0, 0.01)
    fed_ml = np.column_stack([25.0 * times_s, 25.0 * times_s])  # 1.5 L/min each
    truth = motors.truth(times_s, fed_ml)
    rpm = truth.rpm[:, 0]
    assert rpm[np.searchsorted(times_s, 5.9)] == pytest.approx(9750.0, rel=1e-4)
    half_s = times_s[np.flatnonzero(rpm > 4875.0)[0]] - 1.0
    assert half_s == pytest.approx(0.35 * math.log(2.0), abs=0.011)
    expected = 425500.0 * 9750.0**-0.85 * 1.5**0.15
    assert truth.vmd_um[590, 0] == pytest.approx(expected, rel=1e-3)
    assert truth.vmd_um[590, 0] == pytest.approx(184.0, abs=2.0)
    assert np.isnan(truth.vmd_um[50, 0])
    assert np.all(np.isnan(truth.vmd_um[:, 1]))
    assert truth.vmd_um[120, 0] > 1.5 * truth.vmd_um[590, 0]


def test_valves_that_two_atomisers_share_feed_each_its_part() -> None:
    left = replace(SPINNING.atomisers[0], valves=(0, 1))
    motors = Motors(
        replace(SPINNING, atomisers=(left, SPINNING.atomisers[1])),
        SectionPlant(SPINNING, seed=1),
        start_s=0.0,
    )
    times_s = np.array([0.0, 1.0, 2.0])
    truth = motors.truth(times_s, np.column_stack([10.0 * times_s, 20.0 * times_s]))
    assert truth.volume_ml[-1].tolist() == [40.0, 20.0]


def test_sprayers_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="no pump that feeds"):
        SectionPlant(PWM_PUMP, seed=1)
    with pytest.raises(ValueError, match="no constant pump"):
        SuppliedAveraged(SECTIONS, seed=1)
    with pytest.raises(ValueError, match="no such valves"):
        replace(SPINNING, atomisers=(replace(SPINNING.atomisers[0], valves=(7,)),))
    supply = SECTIONS.supply
    assert supply is not None
    with pytest.raises(ValueError, match="stop_us < min_us"):
        replace(supply, min_us=900.0)
    with pytest.raises(ValueError, match="two kinds"):
        replace(load_profile("pump"), supply=supply)
    with pytest.raises(ValueError, match="increasing"):
        replace(SPINNING.atomisers[0], us=(1100.0, 1100.0), rpm=(1.0, 2.0))


def test_a_change_of_a_duty_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="duty outside"):
        SectionPlant(SECTIONS, seed=1).record_change(0.0, 0, math.nan)


def test_orders_of_valves_and_pump_are_in_the_flights_orders() -> None:
    _, output = sprayer(SECTIONS, FlightOptions(fidelity="averaged"), 0.0)
    change = TimedChange(at_s=1.1, valve=3, duty=0.0)
    given = replace(plan(1.0, DrivePlan(fraction=0.5)), duty=(1.0,) * 6, changes=(change,))
    output.submit(given, now_s=1.0)
    output.finish(1.2)
    assert [order.valve for order in output.orders] == [0, 1, 2, 3, 4, 5, 3]
