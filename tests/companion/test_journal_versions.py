"""Old journals stay readable, those of tomorrow are told apart, damage is said and left out."""

from __future__ import annotations

import sqlite3
import zlib
from pathlib import Path

import pytest

from analysis.journals.content import read_entries, read_journal
from analysis.replay import replay
from companion.core.types import Decision, Telemetry
from companion.errors import JournalError
from companion.journal.codec import decode, encode
from companion.journal.journal import Journal
from companion.journal.reader import OtherVersionError, opened
from companion.journal.rows import Block
from tests.builders import setup
from tests.companion.test_journal import INPUTS, change, closed_journal

# A flight of 120 decisions over the plots, written by the program of version 1.
V1 = Path(__file__).resolve().parents[1] / "data/journal/flight-v1.gpkg.zlib"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    path = tmp_path / "flight-0001.gpkg"
    path.write_bytes(zlib.decompress(V1.read_bytes()))
    return path


def test_a_journal_of_version_1_is_read_in_full(old: Path) -> None:
    content = read_journal(old)
    items = list(content.items())
    assert sum(isinstance(item, Decision) for item in items) == 120
    assert len(items) == 409
    assert [event.kind for event in content.events] == ["start", "stop"]
    assert (content.lost, content.is_closed, content.training) == (0, True, "water")
    assert content.setup.boom == setup().boom


def test_a_journal_of_version_1_says_what_it_did_not_write(old: Path) -> None:
    meta = read_journal(old).meta
    assert meta["journal_version"] == "1"
    assert meta["utc_source"] == "computer"
    assert float(meta["utc_offset_s"]) > 1.7e9


def test_a_journal_of_version_1_is_replayed(old: Path) -> None:
    result = replay(old)
    assert (result.inputs, result.decisions, result.is_closed) == (289, 120, True)


def test_some_kinds_are_read_alone_in_both_versions(old: Path, tmp_path: Path) -> None:
    with Journal.create(tmp_path / "new", setup=setup()) as journal:
        for item in INPUTS:
            journal.record_input(item)
    for path, how_many in ((old, 120), (journal.path, 1)):
        with opened(path) as found:
            entries = list(read_entries(found.connection, found.version, kinds={"Telemetry"}))
        assert len(entries) == how_many
        assert all(isinstance(decode(entry.body), Telemetry) for entry in entries)


def test_a_journal_of_tomorrow_gives_what_it_says_of_itself(tmp_path: Path) -> None:
    path = closed_journal(tmp_path)
    change(path, "UPDATE meta SET value = '3' WHERE key = 'journal_version'")
    with pytest.raises(OtherVersionError, match="version 3, this program reads") as refused:
        read_journal(path)
    assert refused.value.meta["map_sha256"] == setup().prescription.sha256


def two_blocks(folder: Path) -> Path:
    """Return a journal of ten inputs in each of two blocks."""
    with Journal.create(folder, setup=setup()) as journal:
        pass
    connection = sqlite3.connect(journal.path)
    try:
        block = Block()
        with connection:
            for sequence in range(1, 21):
                block.add(sequence, float(sequence), encode(INPUTS[3]))
                if sequence == 10:
                    block.insert(connection)
            block.insert(connection)
    finally:
        connection.close()
    return journal.path


DAMAGE = {
    "cut": "UPDATE blocks SET body = substr(body, 1, 40) WHERE first_sequence = 1",
    "garbled": "UPDATE blocks SET body = zeroblob(90) WHERE first_sequence = 1",
    "empty": "UPDATE blocks SET body = NULL WHERE first_sequence = 1",
    "sum": "UPDATE blocks SET crc32 = crc32 + 1 WHERE first_sequence = 1",
    "dictionary": "UPDATE blocks SET dictionary = 77 WHERE first_sequence = 1",
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_damaged_block_is_refused_or_left_out_and_said(case: str, tmp_path: Path) -> None:
    path = two_blocks(tmp_path)
    change(path, DAMAGE[case])
    with pytest.raises(JournalError, match="rows from 1 on"):
        read_journal(path)
    content = read_journal(path, is_lenient=True)
    assert [entry.sequence for entry in content.entries] == list(range(11, 21))
    assert len(content.unread) == 1
    assert content.unread[0].startswith("rows from 1 on (1.000 to 10.000 s)")
    assert content.lost == 10


def test_who_wants_a_sensor_needs_no_decision(tmp_path: Path) -> None:
    path = closed_journal(tmp_path)
    whole = [entry for entry in read_journal(path).entries if not entry.is_decision]
    change(path, "UPDATE blocks SET decisions = zeroblob(90)")
    with opened(path) as found:
        kinds = {entry.kind for entry in whole}
        assert list(read_entries(found.connection, found.version, kinds=kinds)) == whole
    content = read_journal(path, is_lenient=True)
    assert list(content.entries) == whole
    assert all(text.startswith("decisions from ") for text in content.unread)
    assert content.unread
