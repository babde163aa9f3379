"""What was no spraying of a product is marked: journal, operator, replay, evaluation."""

from __future__ import annotations

import asyncio
import json
from dataclasses import replace
from pathlib import Path

import pytest

from analysis.evaluation import evaluate
from analysis.flown.read_applied import read_applied
from analysis.journals.content import read_journal
from analysis.replay import replay
from analysis.report import contents
from companion.cli import ground
from companion.cli.app import execute
from companion.cli.run import component_options, training_mark
from companion.cli.sensor_parts import TankSensor
from companion.config import load
from companion.journal.journal import Journal
from companion.link.component import Component, ComponentOptions
from tests import builders
from tests.analysis import report_flight
from tests.analysis.test_evaluation_flights import Flight, record_of
from tests.companion.component_peer import Peer
from tests.companion.test_sensors_gauges import FakeCounter, FakeLevel
from tests.companion.wire_peer import free_port, heard

EXAMPLE = Path(__file__).parents[2] / "examples" / "anyang" / "config.toml"


@pytest.mark.parametrize(
    ("overrides", "mark"),
    [
        ((), "no"),
        (("journal.training=true",), "water"),
        (('output.kind="none"',), "dry"),
        (('output.kind="none"', "journal.training=true"), "dry"),
    ],
)
def test_the_mark_is_what_is_in_the_tank(overrides: tuple[str, ...], mark: str) -> None:
    config = load(EXAMPLE, overrides=overrides)
    assert training_mark(config) == mark
    options = component_options(config, training=mark)
    assert options.training == ("" if mark == "no" else mark)


def test_run_marks_its_journal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    words = ["run", "--config", str(EXAMPLE), "--water", "--json", "--duration-s", "0.5"]
    words += ["--set", f"link.url=udpin:127.0.0.1:{port}", "--set", f"journal.folder={tmp_path}"]
    with heard(port):
        code = execute(words)
    result = json.loads(capsys.readouterr().out)
    assert (code, result["training"]) == (0, "water")
    assert read_journal(Path(result["journal"])).training == "water"
    assert replay(Path(result["journal"])).training == "water"
    assert execute(["replay", result["journal"]]) == 0
    assert "training: water" in capsys.readouterr().err


def test_a_journal_of_which_nobody_says_is_not_taken_for_either(tmp_path: Path) -> None:
    with Journal.create(tmp_path, setup=builders.setup()) as journal:
        pass
    assert read_journal(journal.path).training is None


@pytest.mark.parametrize(("training", "number"), [("water", 1.0), ("dry", 2.0), ("ground", 3.0)])
def test_the_operator_is_told_and_sees_it(training: str, number: float) -> None:
    peer = Peer()
    component = Component(ComponentOptions(training=training), peer.take)
    component.receive(peer.heartbeat(), 0.0)
    component.tick(None, 0.1)
    assert f"Spray: training: {training}" in peer.texts()
    from tests.companion.test_link_commands import CLOSED

    component.tick(CLOSED, 0.2)
    assert peer.named("SPR_TRAIN") == [number]


def test_a_flight_with_a_product_says_nothing_of_training() -> None:
    from tests.companion.test_link_commands import CLOSED

    peer = Peer()
    component = Component(ComponentOptions(), peer.take)
    component.receive(peer.heartbeat(), 0.0)
    component.tick(CLOSED, 0.1)
    assert not any("training" in text for text in peer.texts())
    assert not peer.named("SPR_TRAIN")


def test_the_evaluation_carries_the_mark() -> None:
    record, _ = record_of(Flight(rates=[[20.0, 26.0, 20.0]], valves=2))
    assert evaluate(record).as_json()["training"] is None
    marked = replace(record, meta=replace(record.meta, training="water"))
    assert evaluate(marked).as_json()["training"] == "water"


def test_ground_work_is_written_a_line_a_piece(tmp_path: Path) -> None:
    log = ground.ready_log(tmp_path / "flights")
    assert ground.append(log, {"kind": "prime", "training": "ground"}) is None
    assert ground.append(log, {"kind": "flush", "training": "ground"}) is None
    kinds = [json.loads(line)["kind"] for line in log.read_text().splitlines()]
    assert kinds == ["prime", "flush"]
    assert "not written" in (ground.append(tmp_path, {}) or "")
    assert "not written" in (ground.append(log, {"open_s": float("nan")}) or "")
    assert len(log.read_text().splitlines()) == 2


# --------------------------------------------------------------------------------------- refill


def test_a_refill_counts_at_once_and_the_level_begins_its_mean_anew() -> None:
    counter, level = FakeCounter(), FakeLevel(3.0)
    tank = TankSensor(counter, level, capacity_l=40.0, filled_l=3.0)
    asyncio.run(tank.open(lambda: None))
    for second in range(1, 13):
        (report,) = tank.read(float(second))
    level.litres = 30.0
    assert tank.refilled(30.0)
    (report,) = tank.read(12.1)
    assert (report.level_l, report.fault) == (30.0, "")  # type: ignore[union-attr]
    (report,) = tank.read(23.0)
    assert (report.level_l, report.fault) == (30.0, "")  # type: ignore[union-attr]


@pytest.mark.parametrize("litres", [41.0, -0.1, float("nan"), float("inf")])
def test_a_refill_that_does_not_go_in_changes_nothing(litres: float) -> None:
    tank = TankSensor(FakeCounter(), None, capacity_l=40.0, filled_l=3.0)
    assert not tank.refilled(litres)
    (report,) = tank.read(1.0)
    assert report.level_l == 3.0  # type: ignore[union-attr]


def test_a_filling_that_the_sensor_refuses_is_denied_and_not_shown() -> None:
    peer = Peer()
    component = Component(ComponentOptions(), peer.take)
    component.on_refilled = lambda litres: litres <= 10.0
    component.receive(peer.heartbeat(), 0.0)
    component.receive(peer.command(31011, 8.0), 1.0)
    component.receive(peer.command(31011, 12.0), 2.0)
    assert [ack.result for ack in peer.of("COMMAND_ACK")] == [0, 2]
    from tests.companion.test_link_commands import CLOSED

    component.tick(CLOSED, 2.1)
    component.tick(CLOSED, 3.2)
    assert set(peer.named("SPR_TANK")) == {8.0}


def test_a_simulated_flight_is_marked_and_its_report_says_so(tmp_path: Path) -> None:
    path = report_flight.fly(tmp_path, training="simulated")
    flight = read_applied(path)
    assert [each.code for each in contents._simulated(flight)] == ["simulated"]
    assert flight.simulated.is_simulated


def test_run_refuses_widths_that_config_check_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = execute(
        [
            *("run", "--config", str(EXAMPLE), "--json", "--duration-s", "0.2"),
            *("--set", "boom.width_m=5.0", "--set", f"journal.folder={tmp_path}"),
        ]
    )
    assert code == 2
    assert "width_m" in json.loads(capsys.readouterr().out)["error"]
    assert not list(tmp_path.iterdir())
