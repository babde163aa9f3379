"""What `vrspray run` shows: figures of decisions, and a drawing that nobody waits for."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from analysis.journals.content import read_journal
from companion.cli.drawing import drawn, shown_of
from companion.cli.live import Screen, Shown, Watcher
from companion.core.types import Decision, Inhibit, SprayerState, SprayPlan, TimedChange
from companion.tally import Tally, next_change_s
from tests.builders import flying
from tests.companion.wire_peer import free_port, heard

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "anyang"


def decision(now_s: float, *, flow_l_min: float = 6.0, rate: float | None = 20.0) -> Decision:
    plan = SprayPlan(
        sequence=1,
        issued_s=now_s,
        duty=(0.5, 0.5),
        changes=(TimedChange(at_s=now_s + 0.2, valve=1, duty=0.0),),
        lease_until_s=now_s + 0.3,
    )
    return Decision(
        now_s=now_s,
        state=flying(now_s, 0.0, velocity_east_m_s=3.0, velocity_north_m_s=4.0),
        inhibits=frozenset(),
        plan=plan,
        rate_l_ha=(rate, None),
        target_flow_l_min=flow_l_min,
        flow_l_min=flow_l_min,
        sprayer=SprayerState.SPRAYING,
    )


def test_tally_adds_up_litres_and_not_over_a_gap() -> None:
    tally = Tally(6.0)
    for now_s in (10.0, 10.5, 11.0, 99.0, 99.5):
        tally.take(decision(now_s))
    assert tally.volume_l == pytest.approx(6.0 / 60.0 * 1.5)


def test_given_rate_is_that_of_the_strips_that_are_to_get_any() -> None:
    # Half of 6 m, 5 m/s: 15 m2/s; 0.1 L/s.
    assert Tally(6.0).given_l_ha(decision(0.0)) == pytest.approx(0.1 / 15.0 * 1e4)
    assert Tally(6.0).given_l_ha(decision(0.0, rate=None)) is None
    assert next_change_s(decision(0.0)) == pytest.approx(0.2)


def test_the_block_says_what_an_operator_asks() -> None:
    def rates_at(east: np.ndarray, north: np.ndarray) -> np.ndarray:
        return np.where(east > 6.0, 30.0, np.nan)

    watcher = Watcher(width_m=6.0, faults=lambda: (None, "valve 2"), rates_at=rates_at)
    watcher.take(decision(10.0))
    held = replace(decision(10.1), inhibits=frozenset({Inhibit.SPEED_BELOW_MIN}))
    shown = watcher.shown(held)
    assert shown_of(json.loads(json.dumps(asdict(shown)))).rows() == shown.rows()
    rows = dict(shown.rows())
    assert rows["state"] == "SPRAYING: too slow"
    assert rows["rate"] == "20.0 L/ha wanted, 66.7 L/ha given"
    # East grows by 0.6 m each metre along the course.
    assert rows["boundary"] == "in 11 m, 2 s"
    assert rows["faults"] == "valve 2"
    assert "position" in rows["ages"]
    console = Console(file=io.StringIO(), width=80)
    console.print(drawn(shown, silent_s=9.0))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "NOTHING NEW FOR 9 s" in text
    assert "SPRAYING: too slow" in text


def test_a_latched_fault_that_is_over_says_how_to_release_it() -> None:
    assert "disable, then enable again" in dict(Shown(state="fault").rows())["faults"]
    assert dict(Shown(state="fault", faults=("valve 2",)).rows())["faults"] == "valve 2"
    assert dict(Shown(state="safe").rows())["faults"] == "none"


def test_nothing_known_is_no_number() -> None:
    assert dict(Shown().rows())["rate"] == "- wanted, - given"


def test_nothing_is_drawn_just_before_a_valve_moves() -> None:
    shown: list[float] = []

    class Sink:
        def show(self, _shown: Shown, now_s: float) -> None:
            shown.append(now_s)

    screen = Screen(Watcher(width_m=6.0, faults=tuple), clock=lambda: 1.0)
    screen._sink = Sink()  # type: ignore[assignment]
    near = decision(1.0)
    change = replace(near.plan.changes[0], at_s=1.005)
    screen.take(replace(near, plan=replace(near.plan, changes=(change,))))
    assert shown == []
    screen.take(near)
    assert shown == [1.0]


def run_words(folder: Path, port: int) -> list[str]:
    url = f"udpin:127.0.0.1:{port}"
    settings = [f"journal.folder={folder}", f"link.url={url}", "output.kind=none"]
    words = [part for one in settings for part in ("--set", one)]
    config = str(FOLDER / "config.toml")
    return [sys.executable, "-m", "companion", "run", "--config", config, *words]


def decisions_of(folder: Path) -> list[float]:
    items = read_journal(folder / "flight-0001.gpkg").items()
    return [each.now_s for each in items if isinstance(each, Decision)]


@pytest.mark.parametrize("kind", ["terminal", "pipe"])
def test_output_that_nobody_reads_stops_neither_loop_nor_end(kind: str, tmp_path: Path) -> None:
    if kind == "terminal":
        ours, theirs = pty.openpty()
    else:
        ours, theirs = os.pipe()
    port = free_port()
    with heard(port), (tmp_path / "out").open("wb") as out:
        process = subprocess.Popen(
            [*run_words(tmp_path, port), "--duration-s", "3"],
            stdout=out,
            stderr=theirs,
            env={**os.environ, "TERM": "xterm"},
        )
        told = b""
        while b"sprayed" not in told:
            told += os.read(ours, 4096)
        # Full from now on: whoever writes waits for ever.
        os.set_blocking(theirs, False)
        with pytest.raises(BlockingIOError):
            while True:
                os.write(theirs, b"x" * 1024)
        os.set_blocking(theirs, True)
        try:
            assert process.wait(40) == 0
        finally:
            process.kill()
            process.wait()
            os.close(theirs)
            os.close(ours)
    times_s = decisions_of(tmp_path)
    assert times_s[-1] - times_s[0] > 2.5
    assert max(np.diff(times_s)) < 1.0
    assert "journal: " in (tmp_path / "out").read_text()
