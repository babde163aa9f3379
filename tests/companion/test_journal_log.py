"""A damaged log is told from one that a cut of power tore at its end."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from analysis.journals.content import read_journal
from analysis.journals.salvage import recover, recover_folder
from companion.cli.app import execute
from companion.cli.record_parts import made_ready
from companion.journal.geopackage import PAGE_BYTES
from companion.journal.journal import open_for_flight
from companion.journal.log import EVENT_KIND, META_KEY, log_damage, log_from
from companion.journal.read_only import kept_log_of, log_of
from tests.bench.journal import crashed
from tests.bench.journal_flight import START_S, example_setup
from tests.companion.test_journal import query

STEP = PAGE_BYTES + 24
SECONDS = 6


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple[int, int]]]:
    """Return the folder of a journal of six seconds that was cut, and where each commit ends."""
    folder = tmp_path_factory.mktemp("made")
    left, ends, _ = crashed(folder, example_setup(), seconds=SECONDS, seed=1)
    return left, ends


@pytest.fixture
def left(made: tuple[Path, list[tuple[int, int]]], tmp_path: Path) -> Path:
    return shutil.copytree(made[0], tmp_path / "left") / "flight-0001.gpkg"


@pytest.fixture
def ends(made: tuple[Path, list[tuple[int, int]]]) -> list[int]:
    return [end for end, _ in made[1]]


Damage = Callable[[bytearray, list[int]], None]


def zeroed(at: int, count: int) -> Damage:
    def damage(log: bytearray, _: list[int]) -> None:
        log[at : at + count] = bytes(count)

    return damage


def within(commit: int, count: int) -> Damage:
    """Zero so much of a transaction, from its second frame on."""

    def damage(log: bytearray, ends: list[int]) -> None:
        begin = ends[commit - 1] + STEP
        log[begin : begin + count] = bytes(count)

    return damage


def cut_in(commit: int) -> Damage:
    def damage(log: bytearray, ends: list[int]) -> None:
        del log[ends[commit - 1] + 2 * STEP + 100 :]

    return damage


def filled_from(commit: int, byte: int) -> Damage:
    """Leave of the log's end what a file system makes of room that was never written."""

    def damage(log: bytearray, ends: list[int]) -> None:
        size = len(log) - ends[commit]
        log[ends[commit] :] = bytes([byte]) * size

    return damage


def flipped(at: int) -> Damage:
    def damage(log: bytearray, _: list[int]) -> None:
        log[at] ^= 0x10

    return damage


# Each with how many of the six seconds are left.
TORN = {
    "whole": (zeroed(0, 0), 6),
    "cut within the last": (cut_in(5), 5),
    "cut earlier": (cut_in(3), 3),
    # Its later pages reached the disk, its commit too, one before them did not.
    "a hole in the last": (within(5, STEP), 5),
    "zeros behind": (filled_from(2, 0), 3),
    "rubbish behind": (filled_from(2, 0xA5), 3),
    "all zeros": (zeroed(0, 10**6), 0),
}
DAMAGED = {
    "a hole": (within(3, 4096), 3, 3),
    "a hole in the last but one": (within(4, STEP), 4, 2),
    "the header": (zeroed(0, 4096), 0, 6),
    "a bit of the header": (flipped(17), 0, 6),
    "a bit of the first page": (flipped(300), 0, 6),
    "a bit of salts": (flipped(32 + 9), 0, 6),
}


def damaged(left: Path, ends: list[int], damage: Damage) -> bytes:
    log = bytearray(log_of(left).read_bytes())
    size = len(log)
    damage(log, ends)
    del log[size:]
    log_of(left).write_bytes(log)
    return bytes(log)


@pytest.mark.parametrize("case", TORN)
def test_a_log_that_a_cut_tore_is_taken_in_silence(case: str, left: Path, ends: list[int]) -> None:
    damage, seconds = TORN[case]
    damaged(left, ends, damage)
    assert log_damage(left) is None
    assert execute(["flights", "recover", "--folder", str(left.parent)]) == 0
    content = read_journal(left)
    assert sum(entry.is_decision for entry in content.entries) == 50 * seconds
    assert META_KEY not in content.meta
    assert [file.name for file in left.parent.iterdir()] == [left.name]


@pytest.mark.parametrize("case", DAMAGED)
def test_what_is_lost_behind_damage_is_said(
    case: str, left: Path, ends: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    damage, seconds, lost_s = DAMAGED[case]
    log = damaged(left, ends, damage)
    assert execute(["flights", "recover", "--folder", str(left.parent)]) == 1
    said = capsys.readouterr().out
    assert "recovered: the log is damaged at byte " in said
    assert f"of {len(log)}: what was committed behind it, at most about {lost_s} s, is lost" in said
    content = read_journal(left)
    assert sum(entry.is_decision for entry in content.entries) == 50 * seconds
    assert content.meta["closed"] == "recovered"
    assert content.meta[META_KEY] in said
    event = content.events[-1]
    assert (event.kind, event.text) == (EVENT_KIND, content.meta[META_KEY])
    assert event.at_s == pytest.approx(START_S + seconds, abs=0.1)
    assert content.lost == 0
    assert kept_log_of(left).read_bytes() == log
    assert recover_folder(left.parent) == []


def test_what_is_lost_is_said_before_the_next_flight_too(left: Path, ends: list[int]) -> None:
    damage, _, lost_s = DAMAGED["a hole"]
    log = damaged(left, ends, damage)
    lines = list(made_ready(left.parent))
    (line,) = (line for line in lines if left.name in line)
    assert "recovered: the log is damaged at byte " in line
    assert f"at most about {lost_s} s, is lost" in line
    assert META_KEY in read_journal(left).meta
    assert kept_log_of(left).read_bytes() == log


def test_the_time_of_the_loss_is_utc(left: Path, ends: list[int]) -> None:
    damaged(left, ends, DAMAGED["a hole"][0])
    found = recover(left)
    assert found is not None
    assert (found.outcome, found.is_whole, found.is_good) == ("recovered", False, False)
    (row,) = query(left, f"SELECT time FROM events WHERE kind = '{EVENT_KIND}'")
    assert str(row[0]).startswith("2026-03-21T08:00:02.9")


def test_a_log_that_is_in_the_file_already_may_be_damaged(left: Path) -> None:
    log = log_of(left).read_bytes()
    with closing(sqlite3.connect(left)) as connection:
        connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
        shutil.copytree(left.parent, left.parent.with_name("again"))
    path = left.parent.with_name("again") / left.name
    log_of(path).write_bytes(bytes(32) + log[32:])
    found = recover(path)
    assert found is not None
    assert (found.outcome, found.is_good) == ("recovered", True)
    content = read_journal(path)
    assert sum(entry.is_decision for entry in content.entries) == 50 * SECONDS
    assert META_KEY not in content.meta
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_what_an_earlier_round_of_the_log_left_behind_is_no_damage(tmp_path: Path) -> None:
    path = tmp_path / "t.gpkg"
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
        connection.execute("CREATE TABLE t (a)")
    log = log_of(path)
    with closing(open_for_flight(path)) as connection:
        for _ in range(30):
            connection.execute("INSERT INTO t VALUES (?)", (b"x" * 700,))
        connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchall()
        before = len(log.read_bytes())
        for _ in range(4):
            connection.execute("INSERT INTO t VALUES (?)", (b"y" * 700,))
        content = log.read_bytes()
    assert len(content) == before
    whole = log_from(content, PAGE_BYTES)
    assert whole.damage_at is None
    assert whole.behind == ()
    assert 4 <= len(whole.counted) < 30
    # The last transaction of the new round is torn: behind it lies only what is old.
    torn = bytearray(content)
    torn[whole.counted[-1].at + 5] ^= 1
    assert log_from(bytes(torn), PAGE_BYTES).damage_at is None
    # An earlier one is damaged: what was committed behind it is found, and nothing old.
    hurt = bytearray(content)
    hurt[whole.counted[0].at + 5] ^= 1
    found = log_from(bytes(hurt), PAGE_BYTES)
    assert found.damage_at == 32
    assert found.behind == whole.counted[1:]


def test_no_log_is_no_damage() -> None:
    for content in (b"", bytes(31), bytes(10_000), b"\xff" * 10_000):
        log = log_from(content, PAGE_BYTES)
        assert (log.damage_at, log.counted, log.behind) == (None, (), ())
