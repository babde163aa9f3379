from __future__ import annotations

from companion.output.engine.wire import Issued
from tests.bench.gpio_edges import PWM, plan, skipped


def pulses(*planned_s: float, duty: float = 0.5) -> list[Issued]:
    return [Issued(at_s, at_s, 0, True, duty) for at_s in planned_s]


def test_a_missing_pulse_is_counted_and_a_restarted_period_is_not() -> None:
    period_s = PWM.period_s
    assert skipped(pulses(0.0, period_s, 2 * period_s)) == 0
    assert skipped(pulses(0.0, 1.5 * period_s)) == 0
    assert skipped(pulses(0.0, 2 * period_s)) == 1
    closed = Issued(0.1, 0.1, 0, False, 0.0)
    assert skipped([*pulses(0.0), closed, *pulses(9.0)]) == 0


def test_all_duties_of_the_plan_move_once_a_second() -> None:
    first, last, second = plan(0, 100.0), plan(19, 100.95), plan(20, 101.0)
    assert first.duty == last.duty != second.duty
    assert {change.at_s for change in last.changes} == {101.0}
    assert tuple(change.duty for change in last.changes) == second.duty
