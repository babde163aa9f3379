"""What the other tests of the metrics let pass."""

from __future__ import annotations

from analysis.evaluation import Distances


def test_distances_of_both_signs_do_not_cancel_in_their_absolutes() -> None:
    assert Distances.of([-3.0, None, 1.0]) == Distances(
        mean=-1.0, mean_abs=2.0, max_abs=3.0, min=-3.0, max=1.0, count=2
    )


def test_without_any_distance_there_is_no_mean() -> None:
    assert Distances.of([None]) == Distances(
        mean=None, mean_abs=None, max_abs=None, min=None, max=None, count=0
    )
