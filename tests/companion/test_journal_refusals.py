"""One damage, one answer: all commands that take a journal leave with the same exit code."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from analysis.journals.content import damages
from companion.cli.app import execute
from companion.errors import JournalError, UnreadableError
from companion.journal.geopackage import PAGE_BYTES
from companion.journal.reader import opened, refused
from tests.builders import setup
from tests.companion.test_coverage_journal import journal
from tests.companion.test_journal import change

Captured = pytest.CaptureFixture[str]
Damage = Callable[[Path], object]

COMMANDS: dict[str, list[str]] = {
    "show": ["flights", "show", "{journal}"],
    "remaining": ["flights", "remaining", "{journal}"],
    "replay": ["replay", "{journal}"],
    "report": ["report", "{journal}", "--out", "{out}/report", "--no-figures"],
    "export": ["export", "{journal}", "--out", "{out}/flight.csv"],
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return journal(tmp_path_factory.mktemp("sound"), setup(record_coverage=True), until_s=22.0)


@pytest.fixture
def path(sound: Path, tmp_path: Path) -> Path:
    """Return a journal, alone in its folder."""
    (tmp_path / "flights").mkdir()
    return Path(shutil.copy(sound, tmp_path / "flights"))


def sql(statement: str) -> Damage:
    return lambda path: change(path, statement)


def kept(share: float) -> Damage:
    return lambda path: path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def garbled(*pages: int | float) -> Damage:
    """Fill pages, given by their number or their place in the file, with noise."""

    def damage(path: Path) -> None:
        content = bytearray(path.read_bytes())
        for page in pages:
            number = page if isinstance(page, int) else int(page * len(content) / PAGE_BYTES)
            noise = random.Random(1).randbytes(PAGE_BYTES)
            content[(number - 1) * PAGE_BYTES : number * PAGE_BYTES] = noise
        path.write_bytes(content)

    return damage


def as_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def other_database(*statements: str) -> Damage:
    def damage(path: Path) -> None:
        path.unlink()
        with closing(sqlite3.connect(path)) as connection, connection:
            for statement in statements:
                connection.execute(statement)

    return damage


VERSION = "UPDATE meta SET value = '{}' WHERE key = 'journal_version'"
SETUP = "UPDATE meta SET value = {} WHERE key = 'setup'"
# What was done to the file, and what is said of it.
NO_JOURNAL: dict[str, tuple[Damage, str]] = {
    "no file": (Path.unlink, "there is no such file; give the .gpkg file of a flight"),
    "a folder": (as_folder, "is a folder; give the .gpkg file of a flight"),
    "a text": (lambda path: path.write_text("a text\n" * 99), "this is not a journal"),
    "empty": (lambda path: path.write_bytes(b""), "this is not a journal"),
    "other database": (other_database("CREATE TABLE meta (key, value)"), "this is not a journal"),
    "other geopackage": (
        other_database("PRAGMA application_id = 1196444487", "CREATE TABLE zones (geom)"),
        "this is a GeoPackage, but no journal of a flight",
    ),
}
DAMAGED: dict[str, tuple[Damage, str]] = {
    "50 bytes": (lambda path: path.write_bytes(path.read_bytes()[:50]), "nothing of it can be"),
    "first page": (lambda path: path.write_bytes(path.read_bytes()[:1024]), "nothing of it can be"),
    "half": (kept(0.5), "the file is shorter than it was"),
    "end": (kept(0.99), "it ends within a page"),
    "a page": (garbled(0.5), "a part of the file is damaged"),
    "last page": (garbled(1.0), "a part of the file is damaged"),
    "pages 2 to 4": (garbled(2, 3, 4), "a part of the file is damaged"),
    "version 99": (
        sql(VERSION.format(99)),
        "is a journal of version 99, this program reads versions 1 and 2; use a newer vrspray; it "
        "says of itself: begun ",
    ),
    "version abc": (sql(VERSION.format("abc")), "its version (abc) is none"),
    "no version": (sql("DELETE FROM meta WHERE key = 'journal_version'"), "version is missing"),
    "no setup": (sql("DELETE FROM meta WHERE key = 'setup'"), "no set-up of the flight: it is"),
    "setup": (sql(SETUP.format("substr(value, 1, 300)")), "its text is garbled or breaks off"),
    "other setup": (sql(SETUP.format("'[]'")), "what it says is not a set-up that this program"),
    "one sample": (
        sql("DELETE FROM applied WHERE sequence > (SELECT min(sequence) + 9 FROM applied)"),
        " rows, 122 were written",
    ),
    "no count": (sql("DELETE FROM meta WHERE key = 'lost'"), "the flight said of lost is missing"),
    "count": (
        sql("UPDATE meta SET value = 'x' WHERE key = 'lost'"),
        "said of lost is not a number",
    ),
    **{
        f"no table {table}": (sql(f"DROP TABLE {table}"), said)
        for table, said in {
            "zones": "no map: its zones or its field cannot be read",
            "field": "no map: its zones or its field cannot be read",
            "blocks": "the table blocks is missing",
            "applied": "the table applied is missing",
            "valve_changes": "the table valve_changes is missing",
            "events": "the table events is missing",
            "meta": "no set-up of the flight: it is gone",
        }.items()
    },
}


def run(name: str, path: Path, capsys: Captured) -> tuple[int, str]:
    """Return the exit code of a command, and all that it says."""
    out = path.parent.parent / "out"
    out.mkdir(exist_ok=True)
    code = execute([part.format(journal=path, out=out) for part in COMMANDS[name]])
    said = capsys.readouterr()
    return code, said.out + said.err


def left_in(folder: Path) -> set[str]:
    return {str(each.relative_to(folder)) for each in folder.rglob("*")}


@pytest.mark.parametrize("case", NO_JOURNAL)
def test_what_is_no_journal_is_exit_2_everywhere(case: str, path: Path, capsys: Captured) -> None:
    damage, text = NO_JOURNAL[case]
    damage(path)
    for name in COMMANDS:
        code, said = run(name, path, capsys)
        assert (name, code) == (name, 2)
        assert text in said
    assert left_in(path.parent.parent / "out") == set()


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_journal_is_exit_1_everywhere(case: str, path: Path, capsys: Captured) -> None:
    damage, text = DAMAGED[case]
    damage(path)
    before = path.read_bytes()
    for name in COMMANDS:
        code, said = run(name, path, capsys)
        assert (name, code) == (name, 1)
        assert any(each in said for each in (text, "is damaged", "not read: ", "not be read: "))
        assert "Traceback" not in said
        assert "no journal" not in said
    assert text in run("show", path, capsys)[1]
    assert path.read_bytes() == before
    assert left_in(path.parent) == {path.name}


def test_a_sound_journal_is_exit_0_everywhere(path: Path, capsys: Captured) -> None:
    codes = {name: run(name, path, capsys)[0] for name in COMMANDS}
    assert codes == dict.fromkeys(COMMANDS, 0)


@pytest.mark.parametrize("name", COMMANDS)
def test_what_hinders_is_one_object_too(name: str, path: Path, capsys: Captured) -> None:
    change(path, VERSION.format(99))
    arguments = [part.format(journal=path, out=path.parent.parent) for part in COMMANDS[name]]
    assert execute([*arguments, "--json"]) == 1
    said = capsys.readouterr()
    found: dict[str, Any] = json.loads(said.out)
    text = found["unread"][-1] if name == "show" else found["error"]
    assert "is a journal of version 99" in text


@pytest.mark.parametrize("case", ["no table applied", "no table valve_changes"])
def test_where_too_little_can_be_read_nobody_knows_what_was_sprayed(
    case: str, path: Path, capsys: Captured
) -> None:
    DAMAGED[case][0](path)
    assert run("report", path, capsys)[0] == 1
    out = path.parent.parent / "out" / "report"
    found: dict[str, Any] = json.loads((out / "report.json").read_text())
    verdict = found["verdict"]
    assert verdict.pop("sentence").startswith("Nothing can be said of what was sprayed")
    assert verdict.pop("worst_why_not") == "too little can be read"
    assert (verdict.pop("lag_count"), verdict.pop("change_count"), verdict.pop("unjudged")) == (
        0, 0, {},
    )  # fmt: skip
    assert set(verdict.values()) == {None}
    assert found["flight"]["treated_area_ha"] is None
    assert found["lag_distance_m"] is None
    assert found["application"]["generic"]["complete"] is False


def test_of_a_damaged_journal_the_verdict_says_that_it_is(path: Path, capsys: Captured) -> None:
    DAMAGED["last page"][0](path)
    assert run("report", path, capsys)[1].count("By what could be read: 0.57 L applied") == 1


def test_noise_within_a_block_is_seen_before_it_is_unpacked(path: Path) -> None:
    with opened(path, is_lenient=True) as journal:
        assert damages(journal.connection) == []
    last = "(SELECT max(first_sequence) FROM blocks)"
    change(path, f"UPDATE blocks SET decisions = zeroblob(90) WHERE first_sequence = {last}")
    with opened(path, is_lenient=True) as journal:
        (found,) = damages(journal.connection)
    assert found.startswith("inputs and decisions: 1 of ")


def test_words_and_class_come_from_one_place() -> None:
    locked = refused(Path("f"), sqlite3.OperationalError("database is locked"))
    assert type(locked) is JournalError
    assert "its flight still writes it" in str(locked)
    kept_back = refused(Path("f"), sqlite3.OperationalError("unable to open database file"))
    assert type(kept_back) is JournalError
    for error in (
        sqlite3.OperationalError("no such table: blocks"),
        sqlite3.DatabaseError("database disk image is malformed"),
        ValueError("x"),
        KeyError("lost"),
    ):
        assert type(refused(Path("f"), error)) is UnreadableError
