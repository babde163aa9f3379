"""`vrspray export`: what it writes, what it refuses in one line, what it never leaves behind."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from analysis.exports.cli import FORMATS, format_for
from analysis.exports.columns import plain_names
from analysis.exports.output import ExportError, write_beside, write_folder
from companion.cli.app import execute
from companion.errors import ConfigError
from companion.journal.journal import Journal
from companion.wording import CUT
from tests.analysis.export_flight import fly
from tests.builders import setup


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("flown"), training="water")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    folder = tmp_path / "out"
    folder.mkdir()
    return folder


def names(folder: Path) -> set[str]:
    return {each.name for each in folder.iterdir()}


@pytest.mark.parametrize(
    ("name", "form", "files"),
    [
        ("f.csv", "csv", {"f.csv", "f.csv-metadata.json"}),
        ("f.kmz", "kml", {"f.kmz"}),
        ("F.SHP", "shapefile", {"F.SHP", "F.shx", "F.dbf", "F.prj", "F.cpg",
                                "F-Deere-Metadata.json"}),
        ("TASKDATA", "isoxml", {"TASKDATA.XML", "TLG00001.xml", "TLG00001.bin"}),
        ("f.mcap", "mcap", {"f.mcap"}),
    ],
)  # fmt: skip
def test_the_end_of_the_name_says_the_format(
    journal: Path,
    out: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    form: str,
    files: set[str],
) -> None:
    assert execute(["export", str(journal), "--out", str(out / name), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["format"] == form
    assert answer["training"] == "water"
    assert answer["volume_l"] == pytest.approx(0.857, abs=0.01)
    assert answer["warnings"] == []
    folder = out / name if (out / name).is_dir() else out
    assert names(folder) == files
    assert answer["bytes"] == sum(each.stat().st_size for each in folder.iterdir())


@pytest.mark.parametrize("form", [each for each in FORMATS if "" in each.also])
def test_a_folder_is_made_and_replaced_whole(
    journal: Path, out: Path, capsys: pytest.CaptureFixture[str], form: object
) -> None:
    name = getattr(form, "name", "")
    given = ["export", str(journal), "--out", str(out / "made"), "--format", name]
    assert execute(given) == 0
    before = names(out / "made")
    assert execute(given) == 2
    assert "or --force to replace it" in capsys.readouterr().err
    assert execute([*given, "--force"]) == 0
    assert names(out / "made") == before
    (out / "made" / "mine.txt").write_text("kept")
    assert execute([*given, "--force"]) == 2
    assert "holds other files" in capsys.readouterr().err
    assert names(out / "made") == {*before, "mine.txt"}
    assert names(out) == {"made"}


def test_a_person_reads_a_sentence_with_the_mark_of_a_training(
    journal: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = out / "f.geojson"
    given = ["export", str(journal), "--out", str(path), "--geometry", "swaths"]
    assert execute([*given, "--units", "us"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"{path}: ")
    assert "polygons, 0.857 L modelled, " in said.out
    assert said.out.endswith("training: water\n")
    assert len(said.err.splitlines()) == 2
    first = json.loads(path.read_text())["features"][0]["properties"]
    assert first["target_rate_gal_ac"] == pytest.approx(20.0 / 9.353958, rel=1e-4)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "f.gpx"], "no format is known by .gpx; there are .csv, "),
        (["--out", "folder"], "no format is known by a name without an end"),
        (["--out", "f.csv", "--format", "gpx"], "there is no format 'gpx'; there are csv, "),
        (
            ["--out", "f.csv", "--format", "kml"],
            "kml is written into a file whose name ends in .kml or .kmz",
        ),
        (
            ["--out", "f.csv", "--format", "isoxml"],
            "isoxml is written into a folder (a name without a dot) or into a file whose name ends "
            "in .zip",
        ),
        (["--out", "f.mcap", "--units", "us"], "mcap has units of its own"),
        (["--out", "f.csv", "--units", "imperial"], "there are metric and us"),
        (["--out", "f.csv", "--geometry", "swaths"], "csv has points"),
        (["--out", "f.csv", "--rate-hz", "0"], "must lie in (0, 1000]"),
        (["--out", "f.csv", "--rate-hz", "nan"], "must lie in (0, 1000]"),
        (["--out", "f.kml", "--rate-hz", "1"], "kml has no points to thin"),
        (["--out", "nowhere/f.csv"], "there is no such folder"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_in_one_line(
    journal: Path,
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(out)
    assert execute(["export", str(journal), *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert names(out) == set()


@pytest.mark.parametrize("name", ["f.csv", "f.shp"])
def test_nothing_is_written_over_without_being_told_to(
    journal: Path, out: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    beside = {"f.csv": "f.csv-metadata.json", "f.shp": "f.dbf"}[name]
    (out / beside).write_text("mine")
    given = ["export", str(journal), "--out", str(out / name)]
    assert execute(given) == 2
    assert f"{beside}: is there already; give another --out, or --force" in capsys.readouterr().err
    assert (out / beside).read_text() == "mine"
    assert names(out) == {beside}
    assert execute([*given, "--force"]) == 0
    assert (out / beside).read_bytes()[:4] != b"mine"


def test_a_cut_journal_gives_what_there_is_and_a_warning(
    journal: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = out / "flight-0009.gpkg"
    shutil.copy(journal, cut)
    with closing(sqlite3.connect(cut)) as connection, connection:
        connection.execute("UPDATE meta SET value = 'no' WHERE key = 'closed'")
    assert execute(["export", str(cut), "--out", str(out / "f.geojson"), "--json"]) == 1
    said = capsys.readouterr()
    answer = json.loads(said.out)
    assert (answer["is_closed"], answer["flight"]) == (False, "flight-0009")
    assert answer["warnings"] == [CUT]
    assert f"warning: {CUT}" in said.err
    facts = json.loads((out / "f.geojson").read_text())["vrspray"]
    assert facts["is_closed"] is False


def test_a_damaged_journal_gives_what_can_be_read_and_says_what_cannot(
    journal: Path, out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = out / "flight-0009.gpkg"
    shutil.copy(journal, damaged)
    with closing(sqlite3.connect(damaged)) as connection, connection:
        connection.execute("UPDATE blocks SET body = zeroblob(20)")
    assert execute(["export", str(damaged), "--out", str(out / "f.geojson"), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["volume_l"] == pytest.approx(0.857, abs=0.01)
    not_read = [each for each in answer["warnings"] if each.startswith("not read: ")]
    assert not_read
    facts = json.loads((out / "f.geojson").read_text())["vrspray"]
    assert [f"not read: {each}" for each in facts["unread"]] == not_read


def test_a_flight_without_a_position_is_refused(
    out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Journal.create(out, setup=setup(), started_s=0.0, waits=True) as empty:
        path = empty.path
    assert execute(["export", str(path), "--out", str(out / "f.csv")]) == 2
    assert "there is nothing to export" in capsys.readouterr().err
    assert names(out) == {path.name}


def test_what_is_no_journal_is_refused(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (out / "text.gpkg").write_text("no journal " * 100)
    for name in ("text.gpkg", "none.gpkg"):
        assert execute(["export", str(out / name), "--out", str(out / "f.csv")]) == 2
        last = capsys.readouterr().err.splitlines()[-1]
        assert last.startswith("error: ")
        assert name in last
    assert names(out) == {"text.gpkg"}


def half_then(error: BaseException) -> Iterator[bytes]:
    yield b"half"
    raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_what_is_interrupted_leaves_nothing_behind(out: Path, error: BaseException) -> None:
    expected = ConfigError if isinstance(error, OSError) else KeyboardInterrupt
    (out / "f.csv").write_text("old")
    with pytest.raises(expected):
        write_beside(out / "f.csv", {"f.csv": half_then(error)}, force=True)
    with pytest.raises(expected):
        write_folder(out / "new", {"a": [b"a"], "b": half_then(error)}, force=False)
    assert names(out) == {"f.csv"}
    assert (out / "f.csv").read_text() == "old"


def test_a_folder_is_never_replaced_by_a_file(out: Path) -> None:
    (out / "f.csv").mkdir()
    with pytest.raises(ExportError, match="is a folder"):
        write_beside(out / "f.csv", {"f.csv": [b""]}, force=True)


def test_every_format_can_be_had_by_name_and_end() -> None:
    for form in FORMATS:
        for end in (*form.suffixes, *form.also):
            assert format_for(Path(f"x{end}"), form.name) is form
        for end in form.suffixes:
            assert format_for(Path(f"X{end.upper()}"), None) is form
    assert format_for(Path("TaskData"), None).name == "isoxml"


def test_the_help_lists_all_formats(capsys: pytest.CaptureFixture[str]) -> None:
    assert execute(["export", "--help"]) == 0
    said = " ".join(capsys.readouterr().out.replace("|", " ").split())
    assert all(form.name in said for form in FORMATS)


def test_names_of_valves_become_names_of_columns() -> None:
    assert plain_names(["a b", "a-b", "7", "é"]) == ["a_b", "a_b_2", "v7", "v4"]
    assert len(set(plain_names(["x", "x", "x_2", "x"]))) == 4


def test_a_format_whose_module_is_missing_says_what_to_install(
    journal: Path,
    out: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "analysis.exports.mcap_file", None)
    assert execute(["export", str(journal), "--out", str(out / "f.mcap")]) == 2
    assert "pip install 'vrspray[office]'" in capsys.readouterr().err


def test_nothing_prescribed_is_nothing_and_not_zero(journal: Path, out: Path) -> None:
    assert execute(["export", str(journal), "--out", str(out / "f.geojson")]) == 0
    features = json.loads((out / "f.geojson").read_text())["features"]
    rates = [each["properties"]["target_rate_l_ha"] for each in features]
    assert rates[0] is None
    assert rates[len(rates) // 4] > 0.0
    flows = np.array([each["properties"]["flow_l_min"] for each in features])
    assert flows[0] == 0.0


def test_files_that_cannot_all_be_moved_leave_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "a.shp"
    write_beside(out, {"a.dbf": [b"old"], "a.shp": [b"old"]}, force=False)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if target == out and self.read_bytes() == b"new":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(ConfigError, match="cannot be written"):
        write_beside(out, {"a.dbf": [b"new"], "a.shp": [b"new"]}, force=True)
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == {
        "a.dbf": b"old",
        "a.shp": b"old",
    }


def test_a_folder_that_cannot_be_moved_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "TASKDATA"
    write_folder(out, {"a.xml": [b"old"]}, force=False)
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == "fresh":
            raise OSError(5, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(ConfigError, match="cannot be written"):
        write_folder(out, {"a.xml": [b"new"]}, force=True)
    assert (out / "a.xml").read_bytes() == b"old"
    assert [each.name for each in tmp_path.iterdir()] == ["TASKDATA"]
