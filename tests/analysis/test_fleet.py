"""`vrspray fleet add` and `forget`: many journals as one data set, in any order, twice, at once."""

from __future__ import annotations

import hashlib
import json
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import fsspec
import pyarrow.parquet as pq
import pytest

from analysis.fleet.adding import add, journals_in
from analysis.fleet.asking import asked
from analysis.fleet.flight_row import recorded
from analysis.fleet.row import COLUMNS, operator_number
from analysis.fleet.store import Store
from companion.cli import answer
from companion.cli.app import execute
from companion.errors import ConfigError
from companion.journal.journal import Journal
from tests.analysis.fleet_flights import (
    TOLD,
    change,
    copied,
    damaged,
    earlier,
    simulated,
    started,
)
from tests.analysis.report_flight import fly
from tests.builders import setup

Captured = pytest.CaptureFixture[str]
GROWER = operator_number("A. Grower")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the journal of one real flight."""
    folder = tmp_path_factory.mktemp("flown")
    return fly(folder, told=dict(TOLD), event=("fault-leak", "leak"))


@pytest.fixture(scope="module")
def several(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the journals of five flights: in two months, one with water, one simulated."""
    folder = tmp_path_factory.mktemp("several")
    return [
        copied(flown, folder / "a" / "flight-0001.gpkg", started(1)),
        copied(flown, folder / "a" / "flight-0002.gpkg", started(2), operator="B. Other"),
        copied(flown, folder / "b" / "flight-0001.gpkg", started(3, 6), aircraft="T40 ES-2"),
        copied(flown, folder / "b" / "flight-0002.gpkg", {**started(4), "training": "water"}),
        simulated(flown, folder / "b" / "flight-0003.gpkg", 5),
    ]


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def taken(paths: list[Path], folder: Path | str, **options: Any) -> Any:
    return add(paths, Store.at(str(folder)), **options)


def rows(folder: Path | str, sql: str = "SELECT * FROM flights ORDER BY started_utc") -> list[Any]:
    with asked(Store.at(str(folder)).existing()) as fleet:
        return fleet.rows(sql)


def test_adding_twice_changes_nothing(several: list[Path], tmp_path: Path) -> None:
    first = taken(several, tmp_path)
    assert (first.added, first.evaluated, first.problems) == (5, 5, ())
    before = contents(tmp_path)
    again = taken(several, tmp_path)
    assert (again.added, again.replaced, again.unchanged, again.evaluated) == (0, 0, 5, 0)
    assert contents(tmp_path) == before


def test_the_folder_is_the_same_in_whatever_order_flights_come(
    several: list[Path], tmp_path: Path
) -> None:
    taken(several, tmp_path / "at-once")
    for path in reversed(several):
        taken([path], tmp_path / "one-by-one")
    assert contents(tmp_path / "at-once") == contents(tmp_path / "one-by-one")


def test_what_was_not_evaluated_is_evaluated_by_the_next_add(
    several: list[Path], tmp_path: Path
) -> None:
    quick = taken(several[:1], tmp_path / "f", evaluate=False)
    assert (quick.added, quick.not_evaluated) == (1, 1)
    (row,) = rows(tmp_path / "f")
    assert (row["applied_by"], row["mean_lag_m"], row["is_evaluated"]) == ("orders", None, False)
    then = taken(several[:1], tmp_path / "f")
    assert (then.added, then.unchanged, then.evaluated) == (0, 1, 1)
    taken(several[:1], tmp_path / "whole")
    assert contents(tmp_path / "f") == contents(tmp_path / "whole")


@pytest.mark.parametrize("step", ["reading journals", "evaluating flights"])
def test_what_was_done_before_an_interrupt_is_kept_and_gone_on_with(
    several: list[Path], tmp_path: Path, step: str
) -> None:
    def interrupt(what: str, done: int, _total: int) -> None:
        if (what, done) == (step, 3):
            raise KeyboardInterrupt

    is_reading = step == "reading journals"
    cut = taken(several, tmp_path / "f", tell=interrupt)
    assert cut.is_interrupted
    assert (cut.journals, cut.unchanged) == (2 if is_reading else 5, 0)
    flags = [row["is_evaluated"] for row in rows(tmp_path / "f")]
    assert (len(flags), sum(flags)) == ((2, 0) if is_reading else (5, 2))
    then = taken(several, tmp_path / "f")
    assert (then.added, then.evaluated) == ((3, 5) if is_reading else (0, 3))
    taken(several, tmp_path / "whole")
    assert contents(tmp_path / "f") == contents(tmp_path / "whole")


def test_a_journal_that_goes_on_between_the_steps_is_read_anew(flown: Path, tmp_path: Path) -> None:
    """What was read in the first step is taken in the second only of the very same file."""
    path = earlier(flown, tmp_path / "flight-0001.gpkg")

    def go_on(what: str, _done: int, _total: int) -> None:
        if what == "reading journals":
            shutil.copyfile(flown, path)

    assert taken([path], tmp_path / "f", tell=go_on).evaluated == 1
    taken([flown], tmp_path / "whole")
    (row,), (whole,) = rows(tmp_path / "f"), rows(tmp_path / "whole")
    for name in ("journal_state", "entries", "journal_sha256", "applied_l", "changes"):
        assert row[name] == whole[name], name


def test_flights_over_other_ground_have_a_map_of_their_own(flown: Path, tmp_path: Path) -> None:
    """Set-ups are kept by their ground too: not by what a journal says of its map."""
    other = copied(flown, tmp_path / "j" / "flight-0002.gpkg", started(9))
    change(other, {}, "UPDATE zones SET rate_l_ha = rate_l_ha * 2.0")
    taken([copied(flown, tmp_path / "j" / "flight-0001.gpkg", started(8)), other], tmp_path / "f")
    one, two = rows(tmp_path / "f")
    assert one["prescribed_l"] > 0.0
    assert two["prescribed_l"] == pytest.approx(2.0 * one["prescribed_l"])


def test_each_step_has_a_bar_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    bars = []
    make = answer._bar
    monkeypatch.setattr(answer, "_bar", lambda: bars.append(make()) or bars[0])
    with answer.progress() as tell:
        for done in range(1, 6):
            tell("reading journals", done, 5)
        (task,) = bars[0].tasks
        assert (task.description, task.completed, task.finished) == ("reading journals", 5, True)
        tell("evaluating flights", 1, 5)
        (task,) = bars[0].tasks
        assert (task.description, task.completed, task.finished) == ("evaluating flights", 1, False)


def test_a_row_says_what_the_report_says(
    several: list[Path], tmp_path: Path, capsys: Captured
) -> None:
    taken(several[:1], tmp_path / "fleet")
    (row,) = rows(tmp_path / "fleet")
    arguments = ["report", str(several[0]), "--out", str(tmp_path / "r"), "--no-figures", "--json"]
    execute(arguments)
    report = json.loads(capsys.readouterr().out)
    verdict = report["verdict"]
    for name in ("applied_l", "applied_by", "area_ha", "missed_m2", "doubled_m2", "untreated_m2"):
        assert row[name] == verdict[name], name
    assert row["mean_lag_m"] == verdict["mean_lag_m"]
    assert row["worst_lag_m"] == verdict["worst_m"]
    assert (row["missed_changes"], row["apart_changes"]) == (report["missed"], report["apart"])
    assert row["modelled_l"] == report["balance"]["model_l"]
    assert row["field_ha"] == report["flight"]["field_area_ha"]
    assert row["faults"] == [{"kind": "leak", "count": 1}]
    assert (row["machine"], row["field"], row["product"]) == ("T40 ES-1", "North", "Mix 50")
    noon = datetime(2026, 5, 1, 12, tzinfo=UTC)
    assert abs((row["started_utc"] - noon).total_seconds()) < 0.01
    assert set(row) == {each.name for each in COLUMNS}


def test_simulated_and_training_flights_stand_apart(several: list[Path], tmp_path: Path) -> None:
    taken(several, tmp_path, evaluate=False)
    folders = {path.parent.parent.name for path in tmp_path.rglob("*.parquet")}
    assert folders == {"kind=real", "kind=training", "kind=simulated"}
    counts = rows(tmp_path, "SELECT kind, count(*) AS n FROM flights GROUP BY kind ORDER BY kind")
    assert [(each["kind"], each["n"]) for each in counts] == [
        ("real", 3), ("simulated", 1), ("training", 1),
    ]  # fmt: skip


def test_closings_are_those_of_open_valves(flown: Path, tmp_path: Path) -> None:
    path = copied(flown, tmp_path / "flight-0001.gpkg")
    change(
        path,
        {},
        "UPDATE applied SET inhibits = 'not-armed', duty = 0",
        "UPDATE applied SET inhibits = '', duty = 0.5 WHERE time_s BETWEEN 103 AND 106.95",
        "UPDATE applied SET inhibits = 'leak no-flow', duty = 0 WHERE time_s BETWEEN 107 AND 109",
        "UPDATE applied SET inhibits = '', duty = 0.5 WHERE time_s > 109.01",
    )
    row = recorded(path)
    assert isinstance(row, dict)
    assert [(each["reason"], each["count"]) for each in row["closings"]] == [
        ("leak", 1), ("no-flow", 1),
    ]  # fmt: skip
    assert row["closings"][0]["seconds"] == pytest.approx(2.0, abs=0.2)


def test_damaged_journals_are_listed_and_the_others_are_in(
    several: list[Path], tmp_path: Path, capsys: Captured
) -> None:
    bad = damaged(several[1], tmp_path / "flight-0009.gpkg")
    nothing = tmp_path / "flight-0010.gpkg"
    nothing.write_bytes(b"no journal")
    fleet = str(tmp_path / "fleet")
    arguments = ["fleet", "add", str(several[0]), str(bad), str(nothing), "--into", fleet, "--json"]
    assert execute(arguments) == 1
    said = capsys.readouterr()
    assert f"not added: {nothing}: this is not a journal; give the .gpkg file" in said.err
    found = json.loads(said.out)
    assert found["added"] == 1
    assert {Path(each["file"]).name: each["is_damaged"] for each in found["problems"]} == {
        "flight-0009.gpkg": True, "flight-0010.gpkg": False,
    }  # fmt: skip
    assert [each["journal"] for each in rows(fleet, "FROM damaged")] == ["flight-0009.gpkg"]
    # The whole journal comes later: then nothing is missing any more.
    taken([several[1]], fleet, evaluate=False)
    assert rows(fleet, "FROM damaged") == []
    assert taken([bad], fleet, evaluate=False).problems == ()


def test_what_holds_no_journal_at_all_is_wrong_input(tmp_path: Path, capsys: Captured) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("rain at noon\n" * 20)
    assert execute(["fleet", "add", str(notes), "--into", str(tmp_path / "fleet")]) == 2
    assert capsys.readouterr().err == (
        f"not added: {notes}: this is not a journal; give the .gpkg file of a flight\n"
    )


@pytest.mark.parametrize("content", [b"", b"\0" * 70_000, b"SQLite f"])
def test_a_journal_of_which_nothing_was_written_is_listed(
    several: list[Path], tmp_path: Path, content: bytes
) -> None:
    """A power cut may leave no more than a name; two of them have the same content."""
    gone = [tmp_path / f"flight-000{number}.gpkg" for number in (8, 9)]
    for path in gone:
        path.write_bytes(content)
    found = taken([several[0], *gone], tmp_path / "fleet", evaluate=False)
    assert found.added == 1
    assert {each.text for each in found.problems} == {
        "this is not a journal: nothing of it was written to the disk"
    }
    taken(gone, tmp_path / "fleet", evaluate=False)
    listed = rows(tmp_path / "fleet", "SELECT journal FROM damaged ORDER BY journal")
    assert [each["journal"] for each in listed] == [path.name for path in gone]


@pytest.mark.parametrize("command", ["add", "query", "report", "forget"])
def test_the_folder_of_a_campaign_is_no_fleet(
    several: list[Path], tmp_path: Path, capsys: Captured, command: str
) -> None:
    campaign = tmp_path / "lags-flights"
    (campaign / "flights" / "part=00000").mkdir(parents=True)
    for name in ("manifest.json", "campaign.toml", "flights/part=00000/flights.parquet"):
        (campaign / name).touch()
    before = contents(campaign)
    given = {
        "add": [str(several[0]), "--into", str(campaign)],
        "query": ["SELECT 1", "--fleet", str(campaign)],
        "report": ["--out", str(tmp_path / "report"), "--fleet", str(campaign)],
        "forget": ["A. Grower", "--fleet", str(campaign)],
    }
    assert execute(["fleet", command, *given[command]]) == 2
    said = capsys.readouterr().err.strip()
    assert "holds the flights of a campaign; give a fleet's folder" in said and "\n" not in said
    assert contents(campaign) == before


def test_a_journal_that_is_still_written_is_left_for_later(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=setup(), started_s=1.0) as journal:
        found = taken([journal.path], tmp_path / "fleet")
        assert [each.is_damaged for each in found.problems] == [False]


@pytest.mark.parametrize("is_late", [True, False])
def test_the_record_that_goes_on_longest_counts(flown: Path, tmp_path: Path, is_late: bool) -> None:
    before = earlier(flown, tmp_path / "flight-0001.gpkg")
    both = [before, flown]
    for path in reversed(both) if is_late else both:
        taken([path], tmp_path / "fleet", evaluate=False)
    (row,) = rows(tmp_path / "fleet")
    assert row["journal_state"] == "closed"
    assert len(list((tmp_path / "fleet").rglob("*.parquet"))) == 1


def test_a_flight_that_turns_out_to_be_simulated_moves(flown: Path, tmp_path: Path) -> None:
    first = earlier(flown, tmp_path / "flight-0001.gpkg")
    taken([first], tmp_path / "fleet", evaluate=False)
    then = copied(flown, tmp_path / "flight-0002.gpkg", {"simulated": "yes"})
    found = taken([then], tmp_path / "fleet", evaluate=False)
    assert (found.added, found.replaced) == (0, 1)
    (file,) = (tmp_path / "fleet").rglob("*.parquet")
    assert file.parent.parent.name == "kind=simulated"


def test_two_writers_at_once_lose_nothing(
    several: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken([several[0]], tmp_path, evaluate=False)
    slow, quick = Store.at(str(tmp_path)), Store.at(str(tmp_path))
    replace = slow._replace

    def late(*arguments: Any) -> None:
        monkeypatch.undo()
        add([several[1]], quick, evaluate=False)  # the other one is done in between
        replace(*arguments)

    monkeypatch.setattr(slow, "_replace", late)
    third = copied(several[0], tmp_path / "flight-0003.gpkg", started(9))
    add([third], slow, evaluate=False)
    assert len(list((tmp_path / "flights").rglob("*.parquet"))) == 2
    assert len(rows(tmp_path)) == 3
    fourth = copied(several[0], tmp_path / "flight-0004.gpkg", started(10))
    add([fourth], Store.at(str(tmp_path)), evaluate=False)
    assert len(list((tmp_path / "flights").rglob("*.parquet"))) == 1
    assert len(rows(tmp_path)) == 4


def test_a_cut_between_new_and_old_file_loses_nothing(
    several: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken([several[0]], tmp_path, evaluate=False)
    store = Store.at(str(tmp_path))

    def cut(_path: str) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(type(store.fs), "rm_file", lambda _self, path: cut(path))
        with pytest.raises(KeyboardInterrupt):
            add([several[1]], store, evaluate=False)
    assert len(rows(tmp_path)) == 2
    assert taken([several[1]], tmp_path, evaluate=False).unchanged == 1


def test_other_stores_hold_the_same(several: list[Path], tmp_path: Path) -> None:
    taken(several[:3], tmp_path / "folder", evaluate=False)
    taken(several[:3], f"file://{tmp_path}/by-url", evaluate=False)
    taken(several[:3], "memory://a-fleet", evaluate=False)
    assert contents(tmp_path / "folder") == contents(tmp_path / "by-url")
    assert rows("memory://a-fleet") == rows(tmp_path / "folder")
    store = fsspec.filesystem("memory")
    assert len(store.find("/a-fleet")) == 2
    store.rm("/a-fleet", recursive=True)


def test_machines_are_named_where_the_journal_names_none(flown: Path, tmp_path: Path) -> None:
    path = copied(flown, tmp_path / "flight-0001.gpkg", {"application_json": "{}"})
    fleet = tmp_path / "fleet"
    taken([path], fleet, evaluate=False)
    assert rows(fleet)[0]["machine"] is None
    taken([path], fleet, machine="no. 7", evaluate=False)
    taken([path], fleet, evaluate=False)  # who adds it again need not know it
    assert rows(fleet)[0]["machine"] == "no. 7"


def test_no_name_of_a_person_is_kept(several: list[Path], tmp_path: Path) -> None:
    taken(several, tmp_path)
    for path in tmp_path.rglob("*.parquet"):
        text = str(pq.ParquetFile(path).read().to_pylist()) + repr(path.read_bytes())
        assert "Grower" not in text
        assert "Other" not in text


@pytest.mark.parametrize("who", ["a.  grower", GROWER])
def test_forget_removes_an_operator_for_good(
    several: list[Path], tmp_path: Path, capsys: Captured, who: str
) -> None:
    taken(several, tmp_path, evaluate=False)
    assert execute(["fleet", "forget", who, "--fleet", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["operator"], found["flights"]) == (GROWER, 4)
    taken([several[0]], tmp_path)  # a machine that was offline brings one of them again
    assert {each["operator"] for each in rows(tmp_path)} == {operator_number("B. Other"), None}
    assert len(rows(tmp_path)) == 5
    for path in tmp_path.rglob("*"):
        assert GROWER not in str(path)
        if path.suffix == ".parquet":
            assert GROWER not in str(pq.ParquetFile(path).read().to_pylist())


def test_forget_says_what_it_did(several: list[Path], tmp_path: Path, capsys: Captured) -> None:
    taken(several, tmp_path, evaluate=False)

    def said(*given: str) -> tuple[str, str]:
        assert execute(["fleet", "forget", *given, "--fleet", str(tmp_path)]) == 0
        told = capsys.readouterr()
        return told.out.strip(), told.err.strip()

    other = operator_number("B. Other")
    assert said("B. Other") == (f"{other}: 1 flight kept, without their operator", "")
    nobody = "no flight here names this operator; check the spelling"
    assert said("B. Other") == (f"{other}: 0 flights kept, without their operator", nobody)
    assert said(GROWER, "--flights") == (f"{GROWER}: 4 flights removed", "")
    assert execute(["fleet", "forget", "  ", "--fleet", str(tmp_path)]) == 2
    assert "OPERATOR: is empty; give the name, or the number op-" in capsys.readouterr().err


def test_forget_can_remove_the_flights_too(
    several: list[Path], tmp_path: Path, capsys: Captured
) -> None:
    taken(several, tmp_path, evaluate=False)
    arguments = ["fleet", "forget", "A. Grower", "--flights", "--fleet", str(tmp_path)]
    assert execute(arguments) == 0
    assert "4 flights" in capsys.readouterr().out
    assert [each["operator"] for each in rows(tmp_path)] == [operator_number("B. Other")]
    again = taken(several, tmp_path, evaluate=False)
    assert again.added == 0
    assert len(rows(tmp_path)) == 1


def test_folders_are_searched_for_journals(several: list[Path], tmp_path: Path) -> None:
    shutil.copytree(several[0].parents[1], tmp_path / "machines")
    (tmp_path / "machines" / "a" / "field.gpkg").write_bytes(b"a map")
    assert [each.name for each in journals_in([tmp_path / "machines"])] == [
        "flight-0001.gpkg", "flight-0002.gpkg",
        "flight-0001.gpkg", "flight-0002.gpkg", "flight-0003.gpkg",
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="no journals"):
        journals_in([_empty(tmp_path)])
    with pytest.raises(ConfigError, match="no such file"):
        journals_in([tmp_path / "nowhere.gpkg"])


def _empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"
