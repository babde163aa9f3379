from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from analysis.replay import replay
from companion.cli.app import execute
from companion.core.prescription import Prescription
from companion.errors import ConfigError
from companion.wording import missing
from sitl.anyang import anyang_route, demo_lags, demo_route, demo_setup, demo_trajectory
from sitl.demo import (
    CALIBRATED,
    CELL_M,
    METHODS,
    PERFECT,
    DemoOptions,
    DemoResult,
    check,
    field_axes,
    fly_demo,
    jobs_of,
    scaled,
)
from sitl.demo_cli import FILES, PICTURES, WIDE, _print, _write
from sitl.demo_page import ACCURACY, COLUMNS, SETTLED, page, rows_of, sentence
from sitl.knowledge import perfect_setup
from sitl.profile import load_profile

ONE = ["--speed", "5", "--fidelity", "averaged"]
CONTRACT_KEYS = {
    "speed_m_s",
    "method",
    "lag_distance_m",
    "settled_lag_distance_m",
    "spraying_accuracy_percent",
    "misapplied_percent",
    "limit_ratio",
    "settled_accuracy_percent",
    "border_margin_m",
    "off_target_ml",
    "missed",
    "apart",
    "fidelity",
    "output",
    "seed",
}


# Of four rows of plots the two in the middle; across the field, from its edge.
ROWS_FLOWN_M = (9.0, 15.0)


@dataclass(frozen=True)
class Shown:
    result: DemoResult
    folder: Path
    told: int
    said: str


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """Return what the command made of two passes, there and back, in one process.

    `test_tutorial.py` flies all four of them in a pool of processes.
    """
    out = tmp_path_factory.mktemp("demo") / "made" / "demo"
    told: list[int] = []
    results: list[DemoResult] = []

    def fly_here(options: DemoOptions, *, on_flown: Callable[[], None], **more: Any) -> DemoResult:
        def tell() -> None:
            told.append(len(told))
            on_flown()

        results.append(fly_demo(options, processes=1, on_flown=tell, **more))
        return results[0]

    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        patch.setattr("sitl.demo.fly_demo", fly_here)
        patch.setattr("sitl.anyang.PASS_COUNT", len(ROWS_FLOWN_M))
        demo_trajectory.cache_clear()
        with redirect_stderr(StringIO()) as noise:
            code = execute(["demo", "--out", str(out), *ONE, "--json"])
    demo_trajectory.cache_clear()
    assert (code, noise.getvalue()) == (0, "")
    return Shown(results[0], out, len(told), said.getvalue())


# ------------------------------------------------------------------------------------ what is flown


def test_every_method_is_flown_at_every_speed_and_once_with_perfect_knowledge() -> None:
    jobs = jobs_of(DemoOptions(), None)
    assert [(job.speed_m_s, job.method) for job in jobs] == [
        (speed, method) for speed in (4.0, 5.0, 6.0) for method in (*METHODS, CALIBRATED, PERFECT)
    ]
    assert METHODS == ("none", "look-ahead", "look-ahead-stated", "scheduled")


def test_only_the_scheduled_flight_of_the_map_s_speed_has_a_journal(tmp_path: Path) -> None:
    jobs = jobs_of(DemoOptions(speeds_m_s=(6.0, 4.5)), tmp_path)
    with_journal = [job for job in jobs if job.journal_folder is not None]
    assert [(job.speed_m_s, job.method) for job in with_journal] == [(4.5, "scheduled")]


@pytest.mark.parametrize("speed_m_s", [0.99, 15.01, -5.0, math.nan, math.inf])
def test_speed_that_is_not_flown_is_refused(speed_m_s: float) -> None:
    check(DemoOptions(speeds_m_s=(1.0, 5.0, 15.0)))
    with pytest.raises(ConfigError, match=r"--speed .*: outside \[1, 15\] m/s"):
        check(DemoOptions(speeds_m_s=(5.0, speed_m_s)))


def test_servo_output_without_pulses_is_refused() -> None:
    check(DemoOptions(output="servo"))
    with pytest.raises(ConfigError, match="--output servo: the averaged twin"):
        check(DemoOptions(output="servo", fidelity="averaged"))


def test_scaled_map_has_other_rates_on_the_same_ground() -> None:
    whole = demo_setup(5.0).prescription
    half = scaled(whole, 0.5)
    assert [zone.rate_l_ha for zone in half.zones] == [zone.rate_l_ha / 2 for zone in whole.zones]
    assert [zone.polygon for zone in half.zones] == [zone.polygon for zone in whole.zones]
    assert half.field.equals(whole.field)
    assert half.sha256 == whole.sha256


def test_default_rate_is_scaled_too() -> None:
    zones = demo_setup(5.0).prescription.zones
    assert scaled(Prescription(zones, default_rate_l_ha=20.0), 1.5).default_rate_l_ha == 30.0
    assert scaled(Prescription(zones), 1.5).default_rate_l_ha is None


def test_perfect_knowledge_has_the_path_s_delay_and_no_late_position() -> None:
    profile = load_profile("wang-2024")
    for output in ("gpio", "servo"):
        measured = demo_lags(output)
        told = perfect_setup(demo_setup(5.0), profile, seed=1, output_s=measured.output_s)
        assert told.lag.output_s == measured.output_s
        assert told.lag.position_s == 0.0 < measured.position_s
        assert told.lag.on_s > profile.mean_lag_s  # that of the latest valve


@pytest.mark.parametrize("speed_m_s", [2.5, 5.0, 10.0])
def test_rates_follow_the_speed_so_that_flows_stay(speed_m_s: float) -> None:
    rates = {zone.rate_l_ha for zone in demo_setup(speed_m_s).prescription.zones}
    assert max(rates) * speed_m_s == pytest.approx(27.8 * 5.0)
    assert min(rates) * speed_m_s == pytest.approx(14.5 * 5.0)


def test_route_is_the_example_s_where_its_run_out_is_enough() -> None:
    assert demo_route(6.0) == anyang_route(6.0, demo_setup(6.0).frame)


@pytest.mark.parametrize("speed_m_s", [6.0, 12.0])
def test_speed_is_reached_before_the_field(speed_m_s: float) -> None:
    path, axes = demo_trajectory(speed_m_s, 1), field_axes(demo_setup(speed_m_s))
    x_m, _ = axes.place(path.east_m, path.north_m)
    over = (x_m > 0.0) & (x_m < axes.length_m)
    speeds = np.hypot(path.velocity_east_m_s, path.velocity_north_m_s)[over]
    assert speeds.min() > speed_m_s - 1.0
    assert np.count_nonzero(np.diff(over.astype(int)) == 1) == 4


# ------------------------------------------------------------------------------------ what is found


def test_each_flight_is_told_once(shown: Shown) -> None:
    assert shown.told == len(shown.result.flights) + len(shown.result.perfect) == 6


def test_demo_makes_its_files_and_one_object_on_stdout(shown: Shown) -> None:
    found: dict[str, Any] = json.loads(shown.said)
    assert [flight["method"] for flight in found["flights"]] == [*METHODS, CALIBRATED]
    assert json.loads((shown.folder / "demo.json").read_text()) == found
    assert sorted(path.name for path in shown.folder.iterdir()) == sorted(FILES)
    for name in PICTURES:
        assert (shown.folder / name).read_bytes().startswith(b"\x89PNG")


def test_json_has_the_keys_of_the_contract(shown: Shown) -> None:
    found = shown.result.as_json()
    assert {"flights", "perfect", "wall_s", "simulated_s"} <= found.keys()
    flights = found["flights"]
    assert isinstance(flights, list)
    assert [flight["method"] for flight in flights] == [*METHODS, CALIBRATED]
    for flight in flights:
        assert flight.keys() >= CONTRACT_KEYS
        assert flight["lag_distance_m"].keys() >= {"mean", "mean_abs", "max_abs", "count"}
        assert flight["border_margin_m"].keys() >= {"min", "mean"}
        assert (flight["fidelity"], flight["output"], flight["seed"]) == ("averaged", "gpio", 1)


def test_methods_are_what_they_are_called(shown: Shown) -> None:
    lag = {f.job.method: f.evaluation.lag_distance_m for f in shown.result.flights}
    assert lag["none"].mean is not None and lag["none"].mean > 2.5
    assert lag["look-ahead"].mean is not None and abs(lag["look-ahead"].mean) < 0.6
    assert lag["look-ahead-stated"].mean is not None and lag["look-ahead-stated"].mean < -0.6
    assert lag["scheduled"].mean_abs is not None and lag["scheduled"].mean_abs < 0.06
    wrong = {f.job.method: f.evaluation.misapplied_percent for f in shown.result.flights}
    assert wrong["calibrated"] is not None and wrong["scheduled"] is not None
    assert wrong["calibrated"] < 0.95 * wrong["scheduled"]
    assert {f.evaluation.meta.method for f in shown.result.flights} == {*METHODS, CALIBRATED}


def test_limit_ratio_is_against_perfect_knowledge(shown: Shown) -> None:
    result = shown.result
    (perfect,) = result.perfect
    assert result.limit_ratio(perfect) == 1.0
    for flown in result.flights:
        misapplied = flown.evaluation.misapplied_percent
        best = perfect.evaluation.misapplied_percent
        assert misapplied is not None and best is not None
        assert result.limit_ratio(flown) == misapplied / best > 1.0


def test_journal_of_the_flight_replays_without_a_difference(shown: Shown) -> None:
    again = replay(shown.folder / "flight-0001.gpkg")
    assert again.training == "simulated"
    assert (again.differences, again.lost, again.is_closed) == (0, 0, True)
    scheduled = shown.result.flights[-1]
    assert again.decisions > 20.0 * scheduled.simulated_s


# ------------------------------------------------------------------------------ what is shown of it


def test_field_lies_on_its_side_with_its_corner_at_zero() -> None:
    setup = demo_setup(5.0)
    axes = field_axes(setup)
    corners = shapely.get_coordinates([zone.polygon for zone in setup.prescription.zones])
    x_m, y_m = axes.place(corners[:, 0], corners[:, 1])
    assert (x_m.min(), y_m.min()) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert (axes.length_m, axes.width_m) == pytest.approx((120.0, 24.0), abs=0.1)
    first = anyang_route(5.0, setup.frame)
    start = axes.place(np.array([first.start_east_m]), np.array([first.start_north_m]))
    # The first pass is in the west: on the left, at the top of the picture.
    assert (start[0][0], start[1][0]) == pytest.approx((-15.0, 21.0), abs=0.2)


def test_raster_holds_all_that_was_applied(shown: Shown) -> None:
    for flown in (each for each in shown.result.flights if each.job.method in METHODS):
        assert flown.traces is not None
        drawn_ml = flown.traces.applied_l_ha.sum() * CELL_M**2 / 10.0
        assert drawn_ml == pytest.approx(flown.evaluation.applied_ml, rel=0.01)


def test_raster_of_scheduled_is_the_map(shown: Shown) -> None:
    setup, (nozzles,) = demo_setup(5.0), demo_setup(5.0).nozzle_sets
    law = load_profile("wang-2024").nozzle_sets[-1]
    axes = field_axes(setup)
    traces = next(f.traces for f in shown.result.flights if f.job.method == "scheduled")
    assert traces is not None
    places = [
        (zone, axes.place(np.array([middle.x]), np.array([middle.y])))
        for zone in setup.prescription.zones
        for middle in [zone.polygon.centroid]
    ]
    flown = [each for each in places if np.abs(each[1][1] - ROWS_FLOWN_M).min() < 1.0]
    assert len(flown) == len(places) / 2 == 20
    for zone, (x_m, y_m) in flown:
        rows, columns = traces.applied_l_ha.shape
        column = int((x_m[0] + (columns * CELL_M - axes.length_m) / 2) / CELL_M)
        row = int((y_m[0] + (rows * CELL_M - axes.width_m) / 2) / CELL_M)
        middle = traces.applied_l_ha[row - 20 : row + 20, column - 20 : column + 20]
        # The sprayer's flow runs by a law of its own between the points that the program knows.
        asked_l_min = zone.rate_l_ha * 6.0 * 5.0 * 60.0 / 10_000.0
        given = law.flows_l_min("smooth", np.array([nozzles.curve.duty_for(asked_l_min)]))
        assert middle.mean() == pytest.approx(zone.rate_l_ha * given[0] / asked_l_min, rel=0.04)


def test_flows_are_prescribed_in_the_field_only_and_ordered_ahead_of_it(shown: Shown) -> None:
    traces = next(f.traces for f in shown.result.flights if f.job.method == "scheduled")
    assert traces is not None
    inside = (traces.along_m > 0.0) & (traces.along_m < 120.0)
    assert (traces.prescribed_l_min[inside] > 2.0).all()
    assert (traces.prescribed_l_min[~inside] == 0.0).all()
    ordered_m = traces.along_m[np.flatnonzero(traces.ordered_l_min > 1.0)[0]]
    applied_m = traces.along_m[np.flatnonzero(traces.applied_l_min > 1.0)[0]]
    assert -2.0 < ordered_m < 0.0 < applied_m < 1.0


def test_table_has_p1_s_own_figures_beside_ours(shown: Shown) -> None:
    (group,) = rows_of(shown.result)
    assert [row.cells[1] for row in group] == [*METHODS, CALIBRATED, "P1: none", "P1: look-ahead"]
    assert [row.cells[COLUMNS.index(SETTLED)] for row in group[-2:]] == ["3.87", "0.32"]
    assert group[-1].cells[COLUMNS.index(ACCURACY)] == "94.79"
    assert [row.published for row in group] == [False] * 5 + [True] * 2
    assert all(len(row.cells) == len(COLUMNS) for row in group)


def test_sentence_says_what_was_missed(shown: Shown) -> None:
    # P1's Eq. 2 misses a change where its nozzle sets change; the others miss none.
    by_eq_2 = ("none", "look-ahead", "look-ahead-stated")
    ours = [one for one in shown.result.flights if one.job.method not in by_eq_2]
    assert [one.evaluation.missed for one in ours] == [0] * len(ours)

    def missing(count: int) -> str:
        flights = [
            replace(one, evaluation=replace(one.evaluation, missed=count))
            for one in shown.result.flights[:1]
        ]
        flights += [
            replace(one, evaluation=replace(one.evaluation, missed=0))
            for one in shown.result.flights[1:]
        ]
        return sentence(replace(shown.result, flights=tuple(flights)))

    assert "missed" not in missing(0)
    assert "7 changes missed, and" in missing(7)


def test_page_needs_nothing_from_elsewhere(shown: Shown, tmp_path: Path) -> None:
    from sitl.demo_pictures import draw_pictures

    names = draw_pictures(shown.result, tmp_path)
    assert names == ["map.png", "lags.png", "flow.png"]
    sizes = [(tmp_path / name).stat().st_size for name in names]
    assert all(20_000 < size <= 250_000 for size in sizes), sizes
    text = page(shown.result, [tmp_path / name for name in names])
    assert text.count("data:image/png;base64,") == 3
    # Any four letters may stand in a picture's base64 by chance.
    assert "http" not in re.sub("base64,[A-Za-z0-9+/=]+", "", text)
    assert "{" not in text.partition("</style>")[2]


def test_table_fits_a_terminal_of_eighty_columns(
    shown: Shown, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setenv("COLUMNS", "80")
    _print(shown.result, [Path("demo-out/demo.json")])
    text = capsys.readouterr().out
    assert "…" not in text
    assert WIDE > 80
    assert all(method in text for method in METHODS)
    assert "Files in demo-out" in text


def test_without_matplotlib_there_is_all_but_the_pictures(
    shown: Shown,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert _write(shown.result, shown.result.as_json(), tmp_path) == ["demo.json", "report.html"]
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == [
        f"no pictures: {missing('matplotlib')}",
        f"no report of the flight: {missing('jinja2 or matplotlib')}",
    ]
    assert "scheduled" in (tmp_path / "report.html").read_text()
