"""The sheet a pilot flies by: what it says beside what is known otherwise."""

from __future__ import annotations

import base64
import json
import math
from datetime import datetime
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from shapely import box

from companion.cli.app import execute
from tests.missions.test_missions_cli import written

pytestmark = pytest.mark.usefixtures("searched_briefly")

BATTERY = """
[mission]
swath_width_m = 6.0
speed_m_s = 6.0
tank_l = 9.0
reserve_l = 1.5
refill_s = 240.0
battery_wh = 400.0
power_hover_w = 5000.0
rate_l_ha = 20.0

[product]
name = "Brew & Sons <A>"
registration = "024-1"

[application]
product_per_l = 0.05
product_unit = "kg"
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Return the configuration of the first paper with a battery and a product."""
    text = (Path(__file__).parents[2] / "examples/anyang/config.toml").read_text()
    for table in ("mission", "product", "application", "prescription"):
        before, mark, after = text.partition(f"[{table}]")
        if mark:
            text = before + after[after.index("\n[") if "\n[" in after else len(after) :]
    path = tmp_path / "config.toml"
    path.write_text(text + BATTERY)
    return path


def planned(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    assert execute(["plan", "--force", *map(str, words), "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_tanks_are_filled_with_the_reserve_and_topped_up_without_it(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, config: Path
) -> None:
    field = written(box(0, 0, 130, 100), tmp_path / "f.geojson")
    found = planned(capsys, field, "--config", config, "--out", tmp_path / "m.kml")
    rows = found["sorties"]
    assert len(rows) > 2
    for number, row in enumerate(rows):
        assert row["fill_l"] == pytest.approx(row["volume_l"] + 1.5)
        assert row["fill_l"] <= 9.0 + 1e-9
        assert row["add_l"] == pytest.approx(row["volume_l"] + (1.5 if number == 0 else 0.0))
        assert row["land_s"] == pytest.approx(row["start_s"] + row["airborne_s"])
    for before, after in pairwise(rows):
        assert after["start_s"] - before["land_s"] >= 240.0 - 1e-6


def test_a_battery_that_stays_goes_on_falling_and_never_below_its_reserve(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, config: Path
) -> None:
    field = written(box(0, 0, 130, 100), tmp_path / "f.geojson")
    found = planned(capsys, field, "--config", config, "--out", tmp_path / "m.kml")
    left = 100.0
    for row in found["sorties"]:
        left = (100.0 if row["swap"] else left) - 100.0 * row["energy_wh"] / 400.0
        assert row["battery_percent"] == pytest.approx(row["energy_wh"] / 4.0)
        assert row["battery_left_percent"] == pytest.approx(left)
        assert left >= 20.0


def test_what_is_lost_to_overlap_is_rate_times_ground_sprayed_twice(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0, 0, 64, 200), tmp_path / "f.geojson")
    found = planned(
        capsys, field, "--rate-l-ha", "30", "--tank-l", "15", "--out", tmp_path / "m.kml"
    )
    assert found["overlap_percent"] > 1.0
    twice_l = found["overlap_percent"] / 100.0 * found["area_ha"] * 30.0
    assert sum(row["overlap_l"] for row in found["sorties"]) == pytest.approx(twice_l, rel=1e-6)


def test_the_farthest_place_is_a_corner_of_the_way(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    field = written(box(0, 0, 60, 200), tmp_path / "f.geojson")
    depot = ["--depot", "48.0,11.0"]
    out = tmp_path / "m.geojson"
    found = planned(capsys, field, *depot, "--tank-l", "9", "--out", out)
    features = json.loads(out.read_text())["features"]
    lat, lon = found["depots"][0]
    for row in found["sorties"]:
        own = [each for each in features if each["properties"].get("sortie") == row["number"]]
        far_m = max(
            math.hypot((x - lon) * 111_320.0 * math.cos(math.radians(lat)), (y - lat) * 111_200.0)
            for each in own
            for x, y in each["geometry"]["coordinates"]
        )
        assert row["farthest_m"] == pytest.approx(far_m, rel=0.005)


def test_a_sheet_in_text_says_what_to_pour_and_when_to_start(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, config: Path
) -> None:
    field = written(box(0, 0, 130, 100), tmp_path / "east field.geojson")
    sheet = tmp_path / "sheet.txt"
    found = planned(
        capsys, field, "--config", config, "--out", tmp_path / "m.kml", "--sheet", sheet,
        "--start", "06:55", "--wind", "3,270",
    )  # fmt: skip
    text = sheet.read_text()
    adds_l = sum(row["add_l"] for row in found["sorties"])
    assert text.startswith("east field\n==========\n")
    assert f"{adds_l:.1f} L: {found['volume_l']:.1f} L to spray" in text
    assert "Brew & Sons <A> (024-1)" in text
    assert f"{adds_l * 0.05:.2f} kg" in text
    assert "{:.6f}, {:.6f}".format(*found["depots"][0]) in text
    assert "planned for 3 m/s from 270 deg" in text
    rows = [line.split() for line in text.splitlines() if line.strip()[:1].isdigit()]
    first = found["sorties"][0]
    assert rows[0][:5] == [
        "1", f"{first['fill_l']:.1f}", f"{first['add_l']:.1f}", f"{first['add_l'] * 0.05:.2f}",
        "06:55",
    ]  # fmt: skip
    assert len(rows) == len(found["sorties"])


def test_a_sheet_in_html_is_one_well_formed_page_with_a_row_for_each_sortie(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, config: Path
) -> None:
    field = written(box(0, 0, 130, 100), tmp_path / "f.geojson")
    sheet = tmp_path / "sheet.html"
    found = planned(
        capsys, field, "--config", config, "--out", tmp_path / "m.kml", "--sheet", sheet
    )
    text = sheet.read_text()
    assert "Brew &amp; Sons &lt;A&gt;" in text
    assert "<script" not in text and "http" not in text and "<img" not in text

    class Rows(HTMLParser):
        open: list[str] = []  # noqa: RUF012
        count = 0

        def handle_starttag(self, tag: str, attrs: object) -> None:
            if tag not in ("meta", "br", "img"):
                self.open.append(tag)
            self.count += tag == "tr"

        def handle_endtag(self, tag: str) -> None:
            assert self.open.pop() == tag

    parser = Rows()
    parser.feed(text)
    assert not parser.open
    assert parser.count == len(found["sorties"]) + 2


def test_a_sheet_in_html_holds_the_picture_that_was_made(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    field = written(box(0, 0, 50, 50), tmp_path / "f.geojson")
    sheet, picture = tmp_path / "sheet.html", tmp_path / "m.png"
    planned(capsys, field, "--out", tmp_path / "m.kml", "--sheet", sheet, "--png", picture)
    _, _, rest = sheet.read_text().partition('src="data:image/png;base64,')
    assert base64.b64decode(rest.partition('"')[0]) == picture.read_bytes()


def test_several_aircraft_each_pour_their_own_reserve(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, config: Path
) -> None:
    field = written(box(0, 0, 260, 100), tmp_path / "f.geojson")
    sheet = tmp_path / "sheet.txt"
    found = planned(
        capsys, field, "--config", config, "--aircraft", "2", "--out", tmp_path / "m.kml",
        "--sheet", sheet,
    )  # fmt: skip
    firsts = [row for row in found["sorties"] if row["first"]]
    assert sorted(row["aircraft"] for row in firsts) == [1, 2]
    assert sum(row["add_l"] for row in found["sorties"]) == pytest.approx(
        found["volume_l"] + 2 * 1.5
    )
    assert "aircraft" in sheet.read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--sheet", "s.docx"], "sheets are written as .html, .txt"),
        (["--sheet", "s.txt", "--start", "25:00"], "write the time of the first take-off"),
        (["--start", "7:00"], "--start is for --sheet"),
    ],
)
def test_what_is_no_sheet_is_refused_before_any_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: list[str], said: str
) -> None:
    field = written(box(0, 0, 50, 50), tmp_path / "f.geojson")
    words = [str(tmp_path / word) if word.startswith("s.") else word for word in words]
    assert execute(["plan", "--force", str(field), "--out", str(tmp_path / "m.plan"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "m.plan").exists()


def test_the_sheet_says_how_little_ways_beside_passes_could_be(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, config: Path
) -> None:
    field = written(box(0, 0, 600, 300), tmp_path / "f.geojson")
    sheet = tmp_path / "s.txt"
    found = planned(
        capsys, field, "--config", config, "--out", tmp_path / "m.kml", "--sheet", sheet
    )
    beside_km = (found["transit_m"] + found["ferry_m"]) / 1000.0
    (way,) = [line for line in sheet.read_text().splitlines() if line.startswith("Way ")]
    assert 0.05 < found["least_idle_m"] / 1000.0 < beside_km
    assert way.split(None, 1)[1] == (
        f"{found['spray_m'] / 1000.0:.1f} km of passes, {beside_km:.1f} km of other ways "
        f"(in any order {found['least_idle_m'] / 1000.0:.1f} km or more)"
    )


def test_a_sheet_has_the_fields_own_name_and_the_day_on_which_it_was_planned(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, config: Path
) -> None:
    field = written(box(0, 0, 60, 60), tmp_path / "boundary.geojson")
    days = {datetime.now().astimezone().date().isoformat()}
    for words, name in (
        (["--set", 'application.field_name="Long Acre"'], "Long Acre"),
        ([], "boundary"),
    ):
        sheet = tmp_path / "sheet.txt"
        out = ["--out", tmp_path / "m.kml", "--sheet", sheet]
        planned(capsys, field, "--config", config, *words, *out)
        days.add(datetime.now().astimezone().date().isoformat())
        lines = sheet.read_text().splitlines()
        assert lines[0] == name
        assert any(f"Planned        {day} " in line for line in lines for day in days)
