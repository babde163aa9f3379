"""Which journals are one job: by the plan's id alone; the rest is named, or refused in a line."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from analysis.journals.jobs import PAUSE_MAX_S, joined, one_job, sortie_of
from analysis.report.build import Report, ReportOptions
from analysis.report.job import build_job
from companion.errors import ConfigError, JournalError
from tests.analysis.report_flight import EU_TOLD, fly

DAY_S = 86_400.0
START_S = 1_790_000_000.0
PLAIN = ReportOptions(with_figures=False)
AIRCRAFT = "application.aircraft"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("flown"), told=EU_TOLD)


@pytest.fixture
def folder(tmp_path: Path, flown: Path) -> Path:
    """Three sorties of one job in two days, one of before the ids, and the treatment of later."""
    sortie(flown, tmp_path, 1, START_S, job="0123456789ab", **{AIRCRAFT: "D1"})
    sortie(flown, tmp_path, 2, START_S + 0.01 * DAY_S, job="0123456789ab", **{AIRCRAFT: "D2"})
    sortie(flown, tmp_path, 3, START_S + 1.0 * DAY_S, job="0123456789ab", **{AIRCRAFT: "D1"})
    sortie(flown, tmp_path, 4, START_S + 1.1 * DAY_S, job=None)
    sortie(flown, tmp_path, 5, START_S + 15.0 * DAY_S, job="0123456789ab")
    sortie(flown, tmp_path, 6, START_S + 0.02 * DAY_S, job="ba9876543210")
    return tmp_path


def sortie(
    flown: Path, folder: Path, number: int, at_s: float, *, job: str | None = None, **told: object
) -> Path:
    path = folder / f"flight-{number:04d}.gpkg"
    shutil.copy(flown, path)
    meta = {"map_sha256": "ab" * 32, "utc_offset_s": repr(at_s - 100.0)}
    if job is not None:
        meta["flight_map_json"] = json.dumps({"frozen": {"mission.job": job}})
    meta["application_json"] = json.dumps(EU_TOLD | told)
    return changed(path, **meta)


def changed(path: Path, **meta: str) -> Path:
    with closing(sqlite3.connect(path)) as connection, connection:
        for key, value in meta.items():
            connection.execute("DELETE FROM meta WHERE key = ?", (key,))
            connection.execute("INSERT INTO meta (key, value) VALUES (?, ?)", (key, value))
    return path


def names(sorties: Any) -> list[int]:
    return [int(each.path.stem[-1]) for each in sorties]


def reported(folder: Path, *numbers: int) -> Report:
    return build_job([folder / f"flight-{number:04d}.gpkg" for number in numbers], PLAIN)


def test_the_id_of_a_plan_joins_and_nothing_else_does(folder: Path) -> None:
    found, perhaps = joined([sortie_of(folder / "flight-0002.gpkg")])
    # Neither the other plan's flight, nor the same plan flown again after two weeks.
    assert names(found) == [1, 2, 3]
    assert names(perhaps) == [4]


def test_without_an_id_flights_of_two_days_are_named(folder: Path) -> None:
    found, perhaps = joined([sortie_of(folder / "flight-0004.gpkg")])
    assert names(found) == [4]
    assert sorted(names(perhaps)) == [1, 2, 3, 6]


def test_flights_of_other_ground_or_with_water_are_not_even_named(folder: Path) -> None:
    changed(folder / "flight-0004.gpkg", training="water")
    changed(folder / "flight-0003.gpkg", map_sha256="cd" * 32)
    found, perhaps = joined([sortie_of(folder / "flight-0001.gpkg")])
    assert names(found) == [1, 2]
    assert names(perhaps) == []


@pytest.mark.parametrize(
    ("meta", "said"),
    [
        ({"map_sha256": "cd" * 32}, "another map"),
        ({"training": "water"}, "another training"),
        ({"simulated": "yes"}, "another simulation"),
        ({"origin_latitude_deg": "10.0"}, "another place"),
        ({"flight_map_json": json.dumps({"frozen": {"mission.job": "ff" * 6}})}, "of job"),
    ],
)
def test_what_is_no_job_is_refused_in_a_line(folder: Path, meta: dict[str, str], said: str) -> None:
    other = changed(folder / "flight-0002.gpkg", **meta)
    with pytest.raises(ConfigError, match=said) as caught:
        one_job([folder / "flight-0001.gpkg", other])
    assert "\n" not in str(caught.value)
    assert str(other) in str(caught.value)


def test_a_journal_is_taken_once_under_whatever_name(folder: Path) -> None:
    again = folder / "copy.gpkg"
    shutil.copy(folder / "flight-0001.gpkg", again)
    with pytest.raises(ConfigError, match="the same flight as"):
        one_job([folder / "flight-0001.gpkg", again])
    with pytest.raises(ConfigError, match="the same flight as"):
        one_job([folder / "flight-0001.gpkg"] * 2)


def test_a_journal_that_is_still_written_is_refused(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "flight-0002.gpkg")) as connection:
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        connection.execute("BEGIN EXCLUSIVE")
        with pytest.raises(JournalError, match="still writes it"):
            reported(folder, 1, 2)


def test_doses_add_up_on_ground_that_counts_once(folder: Path) -> None:
    one, both = reported(folder, 1, 2).contents, reported(folder, 1, 2, 3).contents
    first, rows = one["sorties"][0], both["sorties"]
    assert both["verdict"]["area_ha"] == pytest.approx(first["area_ha"], rel=1e-6)
    assert both["verdict"]["applied_l"] == pytest.approx(3.0 * first["applied_l"])
    assert both["verdict"]["doubled_m2"] == pytest.approx(1e4 * first["area_ha"], rel=0.01)
    assert both["verdict"]["untreated_m2"] == one["verdict"]["untreated_m2"]
    assert [row["aircraft"] for row in rows] == ["D1", "D2", "D1"]
    assert [row["spraying_from"][:10] for row in rows] == ["2026-09-21", "2026-09-21", "2026-09-22"]
    # The product in it is of all litres.
    fields = both["application"]["eu"]["fields"]
    assert fields["product_quantity"]["value"] == pytest.approx(
        0.05 * 3.0 * first["applied_l"], abs=1e-4
    )
    assert fields["aircraft"]["value"] == "D1; D2"
    assert fields["date"]["value"] == "2026-09-21"
    assert both["application"]["eu"]["keep_until"] == "2029-09-22"
    assert both["application"]["eu"]["complete"] is True


def test_a_second_treatment_that_was_asked_for_is_said(folder: Path) -> None:
    codes = {each["code"] for each in reported(folder, 1, 5).contents["warnings"]}
    assert "pause" in codes
    assert PAUSE_MAX_S < 14 * DAY_S
    assert "pause" not in {each["code"] for each in reported(folder, 1, 3).contents["warnings"]}


def test_two_products_are_no_sum(folder: Path) -> None:
    changed(
        folder / "flight-0002.gpkg",
        application_json=json.dumps(EU_TOLD | {"application.product_per_l": 0.1}),
    )
    with pytest.raises(ConfigError, match=r"application\.product_per_l: 0\.05 and 0\.1 in one job"):
        reported(folder, 1, 2)


def test_the_page_and_the_csv_name_each_sortie(folder: Path) -> None:
    report = reported(folder, 1, 2)
    page = report.files["report.html"].decode()
    assert page.count("flight-0002.gpkg") >= 2
    assert "Appendix" not in page
    assert b"by D2" in report.files["application-eu.csv"]
    assert report.is_whole
