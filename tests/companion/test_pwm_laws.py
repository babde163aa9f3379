from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.types import PwmLimits, SprayPlan, TimedChange
from companion.output.pwm import Edge, PulseEngine

PWM = PwmLimits(frequency_hz=11.0, duty_min=0.2, duty_max=0.9, min_on_s=0.01, min_off_s=0.01)
T = PWM.period_s


def plan(duty: float, *changes: TimedChange, lease_until_s: float = 100.0) -> SprayPlan:
    return SprayPlan(
        sequence=0, issued_s=0.0, duty=(duty,), changes=changes, lease_until_s=lease_until_s
    )


def duties() -> st.SearchStrategy[float]:
    return st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 0.2, 0.5, 0.89, 0.9, 1.0]))


@st.composite
def changes(draw: st.DrawFn) -> list[TimedChange]:
    times_s = sorted(draw(st.lists(st.floats(0.01, 5.0), max_size=30)))
    return [
        TimedChange(at_s=at_s, valve=0, duty=draw(duties()), restart=draw(st.booleans()))
        for at_s in times_s
    ]


def open_spans(edges: list[Edge], until_s: float) -> np.ndarray:
    spans, opened_s = [], None
    for edge in edges:
        if edge.is_open and opened_s is None:
            opened_s = edge.at_s
        elif not edge.is_open and opened_s is not None:
            spans.append((opened_s, edge.at_s))
            opened_s = None
    if opened_s is not None:
        spans.append((opened_s, until_s))
    return np.array(spans).reshape(-1, 2)


@settings(max_examples=60, deadline=None)
@given(duty=st.floats(0.0, 1.0))
def test_the_mean_duty_is_right_within_half_a_percent_over_twenty_periods(duty: float) -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan(duty), now_s=0.0)
    spans = open_spans(engine.advance(40 * T), 40 * T)
    for first in (0, 5, 20):
        held = np.clip(spans, first * T, (first + 20) * T)
        assert abs(float((held[:, 1] - held[:, 0]).sum()) / (20 * T) - duty) < 0.005


@settings(max_examples=60, deadline=None)
@given(duty=duties(), orders=changes())
def test_minimum_times_hold_but_for_closing_at_once(duty: float, orders: list[TimedChange]) -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan(duty, *orders), now_s=0.0)
    edges = engine.advance(8.0)
    closed_for_good = {edge.at_s for edge in edges if edge.duty == 0.0}
    spans = open_spans(edges, 8.0)
    for opened_s, closed_s in spans.tolist():
        assert (
            closed_s - opened_s >= PWM.min_on_s - 1e-9
            or closed_s in closed_for_good
            or closed_s == 8.0
        )
    for (_, closed_s), (opened_s, _) in zip(spans[:-1].tolist(), spans[1:].tolist(), strict=True):
        assert opened_s - closed_s >= PWM.min_off_s - 1e-9


@settings(max_examples=60, deadline=None)
@given(
    orders=st.lists(st.tuples(st.floats(0.02, 0.4), st.floats(0.2, 0.85)), min_size=1, max_size=40)
)
def test_no_row_of_restarts_loses_or_gains_more_than_a_period(
    orders: list[tuple[float, float]],
) -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    at_s, last, due_s = 0.5, 0.5, 0.25
    planned = []
    for wait_s, duty in orders:
        planned.append(TimedChange(at_s=at_s, valve=0, duty=duty))
        due_s += wait_s * duty
        at_s, last = at_s + wait_s, duty
    engine.submit(plan(0.5, *planned), now_s=0.0)
    # Let the last period be paid for, then compare on its own law.
    end_s = at_s + 30 * T
    spans = open_spans(engine.advance(end_s), end_s)
    due_s += (end_s - at_s) * last
    assert abs(float((spans[:, 1] - spans[:, 0]).sum()) - due_s) < T


@settings(max_examples=40, deadline=None)
@given(duty=duties(), orders=changes(), lease_until_s=st.floats(0.05, 6.0))
def test_nothing_is_open_after_the_lease(
    duty: float, orders: list[TimedChange], lease_until_s: float
) -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan(duty, *orders, lease_until_s=lease_until_s), now_s=0.0)
    spans = open_spans(engine.advance(9.0), 9.0)
    assert not len(spans) or spans[-1, 1] <= lease_until_s


@settings(max_examples=40, deadline=None)
@given(duty=duties(), orders=changes(), cuts=st.lists(st.floats(0.0, 8.0), max_size=20))
def test_edges_do_not_depend_on_when_they_are_asked_for(
    duty: float, orders: list[TimedChange], cuts: list[float]
) -> None:
    whole, pieces = (PulseEngine(PWM, 1, start_s=0.0) for _ in range(2))
    for engine in (whole, pieces):
        engine.submit(plan(duty, *orders), now_s=0.0)
    found: list[Edge] = []
    for until_s in [*sorted(cuts), 8.0]:
        found += pieces.advance(until_s)
    assert found == whole.advance(8.0)


@settings(max_examples=40, deadline=None)
@given(duty=duties(), orders=changes())
def test_every_order_to_closed_is_told_at_its_own_time(
    duty: float, orders: list[TimedChange]
) -> None:
    engine = PulseEngine(PWM, 1, start_s=0.0)
    engine.submit(plan(duty, *orders), now_s=0.0)
    edges = engine.advance(8.0)
    in_force = duty
    for order in orders:
        if order.restart and order.duty == 0.0 and in_force > 0.0:
            assert any(
                e.at_s == order.at_s and not e.is_open and e.duty == 0.0 for e in edges
            ) or any(e.duty == 0.0 and e.at_s <= order.at_s for e in edges)
        in_force = order.duty
