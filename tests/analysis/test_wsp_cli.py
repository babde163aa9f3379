"""`vrspray wsp`: files in, figures and pictures out, one line for what is wrong."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from analysis.wsp import cli
from analysis.wsp.image import Rectangle
from companion.cli.app import execute
from tests.analysis.test_wsp_flight import flown
from tests.synthetic_cards import Scanner, Spray, draw_sheet, save

DPI = 300.0
PX = DPI / 25.4
SPRAYS = [
    Spray(drops_per_cm2=20.0, nmd_um=170.0, sigma=1.4),
    Spray(drops_per_cm2=45.0, nmd_um=150.0),
]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    places = [
        Rectangle(x=x * PX, y=45.0 * PX, long=76.0 * PX, short=26.0 * PX, angle_deg=88.0)
        for x in (25.0, 65.0)
    ]
    size = (round(90 * PX), round(90 * PX))
    sheet = draw_sheet(SPRAYS, places, size=size, seed=1, scanner=Scanner(dpi=DPI))
    path = tmp_path_factory.mktemp("wsp") / "scan.png"
    save(sheet, path, dpi=DPI)
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, Any, str]:
    code = execute(["wsp", *map(str, arguments), "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out), err


def test_a_scan_becomes_figures_table_and_pictures(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found, _ = run(capsys, scan, "--out", tmp_path)
    assert code == 0
    assert json.loads((tmp_path / "wsp.json").read_text()) == found
    assert [card["card"] for card in found["cards"]] == [1, 2]
    first, second = found["cards"]
    assert first["deposits_per_cm2"] < 25.0 < second["deposits_per_cm2"]
    assert second["drops_per_cm2"] > second["deposits_per_cm2"]
    assert (first["spread"], first["second"]["spread"]) == ("depositscan", "usda")
    assert first["dv05_um"] > first["second"]["dv05_um"]
    assert found["sheets"][0]["dpi_source"] == "file"
    assert found["summary"]["cards"] == 2
    with (tmp_path / "wsp.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["l_ha"]) for row in rows] == pytest.approx(
        [c["l_ha"] for c in found["cards"]]
    )
    assert all(row["second_dv05_um"] and row["flags"] == "low-dpi" for row in rows)
    for name in ("sheet-01-scan.jpg", "distributions.png"):
        with Image.open(tmp_path / name) as picture:
            assert min(picture.size) > 200


def test_the_table_shows_both_spread_factors(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(["wsp", str(scan), "--out", str(tmp_path), "--spread", "table"]) == 0
    out = capsys.readouterr().out
    assert "by table (" in out.splitlines()[0]
    assert out.splitlines()[0].endswith("/ depositscan")


def test_found_stains_are_tinted_and_the_card_is_outlined(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, scan, "--out", tmp_path)
    with Image.open(tmp_path / "sheet-01-scan.jpg") as picture:
        red = sum(
            count
            for count, colour in picture.getcolors(1 << 24) or []
            if isinstance(colour, tuple) and colour[0] > 150 > 90 > colour[1]
        )
    assert red > 1000


def test_cards_are_tied_to_the_flight_over_them(
    scan: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = flown()
    monkeypatch.setattr("analysis.flown.read_applied.read_applied", lambda path, unread: flight)
    journal = tmp_path / "f.gpkg"
    journal.touch()
    places = [flight.setup.frame.to_geographic(east_m, 3.5) for east_m in (11.0, 13.5)]
    table = tmp_path / "cards.csv"
    lines = [
        f"{name},{a!r},{b!r},0.5" for name, (a, b) in zip(["1", "scan-2"], places, strict=True)
    ]
    table.write_text("\n".join(["card,latitude,longitude,height", *lines, "9,36,114.5,"]))
    code, found, err = run(
        capsys, scan, "--out", tmp_path, "--positions", table, "--journal", journal
    )
    assert (code, found["warnings"]) == (0, [])
    first, second = (card["flight"] for card in found["cards"])
    assert (first["prescribed_l_ha"], second["prescribed_l_ha"]) == (20.0, 25.0)
    assert first["boundary_m"] == pytest.approx(-1.0, abs=0.01)
    assert second["boundary_m"] == pytest.approx(1.5, abs=0.01)
    assert first["time"] == "1970-01-12T13:46:44.200Z"
    assert first["valve"] == "3"
    (change,) = found["boundaries"]
    assert [row["card"] for row in change["cards"]] == [1, 2]
    assert found["cards"][0]["position"]["height_m"] == 0.5
    assert "there is no card 9" in err


def test_a_journal_is_looked_at_before_the_scans(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A missing one is an error at once; cards are measured with a damaged one all the same."""
    table = tmp_path / "cards.csv"
    table.write_text("card,latitude,longitude\n1,36,114.5\n")
    out = tmp_path / "out"
    options = ("--out", out, "--positions", table, "--journal", tmp_path / "f.gpkg")
    assert run(capsys, scan, *options)[0] == 2
    assert not out.exists()
    (tmp_path / "f.gpkg").write_bytes(b"no journal at all" * 100)
    code, found, _ = run(capsys, scan, *options)
    assert code == 1
    assert len(found["cards"]) == 2
    assert "this is not a journal" in found["warnings"][0]


def test_a_flight_that_was_cut_is_a_warning(
    scan: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = replace(flown(), is_closed=False)
    monkeypatch.setattr("analysis.flown.read_applied.read_applied", lambda path, unread: flight)
    (tmp_path / "f.gpkg").touch()
    (tmp_path / "c.csv").write_text("card,latitude,longitude\n1,36,114.5\n")
    options = ("--positions", tmp_path / "c.csv", "--journal", tmp_path / "f.gpkg")
    code, found, err = run(capsys, scan, "--out", tmp_path / "out", *options)
    assert code == 1
    assert "was cut" in found["warnings"][0]
    assert "was cut" in err


def test_a_sheet_without_cards_is_a_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", (400, 300), (240, 240, 240)).save(tmp_path / "empty.png")
    code, found, err = run(capsys, tmp_path / "empty.png", "--out", tmp_path / "out")
    assert (code, found["cards"], found["summary"]) == (1, [], None)
    assert "--whole" in err


def test_what_is_refused_leaves_no_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "page.md").write_text("no picture")
    out = tmp_path / "made" / "out"
    assert execute(["wsp", str(tmp_path / "page.md"), "--out", str(out)]) == 2
    assert "is not an image" in capsys.readouterr().err
    assert not out.parent.exists()


def test_one_bad_file_of_two_is_told_and_the_other_measured(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.png").write_text("no image")
    code, found, err = run(capsys, tmp_path / "bad.png", scan, "--out", tmp_path)
    assert (code, len(found["cards"])) == (1, 2)
    assert "bad.png" in found["refused"][0]["error"]
    assert "bad.png" in err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--spread", "magic"], "--spread magic"),
        (["--threshold", "300"], "--threshold 300"),
        (["--threshold", "-1"], "--threshold -1"),
        (["--dpi", "5"], "--dpi 5"),
        (["--dpi", "nan"], "--dpi nan"),
        (["--inset-mm", "nan"], "--inset-mm nan"),
        (["--inset-mm", "10", "--dpi", "1200"], ""),
        (["--card-width-mm", "0"], "--card-width-mm 0"),
        (["--journal", "flight.gpkg"], "--positions"),
        (["--positions", "none.csv"], "none.csv"),
    ],
)
def test_wrong_options_are_refused_in_one_line(
    options: list[str],
    words: str,
    scan: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    code, found, err = run(capsys, scan, "--out", tmp_path, *options)
    assert code == 2
    assert words in found["error"]
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("1,91,10", "latitude"),
        ("1,36,114\n1,36,114", "twice"),
        (",36,114", "card is blank"),
        ("1,36", "longitude is blank"),
    ],
)
def test_wrong_positions_name_their_line(
    rows: str, words: str, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "cards.csv"
    table.write_text(f"card,latitude,longitude\n{rows}\n")
    code, found, _ = run(capsys, scan, "--out", tmp_path, "--positions", table)
    assert code == 2
    assert words in found["error"]
    assert "line" in found["error"]


def test_an_image_that_is_none_and_a_folder_that_cannot_be_are_refused(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("no image")
    assert run(capsys, tmp_path / "file", "--out", tmp_path)[0] == 2
    assert run(capsys, scan, "--out", tmp_path / "file" / "sub")[0] == 2


def test_the_command_is_one_of_typers() -> None:
    assert cli.wsp.name is not None


@pytest.mark.parametrize("size", [(1, 1), (300, 400)])
def test_a_white_image_as_a_whole_card_is_told_to_be_none(
    size: tuple[int, int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.new("RGB", size, (250, 250, 250)).save(tmp_path / "white.png")
    options = ("--whole", "--dpi", "600", "--out", tmp_path / "out")
    code, found, err = run(capsys, tmp_path / "white.png", *options)
    assert code == 0
    assert "no-paper" in found["cards"][0]["flags"]
    assert "No artists" not in err
