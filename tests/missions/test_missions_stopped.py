"""Ctrl-C while a plan is made: before there are lines, in the search, and a second time."""

from __future__ import annotations

import gc
import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, NoReturn

import pytest
import shapely
from shapely import box

import missions.cli
import missions.planner
import missions.search
import missions.selection
from companion.cli import app
from missions.field import Field
from missions.plan import Plan, Settings
from missions.searching import Watch, lines_are_drawn, steps, watched
from tests.mission_fields import degrees

pytestmark = pytest.mark.usefixtures("searched_briefly")

SAID = "wrote the best plan so far"


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def plan(folder: Path) -> tuple[int, Path]:
    """Run the command on 5 ha, which take three tanks; return its code and what it writes."""
    field, out = folder / "field.geojson", folder / "out.geojson"
    field.write_text(shapely.to_geojson(degrees(box(0.0, 0.0, 250.0, 200.0))), encoding="utf-8")
    given = ["--swath-m", "6", "--speed-m-s", "6", "--rate-l-ha", "20", "--json"]
    return app.execute(["plan", "--force", str(field), "--out", str(out), *given]), out


def test_nobody_looks_on_any_more_after_an_error() -> None:
    watch = Watch()
    with pytest.raises(ValueError, match="broken"), watched(watch):
        raise ValueError("broken")
    lines_are_drawn()
    assert not watch.has_lines


def test_ctrl_c_before_there_are_lines_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def drawn(*_: object) -> NoReturn:
        press_ctrl_c()
        raise AssertionError("went on")

    monkeypatch.setattr(missions.planner, "spray_lines", drawn)
    code, out = plan(tmp_path)
    assert code == app.INTERRUPTED
    assert not out.exists()
    assert capsys.readouterr().err == "interrupted\n"


def pressing(*presses: int) -> Callable[[str, int], Iterator[int]]:
    """Return the steps of a search, at some of which Ctrl-C is pressed."""

    def pressed_steps(what: str, count: int) -> Iterator[int]:
        for step in steps(what, count):
            if step in presses:
                press_ctrl_c()
            yield step

    return pressed_steps


def pressed_at(monkeypatch: pytest.MonkeyPatch, *presses: int) -> list[int]:
    """Have Ctrl-C pressed at these steps of the search; return the list of those it does."""
    done: list[int] = []

    def watched_steps(what: str, count: int) -> Iterator[int]:
        for step in steps(what, count):
            done.append(step)
            if step in presses:
                press_ctrl_c()
            yield step

    monkeypatch.setattr(missions.search, "steps", watched_steps)
    return done


def test_ctrl_c_in_the_search_writes_the_best_plan_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done = pressed_at(monkeypatch, 1000)
    code, out = plan(tmp_path)
    assert code == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["stopped"] is True
    assert said.err.splitlines()[-1].endswith(SAID)
    assert out.exists()
    assert 1000 < len(done) < Settings(swath_width_m=6.0, speed_m_s=6.0).moves / 10
    # Later keys are the terminal's again.
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_ends_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pressed_at(monkeypatch, 1, 2)
    code, out = plan(tmp_path)
    assert code == app.INTERRUPTED
    assert not out.exists()
    assert capsys.readouterr().err == "interrupted\n"


SMALL = box(0.0, 0.0, 60.0, 41.0).union(box(0.0, 30.0, 25.0, 60.0))


def plan_small(folder: Path, *given: str) -> tuple[int, Path]:
    """Run the command on a corner of 0.3 ha, whose lines are chosen from all that could be."""
    field, out = folder / "field.geojson", folder / "out.geojson"
    field.write_text(shapely.to_geojson(degrees(SMALL)), encoding="utf-8")
    asked = ["--swath-m", "6", "--speed-m-s", "6", "--rate-l-ha", "20", "--json", *given]
    asked += ["--effort", "quick"]
    return app.execute(["plan", "--force", str(field), "--out", str(out), *asked]), out


def plans_made(monkeypatch: pytest.MonkeyPatch, *, press_in: int | None = None) -> list[Settings]:
    """Return what plans are made for, as they are; with a Ctrl-C as that one begins."""
    made: list[Settings] = []
    before = missions.planner._planned

    def planned(field: Field, settings: Settings, **given: Any) -> Plan:
        made.append(settings)
        if len(made) == press_in:
            press_ctrl_c()
        return before(field, settings, **given)

    monkeypatch.setattr(missions.planner, "_planned", planned)
    return made


def test_ctrl_c_while_lines_are_chosen_writes_a_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, _ = plan_small(tmp_path)
    usual = json.loads(capsys.readouterr().out)
    monkeypatch.setattr(missions.selection, "steps", pressing(100))
    code, out = plan_small(tmp_path)
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert (whole, code, found["stopped"]) == (0, 0, True)
    assert said.err.splitlines()[-1].endswith(SAID)
    assert out.exists()
    assert found["reachable_percent"] >= 99.8
    assert found["flight_s"] >= usual["flight_s"]


def test_ctrl_c_while_less_overlap_is_looked_for_keeps_the_least_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    undisturbed = plans_made(monkeypatch)
    plan_small(tmp_path, "--overlap-max", "0")
    capsys.readouterr()
    # Two of them are the other choices.
    assert len(undisturbed) > 4
    monkeypatch.undo()
    made = plans_made(monkeypatch, press_in=2)
    code, out = plan_small(tmp_path, "--overlap-max", "0")
    said = capsys.readouterr()
    assert (code, len(made)) == (0, 2)
    assert "above --overlap-max 0: the search was stopped before it found less" in said.err
    assert SAID in said.err
    assert out.exists()
    assert not json.loads(said.out)["prices"]


def test_ctrl_c_while_choices_are_looked_for_keeps_the_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = plans_made(monkeypatch, press_in=2)
    code, out = plan_small(tmp_path, "--choices")
    said = capsys.readouterr()
    assert (code, len(made)) == (0, 2)
    assert json.loads(said.out)["stopped"] is False
    assert "stopped: not all choices are shown" in said.err
    assert out.exists()


def test_a_cap_that_changes_no_line_is_not_lowered_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = plans_made(monkeypatch)
    # All ground is to be covered but 1 %, whatever falls twice.
    plan_small(tmp_path, "--overlap-max", "0.1", "--leave-max", "1")
    capsys.readouterr()
    asked = [each for each in made if each.leave_max_percent == 1.0]
    assert [each.overlap_max_percent is None for each in asked] == [False, False, True]


def test_an_undisturbed_plan_says_nothing_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _ = plan(tmp_path)
    said = capsys.readouterr()
    assert code == 0
    assert json.loads(said.out)["stopped"] is False
    assert SAID not in said.err


@pytest.fixture
def as_in_a_process_of_its_own() -> Iterator[None]:
    """Python's own thresholds: the tests' (tests/conftest.py) are those of a plan."""
    before = gc.get_threshold()
    gc.set_threshold(700, 10, 10)
    yield
    gc.set_threshold(*before)


@pytest.mark.parametrize("around", [missions.cli._seldom_collected, missions.cli._undisturbed])
@pytest.mark.parametrize("breaks", [False, True])
def test_what_a_plan_changes_of_the_process_is_as_before(
    around: Callable[[], AbstractContextManager[None]],
    breaks: bool,
    as_in_a_process_of_its_own: None,
) -> None:
    before = gc.get_threshold(), signal.getsignal(signal.SIGINT)
    with suppress(ValueError), around():
        assert (gc.get_threshold(), signal.getsignal(signal.SIGINT)) != before
        if breaks:
            raise ValueError("broken")
    assert (gc.get_threshold(), signal.getsignal(signal.SIGINT)) == before
