"""Changes of which the journal lacks the rows are unknown, and spoil no other change."""

from __future__ import annotations

from dataclasses import replace

import pytest

from analysis.evaluation import evaluate
from analysis.flight_record import FlightRecord
from analysis.holds import Hold, with_unknown
from analysis.lag import Verdict
from tests.analysis.test_border_holds import CHANGE_M, PLOT_M, RUN_UP_M, SPEED_M_S, flown, step_at


def at_s(place_m: float) -> float:
    """Return when the valve is at a place of the row."""
    return (place_m + RUN_UP_M) / SPEED_M_S


def with_gap(from_m: float, until_m: float, *, told: bool = True) -> FlightRecord:
    """Return a flight of which a time is missing: closed there, as nobody knows of any spray."""
    record = flown((), ((from_m, until_m),), ordered=False)
    return replace(record, unknown=(((at_s(from_m), at_s(until_m)),),) if told else ())


def test_a_gap_in_the_journal_makes_no_lag_and_no_missed_change() -> None:
    # From a quarter into the second plot to a quarter into the third.
    gap_m = (CHANGE_M - 0.75 * PLOT_M, CHANGE_M + 0.25 * PLOT_M)
    evaluation = evaluate(with_gap(*gap_m))
    step = step_at(evaluation, CHANGE_M)
    assert (step.verdict, step.lag_distance_m) == (Verdict.UNKNOWN, None)
    assert (evaluation.missed, evaluation.apart) == (0, 1)
    distances = evaluation.lag_distance_m
    assert distances is not None
    assert (distances.count, distances.max_abs) == (2, pytest.approx(0.0, abs=0.005))
    untold = evaluate(with_gap(*gap_m, told=False))
    worst = untold.lag_distance_m
    assert untold.missed > 0 or (worst is not None and worst.max_abs > 0.5)


@pytest.mark.parametrize("late_m", [-0.3, 0.2])
def test_a_change_beside_a_gap_is_placed_by_what_is_known(late_m: float) -> None:
    gap_m = (CHANGE_M + 0.4 * PLOT_M, CHANGE_M + 0.9 * PLOT_M)
    record = flown((), (gap_m,), ordered=False, late_m=late_m)
    record = replace(record, unknown=(((at_s(gap_m[0]), at_s(gap_m[1])),),))
    step = step_at(evaluate(record), CHANGE_M)
    assert step.verdict is Verdict.MEASURED
    assert step.lag_distance_m == pytest.approx(late_m, abs=0.005)


def test_a_change_that_is_missed_stays_so_beside_a_gap() -> None:
    gap_m = (CHANGE_M + 0.6 * PLOT_M, CHANGE_M + 0.9 * PLOT_M)
    record = flown((), (gap_m,), ordered=False, ignore=True)
    record = replace(record, unknown=(((at_s(gap_m[0]), at_s(gap_m[1])),),))
    assert step_at(evaluate(record), CHANGE_M).verdict is Verdict.MISSED


def test_the_settled_distance_leaves_out_what_a_gap_touches() -> None:
    gap_m = (CHANGE_M + 0.25 * PLOT_M, CHANGE_M + 0.75 * PLOT_M)
    whole, broken = evaluate(flown(())), evaluate(with_gap(*gap_m))
    assert (whole.settled_missed, whole.settled_apart) == (0, 0)
    # The changes at both ends of that plot; the third is as it was.
    assert (broken.settled_missed, broken.settled_apart) == (0, 2)
    assert len(broken.settled_steps) == 1
    assert broken.settled_steps[0] in whole.settled_steps


def test_holds_and_unknown_times_are_in_order_and_apart() -> None:
    holds = (Hold(start_s=1.0, end_s=2.0), Hold(start_s=5.0, end_s=6.0))
    found = with_unknown(holds, ((1.5, 3.0), (8.0, 9.0)))
    spans = [(each.start_s, each.end_s) for each in found]
    assert spans == [(1.0, 3.0), (5.0, 6.0), (8.0, 9.0)]
    assert with_unknown(holds, ()) == holds
