"""What unknown errors cost: their signs, their size, and that they are nothing without a value."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from companion.core.types import Input, Telemetry
from companion.errors import ConfigError
from sitl.anyang import anyang_lag, demo_setup
from sitl.campaign.design import read_campaign
from sitl.conditions import BORDER, INSIDE, Disturbance, displaced, on_ground, shortened
from tests.sitl.campaign_files import fly_here
from tools.studies.sensitivity import (
    Cost,
    Figures,
    Result,
    app,
    result_of,
    table_lines,
    write_page,
    write_plot,
)

CAMPAIGN = Path(__file__).parents[2] / "examples" / "campaigns" / "sensitivity.toml"
FLOWN = (
    "undisturbed, positions at 20 Hz",
    "lags 20 ms too short",
    "wind 1 m/s along, 0.80 s of fall",
)
SPEED_M_S = 5.0
UNDISTURBED = Disturbance()
FRAME = demo_setup(SPEED_M_S).frame


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cases of the campaign that is shipped, of one seed, by the averaged twin."""
    folder = tmp_path_factory.mktemp("sensitivity")
    head, *cases = CAMPAIGN.read_text(encoding="utf-8").split("[[case]]\n")
    head = head.replace("seeds = 5", "seeds = 1").replace("pulsed", "averaged")
    chosen = [case for case in cases if case.split('"')[1] in FLOWN]
    (folder / "some.toml").write_text("[[case]]\n".join([head, *chosen]), encoding="utf-8")
    fly_here(folder / "some.toml", folder / "flown")
    return folder / "flown"


@pytest.fixture(scope="module")
def result(flown: Path) -> Result:
    return result_of(flown)


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
    assert row.figures.lag_worst_m > 0.5


def test_page_and_picture_hold_what_was_measured(result: Result, tmp_path: Path) -> None:
    page, plot = tmp_path / "page.md", tmp_path / "plot.png"
    write_plot(result, plot)
    write_page(result, page, plot=plot)
    text = page.read_text(encoding="utf-8")
    assert "python -m tools.studies.sensitivity" in text
    assert "(plot.png)" in text
    assert all(f"| {row.label} |" in text for row in result.rows)
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert len(table_lines(result)) == len(result.rows) + 3
    with pytest.raises(ConfigError, match="cannot be written"):
        write_page(result, tmp_path / "no" / "page.md", plot=None)


def test_behind_is_against_the_course_and_nothing_where_it_is_unknown() -> None:
    behind = Disturbance(behind_m=0.10)
    assert place(behind, told(0.0, 5.0)) == pytest.approx((9.9, 20.0), abs=1e-6)
    assert place(behind, told(-5.0, 0.0)) == pytest.approx((10.0, 20.1), abs=1e-6)
    assert place(behind, told(None, None)) == pytest.approx((10.0, 20.0), abs=1e-6)


def test_a_ground_offset_is_the_same_in_every_direction() -> None:
    ground = Disturbance(along_m=0.10, across_m=0.05)
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
    for name in (*INSIDE, *BORDER):
        wrong = shortened(lag, Disturbance(lag_short_s=0.02, kinds=(name,)))
        assert getattr(lag, name) - getattr(wrong, name) == pytest.approx(0.02)
        assert replace(wrong, **{name: getattr(lag, name)}) == lag


def test_the_campaign_that_is_shipped_has_every_error_alone() -> None:
    campaign = read_campaign(CAMPAIGN)
    assert campaign.cases[0] == (FLOWN[0], {}) and len(campaign.cases) == 16
    assert {"error.behind_m", "error.across_m", "vehicle.position_rate_hz"} < set(campaign.varied)
    assert all(len(case) <= 2 for _, case in campaign.cases)


def test_a_cost_is_taken_seed_by_seed() -> None:
    plain = Figures(
        lag_mean_m=0.0, lag_mean_abs_m=0.1, lag_worst_m=0.2, misapplied_percent=1.0,
        off_target_ml=0.0, apart=0, missed=0,
    )  # fmt: skip
    worse = replace(plain, lag_worst_m=0.5)
    cost = Cost.of([worse, plain], [plain, plain], "lag_worst_m")
    assert (cost.mean, cost.worst) == (pytest.approx(0.15), pytest.approx(0.3))
    assert Figures.all_of([worse, plain]).lag_worst_m == 0.5


def test_a_dataset_that_is_not_complete_is_refused(flown: Path, tmp_path: Path) -> None:
    shutil.copytree(flown, tmp_path / "half")
    manifest = tmp_path / "half" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"flights": 3,', '"flights": 4,'))
    with pytest.raises(ConfigError, match="not all flown yet"):
        result_of(tmp_path / "half")


def test_json_is_one_object(result: Result, flown: Path, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    answer = CliRunner().invoke(app, [str(flown), "--page", str(page), "--json"])
    assert answer.exit_code == 0, answer.output
    found = json.loads(answer.stdout)
    assert [row["label"] for row in found["rows"]] == list(FLOWN[1:])
    assert found["undisturbed"]["missed"] == result.undisturbed.missed
    assert page.is_file()
