"""Damage of every kind: never a traceback, nothing of the file changes, what there is is given."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from analysis.journals.cli import content_of
from analysis.journals.content import read_journal
from analysis.journals.salvage import recover, recover_folder
from companion.cli.app import execute
from companion.cli.record_parts import made_ready
from companion.core.types import UtcReport
from companion.errors import JournalError, NoMapError
from companion.journal.folder import journals, look_at
from companion.journal.journal import open_for_flight
from companion.journal.read_only import log_of, salvaged_name
from companion.journal.reader import opened
from companion.journal.rows import ValveOrder
from companion.journal.writer import Writer
from tests.bench.journal import crashed
from tests.bench.journal_flight import example_setup
from tests.builders import setup
from tests.companion.test_journal import INPUTS, change, closed_journal, decisions, query
from tests.companion.test_journal_recovery import spoil


def everything(folder: Path) -> dict[str, bytes | None]:
    return {file.name: file.read_bytes() if file.is_file() else None for file in folder.iterdir()}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return closed_journal(tmp_path_factory.mktemp("sound"), 600)


@pytest.fixture
def path(sound: Path, tmp_path: Path) -> Path:
    """Return a closed journal of 600 decisions, alone in its folder."""
    return Path(shutil.copy(sound, tmp_path))


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return crashed(tmp_path_factory.mktemp("cut"), example_setup(), seconds=3, seed=1)[0]


@pytest.fixture
def left(cut: Path, tmp_path: Path) -> Path:
    """Return a journal that was cut, its log beside it."""
    return shutil.copytree(cut, tmp_path / "left") / "flight-0001.gpkg"


# --------------------------------------------------------------------- before a flight, recovery

VALUES = {
    "span": "UPDATE blocks SET from_s = 'x'",
    "start": "UPDATE meta SET value = NULL WHERE key = 'started_s'",
    "start as text": "UPDATE meta SET value = 'soon' WHERE key = 'started_s'",
    "litres": "UPDATE applied SET time_s = 'x', flow_l_min = 'y'; ",
    "closed": "DELETE FROM meta WHERE key = 'closed'",
    "points": "UPDATE applied SET geom = x'00'",
}


@pytest.mark.parametrize("is_cut", [False, True])
@pytest.mark.parametrize("case", VALUES)
def test_no_old_journal_keeps_from_flying(case: str, is_cut: bool, path: Path) -> None:
    change(path, VALUES[case].rstrip("; "))
    change(path, "DELETE FROM meta WHERE key = 'applied_l'")
    second = path.with_name("flight-0002.gpkg")
    shutil.copy(path, second)
    change(second, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    if is_cut:
        change(path, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    lines = list(made_ready(path.parent))
    assert any(line.startswith("journal: flight-0002.gpkg: ") for line in lines)
    assert not any("Traceback" in line for line in lines)
    assert path.exists()


def test_before_a_flight_a_damaged_journal_is_left_as_it_is(path: Path) -> None:
    change(path, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    os.truncate(path, path.stat().st_size - 100)
    before = everything(path.parent)
    lines = list(made_ready(path.parent))
    (line,) = (line for line in lines if path.name in line)
    assert line.startswith(f"journal: {path.name}: damaged: the file was cut off within a page; ")
    assert line.endswith("vrspray flights recover copies what can be read of it")
    assert everything(path.parent) == before
    # Once its copy is there, nothing is left to be said.
    recover_folder(path.parent)
    assert not [line for line in made_ready(path.parent) if path.name in line]


def test_an_old_journal_with_a_time_that_is_none_is_damaged(path: Path) -> None:
    change(path, VALUES["span"])
    flight = look_at(path)
    assert flight.state == "damaged"
    assert "could not convert string to float" in str(flight.problem)
    assert flight.started_utc_s is not None


def test_a_cut_journal_without_the_offset_of_its_clock_is_recovered(left: Path) -> None:
    with closing(sqlite3.connect(left)) as connection, connection:
        connection.execute("DELETE FROM meta WHERE key = 'utc_offset_s'")
        connection.execute("UPDATE meta SET value = 'autopilot' WHERE key = 'utc_source'")
    found = recover(left)
    assert found is None or found.outcome == "recovered"
    assert look_at(left).state == "recovered"


@pytest.mark.parametrize("log_bytes", [None, 0, 1104])
def test_a_damaged_file_is_kept_to_the_byte_with_its_log(path: Path, log_bytes: int | None) -> None:
    change(path, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    spoil(path, "applied")
    if log_bytes is not None:
        log_of(path).write_bytes(b"\x37" * log_bytes)
    before = everything(path.parent)
    (found,) = recover_folder(path.parent)
    assert found.outcome == "salvaged"
    salvaged_name(path).unlink()
    assert everything(path.parent) == before


def test_a_damaged_file_with_a_whole_log_is_kept_to_the_byte(left: Path) -> None:
    with left.open("r+b") as file:
        file.seek(20 * 1024)
        file.write(b"\xa5" * (left.stat().st_size - 20 * 1024))
    before = everything(left.parent)
    (found,) = recover_folder(left.parent)
    assert not found.is_good
    after = everything(left.parent)
    after.pop(salvaged_name(left).name, None)
    assert after == before


def test_a_journal_of_tomorrow_that_was_cut_is_left_alone(path: Path) -> None:
    change(path, "UPDATE meta SET value = '3' WHERE key = 'journal_version'")
    assert recover_folder(path.parent) == []
    change(path, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    before = everything(path.parent)
    (found,) = recover_folder(path.parent)
    assert (found.outcome, found.is_good) == ("other-version", False)
    assert "version 3, this program reads" in found.text
    assert everything(path.parent) == before


def test_the_advice_is_a_newer_program_where_this_one_claims_to_have_written_it(path: Path) -> None:
    change(path, "UPDATE meta SET value = '3' WHERE key = 'journal_version'")
    for wrote, advice in (
        (metadata.version("vrspray"), "use a newer vrspray"),
        ("unknown", "use a newer vrspray"),
        ("77.1", "use vrspray 77.1, which wrote it"),
    ):
        change(path, f"UPDATE meta SET value = '{wrote}' WHERE key = 'version_vrspray'")
        with pytest.raises(JournalError, match=advice):
            read_journal(path)


def test_a_folder_or_a_dangling_link_of_that_name_is_passed_over(path: Path) -> None:
    path.with_name("flight-0000.gpkg").mkdir()
    path.with_name("flight-0002.gpkg").symlink_to("nowhere.gpkg")
    third = path.with_name("flight-0003.gpkg")
    shutil.copy(path, third)
    change(third, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    assert journals(path.parent) == [path, third]
    assert [found.path for found in recover_folder(path.parent)] == [third]


def test_what_a_cut_in_the_moment_of_closing_left_half_written_is_undone(path: Path) -> None:
    whole = read_journal(path).entries
    half = path.parent.with_name(path.parent.name + "-half")
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA cache_size = 5")
        connection.execute("BEGIN IMMEDIATE")
        connection.execute("UPDATE applied SET duty = duty + 1, inhibits = inhibits || 'x'")
        shutil.copytree(path.parent, half)
    names = {file.name for file in half.iterdir()}
    assert names == {path.name, f"{path.name}-journal"}
    assert not [found for found in recover_folder(half) if not found.is_good]
    assert read_journal(half / path.name).entries == whole
    assert query(half / path.name, "SELECT max(duty) <= 1 FROM applied") == [(1,)]


# ------------------------------------------------------------------------------ cut off, no map


@pytest.mark.parametrize("share", [0.95, 0.5])
def test_a_closed_journal_that_was_cut_off_gives_what_there_is(
    share: float, tmp_path: Path
) -> None:
    # So long that its set-up and its first rows are in the first half.
    path = closed_journal(tmp_path, 1500)
    whole = read_journal(path)
    os.truncate(path, int(path.stat().st_size * share))
    with pytest.raises(JournalError, match="is damaged"):
        read_journal(path)
    content = read_journal(path, is_lenient=True)
    assert content.meta["map_sha256"] == whole.meta["map_sha256"]
    assert content.setup.boom == whole.setup.boom
    assert list(content.entries) == list(whole.entries[: len(content.entries)])
    assert content.unread[0].startswith("the file is shorter than it was, or damaged: ")
    flight = look_at(path)
    assert (flight.state, flight.started_utc_s is not None) == ("damaged", True)
    before = path.read_bytes()
    (found,) = recover_folder(path.parent)
    assert found.outcome == "salvaged"
    assert path.read_bytes() == before
    with opened(salvaged_name(path), is_lenient=True) as copy:
        (count,) = copy.connection.execute("SELECT count(*) FROM applied").fetchone()
        assert copy.setup().boom == whole.setup.boom
    assert 0 < count < int(whole.meta["rows_applied"])


NO_MAP = {
    "no field": "DELETE FROM field",
    "no layer": "DROP TABLE field",
    "zones": "UPDATE zones SET geom = x'00'",
}


@pytest.mark.parametrize("case", NO_MAP)
def test_without_its_map_the_rest_is_shown_and_that_is_said(
    case: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(path, NO_MAP[case])
    content = content_of(path)
    assert content["entries"] == {"Decision": 600}
    assert any(
        "no map: its zones or its field cannot be read" in text for text in content["unread"]
    )
    with pytest.raises(NoMapError, match=r"no map: .*rows of applied.* can be read") as refused:
        read_journal(path, is_lenient=True)
    assert "\n" not in str(refused.value)
    assert execute(["report", str(path), "--out", str(path.parent / "out")]) == 1
    assert "no map" in capsys.readouterr().err


def test_any_one_page_may_be_gone(sound: Path, tmp_path: Path) -> None:
    (page_bytes,), (pages,) = query(sound, "PRAGMA page_size") + query(sound, "PRAGMA page_count")
    assert isinstance(page_bytes, int)
    assert isinstance(pages, int)
    whole = {entry.sequence: entry for entry in read_journal(sound).entries}
    path = tmp_path / "flight-0001.gpkg"
    for page in [*range(1, 30), *range(30, pages, 11)]:
        shutil.copy(sound, path)
        with path.open("r+b") as file:
            file.seek(page * page_bytes)
            file.write(bytes(page_bytes))
        before = everything(tmp_path)
        look_at(path)
        content = content_of(path)
        assert content["unread"] or sum(content["entries"].values()) == len(whole)
        try:
            entries = read_journal(path, is_lenient=True).entries
        except JournalError as error:
            assert "\n" not in str(error)
        else:
            assert all(whole[entry.sequence] == entry for entry in entries)
        assert everything(tmp_path) == before


# ------------------------------------------------------------------------------------ totals


def test_the_number_of_rows_is_told_and_missing_rows_are_noticed(path: Path) -> None:
    meta = read_journal(path, is_lenient=True).meta
    for table in ("applied", "valve_changes"):
        assert query(path, f"SELECT count(*) FROM {table}") == [(int(meta[f"rows_{table}"]),)]
    assert int(meta["rows_applied"]) > 50
    assert read_journal(path, is_lenient=True).unread == ()
    change(path, "DELETE FROM applied WHERE sequence % 2")
    (text,) = read_journal(path, is_lenient=True).unread
    assert text.startswith("applied: ")
    assert text.endswith(f" rows, {meta['rows_applied']} were written")
    assert content_of(path)["unread"] == [text]


def test_litres_are_told_and_the_layer_is_not_read_for_them(path: Path) -> None:
    litres = look_at(path).applied_l
    assert litres is not None
    assert litres > 0.0
    change(path, "UPDATE applied SET flow_l_min = 1e6")
    assert look_at(path).applied_l == litres
    change(path, "UPDATE meta SET value = 'nan' WHERE key = 'applied_l'")
    assert (look_at(path).applied_l or 0.0) > 1e3


def test_a_recovered_journal_has_its_totals(left: Path) -> None:
    recover(left)
    meta = read_journal(left).meta
    assert query(left, "SELECT count(*) FROM applied") == [(int(meta["rows_applied"]),)]
    change(left, "DELETE FROM valve_changes")
    assert read_journal(left, is_lenient=True).unread != ()


# --------------------------------------------------------------------- a second that is lost


class Failing:
    """A connection whose next COMMIT fails, as on a full disk."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self.connection = connection
        self.fails = False

    def execute(self, sql: str, *values: Any) -> sqlite3.Cursor:
        if self.fails and sql == "COMMIT":
            self.fails = False
            raise sqlite3.OperationalError("database or disk is full")
        return self.connection.execute(sql, *values)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.connection, name)


@pytest.mark.parametrize("goes_on", [False, True])
def test_what_was_first_told_in_a_second_that_had_to_wait_is_told(
    tmp_path: Path, goes_on: bool
) -> None:
    path = closed_journal(tmp_path, 0)
    failing = Failing(open_for_flight(path))
    sequence: Iterator[int] = iter(range(100, 200))
    writer = Writer(
        failing,  # type: ignore[arg-type]
        frame=setup().frame,
        utc_offset_s=0.0,
        next_sequence=sequence.__next__,
    )
    writer.valves.from_orders = True
    writer.write(1, UtcReport(received_s=5.0, utc_s=1.8e9))
    writer.write(0, ValveOrder(valve=0, duty=1.0, planned_s=None, given_s=5.0))
    failing.fails = True
    writer.commit(lost_before=0)
    assert writer.fault is not None
    if goes_on:
        writer.write(2, UtcReport(received_s=6.0, utc_s=1.8e9 + 1.0))
        writer.write(0, ValveOrder(valve=0, duty=1.0, planned_s=None, given_s=6.0))
        writer.commit(lost_before=0)
        assert failing.execute("SELECT value FROM meta WHERE key = 'valve_changes'").fetchone() == (
            "orders",
        )
    writer.finish(lost_before=0)
    meta = read_journal(path).meta
    assert (meta["utc_source"], meta["valve_changes"]) == ("autopilot", "orders")
    assert float(meta["utc_offset_s"]) == pytest.approx(1.8e9 - 5.0)
    rows = query(path, "SELECT actual_us, valve, duty_permille FROM valve_changes")
    assert rows == [(5_000_000, 0, 1000)]


def test_the_last_commit_may_fail_and_the_flight_still_ends_in_order(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 0)
    failing = Failing(open_for_flight(path))
    writer = Writer(
        failing,  # type: ignore[arg-type]
        frame=setup().frame,
        utc_offset_s=0.0,
        next_sequence=iter(range(100, 200)).__next__,
    )
    for sequence, item in enumerate([INPUTS[3], *decisions(5)], 1):
        writer.write(sequence, item)
    failing.fails = True
    writer.finish(lost_before=0)
    meta = read_journal(path).meta
    assert (meta["closed"], meta["rows_applied"]) == ("yes", "3")
    assert (writer.lost, writer.committed) == (0, 6)


def test_the_list_of_tables_lies_at_the_very_front(left: Path) -> None:
    recover(left)
    pages = query(left, "SELECT max(pageno) FROM dbstat WHERE name = 'sqlite_schema'")
    assert int(str(pages[0][0])) < 40
