"""After a crash: what was committed is there, what is damaged is kept, a copy saves the rest."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from analysis.journals.content import content_sha256, read_journal
from analysis.journals.salvage import recover, recover_folder
from companion.journal.folder import look_at
from companion.journal.journal import Journal
from companion.journal.read_only import log_of, salvaged_name
from tests.bench.journal import crashed, kills, torn
from tests.bench.journal_flight import example_setup
from tests.builders import setup
from tests.companion.test_journal import closed_journal, query


def test_every_committed_row_survives_kills() -> None:
    assert kills(4, seed=3, seconds=2.0, say=str)["kills"] == 4


def test_every_whole_transaction_survives_torn_logs() -> None:
    found = torn(8, seed=4, seconds=4, say=str)
    assert found["torn"] == 8
    assert 0 < found["kept_mean"] < found["transactions"]


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a journal of four seconds that was cut."""
    folder = tmp_path_factory.mktemp("cut")
    return crashed(folder, example_setup(), seconds=4, seed=1)[0]


def test_looking_at_a_journal_that_was_cut_leaves_nothing_beside_it(left: Path) -> None:
    names = {file.name for file in left.parent.iterdir()}
    assert names == {left.name, f"{left.name}-wal"}
    assert len(read_journal(left).entries) > 400
    assert {file.name for file in left.parent.iterdir()} == names


def test_the_hash_of_a_journal_that_was_cut_is_of_its_log_too(left: Path) -> None:
    log = log_of(left)
    both = hashlib.sha256(left.read_bytes() + log.read_bytes()).hexdigest()
    assert content_sha256(left) == both
    read_journal(left)
    assert content_sha256(left) == both
    recover(left)
    assert content_sha256(left) == hashlib.sha256(left.read_bytes()).hexdigest()


@pytest.fixture
def left(cut: Path, tmp_path: Path) -> Path:
    """Return a journal of four seconds that was cut, its log beside it."""
    return shutil.copytree(cut, tmp_path / "left") / "flight-0001.gpkg"


def test_a_journal_that_was_cut_becomes_one_recovered_file(left: Path) -> None:
    assert look_at(left).state == "cut"
    (found,) = recover_folder(left.parent)
    assert (found.outcome, found.is_good) == ("recovered", True)
    assert [file.name for file in left.parent.iterdir()] == [left.name]
    flight = look_at(left)
    assert (flight.state, flight.utc_source) == ("recovered", "autopilot")
    assert flight.duration_s == pytest.approx(4.0, abs=0.1)
    assert not read_journal(left).is_closed
    box = query(left, "SELECT min_y, max_y FROM gpkg_contents WHERE table_name = 'applied'")
    assert box[0][0] is not None
    times = query(left, "SELECT min(time) FROM applied")
    assert str(times[0][0]).startswith("2026-03-21T08:00:00")
    assert recover_folder(left.parent) == []


def test_a_closed_journal_is_not_touched(tmp_path: Path) -> None:
    path = closed_journal(tmp_path)
    before = (path.read_bytes(), path.stat().st_mtime_ns)
    assert recover_folder(tmp_path) == []
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before


def test_an_open_journal_is_left_alone(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup()) as journal:
        found = recover(journal.path)
        assert found is not None
        assert (found.outcome, found.is_good) == ("open", True)
        assert look_at(journal.path).state == "open"
    assert read_journal(journal.path).is_closed


def spoil(path: Path, table: str) -> None:
    """Overwrite the first leaf page of a table."""
    with closing(sqlite3.connect(path)) as connection:
        (page_bytes,) = connection.execute("PRAGMA page_size").fetchone()
        sql = "SELECT pageno FROM dbstat WHERE name = ? AND pagetype = 'leaf' ORDER BY pageno"
        pages = [row[0] for row in connection.execute(sql, (table,))]
    with path.open("r+b") as file:
        file.seek((pages[len(pages) // 2] - 1) * page_bytes)
        file.write(b"\xa5" * page_bytes)


def test_a_damaged_journal_is_kept_and_a_copy_saves_what_can_be_read(left: Path) -> None:
    recover(left)
    spoil(left, "applied")
    with closing(sqlite3.connect(left)) as connection, connection:
        connection.execute("UPDATE meta SET value = 'no' WHERE key = 'closed'")
    whole = left.read_bytes()
    found = recover(left)
    assert found is not None
    assert (found.outcome, found.is_good) == ("salvaged", False)
    assert "not all of applied" in found.text
    assert left.read_bytes() == whole
    copy = read_journal(salvaged_name(left))
    assert sum(entry.is_decision for entry in copy.entries) == 200
    assert look_at(salvaged_name(left)).state == "salvaged"
    rows = query(salvaged_name(left), "SELECT count(*), max(time_s) - min(time_s) FROM applied")
    assert 10 < int(str(rows[0][0])) < 40
    assert recover_folder(left.parent) == []


def test_what_is_no_database_any_more_is_said_and_kept(left: Path) -> None:
    left.with_name(left.name + "-wal").unlink()
    left.write_bytes(b"\x00" * 5000)
    found = recover(left)
    assert found is not None
    assert found.outcome == "failed"
    assert left.read_bytes() == b"\x00" * 5000
    assert [file.name for file in left.parent.iterdir()] == [left.name]


def test_a_log_that_was_left_beside_a_closed_journal_is_folded_in(left: Path) -> None:
    with closing(sqlite3.connect(left)) as connection:
        connection.execute("PRAGMA wal_checkpoint")
        with connection:
            connection.execute("UPDATE meta SET value = 'yes' WHERE key = 'closed'")
        shutil.copytree(left.parent, left.parent.with_name("again"))
    path = left.parent.with_name("again") / left.name
    assert path.with_name(path.name + "-wal").exists()
    recover_folder(path.parent)
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    assert read_journal(path).is_closed
