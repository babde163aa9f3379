"""What unknown errors cost: their signs, their size, and that they are nothing without a value."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.core.types import Input, Telemetry
from companion.errors import ConfigError, VrsprayError
from sitl.anyang import anyang_lag
from sitl.demo_field import demo_setup
from sitl.disturbances import (
    DISTURBANCES,
    UNDISTURBED,
    Disturbance,
    chosen,
    displaced,
    on_ground,
    shortened,
)
from sitl.studies.sensitivity import (
    SPEED_M_S,
    Cost,
    Figures,
    Result,
    app,
    measure,
    table_lines,
    write_page,
    write_plot,
)

FRAME = demo_setup(SPEED_M_S).frame


@pytest.fixture(scope="module")
def result() -> Result:
    return measure(chosen(["lag-short-20", "wind-along"]), seeds=[1], fidelity="averaged")


def told(north_m_s: float | None, east_m_s: float | None) -> Telemetry:
    latitude_deg, longitude_deg = FRAME.to_geographic(10.0, 20.0)
    return Telemetry(
        received_s=1.0, boot_s=1.0, latitude_deg=latitude_deg, longitude_deg=longitude_deg,
        relative_altitude_m=3.5, velocity_north_m_s=north_m_s, velocity_east_m_s=east_m_s,
        velocity_down_m_s=0.0, heading_deg=90.0,
    )  # fmt: skip


def place(what: Disturbance, message: Telemetry) -> tuple[float, float]:
    items: list[Input] = list(displaced(iter([message]), what=what, frame=FRAME))
    assert isinstance(items[0], Telemetry)
    return FRAME.to_local(items[0].latitude_deg, items[0].longitude_deg)


def test_a_lag_too_short_is_late_by_speed_times_time(result: Result) -> None:
    row = result.rows[0]
    shift_m = row.figures.lag_mean_m - result.undisturbed.lag_mean_m
    assert shift_m == pytest.approx(0.020 * SPEED_M_S, abs=0.01)
    assert row.lag_mean_abs_cost_m.mean > 0.03
    assert row.misapplied_cost_points.mean > 0.1


def test_wind_is_late_one_way_and_early_the_other(result: Result) -> None:
    row = result.rows[1]
    assert row.figures.lag_mean_m == pytest.approx(result.undisturbed.lag_mean_m, abs=0.01)
    assert row.figures.lag_mean_abs_m == pytest.approx(0.80, abs=0.02)
    assert row.figures.off_target_ml > result.undisturbed.off_target_ml
    assert result.flights == 2  # wind is not flown


def test_page_and_picture_hold_what_was_measured(result: Result, tmp_path: Path) -> None:
    page, plot = tmp_path / "page.md", tmp_path / "plot.png"
    write_plot(result, plot)
    write_page(result, page, plot=plot)
    text = page.read_text(encoding="utf-8")
    assert "python -m sitl.studies.sensitivity" in text
    assert "(plot.png)" in text
    assert all(f"| {row.label} |" in text for row in result.rows)
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert len(table_lines(result)) == len(result.rows) + 3
    with pytest.raises(ConfigError, match="cannot be written"):
        write_page(result, tmp_path / "no" / "page.md", plot=None)


def test_behind_is_against_the_course_and_nothing_where_it_is_unknown() -> None:
    behind = Disturbance(key="x", label="x", behind_m=0.10)
    assert place(behind, told(0.0, 5.0)) == pytest.approx((9.9, 20.0), abs=1e-6)
    assert place(behind, told(-5.0, 0.0)) == pytest.approx((10.0, 20.1), abs=1e-6)
    assert place(behind, told(None, None)) == pytest.approx((10.0, 20.0), abs=1e-6)


def test_a_ground_offset_is_the_same_in_every_direction() -> None:
    ground = Disturbance(key="x", label="x", along_m=0.10, across_m=0.05)
    east_m, north_m = on_ground(FRAME, 0.10, 0.05)
    assert east_m**2 + north_m**2 == pytest.approx(0.10**2 + 0.05**2)
    assert north_m > 0.0  # the first pass leads north
    for message in (told(5.0, 0.0), told(-5.0, 0.0), told(None, None)):
        assert place(ground, message) == pytest.approx((10.0 + east_m, 20.0 + north_m), abs=1e-6)


def test_the_undisturbed_flight_is_not_touched() -> None:
    message = told(5.0, 0.0)
    assert list(displaced(iter([message]), what=UNDISTURBED, frame=FRAME)) == [message]
    assert shortened(anyang_lag("gpio"), UNDISTURBED) == anyang_lag("gpio")


def test_every_error_of_lag_can_be_configured() -> None:
    lag = anyang_lag("gpio")
    for each in DISTURBANCES:
        wrong = shortened(lag, each)
        for name in each.kinds:
            assert getattr(lag, name) - getattr(wrong, name) == pytest.approx(each.lag_short_s)
    up = shortened(lag, next(each for each in DISTURBANCES if each.key == "up-short-20"))
    assert replace(up, up_s=lag.up_s) == lag


def test_a_cost_is_taken_seed_by_seed() -> None:
    plain = Figures(
        lag_mean_m=0.0, lag_mean_abs_m=0.1, lag_worst_m=0.2, misapplied_percent=1.0,
        off_target_ml=0.0, apart=0, missed=0,
    )  # fmt: skip
    worse = replace(plain, lag_worst_m=0.5)
    cost = Cost.of([worse, plain], [plain, plain], "lag_worst_m")
    assert (cost.mean, cost.worst) == (pytest.approx(0.15), pytest.approx(0.3))
    assert Figures.all_of([worse, plain]).lag_worst_m == 0.5


def test_an_unknown_key_is_refused() -> None:
    assert chosen([]) == DISTURBANCES
    with pytest.raises(VrsprayError, match="--only nonsense"):
        chosen(["nonsense"])


def test_json_is_one_object(
    result: Result, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[tuple[str, list[int], str]] = []

    def measured(what: tuple[Disturbance, ...], *, seeds: range, fidelity: str) -> Result:
        asked.extend((each.key, list(seeds), fidelity) for each in what)
        return result

    monkeypatch.setattr("sitl.studies.sensitivity.measure", measured)
    page = tmp_path / "page.md"
    given = ["--seeds", "2", "--only", "wind-across", "--page", str(page), "--json"]
    answer = CliRunner().invoke(app, given)
    assert answer.exit_code == 0, answer.output
    assert asked == [("wind-across", [1, 2], "pulsed")]
    found = json.loads(answer.stdout)
    assert [row["key"] for row in found["rows"]] == ["lag-short-20", "wind-along"]
    assert page.is_file()
