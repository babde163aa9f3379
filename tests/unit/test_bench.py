"""The benchmarks measure what they say: every part on a workload of a moment; no times judged."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from tests.bench import __main__ as bench
from tests.bench.accuracy import accuracy
from tests.bench.arrival import arrivals
from tests.bench.fields import example, grid_setup
from tests.bench.figures import Figure, rounded, short, table
from tests.bench.flights import Flown, Task, fly_all, tasks
from tests.bench.loading import loading
from tests.bench.lookup import linear_scan, lookups
from tests.bench.steps import growth, large_field

EVERY_FIGURE = {"what", "value", "unit", "n", "target", "bound", "met", "alternative"}
FLOWN = Flown(
    speed_m_s=5.0,
    method="scheduled",
    output="gpio",
    seed=7,
    mean_m=0.01,
    mean_abs_m=0.03,
    max_abs_m=0.1,
    count=100,
    apart=0,
    missed=0,
    settled_mean_m=0.2,
    settled_mean_abs_m=0.2,
    accuracy_percent=98.9,
    settled_accuracy_percent=99.6,
    perfect_accuracy_percent=99.0,
    misapplied_percent=1.0,
    limit_ratio=1.02,
    off_target_ml=0.0,
    border_margin_m=0.3,
)


def by_key(figures: list[Figure]) -> dict[str, Figure]:
    return {figure.key: figure for figure in figures}


def test_a_figure_says_whether_its_target_is_met() -> None:
    figure = Figure(key="a", what="a", value=2.0, unit="s", n=1, target=2.0)
    assert figure.met is True
    assert replace(figure, value=2.1).met is False
    assert replace(figure, value=2.1, is_at_least=True).met is True
    assert replace(figure, value=None).met is False
    assert replace(figure, target=None).met is None


def test_what_is_not_a_number_is_null_in_the_results() -> None:
    assert rounded({"a": [float("nan"), 1.23456789], "b": float("inf")}) == {
        "a": [None, 1.2346],
        "b": None,
    }
    assert short(float("nan")) == "-"


def test_the_results_are_one_json_object_and_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    figures = [Figure(key="a", what="one thing", value=3.0, unit="s", n=9, target=2.0)]
    bench.print_results(figures, seed=4, is_quick=True, wall_s=1.5)
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert {"seed", "quick", "machine", "wall_s", "missed_targets", "figures"} <= found.keys()
    assert found["missed_targets"] == ["a"]
    assert found["figures"]["a"].keys() >= EVERY_FIGURE
    assert "one thing" in captured.err
    assert "MISSED" in captured.err


def test_steps_are_measured_over_the_field() -> None:
    figure = large_field(seed=1, side=4, length_m=40.0)
    assert figure.n > 50
    assert {"mean", "p50", "p99"} <= figure.details.keys()
    assert figure.alternative["shapely intersections"] is not None


def test_growth_has_a_time_for_every_number_of_zones() -> None:
    figure = growth(seed=1, zones=(9, 16))
    assert figure.details["median_us"].keys() == {"9", "16"}
    assert figure.value is not None


def test_the_linear_scan_finds_the_same_rates_as_we_do() -> None:
    prescription = grid_setup(4, 4, valve_count=2, seed=1).prescription
    for place in ((1.0, 1.0), (30.0, -7.0), (47.0, 11.0), (-5.0, 0.0)):
        assert linear_scan(prescription, *place) == prescription.rate_at(*place)


def test_every_map_has_its_lookups_beside_the_linear_scan() -> None:
    figures = by_key(lookups(seed=1, sides=(3,), ours=60, theirs=10))
    assert figures.keys() == {"lookup_40_polygons", "lookup_9_polygons"}
    assert all("linear scan" in figure.alternative for figure in figures.values())


def test_the_map_that_is_loaded_is_the_map_that_was_written() -> None:
    assert loading(seed=1, side=3, repeats=1).n == 1


@pytest.mark.sitl
def test_arrivals_are_measured_with_and_without_a_journal() -> None:
    figures = by_key(arrivals(seed=1, count=4, side=12))
    assert figures.keys() == {"message_to_orders", "position_to_plan"}
    assert figures["message_to_orders"].n == 4
    for figure in figures.values():
        assert figure.value is not None
        assert figure.value > 0.0
        assert figure.alternative["without a journal"] is not None


def test_a_task_flies_one_path_by_every_way() -> None:
    task = Task(speed_m_s=6.0, seed=3, outputs=("gpio",), with_paper=True)
    flown = fly_all([task], processes=1)
    assert [each.method for each in flown] == [
        "scheduled",
        "none",
        "look-ahead",
        "look-ahead-stated",
    ]
    assert all(each.seed == 3 and each.speed_m_s == 6.0 for each in flown)
    assert flown[0].count > 100
    figures = by_key(accuracy(flown))
    assert figures["lag_gpio_6_m_s"].alternative.keys() == {
        "paper's none",
        "paper's look-ahead",
        "paper's look-ahead-stated",
    }
    assert figures["paper_none"].value is not None
    assert {"limit_ratio_gpio_6_m_s", "missed_gpio_6_m_s"} <= figures.keys()


def test_quick_flies_at_one_speed_only() -> None:
    quick = tasks(range(1, 4), is_quick=True)
    assert {task.speed_m_s for task in quick} == {5.0}
    assert len(quick) == 3
    full = tasks(range(1, 21), is_quick=False)
    assert {task.speed_m_s for task in full} >= {2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0}
    assert {task.seed for task in full} == set(range(1, 21))


def test_the_worst_seed_is_found() -> None:
    worse = replace(FLOWN, seed=8, max_abs_m=0.4, mean_abs_m=0.09, count=50, missed=1)
    figures = by_key(accuracy([FLOWN, worse]))
    assert figures["lag_gpio_5_m_s"].value == pytest.approx(0.05)
    assert figures["worst_lag_gpio_5_m_s"].value == 0.4
    assert figures["worst_lag_gpio_5_m_s"].details["seed"] == 8
    assert figures["missed_gpio_5_m_s"].met is False
    assert figures["below_perfect_gpio_5_m_s"].value == pytest.approx(0.1)


def test_a_speed_beyond_the_paper_s_is_judged_in_time() -> None:
    figure = by_key(accuracy([replace(FLOWN, speed_m_s=10.0)]))["lag_gpio_10_m_s"]
    assert figure.unit == "s"
    assert figure.value == pytest.approx(0.003)


def test_the_example_is_scaled_to_its_speed() -> None:
    rates = [max(zone.rate_l_ha for zone in example(v).prescription.zones) for v in (5.0, 10.0)]
    assert rates[1] == pytest.approx(rates[0] / 2.0)


def test_a_table_has_a_line_a_figure() -> None:
    figures = accuracy([FLOWN])
    assert len(table(figures).splitlines()) == len(figures) + 1
