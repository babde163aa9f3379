"""The folder of journals: what is listed, pinned, pruned; nothing ever writes into a flight."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from companion.cli.app import execute
from companion.cli.record_parts import made_ready
from companion.errors import JournalError
from companion.journal.folder import (
    Flight,
    Rules,
    Space,
    chosen,
    journals,
    look_at,
    pin_of,
    prune,
    set_pinned,
)
from companion.journal.journal import Journal
from tests.builders import setup
from tests.companion.test_journal import change, closed_journal

FULL = Space(total_bytes=100, free_bytes=0)
ROOMY = Space(total_bytes=100, free_bytes=99)
DAY_S = 86_400.0


def flight(number: int, **changes: Any) -> Flight:
    given: dict[str, Any] = {
        "path": Path(f"flight-{number:04d}.gpkg"),
        "size_bytes": 1,
        "state": "closed",
        "is_pinned": False,
        "started_utc_s": 1e9 + number * DAY_S,
        "utc_source": "autopilot",
        "duration_s": 60.0,
    }
    return Flight(**{**given, **changes})


def numbers(removals: list[folder.Removal]) -> list[int]:
    return [int(each.flight.path.stem[-4:]) for each in removals]


FLIGHTS = [flight(number) for number in range(1, 21)]


def test_for_want_of_space_the_oldest_go_until_there_is_enough() -> None:
    assert numbers(chosen(FLIGHTS, Rules(free_percent=3.0), FULL, 0.0)) == [1, 2, 3]
    assert chosen(FLIGHTS, Rules(free_percent=3.0), ROOMY, 0.0) == []


def test_for_want_of_space_the_newest_ten_stay_all_the_same() -> None:
    assert numbers(chosen(FLIGHTS, Rules(free_percent=90.0), FULL, 0.0)) == list(range(1, 11))


def test_so_many_are_kept_and_never_fewer_than_ten() -> None:
    assert numbers(chosen(FLIGHTS, Rules(free_percent=None, count=17), FULL, 0.0)) == [1, 2, 3]
    few = Rules(free_percent=None, count=2)
    assert numbers(chosen(FLIGHTS, few, FULL, 0.0)) == list(range(1, 11))


LONG = Rules(free_percent=None, days=12.0)
NOW_S = 1e9 + 20.5 * DAY_S


def test_they_are_kept_so_long_where_the_autopilot_told_the_time() -> None:
    assert numbers(chosen(FLIGHTS, LONG, ROOMY, NOW_S)) == list(range(1, 8))
    unsure = [flight(number, utc_source="computer") for number in range(1, 21)]
    assert chosen(unsure, LONG, ROOMY, NOW_S) == []
    assert numbers(chosen(FLIGHTS, Rules(days=0.01), ROOMY, NOW_S)) == list(range(1, 11))


@pytest.mark.parametrize("wrong_s", [-1e9, -30 * DAY_S, 3650 * DAY_S, 1e12])
def test_no_clock_that_is_wrong_alone_removes_a_flight_too_early(wrong_s: float) -> None:
    right = {1, 2, 3, 4, 5, 6, 7, 8}  # what is older than twelve days
    assert set(numbers(chosen(FLIGHTS, LONG, ROOMY, NOW_S + wrong_s))) <= right
    # And one flight whose autopilot was wrong.
    flights = [*FLIGHTS[:-1], flight(20, started_utc_s=NOW_S + wrong_s)]
    assert set(numbers(chosen(flights, LONG, ROOMY, NOW_S))) <= right


@pytest.mark.parametrize(
    "changes",
    [{"is_pinned": True}]
    + [{"state": state} for state in ("open", "cut", "damaged", "other-version", "salvaged")],
)
def test_what_is_pinned_open_or_not_whole_never_goes(changes: dict[str, Any]) -> None:
    flights = [flight(number, **changes) for number in range(1, 31)]
    for rules in (Rules(free_percent=90.0), Rules(count=1), Rules(days=1.0)):
        assert chosen(flights, rules, FULL, 1e12) == []


def test_a_flight_that_is_recovered_may_go() -> None:
    flights = [flight(number, state="recovered") for number in range(1, 13)]
    assert numbers(chosen(flights, Rules(count=11), ROOMY, 0.0)) == [1]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of three flights, as if one were already too many."""
    monkeypatch.setattr("companion.journal.folder.ALWAYS_KEPT", 0)
    for _ in range(3):
        closed_journal(tmp_path, 25)
    return tmp_path


def test_a_flight_is_described(folder: Path) -> None:
    assert [path.name[:11] for path in journals(folder)] == [f"flight-000{n}" for n in (1, 2, 3)]
    found = look_at(folder / "flight-0002.gpkg")
    assert (found.state, found.utc_source, found.is_pinned) == ("closed", "computer", False)
    assert found.duration_s == pytest.approx(24 / 20)
    assert found.applied_l is not None
    assert found.applied_l > 0.0
    assert found.problem is None


def test_a_pin_is_a_file_beside_and_the_flight_is_not_touched(folder: Path) -> None:
    path = folder / "flight-0001.gpkg"
    before = (path.read_bytes(), path.stat().st_mtime_ns)
    assert set_pinned(path, is_pinned=True)
    assert not set_pinned(path, is_pinned=True)
    assert look_at(path).is_pinned
    assert numbers(prune(folder, Rules(free_percent=None, count=1), now_utc_s=0.0)) == [2]
    assert set_pinned(path, is_pinned=False)
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before
    with pytest.raises(JournalError, match="no such file"):
        set_pinned(folder / "flight-0009.gpkg", is_pinned=True)


def test_what_is_no_journal_is_not_pinned(
    tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("not a flight\n" * 100)
    assert execute(["flights", "pin", str(notes)]) == 2
    assert capsys.readouterr().err == (
        f"error: {notes}: this is not a journal; give the .gpkg file of a flight\n"
    )
    assert not pin_of(notes).exists()
    damaged = folder / "flight-0001.gpkg"
    damaged.write_bytes(damaged.read_bytes()[:20_000])
    assert set_pinned(damaged, is_pinned=True)


def test_a_log_beside_a_flight_goes_with_it(folder: Path) -> None:
    logs = [folder / f"flight-0001.gpkg-wal{end}" for end in ("", ".damaged")]
    for log in logs:
        log.write_bytes(b"")
    assert numbers(prune(folder, Rules(free_percent=None, count=2), now_utc_s=0.0)) == [1]
    assert not any(log.exists() for log in logs)


def test_what_is_pinned_meanwhile_is_neither_removed_nor_listed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def space(_folder: Path) -> Space:
        set_pinned(folder / "flight-0001.gpkg", is_pinned=True)
        return ROOMY

    monkeypatch.setattr("companion.journal.folder.space_of", space)
    assert numbers(prune(folder, Rules(free_percent=None, count=1), now_utc_s=0.0)) == [2]
    assert (folder / "flight-0001.gpkg").exists()


def test_what_cannot_be_removed_is_said_and_the_others_go(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unlink = Path.unlink

    def stuck(path: Path, missing_ok: bool = False) -> None:
        if path.name == "flight-0001.gpkg":
            raise PermissionError(1, "Operation not permitted")
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", stuck)
    monkeypatch.setattr("companion.cli.flights.Rules", lambda: Rules(count=1, free_percent=None))
    found = told(capsys, "prune", "--folder", str(folder), code=1)
    assert [Path(each["file"]).name for each in found["removed"]] == ["flight-0002.gpkg"]
    assert found["failed"][0]["problem"] == "cannot be removed (Operation not permitted)"
    assert len(journals(folder)) == 2


def test_a_dry_run_removes_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rules = Rules(free_percent=None, count=1)
    assert numbers(prune(folder, rules, now_utc_s=0.0, is_dry_run=True)) == [1, 2]
    assert len(journals(folder)) == 3
    assert execute(["flights", "prune", "--folder", str(folder), "--dry-run", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["is_dry_run"] is True


def test_an_open_flight_is_listed_as_such_and_never_pruned(folder: Path) -> None:
    with Journal.create(folder, setup=setup()) as journal:
        assert look_at(journal.path).state == "open"
        assert numbers(prune(folder, Rules(count=1, free_percent=None), now_utc_s=0.0)) == [1, 2]
    assert journal.path.exists()


# ------------------------------------------------------------------------------------ the command


def told(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> dict[str, Any]:
    assert execute(["flights", *arguments, "--json"]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_list_show_pin_and_unpin(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(folder / "flight-0001.gpkg")
    assert told(capsys, "pin", path)["changed"] == 1
    found = told(capsys, "list", "--folder", str(folder))
    assert [each["pinned"] for each in found["flights"]] == [True, False, False]
    assert told(capsys, "unpin", path)["changed"] == 1
    shown = told(capsys, "show", path)
    assert shown["entries"] == {"Decision": 25}
    assert len(shown["meta"]["calibration_sha256"]) == 64
    assert shown["unread"] == []
    assert told(capsys, "recover", "--folder", str(folder))["journals"] == []


def test_lines_for_a_person(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(folder / "flight-0001.gpkg")
    execute(["flights", "list", "--folder", str(folder)])
    assert "flight-0003.gpkg, " in capsys.readouterr().out
    execute(["flights", "show", path])
    assert "inputs and decisions: 25 Decision" in capsys.readouterr().out


PARTIAL = {
    "version": "UPDATE meta SET value = '7' WHERE key = 'journal_version'",
    "block": "UPDATE blocks SET body = zeroblob(50)",
    "set-up": "UPDATE meta SET value = '{}' WHERE key = 'setup'",
}


@pytest.mark.parametrize("case", PARTIAL)
def test_what_can_be_read_is_shown_and_what_not_is_said(
    case: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "flight-0001.gpkg"
    change(path, PARTIAL[case])
    shown = told(capsys, "show", str(path), code=1)
    assert len(shown["unread"]) == 1
    assert shown["meta"]["map_sha256"] == setup().prescription.sha256


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_file_that_was_cut_off_is_shown_as_far_as_it_goes(
    share: float, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "flight-0001.gpkg"
    os.truncate(path, int(path.stat().st_size * share))
    shown = told(capsys, "show", str(path), code=1)
    assert shown["unread"]
    assert ("map_sha256" in shown["meta"]) == (share > 0.9)  # so small a file: it lies behind
    assert all("\n" not in text for text in shown["unread"])


def test_wrong_places_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (
        ["list", "--folder", str(tmp_path / "none")],
        ["show", str(tmp_path / "none.gpkg")],
        ["list", "--folder", "a", "--config", "b"],
    ):
        assert execute(["flights", *arguments]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


# --------------------------------------------------------------------------------- before a flight


def test_before_a_flight_what_a_crash_left_is_recovered_and_nothing_is_removed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However little room there is: the law may want a record kept that nobody has exported."""
    for number in range(4, 30):
        shutil.copy(folder / "flight-0001.gpkg", folder / f"flight-{number:04d}.gpkg")
    before = [path.name for path in journals(folder)]
    change(folder / "flight-0002.gpkg", "UPDATE meta SET value = 'no' WHERE key = 'closed'")
    short = Space(total_bytes=10**10, free_bytes=5 * 10**8)
    monkeypatch.setattr("companion.journal.folder.space_of", lambda _folder: short)
    recovered, room = made_ready(folder)
    assert recovered.startswith("journal: flight-0002.gpkg: recovered")
    assert "only 5 % of the disk is free" in room and "vrspray flights prune" in room
    assert [path.name for path in journals(folder)] == before


@pytest.mark.parametrize("place", [".", "not/yet/there"])
def test_a_full_disk_is_refused_before_the_flight(
    folder: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    full = Space(total_bytes=10**12, free_bytes=10**6)
    monkeypatch.setattr("companion.journal.folder.space_of", lambda _folder: full)
    with pytest.raises(JournalError, match="only 1 MB are free, a flight"):
        list(made_ready(folder / place))
