"""Missing and damaged rows of a journal: never more spray than there was, never without a word."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from analysis.evaluation import evaluate
from analysis.flown.applied_flight import AppliedFlight
from analysis.flown.applied_record import record_of
from analysis.flown.holes import Hole, change_holes, closed_over, doubtful_holes, sample_holes
from analysis.flown.read_applied import clock_offset_s, rates_of, read_applied, rows_of
from companion.errors import JournalError, VrsprayError
from tests.analysis.applied_flights import changes_of
from tests.analysis.export_flight import fly

INF = float("inf")


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("holes"))


@pytest.fixture
def damaged(journal: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Return a copy of the journal after a statement of SQL."""

    def changed(sql: str) -> Path:
        path = tmp_path / "flight-0001.gpkg"
        path.write_bytes(journal.read_bytes())
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.executescript(sql)
        return path

    return changed


def litres(flight: AppliedFlight) -> float:
    return float(record_of(flight).volume_ml[-1].sum()) / 1000.0


def test_a_sound_journal_has_no_holes(journal: Path) -> None:
    unread: list[str] = []
    flight = read_applied(journal, unread=unread)
    assert (unread, flight.lost, flight.is_closed) == ([], 0, True)
    assert not any("unread" in reasons for reasons in flight.inhibits)
    assert litres(flight) == litres(read_applied(journal)) > 0.0


def test_no_page_of_zeros_makes_spray(journal: Path, tmp_path: Path) -> None:
    """Every page that a table begins or goes on in, and every seventh of the others."""
    sound_l = litres(read_applied(journal))
    content = journal.read_bytes()
    (size,) = struct.unpack(">H", content[16:18])
    path = tmp_path / "flight-0001.gpkg"
    told = refused = 0
    for page in range(1, len(content) // size, 7):
        path.write_bytes(content[: page * size] + bytes(size) + content[(page + 1) * size :])
        unread: list[str] = []
        try:
            flight = read_applied(path, unread=unread)
            found_l = litres(flight)
        except VrsprayError:
            refused += 1
            continue
        assert found_l <= 1.01 * sound_l
        told += bool(unread)
        assert unread or flight.lost or found_l == sound_l
    assert told > 0
    assert refused + told > 3


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM valve_changes WHERE id > (SELECT max(id) / 2 FROM valve_changes)",
        "DELETE FROM valve_changes WHERE id < (SELECT max(id) / 2 FROM valve_changes)",
        "DELETE FROM valve_changes WHERE id % 40 > 20",
        "DELETE FROM valve_changes",
        "DELETE FROM applied WHERE sequence > (SELECT max(sequence) / 2 FROM applied)",
        "DELETE FROM applied WHERE sequence < (SELECT max(sequence) / 2 FROM applied)",
        "DELETE FROM applied WHERE sequence % 400 > 200",
    ],
)
def test_missing_rows_are_noticed_and_make_no_spray(
    sql: str, journal: Path, damaged: Callable[[str], Path]
) -> None:
    unread: list[str] = []
    flight = read_applied(damaged(sql), unread=unread)
    assert flight.lost > 0
    assert any("no spray is counted there" in each for each in unread)
    assert litres(flight) < 0.999 * litres(read_applied(journal))


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM valve_changes WHERE id > (SELECT max(id) / 2 FROM valve_changes)",
        "DELETE FROM valve_changes WHERE id < (SELECT max(id) / 2 FROM valve_changes)",
        "DELETE FROM valve_changes WHERE id % 40 > 20",
        "DELETE FROM applied WHERE sequence % 400 > 300",
    ],
)
def test_missing_rows_make_no_lag_and_no_missed_change(
    sql: str, journal: Path, damaged: Callable[[str], Path]
) -> None:
    sound = evaluate(record_of(read_applied(journal)))
    record = record_of(read_applied(damaged(sql)))
    found = evaluate(record)
    assert record.unknown
    assert record_of(read_applied(journal)).unknown == ()
    assert found.missed <= sound.missed
    worst, sound_worst = found.lag_distance_m, sound.lag_distance_m
    assert sound_worst is not None
    assert worst is None or worst.max_abs <= sound_worst.max_abs + 0.01


@pytest.mark.parametrize(
    "sql",
    [
        "UPDATE valve_changes SET valve = 77 WHERE id = 5",
        "UPDATE valve_changes SET valve = NULL WHERE id = 5",
        "UPDATE valve_changes SET duty_permille = 'much' WHERE id = 5",
        "UPDATE valve_changes SET planned_us = x'00', actual_us = NULL WHERE id = 5",
        "UPDATE applied SET speed_m_s = 'fast' WHERE sequence > 50",
        "UPDATE applied SET valve_rates_l_ha = '[' WHERE sequence > 9",
        "UPDATE applied SET geom = x'0102' WHERE sequence = (SELECT max(sequence) FROM applied)",
        "UPDATE events SET time_s = 'noon'",
    ],
)
def test_a_row_that_is_none_is_left_out_and_counted(
    sql: str, damaged: Callable[[str], Path]
) -> None:
    path = damaged("INSERT INTO events (time_s, kind, text) VALUES (1, 'x', 'y');" + sql)
    with pytest.raises(JournalError, match="no such thing"):
        read_applied(path)
    unread: list[str] = []
    read_applied(path, unread=unread)
    assert any("no such thing" in each for each in unread)


def test_text_that_is_no_utf_8_does_not_end_the_table(damaged: Callable[[str], Path]) -> None:
    path = damaged("INSERT INTO events (time_s, kind, text) VALUES (1, 'x', CAST(x'ff41' AS TEXT))")
    flight = read_applied(path, unread=[])
    assert flight.events[-1].text == "\ufffdA"


def test_a_table_is_read_on_behind_a_bad_page(tmp_path: Path) -> None:
    path = tmp_path / "table.db"
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("PRAGMA page_size = 512")
        connection.execute("CREATE TABLE t (id INTEGER PRIMARY KEY, text TEXT)")
        connection.executemany(
            "INSERT INTO t VALUES (?, ?)", ((i, "x" * 40) for i in range(1, 999))
        )
    content = bytearray(path.read_bytes())
    content[20 * 512 : 21 * 512] = bytes(512)
    path.write_bytes(content)
    unread: list[str] = []
    with closing(sqlite3.connect(path)) as connection:
        found = rows_of(connection, "t", "text", key="id", unread=unread, what="rows")
        with pytest.raises(sqlite3.DatabaseError):
            rows_of(connection, "t", "text", key="id", unread=None, what="rows")
    numbers = [row[0] for row in found.rows]
    assert found.reaches_end
    assert numbers == sorted(set(numbers))
    assert 970 < len(numbers) < 998
    assert numbers[-1] == 998
    assert len(unread) == 1


def test_holes_in_changes_lie_between_the_numbers() -> None:
    at_s = np.array([1.0, 2.0, 5.0])
    found = change_holes(np.array([1, 2, 9]), at_s, 11, reaches_end=True)
    assert found == [Hole(2.0, 5.0, 6), Hole(5.0, INF, 2)]
    assert change_holes(np.array([1, 2, 3]), at_s, 0, reaches_end=True) == []
    assert change_holes(np.array([4, 5, 6]), at_s, 0, reaches_end=True) == [Hole(-INF, 1.0, 3)]
    assert change_holes(np.array([1, 2, 3]), at_s, 3, reaches_end=False) == [Hole(5.0, INF, 0)]
    many = np.arange(1, 900, 2)
    assert len(change_holes(many, many * 1.0, 0, reaches_end=True)) == 1


def test_a_computer_that_stood_still_is_no_hole() -> None:
    time_s = np.array([0.0, 0.1, 3.0, 3.1])
    assert sample_holes(np.array([1, 5, 8, 12]), time_s) == []
    assert sample_holes(np.array([1, 5, 90, 95]), time_s) == [Hole(0.1, 3.0, 0)]
    ends = [(1.0, -2.0), (200.0, 5.0)]
    found = sample_holes(np.array([50, 55, 58, 62]), time_s, ends)
    assert found == [Hole(-INF, 0.0, 0), Hole(3.1, INF, 0)]


def test_valves_are_closed_over_a_hole_and_open_behind_it_as_known() -> None:
    changes = changes_of([(1.0, 0, 0.5), (1.0, 1, 0.4), (3.0, 1, 0.0), (6.0, 0, 0.7)])
    samples = closed_over(changes, [Hole(2.0, 4.0, 0)], [])
    rows = list(zip(samples.planned_s, samples.valve, samples.duty, strict=True))
    assert rows == [
        (1.0, 0, 0.5), (1.0, 1, 0.4), (2.0, 0, 0.0), (2.0, 1, 0.0), (4.0, 0, 0.5), (6.0, 0, 0.7),
    ]  # fmt: skip
    missing = closed_over(changes, [], [Hole(2.0, 4.0, 0)])
    assert (4.0, 0, 0.5) not in set(
        zip(missing.planned_s, missing.valve, missing.duty, strict=True)
    )
    assert missing.duty[-1] == 0.7


def test_valves_that_stay_open_where_nothing_flows_are_a_hole() -> None:
    time_s = np.arange(0.0, 10.0, 0.1)
    changes = changes_of([(1.0, 0, 0.5)])
    flow = np.where((time_s >= 1.0) & (time_s < 5.0), 0.3, 0.0)
    assert doubtful_holes(changes, time_s, flow)[0] == Hole(1.0, INF, 0)
    steady = np.where(time_s >= 1.0, 0.3, 0.0)
    assert doubtful_holes(changes, time_s, steady) == []
    assert doubtful_holes(changes_of([]), time_s, steady) == [Hole(-INF, INF, 0)]


def test_the_time_in_utc_must_be_one() -> None:
    assert clock_offset_s("1.7e9", [], "f", None) == 1.7e9
    unread: list[str] = []
    assert clock_offset_s("nan", ["1.6e9"], "f", unread) == 1.6e9
    assert len(unread) == 1
    for given in ("nan", "-1e12", "inf", "x", None):
        with pytest.raises(JournalError, match="time in UTC"):
            clock_offset_s(given, ["1.6e9"], "f", None)


@pytest.mark.parametrize("text", ["[", '["x"]', "[1, 2, 3]", "{}", b"x", "[true]"])
def test_rates_that_are_none(text: object) -> None:
    assert rates_of(text, 2) is None
