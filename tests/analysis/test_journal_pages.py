"""Leaf pages read without SQLite: what it finds is what SQLite wrote; of anything else nothing."""

from __future__ import annotations

import random
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.journals.stray_rows import kept_pages, stray_rows
from companion.journal.geopackage import PAGE_BYTES, SCHEMA
from companion.journal.leaf_page import (
    COLUMNS,
    cells_of,
    local_bytes,
    tables_of,
    values_of,
    varint,
    width,
)
from tests.companion.test_journal import closed_journal

VALUES = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False),
    st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\x00"), max_size=40),
    st.binary(max_size=40),
    st.integers(900, 5000).map(lambda size: b"\x5a" * size),
)
ROWS = st.lists(st.tuples(VALUES, VALUES, VALUES), min_size=1, max_size=30)
NUMBERS = st.lists(st.integers(-(2**62), 2**62), min_size=30, max_size=30, unique=True)


def pages_of(connection: sqlite3.Connection) -> list[bytes]:
    image = connection.serialize()
    return [image[at : at + PAGE_BYTES] for at in range(0, len(image), PAGE_BYTES)]


@given(ROWS, NUMBERS)
def test_every_row_of_every_leaf_is_what_sqlite_gives(
    rows: list[tuple[object, ...]], numbers: list[int]
) -> None:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
        connection.execute("CREATE TABLE t (k INTEGER PRIMARY KEY, a, b, c)")
        for number, row in zip(numbers, rows, strict=False):
            connection.execute("INSERT INTO t VALUES (?, ?, ?, ?)", (number, *row))
        told = {row[0]: row[1:] for row in connection.execute("SELECT * FROM t")}
        pages = pages_of(connection)
    found = {}
    for page in pages[1:]:
        try:
            cells = cells_of(page, PAGE_BYTES)
        except ValueError:
            continue
        for cell in cells:
            values = values_of(cell, lambda number: pages[number - 1], PAGE_BYTES)
            found[cell.rowid] = tuple(values[1:])
    # A whole number may be kept as an integer; SQLite makes a float of it by the column's type.
    assert found == told
    assert {type(v) for row in found.values() for v in row} <= {
        type(v) for row in told.values() for v in row
    }


@pytest.mark.parametrize("number", [0, 127, 128, 2**32, 2**56 - 1, 2**56, 2**63 - 1, -1, -(2**63)])
def test_integers_of_every_length(number: int) -> None:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute("CREATE TABLE t (k INTEGER PRIMARY KEY)")
        connection.execute("INSERT INTO t VALUES (?)", (number,))
        image = connection.serialize()
    (cell,) = cells_of(image[4096:8192], 4096)
    assert cell.rowid == number


def test_what_is_cut_off_is_an_error() -> None:
    for data in (b"", b"\x80", b"\xff" * 8):
        with pytest.raises(ValueError, match="cut off"):
            varint(data, 0)
    for kind in (10, 11, -1):
        with pytest.raises(ValueError, match="no type"):
            width(kind)
    assert local_bytes(10**15, PAGE_BYTES) <= PAGE_BYTES - 35


@given(st.binary(max_size=PAGE_BYTES))
def test_anything_else_is_refused_or_gives_rows_within_the_page(data: bytes) -> None:
    for page in (data, b"\x0d" + data, (b"\x0d" + data).ljust(PAGE_BYTES, b"\x00")[:PAGE_BYTES]):
        try:
            cells = cells_of(page, PAGE_BYTES)
        except ValueError:
            continue
        for cell in cells:
            assert cell.end <= PAGE_BYTES
            assert len(cell.local) <= cell.size


def test_damage_to_a_leaf_never_brings_rows_out_of_order(tmp_path: Path) -> None:
    path, chance = closed_journal(tmp_path, 200), random.Random(1)
    raw = path.read_bytes()
    leaves = 0
    for at in range(PAGE_BYTES, len(raw), PAGE_BYTES):
        page = bytearray(raw[at : at + PAGE_BYTES])
        for _ in range(5):
            page[chance.randrange(len(page))] = chance.randrange(256)
            try:
                numbers = [cell.rowid for cell in cells_of(bytes(page), PAGE_BYTES)]
            except ValueError:
                continue
            leaves += 1
            assert numbers == sorted(set(numbers))
    assert leaves > 50


def test_the_columns_are_those_of_the_tables() -> None:
    with closing(sqlite3.connect(":memory:")) as connection:
        connection.executescript(SCHEMA)
        for table in COLUMNS.keys() - {"cells"}:
            told = connection.execute(f"PRAGMA table_info({table})").fetchall()
            assert len(told) == len(COLUMNS[table]), table
            for (_, _, declared, is_needed, _, is_key), column in zip(
                told, COLUMNS[table], strict=True
            ):
                letter = (
                    "k"
                    if is_key
                    else {"INTEGER": "i", "DOUBLE": "r", "BLOB": "b"}.get(
                        declared, "b" if declared in ("POINT", "GEOMETRY") else "t"
                    )
                )
                assert column.lower() == letter, (table, declared)
                assert is_key or not is_needed or column.isupper(), table


def test_all_rows_of_a_journal_are_found_without_its_trees(tmp_path: Path) -> None:
    path = closed_journal(tmp_path, 400)
    with closing(sqlite3.connect(path)) as connection:
        told = {
            table: {row[0]: row for row in connection.execute(f"SELECT * FROM {table}")}
            for table in COLUMNS.keys() - {"cells"}
        }
    with kept_pages(path) as pages:
        found = stray_rows(pages, {table: set() for table in COLUMNS})
    for table, rows in told.items():
        mine = {row[0]: row for name, row in found if name == table}
        assert mine == rows, table
    assert len(told["applied"]) > 50
    with kept_pages(path) as pages:
        assert stray_rows(pages, {table: set(rows) for table, rows in told.items()}) == []


def test_a_leaf_of_two_kinds_of_rows_is_of_no_table() -> None:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
        connection.execute("CREATE TABLE t (k INTEGER PRIMARY KEY, a, b, c, d)")
        connection.execute("INSERT INTO t VALUES (1, 5, 6, 0, 1000)")
        assert tables_of(cells_of(pages_of(connection)[1], PAGE_BYTES)) == {"valve_changes"}
        connection.execute("INSERT INTO t VALUES (2, 'now', 6.5, 'clock', 'text')")
        assert tables_of(cells_of(pages_of(connection)[1], PAGE_BYTES)) == set()


def with_setup(path: Path) -> tuple[bytearray, list[int]]:
    """Return a journal with a row of `meta` that goes on in other pages, and where these lie."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.executescript(SCHEMA)
        connection.execute("INSERT INTO meta (key, value) VALUES ('setup', ?)", ("x" * 9000,))
    raw = bytearray(path.read_bytes())
    chain = [at for at in range(0, len(raw), PAGE_BYTES) if raw[at + 4 : at + 84] == b"x" * 80]
    assert len(chain) > 5
    return raw, chain


@pytest.mark.parametrize(("link", "to"), [(-1, 3), (2, 0), (2, 10**6), (3, -1)])
def test_a_row_whose_chain_of_pages_is_not_its_own_is_left_out(
    link: int, to: int, tmp_path: Path
) -> None:
    path = tmp_path / "flight-0001.gpkg"
    raw, chain = with_setup(path)
    with kept_pages(path) as pages:
        assert len(stray_rows(pages, {"meta": set()})) == 1
    number = chain[0] // PAGE_BYTES + 1 if to < 0 else to
    raw[chain[link] : chain[link] + 4] = number.to_bytes(4, "big")
    path.write_bytes(raw)
    with kept_pages(path) as pages:
        assert stray_rows(pages, {"meta": set()}) == []


def test_a_row_that_claims_to_be_endless_ends(tmp_path: Path) -> None:
    path = tmp_path / "flight-0001.gpkg"
    raw, chain = with_setup(path)
    size = 2**60
    text = size - len(b"key")
    types = bytes([0, 2 * 3 + 13]) + long_varint(2 * text + 13)
    head = len(types) + 1
    local = (bytes([head]) + types + b"key").ljust(local_bytes(head + size, PAGE_BYTES), b"x")
    cell = long_varint(head + size) + b"\x01" + local + (chain[0] // PAGE_BYTES + 1).to_bytes(4)
    start = PAGE_BYTES - len(cell)
    page = (b"\x0d\0\0" + b"\0\x01" + start.to_bytes(2) + b"\0" + start.to_bytes(2)).ljust(start)
    for at in chain:
        raw[at : at + 4] = (chain[0] // PAGE_BYTES + 1).to_bytes(4, "big")
    raw += page + cell
    path.write_bytes(raw)
    (found,) = cells_of(bytes(raw[-PAGE_BYTES:]), PAGE_BYTES)
    assert (found.size, tables_of([found])) == (head + size, {"meta"})
    with kept_pages(path) as pages:
        assert stray_rows(pages, {"meta": set()}) == []


def long_varint(number: int) -> bytes:
    """Return an integer of more than 56 bits as SQLite writes it: nine bytes."""
    return bytes(0x80 | number >> shift & 0x7F for shift in range(57, 7, -7)) + bytes(
        [number & 0xFF]
    )


def test_rows_of_another_time_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "flight-0001.gpkg"
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.executescript(SCHEMA)
        for number in range(1, 60):
            connection.execute(
                "INSERT INTO valve_changes VALUES (?, ?, ?, ?, ?)",
                (number, None, 35_000_000_000 + number, 0, 500 if number % 2 else 0),
            )
        connection.execute("INSERT INTO events VALUES (1, NULL, 35001.5, 'mode', 'AUTO')")
        connection.execute("INSERT INTO events VALUES (2, NULL, 1.5e9, 'mode', 'AUTO')")
        connection.execute("INSERT INTO valve_changes VALUES (99, NULL, 35000000099, 0, 1001)")
    with kept_pages(path) as pages:
        found = stray_rows(pages, {table: set() for table in ("valve_changes", "events")})
    assert sorted(row[0] for table, row in found if table == "events") == [1]
    assert sorted(row[0] for table, row in found if table == "valve_changes") == [*range(1, 60)]
