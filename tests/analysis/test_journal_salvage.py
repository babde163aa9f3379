"""What a cut or garbled journal still holds is in its salvaged copy, and nothing else is."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pyogrio
import pytest

from analysis.journals.content import read_journal
from analysis.journals.salvage import recover, salvage
from companion.cli.app import execute
from companion.journal.folder import look_at
from companion.journal.geopackage import PAGE_BYTES
from companion.journal.leaf_page import cells_of, tables_of
from companion.journal.read_only import log_of, salvaged_name
from tests.bench.journal import crashed
from tests.bench.journal_flight import example_setup
from tests.companion.test_journal import change, query

Rows = dict[str, dict[int, tuple[object, ...]]]
# What a salvage says anew of itself.
_NEW = {"closed", "applied_l"}
# Registers, and their extents, are written again.
_TABLES = ("applied", "valve_changes", "blocks", "events", "zones", "field", "meta", "link_stats")


def rows_of(path: Path) -> Rows:
    found: Rows = {}
    with closing(sqlite3.connect(path)) as connection:
        for table in _TABLES:
            rows = connection.execute(f"SELECT rowid, * FROM {table}").fetchall()
            found[table] = {row[0]: row[1:] for row in rows if row[2] not in _NEW}
    return found


def in_leaves(path: Path) -> dict[str, set[int]]:
    """Return the numbers of the rows of all whole leaves in a file that go on nowhere else."""
    found: dict[str, set[int]] = {table: set() for table in _TABLES}
    raw = path.read_bytes()
    for at in range(0, len(raw) - PAGE_BYTES + 1, PAGE_BYTES):
        try:
            cells = cells_of(raw[at : at + PAGE_BYTES], PAGE_BYTES)
        except ValueError:
            continue
        for table in tables_of(cells) & found.keys():
            found[table] |= {cell.rowid for cell in cells if cell.overflow_page is None}
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a closed journal of twelve seconds with six valves."""
    folder = tmp_path_factory.mktemp("whole")
    left = crashed(folder, example_setup(), seconds=12, seed=1)[0] / "flight-0001.gpkg"
    recover(left)
    change(left, "UPDATE meta SET value = 'yes' WHERE key = 'closed'")
    return left


@pytest.fixture
def path(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(whole, tmp_path))


def spoil(path: Path, at: int, count: int) -> None:
    raw = bytearray(path.read_bytes())
    raw[at : at + count] = bytes(count)
    path.write_bytes(raw)


def salvaged(path: Path, whole: Path) -> Rows:
    """Salvage, and check what holds of every damage; return the rows of the copy."""
    before = path.read_bytes()
    found = recover(path)
    assert found is not None
    assert found.outcome == "salvaged", found
    assert path.read_bytes() == before
    copy = salvaged_name(path)
    assert {file.name for file in path.parent.iterdir()} == {path.name, copy.name}
    assert query(copy, "PRAGMA quick_check") == [("ok",)]
    return rows_of(copy)


@pytest.mark.parametrize("kept", [0.55, 0.7, 0.9, 0.999])
def test_of_a_cut_journal_every_whole_leaf_is_in_the_copy(
    kept: float, path: Path, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = int(path.stat().st_size * kept)
    path.write_bytes(path.read_bytes()[:size])
    rows, told = salvaged(path, whole), rows_of(whole)
    for table, numbers in in_leaves(path).items():
        assert numbers & told[table].keys() <= rows[table].keys(), table
        # And not one that the flight did not have, of the row that the cut went through too.
        assert rows[table].items() <= told[table].items(), table
    assert len(rows["valve_changes"]) > 0
    assert len(rows["applied"]) > 0
    assert "applied" in {name for name, _ in pyogrio.list_layers(salvaged_name(path))}
    assert look_at(salvaged_name(path)).state == "salvaged"
    assert execute(["flights", "recover", "--folder", str(path.parent)]) == 0
    capsys.readouterr()


def test_a_row_that_the_cut_went_through_is_left_out(path: Path, whole: Path) -> None:
    sql = "SELECT max(pageno) FROM dbstat WHERE name = 'applied' AND pagetype = 'leaf'"
    page = int(str(query(path, sql)[0][0]))
    path.write_bytes(path.read_bytes()[: page * PAGE_BYTES - 200])
    rows, told = salvaged(path, whole)["applied"], rows_of(whole)["applied"]
    assert rows.items() <= told.items()
    assert 0 < len(told) - len(rows) < 10


@pytest.mark.parametrize("cut_bytes", [5, 500, PAGE_BYTES - 1])
def test_a_row_that_goes_on_in_the_page_that_was_cut_is_left_out(
    cut_bytes: int, path: Path, whole: Path
) -> None:
    sql = "SELECT max(pageno) FROM dbstat WHERE name = 'blocks' AND pagetype = 'overflow'"
    page = int(str(query(path, sql)[0][0]))
    path.write_bytes(path.read_bytes()[: page * PAGE_BYTES - cut_bytes])
    rows, told = salvaged(path, whole)["blocks"], rows_of(whole)["blocks"]
    assert rows.items() <= told.items()
    assert len(rows) > 0


def root_of(path: Path, table: str) -> int:
    return int(str(query(path, f"SELECT rootpage FROM sqlite_master WHERE name = '{table}'")[0][0]))


def test_rows_that_nothing_leads_to_are_counted_and_said(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(path, (root_of(path, "valve_changes") - 1) * PAGE_BYTES, PAGE_BYTES)
    change(path, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    assert execute(["flights", "recover", "--folder", str(path.parent), "--json"]) == 1
    (told,) = json.loads(capsys.readouterr().out)["journals"]
    count = query(salvaged_name(path), "SELECT count(*) FROM valve_changes")[0][0]
    sql = "SELECT value FROM meta WHERE key = 'rows_valve_changes'"
    assert str(count) == query(path, sql)[0][0]
    assert f"from pages that nothing leads to: valve_changes {count}" in told["text"]
    assert told["text"].endswith("; not all of valve_changes")


def test_the_litres_of_a_part_are_those_of_the_part(path: Path, whole: Path) -> None:
    told_l = look_at(path).applied_l
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    salvage(path)
    part_l = look_at(salvaged_name(path)).applied_l
    assert told_l is not None
    assert part_l is not None
    assert 0.0 < part_l < 0.8 * told_l
    # How many rows the flight had is left as it was: what is missing is seen by it.
    sql = "SELECT value FROM meta WHERE key = 'rows_applied'"
    assert query(salvaged_name(path), sql) == query(whole, sql)


@pytest.mark.parametrize("table", ["applied", "valve_changes", "blocks", "sqlite_schema", "head"])
def test_without_the_root_of_its_tree_a_table_is_whole_again(
    table: str, path: Path, whole: Path
) -> None:
    # Of the first page the list of tables alone, or the head too.
    page = 1 if table in ("head", "sqlite_schema") else root_of(path, table)
    begin = 100 if table == "sqlite_schema" else (page - 1) * PAGE_BYTES
    spoil(path, begin, page * PAGE_BYTES - begin)
    salvage(path)
    assert rows_of(salvaged_name(path)) == rows_of(whole)
    assert [e.body for e in read_journal(salvaged_name(path)).entries] == [
        e.body for e in read_journal(whole).entries
    ]
    layers = dict(pyogrio.list_layers(salvaged_name(path)))
    assert layers["applied"] == "Point"
    assert {"zones", "field"} <= layers.keys()
    assert all(
        pyogrio.read_info(salvaged_name(path), layer=name)["crs"]
        == pyogrio.read_info(whole, layer=name)["crs"]
        for name in ("applied", "zones", "field")
    )


def test_pages_that_were_given_up_bring_nothing_back(path: Path, whole: Path) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("PRAGMA secure_delete = OFF")
        connection.execute("DELETE FROM valve_changes WHERE id > 20")
    assert int(str(query(path, "PRAGMA freelist_count")[0][0])) > 3
    left = rows_of(path)["valve_changes"]
    spoil(path, (root_of(path, "valve_changes") - 1) * PAGE_BYTES, PAGE_BYTES)
    salvage(path)
    assert rows_of(salvaged_name(path))["valve_changes"].items() <= left.items()


def test_what_the_flight_says_of_itself_may_be_gone(path: Path, whole: Path) -> None:
    spoil(path, (root_of(path, "meta") - 1) * PAGE_BYTES, PAGE_BYTES)
    found, told = salvaged(path, whole), rows_of(whole)
    assert found["applied"] == told["applied"]
    assert found["blocks"] == told["blocks"]
    sql = "SELECT value FROM meta WHERE key = 'journal_version'"
    assert query(salvaged_name(path), sql) == [("2",)]


def test_a_tree_that_leads_past_a_leaf_hides_no_rows(path: Path, whole: Path) -> None:
    # The older version of a page: what came to it later is not in it, and SQLite sees no damage.
    sql = "SELECT pageno FROM dbstat WHERE name = 'applied' AND pagetype = 'leaf' ORDER BY path"
    first, second = [int(str(row[0])) for row in query(path, sql)][3:5]
    raw = bytearray(path.read_bytes())
    root = root_of(path, "applied")
    begin = (root - 1) * PAGE_BYTES
    at = raw.index(second.to_bytes(4, "big"), begin, begin + PAGE_BYTES)
    raw[at : at + 4] = first.to_bytes(4, "big")
    path.write_bytes(raw)
    change(path, "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    assert salvaged(path, whole)["applied"] == rows_of(whole)["applied"]


def test_pages_of_the_log_count_where_the_file_is_damaged(tmp_path: Path) -> None:
    left = crashed(tmp_path, example_setup(), seconds=6, seed=1)[0] / "flight-0001.gpkg"
    good = Path(shutil.copytree(left.parent, tmp_path / "good")) / left.name
    recover(good)
    raw = left.read_bytes()
    left.write_bytes(b"\xa5" * PAGE_BYTES + raw[PAGE_BYTES:])
    with log_of(left).open("r+b") as log:
        log.write(bytes(32))  # SQLite reads nothing of it now
    salvage(left)
    found, told = rows_of(salvaged_name(left)), rows_of(good)
    for table in ("valve_changes", "zones", "field", "blocks"):
        assert len(found[table]) >= len(told[table]) - 8, table
    assert len(told["valve_changes"]) > 40


@pytest.mark.parametrize("seed", range(12))
def test_whatever_is_damaged_a_copy_is_sound_or_there_is_none(
    seed: int, path: Path, whole: Path
) -> None:
    chance, raw = random.Random(seed), bytearray(path.read_bytes())
    pages = len(raw) // PAGE_BYTES
    for _ in range(chance.choice((3, 40))):
        at, other = (PAGE_BYTES * chance.randrange(pages) for _ in "ab")
        kind = seed % 4
        if kind == 0:  # a page in another's place
            raw[at : at + PAGE_BYTES] = whole.read_bytes()[other : other + PAGE_BYTES]
        elif kind == 1:
            raw[at : at + PAGE_BYTES] = chance.randbytes(PAGE_BYTES)
        else:
            for _ in range(20):
                raw[chance.randrange(0 if kind == 2 else at, len(raw))] = chance.randrange(256)
    path.write_bytes(raw)
    found = recover(path)
    assert path.read_bytes() == raw
    if found is None or found.outcome == "failed":
        assert not salvaged_name(path).exists()
        return
    assert "\n" not in found.text
    copy = salvaged_name(path)
    if copy.exists():
        assert query(copy, "PRAGMA quick_check") == [("ok",)]
        assert look_at(copy).path == copy
    if kind == 1:
        told = rows_of(whole)
        for table in ("applied", "valve_changes", "events"):
            assert rows_of(copy)[table].items() <= told[table].items()
