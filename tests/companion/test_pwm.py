from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.pwm import (
    STRETCH_MAX,
    Edge,
    PulseEngine,
    carried_debt,
    needs_restart,
    stagger,
)

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
T = PWM.period_s


def plan(
    duty: Sequence[float],
    *changes: TimedChange,
    sequence: int = 0,
    issued_s: float = 0.0,
    lease_until_s: float = 100.0,
) -> SprayPlan:
    return SprayPlan(
        sequence=sequence,
        issued_s=issued_s,
        duty=tuple(duty),
        changes=changes,
        lease_until_s=lease_until_s,
    )


def change(at_s: float, duty: float, *, valve: int = 0, restart: bool = True) -> TimedChange:
    return TimedChange(at_s=at_s, valve=valve, duty=duty, restart=restart)


def pulses(
    edges: Sequence[Edge], valve: int = 0, until_s: float = 100.0
) -> list[tuple[float, float]]:
    """Return (opened, closed) of every pulse; edges that repeat a state are left out."""
    found, opened_s = [], None
    for edge in edges:
        if edge.valve != valve:
            continue
        if edge.is_open and opened_s is None:
            opened_s = edge.at_s
        elif not edge.is_open and opened_s is not None:
            found.append((opened_s, edge.at_s))
            opened_s = None
    if opened_s is not None:
        found.append((opened_s, until_s))
    return found


def on_time_s(edges: Sequence[Edge], times_s: np.ndarray, valve: int = 0) -> np.ndarray:
    total = np.zeros_like(times_s)
    for opened_s, closed_s in pulses(edges, valve):
        total += np.clip(times_s - opened_s, 0.0, closed_s - opened_s)
    return total


def step_of(edges: Sequence[Edge], old: float, new: float, at_s: float, valve: int = 0) -> float:
    """Return the volume-equivalent step of an ideal valve, seconds after the change."""
    grid = np.arange(2000) / 2000.0 * 3.0 * T
    before_s, after_s = at_s - 1.0 - 3.0 * T + grid, at_s + 3.0 + grid
    line_0 = float(np.mean(on_time_s(edges, before_s, valve) - old * before_s))
    line_1 = float(np.mean(on_time_s(edges, after_s, valve) - new * after_s))
    return (line_0 - line_1) / (new - old) - at_s


def flown(old: float, new: float, at_s: float, *, known_ahead: bool, valve: int) -> list[Edge]:
    """Return the edges of one change on six valves, planned early or ordered on the spot."""
    engine = PulseEngine(PWM, 6, start_s=0.0)
    if known_ahead:
        engine.submit(plan([old] * 6, change(at_s, new, valve=valve)), now_s=0.0)
        return engine.advance(at_s + 6.0)
    engine.submit(plan([old] * 6), now_s=0.0)
    edges = engine.advance(at_s)
    engine.order(valve, new, at_s=at_s, restart=True)
    return edges + engine.advance(at_s + 6.0)


def test_a_pulse_stands_in_the_middle_of_its_period() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.5]), now_s=0.0)
    for i, (opened_s, closed_s) in enumerate(pulses(engine.advance(1.0))[:5]):
        assert 0.5 * (opened_s + closed_s) == pytest.approx((i + 0.5) * T, abs=1e-9)
        assert closed_s - opened_s == pytest.approx(0.5 * T, abs=1e-9)


def test_the_first_period_starts_with_the_change_that_opens() -> None:
    engine = PulseEngine(PWM, 6, start_s=0.0)
    engine.submit(plan([0.0] * 6, *(change(0.333, 0.5, valve=v) for v in range(6))), now_s=0.0)
    edges = engine.advance(1.0)
    for valve in range(6):
        opened_s, closed_s = pulses(edges, valve)[0]
        middle_s = 0.5 * (opened_s + closed_s)
        assert middle_s == pytest.approx(0.333 + 0.5 * T, abs=0.5 * STRETCH_MAX * T + 1e-9)


def test_full_duty_is_open_from_the_change_on_and_stays_open() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.0], change(0.2, 1.0)), now_s=0.0)
    assert engine.advance(5.0) == [Edge(0.2, 0, True, 1.0)]


def test_zero_closes_at_once_even_within_the_minimum_on_time() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([1.0], change(0.004, 0.0)), now_s=0.0)
    assert engine.advance(1.0) == [Edge(0.0, 0, True, 1.0), Edge(0.004, 0, False, 0.0)]


def test_closing_a_valve_in_its_gap_is_told_all_the_same() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.5]), now_s=0.0)
    engine.advance(T * 0.9)
    engine.order(0, 0.0, at_s=T * 0.95, restart=True)
    assert engine.advance(5.0) == [Edge(T * 0.95, 0, False, 0.0)]


def test_a_restart_begins_a_new_period_at_the_change() -> None:
    edges = flown(0.5, 0.8, 2.0, known_ahead=False, valve=0)
    restarted = [edge for edge in edges if edge.duty == 0.8]
    assert 2.0 <= restarted[0].at_s < 2.0 + 0.5 * T


def test_a_trim_waits_for_the_next_period() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.5]), now_s=0.0)
    engine.order(0, 0.7, at_s=10.2 * T, restart=False)
    opened = {round(a / T): b - a for a, b in pulses(engine.advance(13.0 * T)) if a < 12.0 * T}
    assert opened[10] == pytest.approx(0.5 * T)
    assert opened[11] == pytest.approx(0.7 * T)


@pytest.mark.parametrize("known_ahead", [False, True])
@pytest.mark.parametrize(
    ("old", "new"), [(0.0, 0.6), (0.5, 0.6), (0.7, 0.5), (0.3, 0.85), (1.0, 0.6)]
)
def test_the_volume_equivalent_step_lies_at_the_change(
    old: float, new: float, known_ahead: bool
) -> None:
    rng = np.random.default_rng(7)
    steps = []
    for _ in range(15):
        at_s, valve = 3.0 + float(rng.uniform()), int(rng.integers(6))
        edges = flown(old, new, at_s, known_ahead=known_ahead, valve=valve)
        steps.append(step_of(edges, old, new, at_s, valve))
    assert abs(np.mean(steps)) < 1e-3
    assert np.max(np.abs(steps)) < 12e-3


@pytest.mark.parametrize(("old", "new"), [(0.6, 0.0), (0.8, 0.0), (0.6, 1.0)])
def test_a_change_known_ahead_lies_right_even_where_no_debt_can_be_paid(
    old: float, new: float
) -> None:
    rng = np.random.default_rng(8)
    for _ in range(10):
        at_s = 3.0 + float(rng.uniform())
        edges = flown(old, new, at_s, known_ahead=True, valve=1)
        assert abs(step_of(edges, old, new, at_s, valve=1)) < 1e-3


def test_many_restarts_in_short_order_keep_the_dose() -> None:
    # Each one truncates a period; without the debt, or with its sign turned, the dose is lost.
    engine = PulseEngine(PWM, 1, start_s=0.0)
    changes = [change(0.061 * i, (0.5, 0.6)[i % 2]) for i in range(1, 100)]
    engine.submit(plan([0.5], *changes), now_s=0.0)
    edges = engine.advance(12.0)
    delivered_s = float(on_time_s(edges, np.array([99 * 0.061]))[0])
    assert delivered_s == pytest.approx(99 * 0.061 * 0.55, abs=0.5 * T)


def test_the_debt_is_held_to_one_period() -> None:
    assert carried_debt(0.3 * T, T) == 0.3 * T
    assert carried_debt(5.0, T) == T
    assert carried_debt(-5.0, T) == -T


def test_a_duty_that_the_minimum_off_time_makes_unreachable_builds_no_large_debt() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.93], change(30 * T, 0.5)), now_s=0.0)
    edges = engine.advance(60 * T)
    after_s = on_time_s(edges, np.array([32 * T, 52 * T]))
    assert float(after_s[1] - after_s[0]) == pytest.approx(20 * 0.5 * T, rel=1e-6)
    first = on_time_s(edges, np.array([30 * T, 31 * T]))
    owed_s = float(first[1] - first[0]) - 0.5 * T
    assert abs(owed_s) < 0.5 * PWM.min_off_s


def test_a_duty_too_small_for_the_minimum_on_time_skips_pulses_and_keeps_the_mean() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.05]), now_s=0.0)
    found = pulses(engine.advance(40 * T))
    assert all(closed_s - opened_s >= PWM.min_on_s - 1e-9 for opened_s, closed_s in found)
    assert sum(b - a for a, b in found) == pytest.approx(0.05 * 40 * T, abs=PWM.min_on_s)


def test_the_end_of_the_lease_closes_everything() -> None:
    engine = PulseEngine(PWM, 3, start_s=0.0)
    engine.submit(plan([0.5, 1.0, 0.0], change(2.0, 0.7), lease_until_s=0.3), now_s=0.0)
    edges = engine.advance(5.0)
    assert max(edge.at_s for edge in edges) == 0.3
    assert [edge for edge in edges if edge.at_s == 0.3] == [
        Edge(0.3, 0, False, 0.0),
        Edge(0.3, 1, False, 0.0),
    ]
    assert engine.duty == (0.0, 0.0, 0.0)


def test_a_plan_whose_lease_is_over_closes_and_opens_nothing() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([1.0]), now_s=0.0)
    engine.advance(5.0)
    engine.submit(plan([1.0], sequence=1, issued_s=4.0, lease_until_s=4.3), now_s=5.0)
    assert engine.advance(9.0) == [Edge(5.0, 0, False, 0.0)]


def test_a_plan_that_comes_after_its_lease_gives_a_closed_valve_no_edge() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([1.0], issued_s=4.0, lease_until_s=4.3), now_s=5.0)
    assert engine.advance(9.0) == []


def test_a_newer_plan_replaces_what_has_not_happened() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.0], change(1.0, 1.0)), now_s=0.0)
    engine.submit(plan([0.0], change(2.0, 1.0), sequence=1, issued_s=0.5), now_s=0.5)
    assert engine.advance(3.0) == [Edge(2.0, 0, True, 1.0)]


def test_what_happened_before_a_newer_plan_came_stays_happened() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.0], change(1.0, 1.0)), now_s=0.0)
    engine.submit(plan([1.0], sequence=1, issued_s=1.5), now_s=1.5)
    assert engine.advance(3.0) == [Edge(1.0, 0, True, 1.0)]


@pytest.mark.parametrize(("before", "after"), [(0.0, 1.0), (1.0, 0.0), (0.3, 0.8), (0.8, 0.3)])
def test_a_plan_that_took_its_time_undoes_no_change(before: float, after: float) -> None:
    """Issued just before a change, it arrives just after it: the change has happened."""

    def edges(late: bool) -> list[Edge]:
        engine = PulseEngine(PWM, 1, start_s=0.0)
        coming = change(1.0, after)
        engine.submit(plan([before], coming, sequence=1, issued_s=0.5), now_s=0.501)
        if late:
            again = plan([before], coming, sequence=2, issued_s=0.9995)
            engine.submit(again, now_s=1.0003)
        return engine.advance(2.0)

    assert edges(late=True) == edges(late=False)


def test_a_change_that_was_due_on_the_way_is_ordered_at_once() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.0], sequence=1, issued_s=0.5), now_s=0.501)
    engine.submit(plan([0.0], change(1.0, 1.0), sequence=2, issued_s=0.9995), now_s=1.0003)
    assert pulses(engine.advance(2.0), until_s=2.0) == [(1.0003, 2.0)]


def test_an_older_plan_is_refused() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    assert engine.submit(plan([0.0], sequence=5), now_s=0.0)
    assert not engine.submit(plan([1.0], sequence=5), now_s=0.1)
    assert not engine.submit(plan([1.0], sequence=4), now_s=0.1)
    assert engine.advance(1.0) == []


def test_the_same_duty_again_changes_no_edge() -> None:
    once, often = (PulseEngine(PWM, 2, start_s=0.0) for _ in range(2))
    once.submit(plan([0.5, 0.7]), now_s=0.0)
    edges: list[Edge] = []
    for i in range(40):
        often.submit(plan([0.5, 0.7], sequence=i, issued_s=0.05 * i), now_s=0.05 * i)
        edges += often.advance(0.05 * (i + 1))
    assert edges == once.advance(2.0)


def test_the_order_in_which_it_is_asked_changes_no_edge() -> None:
    given = plan([0.3, 0.8], change(0.7, 0.6), change(1.1, 0.0, valve=1), lease_until_s=2.0)
    one, many = (PulseEngine(PWM, 2, start_s=0.0) for _ in range(2))
    for engine in (one, many):
        engine.submit(given, now_s=0.0)
    edges: list[Edge] = []
    while many.next_event_s() < 3.0:
        edges += many.advance(many.next_event_s())
    assert sorted(edges) == sorted(one.advance(3.0))
    assert many.next_event_s() == math.inf


def test_edges_come_in_order_of_time() -> None:
    engine = PulseEngine(PWM, 24, start_s=0.0)
    engine.submit(plan([0.6] * 24), now_s=0.0)
    times_s = [edge.at_s for edge in engine.advance(3.0)]
    assert times_s == sorted(times_s)
    assert engine.advance(2.0) == []


def test_after_a_common_restart_the_valves_return_to_their_stagger() -> None:
    engine = PulseEngine(PWM, 6, start_s=0.0)
    engine.submit(plan([0.0] * 6, *(change(1.0, 0.5, valve=v) for v in range(6))), now_s=0.0)
    # Half a period to make good, by at most STRETCH_MAX of a period in each.
    edges = engine.advance(2.0 + 0.5 / STRETCH_MAX * 1.1 * T)
    for valve in range(6):
        found = pulses(edges, valve)
        middles = np.array([0.5 * (a + b) for a, b in found[:-1]])
        off = (middles[-1] / T - 0.5 - stagger(valve, 6) + 0.5) % 1.0 - 0.5
        assert off == pytest.approx(0.0, abs=1e-6)
        assert np.all(np.abs(np.diff(middles) / T - 1.0) < STRETCH_MAX + 1e-6)


def test_no_period_is_stretched_by_more_than_a_tenth() -> None:
    assert 0.0 < STRETCH_MAX <= 0.1


def test_the_valves_of_a_boom_are_staggered_evenly() -> None:
    for count in (1, 2, 5, 6, 24):
        shares = sorted(stagger(valve, count) for valve in range(count))
        assert shares == pytest.approx([i / count for i in range(count)])


def test_small_moves_of_duty_are_trims_and_large_ones_restart() -> None:
    assert not needs_restart(0.5, 0.515)
    assert needs_restart(0.5, 0.53)
    assert needs_restart(0.0, 0.01)
    assert needs_restart(0.01, 0.0)


def test_wrong_arguments_are_refused() -> None:
    engine = PulseEngine(PWM, 2, start_s=0.0)
    with pytest.raises(ValueError, match="plan for 1 valves"):
        engine.submit(plan([0.5]), now_s=0.0)
    with pytest.raises(ValueError, match="not finite"):
        engine.advance(math.nan)
    with pytest.raises(ValueError, match="duty"):
        engine.order(0, math.nan, at_s=0.0, restart=True)
    with pytest.raises(ValueError, match="valves"):
        PulseEngine(PWM, 0, start_s=0.0)
    with pytest.raises(ValueError, match="overrun_s"):
        PulseEngine(PWM, 1, start_s=0.0, overrun_s=math.nan)


@pytest.mark.parametrize(("share", "pulse"), [(0.4, 0.0), (0.6, 1.0), (1.4, 1.4)])
def test_a_pulse_too_short_for_the_valve_is_the_shortest_or_none(
    share: float, pulse: float
) -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([share * PWM.min_on_s / T]), now_s=0.0)
    found = pulses(engine.advance(0.999 * T), until_s=T)
    assert sum(b - a for a, b in found) == pytest.approx(pulse * PWM.min_on_s)


def test_a_gap_too_short_for_the_valve_is_the_shortest() -> None:
    # A period that is shortened up to a restart has a shorter gap than the duty asks for.
    duty, restart_s = 1.0 - 1.1 * PWM.min_off_s / T, 0.62 * T
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([duty], change(restart_s, 0.5)), now_s=0.0)
    found = pulses(engine.advance(restart_s - 1e-6), until_s=restart_s)
    assert restart_s - sum(b - a for a, b in found) == pytest.approx(PWM.min_off_s)


# ------------------------------------------------------------------- the last pulse before closing


@pytest.mark.parametrize("at_s", [1.0, 1.02, 1.05, 1.08])
@pytest.mark.parametrize("duty", [0.3, 0.6, 0.85, 0.95])
def test_the_last_pulse_before_a_planned_closing_ends_with_it(duty: float, at_s: float) -> None:
    # In the middle of its period half a gap of dry ground would lie ahead of every border.
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([duty], change(at_s, 0.0)), now_s=0.0)
    found = pulses(engine.advance(3.0))
    assert found[-1][1] == pytest.approx(at_s, abs=1e-9)
    assert sum(b - a for a, b in found) == pytest.approx(
        duty * at_s, abs=1e-3 + (duty > 0.9) * 0.01
    )


def test_a_planned_change_of_rate_leaves_the_last_pulse_in_the_middle() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.5], change(10.0 * T, 0.7), change(11.0 * T, 0.0)), now_s=0.0)
    found = pulses(engine.advance(3.0))
    assert sum(found[9]) / 2.0 == pytest.approx(9.5 * T)
    assert found[-1][1] == pytest.approx(11.0 * T)


def test_a_closing_that_is_put_off_after_its_last_pulse_began_opens_nothing_more() -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan([0.5], change(10.0 * T, 0.0)), now_s=0.0)
    edges = engine.advance(9.2 * T)
    engine.submit(plan([0.5], change(10.05 * T, 0.0), sequence=1, issued_s=9.2 * T), now_s=9.2 * T)
    found = pulses(edges + engine.advance(3.0))
    assert found[-1] == (pytest.approx(9.5 * T), pytest.approx(10.0 * T))
