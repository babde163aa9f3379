"""Journals made to harm who opens them: the right data or one line, and nothing of them is run."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest

from analysis.flown.read_applied import read_applied
from analysis.journals.content import read_journal
from analysis.journals.salvage import recover, salvage
from companion.cli.app import execute
from companion.errors import VrsprayError
from companion.journal.continuing import is_journal, read_treated_ground
from companion.journal.folder import look_at
from companion.journal.geopackage import PAGE_BYTES
from companion.journal.read_only import distrust, known_tables, salvaged_name
from tests.bench.journal import crashed
from tests.bench.journal_flight import example_setup

ENDLESS = "WITH RECURSIVE c(x) AS (VALUES(1) UNION ALL SELECT x + 1 FROM c) SELECT x FROM c"
PRECIOUS = "precious"
_ROLLBACK_MAGIC = bytes.fromhex("d9d505f920a163d7")


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a journal without a log whose flight did not end: `recover` writes into it."""
    folder = tmp_path_factory.mktemp("cut")
    left = crashed(folder, example_setup(), seconds=4, seed=1)[0] / "flight-0001.gpkg"
    recover(left)
    with closing(sqlite3.connect(left)) as connection, connection:
        connection.execute("UPDATE meta SET value = 'no' WHERE key = 'closed'")
    return left


@pytest.fixture
def path(cut: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "flights"
    folder.mkdir()
    (tmp_path / PRECIOUS).write_text("not to be touched")
    return Path(shutil.copy(cut, folder))


def run(path: Path, script: str) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.executescript(script)


def listed(path: Path, sql: str, name: str = "evil", kind: str = "table") -> None:
    """Write any text into the file's list of tables."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute(
            "INSERT INTO sqlite_master VALUES (?, ?, ?, 0, ?)", (kind, name, name, sql)
        )


def said(path: Path, name: str, sql: str) -> None:
    """Say something else of a table that is there."""
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = ? WHERE name = ?", (sql, name))


def attach(path: Path) -> None:
    listed(path, f"ATTACH DATABASE '{path.parent.parent / 'attached'}' AS other")


def pragma(path: Path) -> None:
    listed(path, "PRAGMA temp_store_directory = '/'")


def vacuum(path: Path) -> None:
    listed(path, f"VACUUM INTO '{path.parent.parent / 'vacuumed'}'")


def table_of_a_query(path: Path) -> None:
    listed(path, f"CREATE TABLE evil AS {ENDLESS}")


def known_table_of_a_query(path: Path) -> None:
    said(path, "link_stats", f"CREATE TABLE link_stats AS {ENDLESS}")


def virtual_table(path: Path) -> None:
    run(path, "CREATE VIRTUAL TABLE evil USING fts5(a)")


def virtual_meta(path: Path) -> None:
    said(path, "events", "CREATE VIRTUAL TABLE events USING fts5(a, content='meta')")


def view_over(name: str) -> Callable[[Path], None]:
    def made(path: Path) -> None:
        columns = {"meta": "x AS id, 'k' AS key, 'v' AS value"}.get(name, "x AS id, x AS sequence")
        sql = f"CREATE VIEW {name} AS SELECT {columns} FROM ({ENDLESS})"
        run(path, f"ALTER TABLE {name} RENAME TO was_{name}; {sql}")

    return made


def view_that_lies(path: Path) -> None:
    said(path, "applied", f"CREATE VIEW applied AS {ENDLESS}")


def trigger(path: Path) -> None:
    for name in ("meta", "gpkg_contents", "applied", "events"):
        body = f"INSERT INTO events (kind, text) SELECT 'evil', x FROM ({ENDLESS} LIMIT 5)"
        for event in ("INSERT", "UPDATE"):
            run(path, f"CREATE TRIGGER t_{name}_{event} AFTER {event} ON {name} BEGIN {body}; END")


def endless_trigger(path: Path) -> None:
    body = f"DELETE FROM blocks WHERE first_sequence IN ({ENDLESS})"
    run(path, f"CREATE TRIGGER evil BEFORE INSERT ON meta BEGIN {body}; END")


def computed_column(path: Path) -> None:
    run(path, "ALTER TABLE meta ADD COLUMN evil AS (hex(zeroblob(100000000)))")


def check_constraint(path: Path) -> None:
    text = (
        "CREATE TABLE meta (id INTEGER PRIMARY KEY NOT NULL, key TEXT NOT NULL UNIQUE, value TEXT, "
        "CHECK (length(hex(zeroblob(400000000))) > 0))"
    )
    said(path, "meta", text)


def index_on_an_expression(path: Path) -> None:
    run(path, "CREATE INDEX evil ON meta (length(hex(zeroblob(id * 100))))")


def default_of_a_column(path: Path) -> None:
    run(path, "ALTER TABLE meta ADD COLUMN evil TEXT DEFAULT 'x'")
    said(
        path,
        "meta",
        "CREATE TABLE meta (id INTEGER PRIMARY KEY NOT NULL, key TEXT NOT NULL UNIQUE, value TEXT, "
        "evil DEFAULT (hex(zeroblob(400000000))))",
    )


def huge_value(path: Path) -> None:
    run(path, "UPDATE blocks SET body = zeroblob(3000000) WHERE first_sequence = 1")


def rollback_file_with_another_name(path: Path) -> None:
    """Beside the journal: a rollback file that is done once the file it names is deleted."""
    other = os.fsencode(path.parent.parent / PRECIOUS)
    pages = path.stat().st_size // PAGE_BYTES
    head = _ROLLBACK_MAGIC + struct.pack(">IIIII", 0, 0, pages, 512, PAGE_BYTES)
    tail = struct.pack(">I", 1 + (1 << 30) // PAGE_BYTES) + other
    tail += struct.pack(">II", len(other), sum(other)) + _ROLLBACK_MAGIC
    path.with_name(path.name + "-journal").write_bytes(head.ljust(512, b"\0") + tail)


def side(name: str, kind: str) -> Callable[[Path], None]:
    def made(path: Path) -> None:
        file = path.with_name(path.name + name)
        if kind == "link":
            file.symlink_to(path.parent.parent / PRECIOUS)
        elif kind == "fifo":
            os.mkfifo(file)
        else:
            file.mkdir()

    return made


def link_to_elsewhere(path: Path) -> None:
    path.rename(path.parent.parent / "elsewhere.gpkg")
    path.symlink_to(path.parent.parent / "elsewhere.gpkg")


def pages_that_lead_to_each_other(path: Path) -> None:
    """Make every interior page of every tree lead to itself and to its like, again and again."""
    raw = bytearray(path.read_bytes())
    for number in range(1, len(raw) // PAGE_BYTES):
        at = number * PAGE_BYTES
        if raw[at] == 5:  # an interior page of a table
            (cells,) = struct.unpack_from(">H", raw, at + 3)
            (first,) = struct.unpack_from(">H", raw, at + 12)
            child = raw[at + first : at + first + 4]
            for cell in range(cells):
                (place,) = struct.unpack_from(">H", raw, at + 12 + 2 * cell)
                raw[at + place : at + place + 4] = child
            raw[at + 8 : at + 12] = child
    path.write_bytes(raw)


ATTACKS: dict[str, Callable[[Path], None]] = {
    "attach": attach,
    "pragma": pragma,
    "vacuum": vacuum,
    "table-of-a-query": table_of_a_query,
    "known-table-of-a-query": known_table_of_a_query,
    "virtual-table": virtual_table,
    "virtual-events": virtual_meta,
    **{f"view-{name}": view_over(name) for name in ("meta", "applied", "blocks", "events")},
    "view-that-lies": view_that_lies,
    "trigger": trigger,
    "endless-trigger": endless_trigger,
    "computed-column": computed_column,
    "check-constraint": check_constraint,
    "index-on-an-expression": index_on_an_expression,
    "default-of-a-column": default_of_a_column,
    "huge-value": huge_value,
    "rollback-names-another": rollback_file_with_another_name,
    **{
        f"side{name}-{kind}": side(name, kind)
        for name in ("-wal", "-journal", "-shm")
        for kind in ("link", "fifo", "folder")
    },
    "link-to-elsewhere": link_to_elsewhere,
    "pages-in-circles": pages_that_lead_to_each_other,
}


def snapshot(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


@pytest.mark.parametrize("damage", [False, True], ids=["whole", "damaged"])
@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_of_a_strangers_journal_is_run(
    path: Path,
    attack: str,
    damage: bool,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("companion.journal.read_only._VALUE_BYTES_MAX", 2_000_000)
    ATTACKS[attack](path)
    if damage and path.is_file():
        with path.open("r+b") as file:  # within a page: what is left is salvaged
            file.truncate(path.stat().st_size - 100)
    outside = snapshot(path.parent.parent)

    assert look_at(path).state
    for read in (
        read_journal,
        lambda one: read_journal(one, is_lenient=True),
        read_treated_ground,
        is_journal,
        lambda one: read_applied(one, unread=[]),
    ):
        with suppress(VrsprayError):
            read(path)
    for command in ("list", "recover"):
        assert execute(["flights", command, "--folder", str(path.parent)]) in (0, 1, 2)
    assert execute(["flights", "show", str(path)]) in (0, 1, 2)
    with suppress(sqlite3.Error, ValueError, OSError):
        salvage(path)

    assert "Traceback" not in capsys.readouterr().err
    assert snapshot(path.parent.parent) == outside
    for made in (path, salvaged_name(path)):
        if made.is_file() and (made != path or "trigger" in attack):
            with closing(sqlite3.connect(made)) as connection, suppress(sqlite3.DatabaseError):
                sql = "SELECT count(*) FROM events WHERE kind = 'evil'"
                assert connection.execute(sql).fetchone() == (0,)
    if salvaged_name(path).is_file():
        with closing(sqlite3.connect(salvaged_name(path))) as connection:
            sql = "SELECT type, name FROM sqlite_master WHERE sql IS NOT NULL"
            assert {tuple(row) for row in connection.execute(sql)} <= {
                ("table", name) for name in known_tables()
            }


def test_a_journal_that_harms_nobody_is_recovered_in_place(path: Path) -> None:
    found = recover(path)
    assert found is not None
    assert found.outcome == "recovered"
    assert found.is_good


@pytest.mark.parametrize("name", ["a?mode=rwc#b", "file:c", "d%20e;f'g\"h"])
def test_the_name_of_a_folder_is_a_name(path: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    path.parent.rename(folder)
    (found,) = (recover(folder / path.name),)
    assert found is not None
    assert found.outcome == "recovered"
    assert look_at(folder / path.name).state == "recovered"
    assert {file.name for file in tmp_path.iterdir()} == {name, PRECIOUS}


@pytest.mark.parametrize(
    "sql",
    [
        "ATTACH DATABASE ':memory:' AS other",
        "SELECT load_extension('evil')",
        "PRAGMA journal_mode = DELETE",
        "PRAGMA trusted_schema = ON",
        "CREATE TABLE evil (a)",
        "CREATE TEMP TABLE evil (a)",
        "CREATE TRIGGER evil AFTER INSERT ON meta BEGIN SELECT 1; END",
        "CREATE VIRTUAL TABLE evil USING fts5(a)",
        "DROP TABLE meta",
        "INSERT INTO meta (key) VALUES ('a')",
        "INSERT INTO sqlite_master VALUES (1, 2, 3, 4, 5)",
        "SELECT * FROM evil",
        "SELECT randomblob(9)",
        "VACUUM",
        ENDLESS,
    ],
)
def test_what_is_none_of_our_statements_is_refused(sql: str) -> None:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.executescript("CREATE TABLE evil (a); CREATE TABLE meta (key)")
        distrust(connection, 0)
        assert connection.execute("SELECT count(*) FROM meta").fetchone() == (0,)
        with pytest.raises(
            sqlite3.DatabaseError, match=r"not authorized|prohibited|too many|denied"
        ):
            connection.execute(sql).fetchall()


def test_what_would_never_end_is_ended() -> None:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as connection:
        connection.execute("CREATE TABLE meta (key)")
        connection.executemany("INSERT INTO meta VALUES (?)", [(key,) for key in range(1000)])
        distrust(connection, 0)
        many = ", ".join(f"meta AS m{number}" for number in range(6))
        with pytest.raises(sqlite3.OperationalError, match="interrupted"):
            connection.execute(f"SELECT count(*) FROM {many}").fetchall()
