"""The benchmarks measure what they say: every part on a workload of a moment; no times judged."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.evaluation import evaluate
from companion.core.nozzle import flow_for_rate
from sitl.anyang import demo_trajectory
from sitl.campaign.design import read_campaign
from sitl.conditions import CONDITIONS, condition_of, laid_out
from sitl.flight import fly
from sitl.profile import load_profile
from tests.bench import __main__ as bench
from tests.bench import parts
from tests.bench.accuracy import accuracy
from tests.bench.arrival import arrivals
from tests.bench.fields import example, grid_setup
from tests.bench.figures import Figure, rounded, short, table
from tests.bench.flights import (
    ACCURACY,
    CONDITION,
    HARD_CONDITIONS,
    SPEED,
    Flights,
    Flown,
    Task,
    condition_flights,
    condition_names,
    field_flights,
    fly_all,
    kept,
    perfect,
    pinpoint_flights,
    place,
)
from tests.bench.identification_figures import Compared
from tests.bench.identification_figures import figures as identification_figures
from tests.bench.identified import unknown_tasks
from tests.bench.loading import loading, ragged
from tests.bench.lookup import linear_scan, lookups
from tests.bench.parts import Options, Part, chosen
from tests.bench.report import page
from tests.bench.sprayers import PLANT, PLANTS, nominal_lag, options_of, scaled_lag, sprayer_setup
from tests.bench.steps import growth, large_field
from tests.bench.timings import TIMINGS

# The controller of Wang et al. 2024, written as anybody would write his own.
OWN_METHOD = Path(__file__).parents[2] / "examples/own-method/wang2024.py"
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


def ran(**change: object) -> bench.Run:
    """Return a run of one figure that misses its target."""
    figure = Figure(key="a", what="one thing", value=3.0, unit="s", n=9, target=2.0, section="One")
    return bench.Run(figures=[replace(figure, **change)], took_s={"steps": 1.5}, load=0.1)


def test_the_results_are_one_json_object_and_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    run = ran()
    found = bench.results(run, Options(seed=4, is_quick=True), command="python -m tests.bench 4")
    bench.print_results(run.figures, found)
    captured = capsys.readouterr()
    told = json.loads(captured.out)
    assert {"seed", "quick", "machine", "date", "command", "wall_s", "parts_s"} <= told.keys()
    assert told["missed_targets"] == ["a"]
    assert told["figures"]["a"].keys() >= EVERY_FIGURE
    assert "one thing" in captured.err
    assert "MISSED" in captured.err


def test_a_figure_comes_back_from_its_json() -> None:
    figures = accuracy([FLOWN], section="Flights")
    for figure in figures:
        there = json.loads(json.dumps(figure.as_json()))
        back = Figure.from_json(figure.key, there)
        assert back.as_json() == figure.as_json()
        assert (back.section, back.row, back.is_at_least) == (
            figure.section,
            figure.row,
            figure.is_at_least,
        )


def saved(run: bench.Run, **change: object) -> dict[str, object]:
    return bench.results(run, Options(), command="python -m tests.bench") | change


def test_of_two_runs_the_later_one_is_on_the_page() -> None:
    first = saved(ran(row="one row"), date="2001-01-01")
    later = saved(ran(row="one row", value=1.0), date="2002-02-02")
    text = page([first, later])
    assert "2002-02-02" in text
    assert "2001-01-01" not in text  # nothing of it is left
    assert "| one row | 1 s | <= 2 | met | 1 | 9 |" in text
    assert "| one row | 3 s | <= 2 | **missed** by 1 | 1 | 9 |" in page([later, first])


def test_a_row_is_met_by_all_its_figures_or_not_at_all() -> None:
    run = ran(row="one row")
    run.figures.append(replace(run.figures[0], key="b", value=1.0))
    assert "| one row | 1 to 3 s | <= 2 | **missed** by 1 | 2 | 18 |" in page([saved(run)])


def test_the_page_has_a_line_for_every_kind_of_flight() -> None:
    worse = replace(FLOWN, output="servo", missed=2, max_abs_m=0.3)
    run = bench.Run(figures=accuracy([FLOWN, worse], section="Flights"), load=0.0)
    lines = page([saved(run)]).splitlines()
    assert [line for line in lines if line.startswith("## ")] == ["## Summary", "## Flights"]
    gpio, servo = (
        next(line for line in lines if line.startswith(f"| {output}, 5 m/s"))
        for output in ("gpio", "servo")
    )
    assert "**" not in gpio
    assert servo.count("**") == 4  # the worst change and those missed


def test_a_page_is_made_of_saved_results_without_measuring(tmp_path: Path) -> None:
    results, out = tmp_path / "results.json", tmp_path / "page.md"
    results.write_text(json.dumps(saved(ran(row="one row"))), "utf-8")
    assert bench.main(["--from", str(results), "--page", str(out)]) == 0
    assert "**missed** by 1" in out.read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--only", "nothing"], "choose of"),
        (["--from", "nowhere.json"], "cannot be read"),
        (["--controller", "nowhere:Nothing"], "nowhere"),
    ],
)
def test_what_cannot_be_measured_is_said_in_one_line(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        bench.main(words)
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_times_are_measured_before_anything_else() -> None:
    order: list[str] = []

    def part(name: str, section: str) -> Part:
        def run(options: Options) -> list[Figure]:
            order.append(name)
            return []

        return Part(name=name, section=section, run=run)

    run = bench.measure([part("flights", "Flights"), part("steps", TIMINGS)], Options())
    assert order == ["steps", "flights"]
    assert run.took_s.keys() == {"steps", "flights"}


def test_patterns_choose_parts() -> None:
    names = [part.name for part in chosen(["arc-*", "pump"], Options())]
    assert names == ["pump", "arc-40", "arc-100"]
    everything = {part.name for part in chosen([], Options())}
    assert "identification" not in everything
    assert {part.name for part in chosen([], Options(flights=9))} - everything == {"identification"}


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
    for where in ((1.0, 1.0), (30.0, -7.0), (47.0, 11.0), (-5.0, 0.0)):
        assert linear_scan(prescription, *where) == prescription.rate_at(*where)


def test_every_map_has_its_lookups_beside_the_linear_scan() -> None:
    figures = by_key(lookups(seed=1, sides=(3,), ours=60, theirs=10))
    assert figures.keys() == {"lookup_40_polygons", "lookup_9_polygons"}
    assert all("linear scan" in figure.alternative for figure in figures.values())


def test_the_map_that_is_loaded_is_the_map_that_was_written() -> None:
    assert loading(seed=1, side=3, repeats=1).n == 1
    figures = by_key(ragged(seed=1, side=3, repeats=1))
    assert figures.keys() == {
        f"check_ragged{each}" for each in ("", "_memory", "_apart", "_apart_memory")
    }


@pytest.mark.sitl
def test_arrivals_are_measured_with_and_without_a_journal() -> None:
    figures = by_key(arrivals(seed=1, count=4, side=12))
    assert figures.keys() == {"message_to_orders", "position_to_plan"}
    assert figures["message_to_orders"].n == 4
    for figure in figures.values():
        assert figure.value is not None
        assert figure.value > 0.0
        assert figure.alternative["without a journal"] is not None


def test_one_path_is_flown_by_every_method_and_held_against_perfect_knowledge() -> None:
    flights = Flights(
        file=ACCURACY, cases=("gpio", "perfect", "none"), seeds=(3,), values={SPEED: (5.0,)}
    )
    flown = fly_all([flights], processes=1)
    assert [(each.method, each.output) for each in flown] == [
        ("scheduled", "gpio"),
        ("none", "gpio"),
    ]
    assert all(each.seed == 3 and each.speed_m_s == 5.0 for each in flown)
    assert flown[0].count > 50
    assert flown[0].perfect_mean_abs_m == flown[1].perfect_mean_abs_m is not None
    figures = by_key(accuracy(flown, section="a"))
    lag = figures["lag_gpio_5_m_s"]
    assert lag.alternative.keys() == {"paper's none", "perfect knowledge"}
    assert lag.value is not None
    assert lag.value < (lag.alternative["paper's none"] or 0.0)
    assert figures["paper_none"].value is not None
    assert {"limit_ratio_gpio_5_m_s", "missed_gpio_5_m_s"} <= figures.keys()


def test_the_flown_vehicle_is_held_against_perfect_knowledge_on_its_own_path() -> None:
    cases = ("gpio", "perfect", "flown, gpio", "flown, perfect")
    flights = Flights(file=ACCURACY, cases=cases, seeds=(3,), values={SPEED: (5.0,)})
    drawn, on_flown = fly_all([flights], processes=1)
    assert drawn.perfect_mean_abs_m != on_flown.perfect_mean_abs_m
    figures = by_key(accuracy([drawn, on_flown], section="a"))
    lag = figures["lag_wang-2024-on-flown-vehicle_gpio_5_m_s"]
    assert lag.value == on_flown.mean_abs_m != figures["lag_gpio_5_m_s"].value
    assert lag.row.endswith(", flown vehicle")


def test_a_flight_of_the_bench_is_the_flight_that_its_setup_flies() -> None:
    flights = Flights(
        file=HARD_CONDITIONS,
        cases=("pinpoint, servo", "pinpoint, perfect"),
        seeds=(3,),
        values={CONDITION: ("arc-40",)},
    )
    (flown,) = fly_all([flights], processes=1)
    task = Task(plant="pinpoint", condition="arc-40", seed=3)
    setup, path = place(task, "servo")
    again = fly(
        setup, path, load_profile("pinpoint"), options_of("servo", 3), speed_m_s=task.speed_m_s
    )
    kept_so = kept(evaluate(again.record), task=task, output="servo", perfect=perfect(task))
    assert flown == kept_so


def test_a_method_of_ones_own_is_flown_beside_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    flights = Flights(
        file=HARD_CONDITIONS, cases=("gpio", "perfect"), seeds=(3,), values={CONDITION: ("arc-40",)}
    )
    monkeypatch.setattr(parts, "condition_flights", lambda _name, _seeds: [flights])
    options = parts.Options(count=1, processes=1, controller=f"{OWN_METHOD}:Wang2024")
    (part,) = (part for part in parts.PARTS if part.name == "arc-40")
    figures = by_key(part.run(options))
    ours, own = (figures[f"{name}lag_arc-40_gpio_5_m_s"] for name in ("", "own_"))
    # The example is the paper's controller with its look-ahead, on our nozzle set.
    assert own.value is not None
    assert ours.value is not None
    assert own.value > 2.0 * ours.value
    assert own.target is None
    assert own.section == parts.OWN_SECTION != ours.section


def test_over_the_example_its_own_path_is_flown() -> None:
    setup, path = place(Task(speed_m_s=6.0, seed=3), "servo")
    assert path is demo_trajectory(6.0, 3)
    assert setup.lag == nominal_lag(PLANT, "servo")


def test_every_sprayer_is_known_by_its_own_curve_and_lags() -> None:
    lags = {(p, o): nominal_lag(p, o) for p in PLANTS for o in ("gpio", "servo", "free-running")}
    assert lags["pinpoint", "gpio"].up_s < 0.5 * lags[PLANT, "gpio"].up_s
    assert lags["pinpoint", "free-running"] == lags["pinpoint", "servo"]
    assert sprayer_setup("pinpoint", "gpio").pwm.frequency_hz == 10.0
    wrong = scaled_lag(lags[PLANT, "servo"], 1.5)
    assert wrong.up_s == pytest.approx(1.5 * lags[PLANT, "servo"].up_s)
    assert (wrong.output_s, wrong.position_s) == (0.012, lags[PLANT, "servo"].position_s)


def test_a_sprayer_that_is_not_known_is_wrong_both_ways() -> None:
    todo = unknown_tasks(range(1, 9))
    assert {(task.lags, task.gain) for task in todo} == set(
        itertools.product((1.5, 0.5), (1.08, 0.92))
    )


def test_quick_flies_at_one_speed_only() -> None:
    quick = field_flights(range(1, 4), is_quick=True)
    assert {speed for each in quick for speed in each.values[SPEED]} == {5.0}
    assert [each.count for each in quick] == [9, 3, 9, 9]
    full = field_flights(range(1, 21), is_quick=False)
    speeds = {speed for each in full for speed in each.values[SPEED]}
    assert speeds == {2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0}
    assert all(each.seeds == tuple(range(1, 21)) for each in full)


def test_the_worst_seed_is_found() -> None:
    worse = replace(FLOWN, seed=8, max_abs_m=0.4, mean_abs_m=0.09, count=50, missed=1)
    figures = by_key(accuracy([FLOWN, worse], section="a"))
    assert figures["lag_gpio_5_m_s"].value == pytest.approx(0.05)
    assert figures["worst_lag_gpio_5_m_s"].value == 0.4
    assert figures["worst_lag_gpio_5_m_s"].details["seed"] == 8
    assert figures["missed_gpio_5_m_s"].met is False
    assert figures["below_perfect_gpio_5_m_s"].value == pytest.approx(0.1)


def test_a_speed_beyond_the_paper_s_is_judged_in_time() -> None:
    figure = by_key(accuracy([replace(FLOWN, speed_m_s=10.0)], section="a"))["lag_gpio_10_m_s"]
    assert figure.unit == "s"
    assert figure.value == pytest.approx(0.003)


def test_the_example_is_scaled_to_its_speed() -> None:
    rates = [max(zone.rate_l_ha for zone in example(v).prescription.zones) for v in (5.0, 10.0)]
    assert rates[1] == pytest.approx(rates[0] / 2.0)


def test_a_table_has_a_line_a_figure() -> None:
    figures = accuracy([FLOWN], section="a")
    assert len(table(figures).splitlines()) == len(figures) + 1


@pytest.mark.parametrize(
    ("plant", "name"),
    [(PLANT, "edges-75"), (PLANT, "arc-40"), *itertools.product(PLANTS, ("braking", "gusts"))],
)
def test_a_condition_asks_only_for_what_the_sprayer_can_give(plant: str, name: str) -> None:
    setup, path = laid_out(condition_of(name), 3, sprayer_setup(plant, "gpio"))
    curve, pwm = setup.nozzle_sets[-1].curve, setup.pwm
    over = zip(
        path.east_m[::10].tolist(),
        path.north_m[::10].tolist(),
        np.hypot(path.velocity_east_m_s, path.velocity_north_m_s)[::10].tolist(),
        strict=True,
    )
    asked = [
        flow_for_rate(rate, speed, setup.boom.width_m)
        for east, north, speed in over
        if (rate := setup.prescription.rate_at(east, north)) is not None
    ]
    assert len(asked) > 200
    assert min(asked) > curve.flow_for(pwm.duty_min)
    assert max(asked) < curve.flow_for(pwm.duty_max)


def test_neighbouring_rates_of_a_condition_can_be_told_apart() -> None:
    for name in ("edges-75", "braking", "gusts"):
        setup, _ = laid_out(condition_of(name), 2, sprayer_setup("wang-2024", "gpio"))
        rates = [zone.rate_l_ha for zone in setup.prescription.zones]
        assert all(abs(b - a) >= 0.09 * min(a, b) for a, b in itertools.pairwise(rates)), name


def test_edges_are_askew_by_their_angle_and_lean_either_way() -> None:
    angles = []
    for seed in (1, 2):
        setup, path = laid_out(condition_of("edges-30"), seed, sprayer_setup("wang-2024", "gpio"))
        first = setup.prescription.zones[0].polygon
        course = math.radians(float(path.heading_deg[0]))
        edge = max(
            (np.subtract(b, a) for a, b in itertools.pairwise(first.exterior.coords)),
            key=lambda side: (
                abs(math.sin(math.atan2(side[0], side[1]) - course) * math.hypot(*side))
                - 100.0 * (abs(math.hypot(*side) - 1.0 / math.cos(math.radians(30.0))) > 0.01)
            ),
        )
        turned = math.degrees(math.atan2(edge[0], edge[1]) - course) % 180.0 - 90.0
        angles.append(turned)
    assert angles == pytest.approx([30.0, -30.0], abs=0.01)


def test_an_arc_is_one_and_the_nose_follows_it() -> None:
    _, path = laid_out(condition_of("arc-40"), 1, sprayer_setup("wang-2024", "gpio"))
    flying = np.hypot(path.velocity_east_m_s, path.velocity_north_m_s) > 4.0
    east, north = path.east_m[flying], path.north_m[flying]
    course = math.radians(12.0)
    centre = (40.0 * math.cos(course), -40.0 * math.sin(course))
    away = np.hypot(east - centre[0], north - centre[1])
    assert np.abs(away - 40.0).max() < 0.2
    step_s = path.time_s[1] - path.time_s[0]
    moved = np.diff(path.east_m) / step_s, np.diff(path.north_m) / step_s
    assert np.abs(moved[0] - path.velocity_east_m_s[1:]).max() < 0.1
    assert np.abs(moved[1] - path.velocity_north_m_s[1:]).max() < 0.1
    aside = np.degrees(np.arctan2(*moved)) - path.heading_deg[1:]
    aside = (aside[flying[1:]] + 180.0) % 360.0 - 180.0
    assert abs(float(aside.mean())) < 0.2


def test_the_speed_sways_and_brakes_as_it_is_said() -> None:
    setup = sprayer_setup("wang-2024", "gpio")
    speeds = {}
    for name in ("sway", "gusts", "braking"):
        held, path = laid_out(condition_of(name), 4, setup)
        inside = [
            held.prescription.rate_at(east, north) is not None
            for east, north in zip(
                path.east_m[::5].tolist(), path.north_m[::5].tolist(), strict=True
            )
        ]
        speeds[name] = np.hypot(path.velocity_east_m_s, path.velocity_north_m_s)[::5][inside]
    assert 3.5 < speeds["sway"].min() < 4.2
    assert 5.8 < speeds["sway"].max() < 6.5
    assert 0.4 < speeds["gusts"].std() < 1.1
    assert speeds["braking"].min() < 2.1
    assert speeds["braking"].max() > 5.8


def test_every_plant_is_flown_in_every_condition() -> None:
    todo = condition_flights("braking", range(1, 21))
    assert [each.count for each in todo] == [3 * 20, 3 * 10]
    assert {name for each in todo for name, _ in each.campaign().cases} == {
        *("gpio", "servo", "perfect"),
        *("pinpoint, gpio", "pinpoint, servo", "pinpoint, perfect"),
    }
    pinpoint = pinpoint_flights([1], is_quick=False)
    assert {speed for each in pinpoint for speed in each.values[SPEED]} >= {3.0, 5.0, 6.0}


def test_every_hard_condition_is_in_the_campaign() -> None:
    (field,) = read_campaign(HARD_CONDITIONS).factors
    assert field.name == CONDITION
    assert list(field.values) == condition_names() == [each.name for each in CONDITIONS]


def test_identified_lags_are_judged_by_error_and_by_interval() -> None:
    one = Compared(seed=1, name="up", count=9, value_s=0.104, low_s=0.1, high_s=0.11, truth_s=0.1)
    rows = [replace(one, name=name) for name in ("on", "off", "up")]
    rows.append(replace(one, name="down", truth_s=0.098))
    figures = by_key(identification_figures(rows, 1, where="gpio", section="a"))
    assert figures["identified_within_gpio"].value == pytest.approx(75.0)
    assert figures["identified_covered_gpio"].value == pytest.approx(75.0)
    assert figures["identified_covered_gpio"].met is False
