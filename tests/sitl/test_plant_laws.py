from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.types import SprayPlan, TimedChange
from companion.output.pwm import PulseEngine, needs_restart
from sitl.knowledge import pwm_limits
from sitl.outputs import ValvePulses, phase_of
from sitl.plant import AveragedPlant, BoardEdge, Plant, PulsedPlant
from sitl.profile import PlantProfile, load_profile

PROFILES = tuple(load_profile(name) for name in ("wang-2024", "orchard-180"))
DUTIES = st.one_of(st.just(0.0), st.floats(0.2, 0.85), st.just(1.0))


@st.composite
def plants(draw: st.DrawFn) -> Plant:
    profile = draw(st.sampled_from(PROFILES))
    seed = draw(st.integers(0, 1000))
    changes = [
        TimedChange(
            at_s=draw(st.floats(0.01, 3.0)), valve=draw(st.integers(0, 5)), duty=draw(DUTIES)
        )
        for _ in range(draw(st.integers(0, 12)))
    ]
    changes.sort(key=lambda change: change.at_s)
    duty = tuple(draw(DUTIES) for _ in range(6))
    if draw(st.booleans()):
        averaged = AveragedPlant(profile, seed=seed)
        for valve in range(6):
            averaged.record_change(0.0, valve, duty[valve])
        for change in changes:
            averaged.record_change(change.at_s, change.valve, change.duty)
        for valve in range(6):
            averaged.record_change(4.0, valve, 0.0)
        return averaged
    engine = PulseEngine(pwm_limits(profile), 6, start_s=0.0)
    plan = SprayPlan(sequence=0, issued_s=0.0, duty=duty, changes=tuple(changes), lease_until_s=4.0)
    engine.submit(plan, now_s=0.0)
    pulsed = PulsedPlant(profile, seed=seed)
    pulsed.record(engine.advance(5.0))
    return pulsed


@settings(max_examples=60, deadline=None)
@given(plant=plants())
def test_volume_never_falls_and_ends_when_all_is_closed(plant: Plant) -> None:
    volume_ml = plant.volume_ml(np.linspace(0.0, 8.0, 1601))
    assert np.all(np.diff(volume_ml, axis=0) >= -1e-6)
    assert np.all(volume_ml[0] == 0.0)
    assert np.allclose(volume_ml[-1], volume_ml[-700], atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(plant=plants(), cuts=st.lists(st.floats(0.0, 8.0), min_size=1, max_size=30))
def test_any_cut_of_time_gives_the_same_volume(plant: Plant, cuts: list[float]) -> None:
    times_s = np.array([0.0, *sorted(cuts), 8.0])
    pieces_ml = np.diff(plant.volume_ml(times_s), axis=0).sum(axis=0)
    assert np.allclose(pieces_ml, plant.volume_ml(np.array([8.0]))[0], atol=1e-9)
    one_by_one = np.vstack([plant.volume_ml(np.array([at_s])) for at_s in times_s])
    assert np.array_equal(one_by_one, plant.volume_ml(times_s))


@settings(max_examples=40, deadline=None)
@given(plant=plants(), before_s=st.floats(0.2, 6.0))
def test_forgetting_changes_no_volume(plant: Plant, before_s: float) -> None:
    times_s = np.linspace(before_s, 8.0, 50)
    before_ml = plant.volume_ml(times_s)
    plant.forget(before_s)
    assert np.allclose(plant.volume_ml(times_s), before_ml, atol=1e-6)


MOVES = st.lists(
    st.tuples(
        st.floats(0.0, 1.0),
        st.one_of(st.sampled_from((0.0, 1.0)), st.floats(0.02, 1.0), st.floats(0.48, 0.52)),
    ),
    max_size=12,
)


@settings(max_examples=200, deadline=None)
@given(
    profile=st.sampled_from(PROFILES),
    overrun_s=st.sampled_from((0.0, 0.005)),
    valve=st.integers(0, 5),
    moves=MOVES,
)
def test_the_board_and_the_products_engine_are_two_readings_of_one_page(
    profile: PlantProfile, overrun_s: float, valve: int, moves: list[tuple[float, float]]
) -> None:
    """Written apart; without a plan ahead, which no board has, they make the same edges."""
    engine = PulseEngine(pwm_limits(profile), 6, start_s=0.0, overrun_s=overrun_s)
    phase_s = phase_of(valve, 6) * profile.pwm.period_s
    board = ValvePulses(valve, profile.pwm, phase_s=phase_s, overrun_s=overrun_s)
    made: list[BoardEdge] = []
    at_s, old = 0.0, 0.0
    for wait_s, duty in moves:
        at_s += wait_s
        if duty != old:
            is_new = needs_restart(old, duty)
            engine.order(valve, duty, at_s=at_s, restart=is_new)
            board.advance(at_s, made)
            board.order(at_s, duty, is_new_period=is_new, out=made)
        old = duty
    # Both are asked between two moments: at one of them rounding alone would decide.
    engine_edges = engine.advance(at_s + 1.0)
    board.advance(at_s + 1.0, made)
    both = [np.array([edge[:1] + edge[2:] for edge in each]) for each in (engine_edges, made)]
    shorter = min(len(each) for each in both)
    assert max(len(each) for each in both) - shorter <= 1
    assert np.allclose(both[0][:shorter], both[1][:shorter], atol=1e-7)
