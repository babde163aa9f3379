"""`vrspray report`: the files, the exit codes, and what cannot be done in one line."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from analysis.report.build import BROWSERS, pdf_of
from companion.cli.app import execute
from companion.errors import ConfigError
from tests.analysis.report_flight import EU_TOLD, fly

Captured = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("cli"), told=EU_TOLD)


def test_report_writes_its_files_and_one_object(
    flown: Path, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "made" / "report"
    arguments = ["report", str(flown), "--out", str(out), "--no-figures", "--json"]
    assert execute([*arguments, "--profile", "eu", "--profile", "us"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    names = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert names == {str(Path(name).relative_to(out)) for name in found["files"]}
    assert {
        "report.html", "report.json", "application-eu.json", "application-eu.csv",
        "application-us.json", "application-us.csv",
    } == names  # fmt: skip
    written = json.loads((out / "report.json").read_text())
    assert {key: found[key] for key in written} == written


def test_report_replaces_an_earlier_one(flown: Path, tmp_path: Path, capsys: Captured) -> None:
    for _ in range(2):
        assert execute(["report", str(flown), "--out", str(tmp_path), "--no-figures"]) == 0
    assert "report.html" in capsys.readouterr().out
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_a_second_run_leaves_nothing_of_the_first(flown: Path, tmp_path: Path) -> None:
    first = ["--profile", "eu", "--profile", "us"]
    assert execute(["report", str(flown), "--out", str(tmp_path), *first]) == 0
    (tmp_path / "figures" / "mine.png").write_bytes(b"mine")
    (tmp_path / "notes.txt").write_bytes(b"mine")
    again = ["--profile", "generic", "--no-figures"]
    assert execute(["report", str(flown), "--out", str(tmp_path), *again]) == 0
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()} == {
        "report.html", "report.json", "application-generic.json", "application-generic.csv",
        "figures/mine.png", "notes.txt",
    }  # fmt: skip


BROWSER = """#!/bin/sh
for word in "$@"; do
  case "$word" in
    --print-to-pdf=*) printf '%%PDF-1.4 of %s' "$*" > "${word#--print-to-pdf=}" ;;
  esac
done
"""


def test_a_pdf_is_the_page_printed_by_a_browser(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "chromium").write_text(BROWSER)
    (programs / "chromium").chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:/usr/bin:/bin")
    out = tmp_path / "out"
    assert execute(["report", str(flown), "--out", str(out), "--pdf", "--no-figures"]) == 0
    printed = (out / "report.pdf").read_text()
    assert printed.startswith("%PDF")
    assert "report.html" in printed
    assert "MAP * ~NOTFOUND" in printed


def test_without_a_browser_a_pdf_is_refused_before_any_work(
    flown: Path, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path / "none"))
    out = tmp_path / "out"
    assert execute(["report", str(flown), "--out", str(out), "--pdf"]) == 2
    assert "install chromium" in capsys.readouterr().err
    assert not out.exists()


def test_a_browser_that_prints_nothing_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"did not print the page"):
        pdf_of("<p>", program="/bin/true")


@pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason="no browser is installed")
def test_a_real_browser_prints_the_page(flown: Path, tmp_path: Path) -> None:
    assert execute(["report", str(flown), "--out", str(tmp_path), "--pdf", "--no-figures"]) == 0
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")


def test_the_journal_is_not_touched(flown: Path, tmp_path: Path) -> None:
    before = flown.read_bytes()
    assert execute(["report", str(flown), "--out", str(tmp_path), "--no-figures"]) == 0
    assert flown.read_bytes() == before


def test_a_flight_that_was_cut_is_reported_and_exit_1(
    flown: Path, tmp_path: Path, capsys: Captured
) -> None:
    cut = tmp_path / "cut.gpkg"
    shutil.copy(flown, cut)
    with closing(sqlite3.connect(cut)) as connection, connection:
        connection.execute("UPDATE meta SET value = 'no' WHERE key = 'closed'")
    out = tmp_path / "report"
    assert execute(["report", str(cut), "--out", str(out), "--no-figures"]) == 1
    assert "The journal was cut" in capsys.readouterr().err
    assert "The journal was cut" in (out / "report.html").read_text()


def test_a_damaged_journal_is_reported_as_far_as_it_goes_and_exit_1(
    flown: Path, tmp_path: Path, capsys: Captured
) -> None:
    damaged = tmp_path / "damaged.gpkg"
    shutil.copy(flown, damaged)
    with closing(sqlite3.connect(damaged)) as connection, connection:
        connection.execute("UPDATE blocks SET body = x'00' WHERE rowid = 1")
    out = tmp_path / "report"
    assert execute(["report", str(damaged), "--out", str(out), "--no-figures"]) == 1
    assert "could not be read" in capsys.readouterr().err
    found = json.loads((out / "report.json").read_text())
    assert found["flight"]["unread"]
    assert found["application"]["eu"]["complete"] is False
    assert "could not be read" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["{folder}/none.gpkg"], "there is no such file"),
        (["{folder}/text.gpkg"], "this is not a journal"),
        (["{folder}/other.gpkg"], "this is not a journal"),
        (["{flown}", "--time-zone", "Mars/Base"], "time zone Mars/Base: not known"),
        (["{flown}", "--set", "application.crop_eppo=wheat"], "application.crop_eppo"),
        (["{flown}", "--application", "{folder}/none.toml"], "none.toml: no such file"),
        (["{flown}", "--out", "{folder}/text.gpkg"], "give a folder that can be written"),
        (["{flown}", "--profile", "uk"], "--profile"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(
    flown: Path, tmp_path: Path, capsys: Captured, arguments: list[str], text: str
) -> None:
    (tmp_path / "text.gpkg").write_text("no database at all, but a text of some length\n" * 99)
    with closing(sqlite3.connect(tmp_path / "other.gpkg")) as connection, connection:
        connection.execute("CREATE TABLE t (x)")
    given = [each.format(folder=tmp_path, flown=flown) for each in arguments]
    out = [] if "--out" in given else ["--out", str(tmp_path / "report")]
    assert execute(["report", *given, *out, "--no-figures"]) == 2
    captured = capsys.readouterr()
    errors = [line for line in captured.err.splitlines() if line.startswith("error: ")]
    assert captured.out == ""
    assert len(errors) == 1
    assert text in errors[0]
    assert not (tmp_path / "report").exists()


def test_report_has_help_with_an_example(capsys: Captured) -> None:
    assert execute(["report", "--help"]) == 0
    assert "vrspray report" in capsys.readouterr().out.partition("Example:")[2]
